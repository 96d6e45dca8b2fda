"""Welch's test for renders, by the name that tests import: `make coverage` prints its p-values, so it is the package's."""

from pssflow.study.welch import (
    ALPHA,
    HEAVY,
    Comparison,
    Moments,
    holm,
    luminance,
    p_value,
    tile_means,
    welch,
    write_exr,
)

__all__ = [
    "ALPHA",
    "HEAVY",
    "Comparison",
    "Moments",
    "holm",
    "luminance",
    "p_value",
    "tile_means",
    "welch",
    "write_exr",
]
