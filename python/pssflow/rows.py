"""Rows of paths as the core takes them: numbers, what they contributed, densities, and where decisions were taken."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .options import check_integer

__all__ = ["LUMINANCE", "matrix", "places", "records"]

F32 = NDArray[np.float32]

LUMINANCE = np.array([0.212671, 0.715160, 0.072169], np.float32)
"""Weights of linear sRGB in a luminance, as Mitsuba has them."""


def records(
    u: ArrayLike,
    f: ArrayLike,
    *,
    f_bsdf: ArrayLike | None = None,
    ray: ArrayLike | None = None,
    g: ArrayLike | None = None,
    g_bsdf: ArrayLike | None = None,
    g_both: ArrayLike | None = None,
    zeros: int = 0,
    contexts: Mapping[str, ArrayLike] | None = None,
    emitters: ArrayLike | None = None,
) -> dict[str, Any]:
    """Paths to learn from as the core takes them, those without light only counted; arguments as in `Guide.fit`.

    `g_bsdf` and `g_both` (n,) are the densities of the numbers that f_bsdf uses and of all numbers; None for `g`.

    Raises:
        ValueError: a shape is wrong.
    """
    u = matrix(u)
    rgb = np.asarray(f, np.float32)
    if rgb.shape not in ((len(u),), (len(u), 3)):
        raise ValueError(f"`f` has shape {rgb.shape}; expected ({len(u)},) or ({len(u)}, 3)")
    largest = rgb.max(axis=1) if rgb.ndim == 2 else rgb
    # NaN is no zero: it goes on to the core, which counts and drops it.
    lit = ~(largest == 0.0)
    term = None if f_bsdf is None else _luminance(np.asarray(f_bsdf, np.float32))
    if term is not None and term.shape != (len(u),):
        raise ValueError(f"`f_bsdf` has shape {term.shape}; expected that of `f`")
    last = None if ray is None else matrix(ray)
    if last is not None and last.shape != (len(u), 2):
        raise ValueError(f"`ray` has shape {last.shape}; expected ({len(u)}, 2)")
    columns: dict[str, Any] = {
        "u": u,
        "f": _luminance(rgb),
        "f_max": largest,
        "f_bsdf": term,
        "ray": last,
    }
    for name, density in (("g", g), ("g_bsdf", g_bsdf), ("g_both", g_both)):
        columns[name] = None if density is None else np.asarray(density, np.float32)
        if density is not None and columns[name].shape != (len(u),):
            raise ValueError(f"`{name}` has shape {columns[name].shape}; expected ({len(u)},)")
    if contexts is not None:
        contexts = _of_paths(contexts, len(u))
        columns["pixel"] = contexts.get("pixel")
    told: dict[str, Any] = {
        name: np.ascontiguousarray(column[lit])
        for name, column in columns.items()
        if column is not None
    }
    if contexts is not None:
        told["contexts"] = _vertices(contexts, lit)
    if emitters is not None:
        told["emitters"] = _intervals(emitters)
    told["zeros"] = check_integer("zeros", zeros, 0, 2**63) + int(np.count_nonzero(~lit))
    return told


def places(contexts: Mapping[str, ArrayLike] | None) -> dict[str, Any] | None:
    """Contexts of decisions, a row each, in the core's types."""
    if contexts is None:
        return None
    whole = ("emitter", "bounce")
    return {
        name: np.ascontiguousarray(value, np.uint32 if name in whole else np.float32)
        for name, value in contexts.items()
    }


def matrix(u: ArrayLike) -> F32:
    """Rows of numbers as the core takes them.

    Raises:
        ValueError: there are not two axes.
    """
    array = np.ascontiguousarray(u, np.float32)
    if array.ndim != 2:
        raise ValueError(f"`u` has shape {array.shape}; expected two axes, a row for each sample")
    return array


def _luminance(values: F32) -> F32:
    return values @ LUMINANCE if values.ndim == 2 else values


def _of_paths(contexts: Mapping[str, ArrayLike], n: int) -> dict[str, NDArray[Any]]:
    """Contexts of n whole paths as arrays.

    Raises:
        ValueError: one is missing that tells the number of vertices, or has another shape.
    """
    if "position" not in contexts:
        raise ValueError(
            "`contexts` holds no `position`, (n, k, 3), which tells how many vertices there are"
        )
    vertices = ("position", "normal", "outgoing")
    arrays: dict[str, NDArray[Any]] = {
        name: np.asarray(contexts[name], np.float32) for name in vertices if name in contexts
    }
    if "pixel" in contexts:
        arrays["pixel"] = np.asarray(contexts["pixel"], np.float32)
    if "emitter" in contexts:
        emitter = np.asarray(contexts["emitter"])
        if emitter.dtype.kind not in "iu":
            raise ValueError(f"contexts['emitter'] holds {emitter.dtype}; expected integers")
        arrays["emitter"] = emitter.astype(np.uint32)
    k = arrays["position"].shape[1] if arrays["position"].ndim == 3 else None
    expected = {**dict.fromkeys(vertices, (n, k, 3)), "pixel": (n, 2), "emitter": (n,)}
    for name, array in arrays.items():
        if k is None or array.shape != expected[name]:
            shape = f"({n}, k, 3)" if k is None else str(expected[name])
            raise ValueError(f"contexts[{name!r}] has shape {array.shape}; expected {shape}")
    return arrays


def _vertices(contexts: Mapping[str, NDArray[Any]], rows: NDArray[np.bool_]) -> dict[str, Any]:
    """Contexts of whole paths, (n, k, …), as one row a vertex; the emitter belongs to the last one."""
    k = contexts["position"].shape[1]
    n = int(np.count_nonzero(rows))
    flat: dict[str, Any] = {
        name: contexts[name][rows].reshape(n * k, 3)
        for name in ("position", "normal", "outgoing")
        if name in contexts
    }
    flat["bounce"] = np.tile(np.arange(1, k + 1, dtype=np.uint32), n)
    if "pixel" in contexts:
        flat["pixel"] = np.repeat(contexts["pixel"][rows], k, axis=0)
    if "emitter" in contexts:
        emitter = np.zeros((n, k), np.uint32)
        emitter[:, -1] = contexts["emitter"][rows]
        flat["emitter"] = emitter.ravel()
    return flat


def _intervals(emitters: ArrayLike) -> list[tuple[float, bool]]:
    array = np.asarray(emitters, np.float32)
    if array.size == 0:
        return []
    if array.ndim != 2 or array.shape[1] != 2:
        raise ValueError(f"`emitters` has shape {array.shape}; expected (m, 2)")
    return [(float(end), bool(surrounds)) for end, surrounds in array]
