"""What cannot be exported is refused by name, in one line that says what is supported and what to do."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from pssflow.export import SUPPORTED, UnsupportedError, export, inspect_scene
from tests.exports import Description, load


def test_all_unsupported_things_are_collected_and_the_first_named(variant: str) -> None:
    scene = load(
        window={"type": "rectangle", "b": {"type": "polarizer"}},
        bowl={"type": "sphere", "b": {"type": "polarizer", "theta": 30.0}},
        bulb={"type": "point", "intensity": {"type": "blackbody", "temperature": 3000.0}},
        fog={"type": "sphere", "interior": {"type": "homogeneous"}},
        ground={"type": "cube", "b": {"type": "twosided", "b": {"type": "pplastic"}}},
    )
    found = {(u.kind, u.plugin, u.shape) for u in inspect_scene(scene).unsupported}
    assert found == {
        ("BSDF", "polarizer", "window"),
        ("BSDF", "polarizer", "bowl"),
        ("texture", "blackbody", None),
        ("medium", "homogeneous", "fog"),
        ("BSDF", "pplastic", "ground"),
    }
    with pytest.raises(UnsupportedError) as caught:
        export(scene)
    message = str(caught.value)
    assert "\n" not in message
    assert 'shape "bowl": BSDF "polarizer"' in message
    assert "(and 1 more like it)" in message
    assert 'shape "fog": medium "homogeneous"' in message
    assert "and 1 more, listed by `pssflow info`" in message
    assert f"BSDFs: {', '.join(SUPPORTED['BSDF'])}" in message
    assert message.endswith("or render this scene with Mitsuba's `path`")


REFUSED: dict[str, tuple[Description, str]] = {
    "shape of a group": (
        {
            "group": {"type": "shapegroup", "s": {"type": "sphere", "b": {"type": "polarizer"}}},
            "copy": {"type": "instance", "g": {"type": "ref", "id": "group"}},
        },
        r'^shape "group\.s": BSDF "polarizer" \("group\.s\.bsdf"\) is not supported',
    ),
    "medium": (
        {"fog": {"type": "sphere", "interior": {"type": "homogeneous"}}},
        r'shape "fog": medium "homogeneous" is not supported\. Replace',
    ),
    "sensor": (
        {"camera": {"type": "batch", "left": {"type": "perspective"}}},
        r'sensor "batch" \("camera"\) is not supported \(supported sensors: orthographic',
    ),
    "signed distances": (
        {"blob": {"type": "sdfgrid", "grid": "grid"}},
        r'shape "blob": plugin "sdfgrid" is not supported \(supported shapes: blender, cube',
    ),
    "hair": (
        {"head": {"type": "sphere", "b": {"type": "hair"}}},
        r'shape "head": BSDF "hair" \("head.bsdf"\) is not supported \(supported BSDFs: blendbsdf',
    ),
    "distant sensor": (
        {"camera": {"type": "distant", "film": {"type": "hdrfilm", "width": 1, "height": 1}}},
        r'sensor "distant" \("camera"\) is not supported \(supported sensors: orthographic',
    ),
    "volume": (
        {
            "ball": {
                "type": "sphere",
                "b": {
                    "type": "diffuse",
                    "reflectance": {"type": "volume", "volume": {"type": "constvolume"}},
                },
            }
        },
        r'shape "ball": texture "volume" \("ball.bsdf.reflectance"\) is not supported',
    ),
    "spectrum": (
        {"bulb": {"type": "point", "intensity": {"type": "blackbody", "temperature": 3000.0}}},
        r'texture "blackbody" \("bulb.intensity"\) is not supported \(supported textures: bitmap',
    ),
    "scaled light": (
        {"lamp": {"type": "directional", "to_world": "scaled"}},
        r'^emitter "directional" \("lamp"\) has a `to_world` that scales',
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refusals_name_the_offender(scalar_variant: str, case: str) -> None:
    parts, message = REFUSED[case]
    if case == "scaled light":  # transforms exist only in a variant
        parts = {"lamp": parts["lamp"] | {"to_world": mi.ScalarTransform4f().scale(2)}}
    if case == "signed distances":
        grid = (np.indices((4, 4, 4)).sum(axis=0) - 4.5).astype(np.float32)[..., None]
        parts = {"blob": parts["blob"] | {"grid": mi.TensorXf(grid)}}
    with pytest.raises(UnsupportedError, match=message):
        export(load(**parts))


def test_a_scene_without_a_sensor_says_so(variant: str) -> None:
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere"}})
    with pytest.raises(ValueError, match="`sensor` = 0: the scene has none"):
        export(scene)


def test_what_is_no_scene_is_a_type_error(variant: str) -> None:
    for thing in ("scene.xml", mi.load_dict({"type": "sphere"})):
        with pytest.raises(TypeError, match=r"expected a `mi\.Scene`"):
            export(thing)


@pytest.mark.parametrize(
    "name", ["scalar_spectral", "scalar_spectral_polarized", "llvm_ad_mono", "llvm_ad_spectral"]
)
def test_variants_of_other_colours_are_refused(name: str) -> None:
    """Also where the scene may be approximated: nothing stands in for a spectrum."""
    mi.set_variant(name)
    scene = load(ball={"type": "sphere"})
    for approximate in (False, True):
        with pytest.raises(UnsupportedError, match=rf'"{name}" is not supported .*scalar_rgb'):
            export(scene, approximate=approximate)


def test_another_active_variant_is_refused() -> None:
    mi.set_variant("scalar_rgb")
    scene = load(ball={"type": "sphere"})
    mi.set_variant("llvm_ad_rgb")
    with pytest.raises(
        UnsupportedError, match=r'loaded in variant "scalar_rgb", but "llvm_ad_rgb"'
    ):
        export(scene)
