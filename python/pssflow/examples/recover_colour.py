"""Inverse rendering by learned paths: `python -m pssflow.examples.recover_colour -o colour.png`.

A camera looks at a white wall. Beside it, out of sight, stands a coloured wall that a lamp shines on: what the camera
sees of its colour has been reflected twice. From such an image alone the colour is recovered by gradient descent, once
along learned paths and once along uniform ones, each for the same time; the chart shows the error of the colour over
time. Training is inside the time. In so small a scene with one large lamp uniform paths do well: look at the chart, not
at what one hopes for.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import click
import drjit as dr
import mitsuba as mi
import numpy as np

import pssflow  # noqa: F401  (registers the plugins)
from pssflow.files import write_beside
from pssflow.variants import ensure_variant

COLOUR = (0.8, 0.25, 0.1)
PARAMETER = "hidden.bsdf.reflectance.value"


def room(resolution: int) -> Any:
    """The scene. Set a variant first."""
    T = mi.ScalarTransform4f

    def diffuse(*rgb: float) -> dict[str, Any]:
        return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(rgb)}}

    film = {"type": "hdrfilm", "width": resolution, "height": resolution, "pixel_format": "rgb"}
    return mi.load_dict(
        {
            "type": "scene",
            "camera": {
                "type": "perspective",
                "fov": 30,
                "to_world": T().look_at(origin=[0, -3, 1], target=[0, 1, 1], up=[0, 0, 1]),
                "film": film | {"rfilter": {"type": "box"}},
            },
            "seen": {
                "type": "rectangle",
                "to_world": T().translate([0, 1, 1]).rotate([1, 0, 0], 90),
                "bsdf": diffuse(0.7, 0.7, 0.7),
            },
            "hidden": {
                "type": "rectangle",
                "to_world": T().translate([-1.5, 0, 1]).rotate([0, 1, 0], 90),
                "bsdf": diffuse(*COLOUR),
            },
            # Its back is to the white wall: that one gets no direct light from it.
            "lamp": {
                "type": "rectangle",
                "to_world": T().translate([1.5, 0, 2]).rotate([0, 1, 0], -110).scale(0.3),
                "bsdf": diffuse(0.0, 0.0, 0.0),
                "light": {"type": "area", "radiance": {"type": "rgb", "value": [20.0] * 3}},
            },
        }
    )


@dataclass
class Descent:
    """What one way of drawing paths came to."""

    guide: str
    seconds: list[float] = field(default_factory=list)
    loss: list[float] = field(default_factory=list)
    error: list[float] = field(default_factory=list)
    """Largest difference of a colour's component."""
    colour: tuple[float, ...] = ()


def recover(
    scene: Any,
    target: Any,
    guide: str,
    *,
    seconds: float,
    steps: int = 10_000,
    spp: int = 16,
    start: Sequence[float] = (0.5, 0.5, 0.5),
) -> Descent:
    """Descends for some seconds, or some steps if these come first; the scene has its own colour again afterwards."""
    integrator: Any = mi.load_dict({"type": "pssflow", "k": 2, "guide": guide})
    params = mi.traverse(scene)
    own = mi.Color3f(params[PARAMETER])
    optimizer = mi.ad.Adam(lr=0.03)
    optimizer[PARAMETER] = mi.Color3f(*start)
    params.update(optimizer)
    found = Descent(guide)
    begin = time.perf_counter()
    for step in range(steps):
        image: Any = mi.render(
            scene,
            params,
            integrator=integrator,
            spp=spp,
            seed=mi.UInt32(2 * step),
            seed_grad=2 * step + 1,
        )
        loss = dr.mean(dr.square(image - target), axis=None)
        dr.backward(loss)
        optimizer.step()
        optimizer[PARAMETER] = dr.clip(optimizer[PARAMETER], 0.01, 0.99)
        params.update(optimizer)
        colour = np.array(optimizer[PARAMETER]).ravel()
        found.seconds.append(time.perf_counter() - begin)
        found.loss.append(float(np.asarray(loss).ravel()[0]))
        found.error.append(float(np.abs(colour - np.array(COLOUR)).max()))
        found.colour = tuple(float(c) for c in colour)
        if found.seconds[-1] >= seconds:
            break
    params[PARAMETER] = own
    params.update()
    return found


def target_image(scene: Any, spp: int) -> Any:
    """What the camera sees, with another seed than any of the descent."""
    integrator: Any = mi.load_dict({"type": "pssflow", "k": 2, "guide": "none"})
    return mi.TensorXf(
        np.array(mi.render(scene, integrator=integrator, spp=spp, seed=mi.UInt32(987_654)))
    )


def chart(runs: Mapping[str, Descent], path: Path, seconds: float) -> None:
    """Writes error over time as PNG.

    Raises:
        OSError: it cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for (name, run), line in zip(runs.items(), ("-", "--", ":"), strict=False):
        axes.semilogy(run.seconds, run.error, line, label=f"{name}, {len(run.error)} steps")
    axes.set_xlabel("wall time (s)")
    axes.set_ylabel("largest error of the colour")
    axes.set_title(
        f"A colour seen by two bounces: {seconds:g} s each, training inside", fontsize=10
    )
    axes.legend()

    def write(part: Path) -> None:
        figure.savefig(part, format="png", dpi=120)

    write_beside(path, write)


@click.command()
@click.option("--seconds", type=float, default=30.0, show_default=True, help="Of each descent.")
@click.option("--resolution", type=click.IntRange(8, 1024), default=48, show_default=True)
@click.option("--spp", type=click.IntRange(2), default=16, show_default=True)
@click.option("--guide", default="table", show_default=True, help="Beside `none`.")
@click.option("-o", "--output", type=click.Path(path_type=Path), default="colour.png")
def main(seconds: float, resolution: int, spp: int, guide: str, output: Path) -> None:
    """Recover the colour of a wall that the camera does not see."""
    ensure_variant()
    if not (mi.variant() or "").startswith("llvm"):
        raise click.ClickException("gradients need the variant llvm_ad_rgb, and so libLLVM")
    scene = room(resolution)
    target = target_image(scene, 4096)
    runs = {
        name: recover(scene, target, name, seconds=seconds, spp=spp) for name in (guide, "none")
    }
    for name, run in runs.items():
        colour = ", ".join(f"{c:.3f}" for c in run.colour)
        click.echo(f"{name}: ({colour}) after {len(run.loss)} steps, error {run.error[-1]:.3f}")
    chart(runs, output, seconds)
    click.echo(f"wrote {output}")


if __name__ == "__main__":
    main()
