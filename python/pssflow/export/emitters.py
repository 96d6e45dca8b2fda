"""Emitters, in an order that does not change from process to process.

To add one: write a converter, and give it a row in `EMITTERS`.
"""

from __future__ import annotations

from typing import Any

from .textures import constant_value, export_texture
from .walk import Converter, Entry, Fields, RefusedError, Walk, class_of, floats, number, plugin_of


def ordered_emitters(
    emitters: list[Any], shapes: list[tuple[str, Any]]
) -> list[tuple[str, Any, int | None]]:
    """(id, emitter, index of its shape or None) of all emitters: those of shapes in the shapes' order, then the others.

    `scene.emitters()` comes in another order in each process, and a table learned over emitters must outlive one.
    The others are sorted by class, then by their id in the scene, then by what they are.
    """
    known = set(emitters)
    listed: list[tuple[str, Any, int | None]] = []
    for index, (key, shape) in enumerate(shapes):
        emitter = shape.emitter()
        if emitter is not None and emitter in known:
            listed.append((f"{key}.emitter", emitter, index))
            known.discard(emitter)

    others = sorted(known, key=lambda emitter: (class_of(emitter), emitter.id(), str(emitter)))
    unnamed = 0
    for emitter in others:
        name = emitter.id()
        if not name:
            name, unnamed = f"{plugin_name(emitter)}_{unnamed}", unnamed + 1
        listed.append((name, emitter, None))
    return listed


def plugin_name(emitter: Any) -> str:
    """The plugin's name, whether it is supported or not."""
    converter = EMITTERS.get(class_of(emitter))
    return converter.plugin if converter else plugin_of(emitter)


def _area(walk: Walk, obj: Any, where: str, shape: Any, index: int | None) -> Entry:
    if shape is None or index is None:
        raise RefusedError("has no shape")
    radiance = Fields(obj)["radiance"]
    # Mitsuba finds the place of a texel on the shape through uv, and throws here without them.
    if radiance.is_spatially_varying() and shape.is_mesh() and not shape.has_vertex_texcoords():
        raise RefusedError("has a textured `radiance` on a mesh without texture coordinates")
    return {
        "shape": index,
        "radiance": export_texture(walk, radiance, f"{where}.radiance"),
        "sampling_weight": _sampling_weight(obj),
    }


def _constant(walk: Walk, obj: Any, where: str, _shape: Any, _index: int | None) -> Entry:
    return {
        "radiance": constant_value(walk, Fields(obj)["radiance"], f"{where}.radiance"),
        "sampling_weight": _sampling_weight(obj),
    }


def _point(walk: Walk, obj: Any, where: str, _shape: Any, _index: int | None) -> Entry:
    fields = Fields(obj)
    return {
        "position": floats(fields["position"], 3, "position"),
        "intensity": constant_value(walk, fields["intensity"], f"{where}.intensity"),
        "sampling_weight": _sampling_weight(obj),
    }


EMITTERS: dict[str, Converter] = {
    "AreaLight": Converter("area", "area", _area),
    "ConstantBackgroundEmitter": Converter("constant", "constant", _constant),
    "PointLight": Converter("point", "point", _point),
}


def _sampling_weight(obj: Any) -> float:
    return number(obj.sampling_weight(), "sampling_weight")
