"""Derivatives of the learned estimate: the core draws paths, Dr.Jit builds the same ones anew and differentiates them.

For each path of k bounces that the core draws from the mixture of density m it hands out the direction and the baseline
density p of every decision (`_core.Scene.draw`). Here the camera ray is sent again in Mitsuba, each direction followed
by Mitsuba's own ray tracing, and

    f_nee ÷ m = Π_{b<k} (f_s·|cos θ|)_b ÷ p_b · (f_s·|cos θ|)_k · L_e · w_nee ÷ (p_nee·m)

(f_bsdf likewise) is evaluated with BSDFs, textures and emitters *attached* and directions, visibility, p, w and m
*detached*: detached sampling (Zeltner et al. 2021, *Monte Carlo estimators for differential light transport*). Its
derivative is unbiased for every parameter that moves no geometry, whatever the guide, since m ≥ a > 0. What moves
geometry is refused by name: its discontinuities need other estimators.

The guides are the render's, which learned where light comes from. With a `Target` (`pssflow.gradient_guides`) others
are learned first, from where the derivative is large.

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

from .gradient_guides import Target, learned
from .jit import to_jit
from .rebuild import draw, radiance, sources

if TYPE_CHECKING:
    from .render import Result
    from .scene import Scene

__all__ = ["backward", "check_parameters", "forward"]

MOST_AT_ONCE = 1 << 17
"""Paths that are differentiated together."""

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


def backward(
    ours: Scene,
    result: Result,
    sensor: Any,
    grad: Any,
    seed: int,
    spp: int,
    parametrisation: str,
    target: Target | None = None,
) -> None:
    """Propagates the gradient of an image (H, W, C) to the scene's parameters; see `forward`."""
    for image, share in _images(
        ours, result, sensor, seed, spp, parametrisation, target, np.array(grad)
    ):
        if not dr.grad_enabled(image):
            continue  # light of this length does not depend on the parameters
        dr.set_grad(image, grad * share)
        dr.enqueue(dr.ADMode.Backward, image)
        dr.traverse(dr.ADMode.Backward)
        dr.eval()


def forward(
    ours: Scene,
    result: Result,
    sensor: Any,
    seed: int,
    spp: int,
    parametrisation: str,
    target: Target | None = None,
) -> Any:
    """The derivative of the image (H, W, C) along the gradients that the scene's parameters have.

    Args:
        ours: the scene as the core has it.
        result: a render, whose guides draw.
        sensor: Mitsuba's sensor.
        seed: of the paths; another one than the render's.
        spp: samples per pixel, of each length; with `target` its pilot is inside.
        parametrisation: of directions, as in `render`.
        target: learns from the derivative before it draws; None for the render's guides, which learned from radiance.

    Raises:
        ValueError: what cannot be differentiated; one line.
    """
    total = None
    for image, share in _images(ours, result, sensor, seed, spp, parametrisation, target):
        # Gradients stay: later passes need those of the parameters, too, which may be computed from other variables.
        dr.forward_to(image, flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad)
        part = dr.detach(dr.grad(image)) * share
        total = part if total is None else total + part
        dr.eval(total)
    return total


def _images(
    ours: Scene,
    result: Result,
    sensor: Any,
    seed: int,
    spp: int,
    parametrisation: str,
    target: Target | None,
    grad: Any = None,
) -> Iterator[tuple[Any, float]]:
    """Developed images with their graph, one a pass and length, and the share of the estimate that each is.

    `grad` is what they will be differentiated with, or None in forward mode.
    """
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
    how: dict[str, Any] = {"seed": seed, "parametrisation": parametrisation}
    for source in sources(result):
        pilot = 0
        if target is not None and source.k > 0:
            pilot = target.pilot(spp)
            passes = [range(i, min(i + most, pilot)) for i in range(0, pilot, most)]
            left = (spp - pilot) * pixels
            source = learned(target, ours, sensor, source, passes, emitters, grad, left, **how)
        for first in range(pilot, spp, most):
            samples = range(first, min(first + most, spp))
            drawn = draw(ours, source, samples, **how)
            with dr.resume_grad():
                value, at = radiance(scene, sensor, drawn, source.k, emitters)
                film.prepare([])
                block = film.create_block()
                channels = [value.x, value.y, value.z, mi.Float(1.0)]
                if block.channel_count() == 5:
                    channels.insert(3, mi.Float(1.0))
                block.put(at, channels)
                film.put_block(block)
                dr.schedule(block.tensor())
                yield film.develop(), len(samples) / (spp - pilot)


def _has_delta(bsdf: Any) -> bool:
    return bool(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta)) or bool(
        mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)
    )
