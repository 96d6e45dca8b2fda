"""The emitter strategy `auto`: what must be, what a probe finds, and that it is always the same."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from pssflow import Scene
from tests.conftest import LLVM, ROOT
from tests.exports import Description, load
from tests.support.core import our_runs


def _auto(scene: Any, k: int = 1, **options: Any) -> tuple[str, str, float | None]:
    return Scene(scene).core.auto_strategy(k=k, parametrisation="bsdf", **options)


def _floor(bsdf: Description, **parts: Any) -> Any:
    view = mi.ScalarTransform4f().look_at(origin=[0, -3, 2], target=[0, 0, 0], up=[0, 0, 1])
    film = {"type": "hdrfilm", "width": 48, "height": 48}
    camera = {"type": "perspective", "to_world": view, "film": film}
    return load(camera=camera, floor={"type": "rectangle", "bsdf": bsdf}, **parts)


def _lamp(height: float, size: float) -> Description:
    place = mi.ScalarTransform4f().translate([0, 0, height]).rotate([1, 0, 0], 180).scale(size)
    return {"type": "rectangle", "to_world": place, "light": {"type": "area"}}


def test_a_light_that_no_ray_can_hit_needs_no_extra_ray(llvm_variant: str) -> None:
    strategy, why, ratio = _auto(
        _floor({"type": "diffuse"}, bulb={"type": "point", "position": [0, 0, 1]})
    )
    assert (strategy, ratio) == ("nee", None)
    assert "no ray can hit" in why


@pytest.mark.parametrize(
    "bsdf",
    [
        {"type": "conductor"},
        {"type": "twosided", "nested": {"type": "plastic"}},
        {"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse"}},
    ],
    ids=lambda bsdf: bsdf["type"],
)
def test_a_delta_lobe_keeps_the_extra_ray(llvm_variant: str, bsdf: Description) -> None:
    strategy, why, ratio = _auto(_floor(bsdf, lamp=_lamp(1, 0.1)))
    assert (strategy, ratio) == ("mis", None)
    assert "mirror" in why


def test_a_light_that_is_not_drawn_everywhere_keeps_the_extra_ray(llvm_variant: str) -> None:
    texels = np.random.default_rng(1).uniform(0, 1, (8, 16, 3)).astype(np.float32)
    sky = {"type": "envmap", "bitmap": mi.Bitmap(texels), "mis_compensation": True}
    never = {"type": "constant", "sampling_weight": 0.0}
    for light in (sky, never):
        strategy, why, _ = _auto(_floor({"type": "diffuse"}, sky=light, bulb={"type": "point"}))
        assert strategy == "mis"
        assert "miss light" in why


def test_the_probe_tells_a_small_far_lamp_from_a_large_near_one(llvm_variant: str) -> None:
    """Diffuse under a small lamp: the extra ray hardly ever finds it. Glossy under a wide one: it is the better."""
    small = _auto(_floor({"type": "diffuse"}, lamp=_lamp(2, 0.05)))
    assert small[0] == "nee"
    assert small[2] is not None
    assert small[2] < 0.9
    glossy = {"type": "roughconductor", "material": "none", "alpha": 0.05}
    wide = _auto(_floor(glossy, lamp=_lamp(3.0, 6.0)))
    assert wide[0] == "mis"
    assert "times as much" in wide[1] or "one sample" in wide[1]


def test_one_scene_gets_one_answer(llvm_variant: str) -> None:
    scene = _floor({"type": "diffuse"}, lamp=_lamp(2, 0.05))
    answers = {_auto(scene, threads=threads) for threads in (1, 2, 3)}
    assert len(answers) == 1


def test_what_the_probe_predicts_holds(llvm_variant: str) -> None:
    """The ratio of the two strategies' variances over 16 seeds, with the fixed costs, is the probe's within a third."""
    mi.set_variant(LLVM)
    scene = Scene(ROOT / "scenes" / "cornell-box" / "scene.xml", resolution=32)
    _, _, ratio = scene.core.auto_strategy(k=2, parametrisation="bsdf")
    assert ratio is not None
    spread = {}
    for strategy in ("mis", "nee"):
        runs = our_runs(scene.core, seeds=range(16), spp=16, k=2, emitter_strategy=strategy)
        mean = runs.mean(axis=0)
        spread[strategy] = float((runs.var(axis=0) / (mean**2 + (0.1 * mean.mean()) ** 2)).mean())
    assert ratio == pytest.approx(spread["nee"] / spread["mis"] * 3 / 4, rel=0.33)
