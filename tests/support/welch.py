"""Welch's test, by the name that tests import. `make coverage` prints its p-values, so it is the package's."""

from pssflow.study.welch import (
    ALPHA,
    HEAVY,
    Comparison,
    Moments,
    Verdict,
    holm,
    luminance,
    p_value,
    tile_means,
    welch,
    welch_where_power,
    write_exr,
)

__all__ = [
    "ALPHA",
    "HEAVY",
    "Comparison",
    "Moments",
    "Verdict",
    "holm",
    "luminance",
    "p_value",
    "tile_means",
    "welch",
    "welch_where_power",
    "write_exr",
]
