"""`pssflow study guides`: what each guide gains and costs, and what it comes to at equal time; `make study-guides`.

One run for each method, scene and seed to the longest time, with snapshots at the shorter ones; pilot, training and
selection are inside. Errors are against Mitsuba's references.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

from ..guide import choose, registry
from ..params import GuideNames, Positive
from ..terminal import Terminal
from .harness import Study
from .report import publish
from .sceneries import SIX, every_scene, named_scenes, pssflow_method, scenery
from .times import Times

__all__ = ["guides"]

STANDARD = ("none", "realnvp", "direction-table", "table", "auto")
"""Guides of the standard set."""

NET = "mixture-net+emitter-table+light-table"
"""Belongs to the standard set where it is registered."""

TIMES = (10.0, 30.0)
FULL_TIMES = (10.0, 30.0, 120.0)


@click.command("guides")
@click.argument("scenes", nargs=-1, metavar="[SCENES]...")
@click.option(
    "--guides", "names", type=GuideNames(), help="By commas.  [default: the standard set]"
)
@click.option("--times", type=Times(), help="Seconds, by commas.  [default: 10,30]")
@click.option("--seeds", type=click.IntRange(1, 1000), default=3, show_default=True)
@click.option(
    "--pixels",
    type=click.IntRange(64),
    default=160_000,
    show_default=True,
    help="Of a film, about.",
)
@click.option("--k", type=click.IntRange(1, 32), default=2, show_default=True, help="Bounces.")
@click.option("--threads", type=click.IntRange(1, 4096), help="[default: one a core]")
@click.option(
    "--reference-time",
    type=Positive("number of seconds"),
    default=120.0,
    show_default=True,
    help="Seconds a scene for Mitsuba's reference; what is cached counts.",
)
@click.option("--full", is_flag=True, help="All scenes, all guides, up to 120 s: many hours.")
@click.option("-o", "--output", default="out/study-guides", show_default=True, metavar="DIR")
@click.option("-q", "--quiet", is_flag=True, help="No progress, no notices.")
@click.pass_obj
def guides(
    terminal: Terminal,
    *,
    scenes: tuple[str, ...],
    names: tuple[str, ...] | None,
    times: tuple[float, ...] | None,
    seeds: int,
    pixels: int,
    k: int,
    threads: int | None,
    reference_time: float,
    full: bool,
    output: str,
    quiet: bool,
) -> None:
    """What each guide gains, what it costs, and what both come to at equal time; what `auto` chose.

    SCENES are XML files or names (`scenes/door-ajar`, `veach-ajar`); the default are six. Writes results.csv, tables
    and charts to DIR; run again, it goes on where it stopped.
    """
    terminal.quiet = quiet
    chosen, missing = (all_guides() if full else standard_guides(), [])
    if names is None and not full and NET not in chosen:
        missing.append(NET)
    chosen = names or chosen
    for name in chosen:
        choose(name, {})
    for name in missing:
        terminal.note(f"{name} is not among the guides of this version and is left out")
    plans = named_scenes(scenes) if scenes else every_scene() if full else named_scenes(SIX)
    times = times or (FULL_TIMES if full else TIMES)
    study = Study(
        folder=Path(output),
        sceneries=[
            scenery(plan, pixels, k, reference_time, not quiet, terminal.note) for plan in plans
        ],
        methods=[pssflow_method(name, k, threads) for name in chosen],
        times=times,
        seeds=range(seeds),
        settings={"k": k, "emitter_strategy": "mis", "threads": threads or 0},
        say=terminal.say,
        progress=not quiet,
    )
    study.publish = lambda rows: publish(study, rows, title(times, k))
    rows = study.run()
    if not rows:
        raise RuntimeError("there is nothing to show: no scene could be rendered")
    for part in publish(study, rows, title(times, k)):
        terminal.out.print(part, highlight=False, soft_wrap=isinstance(part, str))


def standard_guides() -> tuple[str, ...]:
    """The standard set, as far as this version has it."""
    known = registry()
    net = [NET] if set(NET.split("+")) <= set(known) else []
    return (*STANDARD[:-1], *net, STANDARD[-1])


def all_guides() -> tuple[str, ...]:
    """Everything that can render by itself."""
    standard = standard_guides()
    more = [name for name in registry() if name not in standard]
    return (*standard[:-1], *more, standard[-1])


def title(times: Sequence[float], k: int) -> str:
    """What a chart shows, and what is inside its time."""
    shorter = f", snapshots at {', '.join(f'{t:g}' for t in times[:-1])} s" if times[:-1] else ""
    bounces = "1 bounce" if k == 1 else f"{k} bounces"
    return (
        f"light of exactly {bounces}, all with MIS; one run of {times[-1]:g} s a seed{shorter}; "
        "pilot, training and selection inside"
    )
