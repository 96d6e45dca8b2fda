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
from tests.support.values import (
    F32,
    disagreements,
    first_rows,
    points,
    sphere_directions,
    unit_interval,
    vector3,
)

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


def _check(
    ours: dict[str, F32],
    theirs: dict[str, F32],
    *,
    has_point: bool = True,
    radiance: tuple[float, float] = (1e-4, 1e-3),
) -> None:
    """All but 5 in 20,000 lit rows agree: those lie at a light's very edge, or where it is seen edge-on.

    `radiance` is within its first number, relatively, above its second.
    """
    lit = np.logical_and(ours["lit"], theirs["lit"])
    assert np.count_nonzero(lit) > 1000
    wrong = ours["lit"] != theirs["lit"]
    wrong |= lit & disagreements(ours["d"], theirs["d"], rel=2e-4, floor=1.0)
    wrong |= lit & disagreements(
        ours["radiance"], theirs["radiance"], rel=radiance[0], floor=radiance[1]
    )
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


def _sky(name: str) -> Description:
    """Environment maps: a plain one, one that is turned, mirrored and scaled, and others of odd sizes."""
    rng = np.random.default_rng(33)
    sizes = {"plain": (16, 32), "turned": (23, 37), "small": (3, 2), "sun": (64, 128)}
    height, width = sizes.get(name, (9, 20))
    texels = rng.uniform(0, 2, (height, width, 3)).astype(np.float32)
    sky: Description = {"type": "envmap", "bitmap": mi.Bitmap(texels)}
    T = mi.ScalarTransform4f
    if name == "turned":
        turn = T().rotate([0.6, 0, 0.8], 70).rotate([0, 1, 0], 200).scale([-1, 1, 1])
        sky |= {"to_world": turn, "scale": 2.5}
    elif name == "sun":
        texels[10:12, 77:79] = [3000, 2500, 2000]
        texels[40:] = 0
        sky |= {"bitmap": mi.Bitmap(texels)}
    elif name == "compensated":
        sky |= {"mis_compensation": True}
    return sky


SKIES = ("plain", "turned", "small", "sun", "compensated")


@pytest.mark.parametrize("name", SKIES)
def test_sky_is_sampled_as_mitsubas(name: str) -> None:
    mi.set_variant(LLVM)
    # A direction's last digits move the place in the image.
    near = (1e-3, 0.3 if name != "sun" else 300.0)
    _check(*_sample(_scene(_sky(name)), *_numbers()), has_point=False, radiance=near)


@pytest.mark.parametrize("name", SKIES)
def test_what_a_ray_sees_of_the_sky_is_mitsubas(name: str, variant: str) -> None:
    """Radiance and density in 10,000 directions (2,000 in the scalar variant): all but 3 within 1e-3."""
    scene = _scene(_sky(name))
    core, _ = core_scene(scene)
    n = 10_000 if variant == LLVM else 2_000
    d = sphere_directions(np.random.default_rng(34), n)
    # Below the floor, that nothing hides the sky.
    reference = np.tile(np.array([[50, 60, -70]], np.float32), (n, 1))
    radiance, pdf = core.emitter_eval_pdf(0, reference, d)
    sky = scene.emitters()[0]
    if variant == LLVM:
        si, ds = dr.zeros(mi.SurfaceInteraction3f, n), dr.zeros(mi.DirectionSample3f, n)
        si.wi, ds.d = -vector3(d), vector3(d)
        seen, density = points(sky.eval(si)), points(sky.pdf_direction(si, ds))
    else:
        si, ds = mi.SurfaceInteraction3f(), mi.DirectionSample3f()
        seen, density = np.empty((n, 3), np.float32), np.empty(n, np.float32)
        for i, row in enumerate(d.tolist()):
            si.wi, ds.d = -mi.Vector3f(row), mi.Vector3f(row)
            seen[i] = np.array(sky.eval(si))
            density[i] = np.array(sky.pdf_direction(si, ds)).item()
    assert seen.std(axis=0).min() > 0.1
    wrong = disagreements(radiance, seen, rel=1e-3, floor=0.1)
    wrong |= disagreements(pdf, density, rel=1e-3, floor=1e-3)
    rows = {"d": d, "radiance": radiance, "seen": seen, "pdf": pdf, "density": density}
    assert np.count_nonzero(wrong) <= 3, first_rows(wrong, **rows)


def test_edited_sky_is_seen_as_it_is_now() -> None:
    mi.set_variant(LLVM)
    scene = _scene(_sky("plain"))
    params = mi.traverse(scene)
    key = next(name for name, _ in params.items() if name.endswith(".data"))
    flipped = np.ascontiguousarray(np.array(params[key], np.float32)[::-1] * np.float32(3))
    params[key] = mi.TensorXf(flipped)
    params[key.replace("data", "scale")] = 0.7
    params.update()
    _check(*_sample(scene, *_numbers()), has_point=False, radiance=(1e-3, 0.3))


def _lamps() -> dict[str, Description]:
    """Lights from a point or from infinity; each turns on what the others leave at its default."""
    T = mi.ScalarTransform4f
    view = T().look_at(origin=[1, -2, 3], target=[0.1, 0, 0.2], up=[0.6, 0, 0.8])
    texels = np.random.default_rng(35).uniform(0.1, 4, (7, 11, 3)).astype(np.float32)
    image = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}
    colour = {"type": "rgb", "value": [3, 6, 9]}
    return {
        "directional": {"type": "directional", "direction": [1, -2, -3], "irradiance": colour},
        "directional-turned": {"type": "directional", "to_world": view, "irradiance": colour},
        "spot": {"type": "spot", "to_world": view, "intensity": colour},
        "spot-wide": {
            "type": "spot",
            "to_world": view,
            "cutoff_angle": 80,
            "beam_width": 1,
            "intensity": colour,
        },
        "spot-sharp": {"type": "spot", "to_world": view, "cutoff_angle": 30, "beam_width": 30},
        "spot-textured": {
            "type": "spot",
            "to_world": view,
            "cutoff_angle": 35,
            "texture": image,
            "intensity": colour,
        },
        "projector": {"type": "projector", "to_world": view, "irradiance": image, "fov": 40},
        "projector-scaled": {
            "type": "projector",
            "to_world": view @ T().scale([-1, 1, 1]),
            "irradiance": image | {"filter_type": "nearest"},
            "fov": 75,
            "scale": 3.0,
        },
    }


LAMPS = (
    *("directional", "directional-turned", "spot", "spot-wide", "spot-sharp", "spot-textured"),
    *("projector", "projector-scaled"),
)


@pytest.mark.parametrize("name", LAMPS)
def test_lamp_is_sampled_as_mitsubas(name: str) -> None:
    mi.set_variant(LLVM)
    assert set(LAMPS) == set(_lamps())
    has_point = not name.startswith("directional")
    ours, theirs = _sample(_scene(_lamps()[name]), *_numbers())
    # A place in an image, and a share of the light near its rim, hang on a direction's last digits.
    floor = 0.02 * float(theirs["radiance"].max())
    _check(ours, theirs, has_point=has_point, radiance=(1e-4, floor))


SUNSKIES: dict[str, Description] = {
    "default": {},
    "low": {"hour": 18.5, "turbidity": 6.0},
    "complex": {"complex_sun": True, "sun_direction": [0.2, 0.9, 0.1]},
    "large": {"sun_aperture": 20.0, "sun_scale": 0.3, "sun_direction": [1.0, 0.2, 0.1]},
    "no-sun": {"sun_scale": 0.0, "sky_scale": 15.0, "sun_direction": [0.35, 0.87, 0.35]},
    "no-sky": {"sky_scale": 0.0, "sun_direction": [0.35, 0.87, 0.35]},
}


@pytest.mark.parametrize("name", SUNSKIES)
def test_baked_sunsky_is_mitsubas(name: str) -> None:
    """Sky and sun together show Mitsuba's radiance within 1 %, but for the sun's rim; half of the rays near the sun.

    And each has the density that it says: the radiance of its own samples is what a ray sees there, and one over the
    mean of the inverse density is the solid angle that it covers.
    """
    mi.set_variant(LLVM)
    turn = mi.ScalarTransform4f().rotate([1, 0, 0], -90)
    scene = _scene({"type": "sunsky", "to_world": turn} | SUNSKIES[name])
    core, exported = core_scene(scene)
    emitters = exported.description["emitters"]
    assert len(exported.emitter_order) == len(emitters) == 1 + (name != "no-sun")

    rng = np.random.default_rng(36)
    direction = np.array(mi.traverse(scene)["lamp.sun_direction"]).ravel()
    near = rng.normal(size=(5000, 3)) * rng.choice([0.002, 0.01, 0.1], (5000, 1)) + direction
    near /= np.linalg.norm(near, axis=1, keepdims=True)
    d = np.concatenate([near, sphere_directions(rng, 5000)]).astype(np.float32)
    reference = np.tile(np.array([[50, 60, -70]], np.float32), (len(d), 1))
    seen = [core.emitter_eval_pdf(i, reference, d) for i in range(len(emitters))]
    si = dr.zeros(mi.SurfaceInteraction3f, len(d))
    si.wi = -vector3(d)
    theirs = points(scene.emitters()[0].eval(si))
    ours = np.sum([radiance for radiance, _ in seen], axis=0)
    # Rings of a sun that is darker towards its rim, and towards the horizon.
    rel = 2e-2 if name == "complex" else 1e-2
    wrong = disagreements(ours, theirs, rel=rel, floor=1e-3)
    for sun in emitters[1:]:
        angle = 2 * np.arcsin(np.linalg.norm(d - sun["direction"], axis=1) / 2)
        wrong &= np.abs(angle / sun["half_angle"] - 1) > 0.1
    # At the horizon itself.
    wrong &= np.abs(d[:, 1]) > 1e-4
    assert np.count_nonzero(wrong) == 0, first_rows(wrong, d=d, ours=ours, theirs=theirs)

    u = unit_interval(rng, len(d), 2)
    for i in range(len(emitters)):
        if not any(np.ravel(seen[i][0])):
            continue
        drawn = core.emitter_sample(i, reference, u)
        radiance, pdf = core.emitter_eval_pdf(i, reference, drawn["d"])
        lit = drawn["pdf"] > 0
        assert np.count_nonzero(lit) > 9900
        bad = lit & disagreements(pdf, drawn["pdf"], rel=1e-2, floor=1e-3)
        bad |= lit & disagreements(radiance, drawn["radiance"], rel=1e-2, floor=1e-2)
        assert np.count_nonzero(bad) <= 50, first_rows(bad, d=drawn["d"], pdf=pdf, u=u)


TIMED: dict[str, tuple[float, float, Description]] = {
    "moment": (0.3001, 0.3001, {}),
    "complex": (0.5504, 0.5504, {"complex_sun": True, "sun_aperture": 8.0}),
    "hours": (0.0, 1.0, {"end_year": 2025, "end_month": 1, "end_day": 1, "sun_aperture": 5.0}),
}
"""When the shutter opens and closes, and what else is not the default."""


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.long] if name == "hours" else []) for name in TIMED],
)
def test_baked_timed_sunsky_is_mitsubas(name: str) -> None:
    """Sky and sun together have Mitsuba's mean over the shutter's opening: irradiance of five directions to 2 %, and
    away from the sun its radiance to 1 %.
    """
    mi.set_variant(LLVM)
    start, end, options = TIMED[name]
    turn = mi.ScalarTransform4f().rotate([1, 0, 0], -90)
    film = {"type": "hdrfilm", "width": 8, "height": 8}
    camera = {"type": "perspective", "shutter_open": start, "shutter_close": end, "film": film}
    lamp = {"type": "timed_sunsky", "to_world": turn} | options
    scene = mi.load_dict({"type": "scene", "camera": camera, "b": {"type": "rectangle"}, "l": lamp})
    core, exported = core_scene(scene)
    emitters = exported.description["emitters"]
    assert len(exported.emitter_order) == len(emitters) == 2
    assert any("values of Mitsuba's" in note for note in exported.notes)

    rng = np.random.default_rng(37)
    d = sphere_directions(rng, 50_000)
    d[:, 1] = np.abs(d[:, 1])
    reference = np.tile(np.array([[50, 60, -70]], np.float32), (len(d), 1))
    ours = [core.emitter_eval_pdf(i, reference, d)[0] for i in range(2)]
    times = np.linspace(start, end, 1 if start == end else 129)
    times = times if start == end else 0.5 * (times[1:] + times[:-1])
    si: Any = dr.zeros(mi.SurfaceInteraction3f, len(d))
    si.wi = -vector3(d)
    theirs = np.zeros((len(d), 3))
    for t in times.tolist():
        si.time = mi.Float(t)
        theirs += points(scene.emitters()[0].eval(si)) / len(times)
    both = ours[0] + ours[1]
    for n in ([0, 1, 0], [1, 0.2, 0], [-1, 0.2, 0], [0, 0.2, 1], [0, 0.2, -1]):
        cosine = np.maximum(d @ (np.array(n, np.float32) / np.linalg.norm(n)), 0)[:, None]
        np.testing.assert_allclose((both * cosine).mean(0), (theirs * cosine).mean(0), rtol=2e-2)
    sky = ours[1].max(axis=1) == 0
    wrong = disagreements(both, theirs.astype(np.float32), rel=1e-2, floor=1e-3)
    wrong &= sky & (d[:, 1] > 1e-3)
    # The sun's rim: where one of the two still shows it.
    assert np.count_nonzero(wrong) <= len(d) / 1000, first_rows(
        wrong, d=d, both=both, theirs=theirs
    )

    u = unit_interval(rng, 5000, 2)
    for i in range(2):
        drawn = core.emitter_sample(i, reference[:5000], u)
        radiance, pdf = core.emitter_eval_pdf(i, reference[:5000], drawn["d"])
        lit = drawn["pdf"] > 0
        bad = lit & disagreements(pdf, drawn["pdf"], rel=1e-2, floor=1e-3)
        bad |= lit & disagreements(radiance, drawn["radiance"], rel=1e-2, floor=1e-2)
        assert np.count_nonzero(bad) <= 50, first_rows(bad, d=drawn["d"], pdf=pdf, u=u)


def test_laser_gives_no_light_to_a_path() -> None:
    """A `directionalarea` is drawn as any other light, and its every sample is empty: in both."""
    mi.set_variant(LLVM)
    laser = {"type": "rectangle", "light": {"type": "directionalarea"}}
    scene = mi.load_dict({"type": "scene", "camera": {"type": "perspective"}, "laser": laser})
    ours, theirs = _sample(scene, *_numbers())
    assert not ours["lit"].any()
    assert not theirs["lit"].any()


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
