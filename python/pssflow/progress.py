"""Progress of long work, on stderr, where someone is looking."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Literal

__all__ = ["Listener", "Progress", "reporting"]

Listener = Callable[[str, float], None]
"""Called with the name of a phase and the share of it that is done, in [0, 1]."""

Progress = bool | Literal["always"] | Listener
"""True: bars, if stderr is a terminal; "always": bars in any case; False: nothing; or who is told instead."""

TITLES = {"pilot": "Pilot", "fit": "Fit", "render": "Render", "reference": "Reference"}


@contextmanager
def reporting(progress: Progress) -> Iterator[Listener | None]:
    """Yields who is to be told of progress, or None where nobody is; bars are removed at the end."""
    if callable(progress):
        yield progress
        return
    if progress is False or (progress != "always" and not sys.stderr.isatty()):
        yield None
        return

    from rich.console import Console
    from rich.progress import BarColumn, TaskID, TaskProgressColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    console = Console(stderr=True, force_terminal=True if progress == "always" else None)
    columns = (
        TextColumn("{task.description:<10}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
    )
    tasks: dict[str, TaskID] = {}
    with Bars(*columns, console=console, transient=True) as bars:

        def report(phase: str, done: float) -> None:
            if phase not in tasks:
                tasks[phase] = bars.add_task(TITLES.get(phase, phase), total=1.0)
            bars.update(tasks[phase], completed=done)

        yield report
