"""Parts that the cases' scenes are made of: a room, lamps, a camera. Lengths are in Mitsuba's units, z is up.

Set a Mitsuba variant before calling them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mitsuba as mi

__all__ = [
    "CAMERA_AT",
    "CAMERA_TO",
    "area",
    "box",
    "camera",
    "diffuse",
    "film",
    "lamp",
    "rgb",
    "room",
    "sphere",
    "square",
    "twosided",
]

Description = dict[str, Any]
Triple = tuple[float, float, float]

CAMERA_AT: Triple = (0.0, -0.9, 0.0)
CAMERA_TO: Triple = (0.0, 1.0, -0.3)


def rgb(*values: float) -> Description:
    """A colour; grey from one number."""
    return {"type": "rgb", "value": list(values * 3 if len(values) == 1 else values)}


def diffuse(*values: float) -> Description:
    """A diffuse BSDF."""
    return {"type": "diffuse", "reflectance": rgb(*values)}


def twosided(bsdf: Description) -> Description:
    """The same from both sides."""
    return {"type": "twosided", "bsdf": bsdf}


def area(*values: float) -> Description:
    """An area emitter, W·sr⁻¹·m⁻²."""
    return {"type": "area", "radiance": rgb(*values)}


def film(width: int, height: int | None = None) -> Description:
    """A float32 RGB film with the box filter, for which the estimate is exactly unbiased."""
    return {
        "type": "hdrfilm",
        "width": width,
        "height": width if height is None else height,
        "pixel_format": "rgb",
        "component_format": "float32",
        "rfilter": {"type": "box"},
    }


def camera(
    side: int | tuple[int, int],
    origin: Triple = CAMERA_AT,
    target: Triple = CAMERA_TO,
    fov: float = 70.0,
    **more: Any,
) -> Description:
    """A pinhole camera."""
    size = (side, side) if isinstance(side, int) else side
    view = mi.ScalarTransform4f().look_at(origin=list(origin), target=list(target), up=[0, 0, 1])
    return {"type": "perspective", "fov": fov, "to_world": view, "film": film(*size), **more}


def square(place: Triple, normal: Triple, half: float | tuple[float, float]) -> Description:
    """A rectangle with its normal and half its sides."""
    T = mi.ScalarTransform4f
    up = [0, 0, 1] if abs(normal[2]) < 0.9 else [0, 1, 0]
    target = [p + n for p, n in zip(place, normal, strict=True)]
    turned = T().look_at(origin=list(place), target=target, up=up)
    x, y = (half, half) if isinstance(half, (int, float)) else half
    return {"type": "rectangle", "to_world": turned @ T().scale([x, y, 1.0])}


def lamp(
    place: Triple, normal: Triple, half: float | tuple[float, float], *radiance: float
) -> Description:
    """A square that shines to one side and reflects nothing."""
    return {**square(place, normal, half), "bsdf": diffuse(0.0), "light": area(*radiance)}


def sphere(center: Sequence[float], radius: float, bsdf: Description) -> Description:
    """A ball."""
    return {"type": "sphere", "center": list(center), "radius": radius, "bsdf": bsdf}


def box(bsdf: Description, half: float = 1.0, center: Triple = (0.0, 0.0, 0.0)) -> Description:
    """A closed cube; seen from both sides with a two-sided BSDF."""
    T = mi.ScalarTransform4f
    return {"type": "cube", "to_world": T().translate(list(center)).scale(half), "bsdf": bsdf}


def room(side: int | tuple[int, int], **objects: Any) -> Description:
    """A closed grey room of side 2 around the origin, seen from its front wall, with a lamp on the ceiling unless
    `lamp` says otherwise.
    """
    scene: Description = {
        "type": "scene",
        "camera": camera(side),
        "walls": box(twosided(diffuse(0.6, 0.55, 0.5))),
        "ball": sphere((0.4, 0.2, -0.65), 0.35, twosided(diffuse(0.4, 0.5, 0.7))),
        "lamp": lamp((0.0, 0.2, 0.98), (0.0, 0.0, -1.0), 0.25, 10.0),
    }
    scene.update(objects)
    return {name: part for name, part in scene.items() if part is not None}
