"""Exported shapes are what Mitsuba's rays meet and what it samples."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from numpy.typing import NDArray

from pssflow import _core
from pssflow.export import UnsupportedError, export
from pssflow.scene import embree_dirs
from tests.exports import Description, load, named


def trace(scene: Any, origin: list[float], direction: list[float]) -> Any:
    """One ray's hit."""
    return scene.ray_intersect(mi.Ray3f(mi.Point3f(*origin), mi.Vector3f(*direction)))


def vector(value: Any) -> NDArray[np.float64]:
    return np.array(value, np.float64).ravel()


def write_obj(folder: Path) -> Path:
    """Two triangles with normals and texture coordinates."""
    path = folder / "quad.obj"
    path.write_text(
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
        "vn 0 0.6 0.8\nf 1/1/1 2/2/1 3/3/1\nf 1/1/1 3/3/1 4/4/1\n"
    )
    return path


@pytest.mark.parametrize("options", [{}, {"flip_normals": True}, {"face_normals": True}])
@pytest.mark.parametrize("mirrored", [False, True])
def test_mesh_is_what_rays_meet(
    variant: str, tmp_path: Path, options: Description, mirrored: bool
) -> None:
    T = mi.ScalarTransform4f
    mesh = {
        "type": "obj",
        "filename": str(write_obj(tmp_path)),
        "to_world": T().translate([1, 2, 3]).scale([-2 if mirrored else 2, 1, 1]),
    } | options
    scene = load(quad=mesh)
    exported = export(scene)
    shape = named(exported, "shapes", "quad")
    assert shape["type"] == "mesh"
    assert shape["flip_normals"] == options.get("flip_normals", False)
    assert (shape["normals"] is None) == options.get("face_normals", False)

    positions, faces = exported.arrays[shape["positions"]], exported.arrays[shape["faces"]]
    texcoords = exported.arrays[shape["texcoords"]]
    target = np.array([1 + (-1.2 if mirrored else 1.2), 2.3, 3])
    hit = trace(scene, [float(target[0]), float(target[1]), 9], [0, 0, -1])
    triangle = faces[int(np.array(hit.prim_index).item())]
    corners = positions[triangle].astype(float)
    weights = np.linalg.lstsq(np.vstack([corners.T, np.ones(3)]), [*target, 1], rcond=None)[0]
    np.testing.assert_allclose(vector(hit.uv), weights @ texcoords[triangle], atol=1e-5)

    sign = -1 if shape["flip_normals"] else 1
    geometric = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    geometric *= sign / np.linalg.norm(geometric)
    shading = geometric
    if shape["normals"] is not None:
        normals = exported.arrays[shape["normals"]]
        shading = weights @ normals[triangle] * sign
        shading /= np.linalg.norm(shading)
    np.testing.assert_allclose(vector(hit.n), geometric, atol=1e-6)
    np.testing.assert_allclose(vector(hit.sh_frame.n), shading, atol=1e-6)


def test_cube_and_ply_and_their_merger_are_meshes(variant: str, tmp_path: Path) -> None:
    """Mitsuba merges meshes of one BSDF into one without an id."""
    mi.load_dict({"type": "cube"}).write_ply(str(tmp_path / "cube.ply"))
    document = f"""<scene version="3.0.0"><sensor type="perspective"/><bsdf type="diffuse" id="paint"/>
        <shape type="ply" id="a"><string name="filename" value="{tmp_path / "cube.ply"}"/><ref id="paint"/></shape>
        <shape type="cube" id="b"><transform name="to_world"><translate x="3"/></transform>
        <ref id="paint"/></shape></scene>"""
    exported = export(mi.load_string(document))
    (shape,) = exported.description["shapes"]
    assert (shape["type"], shape["id"]) == ("mesh", "mesh_0 (merged)")
    assert exported.description["bsdfs"][shape["bsdf"]]["id"] == "paint"
    assert exported.arrays[shape["faces"]].shape == (24, 3)
    assert exported.arrays[shape["positions"]].max() == 4


@pytest.mark.parametrize("flip", [False, True])
def test_rectangle_is_placed_and_sampled_by_its_transform(variant: str, flip: bool) -> None:
    T = mi.ScalarTransform4f
    to_world = T().translate([1, 2, 3]).rotate([0.48, 0.6, 0.64], 50).scale([2, -0.5, 1])
    scene = load(quad={"type": "rectangle", "to_world": to_world, "flip_normals": flip})
    shape = named(export(scene), "shapes", "quad")
    assert (shape["type"], shape["flip_normals"]) == ("rectangle", flip)
    matrix = np.reshape(shape["to_world"], (4, 4))

    sample = scene.shapes()[0].sample_position(0, mi.Point2f(0.2, 0.7))
    np.testing.assert_allclose(vector(sample.p), (matrix @ [-0.6, 0.4, 0, 1])[:3], atol=1e-5)
    normal = np.linalg.inv(matrix[:3, :3]).T[:, 2] * (-1 if flip else 1)
    np.testing.assert_allclose(vector(sample.n), normal / np.linalg.norm(normal), atol=1e-5)
    np.testing.assert_allclose(vector(sample.uv), [0.2, 0.7], atol=1e-6)


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("scale", [2.0, -2.0])
def test_sphere(variant: str, flip: bool, scale: float) -> None:
    to_world = mi.ScalarTransform4f().translate([1, 2, 3]).scale(scale)
    ball = {"type": "sphere", "center": [0.5, 0, 0], "radius": 0.25, "to_world": to_world}
    scene = load(ball=ball | {"flip_normals": flip})
    shape = named(export(scene), "shapes", "ball")
    assert shape["center"] == [1 + 0.5 * scale, 2, 3]
    assert shape["radius"] == 0.5
    hit = trace(scene, [1 + 0.5 * scale, 2, 9], [0, 0, -1])
    np.testing.assert_allclose(vector(hit.n), [0, 0, -1 if shape["flip_normals"] else 1], atol=1e-6)


@pytest.mark.parametrize("flip", [False, True])
def test_disk_holds_its_flip_in_its_transform(variant: str, flip: bool) -> None:
    scene = load(plate={"type": "disk", "flip_normals": flip})
    shape = named(export(scene), "shapes", "plate")
    assert (shape["type"], shape["flip_normals"]) == ("disk", False)
    matrix = np.reshape(shape["to_world"], (4, 4))
    hit = trace(scene, [0.2, 0.1, 9], [0, 0, -1])
    np.testing.assert_allclose(vector(hit.n), matrix[:3, 2], atol=1e-6)


@pytest.mark.parametrize("flip", [False, True])
def test_cylinder(variant: str, flip: bool) -> None:
    tube = {"type": "cylinder", "p0": [1, 0, 0], "p1": [1, 0, 4], "radius": 0.5}
    scene = load(tube=tube | {"flip_normals": flip})
    shape = named(export(scene), "shapes", "tube")
    matrix = np.reshape(shape["to_world"], (4, 4))
    np.testing.assert_allclose((matrix @ [0, 0, 1, 1])[:3], [1, 0, 4], atol=1e-6)
    assert np.linalg.norm(matrix[:3, 0]) == pytest.approx(0.5)
    hit = trace(scene, [9, 0, 2], [-1, 0, 0])
    np.testing.assert_allclose(vector(hit.n), [-1 if flip else 1, 0, 0], atol=1e-6)
    assert shape["flip_normals"] == flip


def test_a_rotation_about_an_axis_of_another_length_is_refused(variant: str) -> None:
    """Mitsuba 3.9 neither normalises the axis nor inverts the result: positions and normals contradict each other."""
    plate = {"type": "disk", "to_world": mi.ScalarTransform4f().rotate([1, 0.5, 0], 25)}
    with pytest.raises(UnsupportedError, match="rotate about axes of length 1"):
        export(load(plate=plate))


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_transforms_of_any_size_pass(variant: str, scale: float) -> None:
    T = mi.ScalarTransform4f
    to_world = (
        T().translate([100, 200, -300]).rotate([0.6, 0.8, 0], 77).scale([scale, 1, 2 * scale])
    )
    export(load(plate={"type": "disk", "to_world": to_world}))


def test_core_names_the_type_of_a_wrong_array(scalar_variant: str) -> None:
    exported = export(load(floor={"type": "cube"}))
    arrays = [array.astype(np.float64) for array in exported.arrays]
    with pytest.raises(ValueError, match=r"arrays\[0\] is an array of float64, but must be a"):
        _core.Scene(exported.json(), arrays, embree_dirs())


def test_shape_without_id_whose_transform_is_not_finite_is_refused(scalar_variant: str) -> None:
    """By name: shapes without an id are sorted by what they are, and sorting must not stumble over it."""
    xml = """<scene version="3.0.0"><sensor type="perspective"/><shape type="disk">
        <transform name="to_world"><scale x="inf"/></transform></shape></scene>"""
    with pytest.raises(UnsupportedError, match="`to_world` that is not finite"):
        export(mi.load_string(xml))
