"""A look inside: what a surface is lit by, what guides make of it, and where in the image they pay.

`at_pixel` asks about one surface: f over the two numbers of the direction at x₁, all other numbers averaged out, beside
each guide's density of the two, and both over the directions themselves. `over_image` asks about the whole image: gain
in variance, share of paths that carry light, the cells of a guide's table. Both return what was found as arrays, and
draw it; the command `pssflow inspect` is a thin cover.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .guide import Guide
from .options import check_integer
from .render import Result
from .rows import LUMINANCE
from .scene import Scene

__all__ = ["AtPixel", "Fitted", "ImageMaps", "MapRow", "at_pixel", "over_image"]

F32 = NDArray[np.float32]
Array = NDArray[Any]
Settings = Mapping[str, Mapping[str, Any]]

GRID = 64
"""Steps along each of the two numbers."""

DISK = 64
"""Steps across the disk of directions."""

PATHS_A_CELL = 64
"""Paths traced for each step of the grid."""


@dataclass(frozen=True)
class Fitted:
    """A guide after its render, and its density over the direction at one surface."""

    name: str
    """As asked for."""
    chosen: str
    """What it came to; `none` where nothing paid."""
    a: float
    """Share of uniform paths in the mixture."""
    training: str
    """What it learned from, for the title."""
    density: Array
    """m(u₀, u₁) = a + (1 − a) q, (GRID, GRID), rows along u₁, mean 1; other numbers averaged out."""
    per_steradian: Array
    """The same over directions, (DISK, DISK), sr⁻¹; NaN outside the disk. Only directions that meet a surface."""


@dataclass(frozen=True)
class AtPixel:
    """What one surface is lit by."""

    scene: str
    pixel: tuple[int, int]
    k: int
    spp: int
    position: F32
    """x₁ (3,), in the scene's units."""
    normal: F32
    """Shading normal there, (3,)."""
    f: Array
    """Luminance of f over (u₀, u₁), (GRID, GRID), rows along u₁, W·sr⁻¹·m⁻²; the mean is the pixel's radiance."""
    best: Array
    """√(mean f²) over (u₀, u₁), scaled to mean 1: the density of least variance."""
    reach: float
    """Radius of the disk of directions: 1 for the hemisphere, √2 for the sphere where a surface lets light through."""
    f_directions: Array
    """f a steradian of the direction at x₁, (DISK, DISK), W·sr⁻²·m⁻²; NaN outside the disk."""
    best_directions: Array
    """The density of least variance over directions, (DISK, DISK), sr⁻¹; NaN outside the disk."""
    guides: list[Fitted]

    def draw(self, path: str | Path) -> None:
        """Writes the picture as PNG; see `draw_pixel`."""
        from .inspect_picture import draw_pixel

        draw_pixel(self, path)


@dataclass(frozen=True)
class MapRow:
    """One guide over the image."""

    name: str
    chosen: str
    a: float
    training: str
    gain: Array
    """Variance of random numbers ÷ that of the guide at equal samples, (h, w), means over squares of 5 pixels; NaN
    where one of them saw no light."""
    nonzero_share: Array
    """Share of the paths through each pixel that carry light, (h, w)."""
    total_gain: float
    """Sum of the variances of random numbers ÷ that of the guide's."""
    cells: NDArray[np.int64] | None
    """Cell of the guide's direction table at each pixel's x₁, (h, w), -1 for none; None where it has no such table."""


@dataclass(frozen=True)
class ImageMaps:
    """Where in the image guides pay."""

    scene: str
    k: int
    spp: int
    image: F32
    """By random numbers, (h, w, 3)."""
    relative_error: Array
    """Standard error ÷ mean of its luminance, (h, w), of means over squares of 5 pixels; NaN where it is black."""
    nonzero_share: Array
    """Of random numbers, (h, w)."""
    rows: list[MapRow]

    def draw(self, path: str | Path) -> None:
        """Writes the picture as PNG; see `draw_maps`."""
        from .inspect_picture import draw_maps

        draw_maps(self, path)


def at_pixel(
    scene: Scene,
    pixel: tuple[int, int],
    guides: Sequence[str] = ("direction-table", "auto"),
    *,
    spp: int = 16,
    k: int = 2,
    settings: Settings | None = None,
    **options: Any,
) -> AtPixel:
    """Looks at the surface seen at a pixel's centre: 64 × 64 × 64 paths, and a render a guide.

    Args:
        scene: see `Scene`.
        pixel: column and row, from the crop's upper left corner.
        guides: names of guides; each is fitted by a render of `spp`.
        spp: samples per pixel of these renders.
        k: bounces, at least 2: with one, no direction is drawn.
        settings: options of each guide, by guide.
        **options: further arguments of `pssflow.render`, whose `progress` is off by default.

    Raises:
        ValueError: the pixel lies outside of the film or sees no surface, or an argument is wrong.
    """
    _check_bounces(k)
    x, y = _check_pixel(scene, pixel)
    strategy = _strategy(options)
    u, surface = _paths_at(
        scene, (x, y), k, strategy, options.get("seed", 0), options.get("threads")
    )
    position, normal = _surface(surface, (x, y))

    luminance = (surface.f @ LUMINANCE).astype(np.float64)
    # Of the direction at x₁ the rays say where it went, wherever they met x₂.
    onward = surface.outgoing[:, 1] * np.float32(-1)
    known = np.linalg.norm(onward, axis=1) > 0.5
    disk = _Disk(onward, known, normal)
    square = _by_cell(luminance**2)
    best = np.sqrt(square)
    best /= max(best.mean(), np.finfo(np.float64).tiny)
    fitted: list[Fitted] = []
    for name in guides:
        result = _render(scene, name, settings, spp=spp, k=k, **options)
        q = _direction_density(result, u[:, : 2 * k + 1], surface, (x, y), scene)
        a = float(result.stats["a"])
        mixture = a + (1 - a) * q if isinstance(result.guide, Guide) else np.ones(len(u))
        fitted.append(
            Fitted(
                name=name,
                chosen=result.stats["chosen"],
                a=a,
                training=_training(result),
                density=_by_cell(mixture),
                per_steradian=disk.density(mixture),
            )
        )
    return AtPixel(
        scene=_title(scene),
        pixel=(x, y),
        k=k,
        spp=spp,
        position=position,
        normal=normal,
        f=_by_cell(luminance),
        best=best,
        reach=disk.reach,
        f_directions=disk.density(luminance),
        best_directions=disk.density(np.repeat(best.ravel(), PATHS_A_CELL)),
        guides=fitted,
    )


def over_image(
    scene: Scene,
    guides: Sequence[str] = ("direction-table", "auto"),
    *,
    spp: int = 16,
    k: int = 2,
    settings: Settings | None = None,
    **options: Any,
) -> ImageMaps:
    """Renders with random numbers and with each guide, at equal samples, and says where a guide pays.

    Args:
        scene: see `Scene`.
        guides: names of guides.
        spp: samples per pixel of each render, a guide's pilot inside; at least 4.
        k: bounces.
        settings: options of each guide, by guide.
        **options: as in `at_pixel`.

    Raises:
        ValueError: an argument is wrong.
    """
    if spp < 4:
        raise ValueError(f"`spp` = {spp}: a variance for each pixel takes at least 4")
    random = _render(scene, "none", None, spp=spp, k=k, **options)
    before = _smooth(_variance(random))
    mean = _smooth((random.image @ LUMINANCE).astype(np.float64))
    rows: list[MapRow] = []
    for name in guides:
        result = _render(scene, name, settings, spp=spp, k=k, **options)
        after = _smooth(_variance(result))
        lit = (before > 0) & (after > 0)
        rows.append(
            MapRow(
                name=name,
                chosen=result.stats["chosen"],
                a=float(result.stats["a"]),
                training=_training(result),
                gain=np.where(lit, before / np.where(lit, after, 1), np.nan),
                nonzero_share=result.nonzero / spp,
                total_gain=float(
                    _variance(random).sum()
                    / max(_variance(result).sum(), np.finfo(np.float64).tiny)
                ),
                cells=_cells(scene, result, k, _strategy(options), options.get("threads")),
            )
        )
    lit = mean > 0
    error = np.sqrt(before) / np.where(lit, mean, 1)
    return ImageMaps(
        scene=_title(scene),
        k=k,
        spp=spp,
        image=random.image,
        relative_error=np.where(lit, error, np.nan),
        nonzero_share=random.nonzero / spp,
        rows=rows,
    )


def _check_bounces(k: int) -> None:
    if k < 2:
        raise ValueError(
            f"`k` = {k}: with one bounce no direction is drawn; look at k of 2 or more"
        )


def _check_pixel(scene: Scene, pixel: tuple[int, int]) -> tuple[int, int]:
    x, y = (check_integer("pixel", n, -(2**31), 2**31) for n in pixel)
    if not (0 <= x < scene.width and 0 <= y < scene.height):
        raise ValueError(
            f"pixel {x},{y} lies outside of the film, whose pixels are 0,0 to {scene.width - 1},{scene.height - 1}"
        )
    return x, y


def _strategy(options: Mapping[str, Any]) -> dict[str, str]:
    names = ("parametrisation", "emitter_strategy")
    return {name: options[name] for name in names if options.get(name) is not None}


def _paths_at(
    scene: Scene,
    pixel: tuple[int, int],
    k: int,
    strategy: Mapping[str, str],
    seed: int,
    threads: int | None,
) -> tuple[F32, Any]:
    """Paths through a pixel's centre whose first two numbers fill a grid, cell by cell."""
    columns = len(scene.columns(k, strategy.get("emitter_strategy", "mis")))
    rows = GRID * GRID * PATHS_A_CELL
    random = np.random.default_rng(seed)
    u = random.random((rows, columns), np.float32)
    cell = np.arange(rows) // PATHS_A_CELL
    for column, step in ((0, cell % GRID), (1, cell // GRID)):
        # A float32 just below 1 may round up to the next cell, and at the end out of the cube.
        last = np.nextafter(np.float32(1), np.float32(0))
        u[:, column] = np.minimum((step + u[:, column]) / np.float32(GRID), last)
    centre = np.array([[pixel[0] + 0.5, pixel[1] + 0.5]], np.float32)
    traced = scene.trace(u, np.repeat(centre, rows, axis=0), k=k, threads=threads, **strategy)
    return u, traced


def _surface(surface: Any, pixel: tuple[int, int]) -> tuple[F32, F32]:
    """x₁ and its normal, the same for all paths but where a mask lets some of them through."""
    there = np.linalg.norm(surface.normal[:, 0], axis=1) > 0.5
    if not there.any():
        raise ValueError(f"pixel {pixel[0]},{pixel[1]} sees no surface at its centre; name another")
    first = int(np.argmax(there))
    return surface.position[first, 0], surface.normal[first, 0]


def _title(scene: Scene) -> str:
    """The scene's name in a title: of a file its own, or its folder's where all files have the same."""
    path = Path(scene.name)
    named = path.parent.name if path.stem == "scene" else path.stem
    return named if path.suffix == ".xml" and named else scene.name


def _render(scene: Scene, name: str, settings: Settings | None, **options: Any) -> Result:
    return scene.render(name, **{"progress": False, **options, **(settings or {}).get(name, {})})


def _training(result: Result) -> str:
    """What a guide came to, in words: inside of the samples of the render."""
    chosen = result.stats["chosen"]
    if result.guide is None:
        return "random numbers"
    named = "" if chosen == result.stats["guide"] else f"{chosen}, "
    return f"{named}a = {result.stats['a']:g}"


def _direction_density(
    result: Result, u: F32, surface: Any, pixel: tuple[int, int], scene: Scene
) -> Array:
    """Density of the direction at x₁, or of all its numbers where the guide models these; 1 without either."""
    guide = result.guide
    rows = len(u)
    if not isinstance(guide, Guide):
        return np.ones(rows)
    if "path" in guide.models:
        film = np.array(
            [[(pixel[0] + 0.5) / scene.width, (pixel[1] + 0.5) / scene.height]], np.float32
        )
        place = {"pixel": np.repeat(film, rows, axis=0)}
        return np.exp(guide.log_prob(u, contexts=place).astype(np.float64))
    if "direction" not in guide.models:
        return np.ones(rows)
    place = _first_vertices(surface)
    return np.exp(guide.log_prob(u[:, :2], decision="direction", contexts=place).astype(np.float64))


def _first_vertices(surface: Any) -> dict[str, Array]:
    """x₁ of each path as the context of its direction."""
    return {
        "position": surface.position[:, 0],
        "normal": surface.normal[:, 0],
        "outgoing": surface.outgoing[:, 0],
        "pixel": surface.pixel,
        "bounce": np.ones(len(surface.position), np.uint32),
    }


def _by_cell(values: Array) -> Array:
    """Means over the grid's cells, rows along u₁."""
    return values.reshape(GRID, GRID, PATHS_A_CELL).mean(axis=2)


class _Disk:
    """Directions in Lambert's azimuthal equal-area projection, the normal in the middle.

    The hemisphere is the disk of radius 1. Where more than a few directions go below the surface, as through glass,
    the whole sphere is shown, whose radius is √2; few, which rounding or a bent normal sends there, are left out.
    """

    FEW = 0.01
    """Share of directions below the surface that do not make the disk larger."""

    def __init__(self, directions: F32, known: NDArray[np.bool_], normal: F32) -> None:
        n = normal / np.linalg.norm(normal)
        # The picture's right and up: world axes as far as they lie in the surface.
        up = np.array([0.0, 1.0, 0.0]) if abs(n[1]) < 0.9 else np.array([0.0, 0.0, -1.0])
        right = np.cross(up, n)
        right /= np.linalg.norm(right)
        up = np.cross(n, right)
        cosine = np.clip(directions @ n, -1.0, 1.0)
        below = np.count_nonzero(cosine[known] < 0) > self.FEW * np.count_nonzero(known)
        self.reach = float(np.sqrt(2)) if below else 1.0
        radius = np.sqrt(1.0 - cosine)
        across, along = directions @ right, directions @ up
        length = np.maximum(np.hypot(across, along), 1e-12)
        step = np.array([radius * across / length, radius * along / length])
        index = np.clip(((step / self.reach + 1.0) * 0.5 * DISK).astype(np.int64), 0, DISK - 1)
        shown = known & (radius <= self.reach * (1 + 1e-6))
        self.index = np.where(shown, index[1] * DISK + index[0], DISK * DISK)
        # A cell on the rim lies in the disk in part only: as many of 8 × 8 points in it.
        fine = (np.arange(8 * DISK) + 0.5) / (4 * DISK) - 1
        inside = np.hypot(fine[None, :], fine[:, None]) <= 1.0
        share = inside.reshape(DISK, 8, DISK, 8).mean(axis=(1, 3))
        # The disk of area π stands for the hemisphere of 2π: an area on it is half as many steradians.
        self.steradians = share * 2.0 * (2.0 * self.reach / DISK) ** 2

    def density(self, values: Array) -> Array:
        """Means over paths of `values`, a steradian, (DISK, DISK), rows from below to above; NaN outside."""
        sums = np.bincount(self.index, weights=values, minlength=DISK * DISK + 1)[: DISK * DISK]
        within = self.steradians > 0
        mean = sums.reshape(DISK, DISK) / len(values)
        return np.where(within, mean / np.where(within, self.steradians, 1), np.nan)


def _cells(
    scene: Scene, result: Result, k: int, strategy: Mapping[str, str], threads: int | None
) -> NDArray[np.int64] | None:
    """The cell of the table at x₁, or of a guide over whole paths, at each pixel's centre."""
    guide = result.guide
    if not isinstance(guide, Guide):
        return None
    height, width = scene.height, scene.width
    y, x = np.mgrid[:height, :width]
    pixels = np.stack([x.ravel() + 0.5, y.ravel() + 0.5], axis=1).astype(np.float32)
    columns = len(scene.columns(k, strategy.get("emitter_strategy", "mis")))
    u = np.full((len(pixels), columns), 0.5, np.float32)
    surface = scene.trace(u, pixels, k=k, threads=threads, **strategy)
    if "direction" in guide.models:
        cells = guide.cells(_first_vertices(surface))
    elif "path" in guide.models:
        cells = guide.cells({"pixel": surface.pixel}, decision="path")
    else:
        return None
    seen = np.linalg.norm(surface.normal[:, 0], axis=1) > 0.5
    cells = np.where(seen, cells, -1).reshape(height, width)
    return cells if (cells >= 0).any() else None


def _variance(result: Result) -> Array:
    """Of each pixel's luminance, as if its channels were as noisy together as they are apart."""
    return (result.variance @ LUMINANCE).astype(np.float64)


def _smooth(values: Array, radius: int = 2) -> Array:
    """Means over squares of 2·radius + 1 pixels: a single pixel's variance is mostly noise."""
    side = 2 * radius + 1
    padded = np.pad(values.astype(np.float64), radius, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (side, side))
    return windows.mean(axis=(2, 3))
