"""The thesis' first scene, end to end: `make demo`.

For each parametrisation of direction five images: random numbers and numbers learned as in the thesis (its Table 2:
16 spp each, the learned ones after 16 spp of pilot that are discarded), both again at equal spp with the pilot
kept and a tenth of the paths random, which is how one would use the method, and at the same spp what `auto` chooses.
What the thesis lacks is the error, measured against Mitsuba's own rendering.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
from rich.table import Table

from ..compare import measured_reference, results_folder
from ..options import PARAMETRISATIONS
from ..output import write_json
from ..picture import Picture, Row
from ..reference import Reference
from ..render import Result
from ..report import count, number, panel, percent, reference_panel
from ..scene import Scene
from ..terminal import Terminal, run_command
from ..thesis import CAMERA_RAYS, SCENES

SCENE = Path("scenes/teapot/scene.xml")

REFERENCE_SECONDS = 40.0
"""On two cores the whole demo is to stay below three minutes."""

THESIS = SCENES["teapot"].shares
"""Its Table 2."""


@dataclass(frozen=True)
class Method:
    """A row of the table for each parametrisation."""

    name: str
    """As a file's name."""
    title: str
    guide: str
    arguments: dict[str, Any]
    thesis: int | None = None
    """Which of the thesis' two shares stands beside it."""


METHODS = (
    Method("none-16", "random", "none", {"spp": 16}, thesis=0),
    Method("realnvp-thesis", "realnvp as in the thesis", "realnvp", {}, thesis=1),
    Method("none-32", "random, equal spp", "none", {"spp": 32}),
    Method(
        "realnvp-kept",
        "realnvp, a = .1",
        "realnvp",
        {"spp": 32, "pilot_spp": 8, "uniform_fraction": 0.1, "keep_pilot": True},
    ),
    # Its share of random numbers is its own choice, which the preset would fix.
    Method("auto", "auto", "auto", {"spp": 32, "preset": None, "emitter_strategy": "nee"}),
)

NOTES = f"""\
camera rays: here 256² × spp. The thesis' {count(CAMERA_RAYS)} are 260² × 16: PBRT samples the filter's border, too.
found: paths whose two vertices exist; a learned sample outside the cube is a camera ray, but no path found.
share: non-zero ÷ found. The scene is rebuilt from the thesis' facts, and what exactly it counts as found is not known
here: compare how a share changes from random to learned, not its level.
s: pilot, training and rendering. gain: relMSE of random ÷ relMSE of this row at equal total spp; below 1 it is a loss.
As in the thesis, nothing guards its learned rows (a = 0): where the flow puts no samples, light is missing."""


@click.command("demo")
@click.option("-o", "--output", default="out/demo", show_default=True, help="Folder.")
@click.option("--scene", "path", default=str(SCENE), show_default=True, help="The teapot.")
@click.option("--scale", type=float, help="Factor on the film's size, for a quick look.")
@click.option("--reference-time", default=REFERENCE_SECONDS, show_default=True, help="Seconds.")
@click.pass_obj
def demo(
    terminal: Terminal, output: str, path: str, scale: float | None, reference_time: float
) -> None:
    """Random and learned sampling of the thesis' teapot, for all three parametrisations."""
    start = time.perf_counter()
    with results_folder(output) as folder:
        scene = Scene(path, scale=scale)
        for note in scene.notes:
            terminal.note(note)
        runs: dict[tuple[str, str], Result] = {}
        for parametrisation in PARAMETRISATIONS:
            for method in METHODS:
                terminal.say(f"rendering {parametrisation}: {method.title}")
                arguments: dict[str, Any] = {"preset": "thesis"} | method.arguments
                runs[parametrisation, method.name] = scene.render(
                    method.guide, parametrisation=parametrisation, **arguments
                )
        terminal.say(f"Mitsuba's reference, at most {reference_time:g} s unless it is cached")
        truth = measured_reference(scene, list(runs.values()), reference_time)
        for run in runs.values():
            run.measure(truth)
        _write(folder, scene, runs, truth)
    terminal.out.print(_table(runs))
    terminal.out.print(NOTES, highlight=False, soft_wrap=True)
    terminal.out.print(f"reference: {truth.note}", highlight=False, soft_wrap=True)
    terminal.out.print(
        f"{time.perf_counter() - start:.0f} s in all. Look at {folder / 'demo.png'}; images with "
        f"their variance and records (.exr, .json), and results.json, lie beside it.",
        highlight=False,
        soft_wrap=True,
    )


def _write(
    folder: Path, scene: Scene, runs: dict[tuple[str, str], Result], truth: Reference
) -> None:
    """EXRs with their records, the picture, results.json."""
    for (parametrisation, method), run in runs.items():
        image = folder / f"{parametrisation}-{method}.exr"
        run.write(image)
        write_json(image.with_suffix(".json"), run.stats)
    truth.write(folder / "reference.exr")
    write_json(
        folder / "results.json",
        {
            "reference": truth.describe(),
            "runs": [run.stats | {"method": key[1]} for key, run in runs.items()],
            "thesis": {
                "camera_rays": CAMERA_RAYS,
                "nonzero_share": SCENES["teapot"].describe()["nonzero_share"],
            },
        },
    )
    rows = [
        Row(
            [
                panel(
                    runs[parametrisation, method.name],
                    truth,
                    gain=_gain(runs, parametrisation, method),
                    title=f"{parametrisation}: {method.title}",
                )
                for method in METHODS
            ],
            note=note,
        )
        for parametrisation, note in zip(
            PARAMETRISATIONS, ("", _shares(runs), _LOOK_AT), strict=True
        )
    ]
    heading = (
        f"The thesis' teapot, light of exactly 2 bounces, {scene.width}×{scene.height}: "
        "random and learned numbers"
    )
    caption = f"reference: {truth.note}"
    Picture(heading, rows, reference_panel(truth), caption).draw(folder / "demo.png")


def _table(runs: dict[tuple[str, str], Result]) -> Table:
    """The thesis' Table 2, what it lacks, and its numbers."""
    shown = Table(
        title="Light of exactly two bounces, NEE, seed 0", title_justify="left", title_style="bold"
    )
    shown.add_column("direction")
    shown.add_column("numbers")
    shown.add_column("budget")
    for heading in ("camera rays", "s", "found", "non-zero", "share", "thesis"):
        shown.add_column(heading, justify="right")
    for heading in ("relMSE", "trimmed", "gain"):
        shown.add_column(heading, justify="right")
    for parametrisation in PARAMETRISATIONS:
        for method in METHODS:
            stats = runs[parametrisation, method.name].stats
            phases = ("pilot", "fit", "render")
            thesis = THESIS[parametrisation]
            shown.add_row(
                parametrisation if method is METHODS[0] else "",
                method.title,
                stats["budget"],
                count(stats["camera_rays"]),
                f"{sum(stats['seconds'][phase] for phase in phases):.1f}",
                count(stats["paths_found"]),
                count(stats["nonzero"]),
                percent(stats["nonzero_share"]),
                "" if method.thesis is None else f"{thesis[method.thesis]:.2f} %",
                number(stats["relmse"]),
                number(stats["relmse_trimmed"]),
                _gain(runs, parametrisation, method),
                end_section=method is METHODS[-1],
            )
    return shown


def _gain(runs: dict[tuple[str, str], Result], parametrisation: str, method: Method) -> str:
    """Error (relMSE) of random numbers at the same total spp ÷ this method's."""
    if method.guide == "none":
        return ""
    plain = runs[parametrisation, "none-32"].stats["relmse"]
    own = runs[parametrisation, method.name].stats["relmse"]
    return f"{plain / own:.2f}" if plain and own else "–"


def _shares(runs: dict[tuple[str, str], Result]) -> str:
    """The thesis' headline and ours in words."""
    lines = ["Non-zero paths of those found,", "random → learned:"]
    for parametrisation in PARAMETRISATIONS:
        own = [runs[parametrisation, m.name].stats["nonzero_share"] for m in METHODS[:2]]
        thesis = THESIS[parametrisation]
        lines += [
            "",
            parametrisation,
            f"  here {percent(own[0])} → {percent(own[1])}",
            f"  thesis {thesis[0]:.2f} % → {thesis[1]:.2f} %",
        ]
    return "\n".join(lines)


_LOOK_AT = """\
What to look for

Columns 1 and 2 are the thesis' Table 2:
16 spp each, but the second one spent
another 16 on its pilot.

Columns 3 to 5 spend the same, so that
their errors can be compared: a gain
below 1 is a loss. auto conditions its
tables on where a path is.
"""


if __name__ == "__main__":
    sys.exit(run_command(demo))
