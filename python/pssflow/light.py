"""The whole light up to a depth: emission, direct light and k = 2, 3, … bounces, rendered apart and added.

Each length has a guide of its own and its own samples: of a budget it gets what a probe of uniform paths says lowers
the error most (`rust/pssflow/src/lengths.rs`). The shares are fixed before sampling and no path of the probe is in the
image, so the sum is as unbiased as its parts. Each part is a render that can be replayed; so can the sum.

With `rr_depth` long paths, from that many bounces on, may get less than one sample a pixel: of four samples each is
traced with probability s and then counts 1 ÷ s, which is Russian roulette before the first ray.
"""

from __future__ import annotations

import json
import math
import time as clock
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from . import _core, metrics
from .guide import Choice, choose
from .options import MAX_BOUNCES, Plan, check_integer
from .progress import Listener, Progress, reporting
from .rows import LUMINANCE

if TYPE_CHECKING:
    from .render import Result
    from .scene import Scene

__all__ = ["check_depth", "check_roulette", "render_light", "share_layer"]

ODD = 0x9E3779B97F4A7C15
"""Distance of the seeds of two lengths: their paths must not repeat each other's numbers, or errors would add up."""


LEAST_CHANCES = 4
"""Samples per pixel that share what is left to chance, at least: of a single one no variance is known."""

CHANCES = 1 << 24
"""Numbers that the core decides with, equally likely: a chance is so many of them, at least one."""


def check_depth(max_depth: Any, choice: Choice, plan: Plan, preset: str | None) -> int:
    """`max_depth` as it is, if it can be rendered with these arguments.

    Raises:
        ValueError: one line.
    """
    if max_depth == -1:
        raise ValueError(
            "`max_depth` = -1: paths of any length are not supported; "
            f"give the longest one, at most {MAX_BOUNCES + 1}"
        )
    depth = check_integer("max_depth", max_depth, 1, MAX_BOUNCES + 1)
    if preset is not None:
        raise ValueError(f"`preset` = {preset!r} renders light of one k; leave out `max_depth`")
    if plan.snapshots:
        raise ValueError("`snapshots` are not supported with `max_depth`")
    if choice.kind == "ready":
        raise ValueError(
            "a fitted guide is for paths of one length; leave out `max_depth`, or give the guide's name"
        )
    return depth


def check_roulette(rr_depth: Any, max_depth: int | None) -> int | None:
    """`rr_depth` as it is, if it can be used with this `max_depth`.

    Raises:
        ValueError: one line.
    """
    if rr_depth is None:
        return None
    if max_depth is None:
        raise ValueError(
            f"`rr_depth` = {rr_depth!r}: Russian roulette is for the whole light; give `max_depth`, or leave it out"
        )
    return check_integer("rr_depth", rr_depth, 1, MAX_BOUNCES + 1)


@dataclass(frozen=True)
class _Part:
    """A length to render."""

    k: int
    strategy: str
    probe: Mapping[str, Any]
    """What the core says of it; its `spp` is a fraction."""

    @property
    def cost(self) -> float:
        """Rays a pixel."""
        return self.probe["spp"] * self.probe["rays"]


def render_light(
    scene: Scene,
    choice: Choice,
    plan: Plan,
    max_depth: int,
    progress: Progress = True,
    records: Sequence[Mapping[str, Any]] | None = None,
    rr_depth: int | None = None,
) -> Result:
    """Renders light of up to `max_depth` − 1 bounces with arguments that were checked already; see `render`.

    Args:
        scene: the scene.
        choice: the guide of each length but emission.
        plan: the budget, and what all lengths share.
        max_depth: as in Mitsuba: 1 for emission alone, 2 with direct light.
        progress: as in `render`.
        records: the lengths of an earlier run, whose passes are repeated; the budget is not looked at then.
        rr_depth: bounces from which on paths may be left to chance; None for no roulette.
    """
    with reporting(progress) as listener:
        start = clock.perf_counter()
        if records is None:
            parts, probed = _probe(scene, plan, max_depth, rr_depth), clock.perf_counter() - start
            results = _by_budget(scene, choice, plan, parts, rr_depth, start, listener)
            probes: list[Mapping[str, Any] | None] = [part.probe for part in parts]
        else:
            results, probed = _by_records(scene, choice, plan, records, listener), 0.0
            probes = [record.get("probe") for record in records]
        elapsed = clock.perf_counter() - start
    depths = {"max_depth": max_depth, "rr_depth": rr_depth}
    return _sum(scene, choice, plan, depths, results, probes, (probed, elapsed))


def _probe(scene: Scene, plan: Plan, max_depth: int, rr_depth: int | None) -> list[_Part]:
    # What is hidden from the camera has nothing to render at k = 0.
    first = 1 if scene.hide_emitters and max_depth > 1 else 0
    last = max_depth if rr_depth is None else _core.last_probed(rr_depth)
    lengths = []
    strategy = "nee"
    for k in range(first, max_depth):
        # Far behind `rr_depth` little is spent and the last strategy kept: finding one would not pay.
        if 0 < k <= last:
            strategy, _ = scene.resolve_strategy(
                plan.emitter_strategy, k, plan.parametrisation, plan.threads or None
            )
        lengths.append((k, strategy))
    probes = json.loads(
        scene.core.lengths(
            lengths,
            spp=float(plan.spp or 1),
            parametrisation=plan.parametrisation,
            rr_depth=rr_depth,
            threads=plan.threads,
        )
    )
    return [_Part(k, strategy, probe) for (k, strategy), probe in zip(lengths, probes, strict=True)]


def _by_budget(
    scene: Scene,
    choice: Choice,
    plan: Plan,
    parts: Sequence[_Part],
    rr_depth: int | None,
    start: float,
    listener: Listener | None,
) -> list[Result]:
    from .render import run

    results: list[Result] = []
    total = sum(part.cost for part in parts)
    done = 0.0
    for part in parts:
        own = replace(
            plan, k=max(part.k, 0), emitter_strategy=part.strategy, seed=_seed(plan, part.k)
        )
        chance = rr_depth is not None and part.k >= rr_depth
        if plan.time is None:
            wanted = part.probe["spp"]
            own = replace(own, spp=max(round(wanted), 1))
            own = _left_to_chance(own, wanted) if chance else own
        else:
            # What a part leaves or takes too much is shared by those after it.
            left = max(plan.time - (clock.perf_counter() - start), 1e-3)
            share = max(left * part.cost / max(total - done, 1e-9), 1e-3)
            own = replace(own, time=share)
            if chance and results:
                rays = part.probe["rays"] * scene.width * scene.height
                own = _left_to_chance(own, share * _speed(parts, results) / rays)
        guide = choice
        if part.k == 0 or _too_few(choice, own):
            guide = choose("none", {})
        elif own.pilot_spp is not None and own.spp is not None:
            own = replace(own, pilot_spp=min(own.pilot_spp, max(own.spp - 1, 1)))
        span = (done / total, (done + part.cost) / total)
        results.append(run(scene, guide, own, _within(listener, span)))
        done += part.cost
    return results


def _by_records(
    scene: Scene,
    choice: Choice,
    plan: Plan,
    records: Sequence[Mapping[str, Any]],
    listener: Listener | None,
) -> list[Result]:
    from .render import run

    results = []
    for i, record in enumerate(records):
        own = replace(
            plan,
            k=record["k"],
            emitter_strategy=record["emitter_strategy"],
            seed=record["seed"],
            survival=record["survival"],
            uniform_fraction=record["a"],
            replay=[dict(entry) for entry in record["passes"]],
            spp=None,
            time=None,
        )
        guide = choice if record["guide"] != "none" else choose("none", {})
        span = (i / len(records), (i + 1) / len(records))
        results.append(run(scene, guide, own, _within(listener, span)))
    return results


def _left_to_chance(plan: Plan, wanted: float) -> Plan:
    """With few samples per pixel wanted, more of them, each with so small a chance that they cost as much.

    Which pixels have one varies, and so costs a little of what it saves: from two on, numbers are rounded.
    """
    if wanted >= 0.5 * LEAST_CHANCES:
        return plan
    spp = None if plan.spp is None else LEAST_CHANCES
    # Rounded up, so that a path counts 1 ÷ the very share of the core's numbers that lets it live.
    chances = max(math.ceil(wanted / LEAST_CHANCES * CHANCES), 1)
    return replace(plan, spp=spp, survival=chances / CHANCES)


def _speed(parts: Sequence[_Part], results: Sequence[Result]) -> float:
    """Rays a second of what was rendered so far, pilots inside: where there is little time there is nothing else."""
    done = [(part, result.stats) for part, result in zip(parts, results, strict=False)]
    rays = sum(
        (stats["camera_rays"] + stats["pilot"]["camera_rays"]) * part.probe["rays"]
        for part, stats in done
    )
    seconds = sum(stats["seconds"]["pilot"] + stats["seconds"]["render"] for _, stats in done)
    return rays / max(seconds, 1e-9)


def _too_few(choice: Choice, plan: Plan) -> bool:
    """Whether a length's samples leave none for a guide after its pilot.

    `auto` copes with that itself, unless its pilot is thrown away.
    """
    copes = choice.kind == "auto" and plan.keep_pilot
    return choice.learns and not copes and plan.spp is not None and plan.spp < 2


def _seed(plan: Plan, k: int) -> int:
    return (plan.seed + k * ODD) % 2**64


def _within(listener: Listener | None, span: tuple[float, float]) -> Listener | bool:
    """One bar for all lengths; those of the parts would come and go."""
    if listener is None:
        return False

    def report(phase: str, share: float) -> None:
        # Pilot and training are short beside the passes, between which some guides are trained again.
        if phase == "render":
            listener("render", span[0] + (span[1] - span[0]) * share)

    return report


def share_layer(result: Result) -> Any:
    """Share of the paths found through each pixel that carried light, (H, W, 3), grey."""
    share = result.nonzero / np.maximum(result.found, 1)
    return np.repeat(share.astype(np.float32)[..., None], 3, axis=2)


def _sum(
    scene: Scene,
    choice: Choice,
    plan: Plan,
    depths: Mapping[str, int | None],
    parts: Sequence[Result],
    probes: Sequence[Mapping[str, Any] | None],
    seconds: tuple[float, float],
) -> Result:
    from .render import Result

    def total(name: str) -> Any:
        values = [getattr(part, name) for part in parts]
        return np.sum(values, axis=0, dtype=values[0].dtype)

    image, variance = total("image"), total("variance")
    found, nonzero = total("found"), total("nonzero")
    stats = [part.stats for part in parts]
    timings = dict(scene.timings)
    for name in ("pilot", "fit", "render"):
        timings[name] = sum(record["seconds"][name] for record in stats)
    timings["probe"] = seconds[0]
    mean = image.mean(axis=(0, 1), dtype=np.float64)
    lengths = []
    for record, probe in zip(stats, probes, strict=True):
        told = {"spp": sum(entry["spp"] for entry in record["passes"])}
        lengths.append(record | told | {"probe": None if probe is None else dict(probe)})
    counts = {name: sum(record[name] for record in stats) for name in COUNTS}
    guided = [record for record in stats if record["chosen"] != "none"]
    heaviest = [
        record["max_contribution"] * _luminance(record["mean"]) / record["survival"]
        for record in stats
    ]
    brightness = _luminance(mean)
    # One sample of a length has no variance.
    known = image.any() and np.isfinite(variance).all()
    relative = metrics.relative_variance(variance, image) if known else None
    notes = list(dict.fromkeys(note for r in stats for note in _notes(r)))
    if not image.any():
        notes.append("the image is black: no path of any length carried light")
    record: dict[str, Any] = {
        "scene": scene.name,
        "guide": choice.label,
        "chosen": ", ".join(f"k={r['k']}: {r['chosen']}" for r in guided) or "none",
        **counts,
        "nonzero_share": counts["nonzero"] / max(counts["paths_found"], 1),
        **depths,
        "k": None,
        "a": min((r["a"] for r in guided), default=1.0),
        "parametrisation": plan.parametrisation,
        "emitter_strategy": plan.emitter_strategy,
        "seed": plan.seed,
        "threads": stats[0]["threads"],
        "mean": mean.tolist(),
        "variance": None if relative is None else metrics.finite_or_none(relative),
        "max_weight": max(r["max_weight"] for r in stats),
        "max_contribution": max(heaviest) / brightness if brightness > 0 else 0.0,
        "ess": None,
        "diagnostics": None,
        "passes": [],
        "combine": plan.combine,
        "candidates": None,
        "training": None,
        "lengths": lengths,
        "relmse": None,
        "relmse_trimmed": None,
        "notes": notes,
        "seconds": {**timings, "total": sum(timings.values())},
        "elapsed": seconds[1],
        "budget": plan.budget(learns=False) + (" for each length" if plan.time is None else ""),
        "guide_options": choice.options,
        "keep_pilot": plan.keep_pilot,
        "version": _core.__version__,
        "variant": scene.variant,
    }
    layers = {f"k{part.stats['k']}": part.image for part in parts}
    whole = Result(
        image, variance, found, nonzero, record, timings, None, parts=tuple(parts), layers=layers
    )
    return replace(whole, layers=layers | {"nonzero_share": share_layer(whole)})


COUNTS = ("camera_rays", "paths_found", "nonzero", "outside", "non_finite")


def _luminance(rgb: Any) -> float:
    return float(np.asarray(rgb, np.float64) @ LUMINANCE)


def _notes(length: Mapping[str, Any]) -> Iterator[str]:
    """The notes of a length as notes of the whole: what its diagnostics say is said of that length alone."""
    warnings = length["diagnostics"]["warnings"]
    for note in length["notes"]:
        if note in warnings:
            yield f"k={length['k']}: {note}"
        elif not note.startswith("the image is black"):  # that some length has no light is no news
            yield note
