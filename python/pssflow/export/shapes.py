"""Shapes, in an order that does not change from process to process.

To add one: write a converter, and give it a row in `SHAPES`.
"""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from .bsdfs import export_bsdf
from .walk import (
    Converter,
    Entry,
    Fields,
    RefusedError,
    Walk,
    class_of,
    floats,
    matrix,
    plugin_of,
    printed,
    rows,
)

INVERSE_TOLERANCE = 1e-3
"""Largest entry by which a transform times its inverse may miss the identity, scale factors aside."""


def ordered_shapes(shapes: list[Any]) -> list[tuple[str, Any]]:
    """(key, shape) of all shapes. Keys are unique, and the same for the same scene in each process.

    A shape that has an id of its own keeps it. Mitsuba drops the ids of meshes that it merges, and their order in
    `scene.shapes()` hangs on addresses: shapes without an id, or with one that others share, are sorted by what they
    are.
    """
    counts = Counter(shape.id() for shape in shapes)
    named = [shape for shape in shapes if shape.id() and counts[shape.id()] == 1]
    others = [shape for shape in shapes if not (shape.id() and counts[shape.id()] == 1)]
    named.sort(key=lambda shape: shape.id())
    others.sort(key=_content)

    listed = [(shape.id(), shape) for shape in named]
    taken = {key for key, _ in listed}
    used: Counter[str] = Counter()
    for shape in others:
        merged = " (merged)" if " + " in _mesh_name(shape) else ""
        stem = shape.id() or _type_name(shape)
        while (key := f"{stem}_{used[stem]}{merged}") in taken:
            used[stem] += 1
        used[stem] += 1
        listed.append((key, shape))
    return listed


def export_shape(walk: Walk, key: str, shape: Any, emitter: int | None) -> None:
    """Appends a shape's entry; a refused one leaves a line in `walk.unsupported` instead."""
    entry = _entry(walk, key, shape, emitter)
    if entry is not None:
        walk.entries["shape"].append(entry)


def _entry(walk: Walk, key: str, shape: Any, emitter: int | None) -> Entry | None:
    outer, walk.shape = walk.shape, key
    entry = walk.convert(SHAPES, "shape", shape, key)
    # An instance's shapes have BSDFs of their own.
    if entry is not None and entry["type"] != "instance":
        for medium in (shape.interior_medium(), shape.exterior_medium()):
            if medium is not None:
                walk.refuse("medium", plugin_of(medium), key, instead="is left out")
        entry["bsdf"] = export_bsdf(walk, shape.bsdf(), f"{key}.bsdf")
        _attributes(walk, key, shape, entry)
        entry["emitter"] = emitter
    walk.shape = outer
    return entry


def _attributes(walk: Walk, key: str, shape: Any, entry: Entry) -> None:
    """Adds the attributes that the shape's BSDF asks for."""
    wanted = walk.attributes_of(shape.bsdf())
    held = []
    for name in wanted:
        per, _, _ = name.partition("_")
        parameters = Fields(shape)
        if not shape.is_mesh() or name not in parameters or per not in ("vertex", "face"):
            walk.refuse(
                "texture",
                "mesh_attribute",
                key,
                f'asks for the attribute "{name}", which the shape does not hold',
                "is black there",
            )
            continue
        count = shape.vertex_count() if per == "vertex" else shape.face_count()
        values = rows(parameters[name], 1, np.float32, name)
        channels = values.size // max(count, 1)
        if channels not in (1, 3) or values.size != channels * count:
            walk.refuse(
                "texture",
                "mesh_attribute",
                key,
                f'has {values.size} numbers in "{name}" for {count}, expected 1 or 3 each',
                "is black there",
            )
            continue
        data = walk.add_array(values.reshape(-1, channels))
        held.append({"name": name, "per": per, "data": data, "channels": channels})
    if held:
        entry["attributes"] = held


def _mesh(walk: Walk, obj: Any, where: str) -> Entry:
    positions = rows(obj.vertex_positions_buffer(), 3, np.float32, "vertex_positions")
    faces = rows(obj.faces_buffer(), 3, np.uint32, "faces")
    normals = texcoords = None
    if obj.has_vertex_normals():
        normals = rows(obj.vertex_normals_buffer(), 3, np.float32, "vertex_normals")
        bad = np.logical_not(np.isfinite(normals).all(axis=1))
        if bad.any():
            # A normal of no length leaves the choice to the triangle's other two, or to its facet.
            normals = np.where(np.expand_dims(bad, 1), np.float32(0), normals)
            walk.notes.append(f'"{where}": {bad.sum()} vertex normals are not finite and left out')
    if obj.has_vertex_texcoords():
        texcoords = rows(obj.vertex_texcoords_buffer(), 2, np.float32, "vertex_texcoords")
    for name, array in (("vertex_normals", normals), ("vertex_texcoords", texcoords)):
        if array is not None and len(array) != len(positions):
            raise RefusedError(f"has {len(array)} `{name}` for {len(positions)} positions")
    return {
        "positions": walk.add_array(positions),
        "faces": walk.add_array(faces),
        "normals": None if normals is None else walk.add_array(normals),
        "texcoords": None if texcoords is None else walk.add_array(texcoords),
        "flip_normals": bool(obj.has_flipped_normals()),
    }


def _placed(_walk: Walk, obj: Any, _where: str) -> Entry:
    """Shapes that their transform says all about: rectangle, disk (whose transform holds its flip), cylinder."""
    to_world = checked_matrix(Fields(obj)["to_world"])
    return {"to_world": to_world, "flip_normals": bool(obj.has_flipped_normals())}


def checked_matrix(transform: Any) -> list[float]:
    """A `to_world` whose inverse Mitsuba knows too; raises `RefusedError` for any other."""
    to_world = matrix(transform, "to_world")
    inverse_transpose = floats(transform.inverse_transpose, 16, "to_world")
    linear = np.reshape(to_world, (4, 4))[:3, :3]
    lengths = np.linalg.norm(linear, axis=0)
    inverse = np.reshape(inverse_transpose, (4, 4))[:3, :3].T
    # Mitsuba takes every rotation's inverse for its transpose, also about axes that are not of unit length.
    product = (lengths[:, None] * inverse) @ (linear / np.where(lengths > 0, lengths, 1))
    if np.abs(product - np.eye(3)).max() > INVERSE_TOLERANCE:
        raise RefusedError(
            "has a `to_world` whose inverse in Mitsuba is wrong, so that its normals are; "
            "rotate about axes of length 1"
        )
    return to_world


def _sphere(walk: Walk, obj: Any, where: str) -> Entry:
    placed = _placed(walk, obj, where)
    to_world = np.reshape(placed["to_world"], (4, 4))
    # As Mitsuba does: the first axis alone gives the radius, should the transform scale unevenly.
    return {
        "center": to_world[:3, 3].tolist(),
        "radius": float(np.float32(np.linalg.norm(to_world[:3, 0]))),
        **placed,
    }


def _instance(walk: Walk, obj: Any, _where: str) -> Entry:
    """A view of a group, which is exported when its first instance is met."""
    # Mitsuba shows an instance's group by its name alone.
    found = re.search(r'name = "(.*)"', printed(obj).get("shapegroup", ""))
    name = found.group(1) if found else ""
    if name not in walk.groups:
        raise RefusedError(
            "shows a shapegroup that is no child of the scene; give it an id and refer to it"
        )
    to_world = checked_matrix(Fields(obj)["to_world"])
    if name not in walk.group_indices:
        walk.group_indices[name] = len(walk.entries["group"])
        count = obj.effective_primitive_count()
        walk.entries["group"].append(_group(walk, name, walk.groups[name], count))
    return {"group": walk.group_indices[name], "to_world": to_world}


def _group(walk: Walk, name: str, obj: Any, count: int) -> Entry:
    """A group's entry; `count`: of all its primitives, as an instance tells."""
    shapes = list(Fields(obj).children.values())
    found = sum(shape.effective_primitive_count() for shape in shapes)
    if found != count:
        raise RefusedError(
            f'shows the shapegroup "{name}" of {count} primitives, but its children hold {found}; '
            "give each of its shapes an id of its own"
        )
    entries = [_entry(walk, f"{name}.{key}", shape, None) for key, shape in ordered_shapes(shapes)]
    return {"id": name, "shapes": [entry for entry in entries if entry is not None]}


SHAPES: dict[str, Converter] = {
    "Mesh": Converter("mesh", "mesh", _mesh),
    "OBJMesh": Converter("obj", "mesh", _mesh),
    "PLYMesh": Converter("ply", "mesh", _mesh),
    "SerializedMesh": Converter("serialized", "mesh", _mesh),
    "BlenderMesh": Converter("blender", "mesh", _mesh),
    "Cube": Converter("cube", "mesh", _mesh),
    # A mesh too, but sampled as a rectangle: not triangle by triangle.
    "Rectangle": Converter("rectangle", "rectangle", _placed),
    "Sphere": Converter("sphere", "sphere", _sphere),
    "Disk": Converter("disk", "disk", _placed),
    "Cylinder": Converter("cylinder", "cylinder", _placed),
    "Instance": Converter("instance", "instance", _instance),
}


def _content(shape: Any) -> tuple[str, str, int, bytes, str]:
    """What sorts shapes without an id: things that most edits leave alone come first."""
    faces = 0
    blocks: list[NDArray[Any]] = []
    if class_of(shape) in SHAPES:
        if shape.is_mesh():
            faces = shape.face_count()
            blocks.append(rows(shape.faces_buffer(), 1, np.uint32, "faces"))
            blocks.append(rows(shape.vertex_positions_buffer(), 1, np.float32, "vertex_positions"))
        else:
            # As it is: whether it is finite is asked where the shape is converted, and can be refused.
            transform = Fields(shape)["to_world"].matrix
            blocks.append(np.array(dr.detach(transform), np.float64).ravel())
    digest = hashlib.blake2b(digest_size=16)
    for block in blocks:
        digest.update(block.data)
    return class_of(shape), _mesh_name(shape), faces, digest.digest(), str(shape.bsdf())


def _mesh_name(shape: Any) -> str:
    """File that a mesh came from, or the files that it was merged from; empty for other shapes."""
    return printed(shape).get("name", "").strip('"') if shape.is_mesh() else ""


def _type_name(shape: Any) -> str:
    converter = SHAPES.get(class_of(shape))
    return converter.type if converter else plugin_of(shape)
