"""What the tests of the export share: small scenes, and reading entries of a description."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from pssflow.export import Export, export

Description = dict[str, Any]


def load(**parts: Any) -> Any:
    """A scene of the given parts, with a small camera unless one is among them."""
    camera = {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}}
    return mi.load_dict({"type": "scene", "camera": camera} | parts)


def rgb(*value: float) -> Description:
    return {"type": "rgb", "value": list(value)}


def named(export: Export, kind: str, name: str) -> Description:
    """The only entry of a kind with this id."""
    (entry,) = (entry for entry in export.description[kind] if entry["id"] == name)
    return entry


def bsdf_of(description: Description) -> tuple[Export, Description]:
    """Exports a sphere with this BSDF; the export and the BSDF's entry."""
    exported = export(load(ball={"type": "sphere", "material": description}))
    return exported, exported.description["bsdfs"][exported.description["shapes"][0]["bsdf"]]


def texture(exported: Export, index: int) -> Description:
    return exported.description["textures"][index]


def value(exported: Export, index: int) -> list[float]:
    """A constant texture's value."""
    entry = texture(exported, index)
    assert entry["type"] == "constant", entry
    return entry["value"]


def check_references(exported: Export) -> None:
    """Arrays are C-contiguous, of two types, and used once each; indices point at entries."""
    description = exported.description
    used = []
    instances = [shape for shape in description["shapes"] if shape["type"] == "instance"]
    assert all(0 <= shape["group"] < len(description["groups"]) for shape in instances)
    shapes = [shape for shape in description["shapes"] if shape["type"] != "instance"]
    shapes += [shape for group in description["groups"] for shape in group["shapes"]]
    for shape in shapes:
        assert 0 <= shape["bsdf"] < len(description["bsdfs"])
        assert shape["emitter"] is None or shape["emitter"] < len(description["emitters"])
        if shape["type"] == "mesh":
            positions, faces = exported.arrays[shape["positions"]], exported.arrays[shape["faces"]]
            assert (positions.dtype, positions.shape[1]) == (np.float32, 3)
            assert (faces.dtype, faces.shape[1]) == (np.uint32, 3)
            assert faces.max() < len(positions)
            used += [shape[k] for k in ("positions", "faces", "normals", "texcoords")]
    textures = list(description["textures"])
    for entry in textures:  # grows: boards hold two textures each
        textures += [entry[name] for name in ("color0", "color1") if name in entry]
    used += [entry["data"] for entry in textures if entry["type"] == "bitmap"]
    used += [entry["data"] for entry in description["emitters"] if entry["type"] == "envmap"]
    assert sorted(i for i in used if i is not None) == list(range(len(exported.arrays)))
    assert all(array.flags.c_contiguous for array in exported.arrays)
    for i, emitter in enumerate(description["emitters"]):
        if emitter["type"] == "area":
            assert description["shapes"][emitter["shape"]]["emitter"] == i


def bitmap(pixels: NDArray[Any], **options: Any) -> Description:
    """A bitmap that is `raw` and keeps its precision, unless said otherwise."""
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True} | options
