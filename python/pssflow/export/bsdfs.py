"""BSDFs. To add one: write a converter, and give it a row in `BSDFS`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import mitsuba as mi

from .perturbed import switches
from .textures import export_texture
from .walk import (
    SWITCH,
    Converter,
    Entry,
    Fields,
    RefusedError,
    Walk,
    class_of,
    number,
    plugin_of,
    printed,
    switch,
)

DISTRIBUTIONS = {"beckmann": "beckmann", "ggx": "ggx"}


def export_bsdf(walk: Walk, obj: Any, where: str) -> int:
    """Index of a BSDF in the description; those that it nests come before it."""
    walk.bsdfs = BSDFS
    return walk.bsdf(obj, where)


def _diffuse(walk: Walk, obj: Any, where: str) -> Entry:
    return {"reflectance": _texture(walk, Fields(obj), where, "reflectance")}


def _twosided(walk: Walk, obj: Any, where: str) -> Entry:
    fields = Fields(obj)
    return {
        "front": export_bsdf(walk, fields["brdf_0"], f"{where}.brdf_0"),
        "back": export_bsdf(walk, fields["brdf_1"], f"{where}.brdf_1"),
    }


def _blendbsdf(walk: Walk, obj: Any, where: str) -> Entry:
    fields = Fields(obj)
    return {
        "weight": _texture(walk, fields, where, "weight"),
        "first": export_bsdf(walk, fields["bsdf_0"], f"{where}.bsdf_0"),
        "second": export_bsdf(walk, fields["bsdf_1"], f"{where}.bsdf_1"),
    }


def _mask(walk: Walk, obj: Any, where: str) -> Entry:
    fields = Fields(obj)
    return {
        "opacity": _texture(walk, fields, where, "opacity"),
        "nested": export_bsdf(walk, fields["nested_bsdf"], f"{where}.nested_bsdf"),
    }


def _null(_walk: Walk, _obj: Any, _where: str) -> Entry:
    return {}


def _conductor(walk: Walk, obj: Any, where: str) -> Entry:
    fields = Fields(obj)
    return {
        "eta": _texture(walk, fields, where, "eta"),
        "k": _texture(walk, fields, where, "k"),
        "specular_reflectance": _optional_texture(walk, fields, where, "specular_reflectance"),
    }


def _dielectric(walk: Walk, obj: Any, where: str) -> Entry:
    """`dielectric` and `thindielectric`."""
    fields = Fields(obj)
    return {
        "int_ior_over_ext_ior": number(fields["eta"], "eta"),
        "specular_reflectance": _optional_texture(walk, fields, where, "specular_reflectance"),
        "specular_transmittance": _optional_texture(walk, fields, where, "specular_transmittance"),
    }


def _coat(walk: Walk, obj: Any, where: str) -> Entry:
    """What `plastic` and `roughplastic` share."""
    fields, shown = Fields(obj), printed(obj)
    diffuse_mean = number(fields["diffuse_reflectance"].mean(), "diffuse_reflectance")
    specular_mean = 1.0
    if "specular_reflectance" in fields:
        specular_mean = number(fields["specular_reflectance"].mean(), "specular_reflectance")
    # Mitsuba keeps this number to itself but renews it with every edit, from the same means.
    total = diffuse_mean + specular_mean
    return {
        "nonlinear": switch(shown, "nonlinear", SWITCH),
        "int_ior_over_ext_ior": number(fields["eta"], "eta"),
        "diffuse_reflectance": _texture(walk, fields, where, "diffuse_reflectance"),
        "specular_reflectance": _optional_texture(walk, fields, where, "specular_reflectance"),
        "specular_sampling_weight": specular_mean / total if total > 0 else 0.5,
    }


def _roughplastic(walk: Walk, obj: Any, where: str) -> Entry:
    shown = printed(obj)
    return {
        "distribution": switch(shown, "distribution", DISTRIBUTIONS),
        "alpha": number(Fields(obj)["alpha"], "alpha"),
        "sample_visible": switch(shown, "sample_visible", SWITCH),
        **_coat(walk, obj, where),
    }


def _microfacets(walk: Walk, obj: Any, where: str) -> Entry:
    """What `roughconductor` and `roughdielectric` share."""
    fields, shown = Fields(obj), printed(obj)
    isotropic = "alpha" in fields
    return {
        "distribution": switch(shown, "distribution", DISTRIBUTIONS),
        "sample_visible": switch(shown, "sample_visible", SWITCH),
        "alpha_u": _texture(walk, fields, where, "alpha" if isotropic else "alpha_u"),
        "alpha_v": _texture(walk, fields, where, "alpha" if isotropic else "alpha_v"),
    }


def _roughconductor(walk: Walk, obj: Any, where: str) -> Entry:
    return _microfacets(walk, obj, where) | _conductor(walk, obj, where)


def _roughdielectric(walk: Walk, obj: Any, where: str) -> Entry:
    return _microfacets(walk, obj, where) | _dielectric(walk, obj, where)


def _normalmap(walk: Walk, obj: Any, where: str) -> Entry:
    fields = Fields(obj)
    nested, texture = fields["nested_bsdf"], fields["normalmap"]
    _refuse_bumps(nested)
    flip, soften = switches(obj, nested, texture)
    return {
        "nested": export_bsdf(walk, nested, f"{where}.nested_bsdf"),
        "normalmap": _texture(walk, fields, where, "normalmap"),
        "flip_invalid_normals": flip,
        "use_shadowing_function": soften,
    }


def _bumpmap(walk: Walk, obj: Any, where: str) -> Entry:
    fields = Fields(obj)
    nested, texture = fields["nested_bsdf"], fields["nested_texture"]
    scale = number(fields["scale"], "scale")
    _refuse_bumps(nested)
    if class_of(texture) not in HEIGHTS:
        raise RefusedError(
            f"has heights from `{plugin_of(texture)}`, which has no slopes; use a bitmap"
        )
    flip, soften = switches(obj, nested, texture, scale)
    return {
        "nested": export_bsdf(walk, nested, f"{where}.nested_bsdf"),
        "height": _texture(walk, fields, where, "nested_texture"),
        "scale": scale,
        "flip_invalid_normals": flip,
        "use_shadowing_function": soften,
    }


HEIGHTS = ("BitmapTextureImpl", "UniformSpectrum")
"""Textures that Mitsuba can take the gradient of."""


def _refuse_bumps(bsdf: Any) -> None:
    """A bump map needs the surface's own frame: not that of another map around it.

    Raises:
        RefusedError: there is one in `bsdf`, at any depth.
    """
    if class_of(bsdf) == "BumpMap":
        raise RefusedError("nests a `bumpmap` in a frame of its own; give one of the two up")
    for child in Fields(bsdf).children.values():
        if isinstance(child, mi.BSDF):
            _refuse_bumps(child)


DISNEY = (
    *("base_color", "roughness", "anisotropic", "spec_trans", "spec_tint"),
    *("sheen", "sheen_tint", "flatness"),
)
"""Textures that `principled` and `principledthin` share."""


def _principled(walk: Walk, obj: Any, where: str) -> Entry:
    fields = Fields(obj)
    if "eta" in fields:
        eta = number(fields["eta"], "eta")
    else:
        eta = 2 / (1 - (0.08 * number(fields["specular"], "specular")) ** 0.5) - 1
    textures = (*DISNEY, "metallic", "clearcoat", "clearcoat_gloss")
    rates = ("main_specular", "clearcoat", "diffuse_reflectance")
    return {
        "eta": eta,
        **{name: _texture(walk, fields, where, name) for name in textures},
        **_rates(fields, rates),
    }


def _principledthin(walk: Walk, obj: Any, where: str) -> Entry:
    fields = Fields(obj)
    textures = (*DISNEY, "eta", "diff_trans")
    rates = [
        f"{kind}_{way}"
        for kind in ("specular", "diffuse")
        for way in ("reflectance", "transmittance")
    ]
    return {name: _texture(walk, fields, where, name) for name in textures} | _rates(fields, rates)


def _rates(fields: Fields, names: Iterable[str]) -> Entry:
    keys = (f"{name}_sampling_rate" for name in names)
    return {key: number(fields[key], key) for key in keys}


BSDFS: dict[str, Converter] = {
    "SmoothDiffuse": Converter("diffuse", "diffuse", _diffuse),
    "SmoothConductor": Converter("conductor", "conductor", _conductor),
    "SmoothDielectric": Converter("dielectric", "dielectric", _dielectric),
    "ThinDielectric": Converter("thindielectric", "thindielectric", _dielectric),
    "RoughDielectric": Converter("roughdielectric", "roughdielectric", _roughdielectric),
    "SmoothPlastic": Converter("plastic", "plastic", _coat),
    "MaskBSDF": Converter("mask", "mask", _mask),
    "Null": Converter("null", "null", _null),
    "BumpMap": Converter("bumpmap", "bumpmap", _bumpmap),
    "NormalMap": Converter("normalmap", "normalmap", _normalmap),
    "Principled": Converter("principled", "principled", _principled),
    "PrincipledThin": Converter("principledthin", "principledthin", _principledthin),
    "TwoSidedBRDF": Converter("twosided", "twosided", _twosided),
    "BlendBSDF": Converter("blendbsdf", "blendbsdf", _blendbsdf),
    "RoughPlastic": Converter("roughplastic", "roughplastic", _roughplastic),
    "RoughConductor": Converter("roughconductor", "roughconductor", _roughconductor),
}


def _texture(walk: Walk, fields: Fields, where: str, name: str) -> int:
    return export_texture(walk, fields[name], f"{where}.{name}")


def _optional_texture(walk: Walk, fields: Fields, where: str, name: str) -> int | None:
    return _texture(walk, fields, where, name) if name in fields else None
