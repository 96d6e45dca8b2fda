"""A strip of images of growing path length: `python -m pssflow.examples.path_lengths SCENE -o strip.png`.

One render of the whole light up to a depth; each panel is what paths of one length add to it, the last one all of it
together. All are shown under one exposure, so that one sees how fast light fades.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

import pssflow
from pssflow.files import write_beside
from pssflow.picture import display, exposure_of

NAMES = {0: "emission", 1: "direct light"}


def draw(result: pssflow.Result, path: Path) -> None:
    """Writes the strip of a render with `max_depth` as PNG.

    Raises:
        OSError: it cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    whole = sum(result.stats["mean"]) or 1.0
    panels = [
        (NAMES.get(k, f"{k} bounces"), part.image, sum(part.stats["mean"]) / whole)
        for part in result.parts
        for k in [part.stats["k"]]
    ]
    panels.append((f"depth {result.stats['max_depth']}", result.image, 1.0))
    height, width = result.image.shape[:2]
    figure = Figure(figsize=(2.6 * len(panels), 2.6 * height / width + 0.6), layout="constrained")
    FigureCanvasAgg(figure)
    exposure = exposure_of(result.image)
    for axes, (title, image, share) in zip(
        figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True
    ):
        axes.imshow(display(image, exposure), interpolation="nearest")
        axes.set_title(f"{title}: {share:.1%} of the light", fontsize=9)
        axes.set_axis_off()
    figure.suptitle(f"{result.stats['scene']}, {result.stats['budget']}", fontsize=9)

    def write(part: Path) -> None:
        figure.savefig(part, format="png", dpi=120)

    write_beside(path, write)


@click.command()
@click.argument("scene", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--max-depth", type=click.IntRange(1, 33), default=5, show_default=True)
@click.option("--spp", type=click.IntRange(1), default=64, show_default=True)
@click.option("--size", nargs=2, type=int, default=(160, 120), show_default=True, help="Pixels.")
@click.option("-o", "--output", type=click.Path(path_type=Path), default="strip.png")
def main(scene: Path, max_depth: int, spp: int, size: tuple[int, int], output: Path) -> None:
    """Draw the light of SCENE, an XML file, length by length."""
    ours: Any = pssflow.Scene(scene, size=size)
    draw(pssflow.render(ours, spp=spp, max_depth=max_depth), output)
    click.echo(f"wrote {output}")


if __name__ == "__main__":
    main()
