"""`normalmap` and `bumpmap`: a BSDF in a frame of its own, and the two switches that Mitsuba shows nowhere.

`flip_invalid_normals` and `use_shadowing_function` are neither traversed nor printed. They are found by drawing a few
samples and comparing them with what each setting would give, computed from the nested BSDF.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .walk import is_scalar

F64 = NDArray[np.float64]

PROBES = 256
"""Points at which the settings are compared; in scalar variants each costs a few calls."""

DEFAULTS = (True, True)
"""Mitsuba's own settings, taken where all give the same light: on a flat map, say."""


class Samples(NamedTuple):
    """Directions (n, 3) drawn from a BSDF, and their weights (n, 3)."""

    wo: F64
    weight: F64


def switches(bsdf: Any, nested: Any, texture: Any, scale: float | None = None) -> tuple[bool, bool]:
    """`flip_invalid_normals` and `use_shadowing_function` of a normal map, or of a bump map of this scale."""
    rng = np.random.default_rng(0)
    wi = rng.normal(size=(PROBES, 3))
    wi[:, 2] *= 0.3  # slanted, where normals face away
    wi /= np.linalg.norm(wi, axis=1, keepdims=True)
    uv, u = rng.random((PROBES, 2)), rng.random((PROBES, 3))
    normals = 2 * _normals(texture, uv) - 1 if scale is None else _bumps(texture, uv, scale)
    found = _sample(bsdf, uv, wi, u)

    errors: dict[tuple[bool, bool], float] = {}
    for flip in (True, False):
        n = normals.copy()
        if flip:
            n[wi[:, 2] * _dot(wi, n) <= 0, :2] *= -1
        frame = _frames(n)
        drawn = _sample(nested, uv, np.einsum("nij,nj->ni", frame, wi), u)
        wo = np.einsum("nij,ni->nj", frame, drawn.wo)
        agrees = (drawn.wo[:, 2] * wo[:, 2] > 0)[:, None]
        for soften in (True, False):
            weight = np.where(agrees, drawn.weight, 0.0)
            if soften:
                weight = weight * _shadowing(frame[:, 2], wo)[:, None]
            known = np.isfinite(weight) & np.isfinite(found.weight)
            difference = np.abs(weight[known] - found.weight[known])
            errors[flip, soften] = float(difference.mean()) if known.any() else 0.0
    return min(errors, key=lambda s: (round(errors[s], 6), s != DEFAULTS))


def _dot(a: F64, b: F64) -> F64:
    return np.asarray((a * b).sum(axis=1))


def _frames(normals: F64) -> F64:
    """Rows tangent, bitangent, normal, (n, 3, 3): the tangent is the x axis made orthogonal."""
    n = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    s = np.array([1.0, 0.0, 0.0]) - n * n[:, :1]
    s /= np.maximum(np.linalg.norm(s, axis=1, keepdims=True), 1e-12)
    return np.stack([s, np.cross(n, s), n], axis=1)


def _shadowing(n: F64, wo: F64) -> F64:
    """Of the softened terminator (Estevez, Lecocq and Stein 2019)."""

    def tan_2(v: F64) -> F64:
        return np.maximum(1 - v[:, 2] ** 2, 0) / np.maximum(v[:, 2] ** 2, 1e-12)

    alpha_2 = np.minimum(0.125 * tan_2(n), 1)
    return 2 / (1 + np.sqrt(1 + alpha_2 * tan_2(wo)))


def _normals(texture: Any, uv: F64) -> F64:
    """The texture's values (n, 3)."""
    values = [texture.eval_3(si) for si in _interactions(uv, np.zeros((len(uv), 3)))]
    return _rows(values)


def _bumps(texture: Any, uv: F64, scale: float) -> F64:
    """Normals (n, 3) of heights over a plane whose parameters are its lengths."""
    points = _interactions(uv, np.zeros((len(uv), 3)))
    slope = scale * _rows([texture.eval_1_grad(si) for si in points])
    return np.column_stack([-slope, np.ones(len(slope))])


def _sample(bsdf: Any, uv: F64, wi: F64, u: F64) -> Samples:
    context = mi.BSDFContext()
    drawn = []
    for i, si in enumerate(_interactions(uv, wi)):
        # One point at a time, or all of them.
        part = u[i] if is_scalar() else u.astype(np.float32).T
        drawn.append(bsdf.sample(context, si, _number(part[0]), mi.Point2f(part[1:].tolist())))
    return Samples(_rows([s.wo for s, _ in drawn]), _rows([w for _, w in drawn]))


def _number(values: Any) -> Any:
    return float(values) if is_scalar() else mi.Float(values.tolist())


def _interactions(uv: F64, wi: F64) -> Iterator[Any]:
    """Points in a variant's own way: one by one, or all at once."""
    if is_scalar():
        for (u, v), w in zip(uv, wi, strict=True):
            si = mi.SurfaceInteraction3f()
            si.uv, si.wi = mi.Point2f(u, v), mi.Vector3f(*w)
            yield _on_a_plane(si)
        return
    si = dr.zeros(mi.SurfaceInteraction3f, len(uv))
    si.uv = mi.Point2f(uv.T.astype(np.float32))
    si.wi = mi.Vector3f(wi.T.astype(np.float32))
    yield _on_a_plane(si)


def _on_a_plane(si: Any) -> Any:
    """The xy plane: world and local space are one."""
    x, y, z = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1)
    si.n, si.dp_du, si.dp_dv = mi.Normal3f(z), x, y
    si.sh_frame = mi.Frame3f(x, y, z)
    return si


def _rows(values: list[Any]) -> F64:
    """(n, …) of n scalar vectors, or of one wide one."""
    if is_scalar():
        return np.array([np.array(v, np.float64) for v in values])
    return np.array(dr.detach(values[0]), np.float64).T
