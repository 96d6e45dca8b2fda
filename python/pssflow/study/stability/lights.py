"""Cases whose difficulty is where the light is: missed, disconnected, at borders, close to a wall, everywhere."""

from __future__ import annotations

import math
from typing import Any

import mitsuba as mi
import numpy as np

from ...scene import Scene
from .case import F32, Case, Setting
from .parts import area, camera, diffuse, lamp, rgb, room, sphere, square, twosided

__all__ = ["BORDERS", "CLOSE", "EASY", "MODES", "SLIT", "SPREAD"]

Description = dict[str, Any]

# --- 3: a light behind a slit ---------------------------------------------------------------------

SPOT_AT = (0.35, 0.45)
SUN = 2.7
"""Watts through the hole that give about as much two-bounce light as the lamp."""
FLOOR = 0.6


def _house(side: int, half: float, *, sunlit: bool, spot: bool, dark: bool = False) -> Description:
    """A room with a lamp, whose ceiling has a hole through which the sun falls straight down on a spot of the
    floor; or with a square emitter in the place of that spot.
    """
    walls = twosided(diffuse(FLOOR))
    scene: Description = {"type": "scene", "camera": camera(side, target=(0.0, 1.0, 0.0))}
    T = mi.ScalarTransform4f
    sides = {
        "back": (0, 1, 0),
        "front": (0, -1, 0),
        "left": (-1, 0, 0),
        "right": (1, 0, 0),
        "floor": (0, 0, -1),
    }
    for name, out in sides.items():
        inward = (-out[0], -out[1], -out[2])
        scene[name] = {**square(out, inward, 1.0), "bsdf": walls}
    # The ceiling is four plates around the hole.
    x, y = SPOT_AT
    for i, (x0, x1, y0, y1) in enumerate(
        [
            (-1, x - half, -1, 1),
            (x + half, 1, -1, 1),
            (x - half, x + half, -1, y - half),
            (x - half, x + half, y + half, 1),
        ]
    ):
        place = (
            T()
            .translate([(x0 + x1) / 2, (y0 + y1) / 2, 1.0])
            .scale([(x1 - x0) / 2, (y1 - y0) / 2, 1])
        )
        scene[f"ceiling-{i}"] = {"type": "rectangle", "to_world": place, "bsdf": walls}
    if not dark:
        scene["lamp"] = lamp((0.0, 0.2, 0.98), (0.0, 0.0, -1.0), 0.25, 5.0)
    irradiance = SUN / (2 * half) ** 2
    if sunlit:
        sun = {"type": "directional", "direction": [0, 0, -1], "irradiance": rgb(irradiance)}
        scene["sun"] = sun
    if spot:
        # Radiance of a diffuse surface under that irradiance.
        glow = lamp((x, y, -1.0 + 1e-4), (0.0, 0.0, 1.0), half, FLOOR * irradiance / math.pi)
        scene["spot"] = glow
    return scene


def _slit(name: str, half: float, spp: int, side: int) -> Setting:
    """A hole so small that the pilot misses the spot below it, and so many samples that the render does not."""

    def truth(side: int, runs: int, spp: int, threads: int | None) -> F32:
        """Two bounces from the lamp, and one from an emitter in the place of the spot: the same light, easy to
        find.
        """
        lit = Scene(_house(side, half, sunlit=False, spot=False))
        glow = Scene(_house(side, half, sunlit=False, spot=True, dark=True))
        how = {"threads": threads, "progress": False}
        spp = min(spp, 1024)
        return np.stack(
            [
                lit.render("none", spp, seed=seed, **how).image
                + glow.render("none", spp, seed=seed + runs, k=1, **how).image
                for seed in range(runs)
            ]
        )

    def scene(side: int) -> Description:
        return _house(side, half, sunlit=True, spot=False)

    return Setting(name, scene, truth=truth, blind=True, spp=spp, side=side)


SLIT = Case(
    3,
    "missed-mode",
    "A mode that the pilot missed",
    "The sun falls through a hole on a spot that one path in 1e4 or 1e5 meets, and gives about half of the light. No "
    "pilot sees it, and a guide that learns where light was makes it rarer by up to 1/a.",
    (_slit("1 path in 1e4", 0.03, 1024, 8), _slit("1 path in 1e5", 0.0095, 4096, 16)),
    picture=True,
)

# --- 6: mass at the borders -----------------------------------------------------------------------


def _grazing(side: int) -> Description:
    """A plain under a ring of bright wall far away: light comes in at the very rim of the hemisphere, u → 0 and 1."""
    return {
        "type": "scene",
        "camera": camera(side, origin=(0, -3, 3), target=(0, 0, 0), fov=35),
        "floor": {**square((0, 0, 0), (0, 0, 1), 2.0), "bsdf": twosided(diffuse(0.7))},
        "wall": {
            "type": "cylinder",
            "p0": [0, 0, 0.0],
            "p1": [0, 0, 0.6],
            "radius": 8.0,
            "bsdf": twosided(diffuse(0.8)),
        },
        "lamp": lamp((0, 0, 4.0), (0, 0, -1), 0.3, 400.0),
    }


def _rim_of_lamp(side: int) -> Description:
    """A lamp of which only the outermost strip is not covered: the light's own numbers are at their borders."""
    cover = {**square((0.0, 0.2, 0.9), (0.0, 0.0, -1.0), 0.299), "bsdf": diffuse(0.0)}
    return room(side, lamp=lamp((0.0, 0.2, 0.91), (0.0, 0.0, -1.0), 0.3, 300.0), cover=cover)


def _last_of_many(side: int) -> Description:
    """Thirty-two lamps of which only the first and the last are in the room: the emitter's number is at its
    borders.
    """
    lamps: Description = {}
    for i in range(32):
        inside = i in (0, 31)
        place = (-0.5 if i == 0 else 0.5, 0.2, 0.98) if inside else (-8.0 + i / 2, 30.0, 0.0)
        lamps[f"lamp-{i:02}"] = lamp(place, (0.0, 0.0, -1.0), 0.15, 15.0)
    return room(side, lamp=None, **lamps)


BORDERS = Case(
    6,
    "borders",
    "Mass at the borders of the cube",
    "Light where numbers are near 0 or 1: grazing directions, the rim of a lamp, the first and the last emitter. "
    "Normal priors end there slowly, logits go to infinity, histograms must not step over the edge.",
    (
        Setting("grazing", _grazing),
        Setting("rim of the lamp", _rim_of_lamp),
        Setting("first and last emitter", _last_of_many),
    ),
    picture=True,
)

# --- 7: disconnected modes ------------------------------------------------------------------------


def _modes(count: int) -> Any:
    def scene(side: int) -> Description:
        lamps: Description = {}
        for i in range(count):
            angle = 2 * math.pi * i / count
            place = (0.8 * math.cos(angle), 0.8 * math.sin(angle), 0.97)
            lamps[f"lamp-{i:02}"] = lamp(place, (0.0, 0.0, -1.0), 0.03, 40.0 + 20.0 * (i % 3))
            # A tube under each: it lights a spot of the floor, and nothing between the spots.
            tube = {
                "type": "cylinder",
                "p0": [*place[:2], 0.98],
                "p1": [*place[:2], 0.6],
                "radius": 0.09,
            }
            lamps[f"tube-{i:02}"] = {**tube, "bsdf": twosided(diffuse(0.02))}
        return room(side, lamp=None, ball=None, **lamps)

    return scene


MODES = Case(
    7,
    "disconnected-modes",
    "Disconnected modes",
    "Spots of light with nothing between them. A flow that bends one bell curve must tear it, and leaves "
    "bridges; modes that it drops come back as fireflies.",
    (
        Setting("5 lights", _modes(5)),
        Setting("2 lights", _modes(2)),
        Setting("32 lights", _modes(32)),
    ),
    picture=True,
)

# --- 8: close lights and caustics -----------------------------------------------------------------


def _close(side: int) -> Description:
    """A small lamp a hundredth away from the wall that it shines at."""
    small = lamp((0.2, 0.985, 0.1), (0.0, 1.0, 0.0), 0.02, 600.0)
    return room(side, lamp=small)


def _behind(bsdf: Description) -> Any:
    """A ball of a material before the camera, under a small lamp."""

    def scene(side: int) -> Description:
        ball = sphere((0.0, 0.0, -0.45), 0.4, bsdf)
        return room(side, ball=ball, lamp=lamp((0.3, 0.1, 0.98), (0.0, 0.0, -1.0), 0.12, 45.0))

    return scene


CLOSE = Case(
    8,
    "close-lights-and-caustics",
    "A light close to a wall; caustics",
    "1/r² near a small light has no variance by emitter samples alone; light focused by rough glass, mirrors and "
    "glass cannot be joined to a light at all.",
    (
        Setting("lamp at the wall", _close),
        Setting(
            "rough glass",
            _behind({"type": "roughdielectric", "alpha": 0.05, "distribution": "ggx"}),
        ),
        Setting("mirror", _behind({"type": "conductor"})),
        Setting("glass", _behind({"type": "dielectric"})),
    ),
    picture=True,
)

# --- 13, 14: the plain room many times; nothing to learn ------------------------------------------

SPREAD = Case(
    13,
    "run-to-run-spread",
    "Spread between runs",
    "Many short renders of a plain room (Celarek et al. 2019): a method whose error now and then is ten times "
    "its usual one looks fine in most pictures.",
    (Setting("short renders", room, spp=16, seeds=20),),
)


def _furnace(side: int) -> Description:
    """The inside of a glowing white ball: each path brings the same, and random numbers have no noise to remove."""
    return {
        "type": "scene",
        "camera": camera(side, origin=(0, 0, 0), target=(0, 1, 0), fov=60),
        "ball": {
            "type": "sphere",
            "center": [0, 0, 0],
            "radius": 1.0,
            "flip_normals": True,
            "bsdf": diffuse(0.5),
            "light": area(1.0),
        },
    }


def _sky(side: int) -> Description:
    """A ball on a plain under an even sky: BSDF samples are nearly optimal."""
    return {
        "type": "scene",
        "camera": camera(side, origin=(0, -4, 2), target=(0, 0, 0.3), fov=35),
        "floor": {**square((0, 0, 0), (0, 0, 1), 4.0), "bsdf": twosided(diffuse(0.5))},
        "ball": sphere((0, 0, 0.6), 0.6, diffuse(0.7)),
        "sky": {"type": "constant", "radiance": rgb(1.0)},
    }


EASY = Case(
    14,
    "easy-scene",
    "An easy scene",
    "Random numbers are nearly optimal here; whatever a guide does can only cost. The right answer is `none`.",
    (Setting("even sky", _sky), Setting("furnace", _furnace)),
    picture=True,
)
