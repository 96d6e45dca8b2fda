"""Scenes as pssflow traces them: loaded by Mitsuba, exported, and built once (BVH and tables).

```
path, dict or mi.Scene ─► mi.Scene ─ export ─► _core.Scene ─► trace(u), pilot(), render()
```

`Scene.trace` is the tracer as a function: rows of numbers in, what each path contributes out. It is the place to start
for research on sampling; `pssflow.render` is the whole estimator.
"""

from __future__ import annotations

import importlib.util
import json
import site
import sysconfig
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _core
from .export import Export, export
from .export.sensors import select_sensor
from .files import first_line, write_beside
from .options import check_integer, check_number, check_path_options, check_threads
from .variants import ensure_variant

if TYPE_CHECKING:
    from .guide import Guide
    from .render import Result

__all__ = ["Pilot", "Scene", "SceneLike", "Trace", "embree_dirs", "load_scene"]

F32 = NDArray[np.float32]

SceneLike = Any
"""A path to a scene's XML file, a dictionary as for `mi.load_dict`, an `mi.Scene`, or a `Scene`."""


@dataclass(frozen=True)
class Trace:
    """What paths contribute, one row a path. Radiance in W·sr⁻¹·m⁻², linear sRGB; lengths in the scene's units."""

    f: F32
    """f(u) (n, 3), divided by the parametrisation's baseline density, not by a guide's: its mean over uniform u is the
    pixel's k-bounce radiance."""
    f_nee: F32
    """The part of f that an emitter sample found, (n, 3)."""
    f_bsdf: F32
    """The part that the BSDF-sampled ray from x_k found, (n, 3); zero for the strategy `nee`."""
    found: NDArray[np.bool_]
    """Whether all k vertices exist, (n,)."""
    position: F32
    """x₁ … x_k, (n, k, 3)."""
    normal: F32
    """Shading normals there, (n, k, 3)."""
    outgoing: F32
    """Unit directions from there towards the camera's side of the path, (n, k, 3)."""
    pixel: F32
    """Film positions in [0, 1)² of the crop, (n, 2)."""
    emitter: NDArray[np.uint32]
    """Index of the emitter that was chosen at x_k, (n,)."""

    def __len__(self) -> int:
        return len(self.f)


@dataclass(frozen=True)
class Pilot(Trace):
    """Uniform paths of a whole image with the numbers they were drawn from: the training set of a guide."""

    u: F32
    """Primary numbers (n, 2k+1), or (n, 2k+3) with the strategy `mis`; columns as in `columns`."""
    pixels: F32
    """Film positions in pixels from the crop's corner, (n, 2); with a lens (n, 4), its two numbers behind them."""
    g: F32
    """Density that the numbers were drawn from, (n,); 1 throughout."""
    emitters: F32
    """Per emitter: the upper end of its interval of the emitter's number, and 1 if it surrounds the scene, (m, 2)."""
    columns: list[str] = field(default_factory=list)
    """What each column of `u` decides."""
    learned: int = 0
    """How many of the columns a guide of the whole path models: 2k+1, the first ones; with `mis` two of the
    BSDF-sampled ray follow."""
    columns_hash: str = ""
    """What a saved guide is checked against; see `Guide.load`."""
    scene_hash: str = ""
    """The same for the scene."""

    def save(self, path: str | Path) -> None:
        """Writes all arrays to an `.npz` file, which `Pilot.load` and `numpy.load` read.

        Raises:
            OSError: it cannot be written; nothing is left behind.
        """
        values: dict[str, Any] = {
            item.name: np.asarray(getattr(self, item.name)) for item in fields(self)
        }

        def write(part: Path) -> None:
            with part.open("wb") as file:
                np.savez(file, **values)

        write_beside(path, write)

    @classmethod
    def load(cls, path: str | Path) -> Pilot:
        """Reads what `save` wrote.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it is something else.
        """
        try:
            # numpy leaves a file open that it cannot understand.
            with Path(path).open("rb") as file, np.load(file, allow_pickle=False) as stored:
                values: dict[str, Any] = {item.name: stored[item.name] for item in fields(cls)}
        except FileNotFoundError:
            raise FileNotFoundError(f"{path}: there is no such file") from None
        except Exception as error:  # what a damaged archive raises has no common base
            raise ValueError(f"{path}: is no pilot saved by pssflow: {first_line(error)}") from None
        values["columns"] = values["columns"].tolist()
        values["learned"] = int(values["learned"])
        values["columns_hash"] = str(values["columns_hash"])
        values["scene_hash"] = str(values["scene_hash"])
        return cls(**values)

    def fit(self, name: str = "realnvp", *, seed: int = 0, **options: Any) -> Guide:
        """Fits a guide to these paths; see `Guide.fit`."""
        from .guide import Guide

        u = _matrix(self.u, "u")
        return Guide.fit(
            name,
            u[:, : self.learned],
            self.f,
            f_bsdf=self.f_bsdf,
            ray=u[:, self.learned :] if u.shape[1] > self.learned else None,
            g=self.g,
            contexts={
                name: getattr(self, name)
                for name in ("position", "normal", "outgoing", "pixel", "emitter")
            },
            emitters=self.emitters,
            seed=seed,
            columns_hash=self.columns_hash,
            scene_hash=self.scene_hash,
            **options,
        )


class Scene:
    """A scene ready to be traced, in the state it had when this was made: edits made later need a new `Scene`.

    Args:
        scene: a path to an XML file, a dictionary as for `mi.load_dict`, or an `mi.Scene` of the active variant. Where
            no variant is set, loading sets `llvm_ad_rgb`, or `scalar_rgb` where libLLVM is missing.
        sensor: index of the sensor, or a sensor object.
        size: width and height of the film in pixels in place of the scene's own. The horizontal field of view stays,
            the crop becomes the whole film. Changes the `mi.Scene`.
        scale: factor on the film's size in place of `size`; a crop is scaled with it.
        hide_emitters: whether camera rays pass through the surfaces of emitters, as Mitsuba's option of that name.
            None: what the scene's own integrator says.
        approximate: whether what is not supported is replaced where there is a replacement (a BSDF by a diffuse one
            of its mean reflectance, a texture by its mean; media and emitters are left out), with a note for each.
        **xml_parameters: values for `$name` in the XML file.

    Raises:
        FileNotFoundError: there is no such file.
        UnsupportedError: the scene holds what cannot be rendered.
        ValueError: it cannot be loaded, or an argument is out of range.
        RuntimeError: Embree was not found.
    """

    def __init__(
        self,
        scene: SceneLike,
        sensor: Any = 0,
        *,
        size: tuple[int, int] | None = None,
        scale: float | None = None,
        hide_emitters: bool | None = None,
        approximate: bool = False,
        **xml_parameters: Any,
    ) -> None:
        self.notes: list[str] = []
        """What the image will not show exactly as Mitsuba would, and which variant had to be taken."""
        start = time.perf_counter()
        self.mi_scene, self.name = load_scene(scene, self.notes, **xml_parameters)
        if size is not None or scale is not None:
            resize_film(self.mi_scene, sensor, size, scale)
        loaded = time.perf_counter()
        self.sensor = sensor
        self.approximate = approximate
        """Whether unsupported features were to be replaced."""
        self.exported: Export = export(
            self.mi_scene, sensor, hide_emitters=hide_emitters, approximate=approximate
        )
        """What the renderer was built from. It took the arrays over: there are none in here."""
        self.notes += self.exported.notes
        exported = time.perf_counter()
        arrays = _handed_over(self.exported.arrays)
        self.core = _core.Scene(self.exported.json(), arrays, embree_dirs())
        self._strategies: dict[tuple[int, str], tuple[str, str]] = {}
        self.variant = self.mi_scene.variant_name()
        """The Mitsuba variant that loaded it."""
        self.timings: dict[str, float] = {
            "load": loaded - start,
            "export": exported - loaded,
            "bvh": time.perf_counter() - exported,
        }
        """Seconds to load, export, and build; `load` is 0 for an `mi.Scene`."""

    def __repr__(self) -> str:
        return f"Scene({self.name!r}, {self.width}×{self.height}, {self.variant})"

    @property
    def width(self) -> int:
        """Columns of the crop."""
        return self.core.width

    @property
    def height(self) -> int:
        """Rows of the crop."""
        return self.core.height

    @property
    def hash(self) -> str:
        """Hash of what is rendered; a saved guide remembers it."""
        return self.core.hash

    @property
    def summary(self) -> dict[str, Any]:
        """Counts of shapes, BSDFs, emitters; triangles, degenerate triangles, bytes of geometry; Embree's version."""
        return {**json.loads(self.core.summary()), "embree": self.core.embree}

    def columns(self, k: int = 2, emitter_strategy: str = "mis") -> list[str]:
        """What each column of `u` decides: 2k+1 of them, 2k+3 with the strategy `mis`."""
        k, _, strategy = self._path_options(k, "bsdf", emitter_strategy)
        return self.core.columns(k, strategy)

    def trace(
        self,
        u: ArrayLike,
        pixels: ArrayLike,
        *,
        k: int = 2,
        parametrisation: str = "bsdf",
        emitter_strategy: str = "mis",
        threads: int | None = None,
    ) -> Trace:
        """Traces one path per row of `u`.

        | name     | shape                       | unit, range                        |
        |----------|-----------------------------|------------------------------------|
        | `u`      | (n, 2k+1), `mis` (n, 2k+3)  | [0, 1), columns as in `columns`    |
        | `pixels` | (n, 2)                      | x, y in pixels from the crop's corner |
        |          | or (n, 4), for a `thinlens` | and two numbers in [0, 1) for the lens, else its centre |

        Raises:
            ValueError: a shape or value is wrong; the message names the first offender.
        """
        k, parametrisation, strategy = self._path_options(k, parametrisation, emitter_strategy)
        values = self.core.trace(
            _matrix(u, "u"),
            _matrix(pixels, "pixels"),
            k=k,
            parametrisation=parametrisation,
            emitter_strategy=strategy,
            threads=check_threads(threads),
        )
        return Trace(**{item.name: values[item.name] for item in fields(Trace)})

    def pilot(
        self,
        spp: int = 1,
        *,
        k: int = 2,
        parametrisation: str = "bsdf",
        emitter_strategy: str = "mis",
        seed: int = 0,
        threads: int | None = None,
    ) -> Pilot:
        """Traces `spp` uniform paths a pixel and keeps everything: about 90 + 36·k bytes a path.

        Raises:
            ValueError: an argument is out of range.
        """
        k, parametrisation, strategy = self._path_options(k, parametrisation, emitter_strategy)
        values = self.core.pilot(
            spp=check_integer("spp", spp, 1, 1 << 24),
            k=k,
            parametrisation=parametrisation,
            emitter_strategy=strategy,
            seed=check_integer("seed", seed, 0, 2**64 - 1),
            threads=check_threads(threads),
        )
        arrays = {item.name: values[item.name] for item in fields(Pilot) if item.name in values}
        intervals = np.array(self.core.emitter_intervals(), np.float32).reshape(-1, 2)
        return Pilot(
            **arrays,
            emitters=intervals,
            columns=self.core.columns(k, strategy),
            learned=2 * k + 1,
            columns_hash=self.core.columns_hash(k, parametrisation),
            scene_hash=self.hash,
        )

    def render(self, guide: Any = None, spp: int | None = None, **options: Any) -> Result:
        """Renders this scene; arguments as in `pssflow.render`."""
        from .render import render

        return render(self, guide, spp, **options)

    @property
    def hide_emitters(self) -> bool:
        """Whether camera rays pass through the surfaces of emitters."""
        return self.exported.description["hide_emitters"]

    def resolve_strategy(
        self,
        emitter_strategy: str,
        k: int = 2,
        parametrisation: str = "bsdf",
        threads: int | None = None,
    ) -> tuple[str, str | None]:
        """`mis` or `nee`, and for `auto` why it means that here.

        A probe of some 100 000 paths tells, the same always; it is made once for each k and parametrisation.
        """
        if emitter_strategy != "auto":
            return emitter_strategy, None
        key = (k, parametrisation)
        if key not in self._strategies:
            strategy, reason, _ = self.core.auto_strategy(
                k=k, parametrisation=parametrisation, threads=check_threads(threads)
            )
            self._strategies[key] = (strategy, reason)
        return self._strategies[key]

    def _path_options(self, k: int, parametrisation: str, strategy: str) -> tuple[int, str, str]:
        k, parametrisation, strategy = check_path_options(k, parametrisation, strategy)
        return k, parametrisation, self.resolve_strategy(strategy, k, parametrisation)[0]


def load_scene(scene: SceneLike, notes: list[str], **xml_parameters: Any) -> tuple[Any, str]:
    """An `mi.Scene` and its name; notices are appended to `notes`. Nothing is merged on loading: names stay.

    Raises:
        FileNotFoundError, ValueError, TypeError: one line that names the file or the argument.
    """
    if isinstance(scene, Scene):
        _no_parameters(xml_parameters, "a `Scene`")
        return scene.mi_scene, scene.name
    if isinstance(scene, (str, Path)):
        path = Path(scene)
        if not path.is_file():
            what = (
                "is a folder; name the XML file in it" if path.is_dir() else "there is no such file"
            )
            raise FileNotFoundError(f"{path}: {what}")
        _note(notes, ensure_variant())
        try:
            loaded = mi.load_file(str(path), optimize=False, **_texts(xml_parameters))
        except RuntimeError as error:
            message = first_line(error)
            named = message if str(path) in message else f"{path}: {message}"
            raise ValueError(named) from None
        return _one_scene(loaded, str(path)), str(path)
    if isinstance(scene, Mapping):
        _no_parameters(xml_parameters, "a dictionary")
        _note(notes, ensure_variant())
        try:
            loaded = mi.load_dict(dict(scene), optimize=False)
        except RuntimeError as error:
            raise ValueError(f"scene dictionary: {first_line(error)}") from None
        return _one_scene(loaded, "scene dictionary"), "dict"
    _no_parameters(xml_parameters, f"a {type(scene).__name__}")
    if not hasattr(scene, "class_name") or scene.class_name() != "Scene":
        raise TypeError(
            f"`scene` is a {type(scene).__name__}; expected a path to an XML file, a dictionary, or an `mi.Scene`"
        )
    return scene, scene.id() or "mi.Scene"


def resize_film(scene: Any, sensor: Any, size: tuple[int, int] | None, scale: float | None) -> None:
    """Gives a sensor's film another size; see `Scene`.

    Raises:
        ValueError: both were given, or a size is out of range.
    """
    if size is not None and scale is not None:
        raise ValueError("`size` and `scale` were both given; give one")
    camera = select_sensor(scene, sensor)
    film = camera.film()
    old, offset, crop = (
        np.array(v, np.int64) for v in (film.size(), film.crop_offset(), film.crop_size())
    )
    if scale is not None:
        factor = check_number("scale", scale, 1e-4, 1e4)
        new = np.maximum(np.rint(old * factor), 1).astype(int)
        offset = np.minimum(np.rint(offset * factor).astype(int), new - 1)
        crop = np.clip(np.rint(crop * factor).astype(int), 1, new - offset)
    elif size is not None:
        if len(size) != 2:
            raise ValueError(f"`size` = {size}: expected width and height")
        new = np.array([check_integer("size", n, 1, MOST_PIXELS) for n in size])
        offset, crop = np.zeros(2, int), new
    else:
        return
    if new.max() > MOST_PIXELS:
        raise ValueError(
            f"the film would have {new[0]}×{new[1]} pixels; at most {MOST_PIXELS} a side"
        )
    parameters = mi.traverse(camera)
    for name, value in (("size", new), ("crop_size", crop), ("crop_offset", offset)):
        parameters[f"film.{name}"] = [int(n) for n in value]
    parameters.update()


MOST_PIXELS = 1 << 16
"""Longest side of a film."""


def embree_dirs() -> list[str]:
    """Folders where a wheel may have put Embree, best first. Nothing is imported to find them."""
    found: list[Path] = []
    spec = importlib.util.find_spec("embreex")
    if spec is not None and spec.origin is not None:
        found.append(Path(spec.origin).parent.parent)
    found += [Path(sysconfig.get_path(name)) for name in ("platlib", "purelib")]
    found += [Path(folder) for folder in site.getsitepackages()]
    if site.ENABLE_USER_SITE:
        found.append(Path(site.getusersitepackages()))
    return [str(folder) for folder in dict.fromkeys(found) if folder.is_dir()]


def _handed_over(arrays: list[NDArray[Any]]) -> Iterator[NDArray[Any]]:
    """The arrays one by one, none of them held any longer; the list is empty in the end."""
    arrays.reverse()
    while arrays:
        yield arrays.pop()


def _note(notes: list[str], notice: str | None) -> None:
    if notice is not None:
        notes.append(notice)


def _no_parameters(parameters: Mapping[str, Any], what: str) -> None:
    if parameters:
        raise ValueError(
            f"`{next(iter(parameters))}` was given as a parameter of the XML file, but `scene` is {what}"
        )


def _one_scene(loaded: Any, name: str) -> Any:
    if not hasattr(loaded, "class_name") or loaded.class_name() != "Scene":
        raise ValueError(f"{name}: holds a {type(loaded).__name__}, not a scene")
    return loaded


def _texts(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Values as they would stand in an XML file."""
    return {
        name: str(value).lower() if isinstance(value, bool) else str(value)
        for name, value in parameters.items()
    }


def _matrix(values: ArrayLike, name: str) -> F32:
    array = np.ascontiguousarray(values, np.float32)
    if array.ndim != 2:
        raise ValueError(
            f"`{name}` has shape {array.shape}; expected two axes, a row for each path"
        )
    return array
