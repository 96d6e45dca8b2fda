"""The tracer, its rays alone and Mitsuba's `path`, taking turns on one scene.

All contestants take turns within a round, so that a busy machine slows all of them; medians over the rounds are
reported. Each is run once before, unmeasured: Mitsuba's LLVM variant compiles its kernel then.

Rays per path. Ours are counted by the tracer (for `nee` less the BSDF rays of `mis`). Mitsuba does not count: at
depth k+1 its `path` sends up to k+1 rays to find surfaces and up to k shadow rays, fewer where a path escapes. The
shares of paths that reach x₁ … x_k are those of our own uniform paths, drawn from the same BSDFs; shadow rays are an
upper bound, since none is sent to an emitter that faces away. A path of Mitsuba also gathers the light of fewer
bounces, ours that of exactly k: rays per second are comparable, paths per second only with the rays beside them.
"""

from __future__ import annotations

import functools
import re
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

from ..scene import Scene
from ..variants import llvm_problem

SCALAR, LLVM = "scalar_rgb", "llvm_ad_rgb"
OURS, RAYS_ALONE = "pssflow, mis", "mis, its rays alone"


@dataclass
class Contestant:
    """Something that traces `paths` paths when it is called."""

    name: str
    run: Callable[[], object]
    paths: int
    rays_per_path: float
    counted: str
    """How well `rays_per_path` is known: counted, about, or an upper bound."""


Loader = Callable[[str], Scene]
"""Gives the scene in a variant of Mitsuba, which it sets."""


def loader(path: Path, scale: float) -> Loader:
    """Loads a scene once for each variant."""

    @functools.cache
    def load(variant: str) -> Scene:
        mi.set_variant(variant)
        return Scene(path, scale=scale)

    return load


def contestants(
    load: Loader,
    spp: int,
    k: int,
    threads: int,
    *,
    strategies: Sequence[str] = ("mis", "nee"),
    variants: Sequence[str] = (SCALAR, LLVM),
) -> list[Contestant]:
    """All that take turns on one scene: ours with each strategy, its rays alone, Mitsuba in each variant."""
    scene = load(SCALAR)
    paths = scene.width * scene.height * spp
    alone = scene.core.rays_alone(spp=1, k=k, threads=threads)
    reach = [_reached(scene, bounces) for bounces in range(1, k + 1)]
    found = [
        Contestant(
            f"pssflow, {strategy}",
            lambda strategy=strategy: scene.render(
                "none",
                spp,
                k=k,
                emitter_strategy=strategy,
                threads=threads,
                progress=False,
            ),
            paths,
            # `rays_alone` sends those of MIS; NEE spares the ray from x_k that looks for an emitter.
            alone["rays_per_path"] - (reach[-1] if strategy == "nee" else 0.0),
            "counted" if strategy == "mis" else "about",
        )
        for strategy in strategies
    ]
    found.append(
        Contestant(
            RAYS_ALONE,
            lambda: scene.core.rays_alone(spp=spp, k=k, threads=threads),
            paths,
            alone["rays_per_path"],
            "counted",
        )
    )
    bound = 1 + 2 * sum(reach)
    for variant in variants:
        if variant == LLVM and llvm_problem():
            continue
        run = _mitsuba(load, variant, spp, k, threads)
        found.append(Contestant(f"Mitsuba {variant}", run, paths, bound, "upper bound"))
    return found


def measure(contests: dict[int, list[Contestant]], rounds: int) -> list[dict[str, Any]]:
    """Runs all in turn; one row for each contestant and number of threads."""
    seconds: dict[tuple[int, str], list[float]] = {}
    for measured in range(-1, rounds):
        for threads, group in contests.items():
            for contestant in group:
                start = time.perf_counter()
                result = contestant.run()
                elapsed = time.perf_counter() - start
                if isinstance(result, dict):  # it left its preparations out of the time
                    elapsed = result["seconds"]
                if measured >= 0:
                    seconds.setdefault((threads, contestant.name), []).append(elapsed)
    rows = []
    for threads, group in contests.items():
        for contestant in group:
            times = seconds[threads, contestant.name]
            median = statistics.median(times)
            rows.append(
                {
                    "contestant": contestant.name,
                    "threads": threads,
                    "paths_per_second": contestant.paths / median,
                    "us_per_path": 1e6 * median / contestant.paths,
                    "rays_per_path": contestant.rays_per_path,
                    "rays": contestant.counted,
                    "mrays_per_second": contestant.rays_per_path * contestant.paths / median / 1e6,
                    "seconds": times,
                }
            )
    return rows


def film_scale(path: Path, side: int) -> float:
    """Factor that gives a scene's film a longer side of `side` pixels."""
    text = path.read_text(encoding="utf-8", errors="replace")
    # Read without loading the scene a second time; a size by parameter needs Mitsuba.
    sizes = re.findall(r'name="(?:width|height)"\s+value="(\d+)"', text)
    if len(sizes) == 2:
        return side / max(map(int, sizes))
    film = mi.load_file(str(path), optimize=False).sensors()[0].film()
    return side / max(int(n) for n in film.crop_size())


def _reached(scene: Scene, bounces: int) -> float:
    """Share of uniform paths that have the vertices x₁ … x_bounces."""
    stats = scene.render("none", 4, k=bounces, emitter_strategy="nee", seed=1, progress=False).stats
    return stats["paths_found"] / stats["camera_rays"]


def _mitsuba(load: Loader, variant: str, spp: int, k: int, threads: int) -> Callable[[], object]:
    """Mitsuba's `path` on the same film; the variant and the size of its thread pool are set before each run."""
    loaded = load(variant)
    scene = loaded.mi_scene
    mi.set_variant(variant)
    settings = {"max_depth": k + 1, "rr_depth": k + 2, "hide_emitters": loaded.hide_emitters}
    integrator = mi.load_dict({"type": "path", **settings})

    def run() -> dict[str, float]:
        mi.set_variant(variant)
        dr.set_thread_count(threads)
        start = time.perf_counter()
        image = integrator.render(scene, seed=0, spp=spp)
        dr.eval(image)
        dr.sync_thread()
        return {"seconds": time.perf_counter() - start}

    return run
