"""Welch's test on two sets of renders: equal means, image-wide and in every tile?

Both sides bring several runs with seeds of their own. The mean of a region (image or tile) of one run is one sample;
Welch's t-test compares the two sets of samples with each side's own variance, since a guide changes variance on purpose
(Jung, Hanika and Dachsbacher 2020, *Detecting bias in Monte Carlo renderers using Welch's t-test*). Tiles are many
tests at once: their p-values are corrected by Holm's method, which needs no independence.

A test passes where `min(p_mean, p_holm) > ALPHA / 2`: half the level for each of the two questions.

Where one sample holds much of a region's sum, the region's variance is not known, and neither is p. `welch_where_power`
leaves such tiles out, tests larger ones in their place, and counts those for which no size helped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

ALPHA = 1e-4
"""Level of one comparison. Seeds are fixed, so a red test stays red until the code changes."""

HEAVY = 0.1
"""A single sample with more than this share of a side's sum: its variance is not known, and p says little."""

LUMINANCE = np.array([0.212671, 0.715160, 0.072169])
"""Of linear sRGB, as Mitsuba's."""

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Moments:
    """Mean over runs and the variance of that mean, for each region."""

    mean: F64
    variance: F64
    runs: int

    @staticmethod
    def of(samples: F64) -> Moments:
        """From samples (runs, …)."""
        runs = len(samples)
        return Moments(samples.mean(axis=0), samples.var(axis=0, ddof=1) / runs, runs)


@dataclass(frozen=True)
class Comparison:
    """Outcome of `welch`."""

    p_mean: float
    """Of the image means."""
    p_holm: float
    """The smallest tile's, corrected for the number of tiles."""
    p_tiles: F64
    """Corrected p-value of each tile, (rows, columns)."""
    tile: int
    """Side of a tile in pixels; the last row and column may be smaller."""
    images: tuple[Moments, Moments]
    """Image means of both sides."""
    tiles: tuple[Moments, Moments]
    """Tile means of both sides, (rows, columns)."""
    pixels: tuple[Moments, Moments]
    """Pixels of both sides, (height, width): for pictures only."""
    heaviest: tuple[float, float]
    """Share of each side's sum that its largest pixel of a run holds."""

    @property
    def p(self) -> float:
        """The smaller of both; compare it with `ALPHA / 2`."""
        return min(self.p_mean, self.p_holm)

    @property
    def has_power(self) -> bool:
        """Whether the samples' tails are light enough for a t-test to see a bias."""
        return max(self.heaviest) <= HEAVY

    def explain(self, artifacts: Path) -> str:
        """Writes pictures below `artifacts` and returns what differs most, in words."""
        artifacts.mkdir(parents=True, exist_ok=True)
        for side, pixels in zip("ab", self.pixels, strict=True):
            write_exr(artifacts / f"{side}.mean.exr", pixels.mean)
            write_exr(artifacts / f"{side}.var.exr", pixels.variance)
        height, width = self.pixels[0].mean.shape
        p = np.kron(self.p_tiles, np.ones((self.tile, self.tile)))[:height, :width]
        write_exr(artifacts / "p.exr", p)

        row, column = np.unravel_index(np.argmin(self.p_tiles), self.p_tiles.shape)
        a, b = (_describe(side, int(row), int(column)) for side in self.tiles)
        mean_a, mean_b = (_describe(side) for side in self.images)
        lines = [
            f"image: p = {self.p_mean:.2g}, a = {mean_a}, b = {mean_b}",
            f"worst tile (row {row}, column {column} of {self.p_tiles.shape}): p = {self.p_holm:.2g} after Holm, "
            f"a = {a}, b = {b}",
            f"means, variances and p by pixel: {artifacts}",
        ]
        if not self.has_power:
            lines.append(
                f"no power: one sample holds {max(self.heaviest):.0%} of a side's sum (more than {HEAVY:.0%}), "
                "so neither side's variance is known; p says little"
            )
        return "\n".join(lines)


def welch(a: ArrayLike, b: ArrayLike, *, tile: int = 16) -> Comparison:
    """Tests whether two renderers have the same expectation.

    Args:
        a: images of one renderer, (runs, height, width) or (runs, height, width, 3), at least two runs; of colours the
            luminance is compared.
        b: images of the other, as many runs as it likes.
        tile: side of a tile in pixels.

    Raises:
        ValueError: shapes do not fit, there are fewer than two runs, or a value is not finite: a NaN must not pass.
    """
    a, b = luminance(a, "a"), luminance(b, "b")
    if a.shape[1:] != b.shape[1:]:
        raise ValueError(f"images of {a.shape[1:]} and {b.shape[1:]} pixels cannot be compared")
    if tile < 1:
        raise ValueError(f"tile = {tile}: expected a positive number of pixels")
    images = Moments.of(a.mean(axis=(1, 2))), Moments.of(b.mean(axis=(1, 2)))
    tiles = Moments.of(tile_means(a, tile)), Moments.of(tile_means(b, tile))
    p_tiles = holm(p_value(*tiles))
    return Comparison(
        p_mean=float(p_value(*images)),
        p_holm=float(p_tiles.min()),
        p_tiles=p_tiles,
        tile=tile,
        images=images,
        tiles=tiles,
        pixels=(Moments.of(a), Moments.of(b)),
        heaviest=(_heaviest(a), _heaviest(b)),
    )


@dataclass(frozen=True)
class Verdict:
    """Outcome of `welch_where_power`."""

    p_mean: float
    """Of the image means; NaN where the image as a whole has no power."""
    p_holm: float
    """The smallest tile's with power, corrected for the number of tests; NaN where no tile has any."""
    tiles: int
    """Tiles of the smallest size."""
    enlarged: int
    """Those among them that only a larger tile around them could test."""
    without_power: int
    """Those among them that no larger tile could test either."""
    images: tuple[Moments, Moments]
    """Image means of both sides."""
    worst: str
    """The tile that differs most, in words."""

    @property
    def p(self) -> float:
        """The smaller of both; compare it with `ALPHA / 2`. NaN where nothing could be tested."""
        known = [p for p in (self.p_mean, self.p_holm) if not np.isnan(p)]
        return min(known, default=float("nan"))

    def explain(self) -> str:
        """What was compared, in words."""
        a, b = (_describe(side) for side in self.images)
        return (
            f"image: p = {self.p_mean:.2g}, a = {a}, b = {b}\n{self.worst}\n"
            f"{self.without_power} of {self.tiles} tiles without power, {self.enlarged} tested in larger ones"
        )


def welch_where_power(
    a: ArrayLike, b: ArrayLike, *, sizes: Sequence[int] = (12, 24, 48)
) -> Verdict:
    """As `welch`, but each tile must have power: no sample (a pixel of a run) above `HEAVY` of its sum, on either side.

    Args:
        a: as of `welch`.
        b: as of `welch`.
        sizes: sides of tiles in pixels, each a multiple of the one before. A tile without power is tested as part of
            the next larger one, which may overlap its lighter neighbours: Holm's correction needs no independence.

    Raises:
        ValueError: as `welch`.
    """
    a, b = luminance(a, "a"), luminance(b, "b")
    if a.shape[1:] != b.shape[1:]:
        raise ValueError(f"images of {a.shape[1:]} and {b.shape[1:]} pixels cannot be compared")
    images = Moments.of(a.mean(axis=(1, 2))), Moments.of(b.mean(axis=(1, 2)))
    # Which pixels still wait for a tile with power.
    waiting = np.ones(a.shape[1:], bool)
    tested: list[tuple[float, str]] = []
    counts = []
    for size in sizes:
        sides = Moments.of(tile_means(a, size)), Moments.of(tile_means(b, size))
        p = p_value(*sides)
        heavy = np.maximum(_tile_shares(a, size), _tile_shares(b, size)) > HEAVY
        wanted = _any_in_tiles(waiting, size)
        for row, column in np.argwhere(wanted & ~heavy):
            ours = [_describe(side, int(row), int(column)) for side in sides]
            where = f"tile (row {row}, column {column}) of {size}²: a = {ours[0]}, b = {ours[1]}"
            tested.append((float(p[row, column]), where))
        spread = np.kron(heavy, np.ones((size, size), bool))[: a.shape[1], : a.shape[2]]
        waiting &= spread
        counts.append(int(np.count_nonzero(_any_in_tiles(waiting, sizes[0]))))
    corrected = holm(np.array([p for p, _ in tested])) if tested else np.array([np.nan])
    worst = int(np.argmin(corrected))
    return Verdict(
        p_mean=float(p_value(*images)) if max(_heaviest(a), _heaviest(b)) <= HEAVY else np.nan,
        p_holm=float(corrected[worst]),
        tiles=_any_in_tiles(np.ones_like(waiting), sizes[0]).size,
        enlarged=counts[0] - counts[-1],
        without_power=counts[-1],
        images=images,
        worst=f"worst {tested[worst][1]}, p = {corrected[worst]:.2g} after Holm" if tested else "",
    )


def p_value(a: Moments, b: Moments) -> F64:
    """Two-sided p-value of equal means by region, degrees of freedom by Welch and Satterthwaite.

    Regions without any variance (black ones) are equal or not: p is 1 or 0.
    """
    noise = a.variance + b.variance
    scale = np.maximum(np.abs(a.mean), np.abs(b.mean))
    # Summing equal numbers in double precision leaves this much.
    constant = noise <= (1e-13 * scale) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (a.mean - b.mean) / np.sqrt(noise)
        freedom = noise**2 / (a.variance**2 / (a.runs - 1) + b.variance**2 / (b.runs - 1))
        p = 2 * stats.t.sf(np.abs(t), freedom)
    equal = np.abs(a.mean - b.mean) <= 1e-12 * scale
    return np.where(constant, np.where(equal, 1.0, 0.0), p)


def holm(p: F64) -> F64:
    """Holm's step-down correction of many p-values, in their own shape."""
    flat = p.ravel()
    order = np.argsort(flat)
    steps = flat[order] * np.arange(flat.size, 0, -1)
    corrected = np.empty_like(flat)
    corrected[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return corrected.reshape(p.shape)


def write_exr(path: Path, values: NDArray[Any]) -> None:
    """Writes (height, width) as a grey float32 EXR; without a Mitsuba variant, as .npy beside that name."""
    import mitsuba as mi

    if mi.variant() is None:
        np.save(path.with_suffix(".npy"), values)
    else:
        mi.Bitmap(values.astype(np.float32)[..., None]).write(str(path))


def luminance(images: ArrayLike, name: str) -> F64:
    """Images (runs, height, width) of such or of colours; raises `ValueError` as `welch` does."""
    runs = np.asarray(images, dtype=np.float64)
    if runs.ndim == 4 and runs.shape[3] == 3:
        runs = runs @ LUMINANCE
    if runs.ndim != 3 or runs.shape[0] < 2 or 0 in runs.shape:
        raise ValueError(
            f"{name} has shape {runs.shape}, expected (runs, height, width[, 3]) with two or more runs"
        )
    bad = np.count_nonzero(~np.isfinite(runs))
    if bad:
        raise ValueError(f"{name} holds {bad} values that are not finite")
    return runs


def tile_means(runs: F64, tile: int) -> F64:
    """Means of all tiles, (runs, rows, columns)."""
    _, height, width = runs.shape
    rows, columns = np.arange(0, height, tile), np.arange(0, width, tile)
    sums = np.add.reduceat(np.add.reduceat(runs, rows, axis=1), columns, axis=2)
    heights = np.diff(rows, append=height)[:, None]
    return sums / (heights * np.diff(columns, append=width))


def _heaviest(runs: F64) -> float:
    total = np.abs(runs).sum()
    return float(np.abs(runs).max() / total) if total > 0 else 0.0


def _tile_shares(runs: F64, tile: int) -> F64:
    """Share of each tile's sum over all runs that its largest pixel of a run holds; 0 for black tiles."""
    sizes = np.abs(runs)
    total = tile_means(sizes, tile).mean(axis=0)
    rows, columns = np.arange(0, runs.shape[1], tile), np.arange(0, runs.shape[2], tile)
    largest = np.maximum.reduceat(np.maximum.reduceat(sizes, rows, axis=1), columns, axis=2)
    area = np.diff(rows, append=runs.shape[1])[:, None] * np.diff(columns, append=runs.shape[2])
    total = total * area * len(runs)
    return np.divide(largest.max(axis=0), total, out=np.zeros_like(total), where=total > 0)


def _any_in_tiles(pixels: NDArray[np.bool_], tile: int) -> NDArray[np.bool_]:
    rows, columns = np.arange(0, pixels.shape[0], tile), np.arange(0, pixels.shape[1], tile)
    return np.logical_or.reduceat(np.logical_or.reduceat(pixels, rows, axis=0), columns, axis=1)


def _describe(moments: Moments, *at: int) -> str:
    return f"{moments.mean[at]:.6g} ± {np.sqrt(moments.variance[at]):.2g}"
