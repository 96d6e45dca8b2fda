"""What `pssflow study gradients` shows: ratios of variance × time by parameter, their means, and a chart."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..metrics import Estimate
from ..report import number, scene_title
from .drawing import COLOURS, MARKERS, finish, new_figure, plain_ticks
from .page import Chart, write_page
from .report import Sheet, machine_lines, rich_table, with_error, write_summary
from .summary import BASELINE, SIGNIFICANT
from .welch import ALPHA, Moments, holm, p_value

if TYPE_CHECKING:
    from .gradients import GradientRow, Measuring

__all__ = ["NOTES", "Gain", "gains", "publish"]

NOTES = """\
Ratios are those of uniform numbers (none) ÷ the method: variance × seconds of the gradient of the image’s mean, the
components of a parameter added; of a parameter with more than three (a texture) it is the gradient of their sum. Above
1 is a gain at equal time. The image, training and a pilot are inside the seconds; loading and compiling are not.
Variances are between seeds. ± is one standard error, by leaving out one seed after the other; win and loss are beyond
two. prb renders the same light by Mitsuba’s own algorithm."""


@dataclass(frozen=True)
class Gain:
    """A method on one scene."""

    scene: str
    method: str
    ratios: dict[str, float]
    """By parameter."""
    mean: Estimate
    """Their geometric mean."""
    spp: float
    elapsed: float

    @property
    def verdict(self) -> str:
        """Beyond two standard errors, on the logarithm."""
        log, error = math.log(self.mean.value), self.mean.error / self.mean.value
        if not abs(log) > SIGNIFICANT * error:
            return "tie"
        return "win" if log > 0 else "loss"


def gains(rows: Sequence[GradientRow]) -> list[Gain]:
    """All methods but the baseline, scene by scene; parameters that the image does not depend on are left out."""
    found = []
    for scene, method, base, runs in _against_uniform(rows, least=3):
        names = [name for name in runs[0] if min(_work(of, name) for of in (base, runs)) > 0.0]
        if not names:
            continue
        of = [next(iter(run.values())) for run in runs]
        found.append(
            Gain(
                scene=scene,
                method=method,
                ratios={name: _work(base, name) / _work(runs, name) for name in names},
                mean=_mean(base, runs, names),
                spp=float(np.mean([row.spp for row in of])),
                elapsed=float(np.mean([row.elapsed for row in of])),
            )
        )
    return found


Run = dict[str, "GradientRow"]
"""By parameter."""


def _against_uniform(
    rows: Sequence[GradientRow], least: int
) -> Iterator[tuple[str, str, list[Run], list[Run]]]:
    """Scene, method, the runs of uniform numbers and the method's own, where both are so many."""
    for scene in dict.fromkeys(row.scene for row in rows):
        own = [row for row in rows if row.scene == scene]
        base = _runs(own, BASELINE)
        for method in dict.fromkeys(row.method for row in own):
            runs = _runs(own, method)
            if method != BASELINE and min(len(base), len(runs)) >= least:
                yield scene, method, base, runs


def _runs(rows: Sequence[GradientRow], method: str) -> list[Run]:
    of = [row for row in rows if row.method == method]
    return [
        {row.parameter: row for row in of if row.seed == seed}
        for seed in dict.fromkeys(row.seed for row in of)
    ]


def _work(runs: Sequence[Run], name: str) -> float:
    """Variance × seconds."""
    values = np.stack([run[name].values for run in runs])
    seconds = float(np.mean([run[name].elapsed for run in runs]))
    return float(values.var(axis=0, ddof=1).sum()) * seconds


def _mean(base: Sequence[Run], runs: Sequence[Run], names: Sequence[str]) -> Estimate:
    """Geometric mean of the ratios; its error by the jackknife over the runs of either side."""

    def log(base: Sequence[Run], runs: Sequence[Run]) -> float:
        return float(np.mean([math.log(_work(base, n) / _work(runs, n)) for n in names]))

    def spread(of: Sequence[Run], left_out: Callable[[list[Run]], float]) -> float:
        logs = np.array([left_out([*of[:i], *of[i + 1 :]]) for i in range(len(of))])
        return float((len(of) - 1) * logs.var())

    variance = spread(base, lambda b: log(b, runs)) + spread(runs, lambda r: log(base, r))
    value = math.exp(log(base, runs))
    return Estimate(value, value * math.sqrt(variance))


def differing(rows: Sequence[GradientRow]) -> list[str]:
    """A line for each method whose gradients are others than those of uniform numbers: they should not be."""
    lines = []
    for scene, method, base, runs in _against_uniform(rows, least=2):
        sides = [
            np.stack([np.concatenate([r.values for r in run.values()]) for run in side])
            for side in (base, runs)
        ]
        # What the image does not depend on has no variance on either side.
        known = (sides[0].var(axis=0) > 0) & (sides[1].var(axis=0) > 0)
        if not known.any():
            continue
        a, b = (Moments.of(side[:, known]) for side in sides)
        p = holm(p_value(a, b))
        if p.min() < ALPHA:
            lines.append(
                f"BIASED? {method} on {scene_title(scene)}: a gradient differs from that of uniform numbers, "
                f"p = {p.min():.1g} after Holm"
            )
    return lines


def publish(study: Measuring, rows: Sequence[GradientRow]) -> list[Any]:
    """Writes summary.md, a chart and report.html; returns what the command prints.

    Raises:
        OSError: a file cannot be written.
    """
    found = gains(rows)
    (light,) = study.light.items()
    what = f"{light[0].replace('_', '-')} {light[1]}"
    heading = (
        f"Variance of gradients at equal time, {what}: {study.seconds:g} s a run, image, training and derivative "
        f"inside; {len(study.seeds)} seeds"
    )
    sheets = [_summary(found), _by_parameter(found)]
    lines = [
        *differing(rows),
        *(f"left out: {name}: {why}" for name, why in study.failures.items()),
        *machine_lines([vars(row) for row in rows], rows[0].processor, rows[0].mitsuba),
    ]
    write_summary(study.folder / "summary.md", heading, sheets, [NOTES, *lines])
    charts = []
    if found:
        path = study.folder / "gradients.png"
        _chart(path, heading, found, rows[0])
        charts.append(Chart(path.with_suffix(".svg"), heading, first=True))
    write_page(
        study.folder,
        heading,
        sheets=sheets,
        charts=charts,
        scenes=[],
        lines=lines,
        notes=NOTES,
    )
    written = f"wrote {study.folder}: report.html, results.csv, summary.md, a chart"
    return [*(rich_table(sheet) for sheet in reversed(sheets)), NOTES, *lines, written]


def _summary(found: Sequence[Gain]) -> Sheet:
    headings = (
        *("scene", "method", "equal time, geometric mean", "least", "most", "parameters"),
        *("spp", "seconds", "verdict"),
    )
    table = [
        [
            scene_title(gain.scene),
            gain.method,
            with_error(gain.mean),
            number(min(gain.ratios.values()), 3),
            number(max(gain.ratios.values()), 3),
            str(len(gain.ratios)),
            number(gain.spp, 3),
            number(gain.elapsed, 3),
            gain.verdict,
        ]
        for gain in found
    ]
    for method in dict.fromkeys(gain.method for gain in found):
        own = [gain for gain in found if gain.method == method]
        logs = [math.log(gain.mean.value) for gain in own]
        error = math.sqrt(sum((g.mean.error / g.mean.value) ** 2 for g in own)) / len(own)
        value = math.exp(sum(logs) / len(logs))
        verdicts = [gain.verdict for gain in own]
        told = " / ".join(str(verdicts.count(v)) for v in ("win", "tie", "loss"))
        table.append(
            [
                "all",
                method,
                with_error(Estimate(value, value * error)),
                *("", "", "", "", ""),
                f"{told} (wins / ties / losses)",
            ]
        )
    return Sheet("Variance × time, uniform numbers ÷ the method", headings, table, summary=True)


def _by_parameter(found: Sequence[Gain]) -> Sheet:
    methods = list(dict.fromkeys(gain.method for gain in found))
    places = dict.fromkeys((gain.scene, name) for gain in found for name in gain.ratios)
    by = {(gain.scene, gain.method): gain.ratios for gain in found}
    table = [
        [
            scene_title(scene),
            name,
            *(number(by.get((scene, method), {}).get(name), 3) for method in methods),
        ]
        for scene, name in places
    ]
    return Sheet("By parameter", ("scene", "parameter", *methods), table)


def _chart(path: Path, title: str, found: Sequence[Gain], about: GradientRow) -> list[Path]:
    """Scenes side by side; a small mark for each parameter, a large one with its error for their mean."""
    from matplotlib.lines import Line2D

    scenes = list(dict.fromkeys(gain.scene for gain in found))
    methods = list(dict.fromkeys(gain.method for gain in found))
    figure = new_figure(2.2 * len(scenes) + 1.5, 4.6)
    axes = figure.add_subplot()
    for gain in found:
        i = methods.index(gain.method)
        look: dict[str, Any] = {"color": COLOURS[i + 1], "marker": MARKERS[i + 1]}
        x = scenes.index(gain.scene) + (i - 0.5 * (len(methods) - 1)) * 0.8 / len(methods)
        each = list(gain.ratios.values())
        axes.plot([x] * len(each), each, linestyle="", markersize=3, alpha=0.5, **look)
        bar = min(SIGNIFICANT * gain.mean.error, 0.9 * gain.mean.value)
        axes.errorbar([x], [gain.mean.value], yerr=[bar], markersize=8, capsize=3, **look)
    axes.axhline(1.0, color="black", linewidth=1.2)
    axes.set_yscale("log")
    axes.set_xticks(range(len(scenes)), [scene_title(scene) for scene in scenes])
    axes.set_ylabel("variance × time, uniform ÷ method")
    axes.grid(axis="y", which="both", color="#e3e3e3", linewidth=0.5)
    axes.set_axisbelow(True)
    plain_ticks(axes.yaxis)
    handles = [
        Line2D([], [], color=COLOURS[i + 1], marker=MARKERS[i + 1], linestyle="", label=method)
        for i, method in enumerate(methods)
    ]
    caption = (
        f"Small: each parameter. Large: their geometric mean, bars of two standard errors. "
        f"{about.width}×{about.height} pixels and the like, {about.processor}."
    )
    return finish(figure, path, title, handles, caption)
