"""Random nested BSDFs: what Mitsuba loads, we load and agree with by value, or refuse by name."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, event, given, settings

from pssflow.export import UnsupportedError
from tests.conftest import SCALAR
from tests.support.core import core_scene
from tests.support.nested import NESTED, Description, plugins
from tests.support.values import F32, direction_pairs, disagreements, first_rows

pytestmark = pytest.mark.parity

PAIRS = 128
"""Random (uv, wi, wo) for each BSDF."""

FOREIGN = {"polarizer", "pplastic"}
"""Plugins that `NESTED` draws and we do not know."""

PHANTOM = {"roughplastic", "principled"}
"""Plugins whose density in Mitsuba counts directions behind the surface, where they neither reflect nor sample."""

BUMPS = {"normalmap", "bumpmap"}

FEW = 3
"""Rows of `PAIRS` that may disagree: at a texel's edge, or where a nested horizon or lobe ends."""


def _check(description: Description) -> None:
    mi.set_variant(SCALAR)
    camera = {"type": "perspective", "film": {"type": "hdrfilm", "width": 2, "height": 2}}
    try:
        ball = {"type": "sphere", "id": "ball", "material": description}
        scene = mi.load_dict({"type": "scene", "camera": camera, "ball": ball})
    except RuntimeError:
        event("Mitsuba refuses")
        assume(False)
        return
    try:
        core, exported = core_scene(scene)
    except UnsupportedError as refused:
        event("refused by name")
        message = str(refused)
        assert "\n" not in message
        named = [name for name in plugins(description) if f'"{name}"' in message]
        assert named, message
        # Nothing is refused but foreign plugins and what the message gives a reason for.
        foreign = FOREIGN & plugins(description)
        assert foreign or BUMPS & plugins(description), message
        return
    event("compared")
    assert not FOREIGN & plugins(description)

    rng = np.random.default_rng(61)
    uv = rng.uniform(-1, 2, (PAIRS, 2)).astype(np.float32)
    wi, wo = direction_pairs(rng, PAIRS)
    index = exported.description["shapes"][0]["bsdf"]
    value, pdf = core.bsdf_eval_pdf(index, uv, wi, wo)
    their_value, their_pdf = _theirs(scene.shapes()[0].bsdf(), uv, wi, wo)
    wrong = disagreements(value, their_value, rel=2e-3, floor=1e-4)
    off = disagreements(pdf, their_pdf, rel=2e-3, floor=1e-4)
    if PHANTOM & plugins(description):
        behind = (wi[:, 2] < 0) | (wo[:, 2] < 0) | bool(BUMPS & plugins(description))
        off &= ~(behind & (their_pdf > pdf))
    wrong |= off
    wrong &= np.minimum(np.abs(wi[:, 2]), np.abs(wo[:, 2])) > 0.02
    rows: dict[str, Any] = {"uv": uv, "wi": wi, "wo": wo, "value": value, "theirs": their_value}
    assert np.count_nonzero(wrong) <= FEW, first_rows(wrong, pdf=pdf, their_pdf=their_pdf, **rows)


def _theirs(bsdf: mi.BSDF, uv: F32, wi: F32, wo: F32) -> tuple[F32, F32]:
    """Mitsuba's value (n, 3) and density (n,), one by one, on the surface that the core's own calls assume."""
    context = mi.BSDFContext()
    si = mi.SurfaceInteraction3f()
    axes = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1)
    si.n, si.sh_frame = mi.Normal3f(0, 0, 1), mi.Frame3f(*axes)
    si.dp_du, si.dp_dv = mi.Vector3f(2, 0, 0), mi.Vector3f(0.5, 1.5, 0)
    values, densities = [], []
    for row in zip(uv.tolist(), wi.tolist(), wo.tolist(), strict=True):
        si.uv, si.wi = mi.Point2f(row[0]), mi.Vector3f(row[1])
        value, pdf = bsdf.eval_pdf(context, si, mi.Vector3f(row[2]))
        values.append(np.array(value))
        densities.append(pdf)
    return np.array(values, np.float32), np.array(densities, np.float32)


HOW = {
    "derandomize": True,
    "deadline": None,
    "database": None,
    "suppress_health_check": list(HealthCheck),
}


@settings(max_examples=120, **HOW)
@given(NESTED)
def test_nested_bsdfs_agree_or_are_refused(description: Description) -> None:
    _check(description)


@pytest.mark.long
@pytest.mark.timeout(900)
@settings(max_examples=1000, **HOW)
@given(NESTED)
def test_many_nested_bsdfs_agree_or_are_refused(description: Description) -> None:
    _check(description)
