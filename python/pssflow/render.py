"""The whole estimator: a scene in, its k-bounce indirect light out. Start reading at `render`."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from . import _core, metrics
from .guide import Choice, ForeignGuide, Guide, choose, usual_guide
from .light import check_depth, check_roulette, render_light
from .options import Plan, read_replay
from .progress import Progress, reporting
from .scene import Pilot, Scene, SceneLike, Trace

if TYPE_CHECKING:
    from .reference import Reference

__all__ = ["Pilot", "Result", "Scene", "Trace", "render"]

F32 = NDArray[np.float32]

Replay = str | os.PathLike[str] | Mapping[str, Any] | Sequence[Mapping[str, Any]]
"""A run's statistics, the JSON file that holds them, or only its list `passes`."""


@dataclass(frozen=True)
class Result:
    """A rendered image and how it came about."""

    image: F32
    """k-bounce radiance of the crop, (H, W, 3), W·sr⁻¹·m⁻², linear sRGB."""
    variance: F32
    """Variance of each mean, (H, W, 3), estimated from the same samples."""
    found: NDArray[np.uint32]
    """Paths through each pixel whose vertices x₁ … x_k all exist, (H, W)."""
    nonzero: NDArray[np.uint32]
    """Paths through each pixel that carry light, (H, W)."""
    stats: dict[str, Any]
    """The run as one JSON object, what the command's `--json` prints: counts, weights, passes, seconds."""
    timings: dict[str, float]
    """Seconds: `load`, `export`, `bvh`, `pilot`, `fit`, `render`."""
    guide: Guide | ForeignGuide | None
    """The guide that drew the paths; None for random numbers."""
    parts: tuple[Result, ...] = ()
    """With `max_depth`, the light of each path length by itself: k = 0 (emission), 1 (direct light), 2, …"""
    layers: dict[str, F32] = field(default_factory=dict)
    """What `write` adds to image and variance, (H, W, 3) each: with `max_depth` the light of each length as `k0`, `k1`,
    …, and the share of paths that carry light as `nonzero_share`."""
    snapshots: tuple[Result, ...] = ()
    """What there was after each of the times `snapshots`, in the same form: each `stats` can be replayed."""

    @property
    def notes(self) -> list[str]:
        """What is worth knowing, a line each: why the image is black, why the guide was not used."""
        return self.stats["notes"]

    def measure(self, reference: Reference) -> None:
        """Writes `relmse` and `relmse_trimmed` against a reference into `stats`.

        Raises:
            ValueError: the images differ in size.
        """
        args = (self.image, reference.image, reference.variance)
        self.stats["relmse"] = metrics.finite_or_none(metrics.relmse(*args))
        self.stats["relmse_trimmed"] = metrics.finite_or_none(metrics.relmse_trimmed(*args))

    def write(self, path: str | Path) -> None:
        """Writes an EXR: the image as R, G, B, the variance as layer `variance`, and `layers`.

        Raises:
            OSError: it cannot be written; nothing is left behind.
        """
        _core.write_exr(str(path), {"": self.image, "variance": self.variance, **self.layers})


def render(
    scene: SceneLike,
    guide: str | os.PathLike[str] | Guide | ForeignGuide | None = None,
    spp: int | None = None,
    time: float | None = None,
    k: int | None = None,
    parametrisation: str = "bsdf",
    uniform_fraction: float | None = None,
    seed: int = 0,
    threads: int | None = None,
    progress: Progress = True,
    *,
    emitter_strategy: str | None = None,
    sensor: Any = 0,
    hide_emitters: bool | None = None,
    approximate: bool = False,
    preset: str | None = None,
    pilot_spp: int | None = None,
    keep_pilot: bool | None = None,
    combine: str | None = None,
    replay: Replay | None = None,
    snapshots: Sequence[float] = (),
    max_depth: int | None = None,
    rr_depth: int | None = None,
    **guide_options: Any,
) -> Result:
    """Renders the light that reaches the eye after exactly k reflections: pilot → fit → render.

    With `max_depth` it renders all light up to there instead: what Mitsuba's `path` shows at the same `max_depth`.

    Args:
        scene: a path to a scene's XML file, a dictionary as for `mi.load_dict`, an `mi.Scene` in its current state,
            or a `Scene`, which may be rendered many times. Where no Mitsuba variant is set, loading sets one.
        guide: `auto` (the default) for the smallest model that pays, or none; `none` for random numbers, a name of
            `pssflow.guide.registry()` (several joined by `+`) or `table` for all tables, a fitted `Guide` or the path
            of a saved one (no pilot is spent), or any object with fit, sample and log_prob.
        spp: samples per pixel in all, pilot inside. Default: 16, or the preset's.
        time: seconds in place of `spp`, for pilot, fit and rendering together; loading and the BVH come before. The
            image then depends on the machine's speed; `replay` repeats it.
        k: bounces, 1 … 32. Default: 2.
        parametrisation: what a direction's numbers mean: `bsdf`, `cosine` or `uniform` (hemisphere).
        uniform_fraction: share a of uniform paths in the mixture, in [0, 1]; no path's weight exceeds 1/a. Default:
            the guide's, 0.1 for tables and 0.25 for flows, or what `auto` finds best. At 0 the image may be biased.
        seed: of all random numbers; one seed gives one image, bit for bit, on any number of threads.
        threads: None for all cores.
        progress: True for bars on stderr if that is a terminal, "always", False, or a function (phase, share done).
        emitter_strategy: `mis` (default), `nee` (emitter samples alone, as the thesis), or `auto`.
        sensor: index of the sensor, or a sensor object.
        hide_emitters: as in `Scene`, which decides it where one is given. None: what the scene's integrator says.
        approximate: as in `Scene`, which decides it where one is given: replace what is not supported, with a note.
        preset: `thesis`: NEE alone, a pilot of 16 spp that is discarded, a = 0, then 16 spp from the guide; with
            another `spp`, half for the pilot. What is given beside it wins.
        pilot_spp: samples per pixel of the pilot. Default: for a guide that later passes refine a thirty-second of
            `spp`, or a fortieth to a tenth of `time`, until 65,536 paths carry light; for one that is trained once a
            quarter or a seventh.
        keep_pilot: whether the pilot's paths enter the image. Default: yes.
        combine: how passes become one image: `samples` (default; every sample the same, but one of the pilot half) or
            `variance` (each pass by its variance, estimated crosswise from halves of the image: less noise, a bias of
            the order of 1 ÷ spp).
        replay: the record of an earlier run (`Result.stats` or the command's JSON file), whose guide, settings, seed
            and passes are repeated, or only its `passes`.
        snapshots: shorter times, increasing, at which the image so far is handed out (`Result.snapshots`): the last one
            that was complete by then, or the first one there was. Passes are cut so that one ends shortly before;
            `stats["elapsed"]` tells the seconds really used. What handing out takes is not charged to `time`.
        max_depth: longest path in place of `k`, as Mitsuba counts: 1 for emission alone, 2 with direct light, 3 with
            light of two bounces, …, 33. Each length has its own guide and its own share of the budget: `spp` is what
            each would get if all got the same. Fitted guides, presets and snapshots are for one k and are refused. An
            object of your own is fitted anew for each length, k = 1 first, and knows the last one afterwards.
            `stats["lengths"]` holds a record for each; in that of the whole `k`, `ess`, `diagnostics`, `candidates` and
            `training` are None, `passes` is empty, and `pilot` is missing.
        rr_depth: with `max_depth`, bounces from which on long paths are left to chance, 1 … 33: their samples halve
            with each bounce, and may be less than one to a pixel. None: all lengths have one or more.
        **guide_options: the guide's own, as `epochs=7`; in a composite also `**{"realnvp.epochs": 7}`.

    Returns:
        The image, its variance, statistics, timings, and the guide, which can be saved or used again.

    Raises:
        UnsupportedError: the scene holds what cannot be rendered (a `ValueError`).
        ValueError: an argument is wrong; one line that names it.
        TypeError: `scene` or `guide` is of the wrong kind.
        FileNotFoundError: there is no such file.
        KeyboardInterrupt: on Ctrl-C, within a second.

    Examples:
        >>> result = pssflow.render(
        ...     "scenes/cornell-box/scene.xml", "realnvp", spp=64, k=2
        ... )  # doctest: +SKIP
        >>> result.write("cornell-box.exr")  # doctest: +SKIP
    """
    if max_depth is not None and k is not None:
        raise ValueError(f"`k` = {k} and `max_depth` = {max_depth} were both given; give one")
    settings: dict[str, Any] = {
        "k": 2 if k is None else k,
        "parametrisation": parametrisation,
        "emitter_strategy": emitter_strategy,
        "uniform_fraction": uniform_fraction,
        "keep_pilot": keep_pilot,
        "combine": combine,
        "seed": seed,
    }
    records: list[dict[str, Any]] | None = None
    if replay is not None:
        if time is not None or spp is not None:
            raise ValueError("`replay` repeats recorded passes; leave out `spp` and `time`")
        if isinstance(replay, (str, os.PathLike, Mapping)):
            replay = read_replay(replay)
            _check_replayed(replay, k, max_depth)
            if rr_depth is not None:
                raise ValueError("`rr_depth` was given, but `replay` repeats recorded passes")
            if "lengths" in replay:
                rr_depth = replay.get("rr_depth")
                guide, guide_options, replay, max_depth, records = _replayed_light(
                    replay, guide, settings
                )
        elif max_depth is not None:
            raise ValueError("`max_depth` was given, but `replay` holds the passes of one k")
        if isinstance(replay, Mapping):
            guide, guide_options, replay = _replayed(replay, guide, settings)
    choice = choose(usual_guide(preset) if guide is None else guide, guide_options)
    plan = Plan.make(
        learns=choice.learns,
        may_end_in_none=choice.kind == "auto",
        spp=spp,
        time=time,
        pilot_spp=pilot_spp,
        threads=threads,
        preset=preset,
        replay=replay,
        snapshots=snapshots,
        **settings,
    )
    if not isinstance(scene, Scene):
        scene = Scene(scene, sensor, hide_emitters=hide_emitters, approximate=approximate)
    elif sensor != 0 and sensor is not scene.sensor and sensor != scene.sensor:
        raise ValueError(
            "`sensor` was given beside a `Scene`, which has its own; make another `Scene`"
        )
    elif approximate or hide_emitters is not None:
        name = "approximate" if approximate else "hide_emitters"
        raise ValueError(
            f"`{name}` was given beside a `Scene`, which has its own; make another `Scene`"
        )
    roulette = check_roulette(rr_depth, max_depth)
    if max_depth is not None:
        depth = check_depth(max_depth, choice, plan, preset)
        return render_light(scene, choice, plan, depth, progress, records, roulette)
    return run(scene, choice, plan, progress)


def run(scene: Scene, choice: Choice, plan: Plan, progress: Progress = True) -> Result:
    """Renders with arguments that were checked already; see `render`."""
    strategy, why = scene.resolve_strategy(
        plan.emitter_strategy, plan.k, plan.parametrisation, plan.threads or None
    )
    # Emission (k = 0) has no columns, and no guide that could be saved.
    columns = scene.core.columns_hash(plan.k, plan.parametrisation) if plan.k else ""
    hashes = (columns, scene.hash)
    given = choice.given
    if choice.path is not None:
        given = Guide.load(choice.path, columns_hash=hashes[0], scene_hash=hashes[1])
    with reporting(progress) as listener:
        output = scene.core.render(
            plan.core(choice.kind, choice.options, strategy),
            given.core if isinstance(given, Guide) else given,
            listener,
        )
    notes = [*scene.notes, *([f"emitter_strategy auto: {strategy}, {why}"] if why else [])]

    def result(output: Mapping[str, Any], snapshots: tuple[Result, ...] = ()) -> Result:
        record: dict[str, Any] = json.loads(output["record"])
        fitted = output["guide"]
        used: Guide | ForeignGuide | None = None
        if record["chosen"] != "none":
            used = given
            if used is None and fitted is not None:
                used = Guide(fitted, columns_hash=hashes[0], scene_hash=hashes[1])
        timings = {**scene.timings, **record["seconds"]}
        stats = {
            "scene": scene.name,
            "guide": choice.label,
            **record,
            "relmse": None,
            "relmse_trimmed": None,
            "notes": notes + record["notes"],
            "seconds": {**timings, "total": sum(timings.values())},
            "budget": plan.budget(learns=choice.learns, snapshot=output.get("time")),
            "guide_options": choice.options,
            "keep_pilot": plan.keep_pilot,
            "version": _core.__version__,
            "variant": scene.variant,
        }
        images = {key: output[key] for key in ("image", "variance", "found", "nonzero")}
        return Result(**images, stats=stats, timings=timings, guide=used, snapshots=snapshots)

    return result(output, tuple(result(part) for part in output["snapshots"]))


def _check_replayed(record: Mapping[str, Any], k: int | None, max_depth: int | None) -> None:
    """Refuses another length than a record has: its passes are of that one."""
    if "lengths" not in record:
        if max_depth is not None:
            raise ValueError(
                f"`max_depth` = {max_depth} was given, but `replay` holds a render of k = {record['k']}"
            )
        if k not in (None, record["k"]):
            raise ValueError(
                f"`k` = {k} was given, but `replay` holds a render of k = {record['k']}"
            )
        return
    held = f"but `replay` holds all light to `max_depth` = {record['max_depth']}"
    if k is not None:
        raise ValueError(f"`k` = {k} was given, {held}")
    if max_depth not in (None, record["max_depth"]):
        raise ValueError(f"`max_depth` = {max_depth} was given, {held}")


def _replayed(
    record: Mapping[str, Any], guide: Any, settings: dict[str, Any]
) -> tuple[Any, dict[str, Any], list[dict[str, Any]]]:
    """Guide, its options and passes of a record; its settings are written over `settings`.

    A record knows a foreign object's class only, so that object must be given again.
    """
    names = (
        "k",
        "parametrisation",
        "emitter_strategy",
        "keep_pilot",
        "combine",
        "seed",
        "survival",
    )
    settings.update({name: record[name] for name in names}, uniform_fraction=record["a"])
    if guide is None or isinstance(guide, (str, os.PathLike)):
        guide = record["guide"]
    return guide, dict(record["guide_options"]), list(record["passes"])


def _replayed_light(
    record: Mapping[str, Any], guide: Any, settings: dict[str, Any]
) -> tuple[Any, dict[str, Any], None, int, list[dict[str, Any]]]:
    """Guide, its options, depth and lengths of a record of a whole light; see `_replayed`."""
    names = ("parametrisation", "emitter_strategy", "keep_pilot", "combine", "seed")
    settings.update({name: record[name] for name in names})
    if guide is None or isinstance(guide, (str, os.PathLike)):
        guide = record["guide"]
    lengths = [dict(length) for length in record["lengths"]]
    return guide, dict(record["guide_options"]), None, record["max_depth"], lengths
