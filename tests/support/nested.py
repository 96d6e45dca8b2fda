"""Random BSDF dictionaries, nested as Mitsuba allows or not, for hypothesis.

Values stay where single precision is fair to both sides: lobes no narrower than α = .08, indices up to 2.2.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
from hypothesis import strategies as st

Description = dict[str, Any]
Strategy = st.SearchStrategy[Any]

UNIT = st.floats(0.0, 1.0, allow_subnormal=False)
ROUGHNESS = st.floats(0.08, 0.9, allow_subnormal=False)
IOR = st.floats(1.0, 2.2, allow_subnormal=False)
SWITCH = st.booleans()
DISTRIBUTION = st.sampled_from(["beckmann", "ggx"])


@st.composite
def _bitmap(
    draw: st.DrawFn, channels: int, low: float = 0.1, high: float = 0.9, *, smooth: bool = False
) -> Description:
    size = draw(st.sampled_from([(1, 1), (2, 3), (7, 5)]))
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    texels = rng.uniform(low, high, (*size, channels)).astype(np.float32)
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(texels),
        "raw": True,
        "filter_type": "bilinear" if smooth else draw(st.sampled_from(["bilinear", "nearest"])),
        "wrap_mode": draw(st.sampled_from(["repeat", "mirror", "clamp"])),
        "to_uv": mi.ScalarTransform3f().rotate(draw(st.sampled_from([0, 20]))).scale([1.5, 2]),
    }


RGB = st.lists(UNIT, min_size=3, max_size=3).map(lambda v: {"type": "rgb", "value": v})
CHECKS = st.builds(lambda a, b: {"type": "checkerboard", "color0": a, "color1": b}, RGB, RGB)
COLOUR = st.one_of(RGB, UNIT, _bitmap(3), CHECKS)
GREY = st.one_of(UNIT, _bitmap(1))
ALPHA = st.one_of(ROUGHNESS, _bitmap(1))
INDEX = st.lists(st.floats(0.2, 4.0, allow_subnormal=False), min_size=3, max_size=3).map(
    lambda v: {"type": "rgb", "value": v}
)


def _plugin(kind: str, needed: dict[str, Strategy] | None = None, **optional: Any) -> Strategy:
    """Dictionaries of one plugin: `needed` always, each of `optional` or not."""
    return st.fixed_dictionaries({"type": st.just(kind)} | (needed or {}), optional=optional)


METAL = st.one_of(
    st.fixed_dictionaries({"material": st.sampled_from(["Au", "Cu", "Al", "none"])}),
    st.fixed_dictionaries({"eta": INDEX, "k": INDEX}),
)
LOBES: dict[str, Any] = {"specular_reflectance": COLOUR, "specular_transmittance": COLOUR}
MICROFACETS = st.one_of(
    st.fixed_dictionaries({"alpha": ALPHA}),
    st.fixed_dictionaries({"alpha_u": ROUGHNESS, "alpha_v": ROUGHNESS}),
)
DISNEY = dict.fromkeys(
    ("anisotropic", "spec_trans", "sheen", "sheen_tint", "flatness", "spec_tint"), GREY
)


def _with(extra: Strategy, base: Strategy) -> Strategy:
    return st.builds(lambda a, b: a | b, base, extra)


LEAVES = st.one_of(
    _plugin("diffuse", reflectance=COLOUR),
    _with(METAL, _plugin("conductor", specular_reflectance=COLOUR)),
    _plugin("dielectric", int_ior=IOR, ext_ior=IOR, **LOBES),
    _plugin("thindielectric", int_ior=IOR, ext_ior=IOR, **LOBES),
    _with(
        METAL,
        _with(
            MICROFACETS,
            _plugin(
                "roughconductor",
                distribution=DISTRIBUTION,
                sample_visible=SWITCH,
                specular_reflectance=COLOUR,
            ),
        ),
    ),
    _with(
        MICROFACETS,
        _plugin(
            "roughdielectric",
            {"int_ior": st.floats(1.2, 2.2, allow_subnormal=False)},
            distribution=DISTRIBUTION,
            sample_visible=SWITCH,
            **LOBES,
        ),
    ),
    _plugin(
        "plastic",
        int_ior=st.floats(1.1, 2.2, allow_subnormal=False),
        nonlinear=SWITCH,
        diffuse_reflectance=COLOUR,
        specular_reflectance=COLOUR,
    ),
    _plugin(
        "roughplastic",
        {"alpha": ROUGHNESS},
        int_ior=st.floats(1.1, 2.2, allow_subnormal=False),
        distribution=DISTRIBUTION,
        sample_visible=SWITCH,
        nonlinear=SWITCH,
        diffuse_reflectance=COLOUR,
        specular_reflectance=COLOUR,
    ),
    _plugin(
        "principled",
        {"roughness": st.floats(0.3, 1.0, allow_subnormal=False)},
        base_color=COLOUR,
        metallic=GREY,
        clearcoat=GREY,
        clearcoat_gloss=st.floats(0.0, 0.5, allow_subnormal=False),
        eta=st.floats(1.1, 2.0, allow_subnormal=False),
        **DISNEY,
    ),
    _plugin(
        "principledthin",
        {"roughness": st.floats(0.3, 1.0, allow_subnormal=False)},
        base_color=COLOUR,
        diff_trans=st.floats(0.0, 2.0, allow_subnormal=False),
        eta=st.floats(1.1, 2.0, allow_subnormal=False),
        **DISNEY,
    ),
    st.just({"type": "null"}),
    # Known to Mitsuba alone.
    st.just({"type": "polarizer"}),
    _plugin("pplastic", diffuse_reflectance=COLOUR, alpha=ROUGHNESS),
)
"""BSDFs that nest none."""


def _around(inner: Strategy) -> Strategy:
    return st.one_of(
        _plugin("twosided", {"front": inner}),
        _plugin("twosided", {"front": inner, "rear": inner}),
        _plugin("mask", {"nested": inner}, opacity=GREY),
        _plugin("blendbsdf", {"weight": GREY, "first": inner, "second": inner}),
        _plugin(
            "normalmap",
            {"normalmap": _bitmap(3, 0.35, 0.65, smooth=True), "nested": inner},
            flip_invalid_normals=SWITCH,
            use_shadowing_function=SWITCH,
        ),
        _plugin(
            "bumpmap",
            {"heights": _bitmap(1, smooth=True), "nested": inner},
            scale=st.floats(0.01, 0.1, allow_subnormal=False),
            flip_invalid_normals=SWITCH,
            use_shadowing_function=SWITCH,
        ),
    )


NESTED: Strategy = st.recursive(LEAVES, _around, max_leaves=4)
"""BSDFs, up to four leaves deep."""


def plugins(description: Description) -> set[str]:
    """Names of all plugins in a dictionary."""
    found = {description["type"]}
    for child in description.values():
        if isinstance(child, dict) and "type" in child:
            found |= plugins(child)
    return found
