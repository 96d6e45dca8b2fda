"""The compiled core: scenes for it, and runs of our renderer with seeds of their own."""

from __future__ import annotations

import json
import sysconfig
from collections.abc import Iterable
from typing import Any

import mitsuba as mi
import numpy as np

from pssflow import _core
from pssflow.export import Export, export

from .runs import Runs


def core_scene(scene: mi.Scene, sensor: int = 0) -> tuple[_core.Scene, Export]:
    """The scene as the core traces it, and the export that it was built from."""
    exported = export(scene, sensor)
    # Embree may come from the wheel `embreex`.
    core = _core.Scene(exported.json(), exported.arrays, [sysconfig.get_path("platlib")])
    return core, exported


def render(scene: _core.Scene, **options: Any) -> dict[str, Any]:
    """One call of `_core.Scene.render` with its record parsed. Defaults: no guide, k = 2, `bsdf`, `mis`, seed 0."""
    defaults = {
        "guide": "none",
        "k": 2,
        "parametrisation": "bsdf",
        "emitter_strategy": "mis",
        "keep_pilot": True,
        "seed": 0,
        "threads": 0,
    }
    result = scene.render(json.dumps(defaults | options))
    return result | {"record": json.loads(result["record"])}


def our_runs(scene: _core.Scene, *, seeds: Iterable[int], spp: int, **options: Any) -> Runs:
    """Our renderer, one image a seed; options as in `render`."""
    return np.stack([render(scene, seed=seed, spp=spp, **options)["image"] for seed in seeds])
