"""`mesh_attribute` textures: values at vertices and faces, where rays meet the mesh, against Mitsuba's."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from pssflow.export import UnsupportedError, export
from tests.conftest import LLVM
from tests.exports import load
from tests.support.core import core_scene, our_runs
from tests.support.runs import truth_runs
from tests.support.values import points, vector3
from tests.support.welch import ALPHA, welch

pytestmark = pytest.mark.parity

NAMES = {"vertex_color": 3, "vertex_weight": 1, "face_color": 3, "face_weight": 1}
"""Attributes of the mesh, and their channels."""


def _mesh(path: Path) -> str:
    """A crumpled grid with every kind of attribute, and one triangle without area among its faces."""
    n = 9
    rng = np.random.default_rng(71)
    x, y = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n))
    z = 0.1 * rng.random((n, n))
    corner = np.arange(n * n).reshape(n, n)
    quads = [corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]]
    a, b, c, d = (q.ravel() for q in quads)
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    faces = np.insert(faces, 5, [3, 3, 4], axis=0)
    mesh = mi.Mesh("grid", n * n, len(faces))
    params = mi.traverse(mesh)
    params["vertex_positions"] = np.stack([x, y, z], 2).ravel().astype(np.float32)
    params["faces"] = faces.ravel().astype(np.uint32)
    params.update()
    for name, channels in NAMES.items():
        count = n * n if name.startswith("vertex") else len(faces)
        mesh.add_attribute(name, channels, rng.random(count * channels).astype(np.float32).tolist())
    mesh.write_ply(str(path))
    return str(path)


def _scene(path: Path) -> mi.Scene:
    """The grid, and in a group that is shown turned once more, there with the attributes of its faces alone.

    At an instance Mitsuba 3.9 weighs a group's vertices by where the instance is: no truth for theirs.
    """

    def attribute(name: str, **options: Any) -> dict[str, Any]:
        return {"type": "mesh_attribute", "name": name} | options

    faces = {
        "type": "blendbsdf",
        "weight": attribute("face_weight"),
        "a": {"type": "diffuse", "reflectance": attribute("face_color")},
        "b": {"type": "diffuse"},
    }
    all_of_them = {
        "type": "blendbsdf",
        "weight": attribute("vertex_weight"),
        "a": {"type": "diffuse", "reflectance": attribute("vertex_color", scale=0.7)},
        "b": faces,
    }

    def grid(nested: dict[str, Any]) -> dict[str, Any]:
        bsdf = {"type": "twosided", "nested": nested}
        return {"type": "ply", "filename": file, "bsdf": bsdf}

    file = _mesh(path)
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 32, "height": 32, "pixel_format": "rgb"}
    return mi.load_dict(
        {
            "type": "scene",
            "camera": {
                "type": "perspective",
                "fov": 45,
                "to_world": T().look_at(origin=[0.4, -2.5, 3], target=[0.3, 0, 0.3], up=[0, 0, 1]),
                "film": film | {"rfilter": {"type": "box"}},
            },
            "sky": {"type": "constant"},
            "grid": grid(all_of_them),
            "group": {"type": "shapegroup", "grid": grid(faces)},
            "view": {
                "type": "instance",
                "to_world": T().translate([1.5, 0.3, 0.8]).rotate([0, 0.6, 0.8], -60).scale(0.8),
                "group": {"type": "ref", "id": "group"},
            },
        }
    )


def test_values_are_mitsubas(tmp_path: Path) -> None:
    """Every attribute at 10,000 places of the mesh and of its instance, within 1e-5; scalars too."""
    mi.set_variant(LLVM)
    scene = _scene(tmp_path / "grid.ply")
    core, exported = core_scene(scene)
    rng = np.random.default_rng(72)
    n = 20_000
    origin = np.column_stack([rng.uniform(-1, 2, (n, 2)), np.full(n, 5)]).astype(np.float32)
    d = np.tile(np.array([[0, 0, -1]], np.float32), (n, 1))
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(vector3(origin)), vector3(d)))
    # Between triangles of one plane rounding decides which is met: those are left out.
    ours_hit = core.ray_intersect(origin, d)
    same = np.abs(ours_hit["p"] - points(si.p)).max(axis=1) < 1e-4
    same &= np.abs(ours_hit["n"] - points(si.n)).max(axis=1) < 1e-3
    assert np.count_nonzero(same & points(si.is_valid()).astype(bool)) > 10_000
    (plain,) = (i for i, s in enumerate(exported.description["shapes"]) if s["type"] == "mesh")
    met = 0
    for index, entry in enumerate(exported.description["textures"]):
        if entry["type"] != "mesh_attribute":
            continue
        colours, scalars = core.texture_eval_at_hits(index, origin, d)
        texture = mi.load_dict(
            {"type": "mesh_attribute", "name": entry["name"], "scale": entry["scale"]}
        )
        theirs = points(texture.eval(si))
        if entry["name"].startswith("vertex"):
            theirs[ours_hit["shape"] != plain] = 0  # the group's mesh wears faces' attributes alone
        np.testing.assert_allclose(colours[same], theirs[same], atol=1e-5)
        assert theirs.std() > 0.05
        one = points(texture.eval_1(si))
        if entry["name"] == "vertex_weight":
            one[ours_hit["shape"] != plain] = 0
        np.testing.assert_allclose(scalars[same], one[same], atol=1e-5)
        met += 1
    assert met >= len(NAMES)


def test_its_light_is_mitsubas(tmp_path: Path, artifacts: Path) -> None:
    """H0: both views give Mitsuba's one-bounce light. 16 seeds × 32 spp."""
    mi.set_variant(LLVM)
    scene = _scene(tmp_path / "grid.ply")
    truth = truth_runs(scene, k=1, seeds=range(16), spp=32)
    ours = our_runs(core_scene(scene)[0], seeds=range(1000, 1016), spp=32, k=1)
    r = welch(truth, ours)
    assert r.p > ALPHA / 2, r.explain(artifacts)
    assert welch(truth, np.float32(1.02) * ours).p < ALPHA / 2


def test_what_a_shape_does_not_hold_is_refused(variant: str) -> None:
    colour = {"type": "mesh_attribute", "name": "vertex_color"}
    ball = {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": colour}}
    with pytest.raises(
        UnsupportedError, match=r'shape "ball": .* attribute "vertex_color", which the shape'
    ):
        export(load(ball=ball))
    exported = export(load(ball=ball), approximate=True)
    assert any("is black there" in note for note in exported.notes)
    lamp = {"type": "rectangle", "light": {"type": "area", "radiance": colour}}
    with pytest.raises(UnsupportedError, match="`mesh_attribute` as `radiance`"):
        export(load(lamp=lamp))
