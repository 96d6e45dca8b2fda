"""Paths that the core drew, built anew in Dr.Jit with the graph of what they carry; see `pssflow.gradients`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .guide import Guide
from .jit import columns, to_jit

if TYPE_CHECKING:
    from .render import Result
    from .scene import Scene

__all__ = ["Source", "draw", "radiance", "sources", "terms"]

MOST_GRAZED = 2
"""Surfaces in the plane of a light that are passed on the way to it."""


@dataclass(frozen=True)
class Source:
    """What paths of one length are drawn from.

    Raises:
        ValueError: without uniform paths derivatives may be biased.
    """

    k: int
    guide: Guide | None
    a: float
    """Share of uniform paths."""
    strategy: str
    """How the light is joined."""

    def __post_init__(self) -> None:
        if self.a <= 0.0:
            raise ValueError(
                "gradients need a uniform_fraction above 0: without uniform paths they may be biased"
            )


def sources(result: Result) -> list[Source]:
    """What the lengths of a result were drawn from."""
    found = []
    for part in result.parts or (result,):
        guide = part.guide if isinstance(part.guide, Guide) else None
        a = float(part.stats["a"]) if guide is not None else 1.0
        found.append(Source(part.stats["k"], guide, a, part.stats["emitter_strategy"]))
    return found


def draw(
    ours: Scene,
    source: Source,
    samples: range,
    *,
    seed: int,
    parametrisation: str,
    numbers: bool = False,
) -> dict[str, Any]:
    """These samples of each pixel, as `_core.Scene.draw` returns them; each length has numbers of its own."""
    return ours.core.draw(
        None if source.guide is None else source.guide.core,
        uniform_fraction=source.a,
        first_sample=samples.start,
        spp=len(samples),
        k=max(source.k, 1),
        parametrisation=parametrisation,
        emitter_strategy=source.strategy,
        seed=(seed + source.k) % 2**64,
        numbers=numbers,
    )


def radiance(
    scene: Any, sensor: Any, drawn: dict[str, Any], k: int, emitters: Any
) -> tuple[Any, Any]:
    """F ÷ m of drawn paths with its graph, and where on the film they belong; arguments as `terms`."""
    (nee, bsdf), at = terms(scene, sensor, drawn, k, emitters)
    return nee + bsdf, at


def terms(
    scene: Any, sensor: Any, drawn: dict[str, Any], k: int, emitters: Any
) -> tuple[tuple[Any, Any], Any]:
    """The two terms f_nee ÷ m and f_bsdf ÷ m of drawn paths with their graph, and where on the film they belong.

    Args:
        scene: Mitsuba's scene.
        sensor: Mitsuba's sensor.
        drawn: what `_core.Scene.draw` returned.
        k: bounces; 0 for emission along the same camera rays.
        emitters: position in `scene.emitters()` of each of the core's emitters.
    """
    film = sensor.film()
    size, offset = (np.array(v, np.float32) for v in (film.crop_size(), film.crop_offset()))
    place = np.minimum(drawn["film"] / size, np.float32(1 - 2**-24))
    lens = drawn["lens"] if len(drawn["lens"]) else np.full_like(place, 0.5)
    at = drawn["film"] + offset
    if film.rfilter().is_box_filter():
        at = np.floor(at)
    ctx = mi.BSDFContext()
    active = to_jit(mi.Float, drawn["found"].astype(np.float32)) > 0.0 if k > 0 else mi.Bool(True)
    ray, ray_weight = sensor.sample_ray_differential(
        sensor.shutter_open(), 0.0, _vector(place, mi.Point2f), _vector(lens, mi.Point2f)
    )
    with dr.suspend_grad():
        si = scene.ray_intersect(ray, mi.RayFlags.All, True, active)
    if k == 0:
        value = si.emitter(scene).eval(si)
        return (value * ray_weight, mi.Spectrum(0.0)), _vector(at, mi.Point2f)

    # ---------------------- x₁ → … → x_k ----------------------
    throughput = mi.Spectrum(ray_weight)
    for b in range(k - 1):
        active &= si.is_valid()
        d, factor = _step(ctx, si, drawn, b, active)
        throughput *= factor
        with dr.suspend_grad():
            si = scene.ray_intersect(si.spawn_ray(d), mi.RayFlags.All, False, active)
    active &= si.is_valid()

    # ------------------- Emitter sample at x_k -----------------
    scale = to_jit(mi.Float, drawn["join_scale"] / drawn["m_nee"])
    joined = active & (scale > 0.0)
    d = _vector(drawn["join_d"], mi.Vector3f)
    value = si.bsdf().eval(ctx, si, si.to_local(d), joined)
    chosen = dr.gather(mi.UInt32, emitters, to_jit(mi.UInt32, drawn["emitter"]), joined)
    light = dr.gather(mi.EmitterPtr, scene.emitters_dr(), chosen, joined)
    delta = joined & mi.has_flag(light.flags(), mi.EmitterFlags.Delta)
    met = joined & ~delta
    with dr.suspend_grad():
        there = scene.ray_intersect(si.spawn_ray(d), mi.RayFlags.All, False, met)
        for _ in range(MOST_GRAZED):
            # Nothing lies before the light, but a surface may lie in it, as a ceiling with its lamp.
            other = met & (there.emitter(scene, met) != light)
            further = scene.ray_intersect(there.spawn_ray(d), mi.RayFlags.All, False, other)
            there = dr.select(other, further, there)
    # What still lies before the light is another one, whose light is not that of the sample.
    met &= there.emitter(scene, met) == light
    seen = there.emitter(scene, met).eval(there, met)
    # Nothing is chosen on a point or a direction: its numbers do not matter.
    _, given = light.sample_direction(si, mi.Point2f(0.5), delta)
    found = throughput * value * dr.select(delta, given, seen) * scale
    nee = dr.select(joined & dr.all(dr.isfinite(found)), found, 0.0)

    # --------------------- BSDF sample at x_k ------------------
    scale = to_jit(mi.Float, drawn["mis"] / drawn["m_bsdf"])
    met = active & (scale > 0.0)
    d, factor = _step(ctx, si, drawn, k - 1, met)
    with dr.suspend_grad():
        there = scene.ray_intersect(si.spawn_ray(d), mi.RayFlags.All, False, met)
    seen = there.emitter(scene, met).eval(there, met)
    found = throughput * factor * seen * scale
    bsdf = dr.select(met & dr.all(dr.isfinite(found)), found, 0.0)
    return (nee, bsdf), _vector(at, mi.Point2f)


def _step(ctx: Any, si: Any, drawn: dict[str, Any], b: int, active: Any) -> tuple[Any, Any]:
    """A direction that was drawn at x_{b+1}, and f_s·|cos θ| ÷ p with its graph."""
    d = _vector(drawn["step_d"][:, b], mi.Vector3f)
    pdf = to_jit(mi.Float, drawn["step_pdf"][:, b])
    weight = _vector(drawn["step_weight"][:, b], mi.Spectrum)
    smooth = active & (pdf > 0.0)
    value = si.bsdf().eval(ctx, si, si.to_local(d), smooth)
    return d, dr.select(smooth, value / dr.select(smooth, pdf, 1.0), weight)


def _vector(values: Any, kind: Any) -> Any:
    return columns(kind, mi.Float, values)
