"""What the commands of the studies have in common: their options, and a run from these to the last table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..params import GuideNames, Positive
from ..terminal import Terminal
from .times import Samples, Times

if TYPE_CHECKING:
    from .harness import Method, Scenery, Study
    from .store import Row

__all__ = ["Defaults", "conduct", "study_command"]


@dataclass(frozen=True)
class Defaults:
    """What a study does where it is not told otherwise, and with `--full`."""

    methods: Callable[[bool], Sequence[str]]
    """Standard methods, or all of them; those that this machine lacks are left out, with a notice."""
    times: Sequence[float]
    full_times: Sequence[float]
    output: str
    full: str
    """Help of `--full`."""


def study_command(name: str, defaults: Defaults) -> Callable[[Callable[[], None]], click.Command]:
    """Makes a click command of a function whose docstring says what the study shows."""
    times = ",".join(f"{t:g}" for t in defaults.times)

    def decorate(function: Callable[[], None]) -> click.Command:
        @wraps(function)
        def command(terminal: Terminal, **options: Any) -> None:
            _run(terminal, defaults, **options)

        shown: Any = click.pass_obj(command)
        for option in reversed(
            (
                click.argument("scenes", nargs=-1, metavar="[SCENES]..."),
                click.option(
                    "--guides",
                    "names",
                    type=GuideNames(),
                    help="Methods, by commas.  [default: the standard set]",
                ),
                click.option(
                    "--times", type=Times(), help=f"Seconds, by commas.  [default: {times}]"
                ),
                click.option(
                    "--spp",
                    type=Samples(),
                    help="Samples per pixel in place of seconds, as 8,32: rows that repeat but for times.",
                ),
                click.option("--seeds", type=click.IntRange(1, 1000), default=3, show_default=True),
                click.option(
                    "--pixels",
                    type=click.IntRange(64),
                    default=160_000,
                    show_default=True,
                    help="Of a film, about.",
                ),
                click.option(
                    "--k", type=click.IntRange(1, 32), default=2, show_default=True, help="Bounces."
                ),
                click.option(
                    "--threads", type=click.IntRange(1, 4096), help="[default: one a core]"
                ),
                click.option(
                    "--reference-time",
                    type=Positive("number of seconds"),
                    default=120.0,
                    show_default=True,
                    help="Seconds a scene for Mitsuba's reference; what is cached counts.",
                ),
                click.option("--full", is_flag=True, help=defaults.full),
                click.option(
                    "-o", "--output", default=defaults.output, show_default=True, metavar="DIR"
                ),
                click.option("-q", "--quiet", is_flag=True, help="No progress, no notices."),
            )
        ):
            shown = option(shown)
        return click.command(name)(shown)

    return decorate


def _run(
    terminal: Terminal,
    defaults: Defaults,
    *,
    scenes: tuple[str, ...],
    names: tuple[str, ...] | None,
    times: tuple[float, ...] | None,
    spp: tuple[float, ...] | None,
    seeds: int,
    pixels: int,
    k: int,
    threads: int | None,
    reference_time: float,
    full: bool,
    output: str,
    quiet: bool,
) -> None:
    # Mitsuba takes a second to import, and --help should not.
    from .methods import PATH, missing, named_method
    from .report import publish
    from .sceneries import SIX, every_scene, named_scenes, scenery
    from .store import ALL, BOUNCES

    terminal.quiet = quiet
    if times and spp:
        raise ValueError("`--times` and `--spp` were both given; give one")
    chosen = []
    for name in names or defaults.methods(full):
        why = missing(name)
        if why is None:
            chosen.append(name)
        elif names:
            raise ValueError(f"{name}: {why}")
        else:
            terminal.note(f"{name} is left out: {why}")
    unit = "spp" if spp else "s"
    times = spp or times or tuple(defaults.full_times if full else defaults.times)
    # Plain `path` renders all light: scenes of their own, with their truth.
    lights = [BOUNCES] * any(name != PATH for name in chosen) + [ALL] * (PATH in chosen)
    plans = named_scenes(scenes) if scenes else every_scene() if full else named_scenes(SIX)
    sceneries = [
        scenery(plan, pixels, k, reference_time, not quiet, terminal.note, light)
        for plan in plans
        for light in lights
    ]
    conduct(
        terminal,
        sceneries,
        [named_method(name, k, threads, unit) for name in chosen],
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


def conduct(
    terminal: Terminal,
    sceneries: Sequence[Scenery],
    methods: Sequence[Method],
    publish: Callable[[Study, Sequence[Row], str], Sequence[Any]],
    *,
    times: Sequence[float],
    unit: str,
    seeds: int,
    pixels: int,
    k: int,
    threads: int | None,
    reference_time: float,
    output: str,
    heading: str | None = None,
) -> None:
    """Runs what is not there yet; publishes scene after scene, and prints what `publish` returns in the end.

    `heading` says what is shown; None for light of k bounces.

    Raises:
        RuntimeError: there is nothing to show; the message says why.
    """
    from .harness import Study

    study = Study(
        folder=Path(output),
        sceneries=sceneries,
        methods=methods,
        times=times,
        seeds=range(seeds),
        settings={
            "k": k,
            "emitter_strategy": "mis",
            "threads": threads or 0,
            "pixels": pixels,
            "reference_time": reference_time,
        },
        say=terminal.say,
        progress=not terminal.quiet,
        unit=unit,
    )
    shown = heading or title(times, k, unit)
    study.publish = lambda rows: publish(study, rows, shown)
    rows = study.run()
    if not rows:
        raise RuntimeError(
            "there is nothing to show: no scene could be rendered"
            + "".join(f"; {what}: {why}" for what, why in study.failures.items())
        )
    for part in publish(study, rows, shown):
        terminal.out.print(part, highlight=False, soft_wrap=isinstance(part, str))


def title(times: Sequence[float], k: int, unit: str = "s") -> str:
    """What a chart shows, and what is inside its budget."""
    bounces = "1 bounce" if k == 1 else f"{k} bounces"
    if unit == "spp":
        return (
            f"light of exactly {bounces}, all with MIS; a run of each of {', '.join(f'{t:g}' for t in times)} samples "
            "per pixel for each seed, a guide's pilot inside"
        )
    shorter = f", snapshots at {', '.join(f'{t:g}' for t in times[:-1])} s" if times[:-1] else ""
    return (
        f"light of exactly {bounces}, all with MIS; one run of {times[-1]:g} s a seed{shorter}; "
        "pilot, training and selection inside"
    )
