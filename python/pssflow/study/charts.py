"""Charts of a study: error against wall time or samples, and ratios at equal ones.

Methods are told apart by colour (Okabe and Ito's palette, which colour-blind readers can tell apart), marker and line,
so that a copy in black and white can be read, too. Every chart is written as PNG and as SVG.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..metrics import Estimate
from ..report import scene_title
from .drawing import COLOURS, LINES, MARKERS, MUTED, finish, new_figure, plain_ticks
from .store import ALL, Row
from .summary import Cell, Overall, named_baseline

__all__ = ["error_chart", "ratio_chart", "style"]

NOISY = ("relmse", "relmse_trimmed")
"""Measures from which the reference's variance is subtracted."""

SLOPES = {"relmse": -1.0, "relmse_trimmed": -1.0, "mape": -0.5}
"""How measures fall with time; of others that is not known. MAPE is a mean of roots."""


def style(methods: Sequence[str], method: str) -> dict[str, Any]:
    """Colour, marker and line of a method: the same in every chart of a study."""
    i = methods.index(method)
    return {
        "color": COLOURS[i % len(COLOURS)],
        "marker": MARKERS[i % len(MARKERS)],
        "linestyle": LINES[i % len(LINES)],
    }


def error_chart(
    path: Path,
    title: str,
    rows: Sequence[Row],
    methods: Sequence[str],
    *,
    measure: str = "relmse",
    label: str = "relMSE",
    caption: str = "",
) -> list[Path]:
    """Error against seconds used, or samples, log-log, a panel a scene.

    Lines are means over seeds, bands reach from the least to the largest.
    Dotted: the slope with which the measure falls, −1 for relMSE. Below the dashed line, shaded, errors drown in the
    truth's own noise.

    Raises:
        OSError: a file cannot be written.
    """
    scenes = list(dict.fromkeys(row.scene for row in rows))
    known, methods = methods, [m for m in methods if any(row.method == m for row in rows)]
    columns = min(3, len(scenes))
    lines = math.ceil(len(scenes) / columns)
    figure = new_figure(3.5 * columns + 0.7, 2.9 * lines + 2.1)
    for i, scene in enumerate(scenes):
        axes = figure.add_subplot(lines, columns, i + 1)
        own = [row for row in rows if row.scene == scene]
        axes.set_xscale("log")
        axes.set_yscale("log")
        for method in methods:
            _curve(
                axes, [row for row in own if row.method == method], measure, style(known, method)
            )
        _guides(axes, own, measure)
        _scene_axes(
            axes,
            scene_title(scene),
            label if i % columns == 0 else "",
            i >= len(scenes) - columns,
            rows[0].unit,
            sorted({row.time for row in rows}),
        )
    handles = _legend_handles(methods, known)
    from matplotlib.lines import Line2D

    if measure in SLOPES:
        slope = f"slope −{-SLOPES[measure]:g}"
        handles.append(Line2D([], [], color=MUTED, linestyle=":", label=slope))
    if measure in NOISY:
        handles.append(
            Line2D([], [], color=MUTED, linestyle="--", label="the reference’s own variance")
        )
    return finish(figure, path, title, handles, caption)


def ratio_chart(
    path: Path,
    title: str,
    found: Sequence[Cell],
    summary: Sequence[Overall],
    methods: Sequence[str],
    *,
    known: Sequence[str] | None = None,
    caption: str = "",
) -> list[Path]:
    """Ratios to the baseline at equal time by scene, and their geometric mean; bars of two standard errors.

    Colours are those of the methods in `known`, as in the study's other charts.

    Raises:
        OSError: a file cannot be written.
    """
    found = [cell for cell in found if cell.light != ALL]
    unit = found[0].unit
    times = sorted({cell.time for cell in found})
    scenes = list(dict.fromkeys(cell.scene for cell in found))
    baseline = found[0].baseline
    others = [method for method in methods if method != baseline]
    known = known or methods
    labels = [*(scene_title(scene) for scene in scenes), "geometric mean"]
    height = 0.16 * max(len(others), 2) + 0.1
    figure = new_figure(3.6 * len(times) + 1.6, height * len(labels) + 2.2)
    first = None
    for i, time in enumerate(times):
        axes = figure.add_subplot(1, len(times), i + 1, sharex=first, sharey=first)
        first = first or axes
        for j, method in enumerate(others):
            points: list[tuple[int, Estimate]] = [
                (scenes.index(cell.scene), cell.gained)
                for cell in found
                if (cell.method, cell.time) == (method, time) and cell.gained is not None
            ]
            points += [
                (len(scenes), total.mean)
                for total in summary
                if (total.method, total.time) == (method, time)
            ]
            if not points:
                continue
            offset = ((j + 0.5) / len(others) - 0.5) * 0.72
            values = [value for _, (value, _) in points]
            bars = [_bars(estimate) for _, estimate in points]
            axes.errorbar(
                values,
                [row + offset for row, _ in points],
                xerr=list(zip(*bars, strict=True)),
                **style(known, method) | {"linestyle": "none"},
                markersize=5,
                elinewidth=1.2,
                capsize=2,
            )
        axes.axvline(1.0, color="black", linewidth=1)
        for row in range(len(labels)):
            if row % 2:
                axes.axhspan(row - 0.5, row + 0.5, color="#f2f2f2", zorder=0)
        axes.axhline(len(scenes) - 0.5, color=MUTED, linewidth=1)
        axes.set_xscale("log")
        axes.set_ylim(len(labels) - 0.5, -0.5)
        axes.set_yticks(range(len(labels)), labels)
        axes.tick_params(axis="y", length=0, labelleft=i == 0)
        axes.set_title(f"{time:g} {unit}", fontsize=10)
        equal = "equal time" if unit == "s" else "equal samples"
        axes.set_xlabel(
            f"relMSE of {named_baseline(baseline)} ÷ of the method\n({equal}; right of 1 is a gain)",
            fontsize=8.5,
        )
        axes.grid(axis="x", which="both", color="#dddddd", linewidth=0.5)
        axes.set_axisbelow(True)
    # All panels share their axis, whose ends are known only now.
    for axes in figure.axes:
        plain_ticks(axes.xaxis)
    return finish(figure, path, title, _legend_handles(others, known), caption)


def _curve(axes: Any, rows: Sequence[Row], measure: str, look: dict[str, Any]) -> None:
    times = sorted({row.time for row in rows})
    x, y, low, high = [], [], [], []
    for time in times:
        values = [getattr(row, measure) for row in rows if row.time == time]
        if None in values:
            continue
        mean = sum(values) / len(values)
        if mean <= 0.0:
            continue  # drowned: a logarithm has no place for it
        spent = [row.spent for row in rows if row.time == time]
        x.append(sum(spent) / len(spent))
        y.append(mean)
        low.append(max(min(values), 0.1 * mean))
        high.append(max(values))
    if x:
        axes.plot(x, y, **look, linewidth=1.6, markersize=4.5)
        axes.fill_between(x, low, high, color=look["color"], alpha=0.15, linewidth=0)


def _guides(axes: Any, rows: Sequence[Row], measure: str) -> None:
    """The slope, through the middle of what is drawn, and the truth's noise."""
    values = [(row.spent, getattr(row, measure)) for row in rows]
    positive = [(x, y) for x, y in values if y is not None and y > 0.0]
    if not positive:
        return
    left, right = min(x for x, _ in positive), max(x for x, _ in positive)
    if measure in SLOPES and right > left:
        slope = SLOPES[measure]
        middle = math.exp(sum(math.log(y * x**-slope) for x, y in positive) / len(positive))
        axes.plot(
            [left, right],
            [middle * left**slope, middle * right**slope],
            color=MUTED,
            linestyle=":",
            linewidth=1.2,
            zorder=1,
        )
    noise = rows[-1].reference_variance
    if measure in NOISY and noise > 0.0:
        low, high = axes.get_ylim()
        axes.axhline(noise, color=MUTED, linestyle="--", linewidth=1, zorder=1)
        if noise > low:
            axes.axhspan(low, noise, color=MUTED, alpha=0.12, linewidth=0, zorder=0)
            axes.set_ylim(low, high)


def _scene_axes(
    axes: Any, title: str, label: str, last: bool, unit: str, budgets: Sequence[float]
) -> None:
    plain_ticks(axes.xaxis)
    # Between a few budgets there is nothing to read.
    axes.set_xticks(budgets, [f"{budget:g}" for budget in budgets])
    axes.set_title(title, fontsize=10)
    axes.set_ylabel(label)
    if last:
        axes.set_xlabel("wall time used (s)" if unit == "s" else "samples per pixel")
    low, high = axes.get_ylim()
    if low > 1e-3 and high < 1e3 and high < 100.0 * low:
        plain_ticks(axes.yaxis)
    axes.grid(which="both", color="#e3e3e3", linewidth=0.5)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=8, which="both")


def _bars(estimate: Estimate) -> tuple[float, float]:
    """Two standard errors to either side; on a logarithmic axis the lower end stays above zero."""
    value, error = estimate
    if not math.isfinite(error):
        return 0.0, 0.0
    return min(2.0 * error, 0.9 * value), 2.0 * error


def _legend_handles(methods: Sequence[str], all_methods: Sequence[str] | None = None) -> list[Any]:
    from matplotlib.lines import Line2D

    known = all_methods or methods
    return [
        Line2D([], [], label=method, **style(known, method), markersize=5) for method in methods
    ]
