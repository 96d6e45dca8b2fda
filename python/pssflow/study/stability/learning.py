"""Cases whose difficulty is in what a guide learns from: too little, poisoned, elsewhere, too fast, too long."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...files import first_line
from ...guide import Guide
from ...render import Result
from ...scene import Pilot, Scene
from .case import CHEAP, THESIS, Case, Effort, Finding, Setting, render_options, worst
from .materials import glow
from .measure import Bench, judge
from .parts import camera, diffuse, lamp, room, twosided

__all__ = ["AGGRESSIVE", "FEW", "MOVING", "OUTSIDE", "OVERFIT", "POISON", "PRIOR"]

FLOWS = (THESIS, "realnvp", "realnvp-logit")
"""Guides that are trained by their learning rate alone."""

PRIOR = Case(
    1,
    "prior-without-support",
    "A prior without full support",
    "With a uniform prior on the cube, whatever the flow carries outside has density zero: its logarithm has no "
    "gradient, and paths that it should draw are never drawn again.",
    (
        Setting(
            "hypercube prior",
            room,
            guide_options={name: {"prior": "hypercube"} for name in FLOWS},
        ),
    ),
    picture=True,
)


def _outside(guide: str, effort: Effort, folder: Path) -> Finding | None:
    """How many of a guide's paths are lost outside the cube; all of it must be known to the guide itself."""
    bench = Bench.of(Setting("room", room), effort)
    results = bench.run(guide)
    found = judge(bench, results)
    shares = [r.stats["diagnostics"]["outside_share"] for r in results]
    if any(share is None for share in shares):
        return replace(found, why="no guide was fitted")
    lost = float(np.mean([s for s in shares if s is not None]))
    known = float(np.mean([r.stats["diagnostics"]["mass_outside"] or 0.0 for r in results]))
    numbers = {**found.numbers, "outside": lost, "mass_outside": known}
    drawn = float(np.mean([r.stats["camera_rays"] for r in results])) * len(results)
    error = math.sqrt(max(lost * (1 - lost), 1e-9) / drawn) + 0.01
    verdict = found.verdict
    if abs(lost - known) > 5 * error:
        verdict = "fails"
    elif lost > 0.01 and verdict == "holds":
        verdict = "degrades"
    figure = f"{lost:.1%} of its paths lost outside (it knows of {known:.1%}); {found.figure}"
    return replace(found, verdict=verdict, figure=figure, numbers=numbers)


OUTSIDE = Case(
    2,
    "outside-the-cube",
    "Samples outside the cube",
    "A normal prior has no borders: what falls outside the cube is a path lost, though it was paid for.",
    probe=_outside,
)


# --- 4: poisoned records --------------------------------------------------------------------------


def _poisoned(f: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Contributions (n, 3) with an outlier of 1e6 times the mean, NaN, infinities of both signs and denormals among
    those that carry light; black ones are left out when a guide is fitted, whatever is in them.
    """
    f = f.copy()
    rows = rng.permutation(np.flatnonzero(f.max(axis=1) > 0))
    f[rows[:1]] = 1e6 * f.mean()
    for i, value in enumerate((np.nan, np.inf, -np.inf, 1e-42, -1.0)):
        f[rows[1 + 3 * i : 4 + 3 * i]] = value
    return f


def _poison(guide: str, effort: Effort, folder: Path) -> Finding | None:
    """Fits a guide to poisoned records and renders with it: the poison must be dropped, counted, and harm nothing."""
    if guide in ("none", "auto"):
        # `auto` chooses from records of its own alone; `tests/guide/select.rs` poisons these.
        return None
    bench = _class_room(guide, effort)

    def poison(pilot: Pilot, rng: np.random.Generator) -> Pilot:
        # Some guides learn from whole paths, others from what their BSDF-sampled rays found; other rows of either.
        return replace(pilot, f=_poisoned(pilot.f, rng), f_bsdf=_poisoned(pilot.f_bsdf, rng))

    return judge(bench, _taught(bench, guide, effort, poison))


def _class_room(guide: str, effort: Effort) -> Bench:
    """The plain room, for guides that are taught there by hand."""
    strategy = {"emitter_strategy": "nee"} if guide == THESIS else {}
    return Bench.of(Setting("room", room, strategy), effort)


def _taught(
    bench: Bench,
    guide: str,
    effort: Effort,
    change: Callable[[Pilot, np.random.Generator], Pilot],
) -> list[Result]:
    """A render for each seed with a guide that learned from a pilot which was changed."""
    name = "realnvp" if guide == THESIS else guide
    options = dict(CHEAP.get(guide, {})) if effort.cheap else {}
    strategy = "nee" if guide == THESIS else "mis"
    results: list[Result] = []
    for seed in range(effort.seeds):
        # No more paths than a render's pilot has.
        pilot = bench.scene.pilot(
            spp=max(effort.spp // 4, 2),
            seed=seed + 1,
            emitter_strategy=strategy,
            threads=effort.threads,
        )
        taught = change(pilot, np.random.default_rng(seed))
        fitted = taught.fit(name, seed=seed, **options)
        results.append(
            bench.scene.render(
                fitted,
                effort.spp,
                seed=1000 + seed,
                uniform_fraction=0.0 if guide == THESIS else None,
                threads=effort.threads,
                progress=False,
                **bench.setting.options,
            )
        )
    return results


POISON = Case(
    4,
    "poisoned-training",
    "Outliers, NaN and infinities in training",
    "One path of 1e6 times the mean, three each of NaN, ±∞, denormal and negative radiance among the records, and as "
    "many of what BSDF-sampled rays found: a "
    "loss that is not finite once is so for ever, and one outlier pulls all mass to itself.",
    probe=_poison,
)

# --- 5: almost nothing to learn from --------------------------------------------------------------


def _few(guide: str, effort: Effort, folder: Path) -> Finding | None:
    """Fits a guide to a pilot of which none, one or two paths carry light: it refuses with a word, or harms nothing."""
    if guide in ("none", "auto"):
        return None
    bench = _class_room(guide, effort)
    findings = []
    for count in (0, 1, 2):
        said = f"{count} paths with light"
        try:
            results = _taught(bench, guide, effort, partial(_dimmed, count=count))
        except ValueError as error:
            findings.append(Finding("holds", f"{said}: {first_line(error)}"))
            continue
        found = judge(bench, results)
        findings.append(replace(found, why="; ".join(t for t in (said, found.why) if t)))
    return worst(findings)


def _dimmed(pilot: Pilot, rng: np.random.Generator, *, count: int) -> Pilot:
    """The same paths, all but so many of which carry no light."""
    dark = rng.permutation(np.flatnonzero(pilot.f.max(axis=1) > 0))[count:]
    f, f_bsdf = pilot.f.copy(), pilot.f_bsdf.copy()
    f[dark], f_bsdf[dark] = 0.0, 0.0
    return replace(pilot, f=f, f_bsdf=f_bsdf)


FEW = Case(
    5,
    "few-paths",
    "No path with light, one, two; fewer samples than parameters",
    "A guide of 85,840 weights and two paths to learn from; or none, because all is black.",
    (
        Setting("4 pixels, 4 samples", lambda _: room(2), spp=4, side=2),
        Setting("no light", glow, spp=8),
        Setting("one pixel, 2 samples", lambda _: room(1), spp=2, side=1),
        Setting("one pixel, 64 samples", lambda _: room(1), spp=64, side=1),
    ),
    probe=_few,
)

# --- 11: training that is far too fast ------------------------------------------------------------

FAST = 100.0
"""Times the usual learning rate."""

RATES = {
    THESIS: 1e-3,
    "realnvp": 1e-3,
    "realnvp-logit": 1e-3,
    "mixture-net": 5e-3,
    "spline-net": 5e-3,
}
"""Usual learning rates."""


def _aggressive(guide: str, effort: Effort, folder: Path) -> Finding | None:
    """Trains a hundred times too fast: it stops and says so, or what it draws still has the density that it
    states.
    """
    if guide not in RATES:
        return None
    rate = {"learning_rate": min(FAST * RATES[guide], 1.0)}
    bench = Bench.of(Setting("room", room, guide_options={guide: rate}), effort)
    results = bench.run(guide)
    found = judge(bench, results)
    errors = [
        e for r in results if isinstance(r.guide, Guide) and (e := _round_trip(r.guide)) is not None
    ]
    stopped = sum("diverged" in " ".join(r.notes) for r in results)
    numbers = {**found.numbers, "diverged": float(stopped)}
    figure = found.figure
    if errors:
        numbers["log_density_error"] = max(errors)
        figure += f"; |Δ ln q| {max(errors):.1g} on the way back"
    if stopped:
        figure += f"; {stopped} of {len(results)} trainings stopped, random numbers instead"
    verdict = "fails" if errors and not max(errors) < 0.1 else found.verdict
    return replace(found, verdict=verdict, figure=figure, numbers=numbers)


def _round_trip(guide: Guide) -> float | None:
    """Largest difference between the log-density that a whole-path guide states when it draws numbers inside
    the cube, and the one that it computes for these numbers, among all but the worst thousandth.
    """
    if "path" not in guide.models:
        return None
    u, drawn = guide.sample(4096, seed=5)
    inside = ((u >= 0) & (u < 1)).all(axis=1)
    if not inside.any():
        return 0.0
    again = guide.log_prob(u[inside])
    return float(np.quantile(np.abs(again - drawn[inside]), 0.999))


AGGRESSIVE = Case(
    11,
    "aggressive-training",
    "Training a hundred times too fast",
    "Scales saturate, inverses lose their digits in float32, losses become NaN. The density that a path is "
    "divided by must stay the one that it was drawn from.",
    probe=_aggressive,
)

# --- 12: overfitting ------------------------------------------------------------------------------

OVERFIT = Case(
    12,
    "overfitting",
    "200 samples, 200 epochs",
    "A flow that may look at 200 paths 200 times puts its mass on these, and nearly none between them.",
    (
        Setting(
            "10 × 10 pixels, 2 spp of pilot",
            lambda _: room(10),
            {"pilot_spp": 2},
            {
                **{
                    name: {"epochs": 200, "samples": 200, "outlier_quantile": 1.0} for name in FLOWS
                },
                "mixture-net": {"epochs": 200},
                "spline-net": {"epochs": 200},
            },
            side=10,
        ),
    ),
)

# --- 15: a moving target --------------------------------------------------------------------------


def _spot(x: float) -> Callable[[int], dict[str, Any]]:
    """A lamp in a tube over one side of the floor: all light of two bounces comes from the spot below it."""

    def scene(side: int) -> dict[str, Any]:
        place = (x, 0.5, 0.98)
        tube = {"type": "cylinder", "p0": [*place], "p1": [x, 0.5, 0.0], "radius": 0.12}
        shade = {**tube, "bsdf": twosided(diffuse(0.02))}
        shining = lamp((x, 0.5, 0.97), (0.0, 0.0, -1.0), 0.08, 200.0)
        return room(side, ball=None, tube=shade, lamp=shining)

    return scene


LEFT, RIGHT = _spot(-0.7), _spot(0.7)


def _aside(side: int) -> dict[str, Any]:
    """The lamp on the left, seen from the right wall."""
    return LEFT(side) | {"camera": camera(side, (0.9, 0.3, 0.2), (-1.0, 0.4, -0.4))}


LESSON = 16
"""Times the samples of the render that a guide learns from there: it must be sure of what is wrong here."""


def _moving(guide: str, effort: Effort, folder: Path) -> Finding | None:
    """Learns with the lamp on the left, seen as here or from elsewhere, and renders with the lamp on the right: the
    saved guide is refused, and the object itself loses no more than 1/a.
    """
    here = Bench.of(Setting("lamp on the right", RIGHT, blind=True), effort)
    return worst([_moved(guide, effort, folder, here, there) for there in (LEFT, _aside)])


def _moved(
    guide: str,
    effort: Effort,
    folder: Path,
    here: Bench,
    elsewhere: Callable[[int], dict[str, Any]],
) -> Finding:
    there = Scene(elsewhere(effort.side))
    results: list[Result] = []
    for seed in range(effort.seeds):
        how = render_options(guide, effort) | {"threads": effort.threads, "progress": False}
        learned = there.render(**how, spp=LESSON * effort.spp, seed=seed).guide
        if learned is None:
            # Of other seeds' guides there may be one to use.
            continue
        path = folder / f"moved-{guide.replace('+', '_')}-{seed}.guide"
        if isinstance(learned, Guide):
            learned.save(path)
            try:
                here.scene.render(path, 2, progress=False, threads=effort.threads)
                return Finding("fails", "a guide of another scene was taken from its file")
            except ValueError as error:
                refused = first_line(error)
                if "scene" not in refused:
                    return Finding("fails", f"refused for another reason: {refused}")
            finally:
                path.unlink(missing_ok=True)
        options = {"emitter_strategy": "nee", "uniform_fraction": 0.0} if guide == THESIS else {}
        results.append(
            here.scene.render(
                learned,
                effort.spp,
                seed=1000 + seed,
                threads=effort.threads,
                progress=False,
                **options,
            )
        )
    if not results:
        return Finding("holds", "none was chosen: there is nothing to move")
    found = judge(here, results)
    said = "the file is refused; the object was used"
    return replace(found, why="; ".join(t for t in (said, found.why) if t))


MOVING = Case(
    15,
    "moving-target",
    "Learned elsewhere",
    "A guide of one lamp, or of another camera, too, is used for another lamp: its density is small exactly where the "
    "light is now.",
    probe=_moving,
)
