"""The export: each plugin with its values, edits, stable order, and refusals by name.

Textures and shapes have files of their own.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import pssflow.export
from pssflow.export import (
    UnsupportedError,
    export,
    inspect_scene,
    stable_emitter_order,
    stable_shape_order,
)
from pssflow.export.walk import printed
from tests.exports import (
    Description,
    bitmap,
    bsdf_of,
    check_references,
    load,
    named,
    rgb,
    texture,
    value,
)
from tests.scenes import SCENES

# Descriptions as a whole


@pytest.mark.parametrize("name", SCENES)
def test_every_scene_of_the_tests_exports(variant: str, name: str) -> None:
    exported = export(mi.load_dict(SCENES[name]()))
    description = json.loads(exported.json())
    assert description["schema"] == 1
    assert description["variant"] == variant
    assert exported.timings["export"] > 0
    check_references(exported)


def test_export_leaves_the_scene_as_it_was(variant: str) -> None:
    scene = mi.load_dict(SCENES["glossy_room"]())
    before = {
        k: np.array(dr.detach(getattr(v, "matrix", v))) for k, v in mi.traverse(scene).items()
    }
    export(scene)
    params = mi.traverse(scene)
    for key, was in before.items():
        now = np.array(dr.detach(getattr(params[key], "matrix", params[key])))
        np.testing.assert_array_equal(now, was, err_msg=key)


def test_the_same_scene_exports_the_same_twice(variant: str) -> None:
    scene = mi.load_dict(SCENES["glossy_room"]())
    first, second = export(scene), export(scene)
    assert first.json() == second.json()
    for a, b in zip(first.arrays, second.arrays, strict=True):
        np.testing.assert_array_equal(a, b)


# BSDFs


def test_diffuse(variant: str) -> None:
    exported, bsdf = bsdf_of({"type": "diffuse", "reflectance": rgb(0.1, 0.2, 0.3)})
    assert (bsdf["type"], bsdf["id"]) == ("diffuse", "ball.bsdf")
    assert value(exported, bsdf["reflectance"]) == pytest.approx([0.1, 0.2, 0.3])


def test_a_shape_without_a_bsdf_gets_mitsubas_default(variant: str) -> None:
    exported = export(load(ball={"type": "sphere"}))
    (bsdf,) = exported.description["bsdfs"]
    assert value(exported, bsdf["reflectance"]) == [0.5, 0.5, 0.5]


def test_twosided_shares_one_side_or_has_two(variant: str) -> None:
    _, bsdf = bsdf_of({"type": "twosided", "bsdf": {"type": "diffuse"}})
    assert bsdf["type"] == "twosided"
    assert bsdf["front"] == bsdf["back"]
    exported, bsdf = bsdf_of(
        {
            "type": "twosided",
            "front": {"type": "diffuse", "reflectance": rgb(0.1, 0.1, 0.1)},
            "back": {"type": "diffuse", "reflectance": rgb(0.9, 0.9, 0.9)},
        }
    )
    sides = [exported.description["bsdfs"][bsdf[side]] for side in ("front", "back")]
    values = [value(exported, side["reflectance"])[0] for side in sides]
    assert values == pytest.approx([0.1, 0.9])


def test_blendbsdf_keeps_its_order(variant: str) -> None:
    exported, bsdf = bsdf_of(
        {
            "type": "blendbsdf",
            "weight": 0.25,
            "a": {"type": "diffuse", "reflectance": rgb(0.1, 0.2, 0.3)},
            "b": {"type": "roughplastic"},
        }
    )
    types = [exported.description["bsdfs"][bsdf[name]]["type"] for name in ("first", "second")]
    assert types == ["diffuse", "roughplastic"]
    assert value(exported, bsdf["weight"]) == [0.25] * 3


@pytest.mark.parametrize("distribution", ["beckmann", "ggx"])
@pytest.mark.parametrize("flag", [False, True])
def test_roughplastic(variant: str, distribution: str, flag: bool) -> None:
    exported, bsdf = bsdf_of(
        {
            "type": "roughplastic",
            "distribution": distribution,
            "alpha": 0.3,
            "int_ior": 1.6,
            "ext_ior": 1.25,
            "nonlinear": flag,
            "sample_visible": not flag,
            "diffuse_reflectance": rgb(0.1, 0.2, 0.6),
            "specular_reflectance": rgb(0.9, 0.9, 0.6),
        }
    )
    assert bsdf["distribution"] == distribution
    assert (bsdf["nonlinear"], bsdf["sample_visible"]) == (flag, not flag)
    assert bsdf["alpha"] == pytest.approx(0.3)
    assert bsdf["int_ior_over_ext_ior"] == pytest.approx(1.6 / 1.25)
    assert value(exported, bsdf["specular_reflectance"]) == pytest.approx([0.9, 0.9, 0.6])
    # Means of the components: .8 specular, .3 diffuse.
    assert bsdf["specular_sampling_weight"] == pytest.approx(0.8 / 1.1)


def test_roughplastic_reads_its_switches_past_nested_textures(variant: str) -> None:
    """Nested bitmaps print fields of their own, in brackets and before `nonlinear`."""
    exported, bsdf = bsdf_of(
        {
            "type": "roughplastic",
            "nonlinear": True,
            "diffuse_reflectance": bitmap(np.full((2, 2, 3), 0.5, np.float32)),
        }
    )
    assert bsdf["nonlinear"] is True
    assert bsdf["specular_reflectance"] is None
    assert bsdf["specular_sampling_weight"] == pytest.approx(1 / 1.5, rel=1e-5)
    assert texture(exported, bsdf["diffuse_reflectance"])["type"] == "bitmap"


def test_roughconductor(variant: str) -> None:
    exported, bsdf = bsdf_of(
        {
            "type": "roughconductor",
            "distribution": "ggx",
            "sample_visible": False,
            "alpha_u": 0.1,
            "alpha_v": 0.4,
            "eta": rgb(1.5, 0.9, 0.5),
            "k": rgb(9, 6, 4),
            "specular_reflectance": 0.8,
        }
    )
    assert (bsdf["distribution"], bsdf["sample_visible"]) == ("ggx", False)
    values = {k: value(exported, bsdf[k]) for k in ("alpha_u", "alpha_v", "eta", "k")}
    assert values["alpha_u"] == pytest.approx([0.1] * 3)
    assert values["alpha_v"] == pytest.approx([0.4] * 3)
    assert values["eta"] == pytest.approx([1.5, 0.9, 0.5])
    assert values["k"] == [9, 6, 4]
    assert value(exported, bsdf["specular_reflectance"]) == pytest.approx([0.8] * 3)


def test_roughconductor_by_material_and_one_alpha(variant: str) -> None:
    exported, bsdf = bsdf_of({"type": "roughconductor", "material": "Au", "alpha": 0.2})
    assert bsdf["alpha_u"] == bsdf["alpha_v"]
    assert value(exported, bsdf["eta"]) == pytest.approx([0.143036, 0.375307, 1.44205], rel=1e-4)
    assert bsdf["specular_reflectance"] is None


def test_a_shared_bsdf_is_exported_once(variant: str) -> None:
    paint = mi.load_dict({"type": "diffuse", "id": "paint"})
    shapes = {f"s{i}": {"type": "sphere", "center": [3 * i, 0, 0], "b": paint} for i in range(3)}
    exported = export(load(**shapes))
    assert len(exported.description["bsdfs"]) == 1
    assert {shape["bsdf"] for shape in exported.description["shapes"]} == {0}


# Emitters, sensor, film


def test_emitters_and_their_weights(variant: str) -> None:
    scene = load(
        lamp={
            "type": "sphere",
            "light": {"type": "area", "radiance": rgb(1, 2, 3), "sampling_weight": 2.0},
        },
        panel={
            "type": "rectangle",
            "light": {
                "type": "area",
                "radiance": bitmap(np.random.default_rng(7).random((4, 4, 3), dtype=np.float32)),
            },
        },
        sky={"type": "constant", "radiance": rgb(0.5, 0.6, 0.7)},
        bulb={"type": "point", "position": [1, 2, 3], "intensity": 5.0},
    )
    exported = export(scene)
    ids = [emitter["id"] for emitter in exported.description["emitters"]]
    assert ids == ["lamp.emitter", "panel.emitter", "sky", "bulb"]
    lamp, panel, sky, bulb = exported.description["emitters"]
    assert lamp["sampling_weight"] == 2
    assert value(exported, lamp["radiance"]) == [1, 2, 3]
    assert texture(exported, panel["radiance"])["type"] == "bitmap"
    assert exported.description["shapes"][panel["shape"]]["id"] == "panel"
    assert sky["radiance"] == pytest.approx([0.5, 0.6, 0.7])
    assert (bulb["position"], bulb["intensity"]) == ([1, 2, 3], [5, 5, 5])

    theirs = [scene.emitters()[i].class_name() for i in exported.emitter_order]
    assert theirs == ["AreaLight", "AreaLight", "ConstantBackgroundEmitter", "PointLight"]
    assert exported.emitter_order == stable_emitter_order(scene)
    shapes = [scene.shapes()[i].id() for i in stable_shape_order(scene)]
    assert shapes == [shape["id"] for shape in exported.description["shapes"]]


def test_textured_radiance_needs_texture_coordinates(variant: str, tmp_path: Path) -> None:
    path = tmp_path / "bare.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    light = {"type": "area", "radiance": bitmap(np.eye(4, dtype=np.float32)[..., None])}
    scene = load(bare={"type": "obj", "filename": str(path), "light": light})
    with pytest.raises(
        UnsupportedError, match=r'shape "bare": emitter "area" .* without texture coord'
    ):
        export(scene)


def test_perspective_and_film(variant: str) -> None:
    to_world = mi.ScalarTransform4f().look_at(origin=[1, 2, 3], target=[4, 4, 4], up=[0, 0, 1])
    scene = load(
        camera={
            "type": "perspective",
            "fov": 40.0,
            "fov_axis": "x",
            "near_clip": 0.5,
            "far_clip": 50.0,
            "principal_point_offset_x": 0.1,
            "principal_point_offset_y": -0.2,
            "to_world": to_world,
            "film": {
                "type": "hdrfilm",
                "width": 40,
                "height": 30,
                "crop_offset_x": 2,
                "crop_offset_y": 3,
                "crop_width": 10,
                "crop_height": 5,
            },
        }
    )
    exported = export(scene)
    sensor, film = exported.description["sensor"], exported.description["film"]
    assert sensor["type"] == "perspective"
    assert sensor["x_fov"] == pytest.approx(40)
    assert (sensor["near_clip"], sensor["far_clip"]) == (0.5, 50)
    assert sensor["principal_point_offset"] == pytest.approx([0.1, -0.2])
    matrix = np.array(to_world.matrix, np.float32).astype(float)
    np.testing.assert_allclose(np.reshape(sensor["to_world"], (4, 4)), matrix, atol=1e-6)
    assert (film["size"], film["crop_offset"], film["crop_size"]) == ([40, 30], [2, 3], [10, 5])
    assert not exported.notes


@pytest.mark.parametrize("name", ["box", "tent", "gaussian", "mitchell", "catmullrom", "lanczos"])
def test_filters_are_tabulated(variant: str, name: str) -> None:
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": name}}
    scene = load(camera={"type": "perspective", "film": film | {"sample_border": True}})
    exported = export(scene)
    table = exported.description["film"]["rfilter"]
    assert table["type"] == name
    rfilter = scene.sensors()[0].film().rfilter()
    for i in (0, 100, 555, 1000):
        expected = np.array(rfilter.eval(i / 1024 * table["radius"])).item()
        assert table["table"][i] == pytest.approx(expected, abs=1e-6)
    assert len(table["table"]) == 1025
    assert ["sample_border" in note for note in exported.notes] == [True]


def test_a_sensor_is_chosen_by_index_or_object(variant: str) -> None:
    def camera(width: int) -> Description:
        return {"type": "perspective", "film": {"type": "hdrfilm", "width": width, "height": 8}}

    scene = load(a=camera(16), b=camera(24), camera=camera(32))
    widths = [int(sensor.film().size()[0]) for sensor in scene.sensors()]
    for i, width in enumerate(widths):
        assert export(scene, sensor=i).description["film"]["size"][0] == width
    own = mi.load_dict(camera(40))
    assert export(scene, sensor=own).description["film"]["size"][0] == 40
    with pytest.raises(ValueError, match=r"`sensor` = 3: expected 0 ≤ sensor < 3"):
        export(scene, sensor=3)


# Edits


def edit(scene: Any, key: str, change: Callable[[Any], Any]) -> None:
    params = mi.traverse(scene)
    params[key] = change(params[key])
    params.update()


def test_an_edited_scene_exports_its_new_state(variant: str) -> None:
    pixels = np.random.default_rng(8).random((4, 4, 3), dtype=np.float32)
    scene = load(
        block={"type": "cube", "b": {"type": "diffuse", "reflectance": rgb(0.1, 0.2, 0.3)}},
        wall={"type": "rectangle", "b": {"type": "diffuse", "reflectance": bitmap(pixels)}},
        ball={"type": "sphere", "e": {"type": "area", "radiance": 1.0}},
        bulb={"type": "point", "position": [0, 0, 0]},
    )
    export(scene)
    edit(scene, "block.bsdf.reflectance.value", lambda _: mi.Color3f(0.4, 0.5, 0.6))
    edit(scene, "block.vertex_positions", lambda p: p + 1)
    edit(scene, "wall.bsdf.reflectance.data", lambda data: data * 0.5)
    edit(scene, "wall.to_world", lambda _: mi.Transform4f().translate([0, 0, 7]))
    edit(scene, "ball.emitter.radiance.value", lambda _: mi.Float(3))
    edit(scene, "ball.to_world", lambda _: mi.Transform4f().scale(4))
    edit(scene, "bulb.position", lambda _: mi.Point3f(1, 2, 3))
    edit(scene, "camera.to_world", lambda _: mi.Transform4f().translate([5, 0, 0]))
    edit(scene, "camera.x_fov", lambda _: mi.Float(60))
    edit(scene, "camera.film.size", lambda _: mi.ScalarVector2u(12, 10))

    exported = export(scene)
    block, wall, ball = (named(exported, "shapes", name) for name in ("block", "wall", "ball"))
    reflectance = exported.description["bsdfs"][block["bsdf"]]["reflectance"]
    assert value(exported, reflectance) == pytest.approx([0.4, 0.5, 0.6])
    assert exported.arrays[block["positions"]].max() == 2
    reflectance = texture(exported, exported.description["bsdfs"][wall["bsdf"]]["reflectance"])
    np.testing.assert_allclose(exported.arrays[reflectance["data"]], pixels / 2, rtol=1e-6)
    assert reflectance["mean"] == pytest.approx(
        (pixels.mean((0, 1)) / 2) @ [0.212671, 0.715160, 0.072169], rel=1e-5
    )
    assert wall["to_world"][11] == 7
    assert ball["radius"] == 4
    area, point = exported.description["emitters"]
    assert value(exported, area["radiance"]) == [3, 3, 3]
    assert point["position"] == [1, 2, 3]
    assert exported.description["sensor"]["to_world"][3] == 5
    assert exported.description["sensor"]["x_fov"] == 60
    assert exported.description["film"]["size"] == [12, 10]


def test_a_scene_with_gradients_exports(llvm_variant: str) -> None:
    scene = load(block={"type": "cube"})
    params = mi.traverse(scene)
    for key in ("block.vertex_positions", "block.bsdf.reflectance.value"):
        dr.enable_grad(params[key])
    params.update()
    assert export(scene).arrays[0].shape == (24, 3)


# Order and names


UNNAMED = """<scene version="3.0.0"><sensor type="perspective"/>
    <bsdf type="diffuse" id="red"><rgb name="reflectance" value="0.5 0 0"/></bsdf>
    <bsdf type="diffuse" id="green"><rgb name="reflectance" value="0 0.5 0"/></bsdf>
    <bsdf type="twosided" id="blue"><bsdf type="diffuse"><rgb name="reflectance" value="0 0 .5"/></bsdf></bsdf>
    {shapes}
    <emitter type="point"><point name="position" x="1" y="1" z="5"/></emitter>
    <emitter type="point"><point name="position" x="2" y="1" z="5"/></emitter>
    <emitter type="constant"/></scene>"""

DIGEST = """
import hashlib, sys
import mitsuba as mi
mi.set_variant("scalar_rgb")
import pssflow.export
exported = pssflow.export.export(mi.load_string(sys.stdin.read()))
digest = hashlib.sha256(exported.json().encode())
for array in exported.arrays:
    digest.update(array)
print(digest.hexdigest())
"""


def unnamed_scene() -> str:
    """Meshes that Mitsuba merges, shapes without ids, and lights without ids: their order hangs on addresses."""
    shape = (
        '<shape type="{kind}"><transform name="to_world"><translate x="{x}"/></transform>'
        '<ref id="{bsdf}"/>{light}</shape>'
    )
    light = '<emitter type="area"><rgb name="radiance" value="1 2 3"/></emitter>'
    shapes = [
        shape.format(kind=kind, x=3 * i, bsdf=bsdf, light=light if i % 3 == 0 else "")
        for i in range(9)
        for kind, bsdf in (("cube", ("red", "green", "blue")[i % 3]), ("sphere", "red"))
    ]
    return UNNAMED.format(shapes="\n".join(shapes))


def test_the_order_is_the_same_in_each_process() -> None:
    root = Path(pssflow.export.__file__).parents[2]
    path = os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")])
    digests = set()
    for _ in range(3):
        result = subprocess.run(
            [sys.executable, "-c", DIGEST],
            input=unnamed_scene(),
            env=os.environ | {"PYTHONPATH": path},
            capture_output=True,
            text=True,
            check=True,
        )
        digests.add(result.stdout)
    assert len(digests) == 1


def test_shapes_without_ids_get_unique_ones(variant: str) -> None:
    exported = export(mi.load_string(unnamed_scene()))
    ids = [shape["id"] for shape in exported.description["shapes"]]
    assert len(set(ids)) == len(ids)
    assert any(name.endswith("(merged)") for name in ids)
    assert len({emitter["id"] for emitter in exported.description["emitters"]}) == 9
    assert not any("object_" in json.dumps(entry) for entry in exported.description["bsdfs"])
    check_references(exported)


def test_inspection_counts(variant: str) -> None:
    inspection = inspect_scene(mi.load_dict(SCENES["glossy_room"]()))
    assert inspection.unsupported == []
    assert inspection.counts["shape"] == {"cube": 1, "rectangle": 4, "sphere": 1}
    assert inspection.counts["emitter"] == {"area": 1, "point": 1}
    assert inspection.counts["texture"]["bitmap"] == 1
    assert inspection.triangles == 12 + 2 * 4
    assert inspection.array_bytes > 0


# The printed form of objects


class Printed:
    """Prints as it is told."""

    def __init__(self, text: str) -> None:
        self.text = text

    def __str__(self) -> str:
        return self.text


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("A[value=1.0]", {}),
        ("A[\n  a = 1,\n  b = 0\n]", {"a": "1", "b": "0"}),
        ("A[a = 1, b = B[\n a = 2,\n c = 3\n], d = [1, 2]]", {"a": "1", "b": None, "d": "[1, 2]"}),
        ('A[\n  name = "x[, a = 5\n",\n  a = 1\n]', {"name": None, "a": "1"}),
        ("A[\n  b[0] = B[\n    a = 2\n  ],\n  a = 1\n]", {"b[0]": None, "a": "1"}),
        ("A[\n  base_seed = 0\n  sample_count = 16\n]", {"base_seed": "0", "sample_count": "16"}),
        ("A[]", {}),
        ("", {}),
    ],
)
def test_printed_fields_are_those_of_the_object_itself(
    text: str, expected: dict[str, str | None]
) -> None:
    pairs = printed(Printed(text))
    assert pairs.keys() == expected.keys()
    for name, wanted in expected.items():
        assert wanted is None or pairs[name] == wanted


# Third-party scenes


@pytest.mark.parametrize("name", ["cornell-box", "veach-mis", "sponza-lajolla"])
def test_third_party_scene_exports(variant: str, shared_scenes: Path, name: str) -> None:
    scene = mi.load_file(str(shared_scenes / name / "scene.xml"))
    exported = export(scene)
    check_references(exported)
    assert len(exported.description["emitters"]) == len(scene.emitters())


def test_cornell_box_has_known_contents(variant: str, shared_scenes: Path) -> None:
    inspection = inspect_scene(mi.load_file(str(shared_scenes / "cornell-box" / "scene.xml")))
    assert inspection.triangles == 36
    assert inspection.counts["emitter"] == {"area": 1}
    assert inspection.unsupported == []
