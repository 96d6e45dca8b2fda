"""The pictures of `inspect`: panels with labelled axes, in colours that do not depend on telling red from green."""

from __future__ import annotations

import textwrap
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

DECADES = 3
"""Powers of ten that the colours of a density span."""

DARKEST = "#440154"
"""The lowest of viridis: what a density of zero looks like."""


def draw_pixel(found: AtPixel, path: str | Path) -> None:
    """Upper row: over the numbers u₀, u₁; lower row: over directions, the normal in the middle.

    Densities share one logarithmic scale a row, so that the guides can be compared with the best one.

    Raises:
        OSError: the file cannot be written.
    """
    columns = 2 + len(found.guides)
    figure, axes = _figure(2, columns, 2.75, 2.75)
    x, y = found.pixel
    figure.suptitle(
        f"{found.scene}: pixel {x},{y}, k = {found.k}; guides at {found.spp} spp, pilot and training inside",
        fontsize=11,
    )
    sphere = found.reach > 1
    below = (
        "the dashed circle the horizon, the rim straight below" if sphere else "the rim the horizon"
    )
    caption = (
        f"Directions at x₁ = ({', '.join(f'{v:.3g}' for v in found.position)}), "
        f"normal ({', '.join(f'{v:.2f}' for v in found.normal)}): equal-area projection, the normal in the middle, "
        f"{below}; such as meet another surface. Densities are the mixture m = a + (1 − a) q that paths are drawn "
        "from; best is the density of least variance, ∝ √mean f²."
    )
    figure.supxlabel(textwrap.fill(caption, 42 * columns), fontsize=8)
    shown = _numbers(axes[0][0], found.f, "f, mean over other numbers", _linear(found.f))
    _bar(figure, axes[0][0], "W·sr⁻¹·m⁻²", shown)
    values = found.f_directions
    shown = _disk(axes[1][0], values, "f a steradian", found.reach, _linear(values))
    _bar(figure, axes[1][0], "W·sr⁻²·m⁻²", shown)
    squares = [("best density", found.best, found.best_directions)]
    squares += [(_heading(g.name, g.training), g.density, g.per_steradian) for g in found.guides]
    scales = [_logarithmic([s[1] for s in squares]), _logarithmic([s[2] for s in squares])]
    upper: list[Any] = []
    lower: list[Any] = []
    for i, (title, density, per_steradian) in enumerate(squares, start=1):
        upper.append(_numbers(axes[0][i], density, title, scales[0]))
        lower.append(_disk(axes[1][i], per_steradian, "", found.reach, scales[1]))
    _bar(figure, list(axes[0][1:]), "density", *upper)
    _bar(figure, list(axes[1][1:]), "density, sr⁻¹", *lower)
    _save(figure, path)


def draw_maps(found: ImageMaps, path: str | Path) -> None:
    """A row for random numbers, then one a guide: gain, share of paths that carry light, cells.

    Gains have one scale in all rows, and shares another.

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
    figure.supxlabel(
        "Variances and means are taken over squares of 5 pixels; grey where one of them saw no light. "
        "Cells have random colours.",
        fontsize=8,
    )
    shares = [found.nonzero_share, *(row.nonzero_share for row in found.rows)]
    top = max(float(np.quantile(np.stack(shares), EXPOSED)), 1e-3)
    share = ("share", "viridis", (0.0, top))
    axes[0][0].imshow(display(found.image, exposure_of(found.image)), interpolation="nearest")
    _pixels(axes[0][0], "none: image")
    _map(figure, axes[0][1], found.nonzero_share, "none: paths with light", share)
    error = found.relative_error
    most = float(np.nanquantile(error, 0.98)) if np.isfinite(error).any() else 1.0
    _map(
        figure, axes[0][2], error, "none: standard error ÷ mean", ("ratio", "inferno", (0.0, most))
    )
    gains = [np.log2(row.gain) for row in found.rows]
    span = _span(gains)
    for row, gain, line in zip(found.rows, gains, axes[1:], strict=True):
        # Purple where it pays, orange where it costs: as far on either side.
        title = _heading(f"{row.name}: gain, {row.total_gain:.2g} in all", row.training)
        bar = _map(figure, line[0], gain, title, ("variance, none ÷ guide", "PuOr", (-span, span)))
        bar.set_ticks(range(-span, span + 1), labels=[_power(n) for n in range(-span, span + 1)])
        _map(figure, line[1], row.nonzero_share, f"{row.name}: paths with light", share)
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


def _bar(figure: Any, axes: Any, label: str, *images: Any) -> Any:
    """The colour bar of images of one scale, with a tip at an end beyond which they have values."""
    seen = [np.ma.compressed(np.ma.masked_invalid(image.get_array())) for image in images]
    values = np.concatenate(seen)
    low, high = images[0].get_clim()
    ends = {(True, True): "both", (True, False): "min", (False, True): "max"}
    beyond = bool((values < low).any()), bool((values > high).any())
    bar = figure.colorbar(images[0], ax=axes, shrink=0.8, extend=ends.get(beyond, "neither"))
    bar.set_label(label, fontsize=8)
    bar.ax.tick_params(labelsize=7)
    return bar


def _linear(values: Array) -> Any:
    """From 0 to nearly the largest of the values: a few are brighter by far."""
    from matplotlib.colors import Normalize

    seen = values[np.isfinite(values)]
    top = float(np.quantile(seen, EXPOSED)) if seen.size else 0.0
    return Normalize(0, top if top > 0 else float(seen.max(initial=0.0)) or 1.0)


def _logarithmic(densities: list[Array]) -> Any:
    """One scale for several densities, down to a `DECADES`th decade below the largest of all."""
    from matplotlib.colors import LogNorm

    top = max(float(np.nanmax(density, initial=0.0)) for density in densities) or 1.0
    return LogNorm(top * 10.0**-DECADES, top)


def _numbers(axes: Any, values: Array, title: str, scale: Any) -> Any:
    axes.set_facecolor(DARKEST)
    image = axes.imshow(
        np.ma.masked_less_equal(values, 0) if scale.vmin else values,
        origin="lower", extent=(0, 1, 0, 1), cmap="viridis", norm=scale, interpolation="nearest",
    )  # fmt: skip
    axes.set_title(title, fontsize=9)
    axes.set_xlabel("u₀", fontsize=8)
    axes.set_ylabel("u₁", fontsize=8)
    axes.set_xticks((0, 0.5, 1), ("0", "½", "1"))
    axes.set_yticks((0, 0.5, 1), ("0", "½", "1"))
    axes.tick_params(labelsize=7)
    return image


def _disk(axes: Any, values: Array, title: str, reach: float, scale: Any) -> Any:
    """Values over directions, with circles at 30° and 60° from the normal, and at 90° where that is not the rim."""
    from matplotlib.patches import Circle

    rim = Circle((0, 0), reach, facecolor=DARKEST, edgecolor="black", linewidth=0.8)
    axes.add_patch(rim)
    image = axes.imshow(
        np.ma.masked_less_equal(values, 0) if scale.vmin else values,
        origin="lower", extent=(-reach, reach, -reach, reach), cmap="viridis", norm=scale,
        interpolation="nearest", zorder=2,
    )  # fmt: skip
    image.set_clip_path(rim)
    for degrees in (30, 60, 90) if reach > 1 else (30, 60):
        radius = float(np.sqrt(1 - np.cos(np.radians(degrees))))
        style = "--" if degrees == 90 else ":"
        circle = Circle((0, 0), radius, fill=False, edgecolor="white", linestyle=style)
        circle.set(linewidth=0.7, zorder=3)
        axes.add_patch(circle)
        axes.text(
            0, radius, f"{degrees}°", color="white", fontsize=6, ha="center", va="bottom", zorder=3
        )
    axes.set(xlim=(-1.03 * reach, 1.03 * reach), ylim=(-1.03 * reach, 1.03 * reach), aspect="equal")
    axes.axis("off")
    axes.set_title(title, fontsize=9)
    return image


def _map(
    figure: Any, axes: Any, values: Array, title: str, scale: tuple[str, str, tuple[float, float]]
) -> Any:
    """Values by pixel with their colour bar; `scale` is its label, the colours, and from where to where they go."""
    label, colours, (low, high) = scale
    axes.set_facecolor("#bbbbbb")
    image = axes.imshow(values, cmap=colours, vmin=low, vmax=high, interpolation="nearest")
    _pixels(axes, title)
    return _bar(figure, axes, label, image)


def _span(gains: list[Array]) -> int:
    """Powers of two to either side of 1 that hold nearly all gains, 1 to 4."""
    seen = np.abs(np.concatenate([gain[np.isfinite(gain)] for gain in gains] or [np.zeros(0)]))
    return int(np.clip(np.ceil(np.quantile(seen, 0.98)), 1, 4)) if seen.size else 1


def _power(n: int) -> str:
    return f"{2**n}" if n >= 0 else f"1/{2**-n}"


def _heading(first: str, training: str) -> str:
    """A title; long names of composites go over several lines."""
    lines = textwrap.wrap(training.replace("+", "+ "), 36, break_on_hyphens=False)
    return "\n".join([first, *(line.replace("+ ", "+") for line in lines)])


def _pixels(axes: Any, title: str) -> None:
    axes.set_title(title, fontsize=9)
    axes.set_xlabel("x, pixels", fontsize=8)
    axes.set_ylabel("y, pixels", fontsize=8)
    axes.tick_params(labelsize=7)


def _coloured(cells: NDArray[np.int64]) -> Array:
    """A random colour a cell, the same in each picture; grey where there is none."""
    from matplotlib import colormaps

    ids, index = np.unique(cells, return_inverse=True)
    shares = np.random.default_rng(0).permutation(len(ids)) / len(ids)
    colours = np.asarray(colormaps["viridis"](shares))[:, :3]
    colours[ids < 0] = 0.73
    return colours[index.reshape(cells.shape)]
