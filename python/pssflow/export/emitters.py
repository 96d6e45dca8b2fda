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
from .textures import constant_value, export_texture
from .walk import (
    Converter,
    Entry,
    Fields,
    RefusedError,
    Walk,
    class_of,
    floats,
    is_scalar,
    number,
    plugin_of,
    printed,
)

LENGTH_TOLERANCE = 1e-3
"""By how much a direction's length may miss 1 in a light's `to_world`: Mitsuba does not normalise there."""

SKY_WIDTH, SKY_HEIGHT = 512, 201
"""Size of the image that a `sunsky` becomes: a degree a texel or less, and rows that crowd at the horizon."""

SUN_RINGS = 17
"""Values of a sun's radiance between its centre and its rim, where it is not the same all over."""

LUMINANCE = np.array([0.212671, 0.715160, 0.072169], np.float32)
"""Weights of linear sRGB, Mitsuba's."""


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
        "sampling_weight": _sampling_weight(obj),
    }


def _constant(walk: Walk, obj: Any, where: str, _shape: Any, _index: int | None) -> Entry:
    return {
        "radiance": constant_value(walk, Fields(obj)["radiance"], f"{where}.radiance"),
        "sampling_weight": _sampling_weight(obj),
    }


def _point(walk: Walk, obj: Any, where: str, _shape: Any, _index: int | None) -> Entry:
    fields = Fields(obj)
    return {
        "position": floats(fields["position"], 3, "position"),
        "intensity": constant_value(walk, fields["intensity"], f"{where}.intensity"),
        "sampling_weight": _sampling_weight(obj),
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
        "sampling_weight": _sampling_weight(obj),
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
        "sampling_weight": _sampling_weight(obj),
    }


def _directional_area(_walk: Walk, obj: Any, _where: str, _shape: Any, index: int | None) -> Entry:
    if index is None:
        raise RefusedError("has no shape")
    return {"shape": index, "sampling_weight": _sampling_weight(obj)}


def _sunsky(walk: Walk, obj: Any, where: str, _shape: Any, _index: int | None) -> Entry:
    """The sky as an image of the upper half; the sun, where there is one, as an emitter behind all others.

    Both are Mitsuba's own values: of a sky like this one without a sun, and of what this one has more.
    """
    fields = Fields(obj)
    to_world = np.reshape(checked_matrix(fields["to_world"]), (4, 4))
    linear = to_world[:3, :3]
    if np.abs(linear.T @ linear - np.eye(3)).max() > LENGTH_TOLERANCE:
        raise RefusedError("has a `to_world` that scales; turn or mirror it only")
    names = ("turbidity", "sky_scale", "sun_scale")
    numbers = {name: number(fields[name], name) for name in names}
    direction = np.array(floats(fields["sun_direction"], 3, "sun_direction"))
    sky: Any = mi.load_dict(
        {
            "type": "sunsky",
            "to_world": mi.ScalarTransform4f(to_world.tolist()),
            "sun_direction": direction.tolist(),
            "turbidity": numbers["turbidity"],
            "sky_scale": numbers["sky_scale"],
            "sun_scale": 0.0,
            "albedo": fields["albedo"],
        }
    )
    # The image's own axes: y is up.
    turned = linear @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])

    def directions(x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float64]:
        """World directions of columns and rows; the last row is just above the horizon."""
        phi = 2 * np.pi * (x + 0.5) / SKY_WIDTH
        up = np.maximum(np.pi / 2 * (1 - y / (SKY_HEIGHT - 1)) ** 2, 1e-6)
        local = [np.sin(phi) * np.cos(up), np.sin(up), -np.cos(phi) * np.cos(up)]
        return np.stack(np.broadcast_arrays(*local), -1).reshape(-1, 3) @ turned.T

    column, row = np.arange(SKY_WIDTH)[None, :], np.arange(SKY_HEIGHT)[:, None]
    texels = _radiance(sky, directions(column, row)).reshape(SKY_HEIGHT, SKY_WIDTH, 3)
    # Where bilinear interpolation is at its worst: between four texels, on a coarse grid of places.
    x, y = np.meshgrid(np.arange(3, SKY_WIDTH - 1, 17), np.arange(0, SKY_HEIGHT - 1, 5))
    corners = [texels[y + j, x + i] for i in (0, 1) for j in (0, 1)]
    between = np.mean(corners, axis=0).reshape(-1, 3)
    there = _radiance(sky, directions(x + 0.5, y + 0.5))
    if there.max() > 0:
        error = np.abs(between - there).max(axis=1) / np.maximum(there.max(axis=1), 1e-6)
        walk.notes.append(
            f'"{where}": the sky is an image of {SKY_WIDTH}×{SKY_HEIGHT} values of Mitsuba\'s; '
            f"between them its radiance is off by {error.mean():.2%} on average, {error.max():.1%} at the most"
        )

    weight = _sampling_weight(obj)
    up = 1 - row / (SKY_HEIGHT - 1)
    power = float((texels @ LUMINANCE * np.cos(np.pi / 2 * up**2) * up).mean()) * 2 * np.pi**2
    if numbers["sun_scale"] > 0 and (linear.T @ direction)[2] > 0:
        sun = _sun(obj, sky, direction, linear[:, 2])
        middle = np.array(sun["radiance"]).mean(axis=0)
        sun_power = float(middle @ LUMINANCE) * np.pi * sun["half_angle"] ** 2
        share = float(np.clip(sun_power / max(sun_power + power, 1e-30), 0.1, 0.9))
        sun |= {"type": "sun", "id": f"{where}.sun", "sampling_weight": weight * share}
        walk.entries["sun"].append(sun)
        weight *= 1 - share
    return {
        "data": walk.add_array(np.ascontiguousarray(texels, np.float32)),
        "scale": 1.0,
        "to_world": np.block([[turned, np.zeros((3, 1))], [np.eye(4)[3:]]]).ravel().tolist(),
        "upper_half": True,
        "sampling_weight": weight,
    }


def _sun(obj: Any, sky: Any, direction: NDArray[np.float64], up: NDArray[np.float64]) -> Entry:
    """The sun of a `sunsky`: its size, and its radiance from the centre to the rim."""
    axis = direction / np.linalg.norm(direction)
    # Away from the horizon, so that the whole radius is lit.
    away = up - axis * (axis @ up)
    if np.linalg.norm(away) < 1e-3:
        away = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    away /= np.linalg.norm(away)

    def excess(angles: NDArray[np.float64]) -> NDArray[np.float64]:
        d: NDArray[Any] = np.cos(angles)[:, None] * axis + np.sin(angles)[:, None] * away
        return _radiance(obj, d) - _radiance(sky, d)

    # Shown nowhere else; where its light ends is blurred by more than six digits.
    aperture = printed(obj).get("Sun aperture", "")
    try:
        half_angle = np.deg2rad(float(aperture)) / 2
    except ValueError:
        raise RefusedError(f'has a `sun_aperture` that cannot be read: "{aperture}"') from None
    angles = half_angle * np.linspace(0, 0.995, SUN_RINGS)
    radiance = excess(angles)
    if np.ptp(radiance, axis=0).max() <= 1e-3 * radiance.max():
        radiance = radiance.mean(axis=0, keepdims=True)
    return {
        "direction": axis.tolist(),
        "up": up.tolist(),
        "half_angle": float(half_angle),
        "radiance": radiance.tolist(),
    }


def _radiance(obj: Any, directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """What an emitter at infinity shows in world directions (n, 3)."""
    if is_scalar():
        si = mi.SurfaceInteraction3f()
        values = np.empty(directions.shape)
        for i, d in enumerate((-directions).tolist()):
            si.wi = mi.Vector3f(d)
            values[i] = obj.eval(si)
        return values
    si = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    si.wi = mi.Vector3f(np.ascontiguousarray(-directions.T, np.float32))
    return np.array(dr.detach(obj.eval(si)), np.float64).T


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
        "sampling_weight": _sampling_weight(obj),
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
        "sampling_weight": _sampling_weight(obj),
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
    "SunskyEmitter": Converter("sunsky", "envmap", _sunsky),
}


def _unit(direction: NDArray[np.float64]) -> list[float]:
    """A direction of a `to_world`, whose length must be 1 because Mitsuba takes it for that."""
    if abs(np.linalg.norm(direction) - 1) > LENGTH_TOLERANCE:
        raise RefusedError("has a `to_world` that scales; turn, move or mirror it only")
    return direction.tolist()


def _sampling_weight(obj: Any) -> float:
    return number(obj.sampling_weight(), "sampling_weight")
