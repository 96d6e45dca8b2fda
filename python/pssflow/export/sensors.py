"""The sensor and its film. To add one: a converter and a row in `SENSORS` or `FILMS`."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from .walk import Converter, Entry, Fields, RefusedError, Walk, class_of, is_scalar, matrix, number

FILTER_SAMPLES = 1025
"""Samples of a reconstruction filter over [0, radius]: linear interpolation between them is exact to 1e-6."""

RFILTERS = {
    "BoxFilter": "box",
    "TentFilter": "tent",
    "GaussianFilter": "gaussian",
    "MitchellNetravaliFilter": "mitchell",
    "CatmullRomFilter": "catmullrom",
    "LanczosSincFilter": "lanczos",
}
"""Names only: any other filter is exported by its values, under its class."""


def select_sensor(scene: Any, sensor: Any) -> Any:
    """The sensor of an index, or a sensor object as it is.

    Raises:
        ValueError: the scene has no such sensor.
    """
    if not isinstance(sensor, (int, np.integer)):
        return sensor
    count = len(scene.sensors())
    if not 0 <= sensor < count:
        rule = (
            f"expected 0 ≤ sensor < {count}" if count else "the scene has none; add a sensor to it"
        )
        raise ValueError(f"`sensor` = {sensor}: {rule}")
    return scene.sensors()[sensor]


def export_sensor(walk: Walk, sensor: Any) -> tuple[Entry | None, Entry | None]:
    """The entries of a sensor and its film; None for what was refused."""
    where = sensor.id() or "sensor"
    entry = walk.convert(SENSORS, "sensor", sensor, where)
    film = walk.convert(FILMS, "film", sensor.film(), f"{where}.film")
    # There is one of each: nothing refers to them by name.
    return (
        None if entry is None else {k: v for k, v in entry.items() if k != "id"},
        None if film is None else {k: v for k, v in film.items() if k not in ("id", "type")},
    )


def _perspective(_walk: Walk, obj: Any, _where: str) -> Entry:
    fields = Fields(obj)
    names = ("principal_point_offset_x", "principal_point_offset_y")
    return {
        "to_world": matrix(fields["to_world"], "to_world"),
        "x_fov": number(fields["x_fov"], "x_fov"),
        "near_clip": number(fields["near_clip"], "near_clip"),
        "far_clip": number(fields["far_clip"], "far_clip"),
        "principal_point_offset": [number(fields[name], name) for name in names],
    }


def _orthographic(_walk: Walk, obj: Any, _where: str) -> Entry:
    return {
        "to_world": matrix(Fields(obj)["to_world"], "to_world"),
        "near_clip": number(obj.near_clip(), "near_clip"),
        "far_clip": number(obj.far_clip(), "far_clip"),
    }


def _thinlens(_walk: Walk, obj: Any, _where: str) -> Entry:
    fields = Fields(obj)
    names = ("x_fov", "near_clip", "far_clip", "aperture_radius", "focus_distance")
    numbers = {name: number(fields[name], name) for name in names}
    return {"to_world": matrix(fields["to_world"], "to_world"), **numbers}


def _hdrfilm(walk: Walk, obj: Any, where: str) -> Entry:
    if obj.sample_border():
        walk.notes.append(
            f'"{where}": `sample_border` is ignored; pixels at the edge take samples from inside the crop window only'
        )
    return {
        "size": _pixels(obj.size()),
        "crop_offset": _pixels(obj.crop_offset()),
        "crop_size": _pixels(obj.crop_size()),
        "rfilter": _rfilter(obj.rfilter()),
    }


SENSORS: dict[str, Converter] = {
    "OrthographicCamera": Converter("orthographic", "orthographic", _orthographic),
    "PerspectiveCamera": Converter("perspective", "perspective", _perspective),
    "ThinLensCamera": Converter("thinlens", "thinlens", _thinlens),
}

FILMS: dict[str, Converter] = {
    "HDRFilm": Converter("hdrfilm", "hdrfilm", _hdrfilm),
}


def _pixels(value: Any) -> list[int]:
    return [int(x) for x in value]


def _rfilter(rfilter: Any) -> Entry:
    """A filter by its values; they need not be normalised, as a film divides by their sum."""
    radius = number(rfilter.radius(), "radius")
    x = np.linspace(0, radius, FILTER_SAMPLES, dtype=np.float32)
    if is_scalar():
        table = np.array([rfilter.eval(float(position)) for position in x])
    else:
        table = np.array(rfilter.eval(mi.Float(x)))
    if table.shape != x.shape or not np.isfinite(table).all():
        raise RefusedError(f'has a reconstruction filter "{class_of(rfilter)}" that is not finite')
    return {
        "type": RFILTERS.get(class_of(rfilter), class_of(rfilter)),
        "radius": radius,
        "table": table.tolist(),
    }
