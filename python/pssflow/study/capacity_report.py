"""What `pssflow study capacity` shows: a table of models, a chart of error and gain by size, how small is enough."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..metrics import Estimate, mean_and_error
from ..report import count, number, scene_title
from .capacity import Family
from .drawing import COLOURS, LINES, MARKERS, MUTED, finish, new_figure, plain_ticks
from .report import Sheet, with_error
from .store import Row
from .summary import BASELINE, Cell, cells

__all__ = ["NOTES", "Model", "capacity_chart", "capacity_sheet", "enough", "models"]

NOTES = """\
Parameters: numbers that the last fit learned, mean over seeds; of tables those of cells that paths met. relMSE is
relative to the square of the reference about each pixel, the reference's own variance subtracted. Ratios are random
sampling (none) ÷ the model: above 1 is a gain. predicted: variance per path on held-out paths, by the rule of `auto`,
of the guide that drew last; gain / path: the images' own variance, pilot and early passes inside; equal budget: relMSE
at equal time, or samples. training: seconds, all fits. ± is one standard error over seeds. A
flow over the path (realnvp-logit) does not model the BSDF-sampled ray at the last vertex; table and net do."""

CLOSE = 1.1
"""A model is enough if its error at equal budget is at most that times the least."""


@dataclass(frozen=True)
class Model:
    """A size of a family on one scene."""

    cell: Cell
    family: Family | None
    """None for random numbers."""
    value: int
    parameters: float
    predicted: Estimate | None
    fit: float
    """Seconds of training."""


def models(rows: Sequence[Row], families: Sequence[Family], time: float) -> list[Model]:
    """All models at the longest budget, in the order of the families."""
    known = {family.label(value): (family, value) for family in families for value in family.values}
    found = []
    for cell in cells(rows):
        if cell.time != time:
            continue
        own = [r for r in rows if (r.scene, r.method, r.time) == (cell.scene, cell.method, time)]
        family, value = known.get(cell.method, (None, 0))
        sizes = [float(row.parameters or 0) for row in own]
        told = [row.predicted_gain for row in own if row.predicted_gain is not None]
        told = [gain for gain in told if math.isfinite(gain)]
        found.append(
            Model(
                cell=cell,
                family=family,
                value=value,
                parameters=sum(sizes) / len(sizes),
                predicted=mean_and_error(told) if told else None,
                fit=sum(row.seconds_fit or 0.0 for row in own) / len(own),
            )
        )
    return found


def capacity_sheet(found: Sequence[Model], unit: str) -> Sheet:
    """A line a model."""
    equal = "equal time" if unit == "s" else "equal samples"
    headings = (
        *("scene", "model", "guide", "parameters", "training s", "spp", "relMSE", "own variance"),
        *("predicted", "gain / path", "cost / path", equal, "verdict"),
    )
    table = [
        [
            scene_title(model.cell.scene),
            model.cell.method,
            "" if model.family is None else model.family.guide,
            count(round(model.parameters)),
            f"{model.fit:.2f}",
            number(model.cell.spp, 3),
            with_error(model.cell.relmse),
            with_error(model.cell.own_variance),
            with_error(model.predicted),
            with_error(model.cell.gain),
            with_error(model.cell.cost),
            with_error(model.cell.gained),
            model.cell.verdict,
        ]
        for model in found
    ]
    return Sheet("Models by size", headings, table, texts=3, summary=True)


def enough(found: Sequence[Model], families: Sequence[Family], unit: str) -> list[str]:
    """The smallest model that comes near the best, over all families and in each of them."""
    equal = "equal time" if unit == "s" else "equal samples"
    lines = []
    for scene in dict.fromkeys(model.cell.scene for model in found):
        own = [m for m in found if m.cell.scene == scene and m.cell.work.value > 0.0]
        if not own:
            continue
        best = min(own, key=lambda m: m.cell.work.value)
        lines.append(
            f"{scene_title(scene)}: the least error at {equal} is that of {_named(best)}; enough, within "
            f"{100 * (CLOSE - 1):.0f} % of it, is {_smallest(own, best)}"
        )
        for family in families:
            of = [m for m in own if m.family is family]
            if of:
                first = min(of, key=lambda m: m.cell.work.value)
                lines.append(
                    f"{scene_title(scene)}, {family.name} alone: the best is {_named(first)}, enough is "
                    f"{_smallest(of, first)}"
                )
    return lines


def _smallest(own: Sequence[Model], best: Model) -> str:
    """The smallest model near the best, and the smallest one that these seeds do not tell from it."""
    overs = [(m, *_over(m.cell.work, best.cell.work)) for m in own]
    near = min((m for m, over, _ in overs if over <= CLOSE), key=lambda m: m.parameters)
    told = min((m for m, over, e in overs if over - 2.0 * e <= 1.0), key=lambda m: m.parameters)
    if told.parameters >= near.parameters:
        return _named(near)
    return f"{_named(near)}; but these seeds do not tell {_named(told)} from it, beyond two standard errors"


def _named(model: Model) -> str:
    if model.family is None:
        return "random numbers (no parameters)"
    return f"{model.cell.method} ({count(round(model.parameters))} parameters)"


def _over(work: Estimate, best: Estimate) -> tuple[float, float]:
    """How many times the best's, and its standard error; 0 for that of a single seed, which says nothing."""
    over = work.value / best.value
    error = over * math.hypot(work.error / work.value, best.error / best.value)
    return over, error if math.isfinite(error) else 0.0


def capacity_chart(
    path: Path,
    title: str,
    found: Sequence[Model],
    families: Sequence[Family],
    about: Row,
    seeds: int,
) -> list[Path]:
    """Error at equal budget, and gain per path (predicted and measured), by the number of parameters."""
    from matplotlib.lines import Line2D

    figure = new_figure(11.0, 4.9)
    left = figure.add_subplot(1, 2, 1)
    right = figure.add_subplot(1, 2, 2)
    handles = []
    for i, family in enumerate(families):
        own = sorted((m for m in found if m.family is family), key=lambda m: m.value)
        if not own:
            continue
        look = {"color": COLOURS[i + 1], "marker": MARKERS[i + 1], "markersize": 5}
        x = [max(m.parameters, 1.0) for m in own]
        drawn = [
            (p, m.cell.relmse) for p, m in zip(x, own, strict=True) if m.cell.relmse.value > 0.0
        ]
        left.errorbar(
            [p for p, _ in drawn],
            [e.value for _, e in drawn],
            yerr=[_bar(e) for _, e in drawn],
            linestyle=LINES[i + 1],
            linewidth=1.5,
            capsize=2,
            elinewidth=1,
            **look,
        )
        for p, m in zip(x, own, strict=True):
            if m.cell.relmse.value > 0.0 and m in (own[0], own[-1]):
                left.annotate(
                    f"{m.value}",
                    (p, m.cell.relmse.value),
                    (4, 5),
                    textcoords="offset points",
                    fontsize=7.5,
                    color=look["color"],
                )
        for dashed, values in (
            (False, [m.cell.gain for m in own]),
            (True, [m.predicted for m in own]),
        ):
            points = [(p, e.value) for p, e in zip(x, values, strict=True) if e is not None]
            right.plot(
                [p for p, _ in points],
                [v for _, v in points],
                linestyle="--" if dashed else "-",
                linewidth=1.3,
                markerfacecolor="white" if dashed else look["color"],
                **look,
            )
        ends = f"{family.option} {own[0].value} … {own[-1].value}"
        handles.append(
            Line2D([], [], label=f"{family.name} ({ends})", linestyle=LINES[i + 1], **look)
        )
    base = next((m for m in found if m.cell.method == BASELINE), None)
    if base is not None and base.cell.relmse.value > 0.0:
        left.axhline(base.cell.relmse.value, color="black", linewidth=1.2)
        handles.append(Line2D([], [], color="black", linewidth=1.2, label="none: no parameters"))
    right.axhline(1.0, color="black", linewidth=1.2)
    noise = about.reference_variance
    low, high = left.get_ylim()
    if noise > 0.3 * low:
        left.axhline(noise, color=MUTED, linestyle="--", linewidth=1)
        handles.append(
            Line2D([], [], color=MUTED, linestyle="--", label="the reference’s own variance")
        )
    look: dict[str, Any] = {"color": MUTED, "marker": "o"}
    handles += [
        Line2D([], [], linestyle="-", label="measured gain / path", **look),
        Line2D(
            [],
            [],
            linestyle="--",
            markerfacecolor="white",
            label="predicted on held-out paths",
            **look,
        ),
    ]
    equal = "equal time" if about.unit == "s" else "equal samples"
    left.set_ylabel("relMSE")
    left.set_title(f"error at {equal} (numbers: the option's value)", fontsize=10)
    right.set_ylabel("variance per path, random ÷ the model")
    right.set_title("gain per path", fontsize=10)
    for axes in (left, right):
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel("parameters")
        axes.grid(which="both", color="#e3e3e3", linewidth=0.5)
        axes.set_axisbelow(True)
        axes.tick_params(labelsize=8, which="both")
        low, high = axes.get_ylim()
        if low > 1e-3 and high < 1e3 and high < 100.0 * low:
            plain_ticks(axes.yaxis)
    many = "1 seed" if seeds == 1 else f"means over {seeds} seeds, bars of two standard errors"
    caption = f"{about.width}×{about.height} pixels, {many}, {about.processor}."
    return finish(figure, path, title, handles, caption)


def _bar(estimate: Estimate) -> float:
    """Two standard errors; on a logarithmic axis the lower end stays above zero."""
    return min(2.0 * estimate.error, 0.9 * estimate.value) if math.isfinite(estimate.error) else 0.0
