"""What `pssflow study thesis` fits on numbers alone: the crescent, and training against held-out loss.

The crescent is the thesis' example of what a flow does (its Figures 8 and 9): numbers on a crescent become normal
latent numbers, and normal numbers become a crescent. Overfitting is what it left open.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..guide import Guide
from ..scene import Scene
from .latent import Latent

__all__ = [
    "CRESCENT_EPOCHS",
    "CRESCENT_ROWS",
    "Paths",
    "crescent",
    "held_out",
    "learn_crescent",
    "training_paths",
]

F32 = NDArray[np.float32]

CRESCENT_ROWS, CRESCENT_EPOCHS = 4096, 30

OUTLIERS = 0.999
"""The guide's own quantile above which paths are not learned from."""

CONTEXTS = ("position", "normal", "outgoing", "pixel", "emitter")

Listener = Callable[[str, float], None] | None


def crescent(rows: int, seed: int) -> tuple[F32, F32]:
    """Numbers on a crescent in the unit square (n, 2), and where along it each lies (n,), in [0, 1]."""
    rng = np.random.default_rng(seed)
    along = rng.random(rows)
    angle = np.pi * (0.1 + 0.8 * along)
    # Thickest in the middle, as a crescent is.
    radius = 0.36 + 0.035 * np.sin(np.pi * along) * rng.normal(size=rows)
    points = np.stack([0.5 + radius * np.cos(angle), 0.3 + radius * np.sin(angle)], axis=1)
    return points.astype(np.float32), along.astype(np.float32)


def learn_crescent(prior: str, seed: int, progress: Listener = None) -> dict[str, Any]:
    """A flow with that prior, fitted to the crescent: what the charts show of it.

    Returns:
        `loss` by epoch, `lost`: share of the training numbers with density zero, `outside`: mass outside the square,
        `latent`: latent numbers of `crescent(CRESCENT_ROWS, seed)`, `generated`: numbers of latent ones that are drawn
        from the prior, `round_trip`: largest deviation after there and back.
    """
    points, _ = crescent(CRESCENT_ROWS, seed)
    guide = Guide.fit(
        "realnvp",
        points,
        np.ones(len(points), np.float32),
        epochs=CRESCENT_EPOCHS,
        prior=prior,
        seed=seed,
        progress=progress,
    )
    flow = Latent(guide)
    latent, _ = flow.normalise(points)
    again, _ = flow.generate(latent)
    rng = np.random.default_rng([seed, 1])
    drawn = rng.random(points.shape) if prior == "hypercube" else rng.normal(size=points.shape)
    generated, _ = flow.generate(drawn)
    log_q = guide.log_prob(points)
    return {
        "lost": float(np.mean(~np.isfinite(log_q))),
        "outside": guide.mass_outside,
        "parameters": guide.parameters,
        "latent": np.round(latent, 4),
        "drawn": np.round(drawn, 4),
        "generated": np.round(generated, 4),
        "round_trip": float(np.abs(again - points).max()),
    }


@dataclass(frozen=True)
class Paths:
    """Paths that carry light, and how many do not."""

    u: F32
    """(n, 2k+1)"""
    f: F32
    """(n, 3), W·sr⁻¹·m⁻²"""
    contexts: Mapping[str, NDArray[Any]]
    """Where they are, as `Guide.fit` takes it."""
    zeros: int
    surfaces: float
    """Share of the camera rays that meet a surface."""
    columns_hash: str
    scene_hash: str

    def fit(self, name: str, *, alike: bool = False, **options: Any) -> Guide:
        """A guide; `alike` lets every path count the same, without the thesis' resampling by radiance."""
        return Guide.fit(
            name,
            self.u,
            np.ones(len(self.u), np.float32) if alike else self.f,
            zeros=self.zeros,
            contexts=self.contexts,
            columns_hash=self.columns_hash,
            scene_hash=self.scene_hash,
            **options,
        )

    def take(self, rows: int) -> Paths:
        """The first so many, spread over the whole image."""
        order = np.random.default_rng(0).permutation(len(self.u))[:rows]
        return Paths(
            self.u[order],
            self.f[order],
            {name: values[order] for name, values in self.contexts.items()},
            self.zeros * len(order) // max(len(self.u), 1),
            self.surfaces,
            self.columns_hash,
            self.scene_hash,
        )


def training_paths(scene: Scene, parametrisation: str, *, spp: int, seed: int) -> Paths:
    """Uniform paths of so many samples a pixel, in chunks: only those that carry light are kept."""
    chunk = 4
    kept: list[dict[str, NDArray[Any]]] = []
    zeros, met, rays = 0, 0, 0
    columns_hash = scene_hash = ""
    for turn in range(max(spp // chunk, 1)):
        # Seeds of chunks are far from those of renders, whose pilot is no held-out set otherwise.
        pilot = scene.pilot(
            spp=min(chunk, spp),
            k=2,
            parametrisation=parametrisation,
            emitter_strategy="nee",
            seed=1_000_003 * (seed + 1) + turn,
        )
        lit = pilot.f.max(axis=1) > 0.0
        where = {name: getattr(pilot, name)[lit] for name in CONTEXTS}
        kept.append({"u": pilot.u[lit, : pilot.learned], "f": pilot.f[lit], **where})
        zeros += int(np.count_nonzero(~lit))
        met += int(np.count_nonzero(np.abs(pilot.normal[:, 0]).sum(axis=1) > 0.0))
        rays += len(lit)
        columns_hash, scene_hash = pilot.columns_hash, pilot.scene_hash
    all_of = {name: np.concatenate([part[name] for part in kept]) for name in kept[0]}
    contexts = {name: all_of[name] for name in CONTEXTS}
    surfaces = met / max(rays, 1)
    return Paths(all_of["u"], all_of["f"], contexts, zeros, surfaces, columns_hash, scene_hash)


def held_out(guide: Guide, paths: Paths) -> float:
    """Mean −ln q of paths in proportion to their largest component, as the guide's own training set is drawn.

    Without outliers, which it does not learn from, either. 0 is the uniform density's loss: above it a flow describes
    the paths worse than no flow does. Infinite where a path has no density at all.
    """
    weight = paths.f.max(axis=1).astype(np.float64)
    weight[weight > np.quantile(weight, OUTLIERS)] = 0.0
    log_q = guide.log_prob(paths.u).astype(np.float64)
    if np.isneginf(log_q[weight > 0.0]).any():
        return float("inf")
    return float(-(weight * np.where(weight > 0.0, log_q, 0.0)).sum() / weight.sum())
