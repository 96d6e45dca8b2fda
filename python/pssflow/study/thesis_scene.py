"""The runs of `pssflow study thesis`: its Tables 1 and 2 on one scene, and what sampling for the same time comes to.

Each run is a part that is kept (`parts.Parts`), with its image as an EXR beside its record.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .. import metrics
from ..progress import Progress
from ..reference import Reference, read_exr, reference
from ..render import Result
from ..scene import Scene, resize_film
from ..thesis import SCENES, ThesisScene
from .harness import file_name
from .parity import Plan
from .parts import Parts

__all__ = ["KINDS", "MOST_PIXELS", "ThesisRun", "ThesisRuns", "open_scene", "render_runs"]

MOST_PIXELS = 65_536
"""Of a film: the thesis' teapot has 256². Larger ones are scaled down, or the third-party scene would take an hour."""

PHASES = ("pilot", "fit", "render")

FIREFLY = 10.0
"""A pixel is a firefly where it is that many times as bright as the truth about it."""


@dataclass(frozen=True)
class Kind:
    """A row of Table 2 for each parametrisation."""

    name: str
    """As a file's name."""
    title: str
    guide: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    column: int | None = None
    """Which of the thesis' two shares stands beside it."""


KINDS = (
    Kind("random", "random", "none", column=0),
    Kind("learned", "learned as in the thesis", "realnvp", column=1),
    Kind("random-time", "random, same time", "none"),
    Kind(
        "auto",
        "auto, equal spp",
        "auto",
        # Its share of random numbers is its own choice, which the preset would fix.
        {"spp": 32, "preset": None, "emitter_strategy": "nee"},
    ),
)
"""In the order in which they are rendered: the third has the seconds of the second."""


@dataclass(frozen=True)
class ThesisRun:
    """One run, measured."""

    kind: Kind
    parametrisation: str
    stats: dict[str, Any]
    """`Result.stats`, and what `measured` adds."""
    image: Path
    """Its EXR."""

    @property
    def seconds(self) -> float:
        """Pilot, training and rendering."""
        return sum(self.stats["seconds"][phase] for phase in PHASES)

    @property
    def per_ray(self) -> float:
        """Non-zero paths per camera ray; of a learned run without its pilot."""
        return self.stats["nonzero"] / max(self.stats["camera_rays"], 1)


@dataclass(frozen=True)
class ThesisRuns:
    """All of one scene."""

    name: str
    scene: Scene
    plan: Plan
    thesis: ThesisScene | None
    """What the thesis measured there; None where it has no such scene."""
    truth: Reference
    runs: Sequence[ThesisRun]

    def of(self, parametrisation: str) -> dict[str, ThesisRun]:
        """By kind."""
        return {r.kind.name: r for r in self.runs if r.parametrisation == parametrisation}

    @property
    def parametrisations(self) -> list[str]:
        """Those that were rendered."""
        return list(dict.fromkeys(run.parametrisation for run in self.runs))

    def ratio(self, parametrisation: str) -> float:
        """Non-zero paths per camera ray, learned ÷ random: what the thesis has as 3.3, 6.1 and 4.9."""
        runs = self.of(parametrisation)
        random = runs["random"].per_ray
        return runs["learned"].per_ray / random if random > 0.0 else math.nan


def open_scene(plan: Plan, pixels: int) -> Scene:
    """A scene in its variant; its film has at most so many pixels."""
    import mitsuba as mi

    mi.set_variant(plan.variant)
    mi.set_log_level(mi.LogLevel.Error)
    loaded = mi.load_file(str(plan.path), optimize=False)
    width, height = (int(n) for n in loaded.sensors()[0].film().crop_size())
    if width * height > pixels:
        resize_film(loaded, 0, None, math.sqrt(pixels / (width * height)))
    scene = Scene(loaded)
    scene.name = plan.name
    return scene


def thesis_of(name: str) -> ThesisScene | None:
    """What the thesis measured on a scene of ours."""
    own = {"scenes/teapot": "teapot", "sanmiguel": "san-miguel"}.get(name)
    return None if own is None else SCENES[own]


def render_runs(
    plan: Plan,
    scene: Scene,
    parts: Parts,
    folder: Path,
    *,
    seed: int,
    reference_time: float,
    progress: Progress,
) -> ThesisRuns:
    """Renders what is not there yet, and measures all of it against Mitsuba's reference."""
    thesis = thesis_of(plan.name)
    parametrisations = list(thesis.shares) if thesis is not None else ["bsdf"]
    place = folder / "images" / f"{file_name(plan.name)}-reference.exr"
    parts.expect(1 + len(parametrisations) * len(KINDS))

    def truth() -> dict[str, Any]:
        found = reference(scene, 2, seconds=reference_time, progress=progress)
        found.write(place)
        return found.describe()

    about = parts(
        f"{plan.name} Mitsuba's reference",
        truth,
        files=[place],
        scene=scene.hash,
        seconds=reference_time,
    )
    read = read_exr(place)
    known = Reference(
        read.image,
        read.variance,
        passes=about["passes"],
        spp=about["spp"],
        seconds=about["seconds"],
        note=about["note"],
        k=2,
    )
    runs = []
    for parametrisation in parametrisations:
        seconds = math.nan
        for kind in KINDS:
            image = folder / "images" / f"{file_name(plan.name)}-{parametrisation}-{kind.name}.exr"
            arguments: dict[str, Any] = {"preset": "thesis", **kind.arguments}
            if kind.name == "random-time":
                arguments |= {"time": float(f"{seconds:.3g}")}

            def render(
                kind: Kind = kind,
                image: Path = image,
                arguments: Mapping[str, Any] = arguments,
                parametrisation: str = parametrisation,
            ) -> dict[str, Any]:
                result: Result = scene.render(
                    kind.guide,
                    parametrisation=parametrisation,
                    seed=seed,
                    progress=progress,
                    **arguments,
                )
                result.write(image)
                return result.stats | measured(result.image, known)

            stats = parts(
                f"{plan.name} {parametrisation} {kind.name}",
                render,
                files=[image],
                scene=scene.hash,
                arguments=arguments,
                seed=seed,
                reference_time=reference_time,
            )
            run = ThesisRun(kind, parametrisation, stats, image)
            seconds = run.seconds if kind.name == "learned" else seconds
            runs.append(run)
    return ThesisRuns(plan.name, scene, plan, thesis, known, runs)


def measured(image: Any, truth: Reference) -> dict[str, Any]:
    """Errors of an image, and how far they are a matter of single pixels.

    Returns:
        `relmse` and `relmse_trimmed`, relative to the truth about each pixel (`metrics.local_scale`); `firefly`, with
        `count`: pixels ten times as bright as the truth about them; `share`: of the summed
        squared error, what the worst .1 % of the pixels hold; `brightest`: the brightest pixel ÷ the truth's mean.
    """
    scale = metrics.local_scale(truth.image)
    against = (image, truth.image, truth.variance)
    x = np.asarray(image, np.float64).mean(axis=2)
    r = np.asarray(truth.image, np.float64).mean(axis=2)
    mean = max(float(r.mean()), np.finfo(np.float64).tiny)
    level = np.sqrt(scale).mean(
        axis=2
    )  # about the radiance around a pixel, never below a tenth of the mean
    error = (x - r) ** 2 / np.maximum(level**2, np.finfo(np.float64).tiny)
    worst = np.sort(error.ravel())[-max(math.ceil(metrics.TRIMMED * error.size), 1) :]
    return {
        "relmse": metrics.finite_or_none(metrics.relmse(*against, scale=scale)),
        "relmse_trimmed": metrics.finite_or_none(metrics.relmse_trimmed(*against, scale=scale)),
        "firefly": {
            "count": int(np.count_nonzero(x > FIREFLY * level)),
            "share": float(worst.sum() / max(error.sum(), np.finfo(np.float64).tiny)),
            "brightest": float(x.max() / mean),
        },
    }
