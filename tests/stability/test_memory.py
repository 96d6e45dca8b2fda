"""Memory: flat over many renders in one process, and a clear word where it runs out while learning."""

from __future__ import annotations

import ctypes
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from numpy.typing import NDArray

import pssflow
from pssflow.guide import registry
from pssflow.study.stability.parts import room
from pssflow.study.stability.registry import CASES
from tests.conftest import ROOT, SCALAR

SOAK = "PSSFLOW_SOAK_SECONDS"
"""Environment variable: how long the soak goes on. Default: half an hour."""

MOST_GROWTH = 32 << 20
"""Bytes that the allocator's arenas come and go by. Of a thousand renders, each may leak 64 kB unseen."""

SHORT: dict[str, dict[str, Any]] = {
    "realnvp": {"epochs": 1, "samples": 1024},
    "realnvp-logit": {"epochs": 1, "samples": 1024},
    "mixture-net": {"epochs": 1},
    "spline-net": {"epochs": 1},
}


def _resident() -> int:
    """Bytes of this process that are in memory, without what its allocator keeps for later."""
    if sys.platform == "linux":
        ctypes.CDLL(None).malloc_trim(0)
    with Path("/proc/self/statm").open(encoding="ascii") as file:
        return int(file.read().split()[1]) * resource.getpagesize()


def growth(renders: int) -> int:
    """Bytes that this process grew by over the second half of so many renders."""
    mi.set_variant(SCALAR)
    scene = pssflow.Scene(room(40))
    guides = ["none", "auto", "table", "vegas", "mixture-net"]

    def render(i: int) -> None:
        name = guides[i % len(guides)]
        scene.render(name, 16, seed=i, threads=2, progress=False, **SHORT.get(name, {}))

    return _grown(render, renders)


def _grown(work: Callable[[int], object], times: int) -> int:
    middle = 0
    for i in range(times):
        work(i)
        if i == times // 2:
            middle = _resident()
    return _resident() - middle


def _alone(call: str) -> str:
    """What a call of this module's returns in a process of its own, whose heap no other test has filled."""
    code = f"from tests.stability.test_memory import *; print({call})"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_a_leak_is_seen() -> None:
    """The control: a MiB and a half that stays each time, less than the records of a guided render below."""
    kept: list[NDArray[np.uint8]] = []
    assert _grown(lambda _: kept.append(np.ones(3 << 19, np.uint8)), 80) > MOST_GROWTH


@pytest.mark.timeout(900)
def test_memory_is_flat() -> None:
    """Forty renders behind forty others: if each guided one leaked its records (25,600 paths, about 2 MB), it would be
    seen.
    """
    assert int(_alone("growth(80)")) < MOST_GROWTH


@pytest.mark.long
@pytest.mark.timeout(7200)
def test_memory_is_flat_over_a_thousand_renders(record: dict[str, Any]) -> None:
    record["bytes"] = float(_alone("growth(1000)"))
    assert record["bytes"] < MOST_GROWTH


@pytest.mark.timeout(900)
def test_memory_that_runs_out_while_learning_is_no_crash() -> None:
    """The vertices of half a million paths do not fit: fewer are kept, the image is whole, and a note says so."""
    assert _alone("learn_in_little(64 << 20)") == "fewer were kept"


def learn_in_little(more: int) -> str:
    """What a render came to that may take so many bytes more than a first small one."""
    mi.set_variant(SCALAR)
    scene = pssflow.Scene(room(256))
    how: dict[str, Any] = {"k": 24, "threads": 1, "progress": False, "memory_mib": 1}
    # What threads and libraries take once does not count.
    scene.render("table", 2, **how)
    with Path("/proc/self/statm").open(encoding="ascii") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + more, used + more))
    result = scene.render("table", 8, pilot_spp=4, **how)
    if not np.isfinite(result.image).all():
        return "not finite"
    kept = any("memory was short" in note for note in result.notes)
    return "fewer were kept" if kept else "it fitted"


@pytest.mark.long
@pytest.mark.timeout(0)
def test_soak(record: dict[str, Any]) -> None:
    """Renders of random cases, guides and options until the time is over: finite, and memory does not grow."""
    mi.set_variant(SCALAR)
    seconds = float(os.environ.get(SOAK, "1800"))
    rng = np.random.default_rng(7)
    names = ["none", "auto", "table", *registry()]
    scenes = [setting.scene for case in CASES.values() for setting in case.settings]
    start, renders, middle = time.perf_counter(), 0, 0
    # However short the time is, something is rendered before memory is looked at.
    while (elapsed := time.perf_counter() - start) < seconds or not middle:
        if not middle and renders > 0 and elapsed > seconds / 2:
            middle = _resident()
        name = names[rng.integers(len(names))]
        options = {
            "k": int(rng.integers(1, 5)),
            "emitter_strategy": ["mis", "nee", "auto"][rng.integers(3)],
            "parametrisation": ["bsdf", "cosine", "uniform"][rng.integers(3)],
            "combine": ["samples", "variance"][rng.integers(2)],
            "uniform_fraction": [None, 0.1, 0.5, 1.0][rng.integers(4)],
        }
        side = int(rng.integers(1, 40))
        scene = scenes[rng.integers(len(scenes))](side)
        result = pssflow.render(
            scene,
            name,
            int(rng.integers(2, 64)),
            seed=renders,
            progress=False,
            **options,
            **SHORT.get(name, {}),
        )
        assert np.isfinite(result.image).all(), (name, options)
        assert (result.image >= 0).all(), (name, options)
        renders += 1
    record["renders"] = float(renders)
    record["bytes"] = float(_resident() - middle)
    assert renders > 0
    assert record["bytes"] < 64 << 20
