"""Turns a loaded `mi.Scene` into what the renderer takes: one JSON description (schema 1) and a list of arrays.

This package is the only place that knows Mitsuba's class and parameter names, and with them its version (3.9).

```
scene ─► shapes, emitters in a stable order ─► converters by class name (SHAPES, BSDFS, …) ─► description + arrays
                                                    └► what has no converter: one line each, then UnsupportedError
```

The scene is read as it is now, edits through `mi.traverse` included, and is never changed. Nothing is parsed again.
Lengths are in the scene's units, radiance in linear sRGB; matrices are rows first. Start reading at `export`; a new
plugin is a converter and a row in the table of its kind (`bsdfs.py`, `textures.py`, `emitters.py`, `shapes.py`,
`sensors.py`).
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
from numpy.typing import NDArray

from .bsdfs import BSDFS
from .describe import understood
from .emitters import EMITTERS, ordered_emitters
from .sensors import FILMS, SENSORS, export_sensor, select_sensor
from .shapes import SHAPES, export_shape, ordered_shapes
from .textures import TEXTURES
from .walk import Entry, Fields, Unsupported, UnsupportedError, Walk, class_of

__all__ = [
    "SCHEMA",
    "SUPPORTED",
    "VARIANTS",
    "Export",
    "Inspection",
    "Unsupported",
    "UnsupportedError",
    "export",
    "inspect_scene",
    "stable_emitter_order",
    "stable_shape_order",
]

SCHEMA = 1
"""Version of the description; the renderer refuses any other."""

VARIANTS = ("scalar_rgb", "llvm_ad_rgb")
"""Mitsuba variants whose scenes can be exported."""

SUPPORTED: dict[str, tuple[str, ...]] = {
    kind: tuple(sorted({converter.plugin for converter in table.values()}))
    for kind, table in {
        "shape": SHAPES,
        "BSDF": BSDFS,
        "texture": TEXTURES,
        "emitter": EMITTERS,
        "sensor": SENSORS,
        "film": FILMS,
    }.items()
}
"""Names of the supported plugins by kind."""

NAMED_IN_ERROR = 3
"""How many kinds of unsupported things an error spells out; the others are counted."""


@dataclass(frozen=True)
class Export:
    """A scene as the renderer takes it."""

    description: Entry
    """The description, of numbers, strings, lists and dictionaries only. Arrays are named by their index."""
    arrays: list[NDArray[Any]]
    """C-contiguous float32, uint8 or uint32. In LLVM variants they may share Mitsuba's memory: don't write to them."""
    shape_order: list[int]
    """For each shape of the description its position in `scene.shapes()`, which differs between processes."""
    emitter_order: list[int]
    """The same for emitters and `scene.emitters()`."""
    notes: list[str]
    """What the image will not show exactly as Mitsuba would; one line each, often none."""
    timings: dict[str, float]
    """`export`: seconds that it took."""

    def json(self) -> str:
        """The description as compact JSON; the same scene gives the same text in each process."""
        return json.dumps(self.description, separators=(",", ":"), allow_nan=False)


@dataclass(frozen=True)
class Inspection:
    """What was understood of a scene, and what was not."""

    counts: dict[str, dict[str, int]]
    """How often each supported plugin was met, by kind; shared BSDFs and textures count once."""
    triangles: int
    """Of all supported meshes, two for each rectangle; those of groups once, however many instances show them."""
    array_bytes: int
    """Size of all arrays."""
    bsdfs: list[dict[str, Any]]
    """Every BSDF that a shape wears: `id`, `shapes` (how many wear it), `what` (in words)."""
    unsupported: list[Unsupported]
    """Everything that `export` would refuse; empty if the scene can be rendered."""
    notes: list[str]
    """As in `Export`."""


def export(
    scene: Any,
    sensor: Any = 0,
    *,
    hide_emitters: bool | None = None,
    approximate: bool = False,
) -> Export:
    """Exports a scene in its current state.

    Args:
        scene: an `mi.Scene` of one of `VARIANTS`, which must be the active one.
        sensor: index of one of its sensors, or a sensor object.
        hide_emitters: whether camera rays pass through the surfaces of emitters; None for what the scene's integrator
            says, as it would render it.
        approximate: whether what is not supported is replaced where there is a replacement; a note names each.

    Raises:
        UnsupportedError: the scene holds what cannot be rendered. All of it was looked for; the first few are named.
        ValueError: there is no such sensor.
        TypeError: `scene` is no scene.
    """
    start = time.perf_counter()
    walk, shapes, emitters, (camera, film) = _walk(scene, sensor, approximate=approximate)
    if walk.unsupported:
        raise UnsupportedError(_explain(walk.unsupported))
    description = {
        "schema": SCHEMA,
        "variant": mi.variant(),
        "textures": walk.entries["texture"],
        "bsdfs": walk.entries["BSDF"],
        "shapes": walk.entries["shape"],
        "groups": walk.entries["group"],
        "emitters": walk.entries["emitter"],
        "sensor": camera,
        "film": film,
        "hide_emitters": hides_emitters(scene) if hide_emitters is None else bool(hide_emitters),
    }
    return Export(
        description=description,
        arrays=walk.arrays,
        shape_order=_positions(scene.shapes(), shapes),
        emitter_order=_positions(scene.emitters(), emitters),
        notes=walk.notes,
        timings={"export": time.perf_counter() - start},
    )


def hides_emitters(scene: Any) -> bool:
    """Whether the scene's integrator hides the surfaces of emitters from the camera; by default Mitsuba shows them."""
    return bool(getattr(scene.integrator(), "hide_emitters", False))


def inspect_scene(scene: Any, sensor: Any = 0, *, approximate: bool = False) -> Inspection:
    """Goes through a scene as `export` does, but reports what is unsupported instead of raising.

    Raises:
        UnsupportedError: the scene's variant is not supported.
        ValueError, TypeError: as in `export`.
    """
    walk, *_ = _walk(scene, sensor, approximate=approximate)
    shapes = walk.entries["shape"] + [
        shape for group in walk.entries["group"] for shape in group["shapes"]
    ]
    meshes = [shape for shape in shapes if shape["type"] == "mesh"]
    triangles = sum(len(walk.arrays[mesh["faces"]]) for mesh in meshes)
    return Inspection(
        counts={kind: dict(sorted(walk.counts[kind].items())) for kind in SUPPORTED},
        triangles=triangles + 2 * walk.counts["shape"]["rectangle"],
        array_bytes=sum(array.nbytes for array in walk.arrays),
        bsdfs=understood(walk.entries, walk.arrays),
        unsupported=walk.unsupported,
        notes=walk.notes,
    )


def stable_shape_order(scene: Any) -> list[int]:
    """Positions in `scene.shapes()` in the order of the description."""
    _check_scene(scene)
    return _positions(scene.shapes(), [shape for _, shape in ordered_shapes(scene.shapes())])


def stable_emitter_order(scene: Any) -> list[int]:
    """Positions in `scene.emitters()` in the order of the description, which is that of the emitters' indices."""
    _check_scene(scene)
    emitters = ordered_emitters(scene.emitters(), ordered_shapes(scene.shapes()))
    return _positions(scene.emitters(), [emitter for _, emitter, _ in emitters])


def _walk(
    scene: Any, sensor: Any, *, approximate: bool
) -> tuple[Walk, list[Any], list[Any], tuple[Entry | None, Entry | None]]:
    """Visits everything once; returns the walk, shapes and emitters in the description's order, and sensor and film."""
    _check_scene(scene)
    camera = select_sensor(scene, sensor)
    # Mitsuba calls children without an id `object_<address>`: no name for a second process.
    children = Fields(scene).children.items()
    names = {child: name for name, child in children if not name.startswith("object_")}
    walk = Walk(names, approximate=approximate)
    walk.groups = {
        child.id(): child for _, child in children if class_of(child) == "ShapeGroupPlugin"
    }

    walk.shutter = (float(camera.shutter_open()), float(camera.shutter_open_time()))

    shapes = ordered_shapes(scene.shapes())
    emitters = ordered_emitters(scene.emitters(), shapes)
    emitter_of = {shape: i for i, (_, _, shape) in enumerate(emitters) if shape is not None}
    for index, (key, shape) in enumerate(shapes):
        export_shape(walk, key, shape, emitter_of.get(index))
    for key, emitter, index in emitters:
        walk.shape = None if index is None else shapes[index][0]
        owner = None if index is None else shapes[index][1]
        entry = walk.convert(EMITTERS, "emitter", emitter, key, owner, index)
        if entry is not None:
            walk.entries["emitter"].append(entry)
    walk.shape = None
    # Emitters that came out of another one: behind all others, whose indices stay.
    walk.entries["emitter"] += walk.entries["sun"]
    emitters += [("", sky, None) for sky in walk.suns]
    entries = export_sensor(walk, camera)
    return walk, [shape for _, shape in shapes], [emitter for _, emitter, _ in emitters], entries


def _check_scene(scene: Any) -> None:
    """Refuses what is no scene, and scenes of other variants."""
    if not hasattr(scene, "class_name") or scene.class_name() != "Scene":
        raise TypeError(
            f"`scene` is a {type(scene).__name__}, expected a `mi.Scene` as `mi.load_file` returns it"
        )
    variant, active = scene.variant_name(), mi.variant()
    if variant not in VARIANTS:
        raise UnsupportedError(
            f'scene: variant "{variant}" is not supported (supported: {", ".join(VARIANTS)}). '
            f'Call `mi.set_variant("{VARIANTS[-1]}")` and load the scene again'
        )
    if variant != active:
        raise UnsupportedError(
            f'scene: it was loaded in variant "{variant}", but "{active}" is active. '
            f'Call `mi.set_variant("{variant}")` first'
        )


def _explain(unsupported: list[Unsupported]) -> str:
    """One line that names the first few, what is supported of their kinds, and what to do."""
    alike: dict[tuple[str, str, str | None], list[Unsupported]] = {}
    for thing in unsupported:
        alike.setdefault((thing.kind, thing.plugin, thing.reason), []).append(thing)
    groups = [
        f"{things[0]}" + (f" (and {len(things) - 1} more like it)" if len(things) > 1 else "")
        for things in alike.values()
    ]
    named = "; ".join(groups[:NAMED_IN_ERROR])
    more = len(groups) - NAMED_IN_ERROR
    counted = f"; and {more} more, listed by `pssflow info`" if more > 0 else ""
    unknown = dict.fromkeys(thing.kind for thing in unsupported if thing.reason is None)
    kinds = [kind for kind in unknown if kind in SUPPORTED]
    supported = "; ".join(f"{kind}s: {', '.join(SUPPORTED[kind])}" for kind in kinds)
    hint = f" (supported {supported})" if supported else ""
    remedy = "Replace them in the scene, "
    if all(thing.instead is not None for thing in unsupported):
        remedy += "let `--approximate` (in Python `approximate=True`) replace them, "
    return f"{named}{counted}{hint}. {remedy}or render this scene with Mitsuba's `path`"


def _positions(objects: list[Any], ordered: list[Any]) -> list[int]:
    """Where each of `ordered` stands in `objects`."""
    place = {obj: i for i, obj in enumerate(objects)}
    return [place[obj] for obj in ordered]
