"""What `pssflow study thesis` writes and prints: the thesis' tables beside ours, findings, files, the page."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from .. import _core
from ..files import write_beside
from ..metrics import finite_or_none
from ..output import write_json
from ..reference import read_exr
from ..report import count, number, percent, scene_title
from ..thesis import CAMERA_RAYS, PARAMETERS
from .page import Chart, View, viewer_scene, write_page
from .report import Sheet, machine_lines, rich_table, write_summary
from .store import processor
from .thesis_charts import (
    crescent_chart,
    experiment_chart,
    loss_chart,
    phase_chart,
    render_picture,
)
from .thesis_findings import Findings, differs, failing_prior, over, overfit
from .thesis_scene import PHASES, ThesisRun, ThesisRuns
from .thesis_tests import Found

__all__ = ["publish"]

NOTES = f"""\
Preset `thesis`: next-event estimation alone; 16 spp of random numbers teach and are discarded, 16 spp are drawn from
the flow alone. Nothing guards these (a = 0): where the flow puts no samples, light is missing. Camera rays: here pixels
× spp; the thesis' {count(CAMERA_RAYS)} are 260² × 16, since PBRT samples the filter's border, too. Found: paths whose
two vertices exist; a learned sample outside the cube is a camera ray, but no path found. Share: non-zero ÷ found. Per
ray: non-zero ÷ camera rays, learned ÷ random. What exactly the thesis counts as found is not known here: compare how a
share changes, not its level. s: pilot, training, rendering. relMSE: against Mitsuba's reference, relative to the square
of the reference about each pixel, the reference's own variance subtracted; the thesis has no such number. “trimmed”
leaves out the worst 0.1 % of the pixels. The thesis says that its network has {count(PARAMETERS)} parameters; what it
describes has the number in Table 1."""


def publish(findings: Findings, seconds: float) -> list[Any]:
    """Writes results.csv, losses.csv, results.json, summary.md, charts and report.html; what the command prints.

    Raises:
        OSError: a file cannot be written.
    """
    folder = findings.folder
    rows = [_row(runs, run) for runs in findings.scenes for run in runs.runs]
    rows += [_experiment_row(scene, f) for scene, fs in findings.experiments.items() for f in fs]
    write_table(folder / "results.csv", rows)
    losses = [{"scene": scene, **fit} for scene, fits in findings.losses.items() for fit in fits]
    for fit in losses:
        fit.pop("ran", None)
    if losses:
        write_table(folder / "losses.csv", losses)
    sheets = [
        _table_2(findings),
        _ratios(findings),
        _table_1(findings),
        *(_experiments(findings) if findings.experiments else []),
        _fireflies(findings),
        _phases(findings),
    ]
    lines = [*differs(findings), *overfit(findings), *failing_prior(findings)]
    lines += [f"{runs.name}: {runs.thesis.caption}" for runs in findings.scenes if runs.thesis]
    lines += [f"reference of {runs.name}: {runs.truth.note}" for runs in findings.scenes]
    ran = [run.stats["ran"] for runs in findings.scenes for run in runs.runs]
    lines += machine_lines(ran, processor())
    title = (
        "The thesis in one program: light of exactly 2 bounces, NEE, 16 spp learned after a pilot of 16 spp that is "
        f"discarded; seed {findings.seed}"
    )
    write_summary(folder / "summary.md", title, sheets, [NOTES, *lines])
    write_json(folder / "results.json", {"runs": rows, "losses": losses, "findings": lines})
    write_page(
        folder,
        title,
        sheets=sheets,
        charts=_charts(findings),
        scenes=[scene for runs in findings.scenes for scene in _viewer(runs)],
        lines=lines,
        notes=NOTES,
        unit="spp",
        heading="Figures",
    )
    written = (
        f"wrote {folder} in {seconds:.0f} s: report.html, results.csv, results.json, summary.md, charts (.png, .svg), "
        "images (.exr)"
    )
    return [*(rich_table(sheet) for sheet in sheets), NOTES, *lines, written]


def _table_2(findings: Findings) -> Sheet:
    headings = (
        *("scene", "direction", "numbers", "budget", "camera rays", "s", "found", "non-zero"),
        *("share", "thesis", "relMSE", "trimmed"),
    )
    rows = []
    for runs in findings.scenes:
        for run in runs.runs:
            stats = run.stats
            shares = None if runs.thesis is None else runs.thesis.shares.get(run.parametrisation)
            beside = (
                ""
                if shares is None or run.kind.column is None
                else f"{shares[run.kind.column]:.2f} %"
            )
            rows.append(
                [
                    scene_title(runs.name),
                    run.parametrisation,
                    run.kind.title,
                    stats["budget"],
                    count(stats["camera_rays"]),
                    f"{run.seconds:.1f}",
                    count(stats["paths_found"]),
                    count(stats["nonzero"]),
                    percent(stats["nonzero_share"]),
                    beside,
                    number(stats["relmse"], 3),
                    number(stats["relmse_trimmed"], 3),
                ]
            )
    return Sheet("Table 2: paths, with the thesis' shares beside ours", headings, rows, texts=4)


def _ratios(findings: Findings) -> Sheet:
    headings = (
        *("scene", "direction", "share random → learned", "thesis"),
        *("found per ray", "thesis", "non-zero per ray", "thesis"),
    )
    rows = []
    for runs in findings.scenes:
        for parametrisation in runs.parametrisations:
            own = runs.of(parametrisation)
            random, learned = own["random"].stats, own["learned"].stats
            shares = None if runs.thesis is None else runs.thesis.shares.get(parametrisation)
            per_ray = None if runs.thesis is None else runs.thesis.per_ray.get(parametrisation)
            found = over(_found(learned), _found(random))
            rows.append(
                [
                    scene_title(runs.name),
                    parametrisation,
                    f"{percent(random['nonzero_share'])} → {percent(learned['nonzero_share'])}",
                    "" if shares is None else f"{shares[0]:.2f} % → {shares[1]:.2f} %",
                    f"{found:.2f}",
                    # Its two figures say it: per ray = found per ray × share.
                    ""
                    if shares is None or per_ray is None
                    else f"{per_ray * shares[0] / shares[1]:.2f}",
                    f"{runs.ratio(parametrisation):.2f}",
                    "" if per_ray is None else f"{per_ray:.1f}",
                ]
            )
    title = "Learned ÷ random, per camera ray"
    return Sheet(title, headings, rows, texts=2, summary=True)


def _table_1(findings: Findings) -> Sheet:
    headings = (
        *(
            "scene",
            "direction",
            "camera rays of the pilot",
            "training samples",
            "outliers left out",
        ),
        *("drawn for training", "parameters", "samples a parameter"),
    )
    rows = []
    for runs in findings.scenes:
        for parametrisation in runs.parametrisations:
            stats = runs.of(parametrisation)["learned"].stats
            training = stats["training"]
            parameters = training["guide"]["parameters"]
            rows.append(
                [
                    scene_title(runs.name),
                    parametrisation,
                    count(stats["pilot"]["camera_rays"]),
                    count(training["trained_on"]),
                    count(training["outliers_removed"]),
                    count(training["samples"]),
                    count(parameters),
                    f"{training['trained_on'] / parameters:.2f}",
                ]
            )
    return Sheet(
        "Table 1: training samples at 16 spp (the thesis' own are not at hand)", headings, rows
    )


def _experiments(findings: Findings) -> list[Sheet]:
    headings = (
        *(
            "scene",
            "direction",
            "experiment",
            "would explain",
            "learned ÷ random",
            "found",
            "share",
        ),
        *("of random", "outside the cube", "held-out loss", "gain / path"),
    )
    rows = [
        [
            scene_title(scene),
            f.parametrisation,
            f.experiment.name,
            f.experiment.tells,
            f"{f.ratio:.2f}",
            f"{over(f.value['found_per_ray'], f.value['random_found_per_ray']):.2f}",
            percent(f.value["share"]),
            percent(f.value["random_share"]),
            percent(f.value["mass_outside"]),
            number(f.value["loss"], 3),
            number(finite_or_none(over(f.value["random_variance"], f.value["variance"])), 3),
        ]
        for scene, found in findings.experiments.items()
        for f in found
    ]
    return [Sheet("What would explain the thesis' ratio", headings, rows, texts=4)]


def _fireflies(findings: Findings) -> Sheet:
    headings = (
        *(
            "scene",
            "direction",
            "numbers",
            "fireflies",
            "error in the worst .1 %",
            "brightest ÷ mean",
        ),
        *("max f/m ÷ mean", "max 1/m", "effective ÷ all paths"),
    )
    rows = []
    for runs in findings.scenes:
        for run in runs.runs:
            stats = run.stats
            rows.append(
                [
                    scene_title(runs.name),
                    run.parametrisation,
                    run.kind.title,
                    count(stats["firefly"]["count"]),
                    percent(stats["firefly"]["share"]),
                    number(stats["firefly"]["brightest"], 3),
                    number(stats["max_contribution"], 3),
                    number(stats["max_weight"], 3),
                    percent(over(stats["ess"] or 0.0, stats["camera_rays"])),
                ]
            )
    title = "Fireflies: pixels ten times as bright as the reference about them"
    return Sheet(title, headings, rows, texts=3)


def _phases(findings: Findings) -> Sheet:
    headings = (
        *("scene", "direction", "numbers", "pilot s", "training s", "rendering s", "spp", "relMSE"),
        "random ÷ learned",
    )
    rows = []
    for runs in findings.scenes:
        for parametrisation in runs.parametrisations:
            own = runs.of(parametrisation)
            for kind in ("learned", "random-time"):
                run = own[kind]
                gain = over(own["random-time"].stats["relmse"], own["learned"].stats["relmse"])
                rows.append(
                    [
                        scene_title(runs.name),
                        parametrisation,
                        run.kind.title,
                        *(f"{run.stats['seconds'][phase]:.2f}" for phase in PHASES),
                        count(sum(part["spp"] for part in run.stats["passes"])),
                        number(run.stats["relmse"], 3),
                        number(finite_or_none(gain), 3) if kind == "learned" else "",
                    ]
                )
    title = (
        "Time by phase beside random sampling for the same time (below 1: the thesis' method loses)"
    )
    return Sheet(title, headings, rows, texts=3)


def _charts(findings: Findings) -> list[Chart]:
    folder = findings.folder
    charts = []

    def add(paths: Sequence[Path], title: str, text: str = "") -> None:
        svg = next(path for path in paths if path.suffix == ".svg")
        charts.append(Chart(svg, title, first=True, text=text))

    for prior, value in findings.crescents.items():
        paths = crescent_chart(folder / f"crescent-{prior}.png", value, prior, findings.seed)
        figures = "Figures 8 and 9" if prior == "gaussian" else "The same with the failing prior"
        add(paths, f"{figures}: a crescent to latent numbers and back, prior {prior}")
    for runs in findings.scenes:
        path = folder / f"renders-{scene_title(runs.name)}.png"
        render_picture(path, runs)
        what = f"Figures 10 to 17, {scene_title(runs.name)}: renders with highlighted crops"
        charts.append(Chart(path, what, first=True))
    for scene, found in findings.experiments.items():
        runs = next(runs for runs in findings.scenes if runs.name == scene)
        thesis = {} if runs.thesis is None else runs.thesis.per_ray
        path = folder / f"experiments-{scene_title(scene)}.png"
        add(
            experiment_chart(path, scene, found, thesis, findings.seed),
            "What would explain the thesis' ratio",
        )
    for scene, fits in findings.losses.items():
        path = folder / f"losses-{scene_title(scene)}.png"
        runs = next(runs for runs in findings.scenes if runs.name == scene)
        add(
            loss_chart(path, scene, runs.parametrisations[0], fits),
            "Training against held-out loss",
        )
    add(phase_chart(folder / "phases.png", findings.scenes, findings.seed), "Time by phase")
    return charts


def _viewer(runs: ThesisRuns) -> list[dict[str, Any]]:
    """A scene of the viewer for each parametrisation."""

    def view(run: ThesisRun) -> View:
        error = number(run.stats["relmse"], 3)
        return View(
            run.kind.title, read_exr(run.image).image, f"{run.stats['budget']}, relMSE {error}"
        )

    return [
        viewer_scene(
            f"{scene_title(runs.name)}, {parametrisation}",
            runs.truth,
            [view(run) for run in runs.of(parametrisation).values()],
        )
        for parametrisation in runs.parametrisations
    ]


def _row(runs: ThesisRuns, run: ThesisRun) -> dict[str, Any]:
    """A line of results.csv."""
    stats = run.stats
    training = stats["training"] or {}
    shares = None if runs.thesis is None else runs.thesis.shares.get(run.parametrisation)
    column = run.kind.column
    return {
        "scene": runs.name,
        "of": "table 2",
        "parametrisation": run.parametrisation,
        "name": run.kind.name,
        "guide": stats["guide"],
        "chosen": stats["chosen"],
        "budget": stats["budget"],
        "seed": stats["seed"],
        "spp": sum(part["spp"] for part in stats["passes"]),
        **{key: stats[key] for key in ("camera_rays", "paths_found", "nonzero", "nonzero_share")},
        "thesis_share": None if shares is None or column is None else shares[column] / 100,
        "per_ray": run.per_ray,
        "ratio": runs.ratio(run.parametrisation) if run.kind.name == "learned" else None,
        "thesis_ratio": runs.thesis.per_ray.get(run.parametrisation)
        if runs.thesis is not None and run.kind.name == "learned"
        else None,
        "trained_on": training.get("trained_on"),
        "parameters": training.get("guide", {}).get("parameters"),
        "mass_outside": training.get("guide", {}).get("mass_outside"),
        **{f"seconds_{phase}": stats["seconds"][phase] for phase in PHASES},
        "relmse": stats["relmse"],
        "relmse_trimmed": stats["relmse_trimmed"],
        "variance": stats["variance"],
        **{key: stats[key] for key in ("max_weight", "max_contribution", "ess")},
        **{f"firefly_{key}": value for key, value in stats["firefly"].items()},
        **_common(stats["ran"]),
    }


def _experiment_row(scene: str, found: Found) -> dict[str, Any]:
    """A line of results.csv, with what it shares with `_row`."""
    value, experiment = found.value, found.experiment
    return {
        "scene": scene,
        "of": "experiment",
        "parametrisation": found.parametrisation,
        "name": experiment.name,
        "guide": experiment.guide,
        "chosen": experiment.guide,
        "budget": f"{experiment.pilot_spp} spp of a pilot, discarded; 16 spp",
        "spp": 16,
        "nonzero_share": value["share"],
        "per_ray": value["per_ray"],
        "ratio": found.ratio,
        "trained_on": value["trained_on"],
        "parameters": value["parameters"],
        "mass_outside": value["mass_outside"],
        "held_out_loss": value["loss"],
        "variance": value["variance"],
        **_common(value["ran"]),
    }


def _common(ran: Mapping[str, Any]) -> dict[str, Any]:
    return {**ran, "version": _core.__version__, "processor": processor()}


def write_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Rows as CSV: every key is a column, in the order in which they appear.

    Raises:
        OSError: it cannot be written.
    """
    names = list(dict.fromkeys(key for row in rows for key in row))

    def write(part: Path) -> None:
        with part.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, names, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)

    write_beside(path, write)


def _found(stats: Mapping[str, Any]) -> float:
    return stats["paths_found"] / max(stats["camera_rays"], 1)
