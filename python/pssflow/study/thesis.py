"""`pssflow study thesis`: the source thesis in one program, and what it left open.

Its tables and figures on its own scenes under preset `thesis`, the thesis' numbers beside ours; training against
held-out loss; the hypercube prior; fireflies; random sampling for the same time; and experiments that tell why our
ratio of non-zero paths differs. All of it is kept part by part: run again, it goes on where it stopped.
"""

from __future__ import annotations

import time

import click

from ..output import make_folder
from ..params import Positive, Text
from ..terminal import Terminal

__all__ = ["thesis"]

STANDARD = ("scenes/teapot", "sanmiguel|scenes/courtyard")
"""The thesis' two scenes; the courtyard stands in where San Miguel is not there."""


class SceneNames(Text):
    """Scenes joined by commas."""

    name = "scenes"

    def read(self, text: str) -> tuple[str, ...]:
        """At least one."""
        names = tuple(name.strip() for name in text.split(","))
        if not all(names):
            raise ValueError(f"{text!r} names no scene; expected names joined by commas")
        return names


@click.command("thesis")
@click.option(
    "--scenes",
    type=SceneNames(),
    help="By commas: names (scenes/teapot) or XML files.  [default: scenes/teapot and San Miguel, or scenes/courtyard]",
)
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=0, show_default=True)
@click.option(
    "--pixels",
    type=click.IntRange(64, 1 << 24),
    help="Of a film, at most.  [default: 65536, the thesis' 256×256]",
)
@click.option(
    "--reference-time",
    type=Positive("number of seconds"),
    default=30.0,
    show_default=True,
    help="Seconds a scene for Mitsuba's reference; what is cached counts.",
)
@click.option(
    "--full",
    is_flag=True,
    help="All experiments in all parametrisations, not only for BSDF numbers.",
)
@click.option("-o", "--output", default="out/study-thesis", show_default=True, metavar="DIR")
@click.option("-q", "--quiet", is_flag=True, help="No progress, no notices.")
@click.pass_obj
def thesis(
    terminal: Terminal,
    scenes: tuple[str, ...] | None,
    seed: int,
    pixels: int | None,
    reference_time: float,
    full: bool,
    output: str,
    quiet: bool,
) -> None:
    """The source thesis reproduced: its tables and figures, its numbers beside ours, and what it left open.

    Writes results.csv, losses.csv, results.json, images, charts and report.html, which opens without a network, to DIR;
    run again, it goes on where it stopped.
    """
    from .parts import Parts
    from .sceneries import named_scenes
    from .thesis_findings import Findings
    from .thesis_report import publish
    from .thesis_scene import MOST_PIXELS, open_scene, render_runs, thesis_of
    from .thesis_tests import crescents, experiments, overfitting

    terminal.quiet = quiet
    start = time.perf_counter()
    plans = named_scenes(scenes or STANDARD)
    folder = make_folder(output)
    make_folder(folder / "images")
    parts = Parts(folder / "parts", terminal.say)
    pixels = pixels or MOST_PIXELS
    findings = Findings(folder, seed)
    findings.crescents = crescents(parts, seed)
    shown = []
    for plan in plans:
        scene = open_scene(plan, pixels)
        for note in scene.notes:
            terminal.note(f"{plan.name}: {note}")
        runs = render_runs(
            plan,
            scene,
            parts,
            folder,
            seed=seed,
            reference_time=reference_time,
            progress=not quiet,
        )
        findings.scenes.append(runs)
        known = thesis_of(plan.name)
        # What differs from the thesis is asked where it says what it found.
        if (known is not None and known.per_ray) or len(plans) == 1:
            findings.experiments[plan.name] = experiments(
                plan, scene, parts, runs.parametrisations, full=full, seed=seed, pixels=pixels
            )
            findings.losses[plan.name] = overfitting(
                scene, parts, runs.parametrisations[0], seed=seed
            )
        shown = publish(findings, time.perf_counter() - start)
    for part in shown:
        terminal.out.print(part, highlight=False, soft_wrap=isinstance(part, str))
