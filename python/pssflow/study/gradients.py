"""`pssflow study gradients`: the variance of gradients against uniform numbers at equal time.

Each run renders an image and differentiates its mean by all parameters of the scene that can be differentiated; the
image, training and, with the target `gradient`, its pilot are inside the time. Where light has a depth instead of one
length, Mitsuba's `prb` stands beside. Methods take turns, seed by seed.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np
from numpy.typing import NDArray

from ..params import Positive
from ..terminal import Terminal
from .summary import BASELINE

if TYPE_CHECKING:
    from .harness import Case, Scenery

__all__ = ["METHODS", "GradientRow", "Measuring", "gradients", "parameters"]

METHODS: Mapping[str, Mapping[str, Any]] = {
    BASELINE: {"type": "pssflow", "guide": "none"},
    "table": {"type": "pssflow", "guide": "table"},
    "auto": {"type": "pssflow", "guide": "auto"},
    "auto, gradient": {"type": "pssflow", "guide": "auto", "target": "gradient"},
    "prb": {"type": "prb", "rr_depth": 100},
}
"""Integrators by the names that tables have."""

VARIANT = "llvm_ad_rgb"

SCENES = ("scenes/cornell-box", "scenes/door-ajar", "scenes/glossy", "scenes/many-lights")

MOST_COMPONENTS = 3
"""Of a parameter with more (a texture) only the sum of them is looked at."""

CALIBRATION_SPP = 4
"""Samples per pixel of the runs that tell how many there is time for: the first one compiles."""


@dataclass(frozen=True)
class GradientRow:
    """The gradient by one parameter that one run found."""

    scene: str
    scene_hash: str
    method: str
    seed: int
    parameter: str
    gradient: str
    """Of the image's mean, by each component, JSON."""
    time: float
    """Budget, seconds."""
    elapsed: float
    """Seconds really used."""
    spp: int
    """Samples per pixel, of the image and of its derivative each."""
    light: str
    width: int
    height: int
    load_before: float
    """Load average of one minute; it holds the run itself as well."""
    load_after: float
    configuration: str
    """Hash of all that decides the row, but for the machine."""
    commit: str
    version: str
    mitsuba: str
    processor: str
    when: str

    @property
    def run(self) -> tuple[str, str, int]:
        """Scene, method, seed."""
        return self.scene, self.method, self.seed

    @property
    def values(self) -> NDArray[np.float64]:
        """The components."""
        return np.array(json.loads(self.gradient), np.float64)


@click.command("gradients")
@click.argument("scenes", nargs=-1, metavar="[SCENES]...")
@click.option(
    "--time",
    "seconds",
    type=Positive("number of seconds"),
    default=5.0,
    show_default=True,
    help="Of a run: image, training and derivative.",
)
@click.option("--seeds", type=click.IntRange(2, 1000), default=12, show_default=True)
@click.option(
    "--pixels", type=click.IntRange(64), default=10_000, show_default=True, help="Of a film, about."
)
@click.option(
    "--k", type=click.IntRange(1, 32), help="Light of so many bounces alone.  [default: 2]"
)
@click.option("--max-depth", type=click.IntRange(2, 33), help="All light up to there, with prb.")
@click.option("-o", "--output", default="out/study-gradients", show_default=True, metavar="DIR")
@click.option("-q", "--quiet", is_flag=True, help="No progress, no notices.")
@click.pass_obj
def gradients(
    terminal: Terminal,
    scenes: tuple[str, ...],
    seconds: float,
    seeds: int,
    pixels: int,
    k: int | None,
    max_depth: int | None,
    output: str,
    quiet: bool,
) -> None:
    """Variance of gradients against uniform numbers at equal time; training and the image inside.

    Each parameter of a scene that can be differentiated has a line of its own, and their geometric mean another.
    SCENES are XML files or names (`scenes/door-ajar`); the default are four. Writes results.csv, summary.md, a chart
    and report.html to DIR; run again, it goes on where it stopped.
    """
    from ..output import make_folder
    from ..variants import llvm_problem
    from .gradients_report import publish
    from .sceneries import named_scenes, scenery

    terminal.quiet = quiet
    if k is not None and max_depth is not None:
        raise ValueError("`--k` and `--max-depth` were both given; give one")
    problem = llvm_problem()
    if problem is not None:
        raise ValueError(f"gradients: {problem}")
    light = {"k": k or 2} if max_depth is None else {"max_depth": max_depth}
    study = Measuring(
        folder=make_folder(output),
        sceneries=[
            # Its truth is never asked for.
            scenery(plan, pixels, 2, 1.0, not quiet, terminal.note)
            for plan in named_scenes(scenes or SCENES)
        ],
        methods=[name for name in METHODS if name != "prb" or max_depth is not None],
        light=light,
        seconds=seconds,
        seeds=range(seeds),
        say=terminal.say,
    )
    rows = study.run()
    if not rows:
        told = "; ".join(f"{what}: {why}" for what, why in study.failures.items())
        raise RuntimeError(f"there is nothing to show: {told}")
    for part in publish(study, rows):
        terminal.out.print(part, highlight=False, soft_wrap=isinstance(part, str))


@dataclass
class Measuring:
    """The runs of the study, resumed where they stopped."""

    folder: Path
    sceneries: Sequence[Scenery]
    methods: Sequence[str]
    light: Mapping[str, int]
    """`k` or `max_depth`."""
    seconds: float
    seeds: Sequence[int]
    say: Callable[[str], None] = lambda text: None
    failures: dict[str, str] = field(default_factory=dict)
    """Scenes, and methods on scenes, that could not be measured, and why."""

    def run(self) -> list[GradientRow]:
        """Runs what is not there yet, and returns all rows of this study.

        Raises:
            OSError: results.csv cannot be written.
            ValueError: it is none of ours.
        """
        from ..files import first_line
        from .harness import FAILURES
        from .store import Store

        store = Store(self.folder / "results.csv", GradientRow)
        known: set[str] = set()
        for scenery in self.sceneries:
            try:
                case = scenery.open()
                scene = case.scene.in_variant(VARIANT)
                names = parameters(scene)
                wanted = [
                    (method, seed, self._key(scenery.name, case.digest, method, seed, names))
                    for method, seed in self._turns()
                ]
                known |= {key for *_, key in wanted}
                counts: dict[str, int] = {}
                for method, seed, key in wanted:
                    what = f"{method} on {scenery.name}"
                    if store.has(key) or what in self.failures:
                        continue
                    try:
                        if method not in counts:
                            counts[method] = self._affordable(scene, method, names)
                        spp = counts[method]
                        self.say(f"{what}, seed {seed}: {spp} spp")
                        store.put(self._measured(scenery.name, case, method, seed, names, key, spp))
                    except FAILURES as error:
                        self.failures[what] = first_line(error)
                        self.say(f"{what} is left out: {first_line(error)}")
            except FAILURES as error:
                self.failures[scenery.name] = first_line(error)
                self.say(f"{scenery.name} is left out: {first_line(error)}")
        return [row for row in store.rows if row.configuration in known]

    def _turns(self) -> Iterator[tuple[str, int]]:
        """Methods take turns, each time in another order, so that whatever else the machine does hits all alike."""
        for turn, seed in enumerate(self.seeds):
            shift = turn % len(self.methods)
            for method in (*self.methods[shift:], *self.methods[:shift]):
                yield method, seed

    def _key(self, scene: str, digest: str, method: str, seed: int, names: Sequence[str]) -> str:
        from .store import configuration

        return configuration(
            scene=[scene, digest],
            method=[method, METHODS[method]],
            light=dict(self.light),
            seconds=self.seconds,
            seed=seed,
            parameters=list(names),
        )

    def _affordable(self, scene: Any, method: str, names: Sequence[str]) -> int:
        """Samples per pixel that there is time for."""
        spp = CALIBRATION_SPP
        self._gradient(scene, method, names, -1, spp)
        while True:
            _, elapsed = self._gradient(scene, method, names, -1, spp)
            factor = self.seconds / elapsed
            # What is constant in a run makes short ones look slow.
            if factor < 2.0:
                return max(round(spp * factor), 2)
            spp = math.ceil(spp * min(factor, 8.0) / 1.5)

    def _gradient(
        self, scene: Any, method: str, names: Sequence[str], seed: int, spp: int
    ) -> tuple[list[NDArray[np.float64]], float]:
        """Gradients of the image's mean by each parameter, and the seconds that took."""
        import drjit as dr
        import mitsuba as mi

        params = mi.traverse(scene)
        start = time.perf_counter()
        integrator: Any = mi.load_dict({**METHODS[method], **self.light})
        for name in names:
            dr.enable_grad(params[name])
            dr.set_grad(params[name], 0)
        try:
            image = mi.render(
                scene,
                params,
                integrator=integrator,
                seed=mi.UInt32(2 * seed + 2),
                seed_grad=2 * seed + 3,
                spp=spp,
                spp_grad=spp,
            )
            dr.backward(dr.mean(image[..., :3], axis=None))
            found = [np.array(dr.grad(params[name]), np.float64).ravel() for name in names]
        finally:
            for name in names:
                dr.disable_grad(params[name])
        elapsed = time.perf_counter() - start
        return [v if len(v) <= MOST_COMPONENTS else v.sum(keepdims=True) for v in found], elapsed

    def _measured(
        self,
        name: str,
        case: Case,
        method: str,
        seed: int,
        names: Sequence[str],
        key: str,
        spp: int,
    ) -> list[GradientRow]:
        """The rows of one run."""
        import mitsuba as mi

        from .. import _core
        from .store import commit, processor

        scene = case.scene.in_variant(VARIANT)
        before = os.getloadavg()[0]
        found, elapsed = self._gradient(scene, method, names, seed, spp)
        width, height = (int(n) for n in scene.sensors()[0].film().crop_size())
        return [
            GradientRow(
                scene=name,
                scene_hash=case.digest,
                method=method,
                seed=seed,
                parameter=parameter,
                gradient=json.dumps(values.tolist()),
                time=self.seconds,
                elapsed=elapsed,
                spp=spp,
                light=json.dumps(dict(self.light)),
                width=width,
                height=height,
                load_before=before,
                load_after=os.getloadavg()[0],
                configuration=key,
                commit=commit(),
                version=_core.__version__,
                mitsuba=str(mi.__version__),
                processor=processor(),
                when=datetime.now(timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ"),
            )
            for parameter, values in zip(names, found, strict=True)
        ]


def parameters(scene: Any) -> list[str]:
    """Names of the parameters of a scene that `pssflow` differentiates: colours, textures, roughness, emitters."""
    import drjit as dr
    import mitsuba as mi

    from ..gradients import check_parameters

    params = mi.traverse(scene)
    found = []
    for name in params.keys():  # noqa: SIM118
        value = params[name]
        if not (dr.is_diff_v(value) and dr.is_float_v(value)):
            continue
        dr.enable_grad(value)
        try:
            check_parameters(scene, {name: value})
        except ValueError:
            continue
        finally:
            dr.disable_grad(value)
        found.append(name)
    if not found:
        raise ValueError("the scene has no parameter that can be differentiated")
    return found
