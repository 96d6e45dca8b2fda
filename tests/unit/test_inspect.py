"""`pssflow inspect`: what it finds is true, what it draws is a picture, wrong input ends in one clear line."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

import pssflow
from pssflow.cli import main
from pssflow.inspect import DISK, GRID, _Disk, at_pixel, over_image

ROOT = Path(__file__).parents[2]
CORNELL = ROOT / "scenes" / "cornell-box" / "scene.xml"
TINY = ("--variant", "scalar_rgb", "-D", "resolution=16")


@pytest.fixture(scope="module")
def scene() -> pssflow.Scene:
    mi.set_variant("scalar_rgb")
    return pssflow.Scene(CORNELL, resolution=16)


def test_densities_of_a_pixel_are_densities(scene):
    found = at_pixel(scene, (8, 12), ("none", "direction-table", "vegas"), spp=16)
    assert found.f.shape == found.best.shape == (GRID, GRID)
    assert found.f_directions.shape == (DISK, DISK)
    assert np.isclose(found.best.mean(), 1)
    none, table, vegas = found.guides
    assert np.allclose(none.density, 1)
    # A table's density is constant on its bins, so that the grid's mean is exact but for rounding of the probabilities.
    assert abs(table.density.mean() - 1) < 1e-3
    # The other three numbers are averaged by 262,144 random rows.
    assert abs(vegas.density.mean() - 1) < 0.1
    assert table.density.std() > 0.05
    for guide in (table, vegas):
        assert guide.density.min() >= guide.a - 1e-6


@pytest.mark.parametrize(("lowest", "reach"), [(0.0, 1.0), (-1.0, np.sqrt(2))])
def test_a_disk_holds_all_directions_at_their_density(lowest, reach):
    """Uniform on the hemisphere or on the sphere: the rim's cells, too, have the density 1/2π or 1/4π."""
    rng = np.random.default_rng(1)
    cosine, angle = rng.uniform(lowest, 1, 1_000_000), rng.uniform(0, 2 * np.pi, 1_000_000)
    sine = np.sqrt(1 - cosine**2)
    along = np.stack([sine * np.cos(angle), cosine, sine * np.sin(angle)], axis=1)
    normal = np.array([0, 1, 0], np.float32)
    disk = _Disk(along.astype(np.float32), np.ones(len(along), bool), normal)
    assert disk.reach == pytest.approx(reach)
    density = disk.density(np.ones(len(along)))
    inside = np.isfinite(density)
    # Slivers of the rim that none of a cell's points fell on are left out.
    assert np.sum(density[inside] * disk.steradians[inside]) == pytest.approx(1, rel=1e-4)
    uniform = 1 / (2 * np.pi * (1 - lowest))
    # 300 directions a whole cell; of a sliver of one, few.
    whole = disk.steradians > 0.5 * disk.steradians.max()
    assert np.abs(density[whole] / uniform - 1).max() < 0.5
    assert density[whole].mean() == pytest.approx(uniform, rel=0.01)


def test_below_a_surface_that_lets_light_through_the_sphere_is_shown():
    mi.set_variant("scalar_rgb")
    room = mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "to_world": mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 4, "height": 4},
            },
            "sheet": {
                "type": "rectangle",
                "bsdf": {"type": "roughdielectric", "alpha": 0.3},
            },
            "room": {"type": "sphere", "radius": 5.0, "flip_normals": True},
            "lamp": {"type": "point", "position": [0, 2, -2]},
        }
    )
    found = at_pixel(pssflow.Scene(room), (2, 2), ("none",), spp=4)
    assert found.reach == pytest.approx(np.sqrt(2))
    steps = np.linspace(-found.reach, found.reach, DISK)
    below = np.hypot(steps[:, None], steps[None, :]) > 1.1
    assert np.nansum(found.f_directions[below]) > 0
    assert np.nansum(found.f_directions[~below]) > 0


def test_one_bounce_has_a_map_but_no_direction(scene):
    found = over_image(scene, ("auto",), spp=8, k=1)
    assert found.rows[0].nonzero_share.shape == (scene.height, scene.width)


def test_maps_have_the_film_s_shape_and_shares_are_shares(scene):
    found = over_image(scene, ("direction-table", "vegas"), spp=16)
    shape = (scene.height, scene.width)
    for row in found.rows:
        assert row.gain.shape == row.nonzero_share.shape == shape
        assert ((row.nonzero_share >= 0) & (row.nonzero_share <= 1)).all()
        assert row.cells is not None
        assert row.cells.shape == shape
    cells = found.rows[0].cells
    assert cells is not None
    assert len(np.unique(cells)) > 4
    assert found.nonzero_share.max() <= 1


@pytest.mark.parametrize("look", [("--pixel", "8,12"), ("--map",), ("--map", "--k", "1")])
def test_the_command_writes_a_picture(look, tmp_path, capfd):
    out = tmp_path / "out.png"
    code = main(["inspect", str(CORNELL), *TINY, *look, "-o", str(out), "--spp", "8", "-q"])
    assert code == 0, capfd.readouterr().err
    assert out.read_bytes().startswith(b"\x89PNG")
    assert f"wrote {out}" in capfd.readouterr().out.replace("\n", "")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--pixel", "16,0"), "pixel 16,0 lies outside of the film, whose pixels are 0,0 to 15,15"),
        (("--pixel", "-1,3"), "pixel -1,3 lies outside of the film"),
        (("--pixel", "8;3"), "expected a column and a row, as 64,48"),
        (("--pixel", "8,3", "--map"), "give one of --pixel X,Y and --map"),
        ((), "give one of --pixel X,Y and --map"),
        (("--pixel", "8,3", "--k", "1"), "with one bounce no direction is drawn"),
        (("--map", "--guides", "nonsense"), "nonsense"),
    ],
)
def test_wrong_input_ends_in_one_line(arguments, message, tmp_path, capfd):
    code = main(["inspect", str(CORNELL), *TINY, "-o", str(tmp_path / "out.png"), *arguments])
    error = capfd.readouterr().err
    assert code != 0
    assert message in " ".join(error.split())
    assert "Traceback" not in error
    assert not (tmp_path / "out.png").exists()


def test_an_output_that_cannot_be_written_is_refused_before_any_work(tmp_path, capfd):
    code = main(["inspect", str(CORNELL), "--map", "-o", str(tmp_path / "no" / "out.png")])
    assert code != 0
    assert "there is no folder" in capfd.readouterr().err


def test_a_pixel_that_sees_nothing_says_so():
    mi.set_variant("scalar_rgb")
    empty = pssflow.Scene(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "film": {"type": "hdrfilm", "width": 4, "height": 4},
            },
            "light": {"type": "constant"},
            "ball": {
                "type": "sphere",
                "center": [0, 0, -5],
            },
        }
    )
    with pytest.raises(ValueError, match="pixel 1,1 sees no surface"):
        at_pixel(empty, (1, 1), ("none",))
