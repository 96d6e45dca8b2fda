"""What `pssflow study thesis` found, in words: why our ratio differs, when the flow overfits, why a prior fails."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..report import count, number, percent, scene_title
from .thesis_scene import ThesisRuns
from .thesis_tests import Found

__all__ = ["Findings", "differs", "failing_prior", "over", "overfit"]


@dataclass
class Findings:
    """All that was done so far."""

    folder: Path
    seed: int
    crescents: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """By prior."""
    scenes: list[ThesisRuns] = field(default_factory=list)
    experiments: dict[str, Sequence[Found]] = field(default_factory=dict)
    """By scene."""
    losses: dict[str, Sequence[Mapping[str, Any]]] = field(default_factory=dict)
    """By scene."""


def differs(findings: Findings) -> list[str]:
    """Whether our ratio is the thesis', and what the experiments say about it."""
    lines = []
    for runs in findings.scenes:
        found = findings.experiments.get(runs.name, ())
        for parametrisation, theirs in (runs.thesis.per_ray if runs.thesis else {}).items():
            if parametrisation not in runs.parametrisations:
                continue
            ours = runs.ratio(parametrisation)
            text = (
                f"{scene_title(runs.name)}, {parametrisation}: {ours:.2f} times as many non-zero paths per camera ray "
                f"as random numbers find; the thesis has {theirs:.1f}"
            )
            own = [f for f in found if f.parametrisation == parametrisation and f.ratio > 0.0]
            if abs(ours - theirs) > 0.1 * theirs and own:
                text += f". {_told(own, ours, theirs)}"
            lines.append(text)
    return lines


def _told(found: Sequence[Found], ours: float, theirs: float) -> str:
    """What the experiments rule out, in words."""
    base = next((f for f in found if f.experiment.name == "as in the thesis"), found[0])
    up = ours < theirs
    best = (max if up else min)(found, key=lambda f: f.ratio)
    moved = [
        f
        for f in found
        if f is not base and (f.ratio > 1.1 * base.ratio if up else f.ratio < 0.9 * base.ratio)
    ]
    moves = "raises" if up else "lowers"
    what = (
        "; ".join(f"{f.experiment.name}: {f.ratio:.2f}" for f in moved)
        if moved
        else f"none of the changes tried {moves} it by a tenth"
    )
    reach = base.value["surfaces"] / max(base.value["random_per_ray"], 1e-12)
    outside, loss = base.value["mass_outside"], base.value["loss"]
    above = "above 0, so it describes light-carrying paths worse than uniform numbers do"
    # Of the way from our ratio to the thesis'.
    way = (best.ratio - ours) / (theirs - ours)
    verdict = (
        "none of them alone explains it"
        if best is base or way < 0.5
        else f"“{best.experiment.name}” explains most of it: {best.experiment.tells}"
        if abs(best.ratio - theirs) > 0.1 * theirs and way < 1.0
        else f"“{best.experiment.name}” alone would explain it: {best.experiment.tells}"
    )
    bound = (
        f". No guide that leaves the camera alone could pass {reach:.0f}, one path for each camera ray that meets a "
        "surface"
        if up
        else ""
    )
    return (
        f"What {moves} it, a single training each, of one seed: {what}; {verdict}. {percent(outside)} of the flow's "
        f"samples fall outside the cube and find nothing; its held-out loss is {number(loss, 3)}"
        f"{', ' + above if loss and loss > 0.0 else ''}{bound}"
    )


def overfit(findings: Findings) -> list[str]:
    """Where the held-out loss turns, by number of paths."""
    lines = []
    for scene, fits in findings.losses.items():
        told = []
        for rows in dict.fromkeys(f["rows"] for f in fits if f["of"] == "paths"):
            own = [f for f in fits if (f["of"], f["rows"]) == ("paths", rows)]
            best, last = min(own, key=lambda f: f["held_out"]), own[-1]
            word = (
                f"rises again after {best['epochs']} epochs ({number(best['held_out'], 3)} → "
                f"{number(last['held_out'], 3)} at {last['epochs']}, while the training loss falls to "
                f"{number(last['training'], 3)})"
                if best is not last
                else f"still falls at {last['epochs']} epochs ({number(last['held_out'], 3)}; training "
                f"{number(last['training'], 3)})"
            )
            told.append(f"with {count(own[0]['trained_on'])} paths the held-out loss {word}")
        lines.append(f"overfitting, {scene_title(scene)}: {'; '.join(told) or 'too few paths'}")
    return lines


def failing_prior(findings: Findings) -> list[str]:
    """Why the hypercube prior fails, and by how much."""
    lost = findings.crescents["hypercube"]["lost"]
    text = (
        f"hypercube prior: after training {percent(lost)} of the crescent's own numbers have density 0. A path that "
        "the flow maps outside the hypercube has likelihood 0 and no gradient; the others are told to spread, which "
        "maximum likelihood rewards until they have left it, too. A Gaussian has a gradient everywhere"
    )
    return [text]


def over(numerator: float | None, denominator: float | None) -> float:
    """A ratio; NaN where there is none."""
    if numerator is None or not denominator:
        return math.nan
    return numerator / denominator
