"""`pssflow study speed-accuracy`: error against wall time of guides, Mitsuba and others; `make study-speed-accuracy`.

As `pssflow study guides`, with more times and with competitors: Mitsuba's path tracer for k-bounce light, and a guide
of another make. What each time counts stands in every row (`budget`).
"""

from __future__ import annotations

from .command import Defaults, study_command

__all__ = ["speed_accuracy"]

STANDARD = ("none", "table", "auto", "mitsuba-llvm", "python-vegas")


def standard(full: bool) -> list[str]:
    """The standard set, an hour; with `full` all guides, and all that is Mitsuba's.

    That is its scalar variant, where Python's own speed is measured, and its `path` with all light, which takes
    references of its own.
    """
    if not full:
        return list(STANDARD)
    from .guides import standard as guides
    from .methods import OTHERS

    return [*guides(full=True), *OTHERS]


@study_command(
    "speed-accuracy",
    Defaults(
        methods=standard,
        times=(1.0, 3.0, 10.0, 30.0),
        full_times=(1.0, 3.0, 10.0, 30.0, 100.0),
        output="out/study-speed-accuracy",
        full="All scenes, all methods, up to 100 s: many hours.",
    ),
)
def speed_accuracy() -> None:
    """Error against wall time: guides, Mitsuba (mitsuba-llvm, mitsuba-scalar) and python-vegas, training inside.

    mitsuba-path is all light by Mitsuba's path, against its own reference: charted apart, compared with no other. It
    takes part with --full, or where --guides names it.

    SCENES are XML files or names (`scenes/door-ajar`, `veach-ajar`); the default are six. Writes results.csv, tables,
    charts, EXRs and report.html, which opens without a network, to DIR; run again, it goes on where it stopped.
    """
