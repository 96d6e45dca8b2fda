"""Rays by value: what they hit, where, and the frame and texture coordinates there."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from pssflow.export.shapes import ordered_shapes
from pssflow.export.walk import Fields
from tests.conftest import LLVM, ROOT
from tests.scenes import SCENES
from tests.support.core import core_scene
from tests.support.values import (
    F32,
    disagreements,
    first_rows,
    points,
    sphere_directions,
    unit_interval,
    vector3,
)

pytestmark = pytest.mark.parity

RAYS = 20_000


def _shapes() -> dict[str, Any]:
    """Every shape, turned, stretched, mirrored and inside out, without a single light."""
    T = mi.ScalarTransform4f
    turn = T().rotate([2 / 3, 1 / 3, 2 / 3], 70)
    grid = (T().translate([x, y, z]) for x in (-3, 0, 3) for y in (-3, 0, 3) for z in (-3, 0, 3))
    teapot = str(ROOT / "scenes" / "teapot" / "meshes" / "teapot.ply")
    shapes = {
        "rectangle": {"type": "rectangle", "to_world": next(grid) @ turn.scale([1.2, 0.6, 1])},
        "rectangle-mirrored": {
            "type": "rectangle",
            "to_world": next(grid) @ turn.scale([-1.2, 0.6, 1]),
        },
        "rectangle-flipped": {
            "type": "rectangle",
            "to_world": next(grid) @ turn,
            "flip_normals": True,
        },
        "cube": {"type": "cube", "to_world": next(grid) @ turn.scale([0.9, 0.5, 1.1])},
        "cube-mirrored": {"type": "cube", "to_world": next(grid) @ turn.scale([-0.9, 0.5, 1.1])},
        "cube-flipped": {"type": "cube", "to_world": next(grid) @ turn, "flip_normals": True},
        "mesh": {"type": "ply", "filename": teapot, "to_world": next(grid) @ turn.scale(0.4)},
        "mesh-flipped": {
            "type": "ply",
            "filename": teapot,
            "to_world": next(grid) @ turn.scale([0.4, 0.3, 0.5]),
            "flip_normals": True,
        },
        "mesh-facets": {
            "type": "ply",
            "filename": teapot,
            "to_world": next(grid) @ turn.scale(0.4),
            "face_normals": True,
        },
        "mesh-mirrored": {
            "type": "ply",
            "filename": teapot,
            "to_world": next(grid) @ turn.scale([0.4, 0.4, -0.4]),
        },
        "disk": {"type": "disk", "to_world": next(grid) @ turn.scale([1.2, 0.7, 1])},
        "disk-flipped": {"type": "disk", "to_world": next(grid) @ turn, "flip_normals": True},
        "disk-mirrored": {"type": "disk", "to_world": next(grid) @ turn.scale([-1, 1, 1])},
        "sphere": {"type": "sphere", "to_world": next(grid) @ turn.scale(1.3)},
        "sphere-flipped": {"type": "sphere", "to_world": next(grid), "flip_normals": True},
        "sphere-mirrored": {
            "type": "sphere",
            "to_world": next(grid) @ turn.scale([-1.1, 1.1, 1.1]),
        },
        "cylinder": {"type": "cylinder", "to_world": next(grid) @ turn.scale([0.7, 0.7, 1.5])},
        "cylinder-flipped": {
            "type": "cylinder",
            "to_world": next(grid) @ turn.scale([0.6, 0.6, 1.2]),
            "flip_normals": True,
        },
        "cylinder-mirrored": {
            "type": "cylinder",
            "to_world": next(grid) @ turn.scale([0.6, -0.6, 1.2]),
        },
    }
    camera = {
        "type": "perspective",
        "fov": 60,
        "to_world": T().look_at(origin=[9, -12, 8], target=[0, 0, 0], up=[0, 0, 1]),
        "film": {"type": "hdrfilm", "width": 64, "height": 64},
    }
    return {"type": "scene", "camera": camera} | shapes


def _instanced() -> dict[str, Any]:
    """Two groups, of several kinds of shapes and of one, each seen three times: turned, stretched and mirrored."""
    T = mi.ScalarTransform4f
    every = _shapes()
    names = ("cube", "mesh", "disk", "sphere", "cylinder-flipped", "mesh-facets")
    groups = {
        "many": {"type": "shapegroup"} | {name: every[name] for name in names},
        "one": {"type": "shapegroup", "lid": {"type": "rectangle"}},
    }
    scene = {"type": "scene", "camera": every["camera"], **groups, "ball": {"type": "sphere"}}
    for group, z in (("many", 0.0), ("one", 2.5)):
        for i, scale in enumerate(([1, 1, 1], [0.7, 1.2, 0.9], [-0.8, 0.8, 1.1])):
            turn = T().rotate([0.6, 0, 0.8], 40.0 * i)
            scene[f"{group}-{i}"] = {
                "type": "instance",
                "to_world": T().translate([5.0 * i - 5, 2.0 * i - 2, z]) @ turn.scale(scale),
                "group": {"type": "ref", "id": group},
            }
    return scene


def _file(folder: Path) -> Callable[[], mi.Scene]:
    return lambda: mi.load_file(str(folder / "scene.xml"))


OURS: dict[str, Callable[[], mi.Scene]] = {
    "every-shape": lambda: mi.load_dict(_shapes()),
    "instances": lambda: mi.load_dict(_instanced()),
    "cornell-box": _file(ROOT / "scenes" / "cornell-box"),
    "teapot": _file(ROOT / "scenes" / "teapot"),
} | {name: lambda make=make: mi.load_dict(make()) for name, make in SCENES.items()}


def _rays(scene: mi.Scene) -> tuple[F32, F32]:
    """Camera rays, and rays between random points of the scene's box: half of each."""
    rng = np.random.default_rng(51)
    half = RAYS // 2
    position = unit_interval(rng, half, 2)
    ray, _ = scene.sensors()[0].sample_ray(
        mi.Float(0), mi.Float(0.5), mi.Point2f(position.T.copy()), mi.Point2f(0.5, 0.5)
    )
    box = scene.bbox()
    low, high = np.array(box.min), np.array(box.max)
    origins = low + rng.random((half, 3)) * (high - low)
    return (
        np.concatenate([points(ray.o), origins.astype(np.float32)]),
        np.concatenate([points(ray.d), sphere_directions(rng, half)]),
    )


def _check(scene: mi.Scene) -> None:
    """Same shape for all but 20 rays of 20,000 (edges, where a hit is a matter of rounding), and for the rest that hit:

    | what             | within                    | but for at most |
    |------------------|---------------------------|-----------------|
    | hit point        | 1e-5 of the scene's box   | 20              |
    | normals, tangent | 2e-4                      | 20              |
    | uv               | 5e-4 (u on a circle)      | 20              |
    """
    core, exported = core_scene(scene)
    origins, directions = _rays(scene)
    ours = core.ray_intersect(origins, directions)

    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(vector3(origins)), vector3(directions)))
    valid = points(si.is_valid()).astype(bool)
    shapes = [scene.shapes()[place] for place in exported.shape_order]
    entries = list(exported.description["shapes"])
    # The shapes of groups come behind the others, and are met where an instance shows them.
    groups = {child.id(): child for child in Fields(scene).children.values()}
    for group in exported.description["groups"]:
        members = ordered_shapes(list(Fields(groups[group["id"]]).children.values()))
        shapes += [member for _, member in members]
        entries += group["shapes"]
    shape = np.full(RAYS, np.iinfo(np.uint32).max, np.uint32)
    for index, one in enumerate(shapes):
        shape[points(si.shape == mi.ShapePtr(one)).astype(bool) & valid] = index
    assert np.count_nonzero(valid) > RAYS / 20
    assert set(shape[valid]) <= set(range(len(shapes)))

    wrong = shape != np.where(ours["valid"], ours["shape"], np.iinfo(np.uint32).max)
    assert np.count_nonzero(wrong) <= 20, first_rows(
        wrong, origin=origins, direction=directions, ours=ours["shape"], theirs=shape
    )
    same = valid & ~wrong
    box = scene.bbox()
    size = float(np.max(np.abs(np.array([box.min, box.max]))))
    pairs = {
        "p": (ours["p"], points(si.p), 1e-5 * size),
        "n": (ours["n"], points(si.n), 2e-4),
        "sh_n": (ours["sh_n"], points(si.sh_frame.n), 2e-4),
        "sh_s": (ours["sh_s"], points(si.sh_frame.s), 2e-4),
        "uv": (ours["uv"], points(si.uv), 5e-4),
    }
    failures = []
    for name, (a, b, tolerance) in pairs.items():
        if name == "uv":
            # An angle that is 0 on one side and a full turn on the other is the same place.
            a = b + (a - b) - np.round(a - b)
        wrong = same & disagreements(a, b, rel=tolerance, floor=1.0)
        if np.count_nonzero(wrong) > 20:
            where = {str(entries[i]["id"]) for i in set(shape[wrong])}
            text = first_rows(wrong, ours=a, theirs=b, origin=origins, direction=directions)
            failures.append(f"{name} on {sorted(where)}: {text}")
    assert not failures, "\n".join(failures)


@pytest.mark.parametrize("name", OURS)
def test_hits_are_mitsubas(name: str) -> None:
    mi.set_variant(LLVM)
    _check(OURS[name]())


@pytest.mark.parametrize("name", ["cornell-box"])
def test_hits_in_third_party_scenes_are_mitsubas(name: str, shared_scenes: Path) -> None:
    mi.set_variant(LLVM)
    _check(_file(shared_scenes / name)())
