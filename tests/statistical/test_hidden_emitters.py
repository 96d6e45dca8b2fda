"""`hide_emitters`: the camera looks through the surfaces of lights, as in Mitsuba's `path`; no other ray does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from pssflow import Scene, render
from tests.conftest import LLVM
from tests.support.core import core_scene, our_runs
from tests.support.runs import mitsuba_runs, truth_runs
from tests.support.welch import ALPHA, welch

pytestmark = [pytest.mark.stat, pytest.mark.timeout(600)]


def _scene(*, hide: bool, **parts: Any) -> mi.Scene:
    """Two lamps, one before the other, between the camera and a box before a wall, under an even sky."""
    T = mi.ScalarTransform4f
    turned = T().rotate([1, 0, 0], 180)
    film = {"type": "hdrfilm", "width": 32, "height": 32, "pixel_format": "rgb"}
    lamp = {"type": "area", "radiance": {"type": "rgb", "value": [5.0, 4.0, 3.0]}}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "hide_emitters": hide},
            "camera": {
                "type": "perspective",
                "fov": 40,
                "to_world": T().look_at(origin=[0, 0, 6], target=[0, 0, 0], up=[0, 1, 0]),
                "film": film | {"rfilter": {"type": "box"}},
            },
            "wall": {"type": "rectangle", "to_world": T().scale(2), "bsdf": {"type": "diffuse"}},
            "box": {
                "type": "cube",
                "to_world": T().translate([0.4, 0, 0.5]).rotate([0, 1, 1], 30).scale(0.3),
                "bsdf": {
                    "type": "diffuse",
                    "reflectance": {"type": "rgb", "value": [0.7, 0.4, 0.2]},
                },
            },
            "near": {
                "type": "rectangle",
                "to_world": T().translate([0, 0, 2]) @ turned @ T().scale(0.5),
                "light": lamp,
            },
            "far": {
                "type": "rectangle",
                "to_world": T().translate([0.2, 0.1, 1.6]) @ turned @ T().scale(0.4),
                "light": lamp,
            },
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.3, 0.3, 0.4]}},
        }
        | parts
    )


@pytest.mark.parametrize("k", [1, 2])
def test_hidden_lamps_give_mitsubas_mean(k: int, artifacts: Path) -> None:
    """H0: what lies behind two hidden lamps has Mitsuba's k-bounce light. 16 seeds × 64 spp."""
    mi.set_variant(LLVM)
    scene = _scene(hide=True)
    truth = truth_runs(scene, k=k, seeds=range(16), spp=64)
    ours = our_runs(core_scene(scene)[0], seeds=range(1000, 1016), spp=64, k=k)
    r = welch(truth, ours)
    assert r.p > ALPHA / 2, r.explain(artifacts)
    assert r.has_power, r.explain(artifacts)
    # Power: the same scene with its lamps in sight is another image.
    seen = our_runs(core_scene(_scene(hide=False))[0], seeds=range(1000, 1016), spp=64, k=k)
    assert welch(truth, seen).p < ALPHA / 2


def test_the_argument_wins_over_the_scene(variant: str) -> None:
    """Behind the lamps the image is black where they are seen, and the wall where they are hidden."""
    middle = np.s_[12:20, 12:20]
    for hide in (False, True):
        scene = _scene(hide=hide)
        for given in (None, False, True):
            ours = Scene(scene, hide_emitters=given)
            assert ours.hide_emitters == (hide if given is None else given)
            image = render(ours, "none", spp=1, k=1, progress=False).image
            assert image[middle].any() == ours.hide_emitters
    with pytest.raises(ValueError, match="`hide_emitters` was given beside a `Scene`"):
        render(Scene(scene), "none", spp=1, hide_emitters=True)


def test_the_plugin_takes_it_as_mitsubas_integrators_do(llvm_variant: str) -> None:
    scene = _scene(hide=True)
    images = [
        np.array(
            mi.render(
                scene,
                integrator=mi.load_dict(
                    {"type": "pssflow", "guide": "none", "k": 1, "hide_emitters": hide}
                ),
                spp=1,
            )
        )
        for hide in (False, True)
    ]
    assert not images[0][12:20, 12:20].any()
    assert images[1][12:20, 12:20].any()


def test_all_light_hides_them_too(artifacts: Path) -> None:
    """H0: up to a depth, too, lamps and sky are as in `path` with the same option. 16 seeds × 32 spp."""
    mi.set_variant(LLVM)
    scene = _scene(hide=True)
    truth = mitsuba_runs(scene, max_depth=3, seeds=range(16), spp=64)
    ours = Scene(scene)
    runs = [
        render(ours, "none", 32, seed=seed, max_depth=3, progress=False).image
        for seed in range(1000, 1016)
    ]
    r = welch(truth, np.stack(runs))
    assert r.p > ALPHA / 2, r.explain(artifacts)
    assert r.has_power, r.explain(artifacts)
    assert [
        length["k"]
        for length in render(ours, "none", 1, max_depth=3, progress=False).stats["lengths"]
    ] == [1, 2]
