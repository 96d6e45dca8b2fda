"""Charts and pictures of `pssflow study thesis`: crescent, losses, experiments, time by phase, renders with crops."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import metrics
from ..picture import Panel, Picture, Row
from ..reference import Reference, read_exr
from ..report import count, number, percent, reference_panel, scene_title
from .drawing import COLOURS, MARKERS, MUTED, finish, new_figure, plain_ticks
from .thesis_flow import CRESCENT_EPOCHS, CRESCENT_ROWS, crescent
from .thesis_scene import PHASES, ThesisRuns
from .thesis_tests import SPP, Found

__all__ = ["crescent_chart", "experiment_chart", "loss_chart", "phase_chart", "render_picture"]

RAMP = "cividis"
"""Colours of a place along the crescent: a ramp of lightness that colour-blind readers see as one."""


def crescent_chart(path: Path, value: Mapping[str, Any], prior: str, seed: int) -> list[Path]:
    """Crescent → latent numbers, latent numbers → crescent: four panels, each number with its colour in both."""
    from matplotlib.patches import Circle, Rectangle

    points, along = crescent(CRESCENT_ROWS, seed)
    latent, drawn, generated = (
        np.array(value[name], np.float64) for name in ("latent", "drawn", "generated")
    )
    colour = np.linalg.norm(drawn - (0.5 if prior == "hypercube" else 0.0), axis=1)
    figure = new_figure(11.2, 3.9)
    panels = (
        ("data", points, along, False),
        ("data → latent", latent, along, True),
        ("latent numbers of the prior", drawn, colour, True),
        ("latent → data", generated, colour, False),
    )
    far = max(3.2, float(np.quantile(np.abs(latent[np.isfinite(latent)]), 0.995)) * 1.05)
    for i, (title, xy, value_of, is_latent) in enumerate(panels):
        axes = figure.add_subplot(1, 4, i + 1)
        axes.scatter(*xy.T, c=value_of, cmap=RAMP, s=2.5, linewidths=0, rasterized=True)
        axes.set_title(title, fontsize=9.5)
        axes.set_aspect("equal")
        frame = {"fill": False, "edgecolor": "black", "linewidth": 0.9, "linestyle": "--"}
        if is_latent and prior == "gaussian":
            for radius in (1.0, 2.0, 3.0):
                axes.add_patch(Circle((0, 0), radius, **frame))
        else:
            axes.add_patch(Rectangle((0, 0), 1, 1, **frame))
        if is_latent and (prior == "gaussian" or i == 1):
            axes.set(xlim=(-far, far), ylim=(-far, far))
        elif not is_latent:
            # What was generated may lie anywhere.
            low, high = (float(np.quantile(xy, q)) for q in (0.005, 0.995))
            limits = (min(-0.25, 1.1 * low), max(1.25, 1.1 * high))
            axes.set(xlim=limits, ylim=limits)
        axes.set_xlabel("z₁" if is_latent else "u₁", fontsize=9)
        axes.set_ylabel("z₂" if is_latent else "u₂", fontsize=9)
        axes.tick_params(labelsize=7.5)
    shape = (
        "circles: one, two and three standard deviations"
        if prior == "gaussian"
        else "the square is all that the prior holds"
    )
    caption = (
        "Left pair: a colour is a place along the crescent. Right pair: a colour is the distance from the prior's "
        f"middle. Dashed: {shape}; of data the unit square. {percent(value['lost'])} of the crescent's numbers have "
        f"density 0; {percent(value['outside'])} of what is generated falls outside the unit square."
    )
    named = "Gaussian" if prior == "gaussian" else prior
    title = (
        f"A crescent learned by RealNVP, prior {named}: {count(CRESCENT_ROWS)} numbers, {CRESCENT_EPOCHS} epochs, "
        f"{count(value['parameters'])} parameters"
    )
    return finish(figure, path, title, [], caption)


def loss_chart(
    path: Path, scene: str, parametrisation: str, fits: Sequence[Mapping[str, Any]]
) -> list[Path]:
    """Training and held-out loss, over epochs for several numbers of paths, and over numbers of parameters."""
    from matplotlib.lines import Line2D

    figure = new_figure(9.0, 4.9)
    axes = figure.add_subplot(1, 2, 1)
    by_paths = [fit for fit in fits if fit["of"] == "paths"]
    handles = []
    for i, rows in enumerate(dict.fromkeys(fit["rows"] for fit in by_paths)):
        own = [fit for fit in by_paths if fit["rows"] == rows]
        look = {"color": COLOURS[i], "marker": MARKERS[i], "markersize": 4.5, "linewidth": 1.5}
        x = [fit["epochs"] for fit in own]
        axes.plot(x, [fit["held_out"] for fit in own], linestyle="-", **look)
        axes.plot(x, [fit["training"] for fit in own], linestyle="--", **look)
        trained = own[0]["trained_on"]
        handles.append(Line2D([], [], label=f"{count(trained)} paths", **look))
    axes.set_xlabel("epochs")
    axes.set_title("by number of paths", fontsize=10)
    own = sorted((f for f in fits if f["of"] == "parameters"), key=lambda fit: fit["parameters"])
    panels = [axes]
    look = {"color": "black", "marker": "o", "markersize": 4.5, "linewidth": 1.5}
    x = [fit["parameters"] for fit in own]
    if own:
        other = figure.add_subplot(1, 2, 2)
        panels.append(other)
        other.plot(x, [fit["held_out"] for fit in own], linestyle="-", **look)
        other.plot(x, [fit["training"] for fit in own], linestyle="--", **look)
        other.set_xlabel("parameters")
        about = f"{count(own[0]['trained_on'])} paths, {own[0]['epochs']} epochs"
        other.set_title(f"by number of parameters ({about})", fontsize=10)
    for each in panels:
        each.set_xscale("log")
        plain_ticks(each.xaxis)
        each.axhline(0.0, color=MUTED, linewidth=1, linestyle=":")
        each.grid(which="both", color="#e3e3e3", linewidth=0.5)
        each.set_axisbelow(True)
        each.tick_params(labelsize=8, which="both")
    axes.set_ylabel("mean −ln q (nats)")
    handles.append(Line2D([], [], color="black", linestyle="-", label="held-out paths"))
    handles.append(Line2D([], [], color="black", linestyle="--", label="training paths"))
    handles.append(Line2D([], [], color=MUTED, linestyle=":", label="loss of uniform numbers, 0"))
    caption = (
        "Both losses over paths in proportion to their largest component, as the thesis draws its training set. Where "
        "the held-out line turns up while the other falls, the flow learns its paths by heart. Above 0 it describes "
        "paths worse than no flow does."
    )
    title = (
        f"Training against held-out loss of the thesis' RealNVP: {scene_title(scene)}, direction numbers "
        f"{parametrisation}"
    )
    return finish(figure, path, title, handles, caption)


def experiment_chart(
    path: Path, scene: str, found: Sequence[Found], thesis: Mapping[str, float], seed: int
) -> list[Path]:
    """Learned ÷ random non-zero paths per camera ray, an experiment a line, a panel a parametrisation."""
    from matplotlib.lines import Line2D

    shown = list(dict.fromkeys(f.parametrisation for f in found))
    names = list(dict.fromkeys(f.experiment.name for f in found))
    figure = new_figure(3.4 * len(shown) + 3.0, 0.3 * len(names) + 2.1)
    for i, parametrisation in enumerate(shown):
        axes = figure.add_subplot(1, len(shown), i + 1)
        own = [f for f in found if f.parametrisation == parametrisation]
        for f in own:
            y = names.index(f.experiment.name)
            axes.plot([0.0, f.ratio], [y, y], color="#bbbbbb", linewidth=1)
            axes.plot(f.ratio, y, marker="o", color="black", markersize=6)
            axes.annotate(
                f"{f.ratio:.2f}",
                (f.ratio, y),
                (7, 0),
                textcoords="offset points",
                va="center",
                fontsize=8,
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8},
            )
        axes.axvline(1.0, color="black", linewidth=1)
        largest = max([f.ratio for f in own if np.isfinite(f.ratio)] or [1.0])
        if parametrisation in thesis:
            axes.axvline(thesis[parametrisation], color=COLOURS[3], linewidth=1.6, linestyle="--")
            largest = max(largest, thesis[parametrisation])
        axes.set_xlim(0.0, 1.15 * largest + 0.25)
        axes.set_ylim(len(names) - 0.5, -0.5)
        axes.set_yticks(range(len(names)), names if i == 0 else [])
        axes.tick_params(axis="y", length=0)
        axes.set_title(parametrisation, fontsize=10)
        axes.set_xlabel("non-zero paths per camera ray,\nlearned ÷ random", fontsize=8.5)
        axes.grid(axis="x", color="#e3e3e3", linewidth=0.5)
        axes.set_axisbelow(True)
    handles = [
        Line2D([], [], color="black", linewidth=0, marker="o", label="here"),
        Line2D([], [], color="black", linewidth=1, label="random numbers"),
    ]
    if any(name in thesis for name in shown):
        line = {"color": COLOURS[3], "linestyle": "--", "linewidth": 1.6}
        handles.append(Line2D([], [], label="the thesis", **line))
    title = (
        f"What would explain the thesis' ratio: {scene_title(scene)}, NEE, {SPP} spp drawn from the flow alone after a "
        f"pilot that is discarded, of {SPP} spp where a line says nothing else; seed {seed}"
    )
    return finish(figure, path, title, handles, "")


def phase_chart(path: Path, every: Sequence[ThesisRuns], seed: int) -> list[Path]:
    """Seconds by phase of the learned run beside random sampling for as long, with the error that each came to."""
    from matplotlib.patches import Patch

    looks = {"pilot": ("#56b4e9", "//"), "fit": ("#e69f00", ""), "render": ("#0072b2", "")}
    bars = [
        (f"{scene_title(runs.name)}, {parametrisation}", runs.of(parametrisation)[kind])
        for runs in every
        for parametrisation in runs.parametrisations
        for kind in ("learned", "random-time")
    ]
    figure = new_figure(9.0, 0.42 * len(bars) + 2.0)
    axes = figure.add_subplot(1, 1, 1)
    longest = max(run.seconds for _, run in bars)
    for y, (_, run) in enumerate(bars):
        left = 0.0
        for phase in PHASES:
            seconds = run.stats["seconds"][phase]
            colour, hatch = looks[phase]
            axes.barh(
                y, seconds, left=left, color=colour, hatch=hatch, edgecolor="white", height=0.7
            )
            left += seconds
        error = f"relMSE {number(run.stats['relmse'], 3)}, trimmed {number(run.stats['relmse_trimmed'], 3)}"
        axes.annotate(error, (left, y), (6, 0), textcoords="offset points", va="center", fontsize=8)
    labels = [
        f"{name}: {'learned' if i % 2 == 0 else 'random'}" for i, (name, _) in enumerate(bars)
    ]
    axes.set_yticks(range(len(bars)), labels, fontsize=8.5)
    axes.set_ylim(len(bars) - 0.4, -0.6)
    axes.set_xlim(0.0, 1.45 * longest)
    axes.set_xlabel("wall time used (s)")
    axes.grid(axis="x", color="#e3e3e3", linewidth=0.5)
    axes.set_axisbelow(True)
    handles = [
        Patch(facecolor=colour, hatch=hatch, edgecolor="white", label=name)
        for name, (colour, hatch) in zip(
            ("pilot, discarded", "training", "rendering"), looks.values(), strict=True
        )
    ]
    title = (
        "Time by phase of the thesis' method, and random sampling for the same time "
        f"(NEE, seed {seed})"
    )
    return finish(figure, path, title, handles, "")


def render_picture(path: Path, runs: ThesisRuns) -> Path:
    """All renders of a scene with highlighted crops: what the thesis' Figures 10 to 17 show."""
    rows = []
    for parametrisation in runs.parametrisations:
        own = runs.of(parametrisation)
        panels = [
            _panel(f"{parametrisation}: {run.kind.title}", run.image, run.stats, runs.truth)
            for run in own.values()
        ]
        rows.append(Row(panels, note=_note(runs, parametrisation)))
    heading = (
        f"{scene_title(runs.name)}, light of exactly 2 bounces, {runs.scene.width}×{runs.scene.height}: random and "
        "learned numbers"
    )
    caption = f"reference: {runs.truth.note}"
    Picture(heading, rows, reference_panel(runs.truth), caption).draw(path)
    return path


def _note(runs: ThesisRuns, parametrisation: str) -> str:
    """The thesis' measure in words, beside a row."""
    theirs = {} if runs.thesis is None else runs.thesis.per_ray
    lines = [
        parametrisation,
        "",
        "non-zero paths per camera ray,",
        "learned ÷ random:",
        f"  here {runs.ratio(parametrisation):.2f}",
    ]
    return "\n".join(
        lines + [f"  thesis {theirs[p]:.1f}" for p in [parametrisation] if p in theirs]
    )


def _panel(title: str, image: Path, stats: Mapping[str, Any], truth: Reference) -> Panel:
    shown = read_exr(image).image
    scale = metrics.local_scale(truth.image)
    return Panel(
        title=title,
        image=shown,
        lines=[
            stats["budget"],
            f"relMSE {number(stats['relmse'], 3)} (trimmed {number(stats['relmse_trimmed'], 3)})",
            f"non-zero {percent(stats['nonzero_share'])} of {count(stats['paths_found'])} paths found",
        ],
        error=np.mean((shown - truth.image) ** 2 / scale, axis=2),
    )
