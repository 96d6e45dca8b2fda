"""Scenes and methods of the studies: by name or file, at about a given number of pixels, with Mitsuba's truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ..progress import Progress
from ..reference import Reference, reference
from ..render import Result
from ..scene import Scene
from . import parity
from .harness import Case, Method, Scenery, Shot
from .parity import Plan

__all__ = ["SIX", "every_scene", "named_scenes", "pssflow_method", "scenery", "shot_of"]

SIX = (
    *("scenes/door-ajar", "scenes/courtyard", "scenes/many-lights"),
    *("veach-ajar|scenes/glossy", "staircase2|scenes/cornell-box", "sponza-lajolla|scenes/leaves"),
)
"""The standard scenes; after a bar the own scene that stands in where the third-party one is not there."""


def every_scene() -> list[Plan]:
    """The project's own scenes, and the third-party ones that are there (one camera each)."""
    return [plan for plan in parity.all_plans() if "_cam" not in plan.name]


def named_scenes(names: Sequence[str]) -> list[Plan]:
    """Scenes by their names, or as paths of XML files.

    Raises:
        FileNotFoundError: there is no such scene.
        ValueError: one was named twice.
    """
    known = {plan.name: plan for plan in parity.all_plans()}
    plans = []
    for name in names:
        alternatives = [part.removesuffix("/scene.xml").rstrip("/") for part in name.split("|")]
        plan = next((known[part] for part in alternatives if part in known), None)
        if plan is None:
            path = Path(name)
            if not path.is_file():
                listed = ", ".join(known) or "none here"
                raise FileNotFoundError(
                    f"{name}: there is no such file, and no scene of that name ({listed})"
                )
            plan = Plan(name, path)
        plans.append(plan)
    if len({plan.name for plan in plans}) < len(plans):
        raise ValueError(f"a scene was named twice: {', '.join(plan.name for plan in plans)}")
    return plans


def scenery(
    plan: Plan,
    pixels: int,
    k: int,
    reference_time: float,
    progress: Progress = False,
    note: Callable[[str], object] = lambda text: None,
) -> Scenery:
    """A scene whose film has about so many pixels; its truth is Mitsuba's, cached under the scene's hash."""

    def open_it() -> Case:
        import mitsuba as mi

        mi.set_variant(plan.variant)
        mi.set_log_level(mi.LogLevel.Error)
        loaded: Any = mi.load_file(str(plan.path), optimize=False)
        width, height = (int(n) for n in loaded.sensors()[0].film().crop_size())
        scene = Scene(loaded, scale=math.sqrt(pixels / (width * height)))
        scene.name = plan.name
        for text in scene.notes:
            note(f"{plan.name}: {text}")

        def truth() -> Reference:
            found = reference(scene, k, seconds=reference_time, progress=progress)
            note(f"{plan.name}: reference: {found.note}")
            return found

        def warm_up() -> None:
            scene.render("none", 1, k=k, progress=False)

        return Case(digest=scene.hash, scene=scene, truth=truth, warm_up=warm_up)

    return Scenery(plan.name, open_it)


def pssflow_method(guide: str, k: int, threads: int | None, **options: Any) -> Method:
    """A guide of the registry, with its usual options or others."""

    def run(scene: Scene, seed: int, times: Sequence[float], progress: Progress) -> list[Shot]:
        whole = scene.render(
            guide,
            time=times[-1],
            snapshots=times[:-1],
            k=k,
            threads=threads,
            seed=seed,
            progress=progress,
            **options,
        )
        parts = (*whole.snapshots, whole)
        return [shot_of(part, seconds) for part, seconds in zip(parts, times, strict=True)]

    return Method(guide, run, options)


def shot_of(result: Result, seconds: float) -> Shot:
    """A render of ours as a study takes it."""
    stats = result.stats
    # Before its pilot is over a guide has drawn nothing: the pilot's share then is all there is.
    drawn = stats["nonzero_share"] if stats["paths_found"] else stats["pilot"]["nonzero_share"]
    return Shot(
        time=seconds,
        elapsed=stats["elapsed"],
        image=result.image,
        variance=result.variance,
        spp=sum(part["spp"] for part in stats["passes"]),
        chosen=stats["chosen"],
        nonzero_share=drawn,
        seconds={phase: stats["seconds"][phase] for phase in ("pilot", "fit", "render")},
    )
