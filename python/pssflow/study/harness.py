"""Methods × scenes × seeds at given times: the runs of a study, measured, kept, and resumed.

Within a scene the methods take turns, seed by seed and each time in another order, so that whatever else the machine
does hits all of them alike. One run goes to the longest time and hands out its image at the shorter ones. A finished
run is kept at once; what was kept under the same configuration is not run again, and what was kept under another one is
not shown.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import _core, metrics
from ..files import first_line
from ..output import make_folder
from ..progress import Progress
from ..reference import Reference, read_exr
from .flip import flip
from .store import ALL, BOUNCES, Row, Store, commit, configuration, processor

__all__ = [
    "ALL",
    "BOUNCES",
    "Case",
    "Method",
    "Scenery",
    "Shot",
    "Study",
    "image_path",
    "reference_path",
]

F32 = NDArray[np.float32]

PHASES = ("pilot", "fit", "render", "warm_up")

FAILURES = (OSError, ValueError, RuntimeError)
"""What one scene or method may raise without ending the study; a mistake in pssflow ends it."""


@dataclass(frozen=True)
class Shot:
    """What a method had after a budget."""

    time: float
    """Seconds that were allowed, or samples per pixel."""
    elapsed: float
    """Seconds that were used."""
    image: F32
    """(H, W, 3)"""
    variance: F32 | None
    """Of the mean, (H, W, 3), where the method knows it."""
    spp: int
    chosen: str = ""
    nonzero_share: float | None = None
    parameters: int | None = None
    """Weights that were learned."""
    predicted_gain: float | None = None
    """Variance per path, random ÷ the method's, as held-out paths foretell it; where it was asked for."""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """By phase: `pilot`, `fit`, `render`; `warm_up` is outside of the time."""


Runner = Callable[[Any, int, Sequence[float], Progress], Sequence[Shot]]
"""Renders a case's scene with a seed; returns a shot for each of the increasing budgets at which there was an image.
Training is inside them."""


@dataclass(frozen=True)
class Method:
    """A way to render, as the charts name it."""

    name: str
    run: Runner
    options: Mapping[str, Any] = field(default_factory=dict)
    """What sets it apart, for the record and the configuration's hash."""
    budget: str = "pilot, training and selection inside"
    """What its time counts."""
    light: str = BOUNCES
    """What it renders: only scenes whose truth is that are its own."""


@dataclass(frozen=True)
class Case:
    """A scene, ready to be rendered, and its truth."""

    digest: str
    """Hash of what is rendered."""
    scene: Any
    truth: Callable[[], Reference]
    """Called once, before the first run that is not there yet."""
    warm_up: Callable[[], object] = lambda: None
    """Called before the first run: what happens only once is no method's cost."""


@dataclass(frozen=True)
class Scenery:
    """A scene to come: loaded when its turn has come, let go after it."""

    name: str
    open: Callable[[], Case]
    light: str = BOUNCES
    """What its truth holds."""


@dataclass
class Study:
    """The runs of a study.

    Args:
        folder: where results.csv and the images lie.
        sceneries: the scenes.
        methods: the methods.
        times: seconds, or samples per pixel, increasing; a run by seconds goes to the last.
        seeds: numbers of the seeds.
        settings: what all runs share, for the rows and the configuration's hash: `k`, `emitter_strategy`, `threads`,
            and whatever else decides a row, as `reference_time`.
        say: told what is being done.
        progress: as in `pssflow.render`.
        publish: called with the rows so far after each scene but the last, and on Ctrl-C.
    """

    folder: Path
    sceneries: Sequence[Scenery]
    methods: Sequence[Method]
    times: Sequence[float]
    seeds: Sequence[int]
    settings: Mapping[str, Any]
    say: Callable[[str], None] = lambda text: None
    progress: Progress = False
    publish: Callable[[Sequence[Row]], object] = lambda rows: None
    unit: str = "s"
    """Of the times: `s`, or `spp` for samples per pixel."""

    def __post_init__(self) -> None:
        make_folder(self.folder / "images")
        self.store = Store(self.folder / "results.csv", Row)
        self.failures: dict[str, str] = {}
        """Scenes, and methods on scenes, that could not be shown, and why."""
        self._digests: dict[str, str] = {}
        """Of the scenes that were opened."""

    @property
    def rows(self) -> list[Row]:
        """Rows of this very study; others in the file (other settings, an edited scene) are left alone."""
        scenes = {scenery.name for scenery in self.sceneries}
        methods = {method.name: method for method in self.methods}
        return [
            row
            for row in self.store.rows
            if row.scene in scenes
            and row.scene not in self.failures
            and row.method in methods
            and row.seed in self.seeds
            and row.scene_hash == self._digests.get(row.scene, row.scene_hash)
            and row.configuration
            == self._key(row.scene, row.scene_hash, methods[row.method], row.seed)
        ]

    def run(self) -> list[Row]:
        """Runs what is not there yet; on Ctrl-C what there is, is published.

        Raises:
            KeyboardInterrupt: on Ctrl-C; finished runs are kept.
        """
        runs = sum(len(self.methods_of(s)) for s in self.sceneries) * len(self.seeds)
        clock = _Clock(runs, self.times[-1] if self.unit == "s" else 0.0)
        try:
            for scenery in self.sceneries:
                try:
                    case = scenery.open()
                except FAILURES as error:
                    self._leave_out(scenery.name, error)
                    clock.skip(len(self.methods_of(scenery)) * len(self.seeds))
                    continue
                self._digests[scenery.name] = case.digest
                ran = self._scene(scenery, case, clock)
                if ran and scenery is not self.sceneries[-1]:
                    self.publish(self.rows)
        except KeyboardInterrupt:
            self.publish(self.rows)
            raise
        return self.rows

    def _leave_out(self, what: str, error: Exception) -> None:
        self.failures[what] = first_line(error)
        self.say(f"{what} is left out: {first_line(error)}")

    def _key(self, scene: str, digest: str, method: Method, seed: int) -> str:
        return configuration(
            scene=[scene, digest],
            method=method.name,
            options=method.options,
            times=list(self.times),
            unit=self.unit,
            seed=seed,
            settings=dict(self.settings),
        )

    def methods_of(self, scenery: Scenery) -> list[Method]:
        """Those that render what the scene's truth holds."""
        return [method for method in self.methods if method.light == scenery.light]

    def _scene(self, scenery: Scenery, case: Case, clock: _Clock) -> bool:
        """The runs of one scene; whether there were any."""
        name, methods = scenery.name, self.methods_of(scenery)
        wanted = []
        for turn, seed in enumerate(self.seeds):
            shift = turn % max(len(methods), 1)
            for method in [*methods[shift:], *methods[:shift]]:
                wanted.append((method, seed, self._key(name, case.digest, method, seed)))
        missing = [run for run in wanted if not self.store.has(run[2])]
        clock.skip(len(wanted) - len(missing))
        if not missing:
            return False
        self.say(f"{name}: Mitsuba's reference, unless it is cached")
        try:
            truth = case.truth()
            case.warm_up()
        except FAILURES as error:
            self._leave_out(name, error)
            clock.skip(len(missing))
            return False
        size = truth.image.shape[1], truth.image.shape[0]
        k = self.settings["k"]
        truth.write(reference_path(self.folder, name, case.digest, k, size, scenery.light))
        for method, seed, key in missing:
            failure = f"{method.name} on {name}"
            if failure in self.failures:
                clock.skip(1)
                continue
            self.say(f"{clock.place()} {name}, {method.name}, seed {seed}; {clock.left()}")
            before = os.getloadavg()[0]
            try:
                with clock.run():
                    shots = method.run(case.scene, seed, self.times, self.progress)
                common = self._common(name, case, method, seed, key)
                common |= {"load_before": before, "load_after": os.getloadavg()[0]}
                self._keep_images(name, method, seed, shots)
                found = {shot.time: measured(shot, truth, common) for shot in shots}
            except FAILURES as error:
                self._leave_out(failure, error)
                continue
            self.store.put(
                found.get(time) or nothing_yet(time, size, truth, common) for time in self.times
            )
        return True

    def _common(self, name: str, case: Case, method: Method, seed: int, key: str) -> dict[str, Any]:
        import mitsuba as mi

        return {
            "scene": name,
            "scene_hash": case.digest,
            "method": method.name,
            "budget": method.budget,
            "seed": seed,
            "unit": self.unit,
            "light": method.light,
            "longest": self.times[-1],
            "k": self.settings["k"],
            "emitter_strategy": self.settings["emitter_strategy"],
            "threads": self.settings["threads"],
            "options": json.dumps(dict(method.options), sort_keys=True),
            "configuration": key,
            "study": configuration(
                times=list(self.times), unit=self.unit, settings=dict(self.settings)
            ),
            "commit": commit(),
            "version": _core.__version__,
            "mitsuba": mi.__version__,
            "processor": processor(),
            "when": datetime.now(timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ"),
        }

    def _keep_images(self, name: str, method: Method, seed: int, shots: Sequence[Shot]) -> None:
        """Every seed's last image, and all images of the first seed."""
        kept = shots if seed == self.seeds[0] else shots[-1:]
        for shot in kept:
            layers = {"": shot.image}
            # What one sample a pixel says of its variance is infinite, which no reader likes.
            if shot.variance is not None and np.isfinite(shot.variance).all():
                layers["variance"] = shot.variance
            path = image_path(self.folder, name, method.name, seed, shot.time, self.unit)
            _core.write_exr(str(path), layers)

    def image_path(self, row: Row) -> Path:
        """Where a row's image lies; of seeds after the first only the last one is kept."""
        return image_path(self.folder, row.scene, row.method, row.seed, row.time, row.unit)

    def reference_path(self, row: Row) -> Path:
        """Where the truth that a row was measured against lies."""
        return truth_path(self.folder, row)

    def floors(self) -> dict[tuple[str, str], metrics.Estimate]:
        """See `floors`; of this study's rows."""
        return floors(self.folder, self.rows, len(self.seeds))


def floors(
    folder: Path, rows: Sequence[Row], seeds: int
) -> dict[tuple[str, str], metrics.Estimate]:
    """The squared bias that the last images of several seeds have in common, by scene and method.

    Only where all of so many seeds have their image of the longest budget.
    """
    found: dict[tuple[str, str], metrics.Estimate] = {}
    if seeds < 2:
        return found
    last = [row for row in rows if row.spp and row.time == row.longest]
    truths: dict[str, Reference] = {}
    for scene, method in dict.fromkeys((row.scene, row.method) for row in last):
        own = [row for row in last if (row.scene, row.method) == (scene, method)]
        paths = [image_path(folder, scene, method, row.seed, row.time, row.unit) for row in own]
        place = truth_path(folder, own[-1])
        if len(own) < seeds or not all(path.is_file() for path in (*paths, place)):
            continue
        if scene not in truths:
            truths = {scene: read_exr(place)}  # scene after scene: one is held at a time
        truth = truths[scene]
        images = [read_exr(path).image for path in paths]
        found[scene, method] = metrics.floor(
            images, truth.image, truth.variance, scale=metrics.local_scale(truth.image)
        )
    return found


def measured(shot: Shot, truth: Reference, common: Mapping[str, Any]) -> Row:
    """A shot's row.

    Raises:
        ValueError: the image and the truth differ in size.
    """
    height, width = shot.image.shape[:2]
    scale = metrics.local_scale(truth.image)
    own = None
    if shot.variance is not None and np.isfinite(shot.variance).all():
        own = metrics.finite_or_none(
            metrics.relative_variance(shot.variance, truth.image, scale=scale)
        )
    phases: dict[str, Any] = {f"seconds_{phase}": shot.seconds.get(phase) for phase in PHASES}
    against = (shot.image, truth.image, truth.variance)
    error = metrics.relmse_with_error(*against, scale=scale)
    return Row(
        **common,
        time=shot.time,
        elapsed=shot.elapsed,
        chosen=shot.chosen,
        width=width,
        height=height,
        spp=shot.spp,
        paths=shot.spp * width * height,
        **phases,
        nonzero_share=shot.nonzero_share,
        parameters=shot.parameters,
        predicted_gain=shot.predicted_gain,
        relmse=error.value,
        relmse_error=error.error,
        relmse_trimmed=metrics.relmse_trimmed(*against, scale=scale),
        relmse_pixel=metrics.relmse(*against),
        mape=metrics.mape(shot.image, truth.image, scale=scale),
        flip=flip(shot.image, truth.image),
        own_variance=own,
        reference_variance=metrics.relative_variance(truth.variance, truth.image, scale=scale),
        reference_seconds=truth.seconds,
    )


def nothing_yet(
    time: float, size: tuple[int, int], truth: Reference, common: Mapping[str, Any]
) -> Row:
    """The row of a time at which a method had no image yet: no samples, and no number for an error."""
    phases: dict[str, Any] = {f"seconds_{phase}": None for phase in PHASES}
    return Row(
        **common,
        time=time,
        elapsed=time,
        chosen="",
        width=size[0],
        height=size[1],
        spp=0,
        paths=0,
        **phases,
        nonzero_share=None,
        parameters=None,
        predicted_gain=None,
        relmse=math.nan,
        relmse_error=math.nan,
        relmse_trimmed=math.nan,
        relmse_pixel=math.nan,
        mape=math.nan,
        flip=None,
        own_variance=None,
        reference_variance=metrics.relative_variance(
            truth.variance, truth.image, scale=metrics.local_scale(truth.image)
        ),
        reference_seconds=truth.seconds,
    )


def image_path(
    folder: Path, scene: str, method: str, seed: int, budget: float, unit: str = "s"
) -> Path:
    """Where an image of a run lies."""
    name = f"{file_name(scene)}-{file_name(method)}-s{seed}-{budget:g}{unit}"
    return folder / "images" / f"{name}.exr"


def reference_path(
    folder: Path, scene: str, digest: str, k: int, size: tuple[int, int], light: str
) -> Path:
    """Where a scene's truth lies: another scene of that name, another film or other light has a file of its own."""
    text = json.dumps([digest, k, *size, light])
    short = hashlib.sha256(text.encode()).hexdigest()[:8]
    return folder / "images" / f"{file_name(scene)}-reference-{short}.exr"


def truth_path(folder: Path, row: Row) -> Path:
    """Where the truth that a row was measured against lies."""
    size = row.width, row.height
    return reference_path(folder, row.scene, row.scene_hash, row.k, size, row.light)


def file_name(name: str) -> str:
    """A name without what a file's may not have."""
    return "".join(c if c.isalnum() or c in "+._-" else "_" for c in name)


class _Clock:
    """Which run it is, and how long all will take."""

    def __init__(self, runs: int, each: float) -> None:
        self.runs, self.done, self.timed = runs, 0, 0
        self.seconds, self.each = 0.0, each

    def skip(self, runs: int) -> None:
        self.done += runs

    @contextmanager
    def run(self) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.done += 1
        self.timed += 1
        self.seconds += time.perf_counter() - start

    def place(self) -> str:
        return f"[{self.done + 1}/{self.runs}]"

    def left(self) -> str:
        """References to come are not in it: nobody knows which are cached."""
        each = self.seconds / self.timed if self.timed else self.each
        minutes = each * (self.runs - self.done) / 60
        return f"about {math.ceil(minutes)} min left"
