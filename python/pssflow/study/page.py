"""report.html of a study: tables, charts and an image viewer in one file that opens from disk without a network.

Images and charts lie in the page as data URIs. The viewer shows, scene by scene, what each method had: the image under
one exposure, or its error in false colours (the squared relative error of a pixel, on a logarithmic scale).
"""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
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

__all__ = ["ERROR_RANGE", "Chart", "View", "study_scenes", "viewer_scene", "write_page"]

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
    """An SVG or a PNG."""
    title: str
    first: bool = False
    """Whether it is open at once."""
    text: str = ""
    """What to see in it, where its own caption does not say it."""


@dataclass(frozen=True)
class View:
    """An image of the viewer, beside the truth."""

    name: str
    image: NDArray[np.float32]
    text: str
    """Its budget and errors."""
    time: float = 0.0
    """After which budget; the viewer shows those of one at a time."""


def write_page(
    folder: Path,
    title: str,
    *,
    sheets: Sequence[Any],
    charts: Sequence[Chart],
    scenes: Sequence[Mapping[str, Any]],
    lines: Sequence[str],
    notes: str,
    unit: str = "s",
    heading: str = "Charts",
) -> Path:
    """Writes report.html into a study's folder.

    Args:
        folder: where to.
        title: what was measured.
        sheets: tables, `study.report.Sheet`.
        charts: in order.
        scenes: what the viewer shows: `viewer_scene`, or `study_scenes` for all of a study.
        lines: findings, one a paragraph; those that begin with "BIASED?" stand out.
        notes: how to read the tables.
        unit: of the views' budgets.
        heading: above the charts.

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
        heading=heading,
        charts=[
            {"title": c.title, "text": c.text, "first": c.first, "uri": _file_uri(c.path)}
            for c in charts
        ],
        lines=lines,
        notes=notes,
        viewer={
            "scenes": scenes,
            "colours": _colours(),
            "range": ERROR_RANGE,
            "unit": unit,
        },
    )
    path = folder / "report.html"
    write_beside(path, lambda part: part.write_text(text, encoding="utf-8"))
    return path


def study_scenes(study: Study, rows: Sequence[Row]) -> list[dict[str, Any]]:
    """What the viewer shows of a study: scenes whose images are there, of the first seed."""
    shown = [row for row in rows if row.seed == study.seeds[0]]
    if sum(row.width * row.height for row in shown) > MOST_PIXELS:
        shown = [row for row in shown if row.time == study.times[-1]]
    scenes = []
    for scenery in study.sceneries:
        own = [row for row in shown if row.scene == scenery.name]
        if own and (place := study.reference_path(own[0])).is_file():
            scenes.append(
                viewer_scene(scene_title(scenery.name), read_exr(place), _views(study, own))
            )
    return scenes


def _views(study: Study, rows: Sequence[Row]) -> Iterator[View]:
    for row in sorted(rows, key=lambda row: row.time):
        path = study.image_path(row)
        if path.is_file():
            text = f"{row.elapsed:.3g} s, {count(row.spp)} spp, relMSE {number(row.relmse, 3)}"
            text += "" if row.flip is None else f", FLIP {number(row.flip, 3)}"
            yield View(row.method, read_exr(path).image, text, row.time)


def viewer_scene(name: str, truth: Reference, views: Iterable[View]) -> dict[str, Any]:
    """One scene of the viewer: its truth and the views, under one exposure, with the error of each."""
    exposure = exposure_of(truth.image)
    height, width = truth.image.shape[:2]
    scale = metrics.local_scale(truth.image)
    noise = number(metrics.relative_variance(truth.variance, truth.image, scale=scale), 3)
    shown = [
        {
            "name": "reference",
            "time": None,
            "text": f"its own relative variance is {noise}",
            "image": _shown(truth.image, exposure),
            "error": None,
        }
    ]
    shown += [
        {
            "name": view.name,
            "time": view.time,
            "text": view.text,
            "image": _shown(view.image, exposure),
            "error": _error(view.image, truth.image),
        }
        for view in views
    ]
    return {"name": name, "width": width, "height": height, "views": shown}


def _shown(image: NDArray[np.float32], exposure: float) -> str:
    return _png((255.0 * display(np.maximum(image, 0.0), exposure) + 0.5).astype(np.uint8))


def _error(image: NDArray[np.float32], truth: NDArray[np.float32]) -> str:
    """Grey levels that the page colours, (H, W)."""
    x, r = image.astype(np.float64), truth.astype(np.float64)
    scale = metrics.local_scale(r)
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


def _file_uri(path: Path) -> str:
    return _uri(path.read_bytes(), "svg+xml" if path.suffix == ".svg" else "png")


def _uri(data: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def _colours() -> list[list[int]]:
    """Viridis, which colour-blind readers see as a ramp of lightness, by grey level."""
    from matplotlib import colormaps

    table = colormaps["viridis"](np.linspace(0.0, 1.0, 256))[:, :3]
    return [[math.floor(255 * c + 0.5) for c in row] for row in table.tolist()]
