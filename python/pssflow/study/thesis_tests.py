"""Experiments of `pssflow study thesis`: why our flow finds fewer paths than the thesis' does, and what it overfits.

Each changes one thing of the thesis' method on its teapot, and counts non-zero paths per camera ray beside random
numbers in the same scene. Fits run on one thread each, so that as many go side by side as there are cores.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any

import numpy as np

from ..scene import Scene
from .parity import Plan
from .parts import Parts
from .thesis_flow import Paths, held_out, learn_crescent, training_paths
from .thesis_scene import open_scene

__all__ = ["EXPERIMENTS", "Experiment", "Found", "experiments", "overfitting", "side_by_side"]

SPP = 16


@dataclass(frozen=True)
class Experiment:
    """One change of the thesis' method."""

    name: str
    tells: str
    """What it would explain."""
    guide: str = "realnvp"
    options: Mapping[str, Any] = field(default_factory=dict)
    pilot_spp: int = SPP
    alike: bool = False
    """Whether all paths that carry light count the same in training."""
    lamp: float = 1.0
    """Factor on the radius of the disk light."""
    point_light: bool = False
    """Whether the point light of PBRT's file is there, at the camera, of intensity 50."""
    everywhere: bool = False
    """Whether it is made for all parametrisations: those that tell most."""


EXPERIMENTS = (
    Experiment("as in the thesis", "the row of Table 2, with a pilot of its own", everywhere=True),
    Experiment("4 × the epochs", "training stopped too early", options={"epochs": 28}),
    Experiment("4 × the pilot", "too few paths to learn from", pilot_spp=4 * SPP),
    Experiment(
        "3 × the learning rate",
        "a learning rate that the thesis does not give",
        options={"learning_rate": 3e-3},
    ),
    Experiment(
        "couplings stretch by up to e⁴",
        "the bound of tanh on a coupling's scale",
        options={"s_max": 4.0},
    ),
    Experiment("no resampling", "resampling by radiance favours bright paths", alike=True),
    Experiment(
        "through a logit",
        "samples that fall outside the cube",
        guide="realnvp-logit",
        everywhere=True,
    ),
    Experiment(
        "through a logit, 4 × the pilot",
        "both of them",
        guide="realnvp-logit",
        pilot_spp=4 * SPP,
    ),
    Experiment(
        "logit, knows the pixel",
        "one density for all pixels (Zheng and Zwicker's know theirs)",
        guide="realnvp-logit",
        options={"condition": "pixel"},
        everywhere=True,
    ),
    Experiment("hypercube prior", "the thesis' failing prior", options={"prior": "hypercube"}),
    Experiment("lamp of half the radius", "the light's size", lamp=0.5),
    Experiment("lamp of twice the radius", "the light's size", lamp=2.0),
    Experiment("with PBRT's point light", "a second light that reaches more", point_light=True),
)


@dataclass(frozen=True)
class Found:
    """What an experiment came to."""

    experiment: Experiment
    parametrisation: str
    value: dict[str, Any]

    @property
    def ratio(self) -> float:
        """Non-zero paths per camera ray, learned ÷ random."""
        random = self.value["random_per_ray"]
        return self.value["per_ray"] / random if random > 0.0 else float("nan")


def experiments(
    plan: Plan,
    scene: Scene,
    parts: Parts,
    parametrisations: Sequence[str],
    *,
    full: bool,
    seed: int,
    pixels: int,
) -> list[Found]:
    """All experiments that the scene allows: lights are changed only where there is a disk to change.

    In all parametrisations if `full`, else in the first one and a few of them in the others.
    """
    wanted = [e for e in EXPERIMENTS if _is_plain(e) or _disk(scene) is not None]
    cases = [
        (e, p)
        for p in parametrisations
        for e in wanted
        if full or e.everywhere or p == parametrisations[0]
    ]
    parts.expect(len(cases))
    # Lights change the scene: those are built here, once, since Mitsuba's variants belong to one thread.
    scenes = {_light(e): scene if _is_plain(e) else _changed(plan, pixels, e) for e in wanted}
    common = {"seed": seed, "hash": scene.hash, "pixels": pixels}

    def work(case: tuple[Experiment, str], stop: threading.Event) -> Found:
        experiment, parametrisation = case
        value = parts(
            f"{plan.name} {parametrisation} {experiment.name}",
            partial(
                _measure,
                scenes[_light(experiment)],
                experiment,
                parametrisation,
                seed,
                _until(stop),
            ),
            experiment=repr(experiment),
            **common,
        )
        return Found(experiment, parametrisation, value)

    return side_by_side(work, cases)


def _measure(
    scene: Scene,
    experiment: Experiment,
    parametrisation: str,
    seed: int,
    listener: Callable[[str, float], None],
) -> dict[str, Any]:
    """Fits the experiment's flow and renders with it alone, as the thesis does."""
    paths = training_paths(scene, parametrisation, spp=experiment.pilot_spp, seed=seed)
    guide = paths.fit(
        experiment.guide,
        alike=experiment.alike,
        seed=seed,
        progress=listener,
        **experiment.options,
    )
    common: dict[str, Any] = {
        "spp": SPP,
        "parametrisation": parametrisation,
        "emitter_strategy": "nee",
        "seed": seed,
        "progress": False,
    }
    random = scene.render("none", **common).stats
    own = scene.render(guide, uniform_fraction=0.0, **common).stats
    return {
        "trained_on": len(paths.u),
        "surfaces": paths.surfaces,
        "parameters": guide.parameters,
        "mass_outside": guide.mass_outside,
        "loss": held_out(guide, training_paths(scene, parametrisation, spp=4, seed=seed + 1))
        # A flow that knows the pixel has a density for each of them.
        if experiment.options.get("condition") is None
        else None,
        "per_ray": own["nonzero"] / own["camera_rays"],
        "found_per_ray": own["paths_found"] / own["camera_rays"],
        "share": own["nonzero_share"],
        "variance": own["variance"],
        "random_per_ray": random["nonzero"] / random["camera_rays"],
        "random_found_per_ray": random["paths_found"] / random["camera_rays"],
        "random_share": random["nonzero_share"],
        "random_variance": random["variance"],
    }


def _is_plain(experiment: Experiment) -> bool:
    return experiment.lamp == 1.0 and not experiment.point_light


def _light(experiment: Experiment) -> tuple[float, bool]:
    return experiment.lamp, experiment.point_light


def _disk(scene: Scene) -> Any:
    """The scene's only light, where it is a disk."""
    lights = [shape for shape in scene.mi_scene.shapes() if shape.emitter() is not None]
    one = len(lights) == 1 == len(scene.mi_scene.emitters())
    return lights[0] if one and lights[0].class_name() == "Disk" else None


def _changed(plan: Plan, pixels: int, experiment: Experiment) -> Scene:
    """The scene with another light."""
    import mitsuba as mi

    scene = open_scene(plan, pixels)
    if experiment.lamp != 1.0:
        parameters = mi.traverse(_disk(scene))
        parameters["to_world"] = parameters["to_world"] @ mi.ScalarTransform4f().scale(
            [experiment.lamp, experiment.lamp, 1.0]
        )
        parameters.update()
        return Scene(scene.mi_scene)
    camera = scene.mi_scene.sensors()[0]
    place = mi.ScalarPoint3f(np.array(camera.world_transform().translation()).ravel()[:3])
    white = {"type": "rgb", "value": 50.0}
    return Scene(
        mi.load_dict(
            {
                "type": "scene",
                "sensor": camera,
                "point": {"type": "point", "position": place, "intensity": white},
                **{f"shape_{i}": shape for i, shape in enumerate(scene.mi_scene.shapes())},
            },
            optimize=False,
        )
    )


LEARNING = {
    "paths": [
        *({"rows": 1024, "epochs": e} for e in (1, 2, 4, 7, 14, 28, 56)),
        *({"rows": 4096, "epochs": e} for e in (1, 2, 4, 7, 14, 28, 56)),
        *({"rows": 16_384, "epochs": e} for e in (1, 2, 4, 7, 14)),
    ],
    "parameters": [{"rows": 4096, "epochs": 28, "hidden": h} for h in (5, 10, 20, 40, 80)],
}
"""Fits of the overfitting question: by number of paths over epochs, and by number of parameters."""


def overfitting(
    scene: Scene, parts: Parts, parametrisation: str, *, seed: int
) -> list[dict[str, Any]]:
    """Training and held-out loss of each fit: `of`, `rows`, `epochs`, `hidden`, `parameters`, `training`, `held_out`.

    A fit over e epochs is the beginning of one over more: order and steps depend on the seed alone.
    """

    @cache
    def drawn() -> tuple[Paths, Paths]:
        """To learn from, and held out."""
        return (
            training_paths(scene, parametrisation, spp=SPP, seed=seed),
            training_paths(scene, parametrisation, spp=4, seed=seed + 1),
        )

    common = {"scene": scene.hash, "seed": seed, "on": parametrisation}
    parts.expect(1)
    lit = parts(f"{scene.name} paths with light", lambda: {"paths": len(drawn()[0].u)}, **common)
    fits = [{"of": of, "hidden": 40, **fit} for of, list_ in LEARNING.items() for fit in list_]
    # A scene of few paths has fewer to learn from than the largest set asks for.
    fits = [fit for fit in fits if fit["rows"] <= max(lit["paths"], 1024)]
    parts.expect(len(fits))

    def work(fit: dict[str, Any], stop: threading.Event) -> dict[str, Any]:
        def make() -> dict[str, Any]:
            own, others = drawn()[0].take(fit["rows"]), drawn()[1]
            guide = own.fit(
                "realnvp",
                epochs=fit["epochs"],
                hidden=fit["hidden"],
                seed=seed,
                progress=_until(stop),
            )
            return {
                "parameters": guide.parameters,
                "trained_on": len(own.u),
                "training": held_out(guide, own),
                "held_out": held_out(guide, others),
            }

        name = f"{scene.name} loss by {fit['of']}, {fit['rows']} paths {fit['epochs']} epochs {fit['hidden']} units"
        value = parts(name, make, fit=fit, **common)
        return fit | value

    return side_by_side(work, fits)


def crescents(parts: Parts, seed: int) -> dict[str, dict[str, Any]]:
    """The crescent by each prior."""

    def work(prior: str, stop: threading.Event) -> dict[str, Any]:
        return parts(
            f"crescent {prior}", partial(learn_crescent, prior, seed, _until(stop)), seed=seed
        )

    priors = ["gaussian", "hypercube"]
    parts.expect(len(priors))
    return dict(zip(priors, side_by_side(work, priors), strict=True))


def side_by_side(work: Callable[[Any, threading.Event], Any], cases: Sequence[Any]) -> list[Any]:
    """The results in order, as many at a time as there are cores; on Ctrl-C, or if one fails, the others end soon.

    Raises:
        Exception: what the case raised that failed first, not what those raise that are stopped for it.
    """
    stop = threading.Event()
    first: list[BaseException] = []

    def failed(future: Future[Any]) -> None:
        if not future.cancelled() and (error := future.exception()) is not None:
            first.append(error)

    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        futures = [pool.submit(work, case, stop) for case in cases]
        for future in futures:
            future.add_done_callback(failed)
        try:
            wait(futures, return_when=FIRST_EXCEPTION)
        finally:
            if not all(future.done() and not future.exception() for future in futures):
                stop.set()
                pool.shutdown(wait=False, cancel_futures=True)
    if first:
        raise first[0]
    return [future.result() for future in futures]


def _until(stop: threading.Event) -> Callable[[str, float], None]:
    """A listener that ends a fit."""

    def listen(phase: str, done: float) -> None:
        if stop.is_set():
            raise RuntimeError(f"{phase} was stopped at {done:.0%}")

    return listen
