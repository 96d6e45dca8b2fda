"""What a study prints and writes from its rows: tables as text, Markdown and HTML, and charts."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.table import Table

from ..files import write_beside
from ..metrics import Estimate
from ..report import markdown_table, number, percent, scene_title
from .charts import NOISY, error_chart, ratio_chart
from .flip import has_flip
from .harness import Study
from .methods import OTHERS
from .page import Chart, study_scenes, write_page
from .store import ALL, Row
from .summary import (
    BASELINE,
    CLOSE,
    Cell,
    Choice,
    Overall,
    cells,
    choices,
    named_baseline,
    overall,
    reaches,
)

__all__ = [
    "NOTES",
    "Sheet",
    "bias_lines",
    "bias_tested",
    "biased",
    "budgets",
    "choice_lines",
    "errors_sheet",
    "machine_lines",
    "noisy_references",
    "publish",
    "rich_table",
    "sums_sheet",
    "too_early",
    "with_error",
    "write_summary",
]

NOTES = """\
relMSE, and the variance that an image says of itself, are relative to the square of the reference about each pixel,
in the mean of its 24 neighbours: by its own square, as is usual (relmse_pixel in results.csv), a noisy reference
makes all errors too large and all ratios too near 1. Of relMSE the reference's own variance is subtracted, * lies
below it. “trimmed” leaves out the worst 0.1 % of pixels, which hides fireflies. MAPE and FLIP (HDR-FLIP's mean, 0 …
1) hold the reference's noise. variance × budget: the image's own, in seconds or samples. Time (samples) to an error:
where the line of means over seeds crosses it on logarithmic axes, never beyond what was measured. Ratios are those of
random sampling (none) ÷ the method: above 1 is a gain; but cost is the method's ÷ random's. gain / path: the images'
own variance; equal samples and equal time: relMSE; cost: seconds a path with pilot and training inside. ± is one
standard error over seeds; win and loss are beyond two, at equal time or, where the budget is samples, at equal
samples. A time shorter than the run is a snapshot of it: its pilot was planned for the whole. “All light” is
Mitsuba's path against its own reference: it renders something else than the others, and is compared with none of
them."""

MEASURES = {
    "relmse": ("error", "Error against time", "relMSE"),
    "relmse_trimmed": (
        "error-trimmed",
        "Error without the worst 0.1 % of pixels",
        "relMSE, trimmed",
    ),
    "mape": ("mape", "Mean absolute percentage error against time", "MAPE"),
    "flip": ("flip", "Visible difference against time", "HDR-FLIP, mean"),
}
"""Column of the rows → file, title and axis of its chart."""


@dataclass(frozen=True)
class Sheet:
    """A table in words."""

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    texts: int = 2
    """Columns that hold words."""
    summary: bool = False
    """Whether a page begins with it."""


def publish(
    study: Study, rows: Sequence[Row], title: str, *, baseline: str = BASELINE, notes: str = NOTES
) -> list[Any]:
    """Writes summary.md, charts as PNG and SVG, and report.html; returns what the command prints.

    Ratios are those of `baseline` ÷ the method; `notes` say how to read the tables.

    Raises:
        OSError: a file cannot be written.
    """
    if not rows:
        return []
    any_row = rows[0]
    early = [row for row in rows if not row.spp]
    rows = [row for row in rows if row.spp]
    methods = [m.name for m in study.methods if any(row.method == m.name for row in rows)]
    found = cells(rows, baseline)
    total = overall(found)
    picked = choices(found, competitors=OTHERS) if "auto" in methods else []
    sheets = [
        *([sums_sheet(total, study.unit, baseline)] if total else []),
        errors_sheet(found),
        *([_ratios(found)] if total else []),
        *([sheet] if (sheet := _times_toerrors_sheet(found, study.unit)).rows else []),
    ]
    lines = [
        *biased(study, rows),
        *choice_lines(picked, study.unit),
        *too_early(early),
        *noisy_references(rows),
        *_failures(study),
        *budgets(rows or early),
        *([] if has_flip() else ["FLIP is not measured: the package flip-evaluator is missing"]),
        *machine_lines([vars(row) for row in rows or early], any_row.processor, any_row.mitsuba),
    ]
    heading = title[0].upper() + title[1:]
    write_summary(study.folder / "summary.md", heading, sheets, [notes, *lines])
    charts = _charts(study, rows, methods, found, total, title) if rows else []
    write_page(
        study.folder,
        heading,
        sheets=sheets,
        charts=charts,
        scenes=study_scenes(study, rows),
        lines=lines,
        notes=notes,
        unit=study.unit,
    )
    shown: list[Any] = [rich_table(sheet) for sheet in [*sheets[1:], *sheets[:1]]]
    written = f"wrote {study.folder}: report.html, results.csv, summary.md, charts, images"
    return [*shown, notes, *lines, written]


def write_summary(path: Path, heading: str, sheets: Sequence[Sheet], lines: Sequence[str]) -> None:
    """Tables and findings as Markdown.

    Raises:
        OSError: it cannot be written.
    """
    parts = [f"# {heading}"]
    for sheet in sheets:
        table = markdown_table(sheet.headings, sheet.rows, texts=sheet.texts)
        parts += [f"## {sheet.title}", table]
    text = "\n\n".join([*parts, *lines])
    write_beside(path, lambda part: part.write_text(text + "\n", encoding="utf-8"))


def errors_sheet(found: Sequence[Cell]) -> Sheet:
    """Errors by scene, method and budget."""
    headings = (
        *("scene", "method", "budget", "spp", "relMSE", "trimmed", "MAPE", "FLIP", "non-zero"),
        *("own variance", "variance × budget"),
    )
    table = [
        [
            scene_title(cell.scene),
            cell.method + (f" → {_names(cell.chosen)}" if cell.method == "auto" else ""),
            f"{cell.time:g} {cell.unit}",
            number(cell.spp, 3),
            with_error(cell.relmse) + ("*" if cell.drowned else ""),
            with_error(cell.relmse_trimmed),
            number(cell.mape.value, 3),
            number(None if cell.flip is None else cell.flip.value, 3),
            percent(cell.nonzero_share),
            with_error(cell.own_variance),
            with_error(cell.variance_time),
        ]
        for cell in found
    ]
    return Sheet("Errors", headings, table)


def _ratios(found: Sequence[Cell]) -> Sheet:
    headings = (
        *("scene", "method", "budget", "gain / path", "cost / path", "equal samples"),
        *("equal time", "verdict"),
    )
    table = [
        [
            scene_title(cell.scene),
            cell.method,
            f"{cell.time:g} {cell.unit}",
            with_error(cell.gain),
            with_error(cell.cost),
            with_error(cell.equal_samples),
            with_error(cell.equal_time),
            cell.verdict,
        ]
        for cell in found
        if cell.method != cell.baseline and cell.gained is not None
    ]
    return Sheet(f"Ratios to {named_baseline(found[0].baseline)}", headings, table)


def _times_toerrors_sheet(found: Sequence[Cell], unit: str) -> Sheet:
    """A row for each scene and error, a column for each method."""
    known = reaches(found)
    methods = list(dict.fromkeys(reach.method for reach in known))
    places = list(dict.fromkeys((reach.scene, reach.target) for reach in known))
    table = [
        [
            scene_title(scene),
            number(target, 2),
            *(
                next(
                    (str(r) for r in known if (r.scene, r.target, r.method) == (scene, target, m)),
                    "–",
                )
                for m in methods
            ),
        ]
        for scene, target in places
    ]
    what = "Time to an error" if unit == "s" else "Samples to an error"
    return Sheet(what, ("scene", "relMSE", *methods), table, texts=1)


def sums_sheet(total: Sequence[Overall], unit: str, baseline: str = BASELINE) -> Sheet:
    """A line for each method and budget, over all scenes."""
    equal = "equal time" if unit == "s" else "equal samples"
    headings = (
        *("method", "budget", "scenes", f"{equal}, geometric mean", "gain / path"),
        *("wins / ties / losses", "worst"),
    )
    table = [
        [
            o.method,
            f"{o.time:g} {unit}",
            o.of,
            with_error(o.mean),
            with_error(o.gain),
            f"{o.wins} / {o.ties} / {o.losses}",
            f"{with_error(o.worst[1])} ({scene_title(o.worst[0])})",
        ]
        for o in total
    ]
    what = f"Summary: {named_baseline(baseline)} ÷ the method"
    return Sheet(what, headings, table, summary=True)


def _charts(
    study: Study,
    rows: Sequence[Row],
    methods: Sequence[str],
    found: Sequence[Cell],
    total: Sequence[Overall],
    title: str,
) -> list[Chart]:
    """Writes all charts; those for the page."""
    seeds = "1 seed" if len(study.seeds) == 1 else f"{len(study.seeds)} seeds"
    where = f"{rows[0].width}×{rows[0].height} pixels and the like, {seeds}, {rows[0].processor}"
    charts = []
    everything = [row for row in rows if row.light == ALL]
    rows = [row for row in rows if row.light != ALL]
    for measure, (name, heading, label) in MEASURES.items():
        if all(getattr(row, measure) is None for row in rows):
            continue
        heading = heading.replace("time", "samples") if study.unit == "spp" else heading
        noise = "" if measure in NOISY else " It holds the reference’s noise."
        bands = "Lines are means over seeds, bands reach from the least to the largest. "
        bands = bands if len(study.seeds) > 1 else ""
        used = "Points lie at the seconds really used." if study.unit == "s" else ""
        caption = f"{where}. {bands}{used}{noise}"
        path = study.folder / f"{name}.png"
        heading = f"{heading}: {title}"
        error_chart(path, heading, rows, methods, measure=measure, label=label, caption=caption)
        charts.append(Chart(path.with_suffix(".svg"), heading, first=measure == "relmse"))
    if everything:
        path = study.folder / "error-all-light.png"
        heading = (
            "All light: Mitsuba's path against its own reference; "
            + title.partition(";")[2].strip()
        )
        caption = f"{where}. Another quantity than in the other charts, hence not to be compared with them."
        error_chart(path, heading, everything, methods, caption=caption)
        charts.append(Chart(path.with_suffix(".svg"), heading))
    known = methods
    methods = [method for method in methods if any(row.method == method for row in rows)]
    if len(methods) > 1 and any(c.gained for c in found):
        path = study.folder / "ratio.png"
        heading = f"Gain over {named_baseline(found[0].baseline)}: {title}"
        bars = f"Bars: two standard errors over {seeds}. {rows[0].processor}."
        ratio_chart(path, heading, found, total, methods, known=known, caption=bars)
        charts.insert(1, Chart(path.with_suffix(".svg"), heading, first=True))
    return charts


CROWDED = 1.75
"""Load average a core, own work inside, above which times say more about other processes than about methods."""

BIAS_ERRORS = 4.0
BIAS_SHARE = 0.05


NOISY_REFERENCE = 0.1
"""Relative standard error of a reference above which its noise is told, and random sampling is not called biased."""


def biased(study: Study, rows: Sequence[Row]) -> list[str]:
    """`bias_lines` of a study."""
    return bias_lines(study.floors(), rows)


def bias_lines(floors: Mapping[tuple[str, str], Estimate], rows: Sequence[Row]) -> list[str]:
    """A line for each method whose seeds err in common: what no time takes away.

    A noisy reference makes all methods err in common, so that it is what random sampling has not that counts, if that
    was measured. Told beyond four standard errors (dozens are tested), and where it makes a twentieth of the relMSE.
    """
    lines = []
    for scene, method in bias_tested(floors, rows):
        floor = floors[scene, method]
        last = [
            row.relmse
            for row in rows
            if (row.scene, row.method) == (scene, method) and row.time == row.longest
        ]
        error = sum(last) / len(last)
        base = floors.get((scene, BASELINE))
        if method == BASELINE or base is None:
            base = Estimate(0.0, 0.0)
        excess = Estimate(floor.value - base.value, math.hypot(floor.error, base.error))
        if excess.value > max(BIAS_ERRORS * excess.error, BIAS_SHARE * error):
            lines.append(
                f"BIASED? {method} on {scene_title(scene)}: of its relMSE {number(error, 3)} the seeds have "
                f"{with_error(excess)} in common, which is no noise"
            )
    return lines


def bias_tested(
    floors: Mapping[tuple[str, str], Estimate], rows: Sequence[Row]
) -> list[tuple[str, str]]:
    """Scene and method of what `bias_lines` tests: by a noisy reference only what stands beside random sampling."""
    return [
        (scene, method)
        for scene, method in floors
        if (method != BASELINE and (scene, BASELINE) in floors)
        or _reference_error(rows, scene) <= NOISY_REFERENCE
    ]


def _reference_error(rows: Sequence[Row], scene: str) -> float:
    return math.sqrt(max(row.reference_variance for row in rows if row.scene == scene))


def noisy_references(rows: Sequence[Row]) -> list[str]:
    """A line for each reference whose noise is to be known."""
    lines = []
    for scene in dict.fromkeys(row.scene for row in rows):
        error = _reference_error(rows, scene)
        if error > NOISY_REFERENCE:
            lines.append(
                f"the reference of {scene_title(scene)} is noisy (relative standard error {number(error, 2)}): its own "
                "variance is subtracted, but what it has of chance is the same in every relMSE and in no ±; look at "
                "gain / path, which asks the images alone, or raise --reference-time"
            )
    return lines


def with_error(estimate: Estimate | None) -> str:
    """A value and one standard error, in digits that the error leaves."""
    if estimate is None:
        return "–"
    value, error = estimate
    if not math.isfinite(error):
        return number(value, 3)
    return f"{number(value, 3)} ± {number(error, 2)}"


def _names(chosen: str) -> str:
    """What was chosen, without its options."""
    return ", ".join(dict.fromkeys(re.sub(r" *\([^)]*\)", "", part) for part in chosen.split("/")))


def choice_lines(picked: Sequence[Choice], unit: str) -> list[str]:
    """How often `auto` came near the best, and where it did not."""
    if not picked:
        return []
    close = sum(choice.close for choice in picked)
    told = [
        f"auto is within {100 * (CLOSE - 1):.0f} % of the best candidate in hindsight, beyond two standard errors, in "
        f"{close} of {len(picked)} cases of scene and budget."
    ]
    told += [
        f"not so: {scene_title(c.scene)} at {c.time:g} {unit}, {with_error(c.over)} times the error of {c.best}"
        for c in picked
        if not c.close
    ]
    return told


def _failures(study: Study) -> list[str]:
    return [f"left out: {name}: {why}" for name, why in study.failures.items()]


def machine_lines(
    ran: Sequence[Mapping[str, Any]], processor: str, mitsuba: str | None = None
) -> list[str]:
    """Processor, load and commit of runs that have `load_before`, `load_after` and `commit`; crowds are told first."""
    loads = [max(run["load_before"], run["load_after"]) for run in ran]
    commits = ", ".join(sorted({run["commit"] for run in ran}))
    mean, cores = sum(loads) / len(loads), _cores(processor)
    lines = [
        f"{processor}; load average up to {max(loads):.1f}, in the mean {mean:.1f}; "
        f"commit {commits}{'' if mitsuba is None else f'; Mitsuba {mitsuba}'}."
    ]
    if mean > CROWDED * cores:
        lines.insert(
            0,
            f"CROWDED: with a load of {mean:.1f} on {cores} cores others took much of each run's time; "
            "methods share a machine in different ways, so that ratios at equal time are not to be trusted",
        )
    return lines


def _cores(processor: str) -> int:
    """Of the machine that was measured on, as `store.processor` names it: the page may be written on another."""
    number = processor.partition(" ×")[0]
    return int(number) if number.isdigit() else os.cpu_count() or 1


def too_early(early: Sequence[Row]) -> list[str]:
    """Times at which a method had no image yet."""
    times: dict[tuple[str, str], set[float]] = {}
    for row in early:
        times.setdefault((row.scene, row.method), set()).add(row.time)
    return [
        f"no image yet: {method} on {scene_title(scene)} at {', '.join(f'{t:g}' for t in sorted(at))} s"
        for (scene, method), at in times.items()
    ]


def budgets(rows: Sequence[Row]) -> list[str]:
    """What each method's time counts."""
    methods: dict[str, list[str]] = {}
    for row in rows:
        named = methods.setdefault(row.budget, [])
        if row.method not in named:
            named.append(row.method)
    return [f"budget of {', '.join(names)}: {budget}" for budget, names in methods.items()]


def rich_table(sheet: Sheet) -> Table:
    """A table for the terminal."""
    table = Table(title=sheet.title, title_justify="left")
    for i, heading in enumerate(sheet.headings):
        table.add_column(heading, justify="left" if i < sheet.texts else "right")
    for row in sheet.rows:
        table.add_row(*row)
    return table
