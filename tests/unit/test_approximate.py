"""`--approximate`: what is not supported gives way to something that is, and a note says to what."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from pssflow import Scene, render
from pssflow.export import UnsupportedError, export, inspect_scene
from pssflow.export.approximate import mean_reflectance
from tests.exports import Description, load, rgb, value

SKY: Description = {"type": "constant"}


def _bsdf_of_first(exported: Any) -> Description:
    return exported.description["bsdfs"][exported.description["shapes"][0]["bsdf"]]


def test_an_unknown_bsdf_becomes_diffuse_of_its_mean_reflectance(variant: str) -> None:
    """A `pplastic` reflects as a `plastic` of the same numbers does: .5 under a coat, a little more at its gloss."""
    scene = load(ball={"type": "sphere", "b": {"type": "pplastic", "alpha": 0.1}}, sky=SKY)
    with pytest.raises(UnsupportedError, match="--approximate"):
        export(scene)
    exported = export(scene, approximate=True)
    (note,) = exported.notes
    assert 'BSDF "pplastic"' in note
    assert "replaced by a diffuse one of its mean reflectance" in note
    bsdf = _bsdf_of_first(exported)
    assert bsdf["type"] == "diffuse"
    ours = value(exported, bsdf["reflectance"])
    # Its diffuse part without loss inside, under a Fresnel coat that reflects the rest.
    assert ours == pytest.approx([0.5] * 3, abs=0.03)


def test_a_diffuse_bsdf_has_its_own_reflectance(variant: str) -> None:
    diffuse = mi.load_dict({"type": "diffuse", "reflectance": rgb(0.2, 0.5, 0.8)})
    assert mean_reflectance(diffuse) == pytest.approx([0.2, 0.5, 0.8], rel=1e-5)


def test_everything_at_once_renders(variant: str) -> None:
    grid = (np.indices((4, 4, 4)).sum(axis=0) - 4.5).astype(np.float32)[..., None]
    T = mi.ScalarTransform4f
    view = T().look_at(origin=[0, -9, 6], target=[1, 0, 0], up=[0, 0, 1])
    film = {"type": "hdrfilm", "width": 8, "height": 8}
    scene = load(
        camera={"type": "perspective", "to_world": view, "film": film},
        window={"type": "rectangle", "b": {"type": "polarizer"}},
        bulb={"type": "point", "intensity": {"type": "blackbody", "temperature": 3000.0}},
        fog={"type": "sphere", "interior": {"type": "homogeneous"}},
        ground={"type": "cube", "b": {"type": "twosided", "b": {"type": "pplastic"}}},
        blob={"type": "sdfgrid", "grid": mi.TensorXf(grid)},
        head={"type": "sphere", "center": [4, 0, 0], "b": {"type": "hair"}},
        lamp={"type": "rectangle", "e": {"type": "area"}},
        sky=SKY,
    )
    refused = inspect_scene(scene).unsupported
    assert {thing.plugin for thing in refused} == {
        *("polarizer", "blackbody", "homogeneous", "pplastic", "sdfgrid", "hair")
    }
    ours = Scene(scene, approximate=True)
    for thing in refused:
        assert any(str(thing) in note for note in ours.notes), thing
    image = render(ours, "none", spp=2, k=1, progress=False).image
    assert np.isfinite(image).all()
    assert image.any()


def test_a_map_of_heights_gives_way_to_what_it_nests(variant: str) -> None:
    bumps = {
        "type": "bumpmap",
        "heights": {"type": "checkerboard"},
        "nested": {"type": "diffuse", "reflectance": rgb(0.1, 0.2, 0.3)},
    }
    exported = export(load(ball={"type": "sphere", "b": bumps}), approximate=True)
    bsdf = _bsdf_of_first(exported)
    assert value(exported, bsdf["reflectance"]) == pytest.approx([0.1, 0.2, 0.3])


def test_sensors_have_no_replacement(scalar_variant: str) -> None:
    scene = load(camera={"type": "batch", "left": {"type": "perspective"}})
    with pytest.raises(UnsupportedError, match='sensor "batch"') as caught:
        export(scene, approximate=True)
    assert "--approximate" not in str(caught.value)


def test_a_supported_scene_is_left_alone(scalar_variant: str) -> None:
    scene = load(ball={"type": "sphere"}, sky=SKY)
    exact, approximate = export(scene), export(scene, approximate=True)
    assert exact.description == approximate.description
    assert not approximate.notes


def test_the_plugin_takes_it(scalar_variant: str) -> None:
    scene = load(ball={"type": "sphere", "b": {"type": "hair"}}, sky=SKY)
    for approximate in (False, True):
        settings = {"type": "pssflow", "guide": "none", "k": 1, "approximate": approximate}
        integrator: Any = mi.load_dict(settings)
        if approximate:
            integrator.render(scene, spp=1)
            assert any("hair" in note for note in integrator.result.notes)
        else:
            with pytest.raises(UnsupportedError, match="hair"):
                integrator.render(scene, spp=1)
