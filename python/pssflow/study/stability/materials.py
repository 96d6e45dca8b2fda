"""Cases whose difficulty is a surface or a number: glossy lobes, masks, scales, needles, tiny and wide films."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from .case import Case, Setting
from .parts import (
    CAMERA_AT,
    CAMERA_TO,
    Triple,
    area,
    camera,
    diffuse,
    lamp,
    room,
    sphere,
    square,
    twosided,
)

__all__ = ["EXTREMES", "GLOSSY", "SCALES"]

Description = dict[str, Any]


def _glossy(alpha: float) -> Any:
    def scene(side: int) -> Description:
        metal = {"type": "roughconductor", "alpha": alpha, "distribution": "ggx"}
        floor = {**square((0, 0, -0.99), (0, 0, 1), 1.0), "bsdf": twosided(metal)}
        return room(side, floor=floor, ball=sphere((0.4, 0.2, -0.6), 0.35, metal))

    return scene


def _masked(side: int) -> Description:
    """Screens full of holes between lamp and floor."""
    holes = (np.indices((8, 8)).sum(axis=0) % 2).astype(np.float32)[..., None]
    opacity = {"type": "bitmap", "bitmap": mi.Bitmap(holes), "raw": True, "filter_type": "nearest"}
    leaf = {"type": "mask", "opacity": opacity, "nested": twosided(diffuse(0.5))}
    screens = {
        f"screen-{i}": {**square((0, 0.2, z), (0, 0, 1), 0.7), "bsdf": leaf}
        for i, z in enumerate((0.6, 0.3))
    }
    return room(side, **screens)


GLOSSY = Case(
    9,
    "glossy-and-masks",
    "Glossy surfaces and masks",
    "Lobes as narrow as α = .01 turn with the view, so that a cell or a pixel says little; masks let light "
    "through in patterns that no smooth density follows.",
    (
        Setting("α = .1", _glossy(0.1)),
        Setting("α = .01", _glossy(0.01)),
        Setting("masks", _masked),
    ),
    picture=True,
)


def _placed(factor: float, offset: float) -> Any:
    """The plain room `factor` times as large, moved diagonally away from the origin."""

    def scene(side: int) -> Description:
        T = mi.ScalarTransform4f
        away = [offset, -offset, offset]
        by = T().translate(away).scale(factor)
        moved = dict(room(side))
        for name, part in moved.items():
            if name == "camera" or not isinstance(part, dict):
                continue
            if "to_world" in part:
                moved[name] = {**part, "to_world": by @ part["to_world"]}
            elif part.get("type") == "sphere":
                own = T().translate(part["center"]).scale(part["radius"])
                rest = {k: v for k, v in part.items() if k not in ("center", "radius")}
                moved[name] = {**rest, "to_world": by @ own}

        # A camera's transform may hold no scale.
        def moved_point(point: Triple) -> Triple:
            x, y, z = (a + factor * c for a, c in zip(away, point, strict=True))
            return x, y, z

        clip = {"near_clip": 1e-3 * factor, "far_clip": 1e3 * factor}
        moved["camera"] = camera(side, moved_point(CAMERA_AT), moved_point(CAMERA_TO), **clip)
        return moved

    return scene


def _power(watt: float) -> Any:
    def scene(side: int) -> Description:
        half = 0.25
        radiance = watt / (np.pi * (2 * half) ** 2)
        return room(side, lamp=lamp((0.0, 0.2, 0.98), (0.0, 0.0, -1.0), half, float(radiance)))

    return scene


def _needles(side: int) -> Description:
    """Triangles ten thousand times as long as wide, and two floors in one place."""
    T = mi.ScalarTransform4f
    needles: Description = {
        f"needle-{i}": {
            "type": "rectangle",
            "to_world": T().translate([-0.9 + 0.18 * i, 0.3, -0.5]).scale([1e-4, 1.0, 1.0]),
            "bsdf": twosided(diffuse(0.9)),
        }
        for i in range(10)
    }
    twice = {**square((0, 0, -1.0), (0, 0, 1), 1.0), "bsdf": twosided(diffuse(0.3))}
    return room(side, twice=twice, **needles)


SCALES = Case(
    10,
    "scales",
    "Extreme scales",
    "The same room a ten-thousandth and a million times as large, far from the origin, with needles and "
    "coincident faces, lamps of 1e-6 to 1e8 W: whatever has an absolute epsilon breaks.",
    (
        Setting("× 1e6", _placed(1e6, 0.0)),
        Setting("× 1e-4", _placed(1e-4, 0.0)),
        Setting("1e4 from the origin", _placed(1.0, 1e4)),
        Setting("needles, coincident faces", _needles),
        Setting("1e-6 W", _power(1e-6)),
        Setting("1e8 W", _power(1e8)),
    ),
)


def _wide(_: int) -> Description:
    """A line of a square film."""
    side = 16384
    scene = room(side)
    scene["camera"]["film"] |= {
        "crop_width": side,
        "crop_height": 1,
        "crop_offset_x": 0,
        "crop_offset_y": side // 2,
    }
    return scene


EXTREMES = Case(
    16,
    "extremes",
    "Tiny and wide films, many bounces",
    "One pixel, one sample; a crop 16,384 pixels wide and one high; ten bounces, 21 numbers.",
    (
        Setting("k = 10", room, {"k": 10}),
        Setting("one pixel", lambda _: room(1), side=1),
        # There is none left for a guide that is asked for by name.
        Setting("one pixel, one sample", lambda _: room(1), spp=1, side=1, refused="`spp`"),
        Setting("one pixel, two samples", lambda _: room(1), spp=2, side=1),
        Setting("16,384 × 1", _wide, spp=4),
    ),
)


def glow(side: int) -> Description:
    """A room without any light but one that no path of two bounces can find."""
    hidden = {**square((0, 0, 30), (0, 0, 1), 0.1), "bsdf": diffuse(0.0), "light": area(1.0)}
    return room(side, lamp=hidden, camera=camera(side))
