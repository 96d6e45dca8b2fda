"""Emitters by value: the same two numbers give Mitsuba's point, direction, radiance and density."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.conftest import LLVM
from tests.support.core import core_scene
from tests.support.lights import LIGHTS, light
from tests.support.values import F32, disagreements, first_rows, points, unit_interval, vector3

pytestmark = pytest.mark.parity

Description = dict[str, Any]
SAMPLES = 20_000


def _scene(lamp: Description) -> mi.Scene:
    return mi.load_dict(
        {
            "type": "scene",
            "camera": {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}},
            "floor": {"type": "rectangle", "bsdf": {"type": "diffuse"}},
            "lamp": lamp,
        }
    )


def _numbers() -> tuple[F32, F32]:
    """Reference points in [−1, 1]³ and pairs of numbers."""
    rng = np.random.default_rng(32)
    reference = rng.uniform(-1, 1, (SAMPLES, 3)).astype(np.float32)
    return reference, unit_interval(rng, SAMPLES, 2)


def _sample(scene: mi.Scene, reference: F32, u: F32) -> tuple[dict[str, F32], dict[str, F32]]:
    """Ours and theirs of the only emitter; rows without light are zero in both."""
    core, exported = core_scene(scene)
    assert exported.emitter_order == [0]
    ours = core.emitter_sample(0, reference, u)

    it = dr.zeros(mi.Interaction3f, len(reference))
    it.p = mi.Point3f(vector3(reference))
    ds, weight = scene.emitters()[0].sample_direction(it, mi.Point2f(u.T.copy()))
    theirs = {"d": points(ds.d), "p": points(ds.p), "pdf": points(ds.pdf)}
    # What is the same for all rows comes once.
    theirs["p"] = np.broadcast_to(theirs["p"], reference.shape)
    theirs["pdf"] = np.broadcast_to(theirs["pdf"], len(reference))
    theirs["radiance"] = points(weight) * theirs["pdf"][:, None]
    lit = theirs["radiance"].max(axis=1) > 0
    for side in (ours, theirs):
        side["lit"] = np.logical_and(side["pdf"] > 0, side["radiance"].max(axis=1) > 0)
    assert np.array_equal(theirs["lit"], lit)
    return ours, theirs


def _check(ours: dict[str, F32], theirs: dict[str, F32], *, has_point: bool = True) -> None:
    """All but 5 in 20,000 lit rows agree: those lie at a light's very edge, or where it is seen edge-on."""
    lit = np.logical_and(ours["lit"], theirs["lit"])
    assert np.count_nonzero(lit) > 1000
    wrong = ours["lit"] != theirs["lit"]
    wrong |= lit & disagreements(ours["d"], theirs["d"], rel=2e-4, floor=1.0)
    wrong |= lit & disagreements(ours["radiance"], theirs["radiance"], rel=1e-4, floor=1e-3)
    wrong |= lit & disagreements(ours["pdf"], theirs["pdf"], rel=1e-3, floor=1e-6)
    if has_point:
        scale = float(np.abs(theirs["p"][lit]).max())
        wrong |= lit & disagreements(ours["p"], theirs["p"], rel=2e-4, floor=scale)
    names = ("lit", "d", "p", "pdf", "radiance")
    rows = {f"our {n}": ours[n] for n in names} | {f"their {n}": theirs[n] for n in names}
    assert np.count_nonzero(wrong) <= 5, first_rows(wrong, **rows)


@pytest.mark.parametrize("name", LIGHTS)
def test_area_light_is_sampled_as_mitsubas(name: str, tmp_path: Path) -> None:
    mi.set_variant(LLVM)
    scene = _scene(light(name, tmp_path))
    _check(*_sample(scene, *_numbers()))


@pytest.mark.parametrize(
    "lamp",
    [
        {"type": "constant", "radiance": {"type": "rgb", "value": [0.3, 0.6, 0.9]}},
        {"type": "point", "position": [1, 2, 3], "intensity": {"type": "rgb", "value": [3, 6, 9]}},
    ],
    ids=lambda lamp: lamp["type"],
)
def test_light_without_surface_is_sampled_as_mitsubas(lamp: Description) -> None:
    mi.set_variant(LLVM)
    _check(*_sample(_scene(lamp), *_numbers()), has_point=lamp["type"] == "point")


@pytest.mark.parametrize("name", LIGHTS)
def test_textured_light_shows_what_a_ray_sees(name: str, tmp_path: Path) -> None:
    """Mitsuba draws texels by their brightness, we draw the surface, with the densities tested above.

    So the radiance of each point drawn is compared with what Mitsuba sees there along a ray; all but 20 of 20,000
    agree, those at a texel's edge.
    """
    mi.set_variant(LLVM)
    scene = _scene(light(name, tmp_path, textured=True))
    core, _ = core_scene(scene)
    reference, u = _numbers()
    ours = core.emitter_sample(0, reference, u)
    ray = mi.Ray3f(mi.Point3f(vector3(reference)), vector3(ours["d"]))
    si = scene.ray_intersect(ray)
    seen = points(scene.emitters()[0].eval(si))

    lit = ours["pdf"] > 0
    lit &= np.abs(points(si.p) - ours["p"]).max(axis=1) < 1e-3  # not hidden by the floor or itself
    assert np.count_nonzero(lit) > 1000
    assert seen[lit].std(axis=0).min() > 0.1
    wrong = lit & disagreements(ours["radiance"], seen, rel=1e-3, floor=1.0)
    assert np.count_nonzero(wrong) <= 20, first_rows(
        wrong, p=ours["p"], radiance=ours["radiance"], seen=seen
    )
