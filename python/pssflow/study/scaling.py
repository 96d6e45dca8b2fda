"""Time and memory against samples, pixels, bounces, triangles, emitters and threads: `make study-scaling`.

One number is varied at a time. Each point is a process of its own, so that its peak of memory is its own; within it the
render and its rays alone take turns, and medians are told. Where a path takes more time than it should (`RULES`), the
chart and the last lines of the output say so.

Writes scaling.csv, and scaling.png with its twin as SVG.
"""

from __future__ import annotations

import csv
import json
import os
import resource
import statistics
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import mitsuba as mi
import numpy as np

from ..files import write_beside
from ..output import make_folder
from ..scene import Scene
from ..terminal import Terminal, run_command
from .drawing import COLOURS, finish, new_figure, plain_ticks

RULES = {
    "spp": "a path costs the same for any number of samples",
    "pixels": "a path costs the same for any film",
    "k": "a path costs no more than in proportion to its rays",
    "triangles": "a path costs no more than in proportion to its rays",
    "emitters": "a path costs no more than in proportion to its rays",
    "threads": "a path costs no more than in proportion to its rays",
}
"""What is expected along each axis."""

SLACK = 1.3
"""Factor by which a point may miss its rule, against the axis' first point that is long enough to be timed."""

NAMES = {
    "us_per_path": "a path",
    "us_of_its_rays": "its rays alone",
    "peak_mib": "the process at its peak, beyond an idle one",
    "held_mib": "arrays, textures and BVH",
}
"""What is drawn."""

TIMED = 0.02
"""Seconds that a render must take to be judged."""


@dataclass(frozen=True)
class Case:
    """What is rendered at a point."""

    spp: int = 16
    side: int = 128
    k: int = 2
    triangles: int = 1000
    emitters: int = 1
    threads: int = 1


AXES: dict[str, tuple[str, Sequence[int]]] = {
    "spp": ("spp", (1, 4, 16, 64, 256)),
    "pixels": ("side", (32, 64, 128, 256, 512, 1024)),
    "k": ("k", (1, 2, 4, 8, 16, 32)),
    "triangles": ("triangles", (10**3, 10**4, 10**5, 10**6, 10**7)),
    "emitters": ("emitters", (1, 10, 100, 1000, 10_000)),
    "threads": ("threads", ()),
}
"""Field of `Case` and its values by axis; those of threads are of the machine."""


@click.command("scaling")
@click.option("-o", "--output", default="out/scaling", show_default=True, help="Folder.")
@click.option("--axes", default=",".join(AXES), show_default=True, help="Names, by commas.")
@click.option("--most", default=10**7, show_default=True, help="Largest value of any axis.")
@click.option("--rounds", default=5, show_default=True, type=click.IntRange(1))
@click.option("--one", hidden=True, help="A case to measure in this process, JSON.")
@click.pass_obj
def scaling(
    terminal: Terminal, output: str, axes: str, most: int, rounds: int, one: str | None
) -> None:
    """Measures how time and memory grow; writes scaling.csv and scaling.png."""
    if one is not None:
        terminal.out.print(json.dumps(measure(Case(**json.loads(one)), rounds)), soft_wrap=True)
        return
    unknown = [name for name in axes.split(",") if name not in AXES]
    if unknown:
        raise ValueError(f"there is no axis {unknown[0]!r}; there are {', '.join(AXES)}")
    folder = make_folder(output)
    rows: list[dict[str, Any]] = []
    path = folder / "scaling.csv"
    for axis in axes.split(","):
        field, values = AXES[axis]
        for value in values or threads():
            if value <= most:
                terminal.say(f"{axis}: {value}")
                rows.append({"axis": axis, "value": value} | _in_a_process({field: value}, rounds))
                # After each point, so that an interrupted run leaves a table, too.
                write_beside(path, lambda part: _write(part, rows))
    findings = [text for axis in axes.split(",") for text in judge(axis, rows)]
    draw(folder / "scaling", rows, axes.split(","), findings)
    for text in findings or ["nothing grows faster than it should"]:
        terminal.out.print(text, highlight=False)
    terminal.out.print(f"load average {os.getloadavg()[0]:.2f} (1 min); wrote {path}")


def threads() -> list[int]:
    """1, 2, 4, … and all cores."""
    cores = os.cpu_count() or 1
    return sorted({*(1 << i for i in range(cores.bit_length()) if 1 << i <= cores), cores})


def measure(case: Case, rounds: int) -> dict[str, Any]:
    """Times one case: µs per path, of its rays alone, seconds of preparations, MiB held and at the peak."""
    mi.set_variant("scalar_rgb")
    idle = _peak()
    scene = Scene(mi.load_dict(landscape(case)))
    took, alone = [], []
    rays = 0.0
    for measured in range(-1, rounds):
        result = scene.render("none", case.spp, k=case.k, threads=case.threads, progress=False)
        floor = scene.core.rays_alone(spp=case.spp, k=case.k, threads=case.threads)
        rays = floor["rays_per_path"]
        if measured >= 0:
            took.append(result.stats["seconds"]["render"])
            alone.append(floor["seconds"])
    paths = scene.width * scene.height * case.spp
    held = sum(scene.summary[f"{what}_bytes"] for what in ("geometry", "texture", "bvh"))
    return {
        "us_per_path": 1e6 * statistics.median(took) / paths,
        "us_of_its_rays": 1e6 * statistics.median(alone) / paths,
        "over_rays": statistics.median(a / b for a, b in zip(took, alone, strict=True)),
        "rays_per_path": rays,
        "render_s": statistics.median(took),
        **{f"{name}_s": scene.timings[name] for name in ("load", "export", "bvh")},
        "held_mib": held / 2**20,
        "peak_mib": (_peak() - idle) / 2**20,
        "load_average": os.getloadavg()[0],
    }


def landscape(case: Case) -> dict[str, Any]:
    """Hills of `triangles` triangles under `emitters` square lamps, as Mitsuba's dictionary."""
    side = max(round((case.triangles / 2) ** 0.5), 1) + 1
    x, y = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side))
    points = np.stack([x, y, 0.25 * np.sin(9 * x) * np.cos(7 * y)], axis=-1).reshape(-1, 3)
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).reshape(-1, 1)
    halves = np.array([[0, 1, side + 1], [0, side + 1, side]])
    faces = (corner + halves.reshape(1, -1)).reshape(-1, 3)
    mesh = mi.Mesh("hills", len(points), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = points.astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "hide_emitters": True},
        "hills": mesh,
        "sensor": {
            "type": "perspective",
            "fov": 50,
            "to_world": mi.ScalarTransform4f().look_at((0, -2.2, 1.6), (0, 0, 0), (0, 0, 1)),
            "film": {
                "type": "hdrfilm",
                "width": case.side,
                "height": case.side,
                "filter": {"type": "box"},
            },
        },
    }
    across = int(np.ceil(case.emitters**0.5))
    for i in range(case.emitters):
        at = ((np.array([i % across, i // across]) + 0.5) / across * 2 - 1).tolist()
        # Down from a ceiling that they would cover by a quarter together.
        place = mi.ScalarTransform4f().translate((*at, 1.5)).rotate((1, 0, 0), 180)
        scene[f"lamp{i}"] = {
            "type": "rectangle",
            "to_world": place.scale(0.5 / across),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0 + i % 3}},
        }
    return scene


def judge(axis: str, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Points of an axis that miss its rule, a line for each."""
    mine = [row for row in rows if row["axis"] == axis and row["render_s"] >= TIMED]
    # In units of the rays' own time, which holds what the scene's size does to caches, and what a busy machine does.
    key = "us_per_path" if axis in ("spp", "pixels") else "over_rays"
    return [
        f"{axis} = {row['value']}: {row[key] / mine[0][key]:.2f} times as much as at {mine[0]['value']}, though "
        f"{RULES[axis]}"
        for row in mine[1:]
        if row[key] > SLACK * mine[0][key]
    ]


def draw(
    path: Path, rows: Sequence[Mapping[str, Any]], axes: Sequence[str], findings: Sequence[str]
) -> None:
    """A column for each axis: time per path above, memory below."""
    figure = new_figure(2.6 * len(axes), 5.2)
    panels = figure.subplots(2, len(axes), squeeze=False)
    handles = {}
    for column, axis in enumerate(axes):
        mine = [row for row in rows if row["axis"] == axis]
        values = [row["value"] for row in mine]
        for line, keys in enumerate([("us_per_path", "us_of_its_rays"), ("peak_mib", "held_mib")]):
            panel = panels[line][column]
            for colour, key in zip(COLOURS[2 + 2 * line :], keys, strict=False):
                numbers = [max(row[key], 1e-3) for row in mine]
                (handles[key],) = panel.plot(values, numbers, "o-", color=colour, label=NAMES[key])
            panel.set_xscale("log")
            panel.set_yscale("log")
            panel.set_xlabel("side of the film" if axis == "pixels" else axis)
            plain_ticks(panel.xaxis)
            plain_ticks(panel.yaxis)
        if not column:
            panels[0][0].set_ylabel("µs per path")
            panels[1][0].set_ylabel("MiB")
    loads = [row["load_average"] for row in rows]
    caption = f"load average {min(loads):.1f} to {max(loads):.1f}; " + (
        "; ".join(findings) or "nothing grows faster than it should"
    )
    finish(figure, path, "Time of a path and memory", list(handles.values()), caption)


def _in_a_process(changed: Mapping[str, int], rounds: int) -> dict[str, Any]:
    command = [sys.executable, "-m", "pssflow.study.scaling", "--one", json.dumps(changed)]
    done = subprocess.run(
        [*command, "--rounds", str(rounds)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        lines = done.stderr.strip().splitlines() or ["no word"]
        raise RuntimeError(f"{dict(changed)}: {lines[-1]}")
    return json.loads(done.stdout)


def _write(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def _peak() -> int:
    """Largest resident size of this process so far, in bytes."""
    scale = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * scale


if __name__ == "__main__":
    sys.exit(run_command(scaling))
