"""The pictures of `inspect`: panels with labelled axes, in colours that do not depend on telling red from green."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .files import write_beside
from .picture import display, exposure_of

if TYPE_CHECKING:
    from .inspect import AtPixel, ImageMaps

__all__ = ["draw_maps", "draw_pixel"]

Array = NDArray[Any]

EXPOSED = 0.995
"""This quantile of a panel is shown brightest."""


def draw_pixel(found: AtPixel, path: str | Path) -> None:
    """Upper row: over the numbers u₀, u₁; lower row: over directions, the normal in the middle.

    Raises:
        OSError: the file cannot be written.
    """
    columns = 2 + len(found.guides)
    figure, axes = _figure(2, columns, 3.2, 2.55)
    x, y = found.pixel
    figure.suptitle(
        f"{found.scene}: pixel {x},{y}, k = {found.k}; guides at {found.spp} spp, pilot and training inside",
        fontsize=11,
    )
    densities = [found.best, *(g.density for g in found.guides)]
    top = max(float(np.quantile(np.stack(densities), EXPOSED)), 1.0)
    spherical = [g.per_steradian for g in found.guides]
    round_top = float(np.nanquantile(np.stack(spherical), EXPOSED)) if spherical else 1.0
    _numbers(figure, axes[0][0], found.f, "f, other numbers averaged", "W·sr⁻¹·m⁻²", None)
    _numbers(figure, axes[0][1], found.best, "best density, ∝ √mean f²", "density", top)
    _disk(figure, axes[1][0], found.f_directions, "f, over directions at x₁", "W·sr⁻²·m⁻²", None)
    axes[1][1].axis("off")
    axes[1][1].text(
        0.0,
        0.95,
        "Directions: equal-area projection,\nthe normal in the middle, the horizon\nas the rim; only such as meet "
        f"another\nsurface. Densities are the mixture\nm = a + (1 − a) q that paths are drawn\nfrom.\n\nx₁ = "
        f"({', '.join(f'{v:.3g}' for v in found.position)})\nnormal = ({', '.join(f'{v:.2f}' for v in found.normal)})",
        va="top",
        fontsize=8.5,
    )
    for i, guide in enumerate(found.guides):
        title = f"{guide.name}\n{guide.training}"
        _numbers(figure, axes[0][2 + i], guide.density, title, "density", top)
        _disk(figure, axes[1][2 + i], guide.per_steradian, guide.name, "density, sr⁻¹", round_top)
    _save(figure, path)


def draw_maps(found: ImageMaps, path: str | Path) -> None:
    """A row for random numbers, then one a guide: gain, share of paths that carry light, cells.

    Raises:
        OSError: the file cannot be written.
    """
    height, width = found.nonzero_share.shape
    wide = 3.4
    figure, axes = _figure(1 + len(found.rows), 3, wide, 0.66 * wide * height / width + 0.75)
    figure.suptitle(
        f"{found.scene}: k = {found.k}, {found.spp} spp each, guides with pilot and training inside",
        fontsize=11,
    )
    shares = [found.nonzero_share, *(row.nonzero_share for row in found.rows)]
    top = max(float(np.quantile(np.stack(shares), EXPOSED)), 1e-3)
    axes[0][0].imshow(display(found.image, exposure_of(found.image)), interpolation="nearest")
    _pixels(axes[0][0], "none: image")
    _map(
        figure,
        axes[0][1],
        found.nonzero_share,
        "none: paths with light",
        "share",
        "viridis",
        0,
        top,
    )
    error = found.relative_error
    most = float(np.nanquantile(error, 0.98)) if np.isfinite(error).any() else 1.0
    _map(figure, axes[0][2], error, "none: standard error ÷ mean", "ratio", "inferno", 0, most)
    for row, line in zip(found.rows, axes[1:], strict=True):
        # Purple where it pays, orange where it costs: as far on either side.
        logs = np.log2(row.gain)
        span = float(np.nanquantile(np.abs(logs), 0.98)) if np.isfinite(logs).any() else 1.0
        span = min(max(span, 1.0), 4.0)
        title = f"{row.name}: gain, {row.total_gain:.2g} in all\n{row.training}"
        _map(figure, line[0], logs, title, "log₂(variance of none ÷ guide)", "PuOr", -span, span)
        _map(
            figure,
            line[1],
            row.nonzero_share,
            f"{row.name}: paths with light",
            "share",
            "viridis",
            0,
            top,
        )
        if row.cells is None:
            line[2].axis("off")
            line[2].text(0.5, 0.5, "no cells", ha="center", va="center", fontsize=10)
            continue
        count = len(np.unique(row.cells[row.cells >= 0]))
        line[2].imshow(_coloured(row.cells), interpolation="nearest")
        _pixels(line[2], f"{row.name}: {count} cells at x₁")
    _save(figure, path)


def _figure(rows: int, columns: int, wide: float, tall: float) -> tuple[Any, Any]:
    # No pyplot: it would pick a window system and keep figures alive.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(columns * wide, rows * tall + 0.4), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def _save(figure: Any, path: str | Path) -> None:
    write_beside(path, lambda part: figure.savefig(part, format="png"))


def _bar(figure: Any, axes: Any, image: Any, label: str) -> None:
    bar = figure.colorbar(image, ax=axes, shrink=0.8, fraction=0.05)
    bar.set_label(label, fontsize=8)
    bar.ax.tick_params(labelsize=7)


def _limit(values: Array) -> float:
    seen = values[np.isfinite(values)]
    top = float(np.quantile(seen, EXPOSED)) if seen.size else 0.0
    return top if top > 0 else float(seen.max(initial=0.0)) or 1.0


def _numbers(
    figure: Any, axes: Any, values: Array, title: str, label: str, top: float | None
) -> None:
    image = axes.imshow(
        values, origin="lower", extent=(0, 1, 0, 1), cmap="viridis", vmin=0, vmax=top or _limit(values),
        interpolation="nearest",
    )  # fmt: skip
    axes.set_title(title, fontsize=9)
    axes.set_xlabel("u₀", fontsize=8)
    axes.set_ylabel("u₁", fontsize=8)
    axes.tick_params(labelsize=7)
    _bar(figure, axes, image, label)


def _disk(figure: Any, axes: Any, values: Array, title: str, label: str, top: float | None) -> None:
    image = axes.imshow(
        values, origin="lower", extent=(-1, 1, -1, 1), cmap="viridis", vmin=0, vmax=top or _limit(values),
        interpolation="nearest",
    )  # fmt: skip
    axes.set_title(title, fontsize=9)
    axes.set_xlabel("√(1 − cos θ) · cos φ", fontsize=8)
    axes.set_ylabel("√(1 − cos θ) · sin φ", fontsize=8)
    axes.tick_params(labelsize=7)
    _bar(figure, axes, image, label)


def _map(
    figure: Any,
    axes: Any,
    values: Array,
    title: str,
    label: str,
    colours: str,
    low: float,
    high: float,
) -> None:
    axes.set_facecolor("#bbbbbb")
    image = axes.imshow(values, cmap=colours, vmin=low, vmax=high, interpolation="nearest")
    _pixels(axes, title)
    _bar(figure, axes, image, label)


def _pixels(axes: Any, title: str) -> None:
    axes.set_title(title, fontsize=9)
    axes.set_xlabel("x, pixels", fontsize=8)
    axes.set_ylabel("y, pixels", fontsize=8)
    axes.tick_params(labelsize=7)


def _coloured(cells: NDArray[np.int64]) -> Array:
    """A colour a cell, neighbours apart in lightness; grey where there is none."""
    from matplotlib import colormaps

    ids, index = np.unique(cells, return_inverse=True)
    # The golden ratio's multiples: near ids lie far apart.
    colours = np.asarray(colormaps["viridis"]((np.arange(len(ids)) * 0.618034) % 1.0))[:, :3]
    colours[ids < 0] = 0.73
    return colours[index.reshape(cells.shape)]
