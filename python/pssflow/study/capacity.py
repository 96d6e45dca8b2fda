"""`pssflow study capacity`: error and predicted gain against a model's size at equal time; `make study-capacity`.

How small is enough: from nothing over tables of growing depth and finer bins to networks of growing width and flows of
growing depth, each with its training inside the time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import click

from ..params import Positive
from ..terminal import Terminal
from .guides import NET
from .times import Samples

if TYPE_CHECKING:
    from ..render import Result
    from ..scene import Scene
    from .harness import Method, Study
    from .store import Row

__all__ = ["FAMILIES", "Family", "capacity", "capacity_methods", "publish"]


@dataclass(frozen=True)
class Family:
    """Models that differ in one option."""

    name: str
    guide: str
    option: str
    """As the guide has it; in a composite it goes to each part that has it."""
    values: Sequence[int]
    fixed: Mapping[str, Any] = field(default_factory=dict)

    def label(self, value: int) -> str:
        """A model's name in tables."""
        return f"{self.name} {value}"


FAMILIES = (
    Family("table depth", "table", "depth", (0, 1, 2, 3, 4, 5)),
    Family("table bins", "table", "bins", (4, 8, 16, 32), {"depth": 4}),
    Family("net width", NET, "hidden", (4, 8, 16, 32, 64)),
    Family("flow couplings", "realnvp-logit", "couplings", (1, 2, 4, 8)),
)


@click.command("capacity")
@click.argument("scenes", nargs=-1, required=True, metavar="SCENE...")
@click.option(
    "--time",
    "seconds",
    type=Positive("number of seconds"),
    help="Seconds of a run, training inside.  [default: 10]",
)
@click.option("--spp", type=Samples(), help="Samples per pixel in place of seconds.")
@click.option("--seeds", type=click.IntRange(1, 1000), default=3, show_default=True)
@click.option(
    "--pixels", type=click.IntRange(64), default=40_000, show_default=True, help="Of a film, about."
)
@click.option("--k", type=click.IntRange(2, 32), default=2, show_default=True, help="Bounces.")
@click.option("--threads", type=click.IntRange(1, 4096), help="[default: one a core]")
@click.option(
    "--reference-time",
    type=Positive("number of seconds"),
    default=60.0,
    show_default=True,
    help="Seconds a scene for Mitsuba's reference; what is cached counts.",
)
@click.option("-o", "--output", default="out/study-capacity", show_default=True, metavar="DIR")
@click.option("-q", "--quiet", is_flag=True, help="No progress, no notices.")
@click.pass_obj
def capacity(
    terminal: Terminal,
    scenes: tuple[str, ...],
    seconds: float | None,
    spp: tuple[float, ...] | None,
    seeds: int,
    pixels: int,
    k: int,
    threads: int | None,
    reference_time: float,
    output: str,
    quiet: bool,
) -> None:
    """Error and predicted gain against the size of the model at equal time: how small is enough.

    SCENE is an XML file or a name (`scenes/door-ajar`). Writes results.csv, a table, charts and report.html to DIR; run
    again, it goes on where it stopped.
    """
    from .command import conduct
    from .sceneries import named_scenes, scenery

    terminal.quiet = quiet
    if seconds and spp:
        raise ValueError("`--time` and `--spp` were both given; give one")
    unit = "spp" if spp else "s"
    times = spp or (seconds or 10.0,)
    conduct(
        terminal,
        [
            scenery(plan, pixels, k, reference_time, not quiet, terminal.note)
            for plan in named_scenes(scenes)
        ],
        capacity_methods(k, threads, unit),
        publish,
        times=times,
        unit=unit,
        seeds=seeds,
        pixels=pixels,
        k=k,
        threads=threads,
        reference_time=reference_time,
        output=output,
    )


def capacity_methods(
    k: int, threads: int | None, unit: str, families: Sequence[Family] = FAMILIES
) -> list[Method]:
    """Random numbers, and each model of each family, with the gain that held-out paths foretell."""
    from ..guide import Guide
    from .methods import guided
    from .predicted import HeldOut

    held: dict[str, HeldOut] = {}

    def predict(scene: Scene, result: Result) -> float | None:
        if not isinstance(result.guide, Guide):
            return None
        if scene.hash not in held:
            held.clear()  # scene after scene: the paths of one are held at a time
            held[scene.hash] = HeldOut.of(scene, k)
        return held[scene.hash].gain(result.guide, result.stats["a"])

    methods = [guided("none", lambda: "none", k, threads, {}, unit)]
    for family in families:
        for value in family.values:
            options = {**family.fixed, family.option: value}
            methods.append(
                guided(
                    family.label(value),
                    lambda guide=family.guide: guide,
                    k,
                    threads,
                    {"guide": family.guide, **options},
                    unit,
                    predict,
                    **options,
                )
            )
    return methods


def publish(study: Study, rows: Sequence[Row], title: str) -> list[Any]:
    """Writes summary.md, charts and report.html; returns what the command prints.

    Raises:
        OSError: a file cannot be written.
    """
    from ..report import scene_title
    from .capacity_report import (
        NOTES,
        capacity_chart,
        capacity_sheet,
        enough,
        models,
    )
    from .page import Chart, study_scenes, write_page
    from .report import biased, budgets, machine_lines, noisy_references, rich_table, write_summary

    rows = [row for row in rows if row.spp]
    if not rows:
        return []
    found = models(rows, FAMILIES, study.times[-1])
    heading = f"Capacity: {title}"
    sheet = capacity_sheet(found, study.unit)
    lines = [
        *enough(found, FAMILIES, study.unit),
        *biased(study, rows),
        *noisy_references(rows),
        *(f"left out: {what}: {why}" for what, why in study.failures.items()),
        *budgets([row for row in rows if row.method in ("none", FAMILIES[0].label(0))]),
        *machine_lines([vars(row) for row in rows], rows[0].processor, rows[0].mitsuba),
    ]
    charts = []
    for scene in dict.fromkeys(row.scene for row in rows):
        path = study.folder / f"capacity-{scene_title(scene)}.png"
        own = [model for model in found if model.cell.scene == scene]
        what = f"Capacity, {scene_title(scene)}: {title}"
        about = next(row for row in rows if row.scene == scene)
        capacity_chart(path, what, own, FAMILIES, about, len(study.seeds))
        charts.append(Chart(path.with_suffix(".svg"), what, first=True))
    write_summary(study.folder / "summary.md", heading, [sheet], [NOTES, *lines])
    write_page(
        study.folder,
        heading,
        sheets=[sheet],
        charts=charts,
        scenes=study_scenes(study, rows),
        lines=lines,
        notes=NOTES,
        unit=study.unit,
    )
    written = f"wrote {study.folder}: report.html, results.csv, summary.md, charts, images"
    return [rich_table(sheet), NOTES, *lines, written]
