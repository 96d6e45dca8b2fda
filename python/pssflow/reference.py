"""Mitsuba's own truth for light of exactly k bounces, in passes, cached and resumed.

The truth is `path` with max_depth k + 1 minus `path` with max_depth k, the same film and filter, no Russian roulette
before depth k + 2 (`TruthPass`): that is what tests compare with. In LLVM variants both are rendered from one seed:
they share all random numbers up to the last bounce, so that the common terms cancel exactly. In `scalar_rgb` the
streams part ways, and the truth needs far more samples.

A reference need not render the directly lit scene twice, only to throw it away: in LLVM variants it is rendered by
`pssflow_kbounce` (`KBouncePass`), Mitsuba's path tracer cut down to light of k bounces, whose mean is that difference
(`tests/statistical/test_kbounce.py`), at half the time and the same variance. Hidden emitters it does not know: there,
and in `scalar_rgb`, where it would be Python's speed that counts, the difference remains.

Either is averaged over passes of other seeds; their spread gives each pixel's variance of the mean.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from . import metrics
from .export import Export, export
from .files import first_line, write_beside
from .options import MAX_BOUNCES, check_integer, check_number
from .passes import AllLightPass, KBouncePass, TruthPass, is_jit
from .progress import Progress, reporting
from .scene import Scene, SceneLike, load_scene

__all__ = [
    "Reference",
    "Running",
    "cache_path",
    "default_cache",
    "read_exr",
    "reference",
]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

FORMAT = 2
"""Version of the cached file, in its name; since 2 the name also says which of the two ways it was rendered."""

PATHS_PER_PASS = 1 << 18
"""Camera paths of a pass, about: a pass must end soon after Ctrl-C, and many are needed for a variance."""

LEAST_PASSES = 4
"""Fewer say nothing about a variance; they are rendered even if the time is out."""

SAVE_EVERY = 30.0
"""Seconds between two writes of the cache while rendering."""


@dataclass(frozen=True)
class Reference:
    """A truth and how well it is known."""

    image: F32
    """Radiance (H, W, 3), W·sr⁻¹·m⁻². Noise may make it slightly negative."""
    variance: F32
    """Variance of each mean, (H, W, 3); zero where it is unknown (an image from elsewhere)."""
    passes: int
    """Independent images that it is the mean of; 0 for an image from elsewhere."""
    spp: int
    """Samples per pixel in all; of each of the two depths, where it is a difference."""
    seconds: float
    """That rendering took, earlier calls included."""
    note: str
    """Why it ended, or where it comes from; one line."""
    k: int | None = None
    """Bounces; None if unknown, or of all light."""
    path: Path | None = None
    """The file that it is kept in."""
    reached: bool = True
    """Whether the standard error that was asked for was reached; True where none was."""

    @property
    def standard_error(self) -> float:
        """Relative standard error: the root of the mean of variance/(r² + ε), comparable with √relMSE."""
        return metrics.relative_error(self.variance, self.image)

    def describe(self) -> dict[str, Any]:
        """What a JSON record says about it."""
        return {
            "k": self.k,
            "passes": self.passes,
            "spp": self.spp,
            "seconds": self.seconds,
            "standard_error": metrics.finite_or_none(self.standard_error) if self.passes else None,
            "reached": self.reached,
            "mean": [float(c) for c in self.image.mean(axis=(0, 1), dtype=np.float64)],
            "note": self.note,
            "path": None if self.path is None else str(self.path),
        }

    def write(self, path: str | Path) -> None:
        """Writes an EXR, the variance as layer `variance`; `read_exr` reads it.

        Raises:
            OSError: it cannot be written.
        """
        from . import _core

        _core.write_exr(str(path), {"": self.image, "variance": self.variance})


def reference(
    scene: SceneLike,
    k: int = 2,
    *,
    sensor: Any = 0,
    seconds: float | None = 60.0,
    target_se: float | None = None,
    seed0: int = 0,
    progress: Progress = True,
    cache: str | Path | bool | None = None,
    all_light: bool = False,
    max_depth: int = -1,
) -> Reference:
    """Renders Mitsuba's truth for light of exactly k bounces, or adds what is missing to a cached one.

    Ends as soon as the relative standard error is at most `target_se`, or `seconds` were spent in all, cached passes
    included: a second call with the same arguments renders nothing.

    Args:
        scene: as in `pssflow.render`; an `mi.Scene` and a `Scene` in their current state.
        k: bounces, 1 … 32.
        sensor: index of the sensor, or a sensor object; a `Scene` has its own.
        seconds: None for as long as `target_se` needs.
        target_se: relative standard error to reach, comparable with √relMSE; None to use up `seconds`.
        seed0: seed of the first pass.
        progress: as in `pssflow.render`; the phase is "reference".
        cache: a folder; None for `default_cache()`, False for none. Files are named by scene, k, size and crop.
        all_light: the whole image by `path` instead, whatever `k` says.
        max_depth: of that image, as `path` has it: longest path, -1 for no end.

    Raises:
        UnsupportedError, FileNotFoundError: as `pssflow.render`.
        ValueError: an argument is wrong.
        OSError: `cache` cannot be written; this is found out before rendering.
        KeyboardInterrupt: on Ctrl-C, after the running pass (below a second); finished passes are kept in the cache.
    """
    k = check_integer("k", k, 1, MAX_BOUNCES)
    seed0 = check_integer("seed0", seed0, 0, 2**31 - 1)
    if seconds is None and target_se is None:
        raise ValueError("`seconds` and `target_se` are both None; the reference would never end")
    limit = math.inf if seconds is None else check_number("seconds", seconds, 0.0, 1e9)
    target = (
        0.0 if target_se is None else check_number("target_se", target_se, 0.0, 1e9, above=True)
    )

    notices: list[str] = []
    mi_scene, _ = load_scene(scene, notices)
    camera = scene.sensor if isinstance(scene, Scene) else sensor
    # Anew even for a `Scene`: it may have been edited since, and the cache must not mix two states.
    own = isinstance(scene, Scene)
    exported = export(
        mi_scene,
        camera,
        hide_emitters=scene.hide_emitters if own else None,
        approximate=own and scene.approximate,
    )
    hide = bool(exported.description["hide_emitters"])
    if all_light:
        k, renderer = 0, AllLightPass(mi_scene, camera, hide=hide, max_depth=max_depth)
    elif is_jit(mi_scene) and not hide:
        renderer = KBouncePass(mi_scene, camera, k)
    else:
        renderer = TruthPass(mi_scene, camera, k, hide=hide)
    path = _writable_cache(cache, notices, exported, k, seed0, renderer.name)
    total = _load(path, notices) if path is not None else None
    reused = 0 if total is None else total.passes
    film = exported.description["film"]["crop_size"]
    if total is None:
        total = Running.empty(film, max(PATHS_PER_PASS // (film[0] * film[1]), 1))
    saved = time.monotonic()
    with reporting(progress) as listener:
        passes = _more(total, renderer, seed0, limit, target, listener)
        try:
            # A state is made whole before it gets its name: Ctrl-C never leaves a half-added pass to be saved.
            for total in passes:
                if time.monotonic() - saved > SAVE_EVERY:
                    _save(path, total)
                    saved = time.monotonic()
        finally:
            renderer.restore()
            if total.passes > reused:
                _save(path, total)
    if total.non_finite:
        notices.append(f"{total.non_finite} values that were not finite count as zero")
    reached = target_se is None or total.standard_error() <= target
    ending = _ending(total, limit, target_se, reached)
    origin = f", {reused} of {total.passes} passes from the cache" if reused else ""
    return Reference(
        image=total.mean.astype(np.float32),
        variance=total.variance().astype(np.float32),
        passes=total.passes,
        spp=total.spp,
        seconds=total.seconds,
        note="; ".join([f"{renderer.name}, {mi_scene.variant_name()}, {ending}{origin}", *notices]),
        k=None if all_light else k,
        path=path,
        reached=reached,
    )


def read_exr(path: str | Path) -> Reference:
    """Reads an image as a truth: its R, G, B, and the layer `variance` where it has one.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no image, or holds values that are not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file")
    image, variance = _read_ours(path) or _read_theirs(path)
    known = variance is not None
    if variance is None:
        variance = np.zeros_like(image)
    for what, values in (("image", image), ("variance", variance)):
        bad = values.size - int(np.count_nonzero(np.isfinite(values)))
        if bad:
            raise ValueError(f"{path}: {bad} values of its {what} are not finite")
    note = f"read from {path}" + ("" if known else ", its own noise unknown")
    return Reference(image, variance, passes=0, spp=0, seconds=0.0, note=note, path=path)


def default_cache() -> Path:
    """`$XDG_CACHE_HOME/pssflow/references`, or the same under `~/.cache`."""
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(base).expanduser() / "pssflow" / "references"


def cache_path(folder: str | Path, exported: Export, k: int, seed0: int, way: str) -> Path:
    """Where the truth of an exported scene is kept: the name holds a hash of all that it depends on."""
    digest = hashlib.sha256()
    digest.update(json.dumps([FORMAT, mi.__version__, k, seed0, way]).encode())
    digest.update(exported.json().encode())
    for array in exported.arrays:
        digest.update(str((array.dtype.str, array.shape)).encode())
        digest.update(np.ascontiguousarray(array).data)
    film = exported.description["film"]
    (width, height), (x, y) = film["crop_size"], film["crop_offset"]
    return Path(folder) / f"{digest.hexdigest()[:20]}-k{k}-{width}x{height}+{x}+{y}.npz"


@dataclass(frozen=True)
class Running:
    """Mean and sum of squared deviations over passes (Welford 1962), (H, W, 3) in double precision."""

    mean: F64
    m2: F64
    passes: int
    spp_per_pass: int
    seconds: float
    spp: int
    non_finite: int

    @classmethod
    def empty(cls, size: list[int], spp_per_pass: int) -> Running:
        """Before the first pass, of an image of (width, height)."""
        shape = (size[1], size[0], 3)
        return cls(np.zeros(shape), np.zeros(shape), 0, spp_per_pass, 0.0, 0, 0)

    def with_pass(self, image: F64, *, spp: int, non_finite: int, seconds: float) -> Running:
        """The state after one more pass."""
        delta = image - self.mean
        mean = self.mean + delta / (self.passes + 1)
        return replace(
            self,
            mean=mean,
            m2=self.m2 + delta * (image - mean),
            passes=self.passes + 1,
            seconds=self.seconds + seconds,
            spp=self.spp + spp,
            non_finite=self.non_finite + non_finite,
        )

    def variance(self) -> F64:
        """Of the mean."""
        return self.m2 / max((self.passes - 1) * self.passes, 1)

    def standard_error(self) -> float:
        """Relative standard error of the mean, as `Reference.standard_error`."""
        return metrics.relative_error(self.variance(), self.mean)


def _more(
    total: Running,
    renderer: Callable[[int, int], tuple[F64, int, int]],
    seed0: int,
    limit: float,
    target: float,
    listener: Callable[[str, float], None] | None,
) -> Iterator[Running]:
    """The states after each further pass, until the error or the time is reached; none if they are already."""
    check = LEAST_PASSES
    while True:
        if total.passes >= check:
            error = total.standard_error()
            if error <= target or total.seconds >= limit:
                return
            if listener is not None:
                listener("reference", max(total.seconds / limit, (target / error) ** 2))
            # The error falls with the root of the passes: looking at every one would cost more than it saves.
            check = _next_check(total, limit)
        start = time.perf_counter()
        image, spp, bad = renderer(seed0 + total.passes, total.spp_per_pass)
        total = total.with_pass(image, spp=spp, non_finite=bad, seconds=time.perf_counter() - start)
        yield total


def _next_check(total: Running, limit: float) -> int:
    """The pass after which to look again: 5 % more passes, but not past the end of the time."""
    each = max(total.seconds / total.passes, 1e-9)
    in_time = (
        limit if math.isinf(limit) else total.passes + math.ceil((limit - total.seconds) / each)
    )
    return max(total.passes + 1, int(min(math.ceil(total.passes * 1.05), in_time)))


def _ending(total: Running, limit: float, target_se: float | None, reached: bool) -> str:
    error = f"relative standard error {total.standard_error():.2g}"
    if target_se is None:
        return f"{total.seconds:.1f} s, {error}"
    if reached:
        return f"{error} ≤ {target_se:.2g} after {total.seconds:.1f} s"
    return f"out of time after {limit:g} s: {error}, {target_se:.2g} was asked for"


def _writable_cache(
    cache: str | Path | bool | None,
    notices: list[str],
    exported: Export,
    k: int,
    seed0: int,
    way: str,
) -> Path | None:
    """The file to use, its folder made; None without a cache. A default that cannot be written is no error."""
    if cache is False:
        return None
    default = not isinstance(cache, (str, Path))
    folder = default_cache() if default else Path(cache)
    path = cache_path(folder, exported, k, seed0, way)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_beside(path.with_suffix(".probe"), lambda part: part.touch())
        path.with_suffix(".probe").unlink()
    except OSError as error:
        if default:
            notices.append(f"not cached: {first_line(error)}")
            return None
        raise OSError(f"{folder}: references cannot be kept there: {first_line(error)}") from None
    return path


def _load(path: Path, notices: list[str]) -> Running | None:
    """The cached state; None, with a notice where there is a file, if it cannot be used."""
    if not path.exists():
        return None
    try:
        # numpy leaves a file open that it cannot understand.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            if int(stored["format"]) != FORMAT:
                return None
            return Running(
                mean=stored["mean"],
                m2=stored["m2"],
                passes=int(stored["passes"]),
                spp_per_pass=int(stored["spp_per_pass"]),
                seconds=float(stored["seconds"]),
                spp=int(stored["spp"]),
                non_finite=int(stored["non_finite"]),
            )
    except Exception as error:  # whatever a damaged archive raises, the remedy is the same
        notices.append(f"{path} was damaged and is rendered anew ({first_line(error)})")
        return None


def _save(path: Path | None, total: Running) -> None:
    if path is None:
        return

    def write(part: Path) -> None:
        with part.open("wb") as file:
            np.savez(file, format=FORMAT, **vars(total))

    write_beside(path, write)


def _read_ours(path: Path) -> tuple[F32, F32 | None] | None:
    """Image and variance of an EXR that has R, G and B, as ours have; None for any other file.

    Mitsuba's reader works on several threads, and waits for ever where only one core is usable.
    """
    from . import _core

    try:
        channels = _core.read_exr(str(path))
    except ValueError:
        return None
    if not all(name in channels for name in "RGB"):
        return None
    image = np.stack([channels[name] for name in "RGB"], axis=2)
    names = [f"variance.{name}" for name in "RGB"]
    if not all(name in channels for name in names):
        return image, None
    return image, np.stack([channels[name] for name in names], axis=2)


def _read_theirs(path: Path) -> tuple[F32, F32 | None]:
    """Image and variance of whatever else Mitsuba reads."""
    try:
        layers = dict(mi.Bitmap(str(path)).split())
    except RuntimeError as error:
        raise ValueError(f"{path}: cannot be read as an image: {first_line(error)}") from None
    root = layers.get("<root>") or next(iter(layers.values()))
    return _rgb(root), _rgb(layers["variance"]) if "variance" in layers else None


def _rgb(bitmap: Any) -> F32:
    return np.array(
        bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False), np.float32
    )
