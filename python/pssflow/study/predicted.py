"""What a fitted guide gains on paths that it has not learned from: `auto`'s rule for one guide, in NumPy.

The core predicts gains of candidates only while it chooses; a study asks of a guide that was given. The formulas are
those of `rust/pss-guide/src/predict.rs`, without the standard error that makes a choice cautious.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..guide import LUMINANCE, Guide
from ..scene import Pilot, Scene

__all__ = ["HeldOut"]

F64 = NDArray[np.float64]

SIDE = 16
"""Tiles along an axis of the image."""


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

        V(a) = Σ over tiles of [mean of f_nee²/m + (2 f_nee f_bsdf + f_bsdf²)/m′ − Ī²] ÷ (Ī² + ε), with the directions'
        marginal m′.
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

        def variance(m: F64, marginal: F64) -> float:
            moment = mean(nee**2 / m + (2.0 * nee * bsdf + bsdf**2) / marginal)
            return float(((moment - square) * scale).sum())

        all_of, directions = self.densities(guide)
        one = np.ones(len(nee))
        mixed = variance(a + (1.0 - a) * all_of, a + (1.0 - a) * directions)
        return variance(one, one) / mixed if mixed > 0.0 else float("nan")

    def densities(self, guide: Guide) -> tuple[F64, F64]:
        """Q of all numbers of each path, and of those that the BSDF-sampled term uses, (n,)."""
        pilot, k = self.pilot, self.k
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

        if "path" in guide.models:
            whole = q("path", slice(0, 2 * k + 1), 0)
            return whole, whole
        directions, rest = np.ones(rows), np.ones(rows)
        if "direction" in guide.models:
            for b in range(k - 1):
                directions *= q("direction", slice(2 * b, 2 * b + 2), b)
        if "emitter" in guide.models:
            rest *= q("emitter", slice(2 * k - 2, 2 * k - 1), k - 1)
        if "light" in guide.models:
            rest *= q("light", slice(2 * k - 1, 2 * k + 1), k - 1)
        return directions * rest, directions
