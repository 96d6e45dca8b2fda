"""`pssflow study guides`: what each guide gains and costs, and what it comes to at equal time; `make study-guides`.

One run for each method, scene and seed to the longest time, with snapshots at the shorter ones; pilot, training and
selection are inside. Errors are against Mitsuba's references.
"""

from __future__ import annotations

from .command import Defaults, study_command

__all__ = ["guides"]

STANDARD = ("none", "realnvp", "direction-table", "table")
NET = "mixture-net+emitter-table+light-table+ray-table"


def standard(full: bool) -> list[str]:
    """The standard set, or everything that can render by itself; `auto` comes last."""
    from ..guide import registry

    first = [*STANDARD, NET]
    more = [name for name in registry() if name not in first] if full else []
    return [*first, *more, "auto"]


@study_command(
    "guides",
    Defaults(
        methods=standard,
        times=(10.0, 30.0),
        full_times=(10.0, 30.0, 120.0),
        output="out/study-guides",
        full="All scenes, all guides, up to 120 s: many hours.",
    ),
)
def guides() -> None:
    """What each guide gains, what it costs, and what both come to at equal time; what `auto` chose.

    SCENES are XML files or names (`scenes/door-ajar`, `veach-ajar`); the default are six. Writes results.csv, tables,
    charts and report.html to DIR; run again, it goes on where it stopped.
    """
