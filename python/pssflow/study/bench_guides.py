"""What guides cost: in their kernels, and in whole paths."""

from __future__ import annotations

import importlib.util
import json
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..guide import Guide, registry
from ..scene import Scene

GUIDES = (
    "realnvp",
    "realnvp-logit",
    "direction-table",
    "emitter-table",
    "light-table",
    "ray-table",
    "table",
    "vegas",
    "spline-net",
    "mixture-net",
)

PILOT_SPP = 32
"""Samples a pixel that guides are fitted to, half of them uniform."""

PEER_ROWS = 1 << 14
"""Samples that guides of other makes are asked for."""


def kernels(program: str, rows: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Runs the Rust program `guide_cost` and returns what it found.

    Raises:
        RuntimeError: it cannot be run, or failed.
    """
    with tempfile.TemporaryDirectory(prefix="pssflow-") as folder:
        found = Path(folder) / "kernels.json"
        say(f"kernels and training by {program}: some minutes")
        try:
            subprocess.run(
                [program, "--json", str(found), "--rows", str(rows)],
                check=True,
                capture_output=True,
                text=True,
            )
        except OSError as error:
            raise RuntimeError(
                f"{program}: cannot be run ({error.strerror}); build it with `cargo build --release -p pss-guide "
                "--example guide_cost`"
            ) from None
        except subprocess.CalledProcessError as error:
            lines = error.stderr.strip().splitlines() or ["no word"]
            raise RuntimeError(f"{program} failed: {lines[-1]}") from None
        if not found.is_file():
            raise RuntimeError(f"{program} wrote no figures; it is another program, or an old one")
        return json.loads(found.read_text(encoding="utf-8"))


def added(scene: Scene, k: int, spp: int, rounds: int) -> dict[str, dict[str, float]]:
    """What each guide adds to a path on one thread: µs, and as a share of a uniform path's time.

    Guided and uniform renders take turns; medians of the rounds' differences. What guided paths cost more since they
    survive longer is in it.
    """
    fitted: dict[str, Guide] = {}
    for name in GUIDES:
        short = {"epochs": 1} if "epochs" in registry().get(name, {}).get("options", {}) else {}
        result = scene.render(name, PILOT_SPP, k=k, progress=False, **short)
        if isinstance(result.guide, Guide):  # Few paths may end in `none`.
            fitted[name] = result.guide
    paths = scene.width * scene.height * spp

    def seconds(guide: Guide | str) -> float:
        return scene.render(guide, spp, k=k, threads=1, progress=False).stats["seconds"]["render"]

    uniform, guided = [], {name: [] for name in fitted}
    for measured in range(-1, rounds):
        once = seconds("none")
        took = {name: seconds(guide) for name, guide in fitted.items()}
        if measured >= 0:
            uniform.append(once)
            for name, time_of in took.items():
                guided[name].append(time_of)
    found = {}
    for name, times in guided.items():
        pairs = list(zip(times, uniform, strict=True))
        found[name] = {
            "us": 1e6 * statistics.median(a - b for a, b in pairs) / paths,
            "share": statistics.median(a / b for a, b in pairs) - 1,
        }
    return found


def peers() -> dict[str, float]:
    """µs per sample with its density of guides of other makes that are installed: Lepage's `vegas`."""
    if importlib.util.find_spec("vegas") is None:
        return {}
    import vegas

    dims = 5
    grid = vegas.AdaptiveMap([[0.0, 1.0]] * dims, ninc=50)
    y = np.random.default_rng(1).random((PEER_ROWS, dims))
    x, jacobian = np.empty_like(y), np.empty(PEER_ROWS)
    times = []
    for _ in range(9):
        start = time.perf_counter()
        grid.map(y, x, jacobian)
        times.append(time.perf_counter() - start)
    return {f"vegas {vegas.__version__}": 1e6 * statistics.median(times) / PEER_ROWS}
