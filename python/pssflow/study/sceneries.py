"""Scenes of the studies: by name or file, at about a given number of pixels, with Mitsuba's truth."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ..progress import Progress
from ..reference import Reference, reference
from ..scene import Scene, resize_film
from . import parity
from .harness import Case, Scenery
from .methods import Stage
from .parity import Plan
from .store import ALL, BOUNCES

__all__ = ["SIX", "every_scene", "named_scenes", "scenery"]

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
    light: str = BOUNCES,
    max_depth: int = -1,
) -> Scenery:
    """A scene whose film has about so many pixels; its truth is Mitsuba's, cached under the scene's hash.

    With `light` = `all` it is a scene of another name, whose truth is the whole image. With another one than that and
    `k bounces` the truth is the whole image of paths up to `max_depth`, which all methods are expected to render.
    """
    name = f"{plan.name}, all light" if light == ALL else plan.name

    def open_it() -> Case:
        import mitsuba as mi

        def load(variant: str) -> Any:
            mi.set_variant(variant)
            mi.set_log_level(mi.LogLevel.Error)
            return mi.load_file(str(plan.path), optimize=False)

        def load_resized(variant: str) -> Any:
            loaded = load(variant)
            resize_film(loaded, 0, None, scale)
            return loaded

        loaded = load(plan.variant)
        width, height = (int(n) for n in loaded.sensors()[0].film().crop_size())
        scale = math.sqrt(pixels / (width * height))
        scene = Scene(loaded, scale=scale)
        scene.name = plan.name
        for text in scene.notes:
            note(f"{plan.name}: {text}")

        def truth() -> Reference:
            found = reference(
                scene,
                k,
                seconds=reference_time,
                progress=progress,
                all_light=light != BOUNCES,
                max_depth=max_depth,
            )
            note(f"{name}: reference: {found.note}")
            return found

        def warm_up() -> None:
            scene.render("none", 1, k=k, progress=False)

        stage = Stage(scene, load_resized)
        return Case(digest=scene.hash, scene=stage, truth=truth, warm_up=warm_up)

    return Scenery(name, open_it, light)
