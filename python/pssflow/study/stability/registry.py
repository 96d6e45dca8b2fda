"""The cases by name. A new one is a file or a function, and a line here; `tests/stability` then covers it."""

from __future__ import annotations

from . import learning, life, lights, materials
from .case import Case

__all__ = ["CASES", "STANDARD"]

STANDARD = (
    "thesis",
    "realnvp",
    "realnvp-logit",
    "vegas",
    "table",
    "mixture-net",
    "spline-net",
    "auto",
)
"""Guides that the study shows."""

CASES: dict[str, Case] = {
    case.name: case
    for case in (
        learning.PRIOR,
        learning.OUTSIDE,
        lights.SLIT,
        learning.POISON,
        learning.FEW,
        lights.BORDERS,
        lights.MODES,
        lights.CLOSE,
        materials.GLOSSY,
        materials.SCALES,
        learning.AGGRESSIVE,
        learning.OVERFIT,
        lights.SPREAD,
        lights.EASY,
        learning.MOVING,
        materials.EXTREMES,
        life.FILES,
        life.MEMORY,
    )
}
