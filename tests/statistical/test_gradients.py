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
    "glossy": (
        *("varnish.brdf_0.alpha", "copper.brdf_0.alpha.value", "lacquer.roughness.value"),
        *("varnish.brdf_0.diffuse_reflectance.value", "lamp-warm.emitter.radiance.value"),
    ),
    "sun_and_sky": (
        *("sky.scale", "sun.irradiance.value"),
        *(f"ground.bsdf.brdf_0.reflectance.color{i}.value" for i in range(2)),
    ),
    "door-ajar": (
        *("bright-wall.brdf_0.reflectance.value", "boards.brdf_0.reflectance.color0.value"),
        "lamp.emitter.radiance.value",
    ),
}
"""None of them 0: there `prb` ends its paths (`test_gradients_are_finite_differences`)."""

TOLD = {"open_sky": 0.1, "glossy_room": 0.1, "glossy": 0.5, "door-ajar": 0.5}
"""What the test can tell from no difference at all, where light is hard to find; elsewhere a twentieth."""


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
        # Behind the door there is no direct light, and the test would tell little of three bounces.
        if case not in {("door-ajar", 1), ("door-ajar", 3)}
    ]


@pytest.mark.parametrize(("name", "k"), _cases())
def test_gradients_are_those_of_prb(name: str, k: int) -> None:
    """H0: equal gradients, of guided paths and of Mitsuba's; with some more they are not."""
    mi.set_variant(LLVM)
    scene, names = load_named(name), PARAMETERS[name]
    own = {"type": "pssflow", "k": k, "guide": "direction-table" if k > 1 else "none"}
    ours = gradients(scene, own, names, seeds=range(RUNS), spp=32)
    truth = prb(scene, names, k=k, seeds=range(100, 100 + RUNS), spp=64)
    p = holm(p_value(Moments.of(ours), Moments.of(truth)))
    assert p.min() > ALPHA, np.stack([ours.mean(0), truth.mean(0), p])
    assert np.count_nonzero(ours.mean(0)) > 0.8 * ours.shape[1]
    more = holm(p_value(Moments.of((1.0 + TOLD.get(name, 0.05)) * ours), Moments.of(truth)))
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
                ("glossy_room", "ball.bsdf.brdf_0.alpha.value"),
                ("glossy_room", "back.bsdf.brdf_0.alpha"),
                ("glossy_room", "floor.bsdf.brdf_0.reflectance.data"),
                ("open_sky", "ground.bsdf.brdf_0.reflectance.value"),
                ("cornell-box", "lamp.emitter.radiance.value"),
                ("sun_and_sky", "sky.scale"),
                ("sun_and_sky", "ground.bsdf.brdf_0.reflectance.color0.value"),
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


@pytest.mark.parametrize(
    ("name", "guide", "light"),
    [
        ("furnace_sphere", "table", {"k": 2}),
        *(
            pytest.param(*case, marks=pytest.mark.long)
            for case in (
                ("furnace_sphere", "auto", {"max_depth": 4}),
                ("open_sky", "auto", {"k": 1}),
                ("cornell-box", "auto", {"k": 3}),
                ("glossy_room", "realnvp-logit", {"k": 2}),
                ("sun_and_sky", "table", {"k": 2}),
            )
        ),
    ],
)
def test_guides_of_the_gradient_bias_nothing(name: str, guide: str, light: dict[str, int]) -> None:
    """H0: drawn where the derivative is large, gradients are those of uniform numbers; with some more they are not."""
    mi.set_variant(LLVM)
    scene, names = load_named(name), PARAMETERS[name]
    own = {"type": "pssflow", "guide": guide, "target": "gradient", **light}
    ours = gradients(scene, own, names, seeds=range(RUNS), spp=32)
    plain = {"type": "pssflow", "guide": "none", **light}
    truth = gradients(scene, plain, names, seeds=range(100, 100 + RUNS), spp=64)
    p = holm(p_value(Moments.of(ours), Moments.of(truth)))
    assert p.min() > ALPHA, np.stack([ours.mean(0), truth.mean(0), p])
    more = holm(p_value(Moments.of(1.1 * ours), Moments.of(truth)))
    assert more.min() < ALPHA


def _two_panels() -> Any:
    """A white wall that two panels out of sight shine on: one that much light falls on, and one in the dusk."""
    T = mi.ScalarTransform4f

    def panel(x: float, albedo: float) -> dict[str, Any]:
        turned = T().translate([x, 0, 1]).rotate([0, 1, 0], 90.0 if x < 0 else -90.0).scale(0.3)
        bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [albedo] * 3}}
        return {"type": "rectangle", "to_world": turned, "bsdf": bsdf}

    def spot(x: float, intensity: float) -> dict[str, Any]:
        aimed = T().look_at(origin=[0, 0, 1], target=[x, 0, 1], up=[0, 0, 1])
        light = {"type": "rgb", "value": [intensity] * 3}
        return {"type": "spot", "to_world": aimed, "intensity": light, "cutoff_angle": 12.0}

    film = {"type": "hdrfilm", "width": 32, "height": 32, "pixel_format": "rgb"}
    return mi.load_dict(
        {
            "type": "scene",
            "camera": {
                "type": "perspective",
                "fov": 30,
                "to_world": T().look_at(origin=[0, -3, 1], target=[0, 1, 1], up=[0, 0, 1]),
                "film": film | {"rfilter": {"type": "box"}},
            },
            "seen": {
                "type": "rectangle",
                "to_world": T().translate([0, 1, 1]).rotate([1, 0, 0], 90),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7] * 3}},
            },
            "bright": panel(1.5, 0.6),
            "dusk": panel(-1.5, 0.3),
            "strong": spot(1.5, 100.0),
            "weak": spot(-1.5, 1.0),
        }
    )


def test_a_guide_of_the_gradient_gains_where_little_light_matters() -> None:
    """The colour of the panel in the dusk: guides of radiance look at the other one, those of the gradient do not.

    Variances of the derivative's pixels, each between runs, in the mean of a thousand pixels.
    """
    mi.set_variant(LLVM)
    scene, name = _two_panels(), "dusk.bsdf.reflectance.value"
    params = mi.traverse(scene)
    own = {
        "uniform": {"guide": "none"},
        "radiance": {"guide": "table"},
        "gradient": {"guide": "table", "target": "gradient"},
    }
    means, variances = {}, {}
    for side, how in own.items():
        integrator: Any = mi.load_dict({"type": "pssflow", "k": 2, **how})
        runs = []
        for seed in range(3):
            dr.enable_grad(params[name])
            dr.set_grad(params[name], 1.0)
            runs.append(
                np.array(integrator.render_forward(scene, params, seed=seed, spp=256)).mean(axis=2)
            )
            dr.disable_grad(params[name])
        means[side] = Moments.of(np.array(runs).mean(axis=(1, 2)))
        variances[side] = np.var(runs, axis=0, ddof=1).mean()
    assert float(p_value(means["gradient"], means["uniform"])) > ALPHA
    assert variances["radiance"] > 5.0 * variances["gradient"], variances
    assert variances["uniform"] > 2.0 * variances["gradient"], variances
