"""What a study prints and writes from its rows: tables as text and Markdown, and charts."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any

from rich.table import Table

from ..files import write_beside
from ..metrics import Estimate
from ..report import markdown_table, number, scene_title
from .charts import error_chart, ratio_chart
from .harness import Study
from .store import Row
from .summary import BASELINE, CLOSE, Choice, cells, choices, overall

__all__ = ["biased", "publish"]

HEADINGS = (
    *("scene", "guide", "time", "spp", "relMSE", "trimmed", "MAPE", "own variance"),
    *("gain / path", "cost / path", "equal samples", "equal time", "verdict"),
)

NOTES = """\
Ratios are those of random sampling ÷ the guide: above 1 is a gain; but cost is the guide's ÷ random's. gain / path: the
images' own variance; equal samples and equal time: relMSE; cost: seconds a path with pilot and training inside.
± is one standard error over seeds; win and loss are beyond two. Of relMSE the reference's own relative variance is
subtracted; * lies below it. “trimmed” leaves out the worst 0.1 % of pixels, which hides fireflies. MAPE holds the
reference's noise. A time shorter than the run is a snapshot of it: its pilot was planned for the whole."""


def publish(study: Study, rows: Sequence[Row], title: str) -> list[Any]:
    """Writes summary.md, error.png and .svg, and ratio.png and .svg; returns what the command prints.

    Raises:
        OSError: a file cannot be written.
    """
    if not rows:
        return []
    methods = [m.name for m in study.methods if any(row.method == m.name for row in rows)]
    found, picked = cells(rows), []
    total = overall(found)
    table = [
        [
            scene_title(cell.scene),
            cell.method + (f" → {_names(cell.chosen)}" if cell.method == "auto" else ""),
            f"{cell.time:g} s",
            number(cell.spp, 3),
            with_error(cell.relmse) + ("*" if cell.drowned else ""),
            with_error(cell.relmse_trimmed),
            number(cell.mape.value, 3),
            with_error(cell.own_variance),
            with_error(cell.gain),
            with_error(cell.cost),
            with_error(cell.equal_samples),
            with_error(cell.equal_time),
            cell.verdict,
        ]
        for cell in found
    ]
    sums = [
        [
            o.method,
            f"{o.time:g} s",
            str(o.scenes),
            with_error(o.mean),
            with_error(o.gain),
            f"{o.wins} / {o.ties} / {o.losses}",
            f"{with_error(o.worst[1])} ({scene_title(o.worst[0])})",
        ]
        for o in total
    ]
    sum_headings = (
        *("guide", "time", "scenes", "equal time, geometric mean", "gain / path"),
        *("wins / ties / losses", "worst"),
    )
    if "auto" in methods:
        picked = choices(found)
    lines = [
        *_choice_lines(picked),
        *biased(study, rows),
        *_noisy_references(rows),
        *_failures(study),
        *_machine(rows),
    ]
    text = "\n\n".join(
        [
            f"# {title[0].upper()}{title[1:]}",
            markdown_table(HEADINGS, table, texts=2),
            NOTES,
            *([markdown_table(sum_headings, sums, texts=2)] if sums else []),
            *lines,
        ]
    )
    write_beside(
        study.folder / "summary.md", lambda part: part.write_text(text + "\n", encoding="utf-8")
    )
    seeds = max((cell.seeds for cell in found), default=1)
    caption = (
        f"{rows[0].width}×{rows[0].height} pixels and the like, {seeds} seeds, {rows[0].processor}; "
        "lines are means over seeds, bands reach from the least to the largest. Points lie at the seconds really used."
    )
    error_chart(
        study.folder / "error.png", f"Error against time: {title}", rows, methods, caption=caption
    )
    if any(method != BASELINE for method in methods) and any(c.equal_time for c in found):
        ratio_chart(
            study.folder / "ratio.png",
            f"Gain over random sampling: {title}",
            found,
            total,
            methods,
            caption=f"Bars: two standard errors over {seeds} seeds. {rows[0].processor}.",
        )
    shown: list[Any] = [_rich(HEADINGS, table), NOTES]
    if sums:
        shown.append(_rich(sum_headings, sums))
    return [*shown, *lines, f"wrote {study.folder}: results.csv, summary.md, charts, images"]


BIAS_ERRORS = 4.0
BIAS_SHARE = 0.05


NOISY = 0.1
"""Relative standard error of a reference above which relMSE itself is off: it divides by the reference's square."""


def biased(study: Study, rows: Sequence[Row]) -> list[str]:
    """A line for each method whose seeds err in common: what no time takes away.

    A noisy reference makes all methods err in common, so that it is what random sampling has not that counts, if that
    was measured. Told beyond four standard errors (dozens are tested), and where it makes a twentieth of the relMSE.
    """
    lines = []
    floors = study.floors()
    for (scene, method), floor in floors.items():
        last = [
            row.relmse
            for row in rows
            if (row.scene, row.method, row.time) == (scene, method, study.times[-1])
        ]
        error = sum(last) / len(last)
        base = floors.get((scene, BASELINE), Estimate(0.0, 0.0))
        if method == BASELINE:
            base = Estimate(0.0, 0.0)
            if _reference_error(rows, scene) > NOISY:
                continue
        excess = Estimate(floor.value - base.value, math.hypot(floor.error, base.error))
        if excess.value > max(BIAS_ERRORS * excess.error, BIAS_SHARE * error):
            lines.append(
                f"BIASED? {method} on {scene_title(scene)}: of its relMSE {number(error, 3)} the seeds have "
                f"{with_error(excess)} in common, which is no noise"
            )
    return lines


def _reference_error(rows: Sequence[Row], scene: str) -> float:
    return math.sqrt(max(row.reference_variance for row in rows if row.scene == scene))


def _noisy_references(rows: Sequence[Row]) -> list[str]:
    lines = []
    for scene in dict.fromkeys(row.scene for row in rows):
        error = _reference_error(rows, scene)
        if error > NOISY:
            lines.append(
                f"the reference of {scene_title(scene)} is noisy (relative standard error {number(error, 2)}): "
                "its relMSE is too large for all methods, and its ratios too near 1; raise --reference-time"
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


def _choice_lines(picked: Sequence[Choice]) -> list[str]:
    if not picked:
        return []
    close = sum(choice.close for choice in picked)
    told = [
        f"auto is within {100 * (CLOSE - 1):.0f} % of the best candidate in hindsight, beyond two standard errors, in "
        f"{close} of {len(picked)} cases of scene and time."
    ]
    told += [
        f"not so: {scene_title(c.scene)} at {c.time:g} s, {with_error(c.over)} times the error of {c.best}"
        for c in picked
        if not c.close
    ]
    return told


def _failures(study: Study) -> list[str]:
    return [f"left out: {name}: {why}" for name, why in study.failures.items()]


def _machine(rows: Sequence[Row]) -> list[str]:
    loads = [max(row.load_before, row.load_after) for row in rows]
    commits = ", ".join(sorted({row.commit for row in rows}))
    return [
        f"{rows[0].processor}; load average up to {max(loads):.1f}, in the mean {sum(loads) / len(loads):.1f}; "
        f"commit {commits}; Mitsuba {rows[0].mitsuba}."
    ]


def _rich(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    table = Table()
    for i, heading in enumerate(headings):
        table.add_column(heading, justify="left" if i < 2 else "right")
    for row in rows:
        table.add_row(*row)
    return table
