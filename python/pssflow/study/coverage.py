"""Every scene that is there, beside Mitsuba: `make coverage` writes docs/coverage.md.

For each scene: does it load, what is in it, has random sampling Mitsuba's mean (`parity.py`), how fast are both
(`bench.py`), and how much of its light has two bounces. Each scene has a process of its own, so that its peak of
memory is its own and a failure is one row; what a process found is kept, and used again for the same commit and
settings. Needs the extra `test` (scipy).
"""

from __future__ import annotations

import json
import os
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import click
import drjit as dr
import mitsuba as mi
import numpy as np

from ..files import first_line, write_beside
from ..output import make_folder, write_json
from ..report import markdown_table
from ..scene import Scene
from ..terminal import Terminal, run_command
from . import parity
from .contest import (
    LLVM,
    OURS,
    RAYS_ALONE,
    SCALAR,
    Contestant,
    contestants,
    film_scale,
    loader,
    measure,
)
from .parity import BOUNCES, SIDE, Plan
from .store import commit
from .welch import ALPHA, LUMINANCE

TARGETS = {LLVM: 1.4, SCALAR: 3.0}
"""Paths per second of ours that are asked for, in Mitsuba's."""

TIMED_SIDE, TIMED_SPP, K = 256, 8, 2
"""Of timed images: the longer side in pixels, samples a pixel, bounces."""

LIGHT_SPP = 256
"""Of Mitsuba's images that tell the shares of light."""


@click.command("coverage")
@click.option("-o", "--output", default="docs/coverage.md", show_default=True, help="The table.")
@click.option("--work", default="out/coverage", show_default=True, help="What was found by scene.")
@click.option("--scenes", help="Names, by commas.  [default: all that are there]")
@click.option("--effort", default=1.0, show_default=True, help="Factor on the samples compared.")
@click.option("--rounds", default=5, show_default=True, type=click.IntRange(1), help="Timings.")
@click.option("--threads", default=1, show_default=True, type=click.IntRange(1), help="Timings.")
@click.option("--limit", default=240.0, show_default=True, help="Seconds a scene may take.")
@click.option("--fresh", is_flag=True, help="Use nothing that was found before.")
@click.option("--one", hidden=True, help="A scene to examine in this process.")
@click.pass_obj
def coverage(
    terminal: Terminal,
    output: str,
    work: str,
    scenes: str | None,
    effort: float,
    rounds: int,
    threads: int,
    limit: float,
    fresh: bool,
    one: str | None,
) -> None:
    """Compares all scenes with Mitsuba, by mean and by speed; writes a Markdown table."""
    plans = {plan.name: plan for plan in parity.all_plans()}
    settings = {"effort": effort, "rounds": rounds, "threads": threads, "commit": commit()}
    folder = make_folder(work)
    if one is not None:
        write_json(_record(folder, one), settings | examine(plans[one], effort, rounds, threads))
        return
    chosen = list(plans)
    if scenes is not None:
        chosen = scenes.split(",")
        unknown = [name for name in chosen if name not in plans]
        if unknown:
            raise ValueError(f"there is no scene {unknown[0]!r}; there are {', '.join(plans)}")
    elif parity.shared_folder():
        # Its other cameras see the same surfaces; --scenes names them.
        chosen = [name for name in chosen if "_cam" not in name]
    before, start = os.getloadavg(), time.perf_counter()
    rows = []
    for name in chosen:
        row = None if fresh else _found_before(_record(folder, name), settings)
        if row is None:
            terminal.say(f"{name}, at most {limit:g} s")
            row = _in_a_process(name, folder, settings, limit)
        rows.append({"scene": name} | row)
        state = {
            "command": " ".join(["python -m pssflow.study.coverage", *sys.argv[1:]]),
            "before": before,
            "after": os.getloadavg(),
            "seconds": time.perf_counter() - start,
        }
        # After each scene, so that an interrupted run leaves a table, too.
        text = document(rows, settings | state)
        write_beside(Path(output), lambda part, text=text: part.write_text(text, encoding="utf-8"))
    terminal.out.print(f"wrote {output}", highlight=False)


def examine(plan: Plan, effort: float, rounds: int, threads: int) -> dict[str, Any]:
    """Everything about one scene."""
    idle = _peak()
    mi.set_variant(SCALAR)
    timed = loader(plan.path, film_scale(plan.path, TIMED_SIDE))
    first = timed(SCALAR)
    found: dict[str, Any] = {
        "timings": first.timings,
        "peak_bytes": _peak() - idle,
        "held_bytes": sum(
            first.summary[f"{what}_bytes"] for what in ("geometry", "texture", "bvh")
        ),
        "triangles": first.summary["triangles"],
        "features": features(first),
        "notes": first.notes,
    }
    variants = [SCALAR, LLVM] if plan.variant == LLVM else [SCALAR]
    contest = contestants(timed, TIMED_SPP, K, threads, strategies=("mis",), variants=variants)
    pool = dr.thread_count()
    try:
        found["speed"] = speeds(contest, threads, rounds)
    finally:
        # Besides being slow, loading an EXR in a pool of one thread can wait for itself in Mitsuba.
        dr.set_thread_count(pool)

    scene = parity.load(plan)
    spp = max(round(plan.spp * effort), 1)
    reduced = replace(plan, spp=spp, most_runs=plan.runs)
    found["compared"] = {"spp": spp, "runs": plan.runs, "truth_factor": plan.truth_factor}
    found["parity"] = {}
    means = {}
    for k in BOUNCES:
        verdict = parity.compare_means(scene, reduced, k)
        truth, ours = verdict.images
        means[k] = float(ours.mean)
        found["parity"][k] = {
            "p": verdict.p,
            "tiles": verdict.tiles,
            "without_power": verdict.without_power,
            "ratio": float(ours.mean / truth.mean) if truth.mean else None,
            "ratio_se": float(np.sqrt(ours.variance + truth.variance) / truth.mean)
            if truth.mean
            else None,
        }
    reflected = _reflected(scene)
    found["shares"] = {k: means[k] / reflected for k in (1, 2)} if reflected > 0 else {}
    return found


def features(scene: Scene) -> dict[str, dict[str, int]]:
    """How often each plugin was met, by kind, from the export."""
    description = scene.exported.description
    shapes = [s for group in description["groups"] for s in group["shapes"]]
    counts: dict[str, dict[str, int]] = {}
    for kind, entries in {
        "shapes": description["shapes"] + shapes,
        "BSDFs": description["bsdfs"],
        "textures": [t for t in description["textures"] if t["type"] != "constant"],
        "emitters": description["emitters"],
        "camera": [description["sensor"]],
    }.items():
        names = sorted({entry["type"] for entry in entries})
        counts[kind] = {n: sum(entry["type"] == n for entry in entries) for n in names}
    return counts


def speeds(contest: Sequence[Contestant], threads: int, rounds: int) -> dict[str, float]:
    """Paths per second by contestant, and ours in Mitsuba's: medians of the rounds, and of their ratios."""
    rows = {row["contestant"]: row for row in measure({threads: list(contest)}, rounds)}
    ours = rows[OURS]
    found = {"ours": ours["paths_per_second"], "rays": rows[RAYS_ALONE]["paths_per_second"]}
    for variant in TARGETS:
        row = rows.get(f"Mitsuba {variant}")
        if row is not None:
            # Both ran in the same round, so that what slowed one slowed the other, too.
            ratios = np.array(row["seconds"]) / np.array(ours["seconds"])
            found[variant] = row["paths_per_second"]
            found[f"over {variant}"] = float(np.median(ratios))
    return found


def _reflected(scene: Scene) -> float:
    """Mean luminance of all light but emission that the camera sees directly, by Mitsuba."""
    mi.set_variant(scene.variant)
    means = []
    for depth in (-1, 1):
        path = mi.load_dict({"type": "path", "max_depth": depth})
        image = mi.render(scene.mi_scene, integrator=path, spp=LIGHT_SPP, seed=1)  # pyright: ignore[reportArgumentType]
        means.append(float(np.mean(np.array(image, np.float64)[..., :3] @ LUMINANCE)))
    return means[0] - means[1]


def _peak() -> int:
    """Largest resident size of this process so far, in bytes."""
    scale = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * scale


def _record(folder: Path, name: str) -> Path:
    """Where one scene's findings are kept."""
    return folder / f"{name.replace('/', '-')}.json"


def _found_before(path: Path, settings: Mapping[str, Any]) -> dict[str, Any] | None:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    same = all(found.get(name) == value for name, value in settings.items())
    return found if same and not settings["commit"].endswith("+") else None


def _in_a_process(
    name: str, folder: Path, settings: Mapping[str, Any], limit: float
) -> dict[str, Any]:
    command = [sys.executable, "-m", "pssflow.study.coverage", "--one", name, "--work", str(folder)]
    for option in ("effort", "rounds", "threads"):
        command += [f"--{option}", str(settings[option])]
    path = _record(folder, name)
    path.unlink(missing_ok=True)
    start = time.perf_counter()
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=limit)
    except subprocess.TimeoutExpired:
        return {"failed": f"not done after {limit:g} s"}
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if line.strip()]
        return {"failed": first_line(RuntimeError(lines[-1] if lines else "no word"))}
    seconds = time.perf_counter() - start
    return json.loads(path.read_text(encoding="utf-8")) | {"process_seconds": seconds}


# --- the document ----------------------------------------------------------------------------------------------------


def document(rows: Sequence[Mapping[str, Any]], state: Mapping[str, Any]) -> str:
    """The Markdown text of all rows."""
    done = [row for row in rows if "failed" not in row]
    parts = [
        "# Coverage",
        _header(state),
        "## The same light",
        _MEANS.format(alpha=ALPHA / 2, side=SIDE),
        markdown_table(_MEAN_HEADINGS, [_mean_row(row) for row in rows]),
        _verdicts(done),
        "## At what speed",
        _SPEEDS.format(k=K, depth=K + 1, side=TIMED_SIDE, spp=TIMED_SPP, **state),
        markdown_table(_SPEED_HEADINGS, [_speed_row(row) for row in done]),
        _targets(done),
        "## What is in them",
        markdown_table(["scene", *KINDS], [_feature_row(row) for row in done]),
    ]
    return "\n\n".join(parts) + "\n"


KINDS = ("shapes", "BSDFs", "textures", "emitters", "camera")

_MEANS = """\
Random sampling (strategy `mis`) beside Mitsuba's truth, the difference of two depths of `path`. p is the smaller one
of Welch's test of the image means and of the tiles (12², Holm's correction); below {alpha:g} the two differ. Films are
reduced to {side} pixels. Nothing is clipped. A tile whose largest sample holds more than a tenth of its sum is tested
as part of a tile of 24² or 48²; where that does not help it has no power, and is counted for k = 1, 2, 3. Loads:
Mitsuba + export + BVH, in `scalar_rgb`; memory: arrays and BVH that are held / the growth of the process' peak over all
of loading, Mitsuba's own copy with it. Shares are of the light that is not directly visible emission."""

_SPEEDS = """\
Million paths per second on {threads} thread(s), medians of {rounds} interleaved rounds; ratios are medians of the
rounds' ratios. Ours are paths of exactly {k} bounces; Mitsuba's `path` of depth {depth} gathers up to {k}. “Rays
alone” sends the rays of ours to Embree and does nothing else. Films of {side} pixels, {spp} spp. Thousands of
instances are unusable in Mitsuba's LLVM variants, hence the gap."""

_MEAN_HEADINGS = (
    *("scene", "triangles", "loads (s)", "memory (MB)"),
    *(f"p, k = {k}" for k in BOUNCES),
    *("ours ÷ truth, k = 2", "tiles without power", "two-bounce / direct share"),
)
_SPEED_HEADINGS = (
    *("scene", "ours", "rays alone", "Mitsuba llvm", "ours ÷ llvm (≥ 1.4)"),
    *("Mitsuba scalar", "ours ÷ scalar (≥ 3)"),
)


def _header(state: Mapping[str, Any]) -> str:
    before, after = state["before"][0], state["after"][0]
    flags = _cpu_flags()
    when = datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
    return (
        f"Written by `make coverage` (`{state['command'].strip()}`), {when}, commit {state['commit']}, in "
        f"{state['seconds'] / 60:.0f} min. Machine: {os.cpu_count()} cores, {platform.machine()} ({flags}), Mitsuba "
        f"{mi.__version__}; load average {before:.1f} before, {after:.1f} after (1 would be this run alone with one "
        f"thread). Samples compared: those of `study/parity.py` × {state['effort']:g}, 16 seeds a side."
    )


def _cpu_flags() -> str:
    """The vector extensions that matter."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return "flags unknown"
    line = next((line for line in text.splitlines() if line.startswith("flags")), "")
    known = ("sse4_2", "avx", "avx2", "fma", "avx512f", "avx512bw", "avx512vl")
    return ", ".join(flag for flag in known if flag in line.split()) or "flags unknown"


def _mean_row(row: Mapping[str, Any]) -> list[str]:
    if "failed" in row:
        return [row["scene"], f"**{row['failed']}**", *[""] * 8]
    t, by_k = row["timings"], {int(k): v for k, v in row["parity"].items()}
    shares = {int(k): v for k, v in row["shares"].items()}
    ratio = by_k[2]["ratio"]
    return [
        row["scene"],
        f"{row['triangles']:,}",
        f"{t['load']:.1f} + {t['export']:.1f} + {t['bvh']:.1f}",
        f"{row['held_bytes'] / 1e6:.0f} / {row['peak_bytes'] / 1e6:.0f}",
        *(_p(by_k[k]["p"]) for k in BOUNCES),
        "–" if ratio is None else f"{ratio:.4f} ± {by_k[2]['ratio_se']:.4f}",
        " ".join(str(by_k[k]["without_power"]) for k in BOUNCES) + f" of {by_k[2]['tiles']}",
        f"{shares[2]:.3f} / {shares[1]:.3f}" if shares else "–",
    ]


def _p(p: float | None) -> str:
    if p is None:
        return "no power"
    return f"{p:.2g}" if p > ALPHA / 2 else f"**{p:.1g}**"


def _verdicts(rows: Sequence[Mapping[str, Any]]) -> str:
    """How many of all comparisons agree, and how many tiles say nothing."""
    tests = [test for row in rows for test in row["parity"].values()]
    known = [test for test in tests if test["p"] is not None]
    agree = sum(test["p"] > ALPHA / 2 for test in known)
    silent, tiles = (sum(test[name] for test in tests) for name in ("without_power", "tiles"))
    return (
        f"{agree} of {len(known)} comparisons agree, {len(tests) - len(known)} have no power at all; "
        f"{silent} of {tiles} tiles have none."
    )


def _speed_row(row: Mapping[str, Any]) -> list[str]:
    speed = row["speed"]
    cells = [row["scene"], f"{speed['ours'] / 1e6:.2f}", f"{speed['rays'] / 1e6:.2f}"]
    for variant, target in TARGETS.items():
        if variant in speed:
            ratio = speed[f"over {variant}"]
            cells += [f"{speed[variant] / 1e6:.2f}", f"{ratio:.2f}{_mark(ratio, target)}"]
        else:
            cells += ["–", "–"]
    return cells


def _mark(ratio: float, target: float) -> str:
    return " ✓" if ratio >= target else ""


def _targets(rows: Sequence[Mapping[str, Any]]) -> str:
    """How often each target was met."""
    sentences = []
    for variant, target in TARGETS.items():
        ratios = [row["speed"][f"over {variant}"] for row in rows if variant in row["speed"]]
        if ratios:
            met, faster = sum(r >= target for r in ratios), sum(r >= 1 for r in ratios)
            mean = float(np.exp(np.mean(np.log(ratios))))
            sentences.append(
                f"Against `{variant}` the target of {target:g} is met on {met} of {len(ratios)} scenes (✓), ours is "
                f"the faster one on {faster}; geometric mean {mean:.2f}."
            )
    return " ".join(sentences)


def _feature_row(row: Mapping[str, Any]) -> list[str]:
    return [
        row["scene"],
        *(
            ", ".join(
                f"{n:,} {name}" if n > 1 else name for name, n in row["features"][kind].items()
            )
            for kind in KINDS
        ),
    ]


if __name__ == "__main__":
    sys.exit(run_command(coverage))
