"""NumPy's numbers for Dr.Jit."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["columns", "to_jit"]

ALIGNMENT = 64
"""Bytes."""


def to_jit(kind: Any, values: ArrayLike) -> Any:
    """An array of Dr.Jit (`mi.Float`, `mi.UInt32`) of numbers of four bytes.

    Dr.Jit reads NumPy's memory in place and writes into its kernels how that is aligned. What NumPy returns is aligned
    by chance, so that equal programs would be compiled anew every other time; here it always is.
    """
    flat = np.ravel(values)
    room = np.empty(flat.size + ALIGNMENT // 4, flat.dtype if flat.itemsize == 4 else np.float32)
    first = -room.ctypes.data % ALIGNMENT // 4
    aligned = room[first : first + flat.size]
    aligned[:] = flat
    return kind(aligned)


def columns(kind: Any, scalar: Any, values: ArrayLike) -> Any:
    """A vector of Dr.Jit (`mi.Point2f`, `mi.Vector3f`) of rows (n, components)."""
    return kind(*(to_jit(scalar, column) for column in np.asarray(values).T))
