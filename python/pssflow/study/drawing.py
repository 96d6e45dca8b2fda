"""What the charts of all studies share: a palette that colour-blind readers can tell apart, axes, and writing.

Methods are told apart by colour (Okabe and Ito's palette), marker and line, so that a copy in black and white can be
read, too. Every chart is written as PNG and as SVG.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..files import write_beside

__all__ = ["COLOURS", "LINES", "MARKERS", "MUTED", "finish", "new_figure", "plain_ticks"]

COLOURS = ("#000000", "#e69f00", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#7f7f7f")
MARKERS = "osD^vPX*<>h"  # not as many as colours: what has the same colour has another marker
LINES = ("-", "--", "-.", (0, (1, 1)), (0, (5, 1)), (0, (3, 1, 1, 1, 1, 1)))
MUTED = "#666666"


def plain_ticks(axis: Any) -> None:
    """1, 2, 5, 10 in place of 10⁰, 10¹: decades alone leave most of these axes without a number.

    Of an axis whose data are drawn; over more than two decades 1 and 3 are enough, over more than four 1.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = axis.get_view_interval()
    decades = math.log10(high / low) if 0.0 < low < high else 1.0
    subs = (1.0, 2.0, 5.0) if decades <= 2.0 else (1.0, 3.0) if decades <= 4.0 else (1.0,)
    axis.set_major_locator(LogLocator(10, subs=subs, numticks=12))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def new_figure(width: float, height: float) -> Any:
    """An empty figure, in inches; at least as wide as a legend needs."""
    # No pyplot: it would pick a window system and keep figures alive.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(max(width, 6.4), height), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def finish(figure: Any, path: Path, title: str, handles: Sequence[Any], caption: str) -> list[Path]:
    """Title, legend and caption; then both files."""
    width = figure.get_figwidth()
    wrapped = "\n".join(textwrap.wrap(title, int(width * 11)))
    figure.suptitle(wrapped, fontsize=11, x=0.01, ha="left")
    # The caption is the legend's heading: text of its own would lie over the legend.
    legend = figure.legend(
        handles=list(handles),
        loc="outside lower left",
        ncols=max(1, int(width // 2.1)),
        fontsize=8.5,
        frameon=False,
        title="\n".join(textwrap.wrap(caption, int(width * 14))) or None,
        title_fontsize=7.5,
        alignment="left",
    )
    legend.get_title().set_color(MUTED)
    written = [path.with_suffix(".png"), path.with_suffix(".svg")]
    for target in written:
        kind = target.suffix[1:]
        # Without a date two runs over the same rows give the same file.
        metadata = {"Date": None} if kind == "svg" else None
        write_beside(
            target,
            lambda part, kind=kind, metadata=metadata: figure.savefig(
                part, format=kind, metadata=metadata
            ),
        )
    return written
