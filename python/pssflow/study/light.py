"""`pssflow study light`: the whole image against Mitsuba's `path` at the same depth, error by wall time.

Ratios are those of Mitsuba's `path`, in `llvm_ad_rgb` and with its own Russian roulette, ÷ the method.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import click

from ..params import Positive
from ..terminal import Terminal
from .times import Times

if TYPE_CHECKING:
    from ..progress import Progress
    from .harness import Method, Shot
    from .methods import Stage

__all__ = ["METHODS", "light", "whole_light"]

METHODS: dict[str, dict[str, Any]] = {
    "none": {"guide": "none"},
    "table": {"guide": "table"},
    "auto": {"guide": "auto"},
    "auto, roulette": {"guide": "auto", "rr_depth": 3},
}
"""Arguments of `pssflow.render` by the names that charts have; `rr_depth` only where the depth is beyond it."""

TIMES = (10.0, 30.0)
FULL_TIMES = (10.0, 30.0, 120.0)

NOTES = """\
All light up to a depth, each method against Mitsuba's path of the same depth. relMSE and variances are relative to the
square of the reference about each pixel, in the mean of its 24 neighbours; of relMSE the reference's own variance is
subtracted, * lies below it. “trimmed” leaves out the worst 0.1 % of pixels, which hides fireflies. spp are camera rays
to a pixel, which for pssflow are of one path length each: compare times, not samples. Ratios are those of mitsuba-path
÷ the method: above 1 is a gain; but cost is the method's ÷ mitsuba-path's. ± is one standard error over seeds; win and
loss are beyond two, at equal time. Each time is a run of its own, with pilot, probe and training inside."""


@click.command("light")
@click.argument("scenes", nargs=-1, metavar="[SCENES]...")
@click.option("--times", type=Times(), help="Seconds, by commas.  [default: 10,30]")
@click.option("--max-depth", type=click.IntRange(2, 33), default=6, show_default=True)
@click.option("--seeds", type=click.IntRange(1, 1000), default=3, show_default=True)
@click.option(
    "--pixels",
    type=click.IntRange(64),
    default=160_000,
    show_default=True,
    help="Of a film, about.",
)
@click.option("--threads", type=click.IntRange(1, 4096), help="[default: one a core]")
@click.option(
    "--reference-time",
    type=Positive("number of seconds"),
    default=120.0,
    show_default=True,
    help="Seconds a scene for Mitsuba's reference; what is cached counts.",
)
@click.option("--full", is_flag=True, help="All scenes, up to 120 s: many hours.")
@click.option("-o", "--output", default="out/study-light", show_default=True, metavar="DIR")
@click.option("-q", "--quiet", is_flag=True, help="No progress, no notices.")
@click.pass_obj
def light(
    terminal: Terminal,
    scenes: tuple[str, ...],
    times: tuple[float, ...] | None,
    max_depth: int,
    seeds: int,
    pixels: int,
    threads: int | None,
    reference_time: float,
    full: bool,
    output: str,
    quiet: bool,
) -> None:
    """Whole images against Mitsuba's path at the same depth: error × time, wins and losses.

    SCENES are XML files or names (`scenes/door-ajar`, `veach-ajar`); the default are six. Writes results.csv, tables,
    charts, EXRs and report.html to DIR; run again, it goes on where it stopped.
    """
    from ..passes import AllLightPass
    from ..variants import llvm_problem
    from .command import conduct
    from .methods import PATH, mitsuba
    from .report import publish
    from .sceneries import SIX, every_scene, named_scenes, scenery

    terminal.quiet = quiet
    problem = llvm_problem()
    if problem is not None:
        raise ValueError(f"{PATH}: {problem}")
    times = times or (FULL_TIMES if full else TIMES)
    what = f"all to depth {max_depth}"
    plans = named_scenes(scenes) if scenes else every_scene() if full else named_scenes(SIX)
    path = mitsuba(
        PATH,
        "llvm_ad_rgb",
        lambda stage, scene: AllLightPass(
            scene, 0, hide=stage.scene.hide_emitters, max_depth=max_depth
        ),
        threads,
        "s",
        {"integrator": "path", "max_depth": max_depth},
        light=what,
    )
    conduct(
        terminal,
        [
            scenery(plan, pixels, 2, reference_time, not quiet, terminal.note, what, max_depth)
            for plan in plans
        ],
        [
            path,
            *(
                whole_light(name, max_depth, threads, what, **arguments)
                for name, arguments in METHODS.items()
                if max_depth > arguments.get("rr_depth", 0)
            ),
        ],
        partial(publish, baseline=PATH, notes=NOTES),
        times=times,
        unit="s",
        seeds=seeds,
        pixels=pixels,
        k=0,
        threads=threads,
        reference_time=reference_time,
        output=output,
        heading=(
            f"all light to depth {max_depth}; a run of each of {', '.join(f'{t:g}' for t in times)} s for each seed, "
            "pilot, training and selection inside"
        ),
    )


def whole_light(
    name: str, max_depth: int, threads: int | None, light: str, **arguments: Any
) -> Method:
    """All light by pssflow, a render for each time.

    Args:
        name: as the charts have it.
        max_depth: longest path.
        threads: None for all cores.
        light: what it renders, as the scenes' truths say it.
        **arguments: `guide` and others of `pssflow.render`.
    """
    from .harness import Method

    def run(stage: Stage, seed: int, times: Sequence[float], progress: Progress) -> list[Shot]:
        return [
            _shot(
                stage.scene.render(
                    time=time,
                    max_depth=max_depth,
                    seed=seed,
                    threads=threads,
                    progress=progress,
                    **arguments,
                ),
                time,
            )
            for time in times
        ]

    return Method(
        name,
        run,
        {"max_depth": max_depth, **arguments},
        budget="probe, pilot, training, selection and rendering inside; loading and BVH outside",
        light=light,
    )


def _shot(result: Any, budget: float) -> Shot:
    """A whole light as a study takes it."""
    from .harness import Shot

    stats = result.stats
    height, width = result.image.shape[:2]
    return Shot(
        time=budget,
        elapsed=stats["elapsed"],
        image=result.image,
        variance=result.variance,
        spp=max(round(stats["camera_rays"] / (width * height)), 1),
        chosen=stats["chosen"],
        nonzero_share=stats["nonzero_share"],
        seconds={phase: stats["seconds"][phase] for phase in ("pilot", "fit", "render")},
    )
