"""`pssflow inspect`: what it finds is true, what it draws is a picture, wrong input ends in one clear line."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

import pssflow
from pssflow.cli import main
from pssflow.inspect import DISK, GRID, at_pixel, over_image

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


@pytest.mark.parametrize("look", [("--pixel", "8,12"), ("--map",)])
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
