"""Scenes by name: the project's own, reduced for statistics, and those of `tests/scenes.py`."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from tests.conftest import ROOT
from tests.scenes import SCENES

SHIPPED = ("cornell-box", "teapot")
"""Reduced to 64 × 64 pixels."""
HARD = ("courtyard", "door-ajar", "glossy", "leaves", "many-lights", "white-room")
"""Shipped as well, reduced to 32 × 32 pixels: each for one reason why light is hard to find, the last for none."""


def load_named(name: str) -> Any:
    """An `mi.Scene` of the active variant."""
    if name in SHIPPED or name in HARD:
        side = 64 if name in SHIPPED else 32
        return mi.load_file(str(ROOT / "scenes" / name / "scene.xml"), resolution=side)
    return mi.load_dict(SCENES[name]())
