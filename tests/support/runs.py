"""Runs of Mitsuba's renderer with seeds of their own, as arrays (runs, height, width, 3)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

Runs = NDArray[np.float32]


def mitsuba_runs(scene: mi.Scene, *, max_depth: int, seeds: Iterable[int], spp: int) -> Runs:
    """Mitsuba's `path`, one image a seed, in the scene's own film.

    Emitters hide where the scene's integrator hides them.
    """
    # Roulette would draw numbers and end paths that the difference of two depths needs.
    hide = bool(getattr(scene.integrator(), "hide_emitters", False))
    depths = {"max_depth": max_depth, "rr_depth": max_depth + 2}
    path = {"type": "path", "hide_emitters": hide, **depths}
    return integrator_runs(scene, path, seeds=seeds, spp=spp)


def integrator_runs(
    scene: mi.Scene, integrator: dict[str, Any], *, seeds: Iterable[int], spp: int
) -> Runs:
    """Any integrator, as a dictionary, one image a seed, in the scene's own film."""
    loaded = mi.load_dict(integrator)
    images = []
    for seed in seeds:
        image = mi.render(scene, integrator=loaded, spp=spp, seed=seed)  # pyright: ignore[reportArgumentType]
        images.append(np.array(image, dtype=np.float32)[..., :3])
    return np.stack(images)


def truth_runs(scene: mi.Scene, *, k: int, seeds: Iterable[int], spp: int) -> Runs:
    """k-bounce light by Mitsuba: `path` to depth k + 1 minus `path` to depth k.

    In LLVM variants both draw the same numbers for one seed, and what they share cancels
    (`test_what_two_depths_share_cancels`).
    """
    seeds = list(seeds)
    deep = mitsuba_runs(scene, max_depth=k + 1, seeds=seeds, spp=spp)
    return deep - mitsuba_runs(scene, max_depth=k, seeds=seeds, spp=spp)
