"""Errors of images against a truth.

relMSE = mean over pixels and channels of (x − r)²/(r² + ε), ε = (0.1 · mean r)², minus the truth's own relative
variance, mean of var(r)/(r² + ε): a noisy truth adds its variance to every squared difference. Since a few fireflies
can decide a mean, it is always reported with and without the worst 0.1 % of the pixels.

That correction is exact only if the denominator knows nothing of the truth's noise. A pixel that its truth shows too
dark counts too much, and just there (x − r)² is large: of a truth with a relative standard error of a half, relMSE is
many times too large for all methods, and their ratios are too near 1. The studies' truths are as noisy as that, so
they divide by `local_scale` instead, r̃² + ε with the mean r̃ of a pixel's neighbours, which its own noise is not in.

Images are (H, W, 3) radiance in W·sr⁻¹·m⁻² (any last axis works). Sums are in double precision; nothing here knows
Mitsuba.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "EPSILON",
    "TRIMMED",
    "Estimate",
    "epsilon",
    "finite_or_none",
    "floor",
    "local_scale",
    "mape",
    "mean_and_error",
    "relative_error",
    "relative_variance",
    "relmse",
    "relmse_trimmed",
    "relmse_with_error",
]

EPSILON = 0.1
"""Share of the truth's mean below which a pixel's error counts as if the pixel had that radiance."""

TRIMMED = 0.001
"""Share of the pixels, the worst ones, that the trimmed relMSE leaves out."""

F64 = NDArray[np.float64]


class Estimate(NamedTuple):
    """A number with its standard error."""

    value: float
    error: float


def epsilon(reference: ArrayLike) -> float:
    """ε = (0.1 · mean r)² of a truth; 0 for a black one."""
    return float((EPSILON * np.mean(np.asarray(reference, np.float64))) ** 2)


NEIGHBOURS = 2
"""Pixels to each side that `local_scale` looks at."""


def local_scale(reference: ArrayLike, reach: int = NEIGHBOURS) -> F64:
    """Denominators for the relative errors against a noisy truth: r̃² + ε, (H, W, 3).

    r̃ is the mean of the truth over a square of 2 · `reach` + 1 pixels a side without the pixel in its middle. As far as
    pixels are independent, numerators and denominators are, too, and the truth's noise can be subtracted without bias.
    Reconstruction filters wider than a pixel leave some dependence. A truth of a single pixel has no neighbour: r² + ε.

    Raises:
        ValueError: `reference` is no image, or a value is not finite.
    """
    r = _checked(reference, "reference")
    if r.ndim != 3:
        raise ValueError(f"`reference` has shape {r.shape}; expected an image (H, W, 3)")
    height, width = r.shape[:2]
    edge = ((reach, reach), (reach, reach), (0, 0))
    padded, there = np.pad(r, edge), np.pad(np.ones((height, width, 1)), edge)
    total, count = -r, np.full((height, width, 1), -1.0)
    for y in range(2 * reach + 1):
        for x in range(2 * reach + 1):
            total += padded[y : y + height, x : x + width]
            count += there[y : y + height, x : x + width]
    mean = np.where(count > 0.0, total / np.maximum(count, 1.0), r)
    return mean**2 + epsilon(r)


def relmse(
    image: ArrayLike,
    reference: ArrayLike,
    reference_variance: ArrayLike | None = None,
    *,
    scale: ArrayLike | None = None,
) -> float:
    """Relative mean squared error of `image` against `reference`, both (H, W, 3).

    Args:
        image: the estimate.
        reference: the truth.
        reference_variance: the truth's own variance of the mean, of the same shape; None for an exact truth.
        scale: denominators; None for r² + ε. See `local_scale`.

    Returns:
        The error; slightly negative where it drowns in the truth's noise. Against a black truth: 0 for a black image,
        else infinity.

    Raises:
        ValueError: shapes differ, or a value is not finite.

    Examples:
        >>> round(relmse([[[1.1, 0.9, 1.0]]], [[[1.0, 1.0, 1.0]]]) * 3 * 1.01, 6)
        0.02
    """
    return _mean_of_worst_removed(_pixels(image, reference, reference_variance, scale), 0.0)


def relmse_trimmed(
    image: ArrayLike,
    reference: ArrayLike,
    reference_variance: ArrayLike | None = None,
    *,
    fraction: float = TRIMMED,
    scale: ArrayLike | None = None,
) -> float:
    """RelMSE without the `fraction` of pixels where it is largest: at least one is left out, and at least one left.

    Raises:
        ValueError: as `relmse`, or `fraction` lies outside [0, 1).
    """
    if not 0.0 <= fraction < 1.0:
        raise ValueError(f"`fraction` = {fraction} lies outside [0, 1)")
    return _mean_of_worst_removed(_pixels(image, reference, reference_variance, scale), fraction)


def relmse_with_error(
    image: ArrayLike,
    reference: ArrayLike,
    reference_variance: ArrayLike | None = None,
    *,
    scale: ArrayLike | None = None,
) -> Estimate:
    """RelMSE of one image and its standard error, from the spread between pixels.

    That holds as far as pixels are independent: wide reconstruction filters correlate neighbours, so that the error is
    too small by up to the filter's area in pixels under a root. With several seeds use `mean_and_error`.
    """
    errors = _pixels(image, reference, reference_variance, scale)
    value = float(errors.mean())
    return Estimate(value, _standard_error(errors))


def mape(image: ArrayLike, reference: ArrayLike, *, scale: ArrayLike | None = None) -> float:
    """Mean over pixels and channels of |x − r|/(r + 0.1 · mean r), or ÷ √`scale`. What noise the truth has is in it.

    Raises:
        ValueError: as `relmse`.
    """
    x, r = _checked(image, "image"), _checked(reference, "reference")
    _same_shape(x, r, "image")
    below = np.abs(r) + math.sqrt(epsilon(r)) if scale is None else np.sqrt(_scale(r, scale))
    return float(_divide(np.abs(x - r), below).mean())


BLOCK = 16
"""Side in pixels of the blocks whose spread is the error of `floor`: wider than any reconstruction filter."""


def floor(
    images: Sequence[ArrayLike],
    reference: ArrayLike,
    reference_variance: ArrayLike | None = None,
    *,
    scale: ArrayLike | None = None,
) -> Estimate:
    """What of the relMSE no time would take away: the squared bias, from independent images of one method.

    The mean over pairs i ≠ j of (xᵢ − r)(xⱼ − r)/(r² + ε), minus the truth's own relative variance: noise of different
    seeds has no common part, so its expectation is relMSE without the variance, and zero for an unbiased method. The
    standard error is that of blocks of 16² pixels.

    Args:
        images: two or more, (H, W, 3), of different seeds.
        reference: the truth.
        reference_variance: its variance of the mean; None for an exact one.
        scale: denominators, as in `relmse`.

    Raises:
        ValueError: fewer than two images, or as `relmse`.
    """
    if len(images) < 2:
        raise ValueError(f"`images` holds {len(images)}; a floor needs two or more seeds")
    r = _checked(reference, "reference")
    total, squares = np.zeros_like(r), np.zeros_like(r)
    for image in images:
        x = _checked(image, "image")
        _same_shape(x, r, "image")
        total += x - r
        squares += (x - r) ** 2
    n = len(images)
    below = _scale(r, scale)
    product = _divide_signed((total**2 - squares) / (n * (n - 1)), below)
    if reference_variance is not None:
        product -= _divide(_checked(reference_variance, "reference_variance"), below)
    rows, columns = (range(0, size, BLOCK) for size in product.shape[:2])
    blocks = [product[y : y + BLOCK, x : x + BLOCK] for y in rows for x in columns]
    sizes = np.array([block.size for block in blocks], np.float64)
    sums = np.array([block.sum() for block in blocks])
    value = float(sums.sum() / sizes.sum())
    if len(blocks) < 2:
        return Estimate(value, math.nan)
    spread = ((sums - value * sizes) ** 2).sum() * len(blocks) / (len(blocks) - 1)
    return Estimate(value, float(math.sqrt(spread) / sizes.sum()))


def relative_variance(
    variance: ArrayLike, reference: ArrayLike, *, scale: ArrayLike | None = None
) -> float:
    """Mean over pixels and channels of variance/(r² + ε): relMSE's formula with a variance of the mean.

    With a truth's own variance it is what `relmse` subtracts; with an estimate's variance it predicts that estimate's
    relMSE. 0 where both are black, infinity for a variance about a black truth.

    Raises:
        ValueError: shapes differ, or a value is not finite.
    """
    r, v = _checked(reference, "reference"), _checked(variance, "variance")
    _same_shape(v, r, "variance")
    return float(_divide(v, _scale(r, scale)).mean())


def relative_error(variance: ArrayLike, reference: ArrayLike) -> float:
    """Relative standard error of an image: the root of `relative_variance`."""
    return math.sqrt(relative_variance(variance, reference))


def mean_and_error(values: Sequence[float]) -> Estimate:
    """Mean of independent values, as of several seeds, and its standard error; NaN for the error of a single one."""
    array = np.asarray(values, np.float64)
    if array.size == 0:
        raise ValueError("`values` is empty; a mean needs at least one")
    return Estimate(float(array.mean()), _standard_error(array))


def finite_or_none(value: float) -> float | None:
    """The value, or None where JSON has no number for it."""
    return value if math.isfinite(value) else None


def _scale(reference: F64, scale: ArrayLike | None) -> F64:
    """Denominators as they were given, or r² + ε."""
    if scale is None:
        return reference * reference + epsilon(reference)
    given = _checked(scale, "scale")
    _same_shape(given, reference, "scale")
    return given


def _pixels(
    image: ArrayLike,
    reference: ArrayLike,
    variance: ArrayLike | None,
    scale: ArrayLike | None = None,
) -> F64:
    """Each pixel's share of the error, mean over its channels, flat."""
    x, r = _checked(image, "image"), _checked(reference, "reference")
    _same_shape(x, r, "image")
    below = _scale(r, scale)
    errors = _divide((x - r) ** 2, below)
    if variance is not None and below.any():
        v = _checked(variance, "reference_variance")
        _same_shape(v, r, "reference_variance")
        errors = errors - _divide(v, below)
    return errors.reshape(-1, errors.shape[-1]).mean(axis=1)


def _mean_of_worst_removed(errors: F64, fraction: float) -> float:
    drop = min(math.ceil(fraction * errors.size), errors.size - 1)
    if drop == 0:
        return float(errors.mean())
    return float(np.partition(errors, errors.size - drop)[: errors.size - drop].mean())


def _divide(numerator: F64, denominator: F64) -> F64:
    """A ratio that is 0 for 0/0 and infinite for x/0, without a warning: black truths are legal."""
    limit = np.where(numerator > 0.0, math.inf, 0.0)
    return np.divide(numerator, denominator, out=limit, where=denominator > 0.0)


def _divide_signed(numerator: F64, denominator: F64) -> F64:
    """A ratio of either sign; 0 where the truth is black."""
    return np.divide(numerator, denominator, out=np.zeros_like(numerator), where=denominator > 0.0)


def _standard_error(values: F64) -> float:
    if values.size < 2 or not np.isfinite(values).all():
        return math.nan
    return float(values.std(ddof=1) / math.sqrt(values.size))


def _checked(values: Any, name: str) -> F64:
    array = np.asarray(values, np.float64)
    if array.size == 0 or array.ndim == 0:
        raise ValueError(f"`{name}` is empty; expected an image (H, W, 3)")
    bad = array.size - int(np.count_nonzero(np.isfinite(array)))
    if bad:
        raise ValueError(f"`{name}` has {bad} values of {array.size} that are not finite")
    return array


def _same_shape(array: F64, reference: F64, name: str) -> None:
    if array.shape != reference.shape:
        raise ValueError(
            f"`{name}` has shape {array.shape}, the reference {reference.shape}; "
            "compare images of one film size and crop"
        )
