"""What the rows of a study come to: gain, cost, ratios at equal samples and at equal time, wins and losses.

Errors are standard errors over seeds, of ratios by propagation; with three seeds they are themselves only known to
about a half. A run ends a little before or after its time: the ratio at equal time is that of relMSE × seconds used,
since relMSE falls with one over the time.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from ..metrics import Estimate, mean_and_error
from ..report import scene_title
from .store import ALL, Row

__all__ = [
    "BASELINE",
    "CLOSE",
    "Cell",
    "Choice",
    "Overall",
    "Reach",
    "cells",
    "choices",
    "named_baseline",
    "overall",
    "reaches",
    "targets",
    "time_to_reach",
]

BASELINE = "none"
"""Random sampling: what all others are compared with."""

CLOSE = 1.15
"""`auto` is close if its error at equal time is at most this times that of the best candidate."""

SIGNIFICANT = 2.0
"""Standard errors."""


def named_baseline(method: str) -> str:
    """A baseline in words."""
    return "random sampling" if method == BASELINE else method


@dataclass(frozen=True)
class Cell:
    """One method on one scene after one time. Ratios are the baseline's ÷ the method's: above 1 is a gain."""

    scene: str
    method: str
    time: float
    unit: str
    light: str
    seeds: int
    chosen: str
    """What drew last, of all seeds."""
    spp: float
    relmse: Estimate
    relmse_trimmed: Estimate
    mape: Estimate
    flip: Estimate | None
    nonzero_share: float | None
    own_variance: Estimate | None
    reference_variance: float
    spent: float
    """Seconds used, or samples per pixel."""
    work: Estimate
    """relMSE × what was spent."""
    variance_time: Estimate | None
    """Relative variance, by the image itself, × what was spent."""
    gain: Estimate | None
    """Variance per path, by the images' own."""
    cost: Estimate | None
    """Seconds a path, pilot and training inside, in the baseline's: below 1 is cheaper."""
    equal_samples: Estimate | None
    equal_time: Estimate | None
    baseline: str = BASELINE
    """The method that ratios are formed with."""

    @property
    def gained(self) -> Estimate | None:
        """The ratio at equal budget: time, or samples."""
        return self.equal_time if self.unit == "s" else self.equal_samples

    @property
    def verdict(self) -> str:
        """`win` or `loss` beyond two standard errors, `tie`, or nothing where there is nothing to compare."""
        if self.method == self.baseline or self.gained is None:
            return ""
        ratio, error = self.gained
        if not math.isfinite(error):
            return "one seed"
        if ratio - SIGNIFICANT * error > 1.0:
            return "win"
        return "loss" if ratio + SIGNIFICANT * error < 1.0 else "tie"

    @property
    def drowned(self) -> bool:
        """Whether the error lies below the truth's own noise."""
        return self.relmse.value < self.reference_variance


def cells(rows: Iterable[Row], baseline: str = BASELINE) -> list[Cell]:
    """All cells, in the order of the rows; rows of times at which there was no image are left out."""
    groups: dict[tuple[str, str, float], list[Row]] = {}
    for row in rows:
        if not row.spp:
            continue
        groups.setdefault((row.scene, row.method, row.time), []).append(row)
    found = []
    for (scene, method, time), group in groups.items():
        base = groups.get((scene, baseline, time))

        def over(theirs: list[float] | None, own: list[float]) -> Estimate | None:
            return None if theirs is None else ratio(mean_and_error(theirs), mean_and_error(own))

        variances = [row.own_variance for row in group]
        known = [v for v in variances if v is not None]
        whole = len(known) == len(group)
        flips = [row.flip for row in group if row.flip is not None]
        shares = [row.nonzero_share for row in group if row.nonzero_share is not None]
        base_variance = [(r.own_variance, r) for r in base or ()]
        per_path = [v * r.spp for v, r in base_variance if v is not None]
        found.append(
            Cell(
                scene=scene,
                method=method,
                time=time,
                unit=group[0].unit,
                light=group[0].light,
                seeds=len(group),
                chosen="/".join(sorted({row.chosen for row in group})),
                spp=sum(row.spp for row in group) / len(group),
                relmse=mean_and_error([row.relmse for row in group]),
                relmse_trimmed=mean_and_error([row.relmse_trimmed for row in group]),
                mape=mean_and_error([row.mape for row in group]),
                flip=mean_and_error(flips) if len(flips) == len(group) else None,
                nonzero_share=sum(shares) / len(shares) if shares else None,
                own_variance=mean_and_error(known) if whole else None,
                reference_variance=group[-1].reference_variance,
                spent=sum(row.spent for row in group) / len(group),
                work=mean_and_error([row.relmse * row.spent for row in group]),
                variance_time=mean_and_error(
                    [v * row.spent for v, row in zip(known, group, strict=True)]
                )
                if whole
                else None,
                gain=over(
                    per_path if base and len(per_path) == len(base) else None,
                    [v * r.spp for v, r in zip(known, group, strict=True)],
                )
                if whole
                else None,
                cost=over(
                    [row.elapsed / row.spp for row in group], [r.elapsed / r.spp for r in base]
                )
                if base
                else None,
                equal_samples=over(
                    [r.relmse * r.spp for r in base] if base else None,
                    [row.relmse * row.spp for row in group],
                ),
                equal_time=over(
                    [r.relmse * r.elapsed for r in base] if base else None,
                    [row.relmse * row.elapsed for row in group],
                ),
                baseline=baseline,
            )
        )
    return found


def ratio(numerator: Estimate, denominator: Estimate) -> Estimate | None:
    """A ratio of independent estimates; None where one of them is not positive, drowned in the truth's noise."""
    if not (numerator.value > 0.0 and denominator.value > 0.0):
        return None
    value = numerator.value / denominator.value
    relative = math.hypot(numerator.error / numerator.value, denominator.error / denominator.value)
    return Estimate(value, value * relative)


@dataclass(frozen=True)
class Overall:
    """One method after one time, over all scenes."""

    method: str
    time: float
    scenes: int
    """Those that have a ratio."""
    mean: Estimate
    """Geometric mean of the ratios at equal budget."""
    gain: Estimate | None
    """The same of the variance per path."""
    wins: int
    losses: int
    ties: int
    worst: tuple[str, Estimate]
    """Scene of the smallest ratio."""
    left_out: tuple[str, ...] = ()
    """Scenes without a ratio, because the method's error, or random sampling's, drowns in the reference's noise."""

    @property
    def of(self) -> str:
        """Scenes in words: all of them, or how many and which ones are missing."""
        if not self.left_out:
            return str(self.scenes)
        missing = ", ".join(scene_title(scene) for scene in self.left_out)
        return f"{self.scenes} of {self.scenes + len(self.left_out)}; below the noise on {missing}"


def overall(found: Sequence[Cell]) -> list[Overall]:
    """All methods but the baseline, in the order of the cells."""
    groups: dict[tuple[str, float], list[tuple[Cell, Estimate]]] = {}
    drowned: dict[tuple[str, float], list[str]] = {}
    based = {(cell.scene, cell.time) for cell in found if cell.method == cell.baseline}
    for cell in found:
        if cell.method == cell.baseline:
            continue
        if cell.gained is None:
            if (cell.scene, cell.time) in based:
                drowned.setdefault((cell.method, cell.time), []).append(cell.scene)
        else:
            groups.setdefault((cell.method, cell.time), []).append((cell, cell.gained))
    result = []
    for (method, time), group in groups.items():
        verdicts = [cell.verdict for cell, _ in group]
        worst = min(group, key=lambda pair: pair[1].value)
        gains = [cell.gain for cell, _ in group if cell.gain is not None]
        result.append(
            Overall(
                method=method,
                time=time,
                scenes=len(group),
                mean=geometric_mean([value for _, value in group]),
                gain=geometric_mean(gains) if len(gains) == len(group) else None,
                wins=verdicts.count("win"),
                losses=verdicts.count("loss"),
                ties=verdicts.count("tie"),
                worst=(worst[0].scene, worst[1]),
                left_out=tuple(drowned.get((method, time), ())),
            )
        )
    return result


def geometric_mean(values: Sequence[Estimate]) -> Estimate:
    """Of independent positive estimates."""
    mean = math.exp(sum(math.log(v.value) for v in values) / len(values))
    relative = math.sqrt(sum((v.error / v.value) ** 2 for v in values)) / len(values)
    return Estimate(mean, mean * relative)


@dataclass(frozen=True)
class Choice:
    """`auto` beside the best other method in hindsight, on one scene after one time."""

    scene: str
    time: float
    best: str
    over: Estimate
    """Error of `auto` ÷ that of the best, at equal time."""

    @property
    def close(self) -> bool:
        """Whether it is not worse than `CLOSE` beyond two standard errors.

        The best of several noisy candidates looks better than it is; that is not corrected for.
        """
        error = self.over.error if math.isfinite(self.over.error) else 0.0
        return self.over.value - SIGNIFICANT * error <= CLOSE


def choices(
    found: Sequence[Cell], name: str = "auto", competitors: Sequence[str] = ()
) -> list[Choice]:
    """`auto` against the others, wherever both were measured; `competitors` are none that it could have chosen."""
    result = []
    for cell in found:
        if cell.method != name:
            continue
        others = [
            c
            for c in found
            if (c.scene, c.time) == (cell.scene, cell.time)
            and c.method not in (name, *competitors)
            and c.work.value > 0.0
        ]
        if not others:
            continue
        best = min(others, key=lambda c: c.work.value)
        over = ratio(cell.work, best.work)
        if over is not None:
            result.append(Choice(cell.scene, cell.time, best.method, over))
    return result


@dataclass(frozen=True)
class Reach:
    """When a method comes to an error, on one scene."""

    scene: str
    method: str
    target: float
    """relMSE, mean over seeds."""
    seconds: float | None
    """Or samples per pixel; interpolated between two measured ones, None where it lies outside of them."""
    bound: str = ""
    """What is known where there is no number: `< 1 s`, `> 30 s`, or `below the noise`."""
    unit: str = "s"

    def __str__(self) -> str:
        return self.bound if self.seconds is None else f"{self.seconds:.3g} {self.unit}"


def time_to_reach(
    points: Sequence[tuple[float, float]], target: float, floor: float, unit: str = "s"
) -> tuple[float | None, str]:
    """Seconds at which an error that falls through `points` (seconds, error) first comes to `target`.

    Both are interpolated on logarithmic axes, where errors fall in straight lines; nothing is extrapolated, and nothing
    is read below `floor`, the reference's own noise in the same measure.

    Returns:
        The seconds and an empty text, or None and what is known instead, as `Reach.bound`.
    """
    if target < floor:
        return None, "below the noise"
    points = sorted(points)
    if not points:
        return None, "no image"
    before: tuple[float, float] | None = None
    for seconds, error in points:
        if error <= target:
            if before is None:
                # A measured hit is a hit; one below it came sooner than anything that was measured.
                return (seconds, "") if error == target else (None, f"< {seconds:.3g} {unit}")
            # Below the floor an error is not known, only that it is no larger: the crossing is drawn to the floor.
            x0, y0 = before
            y1 = max(error, floor)
            if y1 <= 0.0:
                return None, f"< {seconds:.3g} {unit}"
            share = 1.0 if y0 == y1 else math.log(y0 / target) / math.log(y0 / y1)
            return x0 * (seconds / x0) ** min(share, 1.0), ""
        before = seconds, error
    return None, f"> {points[-1][0]:.3g} {unit}"


def targets(found: Sequence[Cell], scene: str) -> list[float]:
    """Errors worth asking for on a scene, largest first: those of random sampling (or the first method) at each time.

    Rounded up to two digits, so that they can be read, and left out below the reference's noise.
    """
    own = [cell for cell in found if cell.scene == scene]
    base = [cell for cell in own if cell.method == cell.baseline]
    base = base or [cell for cell in own if cell.method == own[0].method]
    errors = [cell.relmse.value for cell in base if cell.relmse.value > cell.reference_variance]
    return sorted({_rounded_up(error) for error in errors if error > 0.0}, reverse=True)


def _rounded_up(value: float, digits: int = 2) -> float:
    step = 10.0 ** (math.floor(math.log10(value)) - digits + 1)
    return float(f"{math.ceil(value / step - 1e-9) * step:.{digits}g}")


def reaches(found: Sequence[Cell], most: int = 3) -> list[Reach]:
    """The time, or the samples, of each method to the scene's last few targets."""
    result = []
    found = [
        cell for cell in found if cell.light != ALL
    ]  # alone in its scene: compared with nobody
    for scene in dict.fromkeys(cell.scene for cell in found):
        own = [cell for cell in found if cell.scene == scene]
        for method in dict.fromkeys(cell.method for cell in own):
            points = [(c.spent, c.relmse.value) for c in own if c.method == method]
            for target in targets(found, scene)[-most:]:
                floor = own[-1].reference_variance
                unit = own[-1].unit
                reached = time_to_reach(points, target, floor, unit)
                result.append(Reach(scene, method, target, *reached, unit))
    return result
