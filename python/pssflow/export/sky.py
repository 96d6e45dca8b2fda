"""`sunsky` and `timed_sunsky`: baked through Mitsuba's own evaluation, sky and sun as two emitters.

The sky becomes an image of the upper half, at an error that a note states. The sun that stands still becomes a disc
behind all other emitters; the sun of a sky that is averaged over a shutter becomes a second image, of its tracks.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .shapes import checked_matrix
from .walk import (
    SWITCH,
    Entry,
    Fields,
    RefusedError,
    Walk,
    floats,
    is_scalar,
    number,
    printed,
    sampling_weight,
    switch,
)

F64 = NDArray[np.float64]
Radiance = Callable[[F64], F64]
"""World directions (n, 3) to radiance (n, 3)."""

LENGTH_TOLERANCE = 1e-3
"""By how much a direction's length may miss 1 in a light's `to_world`: Mitsuba does not normalise there."""

SKY_WIDTH, SKY_HEIGHT = 512, 201
"""Size of the image that a sky becomes: a degree a texel or less, and rows that crowd at the horizon."""

SUN_RINGS = 17
"""Values of a sun's radiance between its centre and its rim, where it is not the same all over."""

SUN_TURNS = 16
"""Places around each ring."""

SKY_TIMES = 256
"""Moments that a sky is averaged over, evenly spaced in the shutter's opening."""

SUN_TIMES, SUN_POINTS = 16384, 64
"""Moments of a moving sun, and points of its disc at each."""

TRACK_WIDTH, TRACK_HEIGHT = 2048, 513
"""Size of the image of its tracks: a sixth of a degree a texel."""

LUMINANCE = np.array([0.212671, 0.715160, 0.072169], np.float32)
"""Weights of linear sRGB, Mitsuba's."""


def export_sunsky(walk: Walk, obj: Any, where: str, _shape: Any, _index: int | None) -> Entry:
    """Both parts are Mitsuba's own values: of a sky like this one without a sun, and of what this one has more."""
    fields = Fields(obj)
    to_world, turned = _axes(fields)
    direction = np.array(floats(fields["sun_direction"], 3, "sun_direction"))
    bare: Any = mi.load_dict(
        {
            "type": "sunsky",
            "to_world": mi.ScalarTransform4f(to_world.tolist()),
            "sun_direction": direction.tolist(),
            "turbidity": number(fields["turbidity"], "turbidity"),
            "sky_scale": number(fields["sky_scale"], "sky_scale"),
            "sun_scale": 0.0,
            "albedo": fields["albedo"],
        }
    )
    image = _image(walk, where, turned, lambda d: _radiance(bare, d))
    up, sun = to_world[:3, 2], None
    if number(fields["sun_scale"], "sun_scale") > 0 and (to_world[:3, :3].T @ direction)[2] > 0:
        sun = _sun(
            _half_angle(obj), lambda d: _radiance(obj, d) - _radiance(bare, d), direction, up
        )
    return _two(walk, obj, where, turned, image, sun)


def export_timed_sunsky(walk: Walk, obj: Any, where: str, _shape: Any, _index: int | None) -> Entry:
    """The mean of the sky over the time that the sensor's shutter is open; one moment where it is open for none."""
    fields = Fields(obj)
    to_world, turned = _axes(fields)
    start, length = walk.shutter
    if length > 0 and is_scalar():
        raise RefusedError(
            "moves while the sensor's shutter is open, whose mean is too slow to find in scalar variants; "
            "use `llvm_ad_rgb`, or a shutter that opens for no time"
        )
    bare, sun_alone = (
        _timed(obj, fields, to_world, sun=False),
        _timed(obj, fields, to_world, sky=False),
    )
    moments = start + length * (np.arange(SKY_TIMES if length > 0 else 1) + 0.5) / SKY_TIMES
    moments = moments if length > 0 else np.array([start])

    def sky(directions: F64) -> F64:
        return np.mean([_radiance(bare, directions, float(t)) for t in moments], axis=0)

    image = _image(walk, where, turned, sky)
    if length > 0:
        walk.notes.append(
            f'"{where}": sky and sun are means of {SKY_TIMES} and {SUN_TIMES} moments of the shutter\'s opening'
        )
    sun = None
    if number(fields["sun_scale"], "sun_scale") > 0:
        count = SUN_TIMES if length > 0 else 1
        times = start + length * (np.arange(count) + 0.5) / count if length > 0 else moments
        directions, lit = _sun_directions(obj, sun_alone, times)
        lit &= directions @ to_world[:3, 2] > 0
        half_angle = _half_angle(obj)
        if length > 0:
            sun = _tracks(walk, sun_alone, times, directions, lit, half_angle, turned)
        elif lit[0]:
            sun = _sun(
                half_angle,
                lambda d: _radiance(sun_alone, d, start),
                directions[0],
                to_world[:3, 2],
            )
    return _two(walk, obj, where, turned, image, sun)


def _axes(fields: Fields) -> tuple[F64, F64]:
    """`to_world` (4, 4), and the axes of the image (3, 3), whose y is up."""
    to_world = np.reshape(checked_matrix(fields["to_world"]), (4, 4))
    linear = to_world[:3, :3]
    if np.abs(linear.T @ linear - np.eye(3)).max() > LENGTH_TOLERANCE:
        raise RefusedError("has a `to_world` that scales; turn or mirror it only")
    return to_world, linear @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def _timed(obj: Any, fields: Fields, to_world: F64, *, sky: bool = True, sun: bool = True) -> Any:
    """A `timed_sunsky` like this one, with or without its sky and its sun."""
    shown = printed(obj)
    reals = (
        "turbidity",
        "latitude",
        "longitude",
        "timezone",
        "window_start_time",
        "window_end_time",
    )
    whole = [f"{end}_{unit}" for end in ("start", "end") for unit in ("year", "month", "day")]
    return mi.load_dict(
        {
            "type": "timed_sunsky",
            "to_world": mi.ScalarTransform4f(to_world.tolist()),
            **{name: number(fields[name], name) for name in reals},
            **{name: int(number(fields[name], name)) for name in whole},
            "sky_scale": number(fields["sky_scale"], "sky_scale") if sky else 0.0,
            "sun_scale": number(fields["sun_scale"], "sun_scale") if sun else 0.0,
            "sun_aperture": float(np.rad2deg(2 * _half_angle(obj))),
            "complex_sun": switch(shown, "Complex sun model", SWITCH),
            "albedo": fields["albedo"],
        }
    )


def _grid(width: int, height: int, x: Any, y: Any) -> F64:
    """Directions (n, 3) of columns and rows in an image's own axes; the last row is just above the horizon."""
    phi = 2 * np.pi * (x + 0.5) / width
    up = np.maximum(np.pi / 2 * (1 - y / (height - 1)) ** 2, 1e-6)
    local = [np.sin(phi) * np.cos(up), np.sin(up), -np.cos(phi) * np.cos(up)]
    return np.stack(np.broadcast_arrays(*local), -1).reshape(-1, 3)


def _image(walk: Walk, where: str, turned: F64, radiance: Radiance) -> NDArray[np.float32]:
    """A sky as an image (SKY_HEIGHT, SKY_WIDTH, 3), and a note of its error."""

    def at(x: Any, y: Any) -> F64:
        return radiance(_grid(SKY_WIDTH, SKY_HEIGHT, x, y) @ turned.T)

    column, row = np.arange(SKY_WIDTH)[None, :], np.arange(SKY_HEIGHT)[:, None]
    texels = at(column, row).reshape(SKY_HEIGHT, SKY_WIDTH, 3)
    # Where bilinear interpolation is at its worst: between four texels, on a coarse grid of places.
    x, y = np.meshgrid(np.arange(3, SKY_WIDTH - 1, 17), np.arange(0, SKY_HEIGHT - 1, 5))
    corners = [texels[y + j, x + i] for i in (0, 1) for j in (0, 1)]
    between = np.mean(corners, axis=0).reshape(-1, 3)
    there = at(x + 0.5, y + 0.5)
    if there.max() > 0:
        error = np.abs(between - there).max(axis=1) / np.maximum(there.max(axis=1), 1e-6)
        walk.notes.append(
            f'"{where}": the sky is an image of {SKY_WIDTH}×{SKY_HEIGHT} values of Mitsuba\'s; '
            f"between them its radiance is off by {error.mean():.2%} on average, {error.max():.1%} at the most"
        )
    return np.ascontiguousarray(texels, np.float32)


def _power(texels: NDArray[Any]) -> float:
    """Luminance of an image over the upper half, integrated over solid angle."""
    height = texels.shape[0]
    up = 1 - np.arange(height)[:, None] / (height - 1)
    return float((texels @ LUMINANCE * np.cos(np.pi / 2 * up**2) * up).mean()) * 2 * np.pi**2


def _two(
    walk: Walk, obj: Any, where: str, turned: F64, image: NDArray[np.float32], sun: Entry | None
) -> Entry:
    """The sky's entry; the sun's, if there is one, is left with the walk. Each is drawn as often as it is bright."""
    weight, power = sampling_weight(obj), _power(image)
    if sun is not None:
        sun_power = sun.pop("power")
        share = float(np.clip(sun_power / max(sun_power + power, 1e-30), 0.1, 0.9))
        walk.entries["sun"].append({"id": f"{where}.sun", "sampling_weight": weight * share, **sun})
        walk.suns.append(obj)
        weight *= 1 - share
    return {"data": walk.add_array(image), **_upper_half(turned), "sampling_weight": weight}


def _upper_half(turned: F64) -> Entry:
    """What the images of skies share."""
    to_world = np.block([[turned, np.zeros((3, 1))], [np.eye(4)[3:]]])
    return {"scale": 1.0, "to_world": to_world.ravel().tolist(), "upper_half": True}


def _half_angle(obj: Any) -> float:
    """The sun's, in radians. Shown nowhere else; where its light ends is blurred by more than six digits."""
    aperture = printed(obj).get("Sun aperture", "").strip("[]")
    try:
        return float(np.deg2rad(float(aperture)) / 2)
    except ValueError:
        raise RefusedError(f'has a `sun_aperture` that cannot be read: "{aperture}"') from None


def _sun(half_angle: float, excess: Radiance, direction: F64, up: F64) -> Entry:
    """A sun that stands still: its size, and its radiance from the centre to the rim."""
    axis = direction / np.linalg.norm(direction)
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    rings = half_angle * np.linspace(0, 0.995, SUN_RINGS)
    # The mean around each ring: a wide sun is redder towards the horizon.
    turns: F64 = 2 * np.pi * np.arange(SUN_TURNS) / SUN_TURNS
    around = np.cos(turns)[:, None] * side + np.sin(turns)[:, None] * other
    d: NDArray[Any] = np.cos(rings)[:, None, None] * axis + np.sin(rings)[:, None, None] * around
    found = excess(d.reshape(-1, 3)).reshape(*d.shape)
    seen = (d @ up > 0)[..., None]
    radiance = (found * seen).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
    if np.ptp(radiance, axis=0).max() <= 1e-3 * radiance.max():
        radiance = radiance.mean(axis=0, keepdims=True)
    return {
        "type": "sun",
        "direction": axis.tolist(),
        "up": up.tolist(),
        "half_angle": half_angle,
        "radiance": radiance.tolist(),
        "power": float(radiance.mean(axis=0) @ LUMINANCE) * np.pi * half_angle**2,
    }


def _sun_directions(obj: Any, sun: Any, times: F64) -> tuple[F64, NDArray[np.bool_]]:
    """Centre of the sun at each time, and whether it is up: the mean of what Mitsuba draws of it.

    `sun` shows the sun alone; a sky without any light of its own draws no sun either, and counts as one without it.
    """
    side = 16 if is_scalar() else 64 if len(times) == 1 else 8
    grid = (np.arange(side) + 0.5) / side
    u = np.stack(np.meshgrid(grid, grid), -1).reshape(-1, 2)
    if is_scalar():
        it: Any = mi.Interaction3f()
        it.time = float(times[0])
        d = np.array([obj.sample_direction(it, mi.Point2f(*pair))[0].d for pair in u.tolist()])
        lit = _radiance(sun, d, float(times[0])).max(axis=1) > 0
    else:
        each = np.repeat(times, len(u))
        it = dr.zeros(mi.Interaction3f, len(each))
        it.time = mi.Float(each.astype(np.float32))
        pairs = mi.Point2f(np.tile(u, (len(times), 1)).T.astype(np.float32))
        ds, _ = obj.sample_direction(it, pairs)
        d = np.array(dr.detach(ds.d), np.float64).T
        lit = _radiance(sun, d, each).max(axis=1) > 0
    lit = lit.reshape(len(times), -1)
    sums = np.where(lit[..., None], d.reshape(len(times), -1, 3), 0.0).sum(axis=1)
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    return sums / np.maximum(length, 1e-12), lit.any(axis=1)


def _tracks(
    walk: Walk,
    sun: Any,
    times: F64,
    directions: F64,
    lit: NDArray[np.bool_],
    half_angle: float,
    turned: F64,
) -> Entry | None:
    """A moving sun as an image of its mean: points of its disc at each moment, spread over the four nearest texels."""
    times, directions = times[lit], directions[lit]
    if not len(times):
        return None
    # Evenly spread over the disc (Vogel 1979).
    n = np.arange(SUN_POINTS) + 0.5
    radius, angle = half_angle * np.sqrt(n / SUN_POINTS), n * np.pi * (3 - np.sqrt(5))
    energy = np.zeros((TRACK_HEIGHT, TRACK_WIDTH, 3))
    side = np.cross(directions, np.eye(3)[np.argmin(np.abs(directions), axis=1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(directions, side)
    solid_angle = 4 * np.pi * np.sin(half_angle / 2) ** 2
    for r, phi in zip(radius, angle, strict=True):
        d = np.cos(r) * directions + np.sin(r) * (np.cos(phi) * side + np.sin(phi) * other)
        share = _radiance(sun, d, times) * (solid_angle / SUN_POINTS / len(lit))
        local = d @ turned
        above = local[:, 1] > 0
        local, share = local[above], share[above]
        x = np.arctan2(local[:, 0], -local[:, 2]) / (2 * np.pi) % 1.0 * TRACK_WIDTH - 0.5
        up = np.arcsin(np.clip(local[:, 1], 0, 1)) / (np.pi / 2)
        y = (1 - np.sqrt(up)) * (TRACK_HEIGHT - 1)
        column, row = np.floor(x).astype(int), np.minimum(np.floor(y).astype(int), TRACK_HEIGHT - 2)
        s, t = x - column, y - row
        for i, a in ((0, 1 - s), (1, s)):
            for j, b in ((0, 1 - t), (1, t)):
                np.add.at(energy, (row + j, (column + i) % TRACK_WIDTH), share * (a * b)[:, None])
    # Solid angle that a texel's tent integrates to.
    fine = (np.arange((TRACK_HEIGHT - 1) * 16) + 0.5) / 16
    up = np.pi / 2 * (1 - fine / (TRACK_HEIGHT - 1)) ** 2
    slope = np.pi * (1 - fine / (TRACK_HEIGHT - 1)) / (TRACK_HEIGHT - 1)
    band = np.cos(up) * slope / 16 * (2 * np.pi / TRACK_WIDTH)
    rows, part = np.floor(fine).astype(int), fine - np.floor(fine)
    omega = np.zeros(TRACK_HEIGHT)
    np.add.at(omega, rows, band * (1 - part))
    np.add.at(omega, rows + 1, band * part)
    texels = np.ascontiguousarray(energy / omega[:, None, None], np.float32)
    return {
        "type": "envmap",
        "data": walk.add_array(texels),
        **_upper_half(turned),
        "power": _power(texels),
    }


def _radiance(obj: Any, directions: F64, time: float | F64 = 0.0) -> F64:
    """What an emitter at infinity shows in world directions (n, 3), at one time or one each."""
    if is_scalar():
        si: Any = mi.SurfaceInteraction3f()
        si.time = float(time)
        values = np.empty(directions.shape)
        for i, d in enumerate((-directions).tolist()):
            si.wi = mi.Vector3f(d)
            values[i] = obj.eval(si)
        return values
    si = dr.zeros(mi.SurfaceInteraction3f, len(directions))
    si.wi = mi.Vector3f(np.ascontiguousarray(-directions.T, np.float32))
    si.time = mi.Float(np.broadcast_to(time, len(directions)).astype(np.float32))
    return np.array(dr.detach(obj.eval(si)), np.float64).T
