"""BSDFs of a description in words, for `pssflow info`: how each was understood."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .walk import Entry

NESTED = ("front", "back", "first", "second", "nested")
"""Keys of a BSDF's entry that are indices of other BSDFs; all other whole numbers are indices of textures."""


def understood(
    entries: Mapping[str, Sequence[Entry]], arrays: Sequence[NDArray[Any]]
) -> list[dict[str, Any]]:
    """Every BSDF that a shape wears: its id, how many shapes wear it, and what it is in words."""
    shapes = [*entries["shape"], *(s for group in entries["group"] for s in group["shapes"])]
    worn = Counter(shape["bsdf"] for shape in shapes if shape.get("bsdf", -1) >= 0)
    return [
        {
            "id": entries["BSDF"][index]["id"],
            "shapes": count,
            "what": bsdf_in_words(entries, arrays, index),
        }
        for index, count in sorted(worn.items())
    ]


def bsdf_in_words(
    entries: Mapping[str, Sequence[Entry]], arrays: Sequence[NDArray[Any]], index: int
) -> str:
    """As `twosided(diffuse(reflectance=bitmap 512×512))`; what was refused is a question mark."""
    if index < 0:
        return "?"
    entry = entries["BSDF"][index]
    parts: list[str] = []
    for key, value in entry.items():
        if key in ("type", "id") or value is None:
            continue
        if key in NESTED:
            words = bsdf_in_words(entries, arrays, value)
            if words not in parts:  # both sides of a `twosided`, as a rule
                parts.append(words)
        elif isinstance(value, int) and not isinstance(value, bool):
            parts.append(f"{key}={_texture(entries, arrays, value)}")
        elif isinstance(value, float):
            parts.append(f"{key}={value:.4g}")
        elif value is True:
            parts.append(key)
        elif isinstance(value, str):
            parts.append(value)
    return f"{entry['type']}({', '.join(parts)})" if parts else entry["type"]


def _texture(
    entries: Mapping[str, Sequence[Entry]], arrays: Sequence[NDArray[Any]], index: int
) -> str:
    if index < 0:
        return "?"
    entry = entries["texture"][index]
    if entry["type"] == "constant":
        value = entry["value"]
        alike = len(set(value)) == 1
        return f"{value[0]:.3g}" if alike else "(" + " ".join(f"{x:.3g}" for x in value) + ")"
    if entry["type"] == "bitmap":
        height, width, _ = arrays[entry["data"]].shape
        return f"bitmap {width}×{height}"
    return f"{entry['type']} {entry.get('name', '')}".strip()
