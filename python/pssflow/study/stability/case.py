"""What a planted failure is, and what is found out about a guide that meets it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "CHEAP",
    "QUICK",
    "THESIS",
    "Case",
    "Effort",
    "Finding",
    "Setting",
    "render_options",
    "sure",
    "worst",
]

F32 = NDArray[np.float32]

THESIS = "thesis"
"""The source thesis' method: `preset="thesis"`, a = 0. All other names are pssflow's guides at their own a."""

VERDICTS = ("holds", "degrades", "fails")

SMALL_FLOW = {"epochs": 2, "samples": 2048, "couplings": 4, "hidden": 16, "layers": 2}

CHEAP: Mapping[str, Mapping[str, Any]] = {
    THESIS: SMALL_FLOW,
    "realnvp": SMALL_FLOW,
    "realnvp-logit": SMALL_FLOW,
    "mixture-net": {"epochs": 4},
    "spline-net": {"epochs": 3},
}
"""Options of training that is short enough for tests; the study trains guides as they are by default."""


@dataclass(frozen=True)
class Effort:
    """How much is done to find out."""

    seeds: int = 8
    spp: int = 64
    side: int = 16
    """Of the film, in pixels."""
    truth: int = 16
    """Runs of the truth, each of 16 times as many samples."""
    extremes: bool = True
    """All settings of a case, or the first alone."""
    cheap: bool = False
    """Short training."""
    threads: int | None = None


QUICK = Effort(seeds=3, spp=32, side=8, truth=8, extremes=False, cheap=True, threads=1)
"""What tests do on every run."""


@dataclass(frozen=True)
class Finding:
    """What a guide made of a case."""

    verdict: str
    """`holds`, `degrades` (safe, but more than 1.3 times the error of random numbers) or `fails`."""
    figure: str
    """The number that says so, in a few words."""
    why: str = ""
    """What else there is to know."""
    numbers: Mapping[str, float | None] = field(default_factory=dict)
    """`ratio` (relMSE ÷ that of random numbers), `bound` (E[(f/m)²]·a ÷ E[f²]), `max_weight`, `z`, `pareto_k`, …"""
    warnings: tuple[str, ...] = ()
    """What the renders' diagnostics said."""
    image: F32 | None = None
    """The first seed's, for pictures."""

    def __post_init__(self) -> None:
        if self.verdict not in VERDICTS:
            raise ValueError(f"verdict {self.verdict!r} is none of {', '.join(VERDICTS)}")


@dataclass(frozen=True)
class Setting:
    """One scene of a case, and how it is rendered."""

    name: str
    scene: Callable[[int], dict[str, Any]]
    """Film side → description for `mi.load_dict`."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Of `pssflow.render`, for all guides and the truth."""
    guide_options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Of single guides."""
    truth: Callable[[int, int, int, int | None], F32] | None = None
    """Runs of the truth (runs, h, w, 3) from (side, runs, spp, threads), where random numbers would need too long."""
    blind: bool = False
    """No pilot can contain the failure: a guide may lose up to 1/a there, and must warn."""
    spp: int | None = None
    """In place of the effort's."""
    side: int | None = None
    """In place of the effort's."""
    seeds: int = 0
    """At least so many, unless training is cheap."""
    refused: str = ""
    """What the line holds by which a guide may refuse this; empty: it must not."""


@dataclass(frozen=True)
class Case:
    """A planted failure."""

    number: int
    """That of the list in docs/limits.md."""
    name: str
    title: str
    what: str
    """What is planted, and why methods fail there; a sentence."""
    settings: tuple[Setting, ...] = ()
    """Scenes to render with every guide."""
    probe: Callable[[str, Effort, Path], Finding | None] | None = None
    """What no render of a scene can show: (guide, effort, a folder for files) → finding; None where it has no sense.
    Comes on top of the settings.
    """
    picture: bool = False
    """Whether docs/limits.md shows its first setting."""


def render_options(
    guide: str, effort: Effort, own: Mapping[str, Mapping[str, Any]] | None = None
) -> dict[str, Any]:
    """Arguments of `pssflow.render` that make a guide of the studies."""
    options: dict[str, Any] = dict(CHEAP.get(guide, {})) if effort.cheap else {}
    options.update((own or {}).get(guide, {}))
    if guide == THESIS:
        return {"preset": THESIS, **options}
    return {"guide": guide, **options}


def sure(numbers: Mapping[str, float | None], name: str) -> float:
    """A number less two of its standard errors; 0 where there is none."""
    return (numbers.get(name) or 0.0) - 2 * (numbers.get(f"{name}_error") or 0.0)


def worst(findings: Sequence[Finding]) -> Finding:
    """The worst of several findings, by verdict, then by ratio, with the largest second moment, both as far as sure."""

    def badness(found: Finding) -> tuple[int, float]:
        return VERDICTS.index(found.verdict), sure(found.numbers, "ratio")

    found = max(findings, key=badness)
    bound = max(findings, key=lambda f: sure(f.numbers, "bound"))
    moments = {name: bound.numbers.get(name) for name in ("bound", "bound_error")}
    return replace(found, numbers={**found.numbers, **moments}) if moments["bound"] else found
