"""Pearson's χ² for densities over directions: do samples fall where the density says?"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import stats

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


def sphere_chi2(
    samples: F32, drawn: int, pdf: Callable[[F32], F32], *, rings: int = 16, sectors: int = 24
) -> tuple[float, str]:
    """p-value of H0: `samples` (n, 3) of `drawn` attempts have density `pdf` in solid angle; and a line about it.

    Bins are equal steps of cos θ and φ; expected counts are the density's integral by a Gauss–Legendre rule in each
    bin. Attempts that gave nothing are a bin of their own, expected to hold what the density lacks to one. Bins that
    expect fewer than 5 are pooled.
    """
    z_edges = np.linspace(-1, 1, rings + 1)
    phi_edges = np.linspace(-np.pi, np.pi, sectors + 1)
    expected = drawn * _integrals(pdf, z_edges, phi_edges)
    integral = expected.sum() / drawn
    w = samples.astype(np.float64)
    z, phi = np.clip(w[:, 2], -1, 1), np.arctan2(w[:, 1], w[:, 0])
    observed, *_ = np.histogram2d(z, phi, bins=(z_edges, phi_edges))

    observed = np.append(observed.ravel(), drawn - len(samples))
    expected = np.append(expected.ravel(), max(drawn - expected.sum(), 0.0))
    rare = expected < 5
    observed = np.append(observed[~rare], observed[rare].sum())
    expected = np.append(expected[~rare], expected[rare].sum())
    if expected[-1] < 5:
        # Too few to approximate by χ²: by Poisson's law, and Bonferroni's correction for asking twice.
        p_rare = float(stats.poisson.sf(observed[-1] - 1, expected[-1] + 1e-3))
        observed, expected = observed[:-1], expected[:-1]
    else:
        p_rare = 0.5
    terms = (observed - expected) ** 2 / expected
    p = 1.0 if len(terms) < 2 else float(stats.chi2.sf(terms.sum(), len(terms) - 1))
    worst = int(np.argmax(terms))
    text = (
        f"χ² = {terms.sum():.1f} over {len(terms)} bins, p = {p:.2g}; rare bins p = {p_rare:.2g}; "
        f"∫pdf = {integral:.5f}; worst bin {observed[worst]:.0f}, expected {expected[worst]:.1f}"
    )
    return min(1.0, 2 * min(p, p_rare)), text


def _integrals(pdf: Callable[[F32], F32], z_edges: F64, phi_edges: F64, nodes: int = 12) -> F64:
    """Integrals of `pdf` over all bins, (rings, sectors)."""
    x, weight = np.polynomial.legendre.leggauss(nodes)

    def spread(edges: F64) -> tuple[F64, float]:
        half = (edges[1] - edges[0]) / 2
        return (edges[:-1] + half)[:, None] + half * x, half

    (z, half_z), (phi, half_phi) = spread(z_edges), spread(phi_edges)
    z_all, phi_all = np.meshgrid(z.ravel(), phi.ravel(), indexing="ij")
    r = np.sqrt(np.maximum(0, 1 - z_all**2))
    w = np.stack([r * np.cos(phi_all), r * np.sin(phi_all), z_all], axis=-1).reshape(-1, 3)
    values = pdf(w.astype(np.float32)).astype(np.float64)
    values = values.reshape(len(z), nodes, len(phi), nodes)
    return half_z * half_phi * np.einsum("aibj,i,j->ab", values, weight, weight)
