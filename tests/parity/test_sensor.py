"""Camera rays by value."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from tests.conftest import LLVM
from tests.support.core import core_scene
from tests.support.values import F32, point2, points, unit_interval

pytestmark = pytest.mark.parity

Description = dict[str, Any]


def _film(width: int, height: int, crop: tuple[int, int, int, int] | None = None) -> Description:
    film: Description = {"type": "hdrfilm", "width": width, "height": height}
    if crop is not None:
        names = ("crop_offset_x", "crop_offset_y", "crop_width", "crop_height")
        film |= dict(zip(names, crop, strict=True))
    return film


def _sensors() -> dict[str, Description]:
    """Cameras, perspective unless they say otherwise; each turns on what the others leave at its default."""
    T = mi.ScalarTransform4f
    view = T().look_at(origin=[3, -4, 2], target=[0.2, 0, 0.5], up=[0, 0.1, 1])
    cases: dict[str, Description] = {
        "default": {"film": _film(64, 64)},
        "wide": {"film": _film(96, 40), "fov": 70, "to_world": view},
        "tall": {"film": _film(40, 96), "fov": 70, "to_world": view},
        "crop": {"film": _film(96, 64, (17, 5, 30, 41)), "to_world": view},
        "principal-point": {
            "film": _film(96, 64),
            "principal_point_offset_x": 0.11,
            "principal_point_offset_y": -0.23,
            "to_world": view,
        },
        "principal-point-crop": {
            "film": _film(64, 96, (10, 50, 50, 20)),
            "principal_point_offset_x": -0.3,
            "principal_point_offset_y": 0.07,
        },
        "mirrored": {"film": _film(96, 64), "to_world": view @ T().scale([-1, 1, 1])},
        "clips": {"film": _film(64, 64), "near_clip": 0.7, "far_clip": 3.1, "to_world": view},
    }
    thin: Description = {"type": "thinlens", "aperture_radius": 0.2, "focus_distance": 2.5}
    cases |= {
        "thinlens": thin | {"film": _film(64, 64), "to_world": view},
        "thinlens-crop": thin | {"film": _film(96, 64, (17, 5, 30, 41)), "fov": 70, "far_clip": 9},
        "orthographic": {"type": "orthographic", "film": _film(96, 40), "to_world": view},
        "orthographic-scaled": {
            "type": "orthographic",
            "film": _film(64, 96, (10, 50, 50, 20)),
            "to_world": view @ T().scale([3, 2, 1]),
            "near_clip": 0.5,
            "far_clip": 20,
        },
    }
    for axis in ("x", "y", "diagonal", "smaller", "larger"):
        cases[f"fov-{axis}"] = {"film": _film(80, 50, (9, 3, 60, 40)), "fov": 33, "fov_axis": axis}
    return cases


SENSORS = [
    *(
        "default",
        "wide",
        "tall",
        "crop",
        "principal-point",
        "principal-point-crop",
        "mirrored",
        "clips",
    ),
    *("thinlens", "thinlens-crop", "orthographic", "orthographic-scaled"),
    *("fov-x", "fov-y", "fov-diagonal", "fov-smaller", "fov-larger"),
]


def _scene(camera: Description) -> mi.Scene:
    return mi.load_dict(
        {
            "type": "scene",
            "camera": {"type": "perspective"} | camera,
            "floor": {"type": "rectangle"},
        }
    )


def _film_positions(width: int, height: int) -> F32:
    """The crop's corners, and 2,000 positions in it, in pixels from its corner."""
    rng = np.random.default_rng(41)
    inside = rng.random((2000, 2)) * [width, height]
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]])
    return np.concatenate([corners, inside]).astype(np.float32)


@pytest.mark.parametrize("name", SENSORS)
def test_rays_are_mitsubas(name: str) -> None:
    """Origin (on the near plane) and direction at 2,004 film positions, within 2e-6 of the scene's size."""
    mi.set_variant(LLVM)
    scene = _scene(_sensors()[name])
    core, _ = core_scene(scene)
    sensor = scene.sensors()[0]
    width, height = (int(n) for n in sensor.film().crop_size())
    assert (core.width, core.height) == (width, height)

    pixels = _film_positions(width, height)
    lens = unit_interval(np.random.default_rng(42), len(pixels), 2)
    origins, directions = core.film_ray(pixels, lens)
    position = mi.Point2f((pixels / np.array([width, height], np.float32)).T.copy())
    ray, _ = sensor.sample_ray(mi.Float(0), mi.Float(0.5), position, point2(lens))
    np.testing.assert_allclose(origins, points(ray.o), atol=1e-5)
    # What is the same for all rays comes once.
    d = np.broadcast_to(points(ray.d), directions.shape)
    np.testing.assert_allclose(directions, d, atol=2e-6)


def test_a_list_of_cameras_names_them_all() -> None:
    """The parametrisation above is written out, because cameras can be made only in a variant."""
    mi.set_variant(LLVM)
    assert set(SENSORS) == set(_sensors())
