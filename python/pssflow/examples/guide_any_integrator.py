"""Learned numbers for integrators that know nothing of them: `python -m pssflow.examples.guide_any_integrator`.

Renders a scene with several of Mitsuba's integrators and with one of our own, ambient occlusion, and with `pss_guided`
around each, and prints what the guide came to: the variance of a uniform sample over that of a guided one. It has no
unit, is above 1 where the guide helps, and leaves out what guiding costs in time, which stands beside it. `none` says
that the guide saw nothing to gain.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import click
import drjit as dr
import mitsuba as mi
import numpy as np
from rich.console import Console
from rich.table import Table

import pssflow  # noqa: F401  (registers the plugins)
from pssflow.scene import load_scene, resize_film
from pssflow.variants import ensure_variant

INTEGRATORS: dict[str, dict[str, Any]] = {
    "path": {"type": "path", "max_depth": 4, "rr_depth": 100},
    "direct": {"type": "direct"},
    "prb_basic": {"type": "prb_basic", "max_depth": 4},
    "ambient": {"type": "pssflow_example_ambient"},
}


def register_ambient() -> None:
    """Makes the integrator of this example known to the active variant."""
    integrator = define_ambient()
    mi.register_integrator("pssflow_example_ambient", lambda props: integrator(props))


def define_ambient() -> Any:
    """Ambient occlusion within a radius of one unit, of the active variant."""

    class Ambient(mi.SamplingIntegrator):
        """Two numbers a path: a direction at x₁."""

        def sample(
            self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True
        ) -> tuple[Any, Any, list[Any]]:
            """1 where nothing is near in a cosine-distributed direction."""
            del medium
            si = scene.ray_intersect(ray, active)
            valid = active & si.is_valid()
            local = mi.warp.square_to_cosine_hemisphere(sampler.next_2d(valid))
            local.z *= dr.sign(si.wi.z)
            away = si.spawn_ray(si.to_world(local))
            away.maxt = 1.0
            free = valid & ~scene.ray_test(away, valid)
            return mi.Spectrum(dr.select(free, 1.0, 0.0)), valid, []

    return Ambient


def compare(scene: Any, spp: int, dimensions: int, seed: int = 0) -> list[dict[str, Any]]:
    """Renders with each integrator alone and guided; one record each."""
    register_ambient()
    records = []
    for name, nested in INTEGRATORS.items():
        plain, plain_s = _timed(scene, nested, spp, seed)
        guided: Any = mi.load_dict(
            {"type": "pss_guided", "dimensions": dimensions, "nested": nested}
        )
        start = time.perf_counter()
        image = np.array(mi.render(scene, integrator=guided, spp=spp, seed=mi.UInt32(seed + 1)))
        seconds = time.perf_counter() - start
        records.append(
            {
                "integrator": name,
                **guided.stats,
                "mean": (float(plain.mean()), float(image.mean())),
                "seconds": (plain_s, seconds),
            }
        )
    return records


def _timed(scene: Any, integrator: dict[str, Any], spp: int, seed: int) -> tuple[Any, float]:
    loaded: Any = mi.load_dict(integrator)
    start = time.perf_counter()
    image = np.array(mi.render(scene, integrator=loaded, spp=spp, seed=mi.UInt32(seed)))
    return image, time.perf_counter() - start


@click.command()
@click.argument("scene", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--size", nargs=2, type=int, default=(64, 64), show_default=True, help="Pixels.")
@click.option("--spp", type=click.IntRange(2), default=64, show_default=True)
@click.option("--dimensions", type=click.IntRange(2, 64), default=12, show_default=True)
def main(scene: Path, size: tuple[int, int], spp: int, dimensions: int) -> None:
    """Guide `path`, `direct`, `prb_basic` and an integrator of our own in SCENE, an XML file."""
    ensure_variant()
    loaded, _ = load_scene(scene, [])
    resize_film(loaded, 0, size, None)
    shown = Table(title=f"{scene}: {size[0]}×{size[1]}, {spp} spp, pilot inside")
    for heading in (
        "integrator",
        "guide",
        "a",
        "mean alone",
        "mean guided",
        "gain",
        "s alone",
        "s guided",
    ):
        shown.add_column(heading)
    for record in compare(loaded, spp, dimensions):
        gain = record["gain"]
        shown.add_row(
            record["integrator"],
            record["chosen"],
            f"{record['a']:g}",
            *(f"{mean:.5g}" for mean in record["mean"]),
            "" if gain is None else f"{gain:.2f}",
            *(f"{seconds:.2f}" for seconds in record["seconds"]),
        )
    Console().print(shown)


if __name__ == "__main__":
    main()
