"""`pssflow study stability`: every planted failure with every guide; a table and a chart of what holds."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ...params import Text
from ...terminal import Terminal

if TYPE_CHECKING:
    from .case import Case, Effort
    from .measure import Bench

__all__ = ["stability"]


class Names(Text):
    """Names joined by commas."""

    name = "names"

    def read(self, text: str) -> tuple[str, ...]:
        """The names; which there are is checked when they are looked up."""
        names = tuple(part.strip() for part in text.split(","))
        if not all(names):
            raise ValueError(f"{text!r} are no names; expected some, joined by commas")
        return names


@click.command("stability")
@click.option("--cases", type=Names(), help="Names or numbers, by commas.  [default: all]")
@click.option("--guides", type=Names(), help="By commas; thesis is its method.  [default: eight]")
@click.option("--seeds", type=click.IntRange(2, 1000), default=8, show_default=True)
@click.option("--spp", type=click.IntRange(2, 4096), default=64, show_default=True)
@click.option(
    "--side", type=click.IntRange(2, 512), default=16, show_default=True, help="Of a film, pixels."
)
@click.option("--quick", is_flag=True, help="A setting a case, tiny films, short training: a look.")
@click.option(
    "--page",
    type=click.Path(exists=True, dir_okay=False),
    metavar="FILE",
    help="Also fills the table into FILE, between its marks, and puts pictures into the folder of that name.",
)
@click.option("--threads", type=click.IntRange(1, 4096), help="[default: one a core]")
@click.option("-o", "--output", default="out/study-stability", show_default=True, metavar="DIR")
@click.option("-q", "--quiet", is_flag=True, help="No progress, no notices.")
@click.pass_obj
def stability(
    terminal: Terminal,
    cases: tuple[str, ...] | None,
    guides: tuple[str, ...] | None,
    seeds: int,
    spp: int,
    side: int,
    quick: bool,
    page: str | None,
    threads: int | None,
    output: str,
    quiet: bool,
) -> None:
    """Planted failures × guides: what holds, what degrades, what fails, each with its figure.

    Writes results.csv, summary.md and a chart to DIR; run again, it goes on where it stopped.
    """
    # Mitsuba takes a second to import, and --help should not.
    from ...guide import choose
    from ...output import make_folder
    from ..store import configuration
    from .case import QUICK, THESIS, Effort
    from .measure import measure
    from .registry import CASES, STANDARD
    from .results import Row, Rows, fill_page, publish

    terminal.quiet = quiet
    chosen = list(CASES.values())
    if cases is not None:
        known = {str(case.number): case for case in chosen} | dict(CASES)
        if unknown := [name for name in cases if name not in known]:
            raise ValueError(f"there is no case {unknown[0]!r}; there are {', '.join(CASES)}")
        chosen = [known[name] for name in cases]
    names = guides or STANDARD
    for name in names:
        if name != THESIS:
            choose(name, {})
    effort = Effort(seeds=seeds, spp=spp, side=side, threads=threads)
    if quick:
        effort = dataclasses.replace(QUICK, seeds=min(seeds, 4), threads=threads)
    _variant()
    folder = make_folder(output)
    store = Rows(folder / "results.csv")
    rows: list[Row] = []
    done, total = 0, len(chosen) * len(names)
    titles = {case.name: f"{case.number}. {case.title}" for case in chosen}
    heading = (
        f"Planted failures: light of exactly 2 bounces, {effort.seeds} seeds, {effort.spp} spp in all (pilot inside) "
        f"where no case says otherwise, {effort.side} × {effort.side} pixels"
    )
    try:
        for case in chosen:
            benches: dict[str, Bench] = {}
            for guide in names:
                done += 1
                key = configuration(
                    case=[case.name, case.what, [s.name for s in case.settings]],
                    guide=guide,
                    effort={**dataclasses.asdict(effort), "threads": None},
                )
                row = store.find(key)
                if row is None:
                    terminal.say(f"[{done}/{total}] {case.number} {case.name}, {guide}")
                    with tempfile.TemporaryDirectory(prefix="pssflow-stability-") as scratch:
                        finding = measure(case, guide, effort, benches, Path(scratch))
                    if finding is None:
                        continue
                    row = Row.of(case, guide, finding, effort, key)
                    store.put(row)
                rows.append(row)
    except KeyboardInterrupt:
        if rows:
            publish(folder, rows, names, titles, heading)
        raise
    if not rows:
        raise ValueError("none of these guides has anything to do with these cases")
    terminal.out.print(publish(folder, rows, names, titles, heading))
    if page is not None:
        fill_page(Path(page), rows, names, titles, heading)
        strips = make_folder(Path(page).with_suffix(""))
        for case in chosen:
            if case.picture:
                terminal.say(f"picture of {case.number} {case.name}")
                _strip(strips / f"{case.name}.png", case, titles[case.name], names, effort)


def _variant() -> None:
    """A variant for scenes from dictionaries, where none is set: films are small, and nothing need be compiled."""
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant("scalar_rgb")


PICTURE_SIDE = 32
"""Of the pictures' films, where a case says nothing else: more than is measured, for there is something to see."""


def _strip(path: Path, case: Case, title: str, guides: Sequence[str], effort: Effort) -> None:
    """Truth, random numbers and guides of a case's first setting, a render each."""
    from ..verdicts import strip
    from .measure import Bench

    setting = dataclasses.replace(case.settings[0], side=max(PICTURE_SIDE, effort.side))
    bench = Bench.of(setting, dataclasses.replace(effort, seeds=1, truth=4))
    images = [("truth", bench.truth.mean(axis=0)), ("random", bench.random[0].image)]
    images += [(guide, bench.run(guide)[0].image) for guide in guides]
    size = f"{bench.effort.side} × {bench.effort.side} pixels, {bench.effort.spp} spp"
    strip(path, f"{title} ({setting.name}; {size})", images)
