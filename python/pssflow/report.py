"""Runs in words and pictures: rich tables, and what stands above each image of a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from . import metrics
from .picture import Panel, Picture, Row, error_map
from .reference import Reference
from .render import Result
from .thesis import ThesisScene

__all__ = [
    "candidates_table",
    "choice_line",
    "compare_picture",
    "count",
    "gain",
    "lengths_table",
    "markdown_table",
    "number",
    "panel",
    "percent",
    "reference_panel",
    "runs_table",
    "scene_info",
    "scene_title",
]

MOST_BSDFS = 30
"""Rows of `pssflow info`'s table of BSDFs."""

PER_ROW = 4
"""Runs side by side in a picture, beside the reference."""


def runs_table(runs: Sequence[Mapping[str, Any]], thesis: ThesisScene | None = None) -> Table:
    """One row a run; columns that no run can fill are left out. The thesis' share stands beside ours if asked for."""
    shown = Table()
    measured = any(run["relmse"] is not None for run in runs)
    shown.add_column("guide")
    shown.add_column("budget")
    headings = ["a", "s", "camera rays", "found", "non-zero", "share"]
    if thesis is not None:
        headings.append(f"thesis, {thesis.title}")
    headings += ["relMSE", "trimmed", "gain"] if measured else ["rel. variance"]
    headings += ["max 1/m", "max f/m ÷ mean", "tail k"]
    for heading in headings:
        shown.add_column(heading, justify="right", overflow="fold")
    for run in runs:
        cells = [run["guide"], run["budget"]]
        if run["chosen"] != run["guide"]:
            cells[0] += f" → {run['chosen']}"
        cells += [
            number(run["a"], 3),
            number(run["seconds"]["total"], 3),
            count(run["camera_rays"]),
            count(run["paths_found"]),
            count(run["nonzero"]),
            percent(run["nonzero_share"]),
        ]
        if thesis is not None:
            share = thesis.share(run)
            cells.append("" if share is None else f"{share:.2f} %")
        if measured:
            cells += [number(run["relmse"]), number(run["relmse_trimmed"]), gain(run, runs)]
        else:
            cells.append(number(run["variance"]))
        cells += [number(run["max_weight"], 3), number(run["max_contribution"], 3)]
        # Those of a whole light stand with its lengths.
        tail = (run["diagnostics"] or {}).get("pareto_k")
        cells.append("" if tail is None else f"{tail:.2f}")
        shown.add_row(*cells)
    return shown


def choice_line(run: Mapping[str, Any]) -> str:
    """What `auto` chose and why, in a line."""
    chosen = next(c for c in run["candidates"] if c["chosen"])
    if chosen["name"] == "none":
        return f"auto: none; {chosen['why']}"
    return (
        f"auto: {chosen['name']} at a = {chosen['a']:.2g}; predicted gain {chosen['predicted_gain']:.3g}, "
        f"{chosen['net_gain']:.3g} after its cost: {chosen['why']}"
    )


def candidates_table(run: Mapping[str, Any]) -> Table:
    """What `auto` considered last, the best first; empty where there was nothing to choose."""
    shown = Table(title="what auto considered")
    shown.add_column("candidate")
    for heading in ("a", "predicted gain", "cost", "training", "net gain"):
        shown.add_column(heading, justify="right")
    shown.add_column("why")
    for candidate in run["candidates"] or ():
        shown.add_row(
            candidate["name"],
            number(candidate["a"], 2),
            number(candidate["predicted_gain"], 3),
            percent(candidate["cost_ratio"]),
            percent(candidate["training_share"]),
            number(candidate["net_gain"], 3),
            candidate["why"],
            style="bold" if candidate["chosen"] else None,
        )
    return shown


def lengths_table(run: Mapping[str, Any]) -> Table:
    """One row a path length of a whole light: what it got, what drew it, how much light it holds."""
    shown = Table(title="path lengths")
    shown.add_column("k", justify="right")
    shown.add_column("guide")
    for heading in ("spp", "s", "share of the light", "non-zero share", "rel. variance"):
        shown.add_column(heading, justify="right")
    whole = max(sum(run["mean"]), 1e-30)
    for length in run["lengths"]:
        seconds = sum(length["seconds"][name] for name in ("pilot", "fit", "render"))
        shown.add_row(
            str(length["k"]),
            length["chosen"],
            str(length["spp"]),
            number(seconds, 3),
            percent(sum(length["mean"]) / whole),
            percent(length["nonzero_share"]),
            number(length["variance"]),
        )
    return shown


def gain(run: Mapping[str, Any], runs: Sequence[Mapping[str, Any]]) -> str:
    """Error (relMSE) of the first run without a guide ÷ this run's; nothing where one of them is missing."""
    plain = next((r for r in runs if r["guide"] == "none"), None)
    if plain is None or plain is run or not plain["relmse"] or not run["relmse"]:
        return "" if plain is None or plain is not run else "1"
    return f"{plain['relmse'] / run['relmse']:.2f}"


def compare_picture(scene: str, runs: Sequence[Result], truth: Reference, caption: str) -> Picture:
    """The reference and all runs, a few to a row."""
    records = [run.stats for run in runs]
    panels = [panel(run, truth, gain=gain(run.stats, records)) for run in runs]
    rows = [Row(panels[i : i + PER_ROW]) for i in range(0, len(panels), PER_ROW)]
    stats = runs[0].stats
    bounces = "1 bounce" if stats["k"] == 1 else f"{stats['k']} bounces"
    how = f"{stats['parametrisation']}, {stats['emitter_strategy']}"
    heading = f"{scene_title(scene)}: light of exactly {bounces} ({how})"
    return Picture(heading, rows, reference_panel(truth), caption=caption)


def panel(run: Result, truth: Reference, *, gain: str = "", title: str = "") -> Panel:
    """One run's image with its budget word for word, its errors and its shares."""
    stats = run.stats
    won = f", gain {gain}" if gain not in ("", "1") else ""
    return Panel(
        title=title or stats["guide"],
        image=run.image,
        lines=[
            stats["budget"],
            f"relMSE {number(stats['relmse'])} (trimmed {number(stats['relmse_trimmed'])}){won}",
            f"non-zero {percent(stats['nonzero_share'])} of {count(stats['paths_found'])} paths found",
        ],
        error=error_map(run.image, truth.image, metrics.epsilon(truth.image)),
    )


def reference_panel(truth: Reference) -> Panel:
    """The truth, and how well it is known."""
    name = "Mitsuba’s path" if truth.k is not None else "reference"
    lines = []
    if truth.k is not None:
        lines.append("light of 1 bounce" if truth.k == 1 else f"light of {truth.k} bounces")
    if truth.spp:
        lines.append(f"{count(truth.spp)} spp, {truth.seconds:.0f} s")
    if truth.variance.any():
        lines.append(f"relative standard error {number(truth.standard_error, 2)}")
    return Panel(name, np.maximum(truth.image, 0.0), lines)


def scene_info(record: Mapping[str, Any]) -> list[Any]:
    """What `pssflow info` prints: tables, and lines of text."""
    found = Table()
    found.add_column("kind")
    found.add_column("understood")
    for kind, plugins in record["counts"].items():
        if plugins:
            found.add_row(kind, ", ".join(f"{n} {name}" for name, n in plugins.items()))
    found.add_row("triangles", count(record["triangles"]))
    if record["instances"]:
        found.add_row("instances", count(record["instances"]))
    found.add_row("arrays", _mebibytes(record["array_bytes"]))
    if memory := record["memory"]:
        parts = ", ".join(f"{name} {_mebibytes(size)}" for name, size in memory.items())
        found.add_row("memory", parts)
    if auto := record["auto"]:
        found.add_row("auto strategy", f"{auto['emitter_strategy']}: {auto['why']}")
    bsdfs = Table()
    bsdfs.add_column("BSDF")
    bsdfs.add_column("shapes", justify="right")
    bsdfs.add_column("understood as", overflow="fold")
    for bsdf in record["bsdfs"][:MOST_BSDFS]:
        bsdfs.add_row(bsdf["id"], count(bsdf["shapes"]), bsdf["what"])
    more = len(record["bsdfs"]) - MOST_BSDFS
    if more > 0:
        bsdfs.add_row(f"and {more} more", "", "all of them with --json")
    guides = Table()
    guides.add_column("guide")
    guides.add_column("what it is; options and defaults for --set")
    guides.add_row("none", "random numbers")
    for name, guide in record["guides"].items():
        options = ", ".join(f"{key}={_option(value)}" for key, value in guide["options"].items())
        guides.add_row(name, f"{guide['summary']}\n{options}")
    refused = [f"not supported: {line}" for line in record["unsupported"]]
    if refused:
        refused += [
            f"with --approximate: {line.partition(': ')[2]}" for line in record["with_approximate"]
        ]
        refused.append(
            "Replace it in the scene, or give --approximate."
            if record.get("approximate_helps")
            else "Replace it in the scene, or render it with Mitsuba's `path`."
        )
    light = [_probe_table(record["probe"])] if record["probe"] else []
    verdict = refused or ["Everything in it is supported."]
    return [record["scene"], found, bsdfs, *light, *verdict, guides]


def _probe_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Where the light is, by bounces, from a probe of random paths."""
    light = Table()
    light.add_column("light of exactly")
    for heading in ("mean luminance", "share of these", "paths found", "non-zero"):
        light.add_column(heading, justify="right")
    for row in rows:
        k = row["k"]
        name = "1 bounce (direct)" if k == 1 else f"{k} bounces"
        mean = f"{number(row['mean'], 3)} ± {number(row['standard_error'], 2)}"
        shares = [percent(row[key]) for key in ("share", "found_share", "nonzero_share")]
        light.add_row(name, mean, *shares)
    return light


def _mebibytes(size: int) -> str:
    return f"{size / 2**20:.1f} MiB"


def scene_title(name: str) -> str:
    """A scene's name without its folders: `scenes/teapot/scene.xml` is called `teapot`."""
    path = Path(name)
    return path.parent.name if path.name == "scene.xml" and path.parent.name else path.stem or name


def number(value: float | None, digits: int = 4) -> str:
    """A few significant digits; a dash for what is unknown."""
    if value is None:
        return "–"
    if value != 0 and not 1e-3 <= abs(value) < 1e5:
        return f"{value:.{digits - 1}e}"
    return f"{value:.{digits}g}"


def count(value: int) -> str:
    """Thousands apart."""
    return f"{value:,}".replace(",", " ")


def percent(share: float | None) -> str:
    """A share with two digits, as the thesis' tables have them."""
    return "–" if share is None else f"{100 * share:.2f} %"


def _option(value: Any) -> str:
    return "null" if value is None else str(value)


def markdown_table(
    headings: Sequence[str], rows: Sequence[Sequence[str]], *, texts: int = 1
) -> str:
    """A table in Markdown, whose first `texts` columns are words and the others numbers."""
    lines = [headings, [*["---"] * texts, *["--:"] * (len(headings) - texts)], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
