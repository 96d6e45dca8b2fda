"""What everything costs: `make bench` writes out/bench.json and prints it as tables.

Scenes: paths per second beside the rays alone and beside Mitsuba (`contest`). Guides: their kernels, beside candle and
the most that a core multiplies (the Rust program `guide_cost`), what each adds to a path, and the cost ratio that
`auto` takes for it under `--spp`. Everything takes turns; medians are told, with the load of the machine.
"""

from __future__ import annotations

import math
import os
import platform
import re
import statistics
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click
import drjit as dr
import mitsuba as mi
from rich.table import Table

from .. import _core
from ..guide import aliases
from ..output import make_folder, write_json
from ..scene import Scene
from ..terminal import Terminal, run_command
from ..variants import llvm_problem
from . import parity
from .bench_guides import GUIDES, added, kernels, peers
from .contest import LLVM, OURS, RAYS_ALONE, SCALAR, contestants, film_scale, loader, measure

THREADS = (1, 2)

SIGNS = {"counted": "", "about": "≈ ", "upper bound": "≤ "}
"""What stands before rays per path that are not counted."""


@click.command("bench")
@click.option("-o", "--output", default="out", show_default=True, help="Folder for bench.json.")
@click.option("--scenes", help="Names, by commas.  [default: two of our own, all third-party ones]")
@click.option("--guided", default="scenes/cornell-box", show_default=True, help="Where guides are.")
@click.option("--spp", default=16, show_default=True, type=click.IntRange(1))
@click.option("--rounds", default=5, show_default=True, type=click.IntRange(1))
@click.option("--side", default=256, show_default=True, help="Longer side of films, in pixels.")
@click.option("-k", "--bounces", "k", default=2, show_default=True, type=click.IntRange(1, 32))
@click.option("--kernels", "program", help="The built program guide_cost; without it no kernels.")
@click.option("--rows", default=100_000, show_default=True, help="Paths of a training epoch.")
@click.pass_obj
def bench(
    terminal: Terminal,
    output: str,
    scenes: str | None,
    guided: str,
    spp: int,
    rounds: int,
    side: int,
    k: int,
    program: str | None,
    rows: int,
) -> None:
    """Measures what paths and guides cost; writes bench.json."""
    console = terminal.out
    target = make_folder(output) / "bench.json"
    plans = {plan.name: plan for plan in parity.all_plans()}
    names = scenes.split(",") if scenes else usual_scenes(plans)
    for name in [*names, guided]:
        if name not in plans:
            raise ValueError(f"there is no scene {name!r}; there are {', '.join(plans)}")
    before = os.getloadavg()
    console.print(
        f"{processor()}, {os.cpu_count()} cores, load average {before[0]:.2f} (1 min) before the "
        f"start; {spp} spp, k = {k}, films of {side} pixels, medians of {rounds} interleaved "
        "rounds, warm-up and compilation not measured"
    )
    problem = llvm_problem()
    if problem:
        console.print(f"without {LLVM}: {problem}")
    record: dict[str, Any] = {
        "machine": {
            "processor": processor(),
            "architecture": platform.machine(),
            "cores": os.cpu_count(),
            "pssflow": _core.__version__,
            "mitsuba": mi.__version__,
        },
        "settings": {"spp": spp, "k": k, "side": side, "rounds": rounds},
        "peak": None,
        "rays": {},
        "mitsuba": {SCALAR: {}, LLVM: {}},
        "scenes": {},
        "guides": {name: {} for name in GUIDES},
        "training": None,
    }
    thread_count = dr.thread_count()
    try:
        for name in names:
            _add_scene(record, name, plans[name], spp, k, rounds, side, console)
        mi.set_variant(SCALAR)
        path = plans[guided].path
        scene = Scene(path, scale=film_scale(path, side))
    finally:
        dr.set_thread_count(thread_count)
    record["geometric_means"] = means = geometric_means(record["scenes"])
    console.print(_said(means))
    costs = kernels(program, rows, terminal.say) if program else {}
    record["peak"], record["training"] = costs.get("peak"), costs.get("training")
    for name, cost in added(scene, k, spp, rounds).items():
        fused = costs.get("guides", {}).get(name, {})
        record["guides"][name] = fused | {"added": cost | {"scene": guided}}
    _add_table(record["guides"])
    console.print(guide_table(record["guides"], guided, record["peak"]))
    if record["training"]:
        console.print(training_table(record["training"]))
    else:
        console.print("without kernels and training: --kernels names no program")
    record["peers"] = peers()
    for name, micros in record["peers"].items():
        console.print(f"{name}: {micros:.2f} µs per sample of 5 numbers", highlight=False)
    after = os.getloadavg()
    record["machine"]["load_average"] = {"before": before, "after": after}
    console.print(
        f"load average {after[0]:.2f} (1 min) at the end\n“rays” are sent to Embree per path; for Mitsuba an upper "
        "bound (shadow rays towards emitters that face away are not sent). Mitsuba's path of depth "
        f"{k + 1} gathers the light of up to {k} bounces, ours that of exactly {k}: compare Mrays/s.",
        highlight=False,
    )
    write_json(target, record)
    console.print(f"wrote {target}")


def usual_scenes(plans: Mapping[str, parity.Plan]) -> list[str]:
    """Two of our own, and the third-party ones that are there, each by its first camera."""
    own = ["scenes/cornell-box", "scenes/teapot"]
    return own + [name for name in plans if "/" not in name and "_cam" not in name]


def processor() -> str:
    """The processor's name, where the system tells it."""
    try:
        found = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.M)
    except OSError:
        found = None
    return found[1] if found else platform.processor() or platform.machine()


def ratios(rows: Sequence[Mapping[str, Any]], threads: int) -> dict[str, float]:
    """A scene's time in its rays', and Mitsuba's in ours: medians of the rounds' ratios."""
    times = {row["contestant"]: row["seconds"] for row in rows if row["threads"] == threads}

    def ratio(above: str, below: str) -> float:
        return statistics.median(a / b for a, b in zip(times[above], times[below], strict=True))

    found = {"over_rays": ratio(OURS, RAYS_ALONE)}
    for variant in (SCALAR, LLVM):
        if f"Mitsuba {variant}" in times:
            found[f"{variant}_over_ours"] = ratio(f"Mitsuba {variant}", OURS)
    return found


def geometric_means(scenes: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Of every ratio over all scenes that have it, by number of threads."""
    means: dict[str, dict[str, float]] = {}
    for threads in map(str, THREADS):
        told = [scene[threads]["ratios"] for scene in scenes.values()]
        for name in {name for ratios in told for name in ratios}:
            values = [ratios[name] for ratios in told if name in ratios]
            mean = math.exp(statistics.fmean(map(math.log, values)))
            means.setdefault(threads, {})[name] = mean
    return means


def scaling(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """How much faster each contestant is on two threads than on one: medians of the rounds' ratios."""
    times = {(row["contestant"], row["threads"]): row["seconds"] for row in rows}
    one, two = THREADS
    return {
        name: statistics.median(a / b for a, b in zip(seconds, times[name, two], strict=True))
        for (name, threads), seconds in times.items()
        if threads == one
    }


def _add_scene(
    record: dict[str, Any],
    name: str,
    plan: parity.Plan,
    spp: int,
    k: int,
    rounds: int,
    side: int,
    console: Any,
) -> None:
    """Measures a scene, prints its table and files its rows."""
    start = time.perf_counter()
    mi.set_variant(SCALAR)
    load = loader(plan.path, film_scale(plan.path, side))
    variants = [SCALAR, LLVM] if plan.variant == LLVM else [SCALAR]
    contests = {n: contestants(load, spp, k, n, variants=variants) for n in THREADS}
    rows = measure(contests, rounds)
    told: dict[str, Any] = {"scaling": scaling(rows)}
    for threads in THREADS:
        mine = [row for row in rows if row["threads"] == threads]
        told[str(threads)] = {"ratios": ratios(mine, threads)}
        for row in mine:
            numbers = {key: row[key] for key in row if key not in ("contestant", "threads")}
            told[str(threads)][row["contestant"]] = numbers
            if row["contestant"] == RAYS_ALONE:
                record["rays"].setdefault(name, {})[str(threads)] = numbers
            for variant in variants:
                if row["contestant"] == f"Mitsuba {variant}":
                    record["mitsuba"][variant].setdefault(name, {})[str(threads)] = numbers
    told["seconds"] = time.perf_counter() - start
    record["scenes"][name] = told
    console.print(scene_table(name, rows))
    console.print(_said({n: told[n]["ratios"] for n in map(str, THREADS)}), highlight=False)


def _add_table(guides: dict[str, Any]) -> None:
    """What `auto` takes for `table`: the sum over its parts."""
    names = aliases()["table"].split("+")
    parts = [guides[name].get("cost_ratio_of_the_registry") for name in names]
    if all(part is not None for part in parts):
        guides["table"]["cost_ratio_of_the_registry"] = sum(parts)


def _said(ratios: Mapping[str, Mapping[str, float]]) -> str:
    """Ratios in words, a line for each number of threads."""
    words = {
        "over_rays": "{:.2f} × the time of its rays",
        f"{SCALAR}_over_ours": f"{{:.2f}} × as fast as {SCALAR}",
        f"{LLVM}_over_ours": f"{{:.2f}} × as fast as {LLVM}",
    }
    lines = []
    for threads, told in ratios.items():
        parts = [text.format(told[key]) for key, text in words.items() if key in told]
        lines.append(f"{threads} thread{'s' * (threads != '1')}: {', '.join(parts)}")
    return "\n".join(lines)


def scene_table(name: str, rows: Sequence[Mapping[str, Any]]) -> Table:
    """One scene's rows."""
    shown = Table(title=name, title_justify="left")
    shown.add_column("")
    for heading in ("threads", "Mpaths/s", "µs/path", "rays/path", "Mrays/s", "spread"):
        shown.add_column(heading, justify="right")
    for i, row in enumerate(rows):
        times = row["seconds"]
        spread = (max(times) - min(times)) / statistics.median(times)
        shown.add_row(
            row["contestant"],
            str(row["threads"]),
            f"{row['paths_per_second'] / 1e6:.2f}",
            f"{row['us_per_path']:.3f}",
            f"{SIGNS[row['rays']]}{row['rays_per_path']:.2f}",
            f"{row['mrays_per_second']:.1f}",
            f"±{50 * spread:.0f} %",
            end_section=i + 1 < len(rows) and rows[i + 1]["threads"] != row["threads"],
        )
    return shown


def guide_table(guides: Mapping[str, Any], scene: str, peak: Mapping[str, Any] | None) -> Table:
    """What guides cost, in their kernels and in whole paths."""
    title = f"guides; paths of {scene}, one thread"
    if peak:
        title += f"; {peak['instructions']}, a core's peak {peak['gflops_per_core']:.0f} GFLOP/s"
    shown = Table(title=title, title_justify="left")
    shown.add_column("")
    for heading in (
        *("sample [µs]", "density [µs]", "of the peak", "candle [µs]", "candle ÷ fused"),
        *("added to a path [µs]", "as a share", "auto takes"),
    ):
        shown.add_column(heading, justify="right")
    for name, row in guides.items():
        cost = row.get("added") or {}
        shown.add_row(
            name,
            _number(row.get("sample_us"), ".3f"),
            _number(row.get("density_us"), ".3f"),
            _number(row.get("sample_share_of_peak"), ".0%"),
            _number(row.get("candle_sample_us"), ".2f"),
            _number(row.get("candle_sample_over_fused"), ".1f"),
            _number(cost.get("us"), ".3f"),
            _number(cost.get("share"), ".0%"),
            _number(row.get("cost_ratio_of_the_registry"), ".0%"),
        )
    return shown


def training_table(training: Mapping[str, Any]) -> Table:
    """Seconds of an epoch."""
    shown = Table(title=f"an epoch of {training['rows']} paths", title_justify="left")
    shown.add_column("")
    for heading in ("1 thread [s]", "its processor [s]", "2 threads [s]", "scaling"):
        shown.add_column(heading, justify="right")
    for name, row in training.items():
        if name != "rows":
            keys = ("1", "1_processor", "2", "scaling")
            shown.add_row(name, *(_number(row[key], ".3f") for key in keys))
    return shown


def _number(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


if __name__ == "__main__":
    sys.exit(run_command(bench))
