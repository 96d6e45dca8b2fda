"""What bump maps need of a surface: ∂p/∂v of every shape, and the image that comes of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from tests.conftest import LLVM
from tests.support.core import core_scene, our_runs
from tests.support.meshes import write_octahedron
from tests.support.runs import truth_runs
from tests.support.values import F32, first_rows, points, vector3
from tests.support.welch import ALPHA, welch

pytestmark = pytest.mark.parity

Description = dict[str, Any]


def _turned() -> Any:
    return mi.ScalarTransform4f().rotate([0.6, 0, 0.8], 40).scale([0.9, 0.7, 0.8])


SHAPES: dict[str, Callable[[Path], Description]] = {
    "rectangle": lambda _: {"type": "rectangle", "to_world": _turned()},
    "disk": lambda _: {"type": "disk", "to_world": _turned()},
    "cylinder": lambda _: {
        "type": "cylinder",
        "radius": 0.5,
        "p0": [0, -0.6, 0],
        "p1": [0.2, 0.5, 0],
    },
    "sphere": lambda _: {
        "type": "sphere",
        "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 30),
    },
    "cube": lambda _: {"type": "cube", "to_world": _turned()},
    "mesh-without-uv": lambda folder: {
        "type": "ply",
        "filename": str(write_octahedron(folder / "ball.ply")),
        "to_world": _turned(),
    },
    "mesh-of-one-uv": lambda folder: {
        "type": "ply",
        "filename": str(write_octahedron(folder / "ball.ply", uv=True)),
        "to_world": _turned(),
    },
    "mesh-of-one-uv-flipped": lambda folder: {
        "type": "ply",
        "filename": str(write_octahedron(folder / "ball.ply", uv=True)),
        "to_world": _turned(),
        "flip_normals": True,
        "face_normals": True,
    },
}


def _bumps(nested: Description) -> Description:
    texels = np.random.default_rng(5).uniform(0, 1, (6, 9, 1)).astype(np.float32)
    heights = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}
    return {"type": "bumpmap", "heights": heights, "nested": nested, "scale": 0.15}


def _scene(shape: Description) -> mi.Scene:
    film = {"type": "hdrfilm", "width": 32, "height": 32, "pixel_format": "rgb"}
    view = mi.ScalarTransform4f().look_at(origin=[1, -3, 2], target=[0, 0, 0], up=[0, 0, 1])
    camera = {"type": "perspective", "fov": 45, "to_world": view}
    lamp = mi.ScalarTransform4f().translate([1, -1, 3]).rotate([1, 0, 0], 180)
    bsdf = _bumps({"type": "roughplastic", "alpha": 0.2})
    return mi.load_dict(
        {
            "type": "scene",
            "camera": camera | {"film": film | {"rfilter": {"type": "box"}}},
            "shape": shape | {"bsdf": {"type": "twosided", "nested": bsdf}},
            "lamp": {"type": "rectangle", "to_world": lamp, "light": {"type": "area"}},
            "sky": {"type": "constant", "radiance": 0.3},
        }
    )


def _rays(rng: np.random.Generator, n: int) -> tuple[F32, F32]:
    """From a sphere around, towards points near the middle."""
    origin = rng.normal(size=(n, 3))
    origin *= 5 / np.linalg.norm(origin, axis=1, keepdims=True)
    d = rng.uniform(-0.7, 0.7, (n, 3)) - origin
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return origin.astype(np.float32), d.astype(np.float32)


@pytest.mark.parametrize("name", SHAPES)
def test_derivatives_are_mitsubas(name: str, tmp_path: Path) -> None:
    """∂p/∂v at 10,000 rays' hits, to 1e-3 of its length."""
    mi.set_variant(LLVM)
    scene = mi.load_dict(
        {
            "type": "scene",
            "camera": {"type": "perspective"},
            "shape": SHAPES[name](tmp_path) | {"bsdf": {"type": "diffuse"}},
        }
    )
    core, _ = core_scene(scene)
    origin, d = _rays(np.random.default_rng(6), 10_000)
    ours = core.ray_intersect(origin, d)
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(origin.T), vector3(d)), mi.RayFlags.All, True)
    both = ours["valid"] & np.array(si.is_valid())
    assert both.sum() > 1000
    theirs = points(si.dp_dv)
    length = np.linalg.norm(theirs, axis=1)
    wrong = np.linalg.norm(ours["dp_dv"] - theirs, axis=1) > 1e-3 * np.maximum(length, 1e-2)
    wrong &= both
    # Edges of the cube may go to either face.
    assert np.count_nonzero(wrong) <= 3, first_rows(wrong, ours=ours["dp_dv"], theirs=theirs)


@pytest.mark.parametrize("parametrisation", ["bsdf", "cosine"])
@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.stat
def test_bumped_shapes_have_mitsubas_light(
    name: str, parametrisation: str, tmp_path: Path, artifacts: Path
) -> None:
    """H0: equal means of one-bounce light (two for the cosine), 12 seeds × 32 spp a side."""
    mi.set_variant(LLVM)
    scene = _scene(SHAPES[name](tmp_path))
    k = 1 if parametrisation == "bsdf" else 2
    truth = truth_runs(scene, k=k, seeds=range(12), spp=32)
    ours = our_runs(
        core_scene(scene)[0],
        seeds=range(1000, 1012),
        spp=32,
        k=k,
        parametrisation=parametrisation,
        emitter_strategy="mis",
    )
    r = welch(truth, ours)
    assert r.p > ALPHA / 2, r.explain(artifacts)
