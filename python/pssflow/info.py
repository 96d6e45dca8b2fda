"""What `pssflow info` finds out about a scene. Never fails on what is not supported: it lists that.

A supported scene is built as a render would build it, and probed: `PATHS` random paths of one, two and three bounces
tell where its light is, whatever guide may follow.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from .export import inspect_scene
from .scene import Scene

__all__ = ["PATHS", "inspect"]

PATHS = 1 << 16
"""Random paths of each number of bounces."""

BOUNCES = (1, 2, 3)

LUMINANCE = np.array([0.212671, 0.715160, 0.072169])


def inspect(mi_scene: Any, sensor: Any = 0, *, approximate: bool = False) -> dict[str, Any]:
    """One JSON object: what was understood, what was not and what to do, and of a scene that can be built also memory,
    light and the emitter strategy.

    Args:
        mi_scene: an `mi.Scene` of the active variant.
        sensor: index of a sensor, or a sensor object.
        approximate: whether unsupported features are replaced, as in `Scene`.

    Raises:
        UnsupportedError: the scene's variant is not supported.
        ValueError: there is no such sensor.
        RuntimeError: Embree was not found.
    """
    found = inspect_scene(mi_scene, sensor, approximate=approximate)
    record: dict[str, Any] = {
        "supported": not found.unsupported,
        "counts": found.counts,
        "triangles": found.triangles,
        "instances": found.counts["shape"].get("instance", 0),
        "array_bytes": found.array_bytes,
        "bsdfs": found.bsdfs,
        "unsupported": [str(thing) for thing in found.unsupported],
        "notes": found.notes,
        "with_approximate": [],
        "memory": None,
        "probe": None,
        "auto": None,
    }
    if found.unsupported:
        if not approximate:
            rest = inspect_scene(mi_scene, sensor, approximate=True)
            record["with_approximate"] = [
                note for note in rest.notes if note.startswith("approximated: ")
            ]
            record["approximate_helps"] = not rest.unsupported
        return record
    scene = Scene(mi_scene, sensor, approximate=approximate)
    summary = scene.summary
    record["memory"] = {
        "geometry": summary["geometry_bytes"],
        "textures": summary["texture_bytes"],
        "bvh": summary["bvh_bytes"],
    }
    record["seconds"] = scene.timings
    record["probe"] = probe(scene)
    strategy, why = scene.resolve_strategy("auto")
    record["auto"] = {"emitter_strategy": strategy, "why": why}
    return record


def probe(scene: Scene) -> list[dict[str, Any]]:
    """Mean luminance of light of exactly k bounces, k = 1, 2, 3, from `PATHS` random paths each, always the same."""
    rng = np.random.default_rng(0)
    width, height = scene.width, scene.height
    lens = scene.exported.description["sensor"]["type"] == "thinlens"
    rows: list[dict[str, Any]] = []
    for k in BOUNCES:
        u = rng.random((PATHS, len(scene.columns(k))), np.float32)
        pixels = rng.random((PATHS, 4 if lens else 2), np.float32)
        # A product that rounds up to the film's edge would fall off it.
        size = np.array([width, height], np.float32)
        pixels[:, :2] = np.minimum(pixels[:, :2] * size, np.nextafter(size, np.float32(0)))
        start = time.perf_counter()
        traced = scene.trace(u, pixels, k=k)
        seconds = time.perf_counter() - start
        luminance = traced.f.astype(np.float64) @ LUMINANCE
        rows.append(
            {
                "k": k,
                "mean": float(luminance.mean()),
                "standard_error": float(luminance.std(ddof=1) / np.sqrt(PATHS)),
                "found_share": float(traced.found.mean()),
                "nonzero_share": float((luminance > 0).sum() / max(traced.found.sum(), 1)),
                "seconds": seconds,
            }
        )
    total = sum(row["mean"] for row in rows)
    for row in rows:
        row["share"] = row["mean"] / total if total > 0 else 0.0
    return rows
