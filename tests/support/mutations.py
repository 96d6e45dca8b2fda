"""Random damage to scene files and to what was exported from scenes: the same for the same number."""

from __future__ import annotations

import copy
import random
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

NUMBERS = ("nan", "inf", "-inf", "-1", "0", "1e38", "1e-40", "1e400", "-0.0", "4294967296", "0.5")
TEXTS = ("", "abc", "1 2", "1,2,3", "$missing", "true", "ä", "../../etc", "0x10", " ")
PLUGINS = (
    *("diffuse", "conductor", "dielectric", "principled", "null", "mask", "twosided", "bumpmap"),
    *("polarizer", "hair", "sphere", "cylinder", "rectangle", "cube", "obj", "ply", "sdfgrid"),
    *("instance", "shapegroup", "perspective", "orthographic", "thinlens", "batch", "distant"),
    *("hdrfilm", "specfilm", "point", "area", "constant", "envmap", "directional", "sunsky"),
    *("independent", "multijitter", "box", "tent", "catmullrom", "bitmap", "checkerboard"),
    *("mesh_attribute", "homogeneous", "path", "volpath", "no_such_plugin"),
)
TAGS = ("bsdf", "shape", "emitter", "texture", "sensor", "medium", "float", "string", "rgb", "ref")


def mutate_xml(text: str, seed: int) -> str:
    """A scene file with one or two wounds; every eighth is no XML any more, more often than not."""
    rng = random.Random(seed)
    if seed % 8 == 0:
        return _mutate_text(text, rng)
    root = ElementTree.fromstring(text)
    for _ in range(rng.choice([1, 1, 1, 2])):
        _mutate_tree(root, rng)
    return ElementTree.tostring(root, encoding="unicode")


def _mutate_text(text: str, rng: random.Random) -> str:
    at = rng.randrange(len(text))
    return rng.choice(
        [
            text[:at],
            text[:at] + text[at + rng.randint(1, 40) :],
            text[:at] + rng.choice("<>\"'&/=$\0ß") + text[at + 1 :],
            text[:at] + text[max(at - 200, 0) : at] + text[at:],
        ]
    )


def _mutate_tree(root: ElementTree.Element, rng: random.Random) -> None:
    parents = [element for element in root.iter() if len(element)]
    parent = rng.choice(parents)
    children = list(parent)
    child = rng.choice(children)
    kind = rng.randrange(14)
    if kind == 0:
        parent.remove(child)
    elif kind == 1:
        parent.append(copy.deepcopy(child))
    elif kind == 2:
        other = rng.choice(parents)
        other.append(copy.deepcopy(child))
    elif kind == 3:
        child.tag = rng.choice(TAGS)
    elif kind == 4:
        element = rng.choice([e for e in root.iter() if "type" in e.attrib])
        element.set("type", rng.choice(PLUGINS))
    elif kind == 5:
        element = rng.choice(list(root.iter()))
        if element.attrib:
            del element.attrib[rng.choice(sorted(element.attrib))]
    elif kind == 6:
        element = rng.choice([e for e in root.iter() if "name" in e.attrib])
        others = [e.get("name", "") for e in root.iter() if "name" in e.attrib]
        element.set("name", rng.choice([*others, *TEXTS]))
    else:
        element = rng.choice([e for e in root.iter() if e.attrib.keys() - {"name", "type"}])
        name = rng.choice(sorted(element.attrib.keys() - {"name", "type"}))
        element.set(name, rng.choice([*NUMBERS, *NUMBERS, *TEXTS]))


def mutate_export(
    description: dict[str, Any], arrays: list[NDArray[Any]], seed: int
) -> tuple[dict[str, Any], list[Any]]:
    """Copies of a description and its arrays with one or two wounds."""
    rng = random.Random(seed)
    description, arrays = copy.deepcopy(description), [array.copy() for array in arrays]
    for _ in range(rng.choice([1, 1, 2])):
        if arrays and rng.random() < 0.4:
            _mutate_arrays(arrays, rng)
        else:
            _mutate_leaf(description, rng)
    return description, arrays


def _mutate_leaf(description: Any, rng: random.Random) -> None:
    """Walks down at random and changes, removes, or adds something there."""
    node: Any = description
    while True:
        keys = sorted(node) if isinstance(node, dict) else list(range(len(node)))
        if not keys:
            if isinstance(node, list):
                node.append(0)
            else:
                node["stranger"] = 1
            return
        key = rng.choice(keys)
        child = node[key]
        if not isinstance(child, (dict, list)) or rng.random() < 0.1:
            break
        node = child
    kind = rng.randrange(12)
    if isinstance(child, float) and kind > 1:
        wounds: list[Any] = [-child, child * 1e6, 0.0, -0.0, 0.5, 1.0, -1.0, 1e38, -1e38, 1e-40]
    elif isinstance(child, int) and not isinstance(child, bool) and kind > 1:
        wounds = [0, 1, 2, 3, 7, child + 1, child - 1, 1 << 16, (1 << 31) - 1, (1 << 32) - 1]
    else:
        wounds = [-1, 0, 2.5, 1e300, 2**70, "", "ggx", None, True, False, [], {}, float("nan")]
    if kind == 0:
        del node[key]
    elif kind == 1:
        if isinstance(node, dict):
            node["stranger"] = child
        else:
            node.append(copy.deepcopy(child))
    else:
        node[key] = rng.choice(wounds)


def _mutate_arrays(arrays: list[Any], rng: random.Random) -> None:
    i = rng.randrange(len(arrays))
    array = arrays[i]
    kind = rng.randrange(12)
    if kind == 0:
        del arrays[i]
    elif kind == 1:
        arrays[i] = arrays[rng.randrange(len(arrays))]
    elif kind == 2:
        arrays[i] = array.astype(rng.choice([np.float64, np.int32, np.uint8, np.float16, bool]))
    elif kind == 3:
        arrays[i] = array.astype(rng.choice([np.float32, np.uint32]))
    elif kind == 4:
        arrays[i] = array[: rng.randrange(len(array) + 1)] if array.ndim else array
    elif kind == 5:
        arrays[i] = array.ravel()
    elif kind == 6:
        arrays[i] = array[..., None]
    elif kind == 7:
        arrays[i] = array[::-1] if array.ndim else array
    elif kind == 8:
        arrays[i] = np.asfortranarray(array)
    elif array.size and array.dtype.kind in "fu":
        values = (
            [np.nan, np.inf, -np.inf, 1e38, -1e38, 1e-40, 0.0, -1.0]
            if array.dtype.kind == "f"
            else [0, 1, 7, 2**31, 2**32 - 1]
        )
        for _ in range(rng.choice([1, 1, 10, array.size])):
            array.flat[rng.randrange(array.size)] = rng.choice(values)
