"""Lepage's VEGAS by its own package, as a guide of another make: `pssflow.render(scene, guide=VegasGuide())`.

The package teaches its map by sampling the integrand itself; a guide is only given paths that were drawn already, the
dark ones as a mere count. So each number gets a map of its own, and is taught each increment's mean of (J f)², in which
dark paths count as the zeros that they are.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["VegasGuide"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

BELOW_ONE = float(np.nextafter(np.float32(1.0), np.float32(0.0)))


class VegasGuide:
    """Separable density q(u) = Π q_d(u_d), each constant on increments that VEGAS has moved.

    Args:
        increments: of each number.
        rounds: adaptations; each moves increments by the package's usual, damped step.
        alpha: of that step.

    References:
        | A New Algorithm for Adaptive Multidimensional Integration (Lepage, 1978)
        | https://github.com/gplepage/vegas
    """

    def __init__(self, increments: int = 32, rounds: int = 5, alpha: float = 0.5) -> None:
        self.increments, self.rounds, self.alpha = increments, rounds, alpha
        self.maps: list[Any] = []

    def fit(self, u: F32, f: F32, g: F32, zeros: int, seed: int) -> None:
        """Learns each number's increments from paths that carry light; see `ForeignGuide.fit`."""
        del seed  # nothing is random
        from vegas import AdaptiveMap

        paths = len(u) + zeros
        squares = np.asarray(f, np.float64) ** 2 / g
        # A single firefly would draw all increments to itself.
        squares = np.minimum(squares, np.quantile(squares, 0.999))
        centres = (np.arange(self.increments) + 0.5)[:, None] / self.increments
        self.maps = []
        for column in np.asarray(u, np.float64).T:
            grid = AdaptiveMap([[0.0, 1.0]], ninc=self.increments)
            for _ in range(self.rounds):
                y, jacobian = _inverse(grid, column[:, None])
                place = np.minimum((y[:, 0] * self.increments).astype(int), self.increments - 1)
                # Over y the mean of (J f)² is the mean over u of J f².
                sums = np.bincount(place, jacobian * squares, self.increments)
                grid.add_training_data(centres, sums * self.increments / paths)
                grid.adapt(alpha=self.alpha)
            self.maps.append(grid)

    def sample(self, n: int, seed: int) -> tuple[F32, F32]:
        """Draws numbers (n, d) and their log-density (n,)."""
        y = np.random.default_rng(seed).random((n, len(self.maps)))
        u = np.empty((n, len(self.maps)), np.float32)
        for d, grid in enumerate(self.maps):
            x, jacobian = np.empty((n, 1)), np.empty(n)
            grid.map(np.ascontiguousarray(y[:, d : d + 1]), x, jacobian)
            u[:, d] = np.clip(x[:, 0], 0.0, BELOW_ONE)
        # Of the rounded numbers: beside an edge they may lie in the next increment.
        return u, self.log_prob(u)

    def log_prob(self, u: F32) -> F32:
        """Log-density (n,) of numbers (n, d)."""
        total = np.zeros(len(u))
        for d, grid in enumerate(self.maps):
            _, jacobian = _inverse(grid, np.asarray(u[:, d : d + 1], np.float64))
            total -= np.log(jacobian)
        return total.astype(np.float32)


def _inverse(grid: Any, x: F64) -> tuple[F64, F64]:
    """For points x (n, 1): y (n, 1) and dx/dy (n,)."""
    x = np.ascontiguousarray(x)
    y, jacobian = np.empty_like(x), np.empty(len(x))
    grid.invmap(x, y, jacobian)
    return y, jacobian
