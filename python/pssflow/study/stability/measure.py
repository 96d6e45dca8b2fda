"""Renders a case's settings with a guide and with random numbers, and judges the one by the other.

A guide *holds* where its images are finite and unbiased (the mean and tiles against the truth: by Welch's test, or with
the variance that the renders state where seeds are few), no
path weighs more than 1/a or is dropped as not finite, E[1/m] = 1 and E[(f/m)²] ≤ E[f²]/a within their errors, and its
relMSE is at most 1.3 times that of as many random samples (median over seeds; means at a = 0, and where no pilot
contains the failure: there a few paths decide, and the median is that of the seeds which were spared). It *degrades*
where it is only slower, and *fails* where one of the others breaks, where it is slower than 1/a times though no pilot
contains the failure, or at a = 0 more than ten times. (With a > 0 the second moment has a bound. The variance, which is
what is left of it without I², can exceed 1/a times that of random numbers where these have hardly any.)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ... import metrics
from ...files import first_line
from ...render import Result
from ...scene import Scene
from ..welch import ALPHA, LUMINANCE, Moments, holm, p_value, tile_means, welch
from .case import THESIS, Case, Effort, Finding, Setting, render_options, worst

__all__ = ["HARMLESS", "TELLING", "Bench", "judge", "measure"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

HARMLESS = 1.3
"""Times the error of random numbers at equal samples that is no harm: a pilot that taught nothing costs a part."""

HOPELESS = 10.0
"""Times that error that count as a failure where nothing bounds it."""

ERRORS = 4.0
"""Standard errors that the measured bound may be exceeded by."""

FEW_SEEDS = 8
"""Fewer images than these say so little of their variance that no bias would be seen; the renders' own is taken."""

TELLING = 0.5
"""Share of the renders that must warn of what no pilot contains."""

FIRST_SEED = 1000
"""Of the renders; the truth counts from 0."""


@dataclass(frozen=True)
class Bench:
    """A setting's scene with its truth and its random renders."""

    setting: Setting
    scene: Scene
    effort: Effort
    truth: F32
    """Runs, (n, h, w, 3)."""
    random: list[Result]
    square: float
    """E[f²] of the truth's paths (of the random renders', where the truth is no render)."""

    @classmethod
    def of(cls, setting: Setting, effort: Effort) -> Bench:
        """Loads a setting's scene and renders what guides are compared with."""
        effort = replace(
            effort,
            spp=setting.spp or effort.spp,
            side=setting.side or effort.side,
            seeds=effort.seeds if effort.cheap else max(effort.seeds, setting.seeds),
        )
        scene = Scene(setting.scene(effort.side))
        many = {**setting.options, "threads": effort.threads, "progress": False}
        random = [
            scene.render("none", effort.spp, seed=FIRST_SEED + seed, **many)
            for seed in range(effort.seeds)
        ]
        if setting.truth is not None:
            truth = setting.truth(effort.side, effort.truth, 16 * effort.spp, effort.threads)
            square = _square(random)
        else:
            runs = [
                scene.render("none", 16 * effort.spp, seed=seed, **many)
                for seed in range(effort.truth)
            ]
            truth = np.stack([run.image for run in runs])
            square = _square(runs)
        return cls(setting, scene, effort, truth, random, square)

    def run(self, guide: str) -> list[Result]:
        """A render of the guide for each seed."""
        how = render_options(guide, self.effort, self.setting.guide_options)
        how |= {**self.setting.options, "threads": self.effort.threads, "progress": False}
        if guide == THESIS:
            # Its emitter samples alone have another f where lights are hit by chance, but the same mean.
            how.pop("emitter_strategy", None)
        return [
            self.scene.render(**how, spp=self.effort.spp, seed=FIRST_SEED + seed)
            for seed in range(self.effort.seeds)
        ]


def measure(
    case: Case, guide: str, effort: Effort, benches: dict[str, Bench], folder: Path
) -> Finding | None:
    """The worst of a case's settings and its probe for a guide; None where the case has no sense for it.

    `benches` keeps what guides share, by setting; `folder` is for files.
    """
    settings = case.settings if effort.extremes else case.settings[:1]
    findings = []
    for setting in settings:
        if setting.name not in benches:
            benches[setting.name] = Bench.of(setting, effort)
        bench = benches[setting.name]
        try:
            found = judge(bench, bench.run(guide))
        except (ValueError, RuntimeError, MemoryError) as error:
            allowed = isinstance(error, ValueError) and setting.refused
            told = bool(allowed) and setting.refused in str(error) and "\n" not in str(error)
            found = Finding("holds" if told else "fails", first_line(error))
        if len(settings) > 1:
            found = replace(found, why="; ".join(t for t in (setting.name, found.why) if t))
        findings.append(found)
    if case.probe is not None and (found := case.probe(guide, effort, folder)) is not None:
        findings.append(found)
    return worst(findings) if findings else None


def judge(bench: Bench, results: Sequence[Result]) -> Finding:
    """What the renders of one guide came to."""
    images = np.stack([result.image for result in results])
    last = results[-1].stats
    first = results[0]
    warnings = tuple(dict.fromkeys(w for r in results for w in r.stats["diagnostics"]["warnings"]))
    ks = [k for r in results if (k := r.stats["diagnostics"]["pareto_k"]) is not None]
    chosen = sorted({result.stats["chosen"] for result in results})
    a = min(float(result.stats["a"]) for result in results)
    numbers: dict[str, float | None] = {
        "a": a,
        "max_weight": max(float(r.stats["max_weight"]) for r in results),
        "pareto_k": float(np.median(ks)) if ks else None,
        "warned": sum(bool(r.stats["diagnostics"]["warnings"]) for r in results) / len(results),
    }

    def finding(verdict: str, figure: str, why: str = "") -> Finding:
        said = [why] if why else []
        if last["guide"] == "auto":
            said.append("chose " + ", ".join(chosen))
        said += [n for n in dict.fromkeys(last["notes"]) if "none is used" in n or "diverged" in n]
        return Finding(verdict, figure, "; ".join(said), numbers, warnings, first.image)

    bad = int(np.count_nonzero(~np.isfinite(images)))
    if bad:
        return finding("fails", f"{bad} values of the image are not finite")
    truth = bench.truth.mean(axis=0)
    if not truth.any():
        lit = float(np.abs(images).max())
        return finding(
            "holds" if lit == 0 else "fails",
            "black, as it should be" if lit == 0 else f"{lit:g} in a black image",
        )
    numbers |= _errors(bench, images, a)
    numbers["bound"], error = _bound(bench, results, a)
    numbers["bound_error"] = error
    if a > 0 and (weight := numbers["max_weight"]) is not None and weight > (1 + 1e-5) / a:
        return finding("fails", f"a path weighs {weight:.4g} > 1/a = {1 / a:.4g}")
    dropped, usual = (sum(r.stats["non_finite"] for r in rs) for rs in (results, bench.random))
    if a > 0 and dropped and not usual:
        return finding("fails", f"{dropped} paths were not finite; of random numbers' none")
    if a > 0 and (off := _weight_is_off(results, a)):
        return finding("fails", off)
    figure = _figure(numbers)
    if a == 0 and (z := _missing(results)) < -ERRORS:
        what = f"light is missing: {z:.0f} standard errors below the pilot's mean; {figure}"
        return finding("fails", what)
    heavy, p = _bias(bench, images, results)
    numbers["p"] = p
    unsure = ""
    # Of a mode that a few paths in all runs meet, their spread says nothing of the variance.
    if p < ALPHA / 2 and not bench.setting.blind:
        there, here = float(truth.mean()), float(images.mean())
        figure += f"; mean {here / there:.3g} of the truth, p = {p:.1g}"
        # Where one sample holds much of the sum, neither side knows its variance, and p says little: but no variance is
        # above E[f²]/a.
        if not heavy or _bias_beyond_bound(bench, images, results, a) < ALPHA / 2:
            return finding("fails", figure)
        unsure = "too heavy-tailed to tell bias from noise"
    bound = numbers["bound"]
    if a > 0 and bound is not None and bound - ERRORS * error > 1.0:
        return finding("fails", f"E[(f/m)²] = {bound:.3g} · E[f²]/a")
    ratio, spread = numbers["ratio"] or 0.0, numbers["ratio_error"] or 0.0
    if a == 0 and max(ratio, numbers["median_ratio"] or 0.0) > HOPELESS:
        return finding("fails", figure)
    if a > 0 and bench.setting.blind and ratio - ERRORS * spread > 1 / a:
        return finding("fails", f"{figure}: more than 1/a")
    if ratio <= HARMLESS and not unsure:
        return finding("holds", figure)
    silent = bench.setting.blind and (numbers["warned"] or 0.0) < TELLING
    return finding(
        "degrades", figure, unsure or ("most renders say nothing of it" if silent else "")
    )


def _weight_is_off(results: Sequence[Result], a: float) -> str:
    """What is wrong with the mean of 1/m over the paths of all renders, which is 1 where a guide's densities are those
    that it draws with; 1/m lies between 0 and 1/a, so that its variance is at most 1/a − 1.
    """
    paths = np.array([r.stats["camera_rays"] for r in results], np.float64)
    if not paths.sum():
        return ""
    means = [r.stats["diagnostics"]["mean_weight"] for r in results]
    mean = float(np.average(means, weights=paths))
    error = math.sqrt((1 / a - 1) / paths.sum()) + 1e-5
    return "" if abs(mean - 1) <= 5 * error else f"E[1/m] = {mean:.4g} ± {error:.1g}, not 1"


def _errors(bench: Bench, images: F32, a: float) -> dict[str, float | None]:
    """RelMSE of guide and random numbers over the seeds, and how far outliers stand out."""
    truth = bench.truth.mean(axis=0)
    variance = bench.truth.var(axis=0, ddof=1) / len(bench.truth)
    ours = np.array([metrics.relmse(image, truth, variance) for image in images])
    theirs = np.array([metrics.relmse(r.image, truth, variance) for r in bench.random])
    # A truth's own noise can leave less than nothing of a small error.
    least = max(metrics.relative_variance(variance, truth), 1e-12)
    middle = [max(float(np.median(side)), least) for side in (ours, theirs)]
    mean = [max(float(side.mean()), least) for side in (ours, theirs)]
    # Where a few paths decide an error, its median is that of the seeds which were spared.
    by_mean = bench.setting.blind or a == 0
    shown = mean if by_mean else middle
    return {
        "relmse": shown[0],
        "relmse_random": shown[1],
        "ratio": shown[0] / shown[1],
        "ratio_error": _ratio_error(ours, theirs, np.mean if by_mean else np.median, least),
        "median_ratio": middle[0] / middle[1],
        "outlier": float(ours.max()) / middle[0],
    }


def _ratio_error(ours: F64, theirs: F64, centre: Callable[..., F64], least: float) -> float:
    """Standard error of the ratio of two centres, from a thousand bootstraps of the seeds: half of what holds the
    middle 68 %. A seed's two errors stay together, for they have random numbers in common.
    """
    rng = np.random.default_rng(0)
    rows = rng.integers(len(ours), size=(1000, len(ours)))
    paired = len(ours) == len(theirs)
    others = rows if paired else rng.integers(len(theirs), size=(1000, len(theirs)))
    drawn = [np.maximum(centre(s[r], axis=1), least) for s, r in ((ours, rows), (theirs, others))]
    low, high = np.quantile(drawn[0] / drawn[1], [0.16, 0.84])
    return float(high - low) / 2


def _bound(bench: Bench, results: Sequence[Result], a: float) -> tuple[float | None, float]:
    """The ratio a · E[(f/m)²] ÷ E[f²], and its standard error from the spread between seeds."""
    ours = np.array([r.stats["diagnostics"]["mean_square"] for r in results], np.float64)
    theirs = np.array([r.stats["diagnostics"]["mean_square"] for r in bench.random], np.float64)
    if (
        theirs.mean() <= 0.0
        or bench.random[0].stats["emitter_strategy"] != results[0].stats["emitter_strategy"]
    ):
        return None, 0.0
    spread = [
        side.std(ddof=1) / math.sqrt(len(side)) / max(side.mean(), 1e-300)
        for side in (ours, theirs)
    ]
    ratio = a * ours.mean() / theirs.mean()
    return float(ratio), float(ratio * math.hypot(*spread))


def _square(results: Sequence[Result]) -> float:
    """Mean E[(f/m)²] of renders."""
    return float(np.mean([r.stats["diagnostics"]["mean_square"] for r in results]))


def _bias(bench: Bench, images: F32, results: Sequence[Result]) -> tuple[bool, float]:
    """Whether tails are too heavy for the test, and p of the means of image and tiles."""
    tile = max(images.shape[1] // 2, 1)
    compared = welch(images, bench.truth, tile=tile)
    # Colours of a path go together: at most so much is the deviation of their luminance.
    variance = (np.sqrt([r.variance for r in results]) @ LUMINANCE) ** 2
    if len(results) >= FEW_SEEDS or not np.isfinite(variance).all():
        return not compared.has_power, compared.p
    # Pixels are independent, and so are their samples: these are the degrees of freedom.
    samples = len(results) * bench.effort.spp
    height, width = variance.shape[1:]
    heights = np.diff(np.arange(0, height, tile), append=height)
    widths = np.diff(np.arange(0, width, tile), append=width)
    pixels = np.outer(heights, widths)
    noise = tile_means(variance, tile).mean(axis=0) / (len(results) * pixels)
    whole = np.asarray(variance.mean() / (len(results) * height * width))
    image, tiles = compared.images[0], compared.tiles[0]
    sides = (
        (Moments(image.mean, whole, samples * height * width), compared.images[1]),
        (Moments(tiles.mean, noise, samples * int(pixels.min())), compared.tiles[1]),
    )
    p_image, p_tiles = (p_value(*side) for side in sides)
    return not compared.has_power, float(min(p_image, holm(p_tiles).min()))


def _bias_beyond_bound(bench: Bench, images: F32, results: Sequence[Result], a: float) -> float:
    """The p of the image's mean if its paths had the largest variance that a allows; 1 without a bound."""
    if a <= 0:
        return 1.0
    paths = sum(int(r.stats["camera_rays"]) for r in results)
    square = max(bench.square / a, _square(results))
    ours = Moments(np.asarray((images @ LUMINANCE).mean()), np.asarray(square / paths), paths)
    return float(p_value(ours, Moments.of((bench.truth @ LUMINANCE).mean(axis=(1, 2)))))


def _missing(results: Sequence[Result]) -> float:
    """Standard errors by which guided paths carry less light than the pilot's; the median of the renders."""
    means = [r.stats["diagnostics"]["means"] for r in results]
    return float(np.median([m["z"] if m else 0.0 for m in means]))


def _figure(numbers: dict[str, Any]) -> str:
    weight = numbers["max_weight"]
    ratio, error = numbers["ratio"], numbers["ratio_error"]
    text = f"relMSE {ratio:.2g} ± {error:.1g} × random's, max 1/m {weight:.3g}"
    if numbers.get("bound") is not None and numbers["a"] > 0:
        text += f", a·E[(f/m)²]/E[f²] {numbers['bound']:.2g} ± {numbers['bound_error']:.1g}"
    if numbers["outlier"] > 5:
        text += f", worst seed {numbers['outlier']:.2g} × median"
    return text
