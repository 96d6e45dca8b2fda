"""The side-by-side picture: images under one exposure, insets where methods differ most, maps of their errors.

Each image has three small ones below: two insets, framed in the colours of their frames in the image (solid orange,
dashed blue: told apart without colour, too), and the relative squared error in one scale for the whole picture.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .files import write_beside

Array = NDArray[Any]

FRAMES = (("#e69f00", "solid"), ("#56b4e9", (0, (3, 1.2))))
"""Colour (Okabe and Ito's palette) and line style of each inset's frame."""

BACKGROUND, INK, MUTED = "#ffffff", "#1a1a1a", "#555555"

INSET_SHARE = 5
"""An inset's side is the image's shorter side divided by this."""

EXPOSED = 0.97
"""This quantile of the reference's pixels that carry light is shown as white."""


@dataclass
class Panel:
    """One image of a picture."""

    title: str
    image: Array
    """Linear sRGB, (h, w, 3)."""
    lines: Sequence[str] = ()
    """Small print under the title."""
    error: Array | None = None
    """What the map shows, (h, w); `None` leaves it out."""
    error_title: str = "error²"


@dataclass(frozen=True)
class Window:
    """A crop: column and row of its upper left corner, and its side, in pixels."""

    x: int
    y: int
    side: int

    def cut(self, image: Array) -> Array:
        """The part of `image` in the window."""
        return image[self.y : self.y + self.side, self.x : self.x + self.side]

    def overlaps(self, other: Window) -> bool:
        """Whether two windows share a pixel."""
        return abs(self.x - other.x) < self.side and abs(self.y - other.y) < self.side


@dataclass(frozen=True)
class Row:
    """Panels side by side."""

    panels: Sequence[Panel]
    note: str = ""
    """Shown in place of the reference, in rows after the first."""


@dataclass
class Picture:
    """All that is drawn."""

    heading: str
    rows: Sequence[Row]
    reference: Panel | None = None
    caption: str = ""
    windows: list[Window] = field(default_factory=list)
    """Insets; chosen by `draw` where empty."""

    def draw(self, path: str | Path) -> None:
        """Writes the picture as PNG.

        Raises:
            OSError: the file cannot be written.
        """
        # No pyplot: it would pick a window system and keep figures alive.
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        panels = [panel for row in self.rows for panel in row.panels]
        windows = self.windows or choose_windows([p.error for p in panels if p.error is not None])
        guide = self.reference.image if self.reference else panels[0].image
        exposure = exposure_of(guide)
        insets = [exposure_of(window.cut(guide)) for window in windows]
        errors = [p.error for p in panels if p.error is not None]
        top = float(np.quantile(np.concatenate([e.ravel() for e in errors]), 0.99)) if errors else 1
        style = _Style(windows, insets, exposure, top or 1.0)

        first = 1 if self.reference else 0
        columns = first + max(len(row.panels) for row in self.rows)
        height, width = panels[0].image.shape[:2]
        wide = 2.75
        tall = wide * height / width
        texts = 0.27 + 0.17 * max(len(p.lines) for p in panels)
        small = wide / 3 + 0.2
        row_height = texts + tall + small + 0.22
        across = columns * (wide + 0.14) + 0.2
        note = (
            f"All images under one exposure (×{exposure:.3g}, sRGB); each inset under one of its own, "
            f"the same in every column ({', '.join(f'×{x:.3g}' for x in insets)}). "
            f"Maps (error²): relative squared error, smoothed, from black, 0, to yellow, {style.top:.2g} and more."
        )
        caption = _wrapped(f"{self.caption}\n{note}".strip(), across - 0.28)
        head, foot = 0.62, 0.34 + 0.165 * (caption.count("\n") + 1)
        total = (across, len(self.rows) * row_height + head + foot)
        figure = Figure(figsize=total, dpi=150, facecolor=BACKGROUND)
        FigureCanvasAgg(figure)
        page = _Page(figure, total, wide, tall, texts)

        page.text(0.14, 0.30, self.heading, size=13, weight="bold")
        for r, row in enumerate(self.rows):
            y = head + r * row_height
            if self.reference and r == 0:
                page.panel(self.reference, 0.14, y, style)
            elif self.reference:
                page.text(0.14, y + texts, row.note, size=9.5, linespacing=1.6)
            for c, panel in enumerate(row.panels):
                page.panel(panel, 0.14 + (first + c) * (wide + 0.14), y, style)
        foot_y = head + len(self.rows) * row_height
        page.text(0.14, foot_y + 0.12, caption, size=8, color=MUTED)
        write_beside(path, lambda part: figure.savefig(part, format="png"))


def choose_windows(errors: Sequence[Array], count: int = len(FRAMES)) -> list[Window]:
    """Crops where the largest and the smallest of the methods' errors (h, w) lie farthest apart, without overlap.

    A few fireflies would draw every crop to themselves, so that errors are cut at their .995 quantile first.
    """
    if not errors:
        return []
    height, width = errors[0].shape
    side = max(4, min(height, width) // INSET_SHARE)
    if side > min(height, width):
        return []
    cut = max(float(np.quantile(np.stack(errors), 0.995)), np.finfo(np.float32).tiny)
    sums = np.stack([_box_sums(np.minimum(error, cut), side) for error in errors])
    spread = sums.max(0) - sums.min(0) if len(errors) > 1 else sums[0]
    windows: list[Window] = []
    free = np.ones_like(spread, dtype=bool)
    while len(windows) < count and free.any():
        y, x = np.unravel_index(np.argmax(np.where(free, spread, -1.0)), spread.shape)
        windows.append(Window(int(x), int(y), side))
        free[max(0, y - side + 1) : y + side, max(0, x - side + 1) : x + side] = False
    return windows


def error_map(image: Array, reference: Array, epsilon: float) -> Array:
    """(x−r)²/(r²+ε), mean over channels, (h, w): the terms of relMSE."""
    return np.mean((image - reference) ** 2 / (reference**2 + epsilon), axis=-1)


@dataclass(frozen=True)
class _Style:
    """What all panels share."""

    windows: list[Window]
    insets: list[float]
    """Exposure of each window."""
    exposure: float
    top: float
    """Error shown brightest."""


@dataclass(frozen=True)
class _Page:
    """Places things on a figure by inches from its upper left corner."""

    figure: Any
    size: tuple[float, float]
    wide: float
    tall: float
    texts: float

    def axes(self, x: float, y: float, width: float, height: float) -> Any:
        """Empty axes without ticks."""
        across, down = self.size
        axes = self.figure.add_axes(
            (x / across, 1 - (y + height) / down, width / across, height / down)
        )
        axes.set_xticks([])
        axes.set_yticks([])
        for spine in axes.spines.values():
            spine.set_linewidth(0.6)
            spine.set_color("#999999")
        return axes

    def text(self, x: float, y: float, text: str, **style: Any) -> None:
        """Text whose upper left corner is given."""
        across, down = self.size
        style = {"color": INK, "va": "top", "linespacing": 1.35} | style
        self.figure.text(x / across, 1 - y / down, text, **style)

    def panel(self, panel: Panel, x: float, y: float, style: _Style) -> None:
        """One image with its title, insets and map."""
        from matplotlib.patches import Rectangle

        self.text(x, y, panel.title, size=10, weight="bold")
        self.text(x, y + 0.22, "\n".join(panel.lines), size=8.5, color=MUTED)
        shown = display(panel.image, style.exposure)
        y += self.texts
        axes = self.axes(x, y, self.wide, self.tall)
        axes.imshow(shown, interpolation="nearest")
        for window, (color, line) in zip(style.windows, FRAMES, strict=False):
            corner = (window.x - 0.5, window.y - 0.5)
            frame = {"fill": False, "edgecolor": color, "linestyle": line, "linewidth": 1.6}
            axes.add_patch(Rectangle(corner, window.side, window.side, **frame))
        gap = 0.05
        side = (self.wide - 2 * gap) / 3
        y += self.tall + gap
        for i, (window, (color, line)) in enumerate(zip(style.windows, FRAMES, strict=False)):
            inset = self.axes(x + i * (side + gap), y, side, side)
            inset.imshow(display(window.cut(panel.image), style.insets[i]), interpolation="nearest")
            for spine in inset.spines.values():
                spine.set(color=color, linestyle=line, linewidth=1.8)
        if panel.error is not None:
            self._error_map(panel, x + 2 * (side + gap), y, side, style.top)

    def _error_map(self, panel: Panel, x: float, y: float, side: float, top: float) -> None:
        """The map keeps the image's shape within the square of an inset."""
        assert panel.error is not None
        height, width = panel.error.shape
        scale = side / max(height, width)
        axes = self.axes(x, y, width * scale, height * scale)
        axes.imshow(_smooth(panel.error), cmap="inferno", vmin=0, vmax=top, interpolation="nearest")
        self.text(x, y + height * scale + 0.03, panel.error_title, size=7, color=MUTED)


def display(image: Array, exposure: float) -> Array:
    """Linear sRGB to display values in [0, 1]; what is not finite is shown in magenta."""
    linear = np.clip(np.asarray(image, np.float64) * exposure, 0.0, 1.0)
    shown = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    broken = ~np.isfinite(image).all(axis=-1)
    shown[broken] = (1.0, 0.0, 1.0)
    return shown


def _wrapped(text: str, inches: float) -> str:
    """Lines broken to fit a width, at matplotlib's 8 points: about 14 characters an inch."""
    lines = (textwrap.fill(line, int(14 * inches)) for line in text.splitlines())
    return "\n".join(lines)


def exposure_of(image: Array) -> float:
    """Factor that shows the bright end of an image just below white; 1 for a black one."""
    peak = np.max(np.nan_to_num(image, nan=0.0, posinf=0.0), axis=-1)
    lit = peak[peak > 0]
    return float(1.0 / np.quantile(lit, EXPOSED)) if lit.size else 1.0


def _box_sums(values: Array, side: int) -> Array:
    """Sums over all squares of `side` pixels, (h − side + 1, w − side + 1)."""
    table = np.zeros((values.shape[0] + 1, values.shape[1] + 1))
    table[1:, 1:] = np.cumsum(np.cumsum(values, axis=0, dtype=np.float64), axis=1)
    return table[side:, side:] - table[:-side, side:] - table[side:, :-side] + table[:-side, :-side]


def _smooth(values: Array, radius: int = 2) -> Array:
    """Mean over squares, smaller ones at the border: single pixels would be lost in a small map."""
    side = 2 * radius + 1
    padded = np.pad(values, radius)
    weight = np.pad(np.ones_like(values, dtype=np.float64), radius)
    return _box_sums(padded, side) / _box_sums(weight, side)
