"""Derivatives of the learned estimate: the core draws paths, Dr.Jit builds the same ones anew and differentiates them.

For each path of k bounces that the core draws from the mixture of density m it hands out the direction and the baseline
density p of every decision (`_core.Scene.draw`). Here the camera ray is sent again in Mitsuba, each direction followed
by Mitsuba's own ray tracing, and

    f_nee ÷ m = Π_{b<k} (f_s·|cos θ|)_b ÷ p_b · (f_s·|cos θ|)_k · L_e · w_nee ÷ (p_nee·m)

(f_bsdf likewise) is evaluated with BSDFs, textures and emitters *attached* and directions, visibility, p, w and m
*detached*: detached sampling (Zeltner et al. 2021, *Monte Carlo estimators for differential light transport*). Its
derivative is unbiased for every parameter that moves no geometry, whatever the guide, since m ≥ a > 0. What moves
geometry is refused by name: its discontinuities need other estimators.

Where a lobe is a delta its weight is a constant, as in Mitsuba's `prb`; parameters of such lobes are refused too. Paths
go on where a surface reflects nothing, since it has a derivative all the same; `prb` ends them there.
Paths are drawn and differentiated a few samples at a time, so that memory does not grow with their number; one sample
of each pixel is the least, for which the core hands out some 100 + 64·k bytes and Dr.Jit's graph takes more beside it:
images of several megapixels are better differentiated by crops. Ctrl-C is heard between passes.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .guide import Guide
from .jit import columns, to_jit

if TYPE_CHECKING:
    from .render import Result
    from .scene import Scene

__all__ = ["backward", "check_parameters", "forward", "sources"]

MOST_AT_ONCE = 1 << 17
"""Paths that are differentiated together."""

MOST_GRAZED = 2
"""Surfaces in the plane of a light that are passed on the way to it."""

GEOMETRY = (
    *("vertex_positions", "vertex_normals", "vertex_texcoords", "faces", "to_world", "to_uv"),
    *("position", "direction", "center", "radius", "x_fov", "near_clip", "far_clip"),
    *("principal_point_offset_x", "principal_point_offset_y", "aperture_radius", "focus_distance"),
    *("cutoff_angle", "beam_width", "sun_direction", "shutter_open", "shutter_open_time"),
)
"""Last parts of the names of parameters that move vertices, rays or what is visible."""

OF_DELTA_LOBES = ("specular_reflectance", "specular_transmittance", "eta", "k", "opacity", "weight")
"""Last parts of the names of parameters that a delta lobe may depend on."""


def check_parameters(scene: Any, params: Any) -> None:
    """Refuses parameters with gradients that this estimator cannot differentiate.

    Raises:
        ValueError: one line that names the first one.
    """
    if params is None:
        return
    # An instance shows a BSDF of its own, not those of its group, which cannot be seen from here.
    delta = any(
        shape.class_name() == "Instance" or _has_delta(shape.bsdf())
        for shape in scene.shapes()
        if shape.bsdf() is not None
    )
    for name in params.keys():  # noqa: SIM118
        if not dr.grad_enabled(params[name]):
            continue
        parts = name.split(".")
        if any(part in GEOMETRY for part in parts) or "film" in parts:
            raise ValueError(
                f"parameter `{name}` moves geometry: `pssflow` cannot differentiate it; use Mitsuba's `prb_projective`"
            )
        # `nested_texture` is the height of a bump map; its `scale` is a plain number, which has no gradients.
        if "nested_texture" in parts or "normalmap" in parts:
            raise ValueError(f"parameter `{name}` bends shading normals: use Mitsuba's `prb`")
        if delta and any(part in OF_DELTA_LOBES for part in parts):
            raise ValueError(
                f"parameter `{name}` may belong to a delta lobe (mirror, glass or mask, or within an instance), whose "
                "derivative is not seen; give the scene rough materials, or leave the parameter out"
            )


def sources(result: Result) -> list[tuple[int, Guide | None, float, str]]:
    """What is drawn from: (k, guide, a, emitter strategy) of each length of a result."""
    lengths = result.parts or (result,)
    found: list[tuple[int, Guide | None, float, str]] = []
    for part in lengths:
        guide = part.guide if isinstance(part.guide, Guide) else None
        a = float(part.stats["a"]) if guide is not None else 1.0
        if a <= 0.0:
            raise ValueError(
                "gradients need a uniform_fraction above 0: without uniform paths they may be biased"
            )
        found.append((part.stats["k"], guide, a, part.stats["emitter_strategy"]))
    return found


def backward(
    ours: Scene, result: Result, sensor: Any, grad: Any, seed: int, spp: int, parametrisation: str
) -> None:
    """Propagates the gradient of an image (H, W, C) to the scene's parameters; see `forward`."""
    for image, share in _images(ours, result, sensor, seed, spp, parametrisation):
        if not dr.grad_enabled(image):
            continue  # light of this length does not depend on the parameters
        dr.set_grad(image, grad * share)
        dr.enqueue(dr.ADMode.Backward, image)
        dr.traverse(dr.ADMode.Backward)
        dr.eval()


def forward(
    ours: Scene, result: Result, sensor: Any, seed: int, spp: int, parametrisation: str
) -> Any:
    """The derivative of the image (H, W, C) along the gradients that the scene's parameters have.

    Args:
        ours: the scene as the core has it.
        result: a render, whose guides draw.
        sensor: Mitsuba's sensor.
        seed: of the paths; another one than the render's.
        spp: samples per pixel, of each length.
        parametrisation: of directions, as in `render`.
    """
    total = None
    for image, share in _images(ours, result, sensor, seed, spp, parametrisation):
        # The parameters' own gradients stay: later passes need them, too.
        kept = dr.ADFlag.ClearEdges | dr.ADFlag.ClearInterior | dr.ADFlag.AllowNoGrad
        dr.forward_to(image, flags=kept)
        part = dr.detach(dr.grad(image)) * share
        total = part if total is None else total + part
        dr.eval(total)
    return total


def _images(
    ours: Scene, result: Result, sensor: Any, seed: int, spp: int, parametrisation: str
) -> Iterator[tuple[Any, float]]:
    """Developed images with their graph, one a pass and length, and the share of the estimate that each is."""
    scene = ours.mi_scene
    if ours.hide_emitters:
        raise ValueError("gradients are not supported with `hide_emitters`")
    replaced = [note for note in ours.exported.notes if note.startswith("approximated: ")]
    if replaced:
        # Mitsuba would differentiate what the paths were not drawn in.
        raise ValueError(
            f"gradients are not supported where `approximate` replaced something: {replaced[0]}"
        )
    if sum(surrounds for _, surrounds in ours.core.emitter_intervals()) > 1:
        raise ValueError("gradients are not supported with more than one background (sun and sky)")
    film = sensor.film()
    pixels = int(np.prod(np.array(film.crop_size())))
    most = max(MOST_AT_ONCE // pixels, 1)
    emitters = to_jit(mi.UInt32, np.array(ours.exported.emitter_order or [0], np.uint32))
    for k, guide, a, strategy in sources(result):
        for first in range(0, spp, most):
            n = min(most, spp - first)
            drawn = ours.core.draw(
                None if guide is None else guide.core,
                uniform_fraction=a,
                first_sample=first,
                spp=n,
                k=max(k, 1),
                parametrisation=parametrisation,
                emitter_strategy=strategy,
                seed=(seed + k) % 2**64,
            )
            with dr.resume_grad():
                value, at = radiance(scene, sensor, drawn, k, emitters)
                film.prepare([])
                block = film.create_block()
                channels = [value.x, value.y, value.z, mi.Float(1.0)]
                if block.channel_count() == 5:
                    channels.insert(3, mi.Float(1.0))
                block.put(at, channels)
                film.put_block(block)
                dr.schedule(block.tensor())
                yield film.develop(), n / spp


def radiance(
    scene: Any, sensor: Any, drawn: dict[str, Any], k: int, emitters: Any
) -> tuple[Any, Any]:
    """F ÷ m of drawn paths with its graph, and where on the film they belong.

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
        return value * ray_weight, _vector(at, mi.Point2f)

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
    result = dr.select(joined, found, 0.0)

    # --------------------- BSDF sample at x_k ------------------
    scale = to_jit(mi.Float, drawn["mis"] / drawn["m_bsdf"])
    met = active & (scale > 0.0)
    d, factor = _step(ctx, si, drawn, k - 1, met)
    with dr.suspend_grad():
        there = scene.ray_intersect(si.spawn_ray(d), mi.RayFlags.All, False, met)
    seen = there.emitter(scene, met).eval(there, met)
    result += dr.select(met, throughput * factor * seen * scale, 0.0)
    return dr.select(dr.all(dr.isfinite(result)), result, 0.0), _vector(at, mi.Point2f)


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


def _has_delta(bsdf: Any) -> bool:
    return bool(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta)) or bool(
        mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)
    )
