"""Emitters, in an order that does not change from process to process.

To add one: write a converter, and give it a row in `EMITTERS`.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .shapes import checked_matrix
from .sky import LENGTH_TOLERANCE, LUMINANCE, export_sunsky, export_timed_sunsky
from .textures import constant_value, export_texture
from .walk import (
    Converter,
    Entry,
    Fields,
    RefusedError,
    Walk,
    class_of,
    floats,
    number,
    plugin_of,
    sampling_weight,
)


def ordered_emitters(
    emitters: list[Any], shapes: list[tuple[str, Any]]
) -> list[tuple[str, Any, int | None]]:
    """(id, emitter, index of its shape or None) of all emitters: those of shapes in the shapes' order, then the others.

    `scene.emitters()` comes in another order in each process, and a table learned over emitters must outlive one.
    The others are sorted by class, then by their id in the scene, then by what they are.
    """
    known = set(emitters)
    listed: list[tuple[str, Any, int | None]] = []
    for index, (key, shape) in enumerate(shapes):
        emitter = shape.emitter()
        if emitter is not None and emitter in known:
            listed.append((f"{key}.emitter", emitter, index))
            known.discard(emitter)

    others = sorted(known, key=lambda emitter: (class_of(emitter), emitter.id(), str(emitter)))
    unnamed = 0
    for emitter in others:
        name = emitter.id()
        if not name:
            name, unnamed = f"{plugin_name(emitter)}_{unnamed}", unnamed + 1
        listed.append((name, emitter, None))
    return listed


def plugin_name(emitter: Any) -> str:
    """The plugin's name, whether it is supported or not."""
    converter = EMITTERS.get(class_of(emitter))
    return converter.plugin if converter else plugin_of(emitter)


def _area(walk: Walk, obj: Any, where: str, shape: Any, index: int | None) -> Entry:
    if shape is None or index is None:
        raise RefusedError("has no shape")
    radiance = Fields(obj)["radiance"]
    if class_of(radiance) == "MeshAttribute":
        raise RefusedError(
            "has a `mesh_attribute` as `radiance`, which Mitsuba itself samples as black; use a bitmap"
        )
    # Mitsuba finds the place of a texel on the shape through uv, and throws here without them.
    if radiance.is_spatially_varying() and shape.is_mesh() and not shape.has_vertex_texcoords():
        raise RefusedError("has a textured `radiance` on a mesh without texture coordinates")
    return {
        "shape": index,
        "radiance": export_texture(walk, radiance, f"{where}.radiance"),
        "sampling_weight": sampling_weight(obj),
    }


def _constant(walk: Walk, obj: Any, where: str, _shape: Any, _index: int | None) -> Entry:
    return {
        "radiance": constant_value(walk, Fields(obj)["radiance"], f"{where}.radiance"),
        "sampling_weight": sampling_weight(obj),
    }


def _point(walk: Walk, obj: Any, where: str, _shape: Any, _index: int | None) -> Entry:
    fields = Fields(obj)
    return {
        "position": floats(fields["position"], 3, "position"),
        "intensity": constant_value(walk, fields["intensity"], f"{where}.intensity"),
        "sampling_weight": sampling_weight(obj),
    }


def _envmap(walk: Walk, obj: Any, _where: str, _shape: Any, _index: int | None) -> Entry:
    fields = Fields(obj)
    to_world = checked_matrix(fields["to_world"])
    linear = np.reshape(to_world, (4, 4))[:3, :3]
    if np.abs(linear.T @ linear - np.eye(3)).max() > LENGTH_TOLERANCE:
        raise RefusedError("has a `to_world` that scales; turn or mirror it only")
    stored = dr.detach(fields["data"]).numpy()
    if stored.ndim != 3 or stored.shape[2] != 3 or stored.shape[0] < 2 or stored.shape[1] < 4:
        raise RefusedError(f"has data of shape {stored.shape}, expected (height, width + 2, 3)")
    # The first and the last column repeat those at the other end.
    texels = np.ascontiguousarray(stored[:, 1:-1], np.float32)
    return {
        "data": walk.add_array(texels),
        "scale": number(fields["scale"], "scale"),
        "to_world": to_world,
        "mis_compensation": _compensates(obj, texels, linear),
        "sampling_weight": sampling_weight(obj),
    }


def _compensates(obj: Any, texels: NDArray[np.float32], linear: NDArray[np.float64]) -> bool:
    """Whether an `envmap` draws from what exceeds its mean: Mitsuba tells by its densities alone.

    The brightest texel's density is compared with both answers.
    """
    height, width, _ = texels.shape
    luminance = (texels @ LUMINANCE).astype(np.float64)
    sine = np.sin(np.pi * np.arange(height) / (height - 1))[:, None]
    y, x = np.unravel_index(np.argmax(luminance * sine), luminance.shape)
    answers = []
    for offset in (0.0, luminance.mean()):
        grid = np.maximum(luminance - offset, 0) * sine
        rows = (grid[:-1] + grid[1:]) / 2
        mean = rows.mean()
        if not mean > 0:
            return False
        answers.append(grid[y, x] / mean / (2 * np.pi**2 * max(sine[y, 0], 1e-6)))
    phi, theta = 2 * np.pi * (x + 0.5) / width, np.pi * y / (height - 1)
    local = [np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)]
    direction = mi.ScalarVector3f(linear @ np.array(local))
    it, ds = mi.Interaction3f(), mi.DirectionSample3f()
    ds.d = mi.Vector3f(direction)
    pdf = number(obj.pdf_direction(it, ds), "pdf_direction")
    return bool(abs(pdf - answers[1]) < abs(pdf - answers[0]))


def _directional(walk: Walk, obj: Any, where: str, _shape: Any, _index: int | None) -> Entry:
    fields = Fields(obj)
    to_world = np.reshape(checked_matrix(fields["to_world"]), (4, 4))
    return {
        "direction": _unit(to_world[:3, 2]),
        "irradiance": constant_value(walk, fields["irradiance"], f"{where}.irradiance"),
        "sampling_weight": sampling_weight(obj),
    }


def _directional_area(_walk: Walk, obj: Any, _where: str, _shape: Any, index: int | None) -> Entry:
    if index is None:
        raise RefusedError("has no shape")
    return {"shape": index, "sampling_weight": sampling_weight(obj)}


def _spot(walk: Walk, obj: Any, where: str, _shape: Any, _index: int | None) -> Entry:
    fields = Fields(obj)
    texture = fields["texture"]
    return {
        "to_world": checked_matrix(fields["to_world"]),
        "intensity": constant_value(walk, fields["intensity"], f"{where}.intensity"),
        "texture": export_texture(walk, texture, f"{where}.texture")
        if texture.is_spatially_varying()
        else None,
        "cutoff_angle": number(fields["cutoff_angle"], "cutoff_angle"),
        "beam_width": number(fields["beam_width"], "beam_width"),
        "sampling_weight": sampling_weight(obj),
    }


def _projector(walk: Walk, obj: Any, where: str, _shape: Any, _index: int | None) -> Entry:
    fields = Fields(obj)
    to_world = checked_matrix(fields["to_world"])
    linear = np.reshape(to_world, (4, 4))
    _unit(linear[:3, 2])
    # The angle of view is shown nowhere: found from where points off the axis fall on the image.
    half_size = []
    for axis in (0, 1):
        uv = []
        for slope in (-1.0, 1.0):
            local = np.array([0.0, 0.0, 1.0, 1.0])
            local[axis] = slope
            it = mi.Interaction3f()
            it.p = mi.Point3f(mi.ScalarPoint3f((linear @ local)[:3]))
            ds, _ = obj.sample_direction(it, mi.Point2f(0.5))
            uv.append(np.asarray(dr.detach(ds.uv), np.float64).ravel()[axis])
        half_size.append(float(1 / (uv[0] - uv[1])))
    return {
        "to_world": to_world,
        "irradiance": export_texture(walk, fields["irradiance"], f"{where}.irradiance"),
        "scale": number(fields["scale"], "scale"),
        "half_size": half_size,
        "sampling_weight": sampling_weight(obj),
    }


EMITTERS: dict[str, Converter] = {
    "AreaLight": Converter("area", "area", _area),
    "ConstantBackgroundEmitter": Converter("constant", "constant", _constant),
    "DirectionalArea": Converter("directionalarea", "directionalarea", _directional_area),
    "DirectionalEmitter": Converter("directional", "directional", _directional),
    "EnvironmentMapEmitter": Converter("envmap", "envmap", _envmap),
    "PointLight": Converter("point", "point", _point),
    "Projector": Converter("projector", "projector", _projector),
    "SpotLight": Converter("spot", "spot", _spot),
    "SunskyEmitter": Converter("sunsky", "envmap", export_sunsky),
    "TimedSunskyEmitter": Converter("timed_sunsky", "envmap", export_timed_sunsky),
}


def _unit(direction: NDArray[np.float64]) -> list[float]:
    """A direction of a `to_world`, whose length must be 1 because Mitsuba takes it for that."""
    if abs(np.linalg.norm(direction) - 1) > LENGTH_TOLERANCE:
        raise RefusedError("has a `to_world` that scales; turn, move or mirror it only")
    return direction.tolist()
