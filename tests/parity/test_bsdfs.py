"""BSDFs by value: ours beside Mitsuba's for the same (uv, wi, wo); samples beside our own density; energy.

Directions are local, so no tangent frame enters here: `test_rays.py` compares the frames.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np
import pytest

from pssflow import _core
from tests.conftest import LLVM
from tests.support.chi2 import sphere_chi2
from tests.support.core import core_scene
from tests.support.values import (
    F32,
    direction_pairs,
    disagreements,
    first_rows,
    interaction,
    points,
    sphere_directions,
    unit_interval,
    vector3,
)

pytestmark = pytest.mark.parity

Description = dict[str, Any]


def _rgb(*value: float) -> Description:
    return {"type": "rgb", "value": list(value)}


def _bitmap(seed: int, channels: int) -> Description:
    texels = np.random.default_rng(seed).uniform(0.1, 0.9, (7, 5, channels)).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}


def _plastic(**options: Any) -> Description:
    return {"type": "roughplastic", "diffuse_reflectance": _rgb(0.6, 0.4, 0.2)} | options


def _gold(**options: Any) -> Description:
    return {
        "type": "roughconductor",
        "eta": _rgb(0.14, 0.37, 1.44),
        "k": _rgb(3.98, 2.39, 1.6),
    } | options


def _coat(**options: Any) -> Description:
    return {"type": "plastic", "diffuse_reflectance": _rgb(0.2, 0.4, 0.6)} | options


def _rough_glass(**options: Any) -> Description:
    return {"type": "roughdielectric", "int_ior": 1.5, "ext_ior": 1.0} | options


def _disney(**options: Any) -> Description:
    return {"type": "principled", "base_color": _rgb(0.8, 0.5, 0.3), "roughness": 0.4} | options


def _sheet(**options: Any) -> Description:
    return {"type": "principledthin", "base_color": _rgb(0.4, 0.7, 0.5), "roughness": 0.5} | options


def _bumpy(nested: Description, **options: Any) -> Description:
    """A normal map whose normals lie up to 50° off."""
    xy = np.random.default_rng(31).uniform(-0.6, 0.6, (7, 5, 2))
    normals = np.concatenate([xy, np.full((7, 5, 1), 0.8)], axis=2)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    texels = (0.5 + 0.5 * normals).astype(np.float32)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}
    return {"type": "normalmap", "normalmap": texture, "nested": nested} | options


def _bumps(nested: Description, **options: Any) -> Description:
    texture = _bitmap(32, 1) | {"to_uv": mi.ScalarTransform3f().scale([2, 3])}
    return {"type": "bumpmap", "heights": texture, "nested": nested, "scale": 0.08} | options


DISNEY_TEXTURES = (
    *("roughness", "anisotropic", "spec_trans", "spec_tint", "sheen", "sheen_tint", "flatness"),
    *("metallic", "clearcoat", "clearcoat_gloss"),
)

BSDFS: dict[str, Callable[[], Description]] = {
    "diffuse": lambda: {"type": "diffuse", "reflectance": _rgb(0.2, 0.5, 0.8)},
    "diffuse-textured": lambda: {"type": "diffuse", "reflectance": _bitmap(1, 3)},
    "twosided": lambda: {
        "type": "twosided",
        "bsdf": {"type": "diffuse", "reflectance": _rgb(0.2, 0.5, 0.8)},
    },
    "twosided-two": lambda: {
        "type": "twosided",
        "front": _plastic(alpha=0.2),
        "back": _gold(alpha=0.3),
    },
    "plastic-beckmann": lambda: _plastic(distribution="beckmann", alpha=0.15),
    "plastic-ggx": lambda: _plastic(distribution="ggx", alpha=0.3, int_ior=1.8, ext_ior=1.1),
    "plastic-nonlinear": lambda: _plastic(alpha=0.25, nonlinear=True),
    "plastic-all-normals": lambda: _plastic(distribution="ggx", alpha=0.35, sample_visible=False),
    "plastic-beckmann-all-normals": lambda: _plastic(alpha=0.35, sample_visible=False),
    "plastic-textured": lambda: _plastic(
        alpha=0.2,
        diffuse_reflectance=_bitmap(2, 3),
        specular_reflectance=_bitmap(3, 3),
        nonlinear=True,
    ),
    "conductor-beckmann": lambda: _gold(distribution="beckmann", alpha=0.1),
    "conductor-ggx": lambda: _gold(distribution="ggx", alpha=0.25),
    "conductor-beckmann-anisotropic": lambda: _gold(alpha_u=0.4, alpha_v=0.12),
    "conductor-ggx-anisotropic": lambda: _gold(distribution="ggx", alpha_u=0.15, alpha_v=0.5),
    "conductor-all-normals": lambda: _gold(distribution="ggx", alpha=0.3, sample_visible=False),
    "conductor-beckmann-all-normals": lambda: _gold(alpha=0.3, sample_visible=False),
    "conductor-anisotropic-all-normals": lambda: _gold(
        distribution="ggx", alpha_u=0.2, alpha_v=0.45, sample_visible=False
    ),
    "conductor-beckmann-anisotropic-all-normals": lambda: _gold(
        alpha_u=0.45, alpha_v=0.2, sample_visible=False
    ),
    "conductor-textured": lambda: _gold(alpha=_bitmap(4, 1), specular_reflectance=_bitmap(5, 3)),
    "blend": lambda: {
        "type": "blendbsdf",
        "weight": 0.3,
        "a": {"type": "diffuse", "reflectance": _rgb(0.7, 0.3, 0.5)},
        "b": _gold(distribution="ggx", alpha=0.2),
    },
    "blend-nested-textured": lambda: {
        "type": "twosided",
        "nested": {
            "type": "blendbsdf",
            "weight": _bitmap(6, 1),
            "a": {
                "type": "blendbsdf",
                "weight": 0.6,
                "a": _plastic(alpha=0.3),
                "b": {"type": "diffuse", "reflectance": _bitmap(7, 3)},
            },
            "b": _gold(alpha_u=0.2, alpha_v=0.4),
        },
    },
}
"""Each on a sphere of its own in the gallery."""

BSDFS |= {
    "coat": lambda: _coat(),
    "coat-nonlinear": lambda: _coat(nonlinear=True, int_ior=1.9),
    "coat-textured": lambda: _coat(
        diffuse_reflectance=_bitmap(8, 3), specular_reflectance=_bitmap(9, 3), int_ior=1.3
    ),
    "coat-twosided": lambda: {"type": "twosided", "nested": _coat()},
    "mask": lambda: {"type": "mask", "opacity": 0.6, "nested": _gold(alpha=0.2)},
    "mask-textured": lambda: {
        "type": "mask",
        "opacity": _bitmap(10, 1),
        "nested": {"type": "twosided", "nested": {"type": "diffuse"}},
    },
    "mask-of-coat": lambda: {"type": "mask", "opacity": 0.7, "nested": _coat()},
    "mask-of-mask": lambda: {
        "type": "mask",
        "opacity": _bitmap(11, 1),
        "nested": {"type": "mask", "opacity": 0.5, "nested": _rough_glass(alpha=0.3)},
    },
    "rough-glass-beckmann": lambda: _rough_glass(alpha=0.2),
    "rough-glass-ggx": lambda: _rough_glass(distribution="ggx", alpha=0.3, int_ior=1.33),
    "rough-glass-inside-out": lambda: _rough_glass(alpha=0.25, int_ior=1.0, ext_ior=1.7),
    "rough-glass-anisotropic": lambda: _rough_glass(distribution="ggx", alpha_u=0.2, alpha_v=0.5),
    "rough-glass-all-normals": lambda: _rough_glass(
        distribution="ggx", alpha=0.3, sample_visible=False
    ),
    "rough-glass-beckmann-all-normals": lambda: _rough_glass(
        alpha_u=0.3, alpha_v=0.2, sample_visible=False
    ),
    "rough-glass-textured": lambda: _rough_glass(
        alpha=_bitmap(12, 1),
        specular_reflectance=_bitmap(13, 3),
        specular_transmittance=_bitmap(14, 3),
    ),
    "blend-of-rough-glass": lambda: {
        "type": "blendbsdf",
        "weight": 0.4,
        "a": _rough_glass(alpha=0.3),
        "b": {"type": "twosided", "nested": {"type": "diffuse"}},
    },
}

BSDFS |= {
    "disney": lambda: _disney(),
    "disney-metal": lambda: _disney(metallic=0.8, anisotropic=0.7, spec_tint=0.4),
    "disney-cloth": lambda: _disney(sheen=0.9, sheen_tint=0.6, flatness=0.7, roughness=0.8),
    "disney-coated": lambda: _disney(
        clearcoat=0.9, clearcoat_gloss=0.1, specular=0.7, clearcoat_sampling_rate=2.0
    ),
    "disney-glass": lambda: _disney(spec_trans=0.8, eta=1.4, roughness=0.5),
    "disney-all": lambda: _disney(
        spec_trans=0.5,
        metallic=0.3,
        anisotropic=0.5,
        eta=1.6,
        spec_tint=0.5,
        sheen=0.4,
        sheen_tint=0.5,
        flatness=0.3,
        clearcoat=0.6,
        clearcoat_gloss=0.2,
        main_specular_sampling_rate=0.7,
        diffuse_reflectance_sampling_rate=1.5,
    ),
    "disney-textured": lambda: _disney(
        base_color=_bitmap(23, 3),
        roughness=_bitmap(24, 1),
        metallic=_bitmap(25, 1),
        clearcoat=_bitmap(26, 1),
        sheen=_bitmap(27, 1),
    ),
    "sheet": lambda: _sheet(),
    "sheet-glossy": lambda: _sheet(spec_trans=0.7, eta=1.3, spec_tint=0.5, roughness=0.6),
    "sheet-all": lambda: _sheet(
        spec_trans=0.4,
        diff_trans=1.2,
        anisotropic=0.6,
        eta=1.5,
        spec_tint=0.3,
        sheen=0.8,
        sheen_tint=0.5,
        flatness=0.6,
        specular_transmittance_sampling_rate=0.5,
        diffuse_transmittance_sampling_rate=2.0,
    ),
    "sheet-textured": lambda: _sheet(
        spec_trans=_bitmap(28, 1), diff_trans=_bitmap(29, 1), base_color=_bitmap(30, 3)
    ),
    "normalmap": lambda: _bumpy({"type": "diffuse"}),
    "normalmap-hard": lambda: _bumpy(
        {"type": "diffuse"}, flip_invalid_normals=False, use_shadowing_function=False
    ),
    "normalmap-unflipped": lambda: _bumpy(
        {"type": "twosided", "nested": _gold(alpha_u=0.2, alpha_v=0.4)}, flip_invalid_normals=False
    ),
    "normalmap-glass": lambda: _bumpy(_rough_glass(alpha=0.3), use_shadowing_function=False),
    "normalmap-twosided": lambda: {"type": "twosided", "nested": _bumpy(_plastic(alpha=0.2))},
    "normalmap-coat": lambda: _bumpy(_coat()),
    "bumpmap": lambda: _bumps({"type": "diffuse"}),
    "bumpmap-hard": lambda: _bumps(
        {"type": "diffuse"}, flip_invalid_normals=False, use_shadowing_function=False
    ),
    "bumpmap-textured": lambda: _bumps(_plastic(alpha=0.2, diffuse_reflectance=_bitmap(33, 3))),
    "bumpmap-anisotropic": lambda: _bumps(_gold(alpha_u=0.2, alpha_v=0.4), scale=-0.05),
    "bumpmap-twosided": lambda: {"type": "twosided", "nested": _bumps(_coat())},
    "bumpmap-glass": lambda: _bumps(_rough_glass(alpha=0.3), use_shadowing_function=False),
    "normalmap-mask": lambda: _bumpy({"type": "mask", "opacity": 0.6, "nested": _coat()}),
}

BSDFS |= {
    "conductor-copper": lambda: {"type": "roughconductor", "material": "Cu", "alpha": 0.2},
    "conductor-spectra": lambda: {
        "type": "roughconductor",
        "alpha": 0.3,
        "eta": {"type": "spectrum", "value": [(400, 1.2), (550, 0.6), (700, 0.2)]},
        "k": {"type": "spectrum", "value": [(400, 2.1), (550, 2.6), (700, 4.2)]},
    },
    "conductor-textured-anisotropic": lambda: _gold(
        distribution="ggx",
        alpha_u=_bitmap(40, 1),
        alpha_v=_bitmap(41, 1),
        eta=_bitmap(42, 3),
        k=_bitmap(43, 3),
    ),
    "plastic-named-ior": lambda: _plastic(alpha=0.2, int_ior="polypropylene", ext_ior="water"),
    "coat-named-ior": lambda: _coat(int_ior="acrylic glass", ext_ior="water ice"),
    "rough-glass-named-ior": lambda: _rough_glass(alpha=0.3, int_ior="bk7", ext_ior="vacuum"),
    "rough-glass-textured-anisotropic": lambda: _rough_glass(
        distribution="ggx", alpha_u=_bitmap(44, 1), alpha_v=_bitmap(45, 1)
    ),
    "disney-all-textured": lambda: _disney(
        **{name: _bitmap(50 + i, 1) for i, name in enumerate(DISNEY_TEXTURES)}
    ),
    "sheet-all-textured": lambda: _sheet(
        **{name: _bitmap(70 + i, 1) for i, name in enumerate((*DISNEY_TEXTURES[:7], "diff_trans"))}
    ),
    "checkerboard-weight": lambda: {
        "type": "blendbsdf",
        "weight": {"type": "checkerboard", "color0": 0.2, "color1": 0.7},
        "a": {"type": "diffuse", "reflectance": {"type": "checkerboard"}},
        "b": _gold(alpha=0.3),
    },
}

DELTA: dict[str, Callable[[], Description]] = {
    "mirror": lambda: {"type": "conductor", "specular_reflectance": _rgb(0.9, 0.8, 0.7)},
    "mirror-spectra": lambda: {
        "type": "conductor",
        "eta": {"type": "spectrum", "value": [(400, 1.2), (700, 0.2)]},
        "k": {"type": "spectrum", "value": [(400, 2.1), (700, 4.2)]},
    },
    "mirror-gold": lambda: {"type": "conductor", "material": "Au"},
    "mirror-textured": lambda: {
        "type": "conductor",
        "eta": _bitmap(15, 3),
        "k": _rgb(2, 3, 4),
        "specular_reflectance": _bitmap(16, 3),
    },
    "mirror-twosided": lambda: {
        "type": "twosided",
        "nested": {"type": "conductor", "eta": _rgb(0.2, 0.9, 1.1), "k": _rgb(3, 2, 1)},
    },
    "glass": lambda: {"type": "dielectric"},
    "glass-inside-out": lambda: {"type": "dielectric", "int_ior": "air", "ext_ior": "diamond"},
    "glass-tinted": lambda: {
        "type": "dielectric",
        "int_ior": 1.8,
        "specular_reflectance": _bitmap(17, 3),
        "specular_transmittance": _bitmap(18, 3),
    },
    "no-glass": lambda: {"type": "dielectric", "int_ior": 1.2, "ext_ior": 1.2},
    "pane": lambda: {"type": "thindielectric", "int_ior": 1.7},
    "pane-tinted": lambda: {
        "type": "thindielectric",
        "specular_reflectance": _bitmap(19, 3),
        "specular_transmittance": _bitmap(20, 3),
    },
    "null": lambda: {"type": "null"},
    "mask-of-glass": lambda: {
        "type": "mask",
        "opacity": _bitmap(21, 1),
        "nested": {"type": "dielectric"},
    },
    "mask-of-mirror": lambda: {
        "type": "mask",
        "opacity": 0.3,
        "nested": {"type": "twosided", "nested": {"type": "conductor"}},
    },
    "normalmap-mirror": lambda: _bumpy({"type": "conductor"}),
    "normalmap-of-glass": lambda: _bumpy({"type": "dielectric"}, use_shadowing_function=False),
    "blend-of-mirrors": lambda: {
        "type": "blendbsdf",
        "weight": _bitmap(22, 1),
        "a": {"type": "conductor"},
        "b": {"type": "dielectric", "int_ior": 1.9},
    },
}
"""Nothing but delta lobes."""

MIXED = (
    "coat",
    "coat-nonlinear",
    "coat-textured",
    "coat-twosided",
    "mask",
    "mask-textured",
    "mask-of-coat",
    "mask-of-mask",
    "normalmap-coat",
    "normalmap-mask",
    "bumpmap-twosided",
)
"""Those of `BSDFS` with delta lobes beside smooth ones."""

WHITE: dict[str, Callable[[], Description]] = {
    "white-diffuse": lambda: {"type": "diffuse", "reflectance": _rgb(1, 1, 1)},
    "white-plastic": lambda: _plastic(alpha=0.2, diffuse_reflectance=_rgb(1, 1, 1)),
    "white-plastic-nonlinear": lambda: _plastic(
        alpha=0.2, diffuse_reflectance=_rgb(1, 1, 1), nonlinear=True
    ),
    "white-plastic-rough": lambda: _plastic(
        distribution="ggx", alpha=0.7, diffuse_reflectance=_rgb(1, 1, 1)
    ),
    "white-mirror": lambda: {"type": "roughconductor", "material": "none", "alpha": 0.15},
    "white-mirror-ggx": lambda: {
        "type": "roughconductor",
        "material": "none",
        "distribution": "ggx",
        "alpha_u": 0.6,
        "alpha_v": 0.2,
    },
    "white-mirror-all-normals": lambda: {
        "type": "roughconductor",
        "material": "none",
        "distribution": "ggx",
        "alpha": 0.5,
        "sample_visible": False,
    },
    "white-coat": lambda: _coat(diffuse_reflectance=_rgb(1, 1, 1)),
    "white-coat-nonlinear": lambda: _coat(diffuse_reflectance=_rgb(1, 1, 1), nonlinear=True),
}
"""Nothing is absorbed, so that a surplus of energy shows."""


class Gallery(NamedTuple):
    """All BSDFs in one scene, on both sides."""

    core: _core.Scene
    ids: dict[str, int]
    """BSDF of the core, by name."""
    theirs: dict[str, mi.BSDF]


@pytest.fixture(scope="module")
def gallery() -> Gallery:
    mi.set_variant(LLVM)
    camera = {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}}
    balls = {
        name: {"type": "sphere", "center": [3.0 * i, 0, 0], "id": name, "bsdf": make()}
        for i, (name, make) in enumerate((BSDFS | DELTA | WHITE).items())
    }
    scene = mi.load_dict({"type": "scene", "camera": camera} | balls)
    core, exported = core_scene(scene)
    index = {shape["id"]: shape["bsdf"] for shape in exported.description["shapes"]}
    return Gallery(core, index, {shape.id(): shape.bsdf() for shape in scene.shapes()})


@pytest.mark.parametrize("name", BSDFS)
def test_value_and_density_are_mitsubas(name: str, gallery: Gallery) -> None:
    """20,000 triples (uv, wi, wo): value and density within 1e-3, but for at most 20 within .6° of the horizon, or
    of a refracting microfacet's plane. There both sides lose digits to cancellation.
    """
    rng = np.random.default_rng(11)
    n = 20_000
    uv = rng.uniform(-1, 2, (n, 2)).astype(np.float32)
    wi, wo = direction_pairs(rng, n)
    value, pdf = gallery.core.bsdf_eval_pdf(gallery.ids[name], uv, wi, wo)

    si = interaction(uv, wi)
    theirs, context = gallery.theirs[name], mi.BSDFContext()
    their_value = points(theirs.eval(context, si, vector3(wo)))
    their_pdf = points(theirs.pdf(context, si, vector3(wo)))
    # Its `roughplastic` gives densities below the horizon too, where it neither reflects nor samples.
    their_pdf[~their_value.any(axis=1) & (wi[:, 2] * wo[:, 2] < 0)] = 0
    if name.startswith("plastic"):
        their_pdf[wi[:, 2] < 0] = 0
    # Likewise its `principled` on the back of what does not transmit.
    if name.startswith("disney"):
        their_pdf[~their_value.any(axis=1) & (wi[:, 2] < 0)] = 0
    assert np.count_nonzero(their_pdf) > n / 5

    wrong = disagreements(value, their_value, rel=1e-3, floor=1e-6)
    wrong |= disagreements(pdf, their_pdf, rel=1e-3, floor=1e-6)
    grazing = np.minimum(np.abs(wi[:, 2]), np.abs(wo[:, 2])) < 0.01
    # Refraction along the microfacet: 1 − F and ωo·m both vanish, and with them the value.
    grazing |= (wi[:, 2] * wo[:, 2] < 0) & (their_value.max(axis=1) < 1e-4)
    if name.startswith(("normalmap", "bumpmap")):
        grazing |= their_pdf < 1e-3  # the horizon of another normal
    rows = {"uv": uv, "wi": wi, "wo": wo, "value": value, "theirs": their_value}
    rows |= {"pdf": pdf, "their_pdf": their_pdf}
    assert not (wrong & ~grazing).any(), first_rows(wrong & ~grazing, **rows)
    assert np.count_nonzero(wrong) <= 20, first_rows(wrong, **rows)


INCIDENT = {
    "normal": (0.0, 0.0, 1.0),
    "slanted": (0.5, -0.3, 0.6),
    "grazing": (-0.7, 0.68, 0.2),
}
"""Directions that sampling is tested for."""


def _directed(name: str, n: int) -> F32:
    w = np.array(INCIDENT[name], np.float32)
    return np.tile(w / np.linalg.norm(w), (n, 1)).astype(np.float32)


NARROW = (
    "rough-glass",
    "mask-of-mask",
    "blend-of-rough-glass",
    "normalmap-glass",
    "bumpmap-glass",
    "disney-glass",
    "disney-all",
    "sheet",
)
"""BSDFs with lobes narrower than 384 bins of the sphere resolve."""


@pytest.mark.parametrize("incident", INCIDENT)
@pytest.mark.parametrize("name", BSDFS)
def test_samples_follow_the_density(name: str, incident: str, gallery: Gallery) -> None:
    """H0: `bsdf_sample` draws from the density of `bsdf_eval_pdf`, and gives value ÷ density as weight.

    χ² over 384 bins of the sphere (6,144 for narrow lobes), 200,000 samples, level 1e-4.
    """
    rng = np.random.default_rng(12)
    n = 200_000
    wi = _directed(incident, n)
    uv = np.full((n, 2), (0.31, 0.62), np.float32)
    bsdf = gallery.ids[name]
    wo, weight, pdf, delta = gallery.core.bsdf_sample(bsdf, uv, wi, unit_interval(rng, n, 2))
    drawn = (pdf > 0) & ~delta

    def density(w: F32) -> F32:
        m = len(w)
        return gallery.core.bsdf_eval_pdf(
            bsdf, np.tile(uv[:1], (m, 1)), np.tile(wi[:1], (m, 1)), w
        )[1]

    # Refraction into the denser side ends sharply at the critical angle, and a sheet passes light on in a
    # narrow lobe: finer bins find their edges.
    rings, sectors = (64, 96) if name.startswith(NARROW) else (16, 24)
    p, text = sphere_chi2(wo[drawn], n, density, rings=rings, sectors=sectors)
    assert p > 1e-4, text

    value, again = gallery.core.bsdf_eval_pdf(bsdf, uv, wi, wo)
    # The horizon of a normal map's normal is elsewhere, and so is its cancellation.
    rel = 1e-2 if name.startswith(("normalmap", "bumpmap")) else 1e-3
    wrong = disagreements(pdf, again, rel=rel, floor=1e-4)
    wrong |= disagreements(weight * pdf[:, None], value, rel=rel, floor=1e-4)
    wrong &= drawn & (np.abs(wo[:, 2]) > 0.01)
    assert not wrong.any(), first_rows(
        wrong, wo=wo, pdf=pdf, again=again, weight=weight, value=value
    )
    np.testing.assert_allclose(np.linalg.norm(wo[drawn], axis=1), 1, atol=1e-5)
    assert (weight[pdf == 0] == 0).all()


DIM_IN_MITSUBA = ("rough-glass-all-normals", "rough-glass-beckmann-all-normals")
"""Its `roughdielectric` draws all normals from a rougher distribution, but leaves the ratio out of the weight."""


@pytest.mark.parametrize("name", [name for name in [*BSDFS, *DELTA] if name not in DIM_IN_MITSUBA])
def test_samples_have_mitsubas_mean_weight(name: str, gallery: Gallery) -> None:
    """H0: the same share of light is reflected, for 20,000 random (uv, wi), by both samplers; five standard errors."""
    rng = np.random.default_rng(13)
    n = 20_000
    uv = rng.uniform(-1, 2, (n, 2)).astype(np.float32)
    wi = sphere_directions(rng, n)
    u = unit_interval(rng, n, 3)
    _, ours, *_ = gallery.core.bsdf_sample(gallery.ids[name], uv, wi, u[:, :2].copy())
    _, theirs = gallery.theirs[name].sample(
        mi.BSDFContext(),
        interaction(uv, wi),
        u[:, 2].copy(),
        mi.Point2f(u[:, :2].T.copy()),
    )
    theirs = np.broadcast_to(points(theirs), ours.shape).copy()
    # From behind a one-sided surface its `blendbsdf` divides nothing by nothing.
    lost = ~np.isfinite(theirs).all(axis=1)
    assert (wi[lost, 2] < 0).all()
    theirs[lost] = 0
    difference = ours.astype(np.float64) - theirs
    se = difference.std(axis=0) / np.sqrt(n)
    assert (np.abs(difference.mean(axis=0)) <= 5 * se + 1e-6).all(), (difference.mean(axis=0), se)


@pytest.mark.parametrize("name", [*DELTA, *MIXED])
def test_delta_lobes_are_mitsubas(name: str, gallery: Gallery) -> None:
    """Direction, probability and weight of delta lobes, for 10,000 random (uv, wi); and how often each side takes one.

    Each lobe that Mitsuba draws must be among those that we draw from 64 numbers. Rare lobes (below 3 %) may be missed.
    """
    rng = np.random.default_rng(15)
    n, steps = 10_000, 64
    uv = rng.uniform(-1, 2, (n, 2)).astype(np.float32)
    wi = sphere_directions(rng, n)
    wi = wi[np.abs(wi[:, 2]) > 1e-3]
    n, uv = len(wi), uv[: len(wi)]
    u = unit_interval(rng, n, 3)
    sample, weight = gallery.theirs[name].sample(
        mi.BSDFContext(),
        interaction(uv, wi),
        u[:, 2].copy(),
        mi.Point2f(u[:, :2].T.copy()),
    )
    their_wo, their_pdf, their_weight = points(sample.wo), points(sample.pdf), points(weight)
    kind = np.array(sample.sampled_type).astype(np.uint32)
    if name == "null":  # one number for all
        their_pdf, kind = np.repeat(their_pdf, n), np.repeat(kind, n)
        their_weight = np.ones((n, 3), np.float32)
    theirs = ((kind & int(mi.BSDFFlags.Delta)) != 0) & their_weight.any(axis=1)

    best, probability = np.full(n, np.inf), np.zeros(n, np.float32)
    pdf, weight = np.zeros(n, np.float32), np.zeros((n, 3), np.float32)
    bsdf = gallery.ids[name]
    for number in (np.arange(steps) + 0.5) / steps:
        probability, (wo, w, p, delta) = gallery.core.bsdf_sample_delta(
            bsdf, uv, wi, np.full(n, number, np.float32)
        )
        assert (delta == (p > 0)).all()
        # Several lobes may share a direction, as a mask's hole and its nested mask's do.
        distance = np.linalg.norm(wo - their_wo, axis=1) + 0.1 * np.abs(p - their_pdf)
        distance[~delta] = np.inf
        nearer = distance < best
        best[nearer], pdf[nearer], weight[nearer] = distance[nearer], p[nearer], w[nearer]
    compared = theirs & (their_pdf > 0.03)
    assert compared.sum() > n / 50
    wrong = (best > 2e-4) | disagreements(pdf, their_pdf, rel=1e-3, floor=1e-3)
    wrong |= disagreements(weight, their_weight, rel=1e-3, floor=1e-3)
    wrong &= compared
    rows = {"wi": wi, "their_wo": their_wo, "pdf": pdf, "their_pdf": their_pdf}
    rows |= {"weight": weight, "their_weight": their_weight}
    assert not wrong.any(), first_rows(wrong, **rows)

    if name.startswith(("normalmap", "bumpmap")):
        return  # lobes that its normals send to the wrong side end the path: not seen as delta
    reachable = (wi[:, 2] > 0) | (probability < 1)  # a mirror's back: nothing, by either
    excess = (theirs - probability.astype(np.float64))[reachable]
    assert abs(excess.mean()) <= 5 * excess.std() / np.sqrt(len(excess)) + 1e-6
    _, _, p, drawn = gallery.core.bsdf_sample(bsdf, uv, wi, unit_interval(rng, n, 2))
    excess = ((drawn & (p > 0)) - probability.astype(np.float64))[reachable]
    assert abs(excess.mean()) <= 5 * excess.std() / np.sqrt(len(excess)) + 1e-6


@pytest.mark.parametrize("name", DELTA)
def test_delta_lobes_have_no_density(name: str, gallery: Gallery) -> None:
    rng = np.random.default_rng(16)
    wi, wo = sphere_directions(rng, 1000), sphere_directions(rng, 1000)
    uv = rng.random((1000, 2)).astype(np.float32)
    value, pdf = gallery.core.bsdf_eval_pdf(gallery.ids[name], uv, wi, wo)
    assert not value.any()
    assert not pdf.any()


BRIGHTER = ("glass-inside-out", "rough-glass-inside-out", "disney-cloth")
"""From the dense side radiance grows on its way through, by the index squared; Burley's sheen is merely added."""


@pytest.mark.parametrize(
    "name", [name for name in [*WHITE, *DELTA, *BSDFS] if name not in BRIGHTER]
)
def test_no_bsdf_makes_energy(name: str, gallery: Gallery) -> None:
    """White furnace: E[weight] ≤ 1 for every incident direction; four standard errors, and 1e-4 for rounding."""
    rng = np.random.default_rng(14)
    n = 50_000
    for cos_theta in (1.0, 0.7, 0.3, 0.05):
        wi = np.tile(np.array([np.sqrt(1 - cos_theta**2), 0, cos_theta], np.float32), (n, 1))
        uv = rng.random((n, 2)).astype(np.float32)
        _, weight, *_ = gallery.core.bsdf_sample(
            gallery.ids[name], uv, wi, unit_interval(rng, n, 2)
        )
        mean = weight.mean(axis=0, dtype=np.float64)
        se = weight.std(axis=0, dtype=np.float64) / np.sqrt(n)
        assert (mean <= 1 + 4 * se + 1e-4).all(), f"cos θ = {cos_theta}: {mean} ± {se}"
