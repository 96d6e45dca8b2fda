"""Calls by value: random directions, Mitsuba's interactions made of them, and comparing arrays of results."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]


def points(values: Any) -> F32:
    """Rows (n, …) of a Dr.Jit array of n points, vectors or numbers."""
    array = np.array(dr.detach(values), dtype=np.float32)
    return np.ascontiguousarray(array.T) if array.ndim == 2 else array


def point2(rows: F32) -> mi.Point2f:
    """Dr.Jit points of rows (n, 2)."""
    return mi.Point2f(np.ascontiguousarray(rows.T))


def vector3(rows: F32) -> mi.Vector3f:
    """Dr.Jit vectors of rows (n, 3)."""
    return mi.Vector3f(np.ascontiguousarray(rows.T))


def interaction(uv: F32, wi: F32 | None = None) -> mi.SurfaceInteraction3f:
    """A surface point as textures and BSDFs see it: texture coordinates and the local direction back."""
    si = dr.zeros(mi.SurfaceInteraction3f, len(uv))
    si.uv = point2(uv)
    if wi is not None:
        si.wi = vector3(wi)
    # The surface that the core's own calls assume, for bump maps.
    axes = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1)
    si.n, si.sh_frame = mi.Normal3f(0, 0, 1), mi.Frame3f(*axes)
    si.dp_du, si.dp_dv = mi.Vector3f(2, 0, 0), mi.Vector3f(0.5, 1.5, 0)
    return si


def sphere_directions(rng: np.random.Generator, n: int) -> F32:
    """Unit vectors (n, 3), uniform on the sphere."""
    v = rng.normal(size=(n, 3))
    return (v / np.linalg.norm(v, axis=1, keepdims=True)).astype(np.float32)


def unit_interval(rng: np.random.Generator, *shape: int) -> F32:
    """Numbers in [0, 1) as the renderer draws them: multiples of 2⁻²⁴."""
    return (rng.integers(0, 1 << 24, shape) / (1 << 24)).astype(np.float32)


def direction_pairs(rng: np.random.Generator, n: int) -> tuple[F32, F32]:
    """Local pairs (wi, wo): half both above the surface, a quarter near the mirror direction, a quarter anywhere.

    Uniform pairs alone would rarely meet the peak of a glossy lobe.
    """
    wi, wo = sphere_directions(rng, n), sphere_directions(rng, n)
    half, quarter = n // 2, n // 4
    for w in (wi, wo):
        w[: n - quarter, 2] = np.abs(w[: n - quarter, 2])
    spread = rng.choice([0.01, 0.05, 0.2], quarter)[:, None].astype(np.float32)
    mirrored = wi[half : half + quarter] * np.array([-1, -1, 1], np.float32)
    mirrored = mirrored + spread * rng.normal(size=(quarter, 3)).astype(np.float32)
    wo[half : half + quarter] = mirrored / np.linalg.norm(mirrored, axis=1, keepdims=True)
    # And some on the back, for BSDFs with two sides.
    wi[::7, 2] *= -1
    wo[::7, 2] *= -1
    return wi, wo


def disagreements(ours: F32, theirs: F32, *, rel: float, floor: float) -> NDArray[np.bool_]:
    """Rows where any channel differs by more than `rel` times Mitsuba's value; below `floor`, `rel · floor` is allowed.

    A value that is not finite on either side is a disagreement.
    """
    ours, theirs = (np.atleast_2d(v.T).T.astype(np.float64) for v in (ours, theirs))
    wrong = ~(np.abs(ours - theirs) <= rel * np.maximum(np.abs(theirs), floor))
    return np.asarray(wrong.any(axis=1))


def first_rows(wrong: NDArray[np.bool_], **columns: NDArray[Any]) -> str:
    """The first few disagreeing rows in words, for an assertion's message."""
    rows = np.flatnonzero(wrong)
    lines = [f"{len(rows)} of {len(wrong)} rows disagree"]
    lines += [
        ", ".join(
            f"{name} = {np.array2string(np.asarray(c[i]), precision=7)}"
            for name, c in columns.items()
        )
        for i in rows[:5]
    ]
    return "\n".join(lines)
