"""The switches of normal maps that Mitsuba does not show are found by their effect."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from tests.exports import Description, bitmap, bsdf_of

NESTED: dict[str, Description] = {
    "diffuse": {"type": "diffuse"},
    "twosided": {"type": "twosided", "nested": {"type": "roughconductor", "alpha": 0.3}},
    "mirror": {"type": "conductor"},
    "glass": {"type": "dielectric"},
}


def _texels(slant: float) -> np.ndarray:
    """Normals up to `slant` off in x and y."""
    xy = np.random.default_rng(1).uniform(-slant, slant, (6, 4, 2))
    n = np.concatenate([xy, np.full((6, 4, 1), 0.8)], axis=2)
    n /= np.linalg.norm(n, axis=2, keepdims=True)
    return (0.5 + 0.5 * n).astype(np.float32)


@pytest.mark.parametrize(("flip", "soften"), list(product((True, False), repeat=2)))
@pytest.mark.parametrize("nested", NESTED)
def test_switches_are_found(variant: str, nested: str, flip: bool, soften: bool) -> None:
    description = {
        "type": "normalmap",
        "normalmap": bitmap(_texels(0.6)),
        "nested": NESTED[nested],
        "flip_invalid_normals": flip,
        "use_shadowing_function": soften,
    }
    _, entry = bsdf_of(description)
    assert entry["type"] == "normalmap"
    assert (entry["flip_invalid_normals"], entry["use_shadowing_function"]) == (flip, soften)


def test_a_flat_map_has_the_defaults(variant: str) -> None:
    flat = np.tile(np.array([0.5, 0.5, 1], np.float32), (2, 2, 1))
    description = {
        "type": "normalmap",
        "normalmap": bitmap(flat),
        "nested": {"type": "diffuse"},
        "use_shadowing_function": False,
    }
    _, entry = bsdf_of(description)
    assert (entry["flip_invalid_normals"], entry["use_shadowing_function"]) == (True, True)
