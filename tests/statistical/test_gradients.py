"""Gradients of `pssflow`: are they those of Mitsuba's `prb`, the difference of two depths, and finite differences?

One number of the loss (the image's mean) has a gradient for each component of each parameter; each is estimated with
several seeds on both sides and compared by Welch's t-test, p-values corrected by Holm's method.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.conftest import LLVM
from tests.support.named import load_named
from tests.support.welch import ALPHA, Moments, holm, p_value

pytestmark = [pytest.mark.stat, pytest.mark.timeout(600)]

RUNS = 8
PARAMETERS = {
    "furnace_sphere": (
        *(f"{shape}.bsdf.brdf_0.reflectance.value" for shape in ("ball", "plate", "tube", "room")),
        "lamp.emitter.radiance.value",
    ),
    "open_sky": (
        *("sky.radiance.value", "lantern.emitter.radiance.value"),
        *(f"{s}.bsdf.brdf_0.reflectance.value" for s in ("roof", "wall", "tower", "ground")),
    ),
    "cornell-box": (
        *(f"{wall}.brdf_0.reflectance.value" for wall in ("white", "red", "green")),
        "lamp.emitter.radiance.value",
    ),
    "glossy_room": (
        *("bulb.intensity.value", "lamp.emitter.radiance.value"),
        "block.bsdf.brdf_0.bsdf_0.reflectance.value",
        "block.bsdf.brdf_0.bsdf_1.diffuse_reflectance.value",
        "block.bsdf.brdf_0.weight.value",
    ),
}
"""None of them 0: there `prb` ends its paths (`test_gradients_are_finite_differences`)."""


def gradients(
    scene: Any, integrator: dict[str, Any], names: tuple[str, ...], *, seeds: range, spp: int
) -> NDArray[np.float64]:
    """Of the image's mean, (runs, components of all parameters)."""
    loaded: Any = mi.load_dict(integrator)
    params = mi.traverse(scene)
    runs = []
    for seed in seeds:
        for name in names:
            dr.enable_grad(params[name])
            dr.set_grad(params[name], 0)
        image = mi.render(
            scene,
            params,
            integrator=loaded,
            seed=seed,  # pyright: ignore[reportArgumentType]
            seed_grad=seed + 7000,
            spp=spp,
            spp_grad=spp,
        )
        dr.backward(dr.mean(image[..., :3], axis=None))
        found = [np.array(dr.grad(params[name]), np.float64).ravel() for name in names]
        runs.append(np.concatenate(found))
        for name in names:
            dr.disable_grad(params[name])
    return np.array(runs)


def prb(scene: Any, names: tuple[str, ...], *, k: int, seeds: range, spp: int) -> Any:
    """The same by Mitsuba, light of k bounces alone."""
    deep, shallow = (
        gradients(
            scene,
            {"type": "prb", "max_depth": depth, "rr_depth": 100},
            names,
            seeds=seeds,
            spp=spp,
        )
        for depth in (k + 1, k)
    )
    return deep - shallow


def _cases() -> list[Any]:
    quick = {("furnace_sphere", 2)}
    return [
        pytest.param(*case, marks=[] if case in quick else [pytest.mark.long])
        for case in product(PARAMETERS, (1, 2, 3))
    ]


@pytest.mark.parametrize(("name", "k"), _cases())
def test_gradients_are_those_of_prb(name: str, k: int) -> None:
    """H0: equal gradients, of guided paths and of Mitsuba's; with 5 % more they are not."""
    mi.set_variant(LLVM)
    scene, names = load_named(name), PARAMETERS[name]
    own = {"type": "pssflow", "k": k, "guide": "direction-table" if k > 1 else "none"}
    ours = gradients(scene, own, names, seeds=range(RUNS), spp=32)
    truth = prb(scene, names, k=k, seeds=range(100, 100 + RUNS), spp=64)
    p = holm(p_value(Moments.of(ours), Moments.of(truth)))
    assert p.min() > ALPHA, np.stack([ours.mean(0), truth.mean(0), p])
    assert np.count_nonzero(ours.mean(0)) > 0.8 * ours.shape[1]
    more = holm(p_value(Moments.of(1.05 * ours), Moments.of(truth)))
    assert more.min() < ALPHA


@pytest.mark.long
def test_gradients_of_the_whole_light(llvm_variant: str) -> None:
    """H0: up to a depth, emission and direct light included, they are those of `prb` at the same depth."""
    scene, names = load_named("furnace_sphere"), PARAMETERS["furnace_sphere"]
    own = {"type": "pssflow", "max_depth": 3, "guide": "table"}
    ours = gradients(scene, own, names, seeds=range(RUNS), spp=16)
    theirs = {"type": "prb", "max_depth": 3, "rr_depth": 100}
    truth = gradients(scene, theirs, names, seeds=range(100, 100 + RUNS), spp=32)
    p = holm(p_value(Moments.of(ours), Moments.of(truth)))
    assert p.min() > ALPHA, np.stack([ours.mean(0), truth.mean(0), p])


@pytest.mark.parametrize(
    ("name", "parameter"),
    [
        # Black: its paths carry no light, but have a derivative.
        ("furnace_sphere", "lamp.bsdf.reflectance.value"),
        *(
            pytest.param(name, parameter, marks=pytest.mark.long)
            for name, parameter in (
                ("furnace_sphere", "room.bsdf.brdf_0.reflectance.value"),
                ("open_sky", "sky.radiance.value"),
                ("cornell-box", "red.brdf_0.reflectance.value"),
                ("glossy_room", "block.bsdf.brdf_0.weight.value"),
            )
        ),
    ],
)
def test_gradients_are_finite_differences(name: str, parameter: str) -> None:
    """H0: the sum over components is (I(p + h) − I(p − h)) ÷ 2h of `path`, whose numbers are the same on both sides."""
    mi.set_variant(LLVM)
    scene = load_named(name)
    own = {"type": "pssflow", "k": 2, "guide": "direction-table"}
    ours = gradients(scene, own, (parameter,), seeds=range(RUNS), spp=32).sum(axis=1)
    params = mi.traverse(scene)
    value: Any = dr.detach(params[parameter])
    step, sides = 0.02, []
    low = value - step if np.array(value).min() > step else value
    for at in (value + step, low):
        params[parameter] = at
        params.update()
        sides.append(_two_bounces(scene))
    params[parameter] = value
    params.update()
    truth = (sides[0] - sides[1]) / (step if low is value else 2 * step)
    p = float(p_value(Moments.of(ours), Moments.of(truth)))
    assert p > ALPHA, (ours.mean(), truth.mean(), p)
    assert float(p_value(Moments.of(1.2 * ours), Moments.of(truth))) < ALPHA


def _two_bounces(scene: Any) -> NDArray[np.float64]:
    """Means of images of k = 2, a seed each."""
    means = []
    for seed in range(RUNS):
        deep, shallow = (
            np.array(
                mi.render(
                    scene,
                    integrator=mi.load_dict({"type": "path", "max_depth": d, "rr_depth": 100}),
                    seed=seed,  # pyright: ignore[reportArgumentType]
                    spp=128,
                )
            )[..., :3].mean()
            for d in (3, 2)
        )
        means.append(float(deep - shallow))
    return np.array(means)
