"""The charts of planted failures: a grid of verdicts, and strips of small images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from ..files import write_beside
from ..picture import display, exposure_of
from .drawing import finish, new_figure

__all__ = ["VERDICT_COLOURS", "strip", "verdict_chart"]

VERDICT_COLOURS = {"holds": "#009e73", "degrades": "#e69f00", "fails": "#d55e00"}
"""Okabe and Ito's green, orange and vermilion; the words stand in the cells, too."""


def verdict_chart(
    path: Path,
    title: str,
    cases: Sequence[str],
    methods: Sequence[str],
    cells: Mapping[tuple[str, str], tuple[str, str]],
    caption: str = "",
) -> list[Path]:
    """A grid of cases × methods; a cell is a verdict of `VERDICT_COLOURS` and its figure. Cells may be missing.

    Raises:
        OSError: a file cannot be written.
    """
    from matplotlib.patches import Patch, Rectangle

    figure = new_figure(1.25 * len(methods) + 3.4, 0.38 * len(cases) + 1.9)
    axes = figure.add_subplot()
    for row, case in enumerate(cases):
        for column, method in enumerate(methods):
            verdict, text = cells.get((case, method), ("", "–"))
            colour = VERDICT_COLOURS.get(verdict, "#f2f2f2")
            box = {"facecolor": colour, "edgecolor": "white", "linewidth": 1.5, "alpha": 0.55}
            axes.add_patch(Rectangle((column, row), 1, 1, **box))
            shown = f"{verdict}\n{text}" if verdict else text
            where = {"ha": "center", "va": "center", "fontsize": 6.5}
            axes.text(column + 0.5, row + 0.5, shown, **where)
    axes.set_xlim(0, len(methods))
    axes.set_ylim(len(cases), 0)
    axes.set_xticks([i + 0.5 for i in range(len(methods))], methods, fontsize=8)
    axes.set_yticks([i + 0.5 for i in range(len(cases))], cases, fontsize=8)
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    for spine in axes.spines.values():
        spine.set_visible(False)
    handles = [
        Patch(facecolor=colour, alpha=0.55, label=verdict)
        for verdict, colour in VERDICT_COLOURS.items()
    ]
    return finish(figure, path, title, handles, caption)


def strip(path: Path, title: str, images: Sequence[tuple[str, NDArray[Any]]]) -> None:
    """Small images side by side under the first one's exposure, each with a line above it; a PNG.

    Raises:
        OSError: the file cannot be written.
    """
    exposure = exposure_of(images[0][1])
    figure = new_figure(1.35 * len(images), 1.75)
    figure.set_dpi(100)
    for i, (name, image) in enumerate(images):
        axes = figure.add_subplot(1, len(images), i + 1)
        axes.imshow(display(image, exposure), interpolation="nearest")
        axes.set_title(name, fontsize=7)
        axes.set_axis_off()
    figure.suptitle(title, fontsize=8, x=0.01, ha="left")
    write_beside(path, lambda part: figure.savefig(part, format="png"))
