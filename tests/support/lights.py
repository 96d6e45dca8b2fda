"""Area lights of every shape, for the tests of their sampling and of the light that they give."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

Description = dict[str, Any]

LIGHTS = (
    *("rectangle", "rectangle-mirrored", "rectangle-flipped", "cube"),
    *("mesh", "mesh-flipped", "mesh-facets"),
    *("disk", "disk-flipped", "cylinder", "cylinder-flipped"),
    *("sphere", "sphere-far", "sphere-around", "sphere-turned"),
)
"""Names that `light` knows."""

MISSED_BY_MITSUBA = ("rectangle-flipped", "cube", "mesh", "mesh-flipped", "sphere-turned")
"""Lights whose radiance Mitsuba 3.9 samples wrongly where it is textured, so that its images are no truth there.

It draws a texel and looks for its place by uv: a flipped rectangle then faces the wrong way, a cube has six places, a
sphere forgets that it is turned, and interpolated normals count on one side only. What a ray sees
of these lights is right, and ours is compared with that.
"""


def light(name: str, folder: Path, *, textured: bool = False) -> Description:
    """A light some 3 away from the origin; turned, stretched, mirrored or inside out. Flat ones face the origin.

    Meshes are written into `folder`.
    """
    T = mi.ScalarTransform4f
    view = T().look_at(origin=[2, 1.5, 1.8], target=[0, 0.1, 0.2], up=[0.6, 0, 0.8])
    away = T().look_at(origin=[2, 1.5, 1.8], target=[4, 3, 3], up=[0.6, 0, 0.8])
    shapes: dict[str, Callable[[], Description]] = {
        "rectangle": lambda: {"type": "rectangle", "to_world": view.scale([0.7, 0.4, 1])},
        "rectangle-mirrored": lambda: {"type": "rectangle", "to_world": view.scale([-0.7, 0.4, 1])},
        "rectangle-flipped": lambda: {"type": "rectangle", "to_world": away, "flip_normals": True},
        "cube": lambda: {"type": "cube", "to_world": view.scale([0.5, 0.3, 0.8])},
        "mesh": lambda: {
            "type": "ply",
            "filename": _bumps(folder),
            "to_world": view.scale([0.6, 0.8, 1.1]),
        },
        "mesh-flipped": lambda: {
            "type": "ply",
            "filename": _bumps(folder),
            "to_world": away,
            "flip_normals": True,
        },
        "mesh-facets": lambda: {
            "type": "ply",
            "filename": _bumps(folder),
            "to_world": view,
            "face_normals": True,
        },
        "disk": lambda: {"type": "disk", "to_world": view.scale([0.9, 0.5, 1])},
        "disk-flipped": lambda: {"type": "disk", "to_world": away, "flip_normals": True},
        "sphere": lambda: {"type": "sphere", "center": [2, 1, 1.5], "radius": 0.4},
        "sphere-far": lambda: {"type": "sphere", "center": [50, 70, 20], "radius": 0.9},
        "sphere-around": lambda: {"type": "sphere", "radius": 9.0, "flip_normals": True},
        "sphere-turned": lambda: {"type": "sphere", "to_world": view.scale(0.6)},
        "cylinder": lambda: {
            "type": "cylinder",
            "p0": [2, 1, 1],
            "p1": [1.5, 1.8, 2],
            "radius": 0.3,
        },
        "cylinder-flipped": lambda: {
            "type": "cylinder",
            "to_world": view.scale([2, 2, 3]),
            "flip_normals": True,
        },
    }
    radiance: Description = {"type": "rgb", "value": [3.0, 2.0, 1.0]}
    if textured:
        texels = np.random.default_rng(31).uniform(0, 4, (5, 9, 3)).astype(np.float32)
        radiance = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}
        radiance["filter_type"] = "nearest"
    dark = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    return shapes[name]() | {"bsdf": dark, "light": {"type": "area", "radiance": radiance}}


def _bumps(folder: Path) -> str:
    """A PLY of 72 triangles with vertex normals and texture coordinates, bent so that normals differ from facets."""
    y, x = np.mgrid[-1:1:7j, -1:1:7j]
    z = 0.3 * np.cos(2 * x) * np.sin(1.5 * y + 0.4)
    corner = (np.arange(6)[:, None] * 7 + np.arange(6)).ravel()[:, None]
    faces = np.concatenate([np.add(corner, [0, 1, 8]), np.add(corner, [0, 8, 7])])
    mesh = mi.Mesh("bumps", 49, len(faces), has_vertex_normals=True, has_vertex_texcoords=True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = np.stack([x, y, z], -1).ravel().astype(np.float32)
    params["vertex_texcoords"] = np.stack([x, y], -1).ravel().astype(np.float32) / 2 + 0.5
    params["faces"] = faces.ravel().astype(np.uint32)
    params.update()
    mesh.write_ply(str(folder / "bumps.ply"))
    return str(folder / "bumps.ply")
