"""Textures and spectra: constants, bitmaps, boards, and attributes of meshes.

In the RGB variants Mitsuba turns the emission spectra of a scene file into these before we see them: `d65` becomes
`uniform`, `srgb` or the bitmap that it nests.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .walk import (
    SWITCH,
    Converter,
    Entry,
    Fields,
    RefusedError,
    Walk,
    floats,
    is_scalar,
    matrix,
    number,
    printed,
    switch,
)

Texels = NDArray[np.float32]
"""Shape (height, width, channels), linear values."""

BLOCK_ROWS = 64
"""Rows of a bitmap that a search looks at together: enough for numpy, and small beside the bitmap."""

_BYTES = np.arange(256) / 255.0

CURVES = {
    "linear": _BYTES,
    "srgb": np.where(_BYTES <= 0.04045, _BYTES / 12.92, ((_BYTES + 0.055) / 1.055) ** 2.4),
}
"""What each byte of a bitmap stands for, by its encoding."""

NOTICEABLE = 1e-3
"""Differences below this share of a bitmap's largest value are taken for none when modes are told apart."""


def export_texture(walk: Walk, obj: Any, where: str) -> int:
    """Index of a texture in the description."""
    return walk.shared(TEXTURES, "texture", obj, where)


def constant_value(walk: Walk, obj: Any, where: str) -> list[float]:
    """RGB of a texture that must be constant, as those of lights without a surface must."""
    entry = walk.convert(TEXTURES, "texture", obj, where)
    if entry is None:  # already refused, under its own name
        return [0.0, 0.0, 0.0]
    if entry["type"] != "constant":
        raise RefusedError("needs a constant spectrum")
    return entry["value"]


def _constant(_walk: Walk, obj: Any, _where: str) -> Entry:
    value = Fields(obj)["value"]
    numbers = np.asarray(dr.detach(value)).size
    rgb = floats(value, 3, "value") if numbers == 3 else [number(value, "value")] * 3
    return {"value": rgb}


def _bitmap(walk: Walk, obj: Any, _where: str) -> Entry:
    fields = Fields(obj)
    to_uv = np.reshape(matrix(fields["to_uv"], "to_uv"), (3, 3))
    stored = dr.detach(fields["data"]).numpy()
    if stored.ndim != 3 or stored.shape[2] not in (1, 3) or stored.size == 0:
        raise RefusedError(f"has data of shape {stored.shape}, expected (height, width, 1 or 3)")
    look_up = _Probe(obj, to_uv, stored.shape)

    encoding = "linear"
    if stored.dtype == np.uint8:
        # Bytes stay bytes, a quarter of the memory; what they stand for is only looked at here.
        data = np.ascontiguousarray(stored)
        encoding = _encoding(stored, obj, look_up)
        texels = CURVES[encoding].astype(np.float32)[stored]
    else:
        data = texels = np.ascontiguousarray(stored, np.float32)
    filter_type, wrap = _modes(texels, look_up)
    return {
        "data": walk.add_array(data),
        "encoding": encoding,
        "to_uv": to_uv.ravel().tolist(),
        "wrap": wrap,
        "filter": filter_type,
        "mean": number(obj.mean(), "mean"),
    }


def _checkerboard(walk: Walk, obj: Any, where: str) -> Entry:
    fields = Fields(obj)
    entry: Entry = {"to_uv": matrix(fields["to_uv"], "to_uv")}
    for name in ("color0", "color1"):
        # Its own: the board holds its two textures, and shares neither.
        child = walk.convert(TEXTURES, "texture", fields[name], f"{where}.{name}")
        entry[name] = child
    return entry


def _mesh_attribute(_walk: Walk, obj: Any, _where: str) -> Entry:
    return {
        "name": printed(obj).get("name", "").strip('"'),
        "scale": number(Fields(obj)["scale"], "scale"),
    }


TEXTURES: dict[str, Converter] = {
    "Checkerboard": Converter("checkerboard", "checkerboard", _checkerboard),
    "SRGBReflectanceSpectrum": Converter("srgb", "constant", _constant),
    "MeshAttribute": Converter("mesh_attribute", "mesh_attribute", _mesh_attribute),
    "UniformSpectrum": Converter("uniform", "constant", _constant),
    "RawConstantTexture": Converter("rawconstant", "constant", _constant),
    "BitmapTextureImpl": Converter("bitmap", "bitmap", _bitmap),
}


# What Mitsuba does not tell about a bitmap: found by looking up a few points and comparing with each possible answer.


class _Probe:
    """Looks a bitmap up in texel coordinates: texel (x, y) covers [x, x+1) × [y, y+1), outside of the bitmap too."""

    def __init__(self, obj: Any, to_uv: NDArray[np.float64], shape: tuple[int, ...]) -> None:
        self._obj = obj
        self._shape = shape
        self._to_uv = to_uv

    def __call__(self, points: list[tuple[float, float]]) -> NDArray[np.float64]:
        """Values (n, channels) at the points (x, y)."""
        height, width, channels = self._shape
        try:
            inverse = np.linalg.inv(self._to_uv)
        except np.linalg.LinAlgError:
            raise RefusedError(f"has a `to_uv` that is singular: {self._to_uv.tolist()}") from None
        uv = np.array(points, np.float64) / [width, height]
        uv = uv @ inverse[:2, :2].T + inverse[:2, 2]

        if is_scalar():
            values = np.array([self._look_up_one(u, v) for u, v in uv])
        else:
            si = dr.zeros(mi.SurfaceInteraction3f, len(points))
            si.uv = mi.Point2f(uv.T.astype(np.float32))
            values = np.array(dr.detach(self._obj.eval(si))).T
        return values[:, :channels].astype(np.float64)

    def _look_up_one(self, u: float, v: float) -> NDArray[np.float32]:
        si = mi.SurfaceInteraction3f()
        si.uv = mi.Point2f(u, v)
        return np.array(self._obj.eval(si))


def _encoding(stored: NDArray[np.uint8], obj: Any, look_up: _Probe) -> str:
    """What the bytes stand for that Mitsuba keeps and decodes at each look-up, before it filters: a key of `CURVES`."""
    if switch(printed(obj), "raw", SWITCH):
        return "linear"
    # Bitmaps from memory may be linear without being `raw`. The two curves differ most near .4.
    y, x, c = np.unravel_index(np.argmin(np.abs(stored.astype(np.int16) - 110)), stored.shape)
    byte = stored[y, x, c]
    value = look_up([(x + 0.5, y + 0.5)])[0, c]
    return min(CURVES, key=lambda name: abs(value - CURVES[name][byte]))


def _modes(texels: Texels, look_up: _Probe) -> tuple[str, str]:
    """A bitmap's filter and wrap mode.

    Where all modes give the same image (a bitmap of one colour, a symmetric one), any of them is returned.
    """
    height, width, _ = texels.shape
    scale = float(max(texels.max(), -texels.min()))
    if not np.isfinite(scale):
        return "bilinear", "repeat"  # the renderer refuses it by name

    filter_points: list[_Point] = []
    for axis in (1, 0):
        if found := _largest(texels, scale, lambda d, axis=axis: np.diff(d, axis=axis), along=axis):
            y, x = found
            step = (0.25, 0.0) if axis == 1 else (0.0, 0.25)
            near, far = texels[y, x], texels[y + (axis == 0), x + (axis == 1)]
            answers = {"nearest": near, "bilinear": 0.75 * near + 0.25 * far}
            filter_points = [((x + 0.5 + step[0], y + 0.5 + step[1]), answers)]
            break

    # One step beyond the last column: `repeat` starts anew, `mirror` turns round, `clamp` stays. Likewise for rows.
    wrap_points: list[_Point] = []
    for axis in (1, 0):
        last = texels.shape[axis] - 1
        for differ in (
            lambda d, axis=axis: d - np.take(d, [-1], axis),  # repeat from clamp
            lambda d, axis=axis: np.flip(d, axis) - np.take(d, [-1], axis),  # mirror from clamp
            lambda d, axis=axis: d - np.flip(d, axis),  # repeat from mirror
        ):
            if found := _largest(texels, scale, differ, along=axis):
                y, x = found
                if axis == 1:
                    point = (x + 0.5 + width, y + 0.5)
                    mirrored, clamped = texels[y, last - x], texels[y, last]
                else:
                    point = (x + 0.5, y + 0.5 + height)
                    mirrored, clamped = texels[last - y, x], texels[last, x]
                answers = {"repeat": texels[y, x], "mirror": mirrored, "clamp": clamped}
                wrap_points.append((point, answers))

    values = look_up([point for point, _ in filter_points + wrap_points]) if wrap_points else None
    if values is None:
        return "bilinear", "repeat"
    split = len(filter_points)
    return (
        _nearest_answer("filter_type", filter_points, values[:split], scale) or "bilinear",
        _nearest_answer("wrap_mode", wrap_points, values[split:], scale) or "repeat",
    )


_Point = tuple[tuple[float, float], dict[str, Texels]]
"""Where to look a bitmap up, and what each mode would give there."""


def _largest(
    texels: Texels, scale: float, differ: Callable[[Texels], Texels], *, along: int
) -> tuple[int, int] | None:
    """Row and column of a texel where `differ` is largest, or large enough; None where it is nowhere noticeable.

    Goes through the bitmap in blocks that are whole along the axis `differ` works on, and stops early.
    """
    across = 1 - along
    best, place = NOTICEABLE * scale, None
    for start in range(0, texels.shape[across], BLOCK_ROWS):
        part = slice(start, start + BLOCK_ROWS)
        block = texels[part] if across == 0 else texels[:, part]
        size = np.abs(differ(block))
        if size.size == 0:
            continue
        y, x, c = np.unravel_index(np.argmax(size), size.shape)
        if size[y, x, c] > best:
            best = float(size[y, x, c])
            place = (int(y) + start * (across == 0), int(x) + start * (across == 1))
            if best > 0.1 * scale:
                break
    return place


def _nearest_answer(
    name: str, points: list[_Point], values: NDArray[np.float64], scale: float
) -> str | None:
    """The mode whose answers come nearest to the values; None without points."""
    if not points:
        return None
    modes = points[0][1]
    errors = {
        mode: max(
            np.abs(value - answers[mode]).max()
            for (_, answers), value in zip(points, values, strict=True)
        )
        for mode in modes
    }
    best = min(errors, key=lambda mode: errors[mode])
    # Look-ups at texel centres are exact up to the rounding of uv, which is below a hundredth of a texel.
    if not errors[best] <= 0.02 * scale:
        raise RefusedError(
            f"has a `{name}` that cannot be told from its values; is `to_uv` extreme?"
        )
    return best
