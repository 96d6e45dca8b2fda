"""The scenes that we ship and those of the tests: they load, they hold what their README says, the teapot is right."""

from __future__ import annotations

import importlib.util
import sys
from collections import Counter
from pathlib import Path
from types import ModuleType

import mitsuba as mi
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.scenes import SCENES

ROOT = Path(__file__).resolve().parents[2]
SHIPPED = sorted(path.parent for path in (ROOT / "scenes").glob("*/scene.xml"))
TEAPOT = ROOT / "scenes" / "teapot"


def _load_script(path: Path) -> ModuleType:
    """Imports a script that is in no package."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None, path
    assert spec.loader is not None, path
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


def _render(scene: mi.Scene, *, max_depth: int, spp: int) -> NDArray[np.float32]:
    """Mitsuba's own image, (H, W, 3)."""
    path = mi.load_dict({"type": "path", "max_depth": max_depth})
    # The stub asks for a Dr.Jit integer; the function takes a Python one.
    return np.array(mi.render(scene, integrator=path, spp=spp, seed=7))  # pyright: ignore[reportArgumentType]


tess = _load_script(TEAPOT / "tessellate.py")
modelling = _load_script(ROOT / "scenes" / "modelling.py")
MODELLED = [folder for folder in SHIPPED if (folder / "model.py").exists()]


@pytest.fixture(scope="module")
def teapot() -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Positions, normals and faces of the shipped resolution, in types that tests can compute with."""
    mesh = tess.tessellate()
    return mesh.positions.astype(float), mesh.normals.astype(float), mesh.faces.astype(int)


def test_there_are_shipped_scenes() -> None:
    hard = {"courtyard", "door-ajar", "glossy", "leaves", "many-lights"}
    assert {"cornell-box", "teapot", "white-room"} | hard <= {path.name for path in SHIPPED}


@pytest.mark.parametrize("folder", SHIPPED, ids=lambda path: path.name)
def test_shipped_scene_loads_and_keeps_its_parameters(folder: Path, variant: str) -> None:
    scene = mi.load_file(str(folder / "scene.xml"), resolution=24, spp=3, max_depth=2)
    (sensor,) = scene.sensors()
    assert list(sensor.film().size()) == [24, 24]
    assert sensor.sampler().sample_count() == 3
    assert len(scene.emitters()) >= 1

    default = mi.load_file(str(folder / "scene.xml"))
    assert list(default.sensors()[0].film().size()) == [256, 256]


@pytest.mark.parametrize("folder", SHIPPED, ids=lambda path: path.name)
def test_shipped_scene_says_what_is_hard_and_where_it_comes_from(folder: Path) -> None:
    text = (folder / "README.md").read_text(encoding="utf-8")
    for heading in ("## What is hard about it", "## What it is made from", "Licence: "):
        assert heading in text, f"{folder.name}/README.md lacks {heading!r}"


@pytest.mark.parametrize("name", SCENES)
def test_small_scene_loads_in_tiles_and_is_lit(name: str, variant: str) -> None:
    """Film sizes are whole tiles of 16²; a black image would pass every comparison of means."""
    scene = mi.load_dict(SCENES[name]())
    image = _render(scene, max_depth=3, spp=2)
    height, width, channels = image.shape
    assert channels == 3
    assert (width % 16, height % 16) == (0, 0)
    assert np.isfinite(image).all()
    assert image.mean() > 0.01


@pytest.mark.parametrize("folder", MODELLED, ids=lambda path: path.name)
def test_shipped_files_are_what_the_script_writes(folder: Path) -> None:
    """Bit for bit, nothing else lies beside them, and a scene's folder stays below a megabyte."""
    expected = modelling.outputs(folder)
    own = {"README.md", "model.py", "scene.xml"}
    files = {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert set(files) == own | set(expected)
    assert sum(map(len, files.values())) < 1_000_000
    for name, content in expected.items():
        assert files[name] == content, (
            f"{folder.name}/{name} differs from the script's; run python scenes/modelling.py {folder.name}"
        )


@pytest.mark.parametrize("folder", MODELLED, ids=lambda path: path.name)
def test_modelled_meshes_have_unit_normals_on_their_own_side(
    folder: Path, scalar_variant: str
) -> None:
    meshes = sorted((folder / "meshes").glob("*.ply"))
    assert meshes
    for path in meshes:
        params = mi.traverse(mi.load_dict({"type": "ply", "filename": str(path)}))
        positions = np.array(params["vertex_positions"], float).reshape(-1, 3)
        normals = np.array(params["vertex_normals"], float).reshape(-1, 3)
        corners = positions[np.array(params["faces"], int).reshape(-1, 3)]
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
        flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(flat, axis=1)
        assert area.min() > 1e-9, f"{path.name} has a degenerate triangle"
        faces = np.array(params["faces"], int).reshape(-1, 3)
        mean = normals[faces].sum(axis=1)
        assert ((flat * mean).sum(axis=-1) > 0).mean() > 0.99, path.name


@pytest.mark.parametrize("n", [0, 3, 12])
def test_a_circle_is_halved_quarters(n: int) -> None:
    with pytest.raises(ValueError, match=f"n = {n} points of a circle"):
        modelling.circle(n)


def test_stored_images_are_read_back(tmp_path: Path, scalar_variant: str) -> None:
    """More than one stored block; rows top to bottom; the channels in their order."""
    pixels = (np.arange(180 * 150 * 3) * 7 % 251).astype(np.uint8).reshape(180, 150, 3)
    for name, wanted in (("grey", pixels[..., 0]), ("rgb", pixels)):
        (tmp_path / f"{name}.png").write_bytes(modelling.png(wanted))
        read = np.array(mi.Bitmap(str(tmp_path / f"{name}.png")))
        np.testing.assert_array_equal(read.reshape(wanted.shape), wanted)
    (tmp_path / "sky.pfm").write_bytes(modelling.pfm(pixels / 8.0))
    np.testing.assert_array_equal(np.array(mi.Bitmap(str(tmp_path / "sky.pfm"))), pixels / 8.0)


def test_many_lights_are_many_and_each_keeps_to_its_cell(scalar_variant: str) -> None:
    """36 emitters, one-sided, facing down from below the partitions' tops."""
    scene = mi.load_file(str(ROOT / "scenes" / "many-lights" / "scene.xml"))
    assert len(scene.emitters()) == 36
    places = set()
    for lamp in scene.emitters():
        sample = lamp.get_shape().sample_position(0.0, [0.3, 0.7])
        np.testing.assert_allclose(np.array(sample.n), [0, -1, 0], atol=1e-6)
        x, y, z = np.array(sample.p)
        assert y < 1.75
        places.add((int((x + 7.8) // 2.6), int((z + 7.8) // 2.6)))
    assert len(places) == 36, "no two lamps in one cell"


def test_cornell_box_has_the_published_proportions(scalar_variant: str) -> None:
    """Room 5.528 × 5.488 × 5.592 and light 1.3 × 1.05 decimetres, to the millimetre that the scene keeps."""
    scene = mi.load_file(str(ROOT / "scenes" / "cornell-box" / "scene.xml"))
    box = scene.bbox()
    np.testing.assert_allclose(np.array(box.max - box.min), [5.52, 5.48, 5.6], atol=1e-5)
    (lamp,) = scene.emitters()
    assert lamp.get_shape().surface_area() == pytest.approx(1.3 * 1.05, rel=1e-5)
    assert sum(shape.primitive_count() for shape in scene.shapes()) == 36


def test_teapot_control_points_are_newells() -> None:
    """32 patches with 302 distinct points less those that the bottom repeats from the body, inside Newell's hull."""
    patches = tess.control_patches()
    assert patches.shape == (32, 4, 4, 3)
    distinct = np.unique(np.round(patches.reshape(-1, 3), 9) + 0.0, axis=0)
    assert len(distinct) == 290
    np.testing.assert_allclose(distinct.min(axis=0), [-3.0, -2.0, 0.0])
    np.testing.assert_allclose(distinct.max(axis=0), [3.525, 2.0, 3.15])


def test_teapot_fills_the_box_of_the_thesis(teapot) -> None:
    positions, _, _ = teapot
    np.testing.assert_allclose(positions.min(axis=0), [-3.0, -2.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(positions.max(axis=0), [3.43, 2.0, 3.15], atol=5e-3)


def test_shipped_mesh_is_what_the_script_writes() -> None:
    expected = tess.ply_bytes(tess.tessellate())
    assert (TEAPOT / "meshes" / "teapot.ply").read_bytes() == expected, (
        "meshes/teapot.ply differs from tessellate.py's output; run python scenes/teapot/tessellate.py"
    )


def test_mitsuba_reads_the_mesh_as_written(teapot, scalar_variant: str) -> None:
    positions, normals, faces = teapot
    mesh = mi.load_dict({"type": "ply", "filename": str(TEAPOT / "meshes" / "teapot.ply")})
    params = mi.traverse(mesh)
    np.testing.assert_array_equal(np.array(params["vertex_positions"]), positions.ravel())
    # Mitsuba normalises what it reads once more.
    np.testing.assert_allclose(np.array(params["vertex_normals"]), normals.ravel(), atol=2e-7)
    np.testing.assert_array_equal(np.array(params["faces"]), faces.ravel())


@pytest.mark.parametrize("n", [2, 5, 20])
def test_teapot_is_watertight_but_for_newells_openings(n: int) -> None:
    """Every directed edge occurs once and its reverse too, except on six loops: rim, lid, and both ends of handle and
    spout. Rim and lid are 4n edges long, the others 2n. No vertex is doubled, so no crack hides between equal edges.
    """
    mesh = tess.tessellate(n)
    edges = Counter((int(face[i]), int(face[(i + 1) % 3])) for face in mesh.faces for i in range(3))
    assert set(edges.values()) == {1}
    border = dict(edge for edge in edges if (edge[1], edge[0]) not in edges)
    loops = []
    while border:
        start, here = next(iter(border.items()))
        del border[start]
        length = 1
        while here != start:
            here = border.pop(here)
            length += 1
        loops.append(length)
    assert sorted(loops) == [2 * n] * 4 + [4 * n] * 2
    assert len(mesh.faces) == 64 * n * n - 8 * n


def test_teapot_vertices_are_distinct_within_parts(teapot) -> None:
    """Only the handle's lower end touches another part: it shares one point with the body."""
    positions, _, _ = teapot
    _, counts = np.unique(positions, axis=0, return_counts=True)
    assert sorted(counts[counts > 1]) == [2]


def test_teapot_normals_are_unit_and_point_outwards(teapot) -> None:
    positions, normals, faces = teapot
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)

    corners = positions[faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(flat, axis=1)
    assert area.min() > 1e-6, "degenerate triangle"
    agreement = ((flat / area[:, None])[:, None] * normals[faces]).sum(axis=-1)
    assert agreement.min() > 0.75, "a vertex normal turns away from its triangle"

    radius = np.hypot(positions[:, 0], positions[:, 1])
    z = positions[:, 2]
    body = np.isclose(radius, 2.0, atol=0.05) & (z > 0.7) & (z < 1.6)
    body &= np.abs(positions[:, 1]) > 0.7  # not the roots of handle and spout
    radial = (positions * normals)[:, :2].sum(axis=1) / np.maximum(radius, 1e-9)
    assert body.sum() > 500
    assert radial[body].min() > 0.9
    np.testing.assert_allclose(normals[z == z.max()], [[0, 0, 1]], atol=1e-6)
    np.testing.assert_allclose(normals[z == z.min()], [[0, 0, -1]], atol=1e-6)


@pytest.mark.parametrize("n", [-1, 0, 1])
def test_tessellate_refuses_too_few_segments(n: int) -> None:
    with pytest.raises(ValueError, match=f"n = {n} segments a patch: the teapot needs at least 2"):
        tess.tessellate(n)


@pytest.mark.parametrize(
    ("x", "y", "shape"),
    [
        (0.90, 0.06, "lamp"),  # top right
        (0.92, 0.31, "teapot"),  # spout, right
        (0.25, 0.21, "teapot"),  # handle, left
        (0.60, 0.85, "table"),
        (0.05, 0.05, None),
    ],
)
def test_teapot_camera_is_mirrored_as_in_pbrt(
    x: float, y: float, shape: str | None, scalar_variant: str
) -> None:
    scene = mi.load_file(str(TEAPOT / "scene.xml"))
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, [x, y], [0.5, 0.5])
    hit = scene.ray_intersect(ray)
    assert (hit.shape.id() if hit.is_valid() else None) == shape


def test_teapot_lamp_is_the_thesis_lamp(scalar_variant: str) -> None:
    scene = mi.load_file(str(TEAPOT / "scene.xml"))
    (lamp,) = scene.emitters()
    sample = lamp.get_shape().sample_position(0.0, [0.3, 0.7])
    np.testing.assert_allclose(np.array(sample.n), [0, np.sqrt(0.75), -0.5], atol=1e-6)
    assert np.linalg.norm(np.array(sample.p) - [2, -4, 4]) < 2
    assert lamp.get_shape().surface_area() == pytest.approx(4 * np.pi, rel=1e-5)


@pytest.mark.parity
def test_teapot_two_bounce_share_is_the_known_one(llvm_variant: str) -> None:
    """Two-bounce light is 3.6 % of what is not directly visible emission, to its last digit (noise here: .02 %)."""
    scene = mi.load_file(str(TEAPOT / "scene.xml"), resolution=96)
    means = [float(_render(scene, max_depth=depth, spp=128).mean()) for depth in (1, 2, 3, -1)]
    assert (means[2] - means[1]) / (means[3] - means[0]) == pytest.approx(0.036, abs=0.0015)
