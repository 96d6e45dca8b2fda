"""What a fitted guide gains on paths that it has not learned from: `auto`'s rule for one guide, in NumPy.

The core predicts gains of candidates only while it chooses; a study asks of a guide that was given. The formulas are
those of `rust/pss-guide/src/predict.rs`, without the standard error that makes a choice cautious.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..guide import Guide
from ..rows import LUMINANCE
from ..scene import Pilot, Scene

__all__ = ["Densities", "HeldOut"]

F64 = NDArray[np.float64]

SIDE = 16
"""Tiles along an axis of the image."""


class Densities(NamedTuple):
    """A guide's densities of some paths' numbers, (n,) each."""

    nee: F64
    """Of the numbers that f_nee uses."""
    bsdf: F64
    """Of those that the BSDF-sampled term uses: the directions' and the ray's."""
    both: F64
    """Of all."""


@dataclass(frozen=True)
class HeldOut:
    """Uniform paths of a scene.

    Args:
        pilot: the paths; all of them, also those without light.
        k: bounces.
    """

    pilot: Pilot
    k: int

    @classmethod
    def of(cls, scene: Scene, k: int, *, paths: int = 1 << 17, seed: int = 1 << 40) -> HeldOut:
        """About so many paths, of a seed that no render has."""
        spp = max(round(paths / (scene.width * scene.height)), 1)
        return cls(scene.pilot(spp, k=k, seed=seed), k)

    def gain(self, guide: Guide, a: float) -> float:
        """V(1) ÷ V(a), the relative variance of random numbers ÷ that of the mixture a + (1 − a)·q; NaN without light.

        V(a) = Σ over tiles of [mean of f_nee²/m_nee + f_bsdf²/m_bsdf + 2 f_nee f_bsdf m/(m_nee m_bsdf) − Ī²]
        ÷ (Ī² + ε).
        """
        pilot = self.pilot
        nee, bsdf = (
            (values @ LUMINANCE).astype(np.float64) for values in (pilot.f_nee, pilot.f_bsdf)
        )
        cells = np.minimum((pilot.pixel * SIDE).astype(np.int64), SIDE - 1)
        tile = cells[:, 1] * SIDE + cells[:, 0]

        def mean(values: F64) -> F64:
            count = np.bincount(tile, minlength=SIDE * SIDE)
            return np.bincount(tile, values, SIDE * SIDE) / np.maximum(count, 1)

        each = np.maximum(np.bincount(tile, minlength=SIDE * SIDE), 2)
        first = mean(nee + bsdf)
        if not first.any():
            return float("nan")
        second = mean((nee + bsdf) ** 2)
        # The square of a mean of n paths is too large by their variance ÷ n.
        square = (each * first**2 - second) / (each - 1)
        scale = 1.0 / (first**2 + (0.1 * first.mean()) ** 2)

        def variance(q: Densities, a: float) -> float:
            m_nee, m_bsdf, m = (a + (1.0 - a) * own for own in q)
            with np.errstate(invalid="ignore"):
                # Where densities are infinite nothing is left of either term: ∞/∞ is 0 here.
                cross = np.fmax(m / (m_nee * m_bsdf), 0.0)
            moment = mean(nee**2 / m_nee + bsdf**2 / m_bsdf + 2.0 * nee * bsdf * cross)
            return float(((moment - square) * scale).sum())

        one = np.ones(len(nee))
        uniform = variance(Densities(one, one, one), 1.0)
        mixed = variance(self.densities(guide), a) if a < 1.0 else uniform
        return uniform / mixed if mixed > 0.0 else float("nan")

    def densities(self, guide: Guide) -> Densities:
        """Of each path's numbers; without a BSDF-sampled ray its numbers have density 1."""
        pilot = self.pilot
        rows = len(pilot.u)

        def q(decision: str, columns: slice, vertex: int) -> F64:
            places = {
                name: getattr(pilot, name)[:, vertex] for name in ("position", "normal", "outgoing")
            }
            places["pixel"] = pilot.pixel
            places["bounce"] = np.full(rows, vertex + 1)
            if decision == "light":
                places["emitter"] = pilot.emitter
            return np.exp(
                guide.log_prob(
                    np.ascontiguousarray(pilot.u[:, columns]), decision=decision, contexts=places
                ).astype(np.float64)
            )

        nee, bsdf, both = np.ones(rows), np.ones(rows), np.ones(rows)
        for decision in guide.models:
            for vertex, columns in self._columns(decision):
                own = q(decision, columns, vertex)
                both *= own
                if decision != "ray":
                    nee *= own
                if decision not in ("emitter", "light"):
                    bsdf *= own
        return Densities(nee, bsdf, both)

    def _columns(self, decision: str) -> list[tuple[int, slice]]:
        """Where a decision is taken: vertices, counted from 0, and the columns of u."""
        k, learned = self.k, self.pilot.learned
        places = {
            "path": [(0, slice(0, learned))],
            "direction": [(b, slice(2 * b, 2 * b + 2)) for b in range(k - 1)],
            "emitter": [(k - 1, slice(2 * k - 2, 2 * k - 1))],
            "light": [(k - 1, slice(2 * k - 1, 2 * k + 1))],
            "ray": [(k - 1, slice(learned, learned + 2))],
        }
        return [at for at in places[decision] if at[1].stop <= self.pilot.u.shape[1]]
