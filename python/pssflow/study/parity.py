"""Random sampling beside Mitsuba's truth on whole scenes: runs of both, and Welch's test where it has power.

Scenes that people have are harder to compare than those made for tests: a lamp behind glass gives one path in a
million most of a tile's light. Nothing is clipped, since clipped means of two unbiased estimators differ. Instead a
tile that one sample dominates is tested as part of a larger one, more samples are drawn as long as one is left over,
and those that remain are counted (`welch_where_power`).
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..passes import TruthPass
from ..scene import Scene
from .welch import Verdict, welch_where_power

SCALAR, LLVM = "scalar_rgb", "llvm_ad_rgb"

F64 = NDArray[np.float64]

SIDE = 48
"""Pixels of a reduced film's longer side."""

BOUNCES = (1, 2, 3)


@dataclass(frozen=True)
class Plan:
    """How one scene is compared."""

    name: str
    path: Path
    variant: str = LLVM
    """Mitsuba's, for the truth. LLVM cannot hold thousands of instances."""
    spp: int = 256
    """Of each of our runs."""
    truth_factor: int = 1
    """The truth's samples for one of ours: in `scalar_rgb` its two depths share no numbers."""
    runs: int = 16
    """Seeds a side to begin with."""
    most_runs: int = 64
    """Seeds a side at most, if tiles are without power."""


SANMIGUEL_CAMERAS = ("", "_cam01", "_cam03", "_cam04", "_cam14", "_cam25")


def shared_plans(folder: Path) -> list[Plan]:
    """Those of the third-party scenes that are there."""
    plans = [
        Plan(name, folder / name / "scene.xml", spp=spp)
        for name, spp in {
            "cornell-box": 256,
            "veach-ajar": 256,
            "veach-bidir": 256,
            "veach-mis": 512,
            "staircase2": 256,
            "bathroom2": 256,
            "living-room": 256,
            "sponza-lajolla": 256,
        }.items()
    ]
    plans += [
        Plan(
            f"sanmiguel{camera}",
            folder / "sanmiguel" / f"scene{camera}.xml",
            SCALAR,
            spp=32,
            truth_factor=8,
            most_runs=32,
        )
        for camera in SANMIGUEL_CAMERAS
    ]
    return [plan for plan in plans if plan.path.is_file()]


def own_plans(folder: Path = Path("scenes")) -> list[Plan]:
    """Those of the project's own scenes."""
    return [Plan(path.parent.name, path) for path in sorted(folder.glob("*/scene.xml"))]


def shared_folder() -> Path | None:
    """What the environment variable PSSFLOW_SCENES names, if it is a folder."""
    folder = os.environ.get("PSSFLOW_SCENES")
    return Path(folder) if folder and Path(folder).is_dir() else None


def all_plans() -> list[Plan]:
    """The project's own scenes, under `scenes/`, and the third-party ones that are there, with all their cameras."""
    shared = shared_folder()
    own = [replace(plan, name=f"scenes/{plan.name}") for plan in own_plans()]
    return own + (shared_plans(shared) if shared else [])


def load(plan: Plan, side: int = SIDE) -> Scene:
    """The plan's scene in its variant, the film's longer side reduced to `side` pixels."""
    mi.set_variant(plan.variant)
    scene = mi.load_file(str(plan.path), optimize=False)
    width, height = (int(n) for n in scene.sensors()[0].film().crop_size())
    return Scene(scene, scale=side / max(width, height))


def truth_runs(scene: Scene, k: int, *, seeds: range, spp: int) -> F64:
    """k-bounce light by Mitsuba, `path` to depth k + 1 minus `path` to depth k: (runs, H, W, 3), unclipped.

    Raises:
        ValueError: a value is not finite.
    """
    mi.set_variant(scene.variant)
    truth = TruthPass(scene.mi_scene, scene.sensor, k, hide=scene.hide_emitters)
    images = []
    try:
        for seed in seeds:
            image, _, bad = truth(seed, spp)
            if bad:
                raise ValueError(
                    f"{scene.name}: Mitsuba's image holds {bad} values that are not finite"
                )
            images.append(image)
    finally:
        truth.restore()
    return np.stack(images)


def our_runs(scene: Scene, k: int, *, seeds: range, spp: int, **options: Any) -> F64:
    """The same by random sampling of ours, strategy `mis`: (runs, H, W, 3)."""
    return np.stack(
        [
            scene.render("none", spp, k=k, seed=seed, progress=False, **options).image
            for seed in seeds
        ]
    ).astype(np.float64)


def compare_means(scene: Scene, plan: Plan, k: int, *, seed0: int = 0) -> Verdict:
    """Welch's test of ours and the truth; the runs are doubled while tiles lack power, up to `plan.most_runs`."""
    ours = truth = np.zeros((0, scene.height, scene.width, 3))
    wanted = plan.runs
    spp = plan.spp
    while True:
        more = range(seed0 + len(ours), seed0 + wanted)
        truth = np.concatenate(
            [truth, truth_runs(scene, k, seeds=more, spp=spp * plan.truth_factor)]
        )
        # Other seeds than the truth's, though the generators have nothing in common.
        more = range(1000 + more.start, 1000 + more.stop)
        ours = np.concatenate([ours, our_runs(scene, k, seeds=more, spp=spp)])
        verdict = welch_where_power(truth, ours)
        if not verdict.without_power or wanted >= plan.most_runs:
            return verdict
        wanted = min(2 * wanted, plan.most_runs)
