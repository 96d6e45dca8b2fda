"""Textures by value: every filter and wrap mode, turned and scaled, colours and scalars."""

from __future__ import annotations

from itertools import product
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from tests.conftest import LLVM
from tests.support.core import core_scene
from tests.support.values import disagreements, first_rows, interaction, points

pytestmark = pytest.mark.parity

Description = dict[str, Any]


def _maps() -> dict[str, Any]:
    T = mi.ScalarTransform3f
    return {
        "plain": T(),
        "turned": T().rotate(33).scale([1.7, 0.6]),
        "moved": T().translate([0.3, -0.8]),
    }


def _texels(channels: int, dtype: type) -> np.ndarray:
    """A 6 × 11 image, neither square nor symmetric."""
    texels = np.random.default_rng(channels).uniform(0.05, 0.95, (6, 11, channels))
    return (texels * 255).astype(np.uint8) if dtype is np.uint8 else texels.astype(np.float32)


def _cases() -> dict[str, Description]:
    cases: dict[str, Description] = {
        "constant": {"type": "rgb", "value": [0.1, 0.5, 0.7]},
    }
    for filter_type, wrap, (name, to_uv), channels in product(
        ("bilinear", "nearest"), ("repeat", "mirror", "clamp"), _maps().items(), (1, 3)
    ):
        cases[f"{filter_type}-{wrap}-{name}-{channels}"] = {
            "type": "bitmap",
            "bitmap": mi.Bitmap(_texels(channels, np.float32)),
            "raw": True,
            "filter_type": filter_type,
            "wrap_mode": wrap,
            "to_uv": to_uv,
        }
    for name, to_uv in _maps().items():
        cases[f"checkerboard-{name}"] = {"type": "checkerboard", "to_uv": to_uv}
    cases["checkerboard-nearest-nested"] = {
        "type": "checkerboard",
        "to_uv": _maps()["turned"],
        "color0": {"type": "rgb", "value": [0.1, 0.8, 0.3]},
        "color1": cases["nearest-repeat-turned-3"],
    }
    for channels, name in ((4, "alpha"), (2, "grey-alpha")):
        for raw in (False, True):
            bitmap = mi.Bitmap(_texels(channels, np.uint8))
            cases[f"{name}-raw-{raw}"] = {"type": "bitmap", "bitmap": bitmap, "raw": raw}
    spectrum = [(400, 0.2), (550, 0.7), (700, 0.4)]
    cases["constant-spectrum"] = {"type": "spectrum", "value": spectrum}
    cases["constant-uniform"] = {"type": "uniform", "value": 0.37}
    cases["constant-srgb"] = {"type": "srgb", "color": [0.1, 0.4, 0.9]}
    for raw in (False, True):
        bitmap = mi.Bitmap(_texels(3, np.uint8))
        cases[f"bytes-raw-{raw}"] = {"type": "bitmap", "bitmap": bitmap, "raw": raw}
    return cases


def test_values_are_mitsubas() -> None:
    """Every case at 10,000 places in [−2, 3]², within 1e-4.

    At a texel's very edge `nearest` may choose the neighbour: three times at most.
    """
    mi.set_variant(LLVM)
    cases = _cases()
    camera = {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}}
    balls = {
        name: {
            "type": "sphere",
            "center": [3.0 * i, 0, 0],
            "id": name,
            "bsdf": {"type": "diffuse", "reflectance": texture},
        }
        for i, (name, texture) in enumerate(cases.items())
    }
    scene = mi.load_dict({"type": "scene", "camera": camera} | balls)
    core, exported = core_scene(scene)
    shapes = {shape["id"]: shape for shape in exported.description["shapes"]}
    uv = np.random.default_rng(21).uniform(-2, 3, (10_000, 2)).astype(np.float32)

    failures = []
    for name, description in cases.items():
        bsdf = exported.description["bsdfs"][shapes[name]["bsdf"]]
        ours = core.texture_eval(bsdf["reflectance"], uv)
        theirs = points(mi.load_dict(description).eval(interaction(uv)))
        assert theirs.std(axis=0).max() > (0.05 if not name.startswith("constant") else -1)
        wrong = disagreements(ours, theirs, rel=1e-4, floor=1.0)
        if np.count_nonzero(wrong) > (3 if "nearest" in name else 0):
            failures.append(f"{name}: {first_rows(wrong, uv=uv, ours=ours, theirs=theirs)}")
    assert not failures, "\n".join(failures)
