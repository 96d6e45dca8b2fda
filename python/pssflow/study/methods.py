"""Methods of the studies by name: pssflow's guides, Mitsuba's path tracer, and a guide of another make.

| name              | what it is                                                                           |
|-------------------|--------------------------------------------------------------------------------------|
| `none`, `auto`, … | a guide of `pssflow.guide.guide_names()`                                             |
| `mitsuba-llvm`    | `pssflow_kbounce` in `llvm_ad_rgb`: Mitsuba's path tracer, for k-bounce light only   |
| `mitsuba-scalar`  | the same in `scalar_rgb`, where Python is called for every path and takes most of it |
| `python-vegas`    | Lepage's own package `vegas`, as a guide of pssflow by `guide=` object               |
| `mitsuba-path`    | Mitsuba's `path` in `llvm_ad_rgb`, all light: on scenes of its own, with their truth |

All of them join the light with MIS. A difference of two renders is none: it would render the directly lit scene as
well, only to throw it away. `mitsuba-path` renders something else than the others, so that it has a truth of its own
and is compared with none of them.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..guide import choose, guide_names
from ..passes import AllLightPass, KBouncePass, Pass
from ..progress import Progress, reporting
from ..reference import Running
from ..render import Result
from ..scene import Scene
from ..variants import llvm_problem
from .harness import Method, Shot
from .store import ALL, BOUNCES

__all__ = [
    "MITSUBA",
    "OTHERS",
    "PATH",
    "Stage",
    "guided",
    "method_names",
    "missing",
    "mitsuba",
    "named_method",
    "shot_of",
]

PATH = "mitsuba-path"

MITSUBA = {"mitsuba-llvm": "llvm_ad_rgb", "mitsuba-scalar": "scalar_rgb"}
"""Name → Mitsuba's variant."""

VEGAS = "python-vegas"

OTHERS = (*MITSUBA, VEGAS, PATH)
"""Methods that are no guide of pssflow's own."""

PATHS_PER_PASS = (1 << 18, 1 << 20)
"""Of Mitsuba, about, at first and at most: a wavefront that is worth its overhead, and many to a second."""

SHARE_OF_FIRST = 0.25
"""Of the shortest time that a pass takes, as far as its number of paths lets it: what does not fit any more is lost."""


@dataclass
class Stage:
    """A scene that all methods can render: ours, and Mitsuba's in whatever variant a method needs."""

    scene: Scene
    load: Callable[[str], Any]
    """Sets a variant of Mitsuba and loads the scene in it, with the film's size of `scene`."""
    loaded: dict[str, Any] = field(default_factory=dict)
    too_slow: set[str] = field(default_factory=set)
    """Methods that could not finish a pass in their time: other seeds need not try."""

    def in_variant(self, variant: str) -> Any:
        """The `mi.Scene`, loaded once. Sets the variant."""
        import mitsuba as mi

        mi.set_variant(variant)
        if variant == self.scene.variant:
            return self.scene.mi_scene
        if variant not in self.loaded:
            self.loaded[variant] = self.load(variant)
        return self.loaded[variant]


def method_names() -> list[str]:
    """All that `--guides` of a study understands; guides may be joined by `+`."""
    return [*guide_names(), *OTHERS]


def missing(name: str) -> str | None:
    """Why a method cannot be used on this machine; None if it can.

    Raises:
        ValueError: there is no method of that name.
    """
    from importlib.util import find_spec

    if name in ("mitsuba-llvm", PATH):
        return llvm_problem()
    if name == VEGAS:
        if find_spec("vegas") is None:
            return "the package `vegas` is not installed; pip install 'pssflow[studies]'"
        return None
    if name not in MITSUBA:
        try:
            choose(name, {})
        except ValueError as error:
            raise ValueError(f"{error}; studies also know {', '.join(OTHERS)}") from None
    return None


def named_method(name: str, k: int, threads: int | None, unit: str = "s") -> Method:
    """The method of that name; its budgets are seconds, or with the unit `spp` samples per pixel."""
    if name == PATH:
        return mitsuba(
            name,
            "llvm_ad_rgb",
            lambda stage, scene: AllLightPass(scene, 0, hide=stage.scene.hide_emitters),
            threads,
            unit,
            {"integrator": "path"},
            light=ALL,
        )
    if name in MITSUBA:

        def k_bounces(stage: Stage, scene: Any) -> Pass:
            if stage.scene.hide_emitters:
                raise ValueError("`hide_emitters` is set, which pssflow_kbounce does not know")
            return KBouncePass(scene, 0, k)

        options = {"integrator": "pssflow_kbounce"}
        return mitsuba(name, MITSUBA[name], k_bounces, threads, unit, options)
    if name == VEGAS:
        from importlib.metadata import version

        from .vegas_guide import VegasGuide

        return guided(name, VegasGuide, k, threads, {"vegas": version("vegas")}, unit)
    return guided(name, lambda: name, k, threads, {}, unit)


def guided(
    name: str,
    guide: Callable[[], Any],
    k: int,
    threads: int | None,
    options: Mapping[str, Any],
    unit: str = "s",
    predict: Callable[[Scene, Result], float | None] = lambda scene, result: None,
    **guide_options: Any,
) -> Method:
    """A guide, made anew for each run: one render with snapshots by time, one for each budget by samples.

    Args:
        name: as the charts have it.
        guide: gives a guide's name or object.
        k: bounces.
        threads: None for all cores.
        options: for the record.
        unit: `s` or `spp`.
        predict: asked for the gain after the time is over.
        **guide_options: the guide's own.
    """

    def run(stage: Stage, seed: int, times: Sequence[float], progress: Progress) -> list[Shot]:
        common: dict[str, Any] = {"k": k, "threads": threads, "seed": seed, "progress": progress}
        common |= guide_options
        if unit == "spp":
            parts = tuple(stage.scene.render(guide(), spp=int(spp), **common) for spp in times)
        else:
            whole = stage.scene.render(guide(), time=times[-1], snapshots=times[:-1], **common)
            parts = (*whole.snapshots, whole)
        shots = [shot_of(part, budget) for part, budget in zip(parts, times, strict=True)]
        return [*shots[:-1], replace(shots[-1], predicted_gain=predict(stage.scene, parts[-1]))]

    inside = "rendering" if name == "none" else "pilot, training, selection and rendering"
    budget = f"{inside} inside; loading and BVH outside"
    if unit == "spp":
        budget = "all samples of the render" if name == "none" else "the pilot's samples inside"
    return Method(name, run, options, budget=budget)


def shot_of(result: Result, budget: float) -> Shot:
    """A render of ours as a study takes it."""
    stats = result.stats
    # Before its pilot is over a guide has drawn nothing: the pilot's share then is all there is.
    drawn = stats["nonzero_share"] if stats["paths_found"] else stats["pilot"]["nonzero_share"]
    return Shot(
        time=budget,
        elapsed=stats["elapsed"],
        image=result.image,
        variance=result.variance,
        spp=sum(part["spp"] for part in stats["passes"]),
        chosen=stats["chosen"],
        nonzero_share=drawn,
        parameters=((stats["training"] or {}).get("guide") or {}).get("parameters"),
        seconds={phase: stats["seconds"][phase] for phase in ("pilot", "fit", "render")},
    )


def mitsuba(
    name: str,
    variant: str,
    make: Callable[[Stage, Any], Pass],
    threads: int | None,
    unit: str,
    options: Mapping[str, Any],
    light: str = BOUNCES,
) -> Method:
    """An integrator of Mitsuba's, in passes until the time or the samples are over.

    Args:
        name: as the charts have it.
        variant: of Mitsuba.
        make: gives a pass of the stage's scene as it is in that variant.
        threads: None for all cores.
        unit: `s` or `spp`.
        options: for the record.
        light: what it renders.
    """

    def run(stage: Stage, seed: int, times: Sequence[float], progress: Progress) -> list[Shot]:
        if name in stage.too_slow:
            return []
        before = stage.scene.variant
        try:
            scene = stage.in_variant(variant)
            one = make(stage, scene)
            try:
                with _threads(threads), reporting(progress) as listener:
                    passes = _counted if unit == "spp" else _passes
                    shots = passes(one, name, seed, stage.scene, times, listener)
            finally:
                one.restore()
        finally:
            import mitsuba as mi

            mi.set_variant(before)
        if not shots:
            stage.too_slow.add(name)
        return shots

    budget = "rendering inside; loading and compiling outside"
    return Method(
        name,
        run,
        {**options, "variant": variant},
        budget="all samples of the render; compiling outside" if unit == "spp" else budget,
        light=light,
    )


def _counted(
    render: Pass,
    name: str,
    seed: int,
    scene: Scene,
    budgets: Sequence[float],
    listener: Callable[[str, float], None] | None,
) -> list[Shot]:
    """Whole passes until each number of samples is reached; at least two to the first one, for a variance."""
    wanted = [int(spp) for spp in budgets]
    pixels = scene.width * scene.height
    common = math.gcd(*wanted)
    most = max(min(PATHS_PER_PASS[0] // pixels, common // 2), 1)
    # All passes are of one size, and end at each budget.
    spp = max(size for size in range(1, most + 1) if common % size == 0)
    state = Running.empty([scene.width, scene.height], spp)
    first = (seed + 1) << 20
    start = time.perf_counter()
    if render.jit:
        render(first - 1, spp)  # the first pass compiles
    warm_up = time.perf_counter() - start
    start = time.perf_counter()
    shots = []
    for budget in wanted:
        while state.spp < budget:
            image, drawn, bad = render(first + state.passes, spp)
            state = state.with_pass(image, spp=drawn, non_finite=bad, seconds=0.0)
            if listener is not None:
                listener("render", state.spp / wanted[-1])
        elapsed = time.perf_counter() - start
        seconds = {"render": elapsed, "warm_up": warm_up}
        shots.append(_shot(state, budget, elapsed, name, seconds))
    return shots


def _passes(
    render: Pass,
    name: str,
    seed: int,
    scene: Scene,
    times: Sequence[float],
    listener: Callable[[str, float], None] | None,
) -> list[Shot]:
    """Whole passes, none of which ends after its time; the snapshot at a time is what there was then."""
    pixels = scene.width * scene.height
    spp, most = (max(paths // pixels, 1) if render.jit else 1 for paths in PATHS_PER_PASS)
    # References count from 0, and must not share a number with what they measure.
    first = (seed + 1) << 20
    start = time.perf_counter()
    longest = 0.0

    def measure(spp: int, seed: int) -> float:
        """Seconds of a pass: its first one compiles, its second one tells."""
        render(seed, spp)
        begun = time.perf_counter()
        render(seed + 1, spp)
        return time.perf_counter() - begun

    if render.jit:
        longest = measure(spp, first - 2)
        fitting = SHARE_OF_FIRST * times[0] / longest if longest > 0.0 else 1.0
        suits = min(max(int(spp * fitting), 1), most)
        if suits != spp and not 1.0 <= fitting < 2.0:
            spp = suits
            longest = measure(spp, first - 4)
    warm_up = time.perf_counter() - start
    state = Running.empty([scene.width, scene.height], spp)
    elapsed = 0.0
    shots: list[Shot | None] = []

    def shoot(until: float) -> None:
        """Snapshots of what there is, at all times before this one."""
        while len(shots) < len(times) and times[len(shots)] < until:
            shots.append(None if not state.passes else shot(times[len(shots)]))

    def shot(at: float) -> Shot:
        return _shot(state, at, elapsed, name, {"render": elapsed, "warm_up": warm_up})

    while elapsed + longest <= times[-1]:
        begun = time.perf_counter()
        image, drawn, bad = render(first + state.passes, spp)
        after = state.with_pass(image, spp=drawn, non_finite=bad, seconds=0.0)
        took = time.perf_counter() - begun
        longest = max(0.9 * longest, took)
        shoot(elapsed + took)
        if elapsed + took > times[-1]:
            break
        # What snapshots take is between the passes, and not the method's.
        state, elapsed = after, elapsed + took
        if listener is not None:
            listener("render", elapsed / times[-1])
    shoot(float("inf"))
    return [taken for taken in shots if taken is not None]


def _shot(
    state: Running, budget: float, elapsed: float, name: str, seconds: Mapping[str, float]
) -> Shot:
    """What passes have come to."""
    return Shot(
        time=budget,
        elapsed=elapsed,
        image=state.mean.astype(np.float32),
        variance=state.variance().astype(np.float32) if state.passes > 1 else None,
        spp=state.spp,
        chosen=name,
        seconds=seconds,
    )


@contextmanager
def _threads(threads: int | None) -> Iterator[None]:
    """Size of Mitsuba's pool for a while."""
    import drjit as dr

    if threads is None:
        yield
        return
    dr.set_thread_count(threads)
    try:
        yield
    finally:
        dr.set_thread_count(os.cpu_count() or 1)
