"""Small scenes of the tests, as dictionaries for `mi.load_dict`. Each turns on what the others leave out.

| name             | film                        | shapes                       | materials        | emitters       |
|------------------|-----------------------------|------------------------------|------------------|----------------|
| `quad`           | 32 × 32, box                | rectangle                    | diffuse          | one area       |
| `furnace_sphere` | 32 × 32, box                | cube, sphere, disk, cylinder | diffuse          | area (sphere)  |
| `glossy_room`    | 48 × 32 of 64 × 48, Gauss   | rectangle, cube, sphere      | every glossy one | point, area    |
| `open_sky`       | 48 × 48, tent               | rectangle, cube, sphere      | diffuse          | constant, area |
| `sun_and_sky`    | 32 × 32, tent, lens         | rectangle, cube, sphere      | diffuse, plastic | the other kinds |
| `glass_room`     | 32 × 32, box                | rectangle, sphere, cube      | every delta one  | constant, area |

Set a Mitsuba variant before calling a factory: transforms and bitmaps belong to one. Film sizes are multiples of 16,
the side of a tile in the statistical tests.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

Description = dict[str, Any]
Triple = tuple[float, float, float]


def quad() -> Description:
    """One white square, one square light above it, seen from the side: the smallest scene with an image.

    Two-bounce light is zero: from the only surface that reflects, no ray meets another one that does.
    """
    return {
        "type": "scene",
        "camera": _camera(origin=(0, -4, 2), target=(0, 0, 0.3), fov=40, film=_film(32, 32, "box")),
        "floor": {
            "type": "rectangle",
            "bsdf": _diffuse(0.8),
        },
        "lamp": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f()
            .translate([0, 0, 2])
            .rotate([1, 0, 0], 180)
            .scale(0.5),
            "bsdf": _diffuse(0.0),
            "light": _area(6.0),
        },
    }


def furnace_sphere() -> Description:
    """A closed room of albedo .5 lit by a small sphere, with each of the exact shapes in it.

    No ray escapes: a path ends early only where it meets the lamp, whose surface reflects nothing.
    """
    T = mi.ScalarTransform4f
    return {
        "type": "scene",
        "camera": _camera(
            origin=(0.2, -1.8, 0.1), target=(0, 0, -0.3), fov=75, film=_film(32, 32, "box")
        ),
        "room": {
            "type": "cube",
            "to_world": T().scale(2.0),
            "bsdf": _twosided(_diffuse(0.5, 0.45, 0.4)),
        },
        "ball": {
            "type": "sphere",
            "center": [-0.8, 0.6, -0.5],
            "radius": 0.6,
            "bsdf": _twosided(_diffuse(0.3, 0.5, 0.7)),
        },
        "plate": {
            "type": "disk",
            "to_world": T()
            .translate([0.7, 0.3, -0.9])
            .rotate([0.8, 0.6, 0], 25)
            .scale([0.9, 0.6, 1]),
            "bsdf": _twosided(_diffuse(0.7, 0.5, 0.2)),
        },
        "tube": {
            "type": "cylinder",
            "p0": [0.9, 1.1, -1.6],
            "p1": [0.6, 0.9, 0.4],
            "radius": 0.35,
            "bsdf": _twosided(_diffuse(0.6, 0.2, 0.3)),
        },
        "lamp": {
            "type": "sphere",
            "center": [0.1, 0.4, 1.2],
            "radius": 0.3,
            "bsdf": _diffuse(0.0),
            "light": _area(5.0, 4.5, 4.0),
        },
    }


def glossy_room() -> Description:
    """A corner with every glossy material of the first schema, a point light and an area light; the film is cropped."""
    T = mi.ScalarTransform4f
    return {
        "type": "scene",
        "camera": _camera(
            origin=(2.6, -2.8, 1.7),
            target=(-0.1, 0.1, 0.45),
            fov=50,
            film=_film(64, 48, "gaussian", crop=(8, 10, 48, 32)),
        ),
        "floor": {
            "type": "rectangle",
            "to_world": T().scale(2.0),
            "bsdf": _twosided({"type": "diffuse", "reflectance": _checks()}),
        },
        "back": {
            "type": "rectangle",
            "to_world": T().translate([0, 2, 1.5]).rotate([1, 0, 0], 90).scale([2, 1.5, 1]),
            "bsdf": _twosided(
                {
                    "type": "roughplastic",
                    "distribution": "ggx",
                    "alpha": 0.25,
                    "nonlinear": True,
                    "diffuse_reflectance": _rgb(0.5, 0.3, 0.25),
                }
            ),
        },
        "side": {
            "type": "rectangle",
            "to_world": T().translate([-2, 0, 1.5]).rotate([0, 1, 0], 90).scale([1.5, 2, 1]),
            "bsdf": _twosided(
                {
                    "type": "roughconductor",
                    "distribution": "ggx",
                    "alpha_u": 0.45,
                    "alpha_v": 0.2,
                    "eta": _rgb(1.66, 0.88, 0.52),
                    "k": _rgb(9.22, 6.27, 4.84),
                    "specular_reflectance": _rgb(0.9, 0.85, 0.8),
                }
            ),
        },
        "block": {
            "type": "cube",
            "to_world": T()
            .translate([-0.7, 0.6, 0.5])
            .rotate([0, 0, 1], 30)
            .scale([0.4, 0.4, 0.5]),
            "bsdf": _twosided(
                {
                    "type": "blendbsdf",
                    "weight": 0.35,
                    "first": _diffuse(0.2, 0.45, 0.6),
                    "second": {
                        "type": "roughplastic",
                        "distribution": "beckmann",
                        "alpha": 0.3,
                        "int_ior": 1.6,
                        "diffuse_reflectance": _rgb(0.1, 0.2, 0.3),
                        "specular_reflectance": _rgb(0.9, 0.9, 0.9),
                    },
                }
            ),
        },
        "ball": {
            "type": "sphere",
            "center": [0.6, 0.1, 0.45],
            "radius": 0.45,
            "bsdf": _twosided(
                {
                    "type": "roughconductor",
                    "distribution": "beckmann",
                    "alpha": 0.3,
                    "eta": _rgb(0.2, 0.92, 1.1),
                    "k": _rgb(3.9, 2.45, 2.14),
                }
            ),
        },
        "bulb": {"type": "point", "position": [1.2, -0.8, 2.2], "intensity": _rgb(4.0, 4.0, 5.0)},
        "lamp": {
            "type": "rectangle",
            "to_world": T()
            .translate([-0.4, -0.2, 2.6])
            .rotate([0.96, 0.28, 0], 170)
            .scale([0.5, 0.4, 1]),
            "bsdf": _diffuse(0.0),
            "light": _area(6.0, 5.0, 4.0),
        },
    }


def open_sky() -> Description:
    """A court of blocks under a uniform sky with a small glowing sphere: most first bounces escape."""
    T = mi.ScalarTransform4f
    return {
        "type": "scene",
        "camera": _camera(
            origin=(3.5, -4.5, 3.2), target=(0, 0, 0.4), fov=42, film=_film(48, 48, "tent")
        ),
        "sky": {"type": "constant", "radiance": _rgb(0.5, 0.65, 0.9)},
        "ground": {
            "type": "rectangle",
            "to_world": T().scale(3.0),
            "bsdf": _twosided(_diffuse(0.55, 0.5, 0.42)),
        },
        "tower": {
            "type": "cube",
            "to_world": T()
            .translate([-0.9, 0.8, 0.8])
            .rotate([0, 0, 1], 20)
            .scale([0.5, 0.6, 0.8]),
            "bsdf": _twosided(_diffuse(0.7, 0.25, 0.2)),
        },
        "wall": {
            "type": "cube",
            "to_world": T()
            .translate([0.9, 1.0, 0.5])
            .rotate([0, 0, 1], -12)
            .scale([0.9, 0.1, 0.5]),
            "bsdf": _twosided(_diffuse(0.3, 0.6, 0.35)),
        },
        "roof": {
            "type": "rectangle",
            "to_world": T().translate([0.7, 0.3, 1.1]).rotate([1, 0, 0], 15).scale([0.9, 0.7, 1]),
            "bsdf": _twosided(_diffuse(0.75)),
        },
        "lantern": {
            "type": "sphere",
            "center": [0.6, -0.3, 0.35],
            "radius": 0.25,
            "bsdf": _diffuse(0.0),
            "light": _area(3.0, 2.0, 1.0),
        },
    }


def sun_and_sky() -> Description:
    """A court under an image of the sky with a low bright spot, a sun and two lamps that have no size.

    Seen by a camera with a lens; on the ground lie the squares of a checkerboard.
    """
    T = mi.ScalarTransform4f
    row, column = np.mgrid[0:24, 0:48]
    glow = 12 * np.exp(-((row - 9) ** 2 + (column - 30) ** 2) / 6)
    sky = np.stack([0.3 + glow, 0.4 + 0.8 * glow, 0.7 + 0.5 * glow], -1) * (row < 14)[..., None]
    camera = _camera(
        origin=(3.2, -4.2, 2.9), target=(0, 0, 0.4), fov=42, film=_film(32, 32, "tent")
    )
    return {
        "type": "scene",
        "camera": camera | {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 5.2},
        "sky": {
            "type": "envmap",
            "bitmap": mi.Bitmap(sky.astype(np.float32)),
            "scale": 1.3,
            "to_world": T().rotate([1, 0, 0], 90).rotate([0, 1, 0], 40),
        },
        "sun": {
            "type": "directional",
            "direction": [0.5, 0.6, -1],
            "irradiance": _rgb(2.0, 1.8, 1.4),
            "sampling_weight": 0.7,
        },
        "spot": {
            "type": "spot",
            "to_world": T().look_at(origin=[-1.5, -2, 2.5], target=[0.3, 0.4, 0], up=[0, 0, 1]),
            "cutoff_angle": 28,
            "intensity": _rgb(9.0, 12.0, 9.0),
        },
        "slides": {
            "type": "projector",
            "to_world": T().look_at(origin=[2, -1.5, 2], target=[-0.6, 0.8, 0.8], up=[0, 0, 1]),
            "irradiance": _checks(),
            "fov": 35,
            "scale": 2.0,
        },
        "ground": {
            "type": "rectangle",
            "to_world": T().scale(3.0),
            "bsdf": _twosided(
                {
                    "type": "diffuse",
                    "reflectance": {
                        "type": "checkerboard",
                        "color0": _rgb(0.6, 0.5, 0.4),
                        "color1": _rgb(0.2, 0.3, 0.25),
                        "to_uv": mi.ScalarTransform3f().scale([3, 4]),
                    },
                }
            ),
        },
        "tower": {
            "type": "cube",
            "to_world": T()
            .translate([-0.9, 0.8, 0.8])
            .rotate([0, 0, 1], 20)
            .scale([0.5, 0.6, 0.8]),
            "bsdf": _twosided(
                {"type": "roughplastic", "alpha": 0.3, "diffuse_reflectance": _rgb(0.6, 0.3, 0.2)}
            ),
        },
        "ball": {
            "type": "sphere",
            "center": [0.7, 0.1, 0.5],
            "radius": 0.5,
            "bsdf": _twosided(_diffuse(0.4, 0.6, 0.7)),
        },
    }


def glass_room() -> Description:
    """Mirrors, panes, smooth and rough glass and masks on a coated floor: NEE alone misses their light.

    The lights are large, so that no single path through the glass holds a good part of the image.
    """
    T = mi.ScalarTransform4f
    glass = {"type": "dielectric", "int_ior": 1.5}
    return {
        "type": "scene",
        "camera": _camera(
            origin=(2.2, -2.9, 1.6), target=(-0.1, 0.2, 0.5), fov=48, film=_film(32, 32, "box")
        ),
        "floor": {
            "type": "rectangle",
            "to_world": T().scale(2.0),
            "bsdf": {"type": "plastic", "diffuse_reflectance": _checks(), "nonlinear": True},
        },
        "back": {
            "type": "rectangle",
            "to_world": T().translate([0, 2, 1.5]).rotate([1, 0, 0], 90).scale([2, 1.5, 1]),
            "bsdf": {"type": "conductor", "specular_reflectance": _rgb(0.8, 0.75, 0.7)},
        },
        "side": {
            "type": "rectangle",
            "to_world": T().translate([-2, 0, 1.5]).rotate([0, 1, 0], 90).scale([1.5, 2, 1]),
            "bsdf": _twosided({"type": "plastic", "diffuse_reflectance": _rgb(0.3, 0.5, 0.4)}),
        },
        "ball": {"type": "sphere", "center": [-0.6, 0.5, 0.55], "radius": 0.5, "bsdf": glass},
        "frosted": {
            "type": "sphere",
            "center": [0.7, 0.9, 0.45],
            "radius": 0.4,
            "bsdf": {"type": "roughdielectric", "distribution": "ggx", "alpha": 0.3},
        },
        "pane": {
            "type": "rectangle",
            "to_world": T().translate([1.1, -0.2, 0.5]).rotate([0, 1, 0], 70).scale([0.5, 0.6, 1]),
            "bsdf": {"type": "thindielectric", "specular_transmittance": _rgb(0.7, 0.9, 0.8)},
        },
        "leaf": {
            "type": "rectangle",
            "to_world": T().translate([0, -0.9, 0.6]).rotate([1, 0, 0], 65).scale([0.7, 0.5, 1]),
            "bsdf": {
                "type": "mask",
                "opacity": 0.55,
                "nested": _twosided(_diffuse(0.7, 0.4, 0.2)),
            },
        },
        "veil": {
            "type": "rectangle",
            "to_world": T().translate([-1.2, -0.8, 0.5]).rotate([1, 0, 0], 90).scale(0.5),
            "bsdf": {
                "type": "mask",
                "opacity": 0.7,
                "nested": _twosided(
                    {"type": "plastic", "diffuse_reflectance": _rgb(0.6, 0.2, 0.4)}
                ),
            },
        },
        "ghost": {
            "type": "cube",
            "to_world": T().translate([0.1, 1.2, 1.4]).scale(0.3),
            "bsdf": {"type": "null"},
        },
        "lamp": {
            "type": "rectangle",
            "to_world": T().translate([0, 0, 3]).rotate([1, 0, 0], 180).scale(1.5),
            "bsdf": _diffuse(0.0),
            "light": _area(2.0, 1.9, 1.7),
        },
        "sky": {"type": "constant", "radiance": _rgb(0.4, 0.5, 0.6)},
    }


def carved_room() -> Description:
    """Disney's materials, bumps and bent normals on smooth and glossy surfaces, and a leaf with a pattern of holes."""
    T = mi.ScalarTransform4f
    bumps = {"type": "bitmap", "bitmap": mi.Bitmap(_waves()[..., None]), "raw": True}
    along_v, along_u = (np.gradient(_waves(), axis=axis) for axis in (0, 1))
    normals = np.stack([-along_u, -along_v, np.ones_like(along_u)], axis=2)
    normals = 0.5 + 0.5 * normals / np.linalg.norm(normals, axis=2, keepdims=True)
    bent = {"type": "bitmap", "bitmap": mi.Bitmap(normals.astype(np.float32)), "raw": True}
    tiles = mi.ScalarTransform3f().scale([2, 3])
    return {
        "type": "scene",
        "camera": _camera(
            origin=(2.3, -2.8, 1.7), target=(-0.1, 0.2, 0.5), fov=48, film=_film(32, 32, "box")
        ),
        "floor": {
            "type": "rectangle",
            "to_world": T().scale(2.0),
            "bsdf": _twosided(
                {
                    "type": "normalmap",
                    "normalmap": bent | {"to_uv": tiles},
                    "nested": {
                        "type": "roughplastic",
                        "alpha": 0.3,
                        "diffuse_reflectance": _rgb(0.5, 0.4, 0.3),
                    },
                }
            ),
        },
        "back": {
            "type": "rectangle",
            "to_world": T().translate([0, 2, 1.5]).rotate([1, 0, 0], 90).scale([2, 1.5, 1]),
            "bsdf": _twosided(
                {
                    "type": "bumpmap",
                    "heights": bumps | {"to_uv": tiles},
                    "scale": 0.1,
                    "nested": {
                        "type": "roughconductor",
                        "distribution": "ggx",
                        "alpha_u": 0.5,
                        "alpha_v": 0.25,
                        "material": "Cu",
                    },
                }
            ),
        },
        "side": {
            "type": "rectangle",
            "to_world": T().translate([-2, 0, 1.5]).rotate([0, 1, 0], 90).scale([1.5, 2, 1]),
            "bsdf": _twosided(
                {
                    "type": "principled",
                    "base_color": _checks(),
                    "roughness": 0.4,
                    "metallic": 0.3,
                    "sheen": 0.5,
                    "clearcoat": 0.6,
                    "clearcoat_gloss": 0.3,
                }
            ),
        },
        "ball": {
            "type": "sphere",
            "center": [-0.6, 0.5, 0.55],
            "radius": 0.5,
            "bsdf": {
                "type": "principled",
                "base_color": _rgb(0.8, 0.7, 0.6),
                "roughness": 0.5,
                "spec_trans": 0.6,
                "eta": 1.4,
            },
        },
        "sheet": {
            "type": "rectangle",
            "to_world": T().translate([1.0, -0.1, 0.6]).rotate([0, 1, 0], 70).scale([0.5, 0.6, 1]),
            "bsdf": {
                "type": "principledthin",
                "base_color": _rgb(0.5, 0.7, 0.4),
                "roughness": 0.5,
                "spec_trans": 0.3,
                "diff_trans": 1.2,
            },
        },
        "leaf": {
            "type": "rectangle",
            "to_world": T().translate([0, -0.9, 0.6]).rotate([1, 0, 0], 65).scale([0.7, 0.5, 1]),
            "bsdf": {
                "type": "mask",
                "opacity": bumps | {"filter_type": "nearest"},
                "nested": _twosided(_diffuse(0.3, 0.6, 0.2)),
            },
        },
        "lamp": {
            "type": "rectangle",
            "to_world": T().translate([0, 0, 3]).rotate([1, 0, 0], 180).scale(1.2),
            "bsdf": _diffuse(0.0),
            "light": _area(3.0, 2.8, 2.5),
        },
        "sky": {"type": "constant", "radiance": _rgb(0.4, 0.5, 0.6)},
    }


SCENES: dict[str, Callable[[], Description]] = {
    "quad": quad,
    "furnace_sphere": furnace_sphere,
    "glossy_room": glossy_room,
    "open_sky": open_sky,
    "sun_and_sky": sun_and_sky,
    "glass_room": glass_room,
    "carved_room": carved_room,
}
"""Every scene of this file by name; a test over all scenes iterates over this."""


def _camera(*, origin: Triple, target: Triple, fov: float, film: Description) -> Description:
    return {
        "type": "perspective",
        "fov": fov,
        "to_world": mi.ScalarTransform4f().look_at(
            origin=list(origin), target=list(target), up=[0, 0, 1]
        ),
        "sampler": {"type": "independent", "sample_count": 16},
        "film": film,
    }


def _film(
    width: int, height: int, rfilter: str, *, crop: tuple[int, int, int, int] | None = None
) -> Description:
    """A float32 RGB film; `crop` is (x, y, width, height) in pixels."""
    film: Description = {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "pixel_format": "rgb",
        "component_format": "float32",
        "rfilter": {"type": rfilter},
    }
    if crop is not None:
        names = ("crop_offset_x", "crop_offset_y", "crop_width", "crop_height")
        film |= dict(zip(names, crop, strict=True))
    return film


def _rgb(r: float, g: float, b: float) -> Description:
    return {"type": "rgb", "value": [r, g, b]}


def _diffuse(r: float, g: float | None = None, b: float | None = None) -> Description:
    """A diffuse BSDF, grey if only `r` is given."""
    return {"type": "diffuse", "reflectance": _rgb(r, r if g is None else g, r if b is None else b)}


def _area(r: float, g: float | None = None, b: float | None = None) -> Description:
    """An area emitter, grey if only `r` is given."""
    return {"type": "area", "radiance": _rgb(r, r if g is None else g, r if b is None else b)}


def _twosided(bsdf: Description) -> Description:
    return {"type": "twosided", "bsdf": bsdf}


def _waves() -> NDArray[np.float32]:
    """Heights (12, 16) between 0 and 1, smooth and periodic."""
    v, u = np.mgrid[0:12, 0:16]
    waves = np.sin(2 * np.pi * (u / 16 + v / 12)) * np.cos(4 * np.pi * u / 16)
    return (0.5 + 0.5 * waves).astype(np.float32)


def _checks() -> Description:
    """A 16 × 12 bitmap that is no square, repeats, is turned and holds no two equal texels: mistakes in it show."""
    v, u = np.mgrid[0:12, 0:16].astype(np.float32)
    checks = ((u + v) % 2) * 0.4
    pixels = np.stack([0.1 + checks + u / 64, 0.15 + checks + v / 48, 0.5 - checks + u / 64], -1)
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(pixels.astype(np.float32)),
        "raw": True,
        "filter_type": "bilinear",
        "wrap_mode": "repeat",
        "to_uv": mi.ScalarTransform3f().rotate(20).scale([1.5, 2.0]),
    }
