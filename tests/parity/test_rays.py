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
from tests.conftest import LLVM, ROOT, SCALAR
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
    camera = scene.sensors()[0]
    if (mi.variant() or "").startswith("scalar"):
        rays = [camera.sample_ray(0, 0.5, mi.Point2f(p), [0.5, 0.5])[0] for p in position.tolist()]
        from_camera = [
            np.array([np.array(v) for v in vs], np.float32)
            for vs in ([ray.o for ray in rays], [ray.d for ray in rays])
        ]
    else:
        ray, _ = camera.sample_ray(
            mi.Float(0), mi.Float(0.5), mi.Point2f(position.T.copy()), mi.Point2f(0.5, 0.5)
        )
        from_camera = [points(ray.o), points(ray.d)]
    box = scene.bbox()
    low, high = np.array(box.min), np.array(box.max)
    origins = low + rng.random((half, 3)) * (high - low)
    return (
        np.concatenate([from_camera[0], origins.astype(np.float32)]),
        np.concatenate([from_camera[1], sphere_directions(rng, half)]),
    )


def _theirs(
    scene: mi.Scene, shapes: list[Any], origins: F32, directions: F32
) -> dict[str, np.ndarray]:
    """What Mitsuba's rays hit, with the keys of the core's `ray_intersect`; shapes by their place in `shapes`."""
    nothing = np.iinfo(np.uint32).max
    if (mi.variant() or "").startswith("scalar"):
        place = {shape: index for index, shape in enumerate(shapes)}
        rows: list[Any] = []
        for o, d in zip(origins.tolist(), directions.tolist(), strict=True):
            si = scene.ray_intersect(mi.Ray3f(mi.Point3f(o), mi.Vector3f(d)))
            hit = si.is_valid()
            frame = si.sh_frame
            index = place[si.shape] if hit else nothing
            rows.append((hit, index, *map(np.array, (si.p, si.n, frame.n, frame.s, si.uv))))
        columns = [np.array(column) for column in zip(*rows, strict=True)]
        return dict(zip(("valid", "shape", "p", "n", "sh_n", "sh_s", "uv"), columns, strict=True))
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(vector3(origins)), vector3(directions)))
    valid = points(si.is_valid()).astype(bool)
    shape = np.full(RAYS, nothing, np.uint32)
    for index, one in enumerate(shapes):
        shape[points(si.shape == mi.ShapePtr(one)).astype(bool) & valid] = index
    values = {"p": si.p, "n": si.n, "sh_n": si.sh_frame.n, "sh_s": si.sh_frame.s, "uv": si.uv}
    return {"valid": valid, "shape": shape} | {name: points(v) for name, v in values.items()}


def _check(scene: mi.Scene, *, arbitrary_tangents: bool = False) -> None:
    """Same shape for all but 20 rays of 20,000 (edges, where a hit is a matter of rounding), and for the rest that hit:

    | what             | within                    | but for at most |
    |------------------|---------------------------|-----------------|
    | hit point        | 1e-5 of the scene's box   | 20              |
    | normals, tangent | 2e-4                      | 20              |
    | uv               | 5e-4 (u on a circle)      | 20              |

    With `arbitrary_tangents` there are meshes whose texture coordinates give none, or hardly any. Which side a tangent
    points to is then a matter of rounding, and on walls along z, where it follows the sign of the normal's z, so is all
    of it: there it is not compared.
    """
    core, exported = core_scene(scene)
    origins, directions = _rays(scene)
    ours = core.ray_intersect(origins, directions)

    shapes = [scene.shapes()[place] for place in exported.shape_order]
    entries = list(exported.description["shapes"])
    # The shapes of groups come behind the others, and are met where an instance shows them.
    groups = {child.id(): child for child in Fields(scene).children.values()}
    for group in exported.description["groups"]:
        members = ordered_shapes(list(Fields(groups[group["id"]]).children.values()))
        shapes += [member for _, member in members]
        entries += group["shapes"]
    theirs = _theirs(scene, shapes, origins, directions)
    valid, shape = theirs["valid"], theirs["shape"]
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
        name: (ours[name], theirs[name], tolerance)
        for name, tolerance in {
            "p": 1e-5 * size,
            "n": 2e-4,
            "sh_n": 2e-4,
            "sh_s": 2e-4,
            "uv": 5e-4,
        }.items()
    }
    failures = []
    for name, (a, b, tolerance) in pairs.items():
        if name == "uv":
            # An angle that is 0 on one side and a full turn on the other is the same place.
            a = b + (a - b) - np.round(a - b)
        if name == "sh_s" and arbitrary_tangents:
            a = np.where((a * b).sum(axis=1, keepdims=True) < 0, -a, a)
        wrong = same & disagreements(np.asarray(a, np.float32), b, rel=tolerance, floor=1.0)
        if name == "sh_s" and arbitrary_tangents:
            wrong &= np.abs(theirs["n"][:, 2]) > 1e-4
        if np.count_nonzero(wrong) > 20:
            where = {str(entries[i]["id"]) for i in set(shape[wrong])}
            text = first_rows(wrong, ours=a, theirs=b, origin=origins, direction=directions)
            failures.append(f"{name} on {sorted(where)}: {text}")
    assert not failures, "\n".join(failures)


@pytest.mark.parametrize("name", OURS)
def test_hits_are_mitsubas(name: str) -> None:
    mi.set_variant(LLVM)
    _check(OURS[name]())


def _shared() -> list[Any]:
    names = ("cornell-box", "veach-ajar", "veach-bidir", "veach-mis", "staircase2", "bathroom2")
    names += ("living-room", "sponza-lajolla", "sanmiguel")
    long = [pytest.mark.long, pytest.mark.timeout(600)]
    return [pytest.param(name, marks=long if name != "cornell-box" else []) for name in names]


@pytest.mark.parametrize("name", _shared())
def test_hits_in_third_party_scenes_are_mitsubas(name: str, shared_scenes: Path) -> None:
    # Thousands of instances are unusable in LLVM.
    mi.set_variant(SCALAR if name == "sanmiguel" else LLVM)
    scene = mi.load_file(str(shared_scenes / name / "scene.xml"), optimize=False)
    _check(scene, arbitrary_tangents=True)
