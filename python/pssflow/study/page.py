"""report.html of a study: tables, charts and an image viewer in one file that opens from disk without a network.

Images and charts lie in the page as data URIs. The viewer shows, scene by scene, what each method had: the image under
one exposure, or its error in false colours (relMSE's squared relative error of a pixel, on a logarithmic scale).
"""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .. import __version__, metrics
from ..files import write_beside
from ..picture import display, exposure_of
from ..reference import Reference, read_exr
from ..report import count, number, scene_title
from .store import Row

if TYPE_CHECKING:
    from .harness import Study

__all__ = ["ERROR_RANGE", "Chart", "write_page"]

ERROR_RANGE = (-4.0, 1.0)
"""Decades of the false colours: relative squared errors of 1e-4 … 10."""

LEVELS = 64
"""Of an error map: what the eye tells apart, at a third of the bytes of 256."""

MOST_PIXELS = 12_000_000
"""Above this sum over all images a page holds those of the longest time only: browsers take 50 MB, not 500."""


@dataclass(frozen=True)
class Chart:
    """A chart on the page."""

    path: Path
    """An SVG."""
    title: str
    first: bool = False
    """Whether it is open at once."""


def write_page(
    study: Study,
    rows: Sequence[Row],
    title: str,
    sheets: Sequence[Any],
    charts: Sequence[Chart],
    lines: Sequence[str],
    notes: str,
) -> Path:
    """Writes report.html into the study's folder.

    Args:
        study: whose images are shown.
        rows: of times at which there was an image.
        title: what was measured.
        sheets: tables, `study.report.Sheet`.
        charts: in order.
        lines: findings, one a paragraph; those that begin with "BIASED?" stand out.
        notes: how to read the tables.

    Raises:
        OSError: it cannot be written.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("pssflow.study"), autoescape=True, undefined=StrictUndefined
    )
    text = environment.get_template("report.html.j2").render(
        title=title,
        version=__version__,
        sheets=sheets,
        charts=[
            {
                "title": chart.title,
                "first": chart.first,
                "uri": _uri(chart.path.read_bytes(), "svg+xml"),
            }
            for chart in charts
        ],
        lines=lines,
        notes=notes,
        viewer={"scenes": _scenes(study, rows), "colours": _colours(), "range": ERROR_RANGE},
    )
    path = study.folder / "report.html"
    write_beside(path, lambda part: part.write_text(text, encoding="utf-8"))
    return path


def _scenes(study: Study, rows: Sequence[Row]) -> list[dict[str, Any]]:
    """What the viewer shows: scenes whose images are there."""
    shown = [row for row in rows if row.seed == study.seeds[0]]
    if sum(row.width * row.height for row in shown) > MOST_PIXELS:
        shown = [row for row in shown if row.time == study.times[-1]]
    scenes = []
    for scenery in study.sceneries:
        own = [row for row in shown if row.scene == scenery.name]
        place = study.reference_path(scenery.name)
        if own and place.is_file():
            scenes.append(_scene(study, own, read_exr(place)))
    return scenes


def _scene(study: Study, rows: Sequence[Row], truth: Reference) -> dict[str, Any]:
    exposure = exposure_of(truth.image)
    height, width = truth.image.shape[:2]
    noise = number(metrics.relative_variance(truth.variance, truth.image), 3)
    views = [
        {
            "name": "reference",
            "time": None,
            "text": f"its own relative variance is {noise}",
            "image": _shown(truth.image, exposure),
            "error": None,
        }
    ]
    for row in sorted(rows, key=lambda row: row.time):
        path = study.image_path(row)
        if not path.is_file():
            continue
        image = read_exr(path).image
        text = f"{row.elapsed:.3g} s, {count(row.spp)} spp, relMSE {number(row.relmse, 3)}"
        views.append(
            {
                "name": row.method,
                "time": row.time,
                "text": text + ("" if row.flip is None else f", FLIP {number(row.flip, 3)}"),
                "image": _shown(image, exposure),
                "error": _error(image, truth.image),
            }
        )
    name = scene_title(rows[0].scene)
    return {"name": name, "width": width, "height": height, "views": views}


def _shown(image: NDArray[np.float32], exposure: float) -> str:
    return _png((255.0 * display(np.maximum(image, 0.0), exposure) + 0.5).astype(np.uint8))


def _error(image: NDArray[np.float32], truth: NDArray[np.float32]) -> str:
    """Grey levels that the page colours, (H, W)."""
    x, r = image.astype(np.float64), truth.astype(np.float64)
    scale = r * r + metrics.epsilon(r)
    error = np.divide((x - r) ** 2, scale, out=np.zeros_like(r), where=scale > 0.0).mean(axis=2)
    low, high = ERROR_RANGE
    share = (np.log10(np.maximum(error, 10.0 ** (low - 1.0))) - low) / (high - low)
    steps = np.rint(np.clip(share, 0.0, 1.0) * (LEVELS - 1))
    return _png((steps * (255.0 / (LEVELS - 1)) + 0.5).astype(np.uint8))


def _png(pixels: NDArray[np.uint8]) -> str:
    """As a data URI; matplotlib brings Pillow along."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(stream, "png", optimize=True)
    return _uri(stream.getvalue(), "png")


def _uri(data: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def _colours() -> list[list[int]]:
    """Viridis, which colour-blind readers see as a ramp of lightness, by grey level."""
    from matplotlib import colormaps

    table = colormaps["viridis"](np.linspace(0.0, 1.0, 256))[:, :3]
    return [[math.floor(255 * c + 0.5) for c in row] for row in table.tolist()]
