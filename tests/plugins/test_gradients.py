"""Gradients of `<integrator type="pssflow">`: how they are made, and what is refused. Values: `tests/statistical`."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import pssflow
from pssflow import gradients
from tests import scenes
from tests.support.named import load_named

ALBEDO = "room.bsdf.brdf_0.reflectance.value"


def _drawn(ours: pssflow.Scene, guide: Any, a: float, k: int, spp: int = 2) -> dict[str, Any]:
    return ours.core.draw(
        guide,
        uniform_fraction=a,
        first_sample=0,
        spp=spp,
        k=k,
        parametrisation="bsdf",
        emitter_strategy="mis",
        seed=1,
    )


@pytest.mark.parametrize(
    ("name", "k"),
    [
        ("glossy_room", 2),
        ("glass_room", 3),
        ("furnace_sphere", 2),
        *(
            pytest.param(name, k, marks=pytest.mark.long)
            for name in ("carved_room", "open_sky", "sun_and_sky", "cornell-box")
            for k in (1, 2, 3)
        ),
    ],
)
def test_paths_are_built_anew(name, k, llvm_variant):
    """Each path's f ÷ m in Dr.Jit is the core's, but for one in a thousand that grazes an edge."""
    scene = load_named(name)
    ours = pssflow.Scene(scene)
    guide = None
    if k > 1:
        guide = pssflow.render(ours, "direction-table", 8, k=k, progress=False).guide
    core = guide.core if isinstance(guide, pssflow.Guide) else None
    drawn = _drawn(ours, core, 0.25 if core else 1.0, k)
    emitters = mi.UInt32(ours.exported.emitter_order)
    value, _ = gradients.radiance(scene, scene.sensors()[0], drawn, k, emitters)
    found = np.array(value).reshape(3, -1).T
    expected = drawn["f_nee"] / drawn["m_nee"][:, None] + drawn["f_bsdf"] / drawn["m_bsdf"][:, None]
    off = np.abs(found - expected).max(axis=1)
    wrong = off > 1e-2 * expected.max(axis=1) + 1e-4 * expected.mean()
    assert wrong.mean() < 1e-3
    if core is not None:
        assert np.ptp(drawn["m_nee"]) > 0.1


def _image(scene: Any, params: Any, integrator: Any, spp: int = 4) -> Any:
    return mi.render(scene, params, integrator=integrator, seed_grad=99, spp=spp, spp_grad=spp)


def _room() -> tuple[Any, Any]:
    scene = mi.load_dict(scenes.furnace_sphere())
    params = mi.traverse(scene)
    dr.enable_grad(params[ALBEDO])
    return scene, params


def test_forward_and_backward_agree(llvm_variant):
    """The same paths, one way and the other: the image's derivative, summed, is the gradient of its sum."""
    integrator: Any = mi.load_dict({"type": "pssflow", "max_depth": 3, "guide": "table"})
    scene, params = _room()
    dr.backward(dr.sum(_image(scene, params, integrator), axis=None))
    gradient = np.array(dr.grad(params[ALBEDO])).sum()
    scene, params = _room()
    image = _image(scene, params, integrator)
    dr.set_grad(params[ALBEDO], 1.0)
    dr.enqueue(dr.ADMode.Forward, params[ALBEDO])
    dr.traverse(dr.ADMode.Forward)
    derivative = np.array(dr.grad(image))
    assert derivative.shape == (32, 32, 3)
    assert gradient > 0
    np.testing.assert_allclose(derivative.sum(), gradient, rtol=1e-4)


def test_passes_add_up(llvm_variant, monkeypatch):
    """Memory is bounded by passes of a few paths; with the box filter how many does not matter."""
    integrator: Any = mi.load_dict({"type": "pssflow", "k": 2, "guide": "none"})
    found = []
    for most in (1 << 17, 1024):
        monkeypatch.setattr(gradients, "MOST_AT_ONCE", most)
        scene, params = _room()
        dr.backward(dr.sum(_image(scene, params, integrator), axis=None))
        found.append(np.array(dr.grad(params[ALBEDO])))
    np.testing.assert_allclose(*found, rtol=1e-4)


def test_passes_add_up_forward(llvm_variant, monkeypatch):
    """Also over several lengths, of which emission does not depend on the parameter."""
    integrator: Any = mi.load_dict({"type": "pssflow", "max_depth": 3, "guide": "none"})
    found = []
    for most in (1 << 17, 1024):
        monkeypatch.setattr(gradients, "MOST_AT_ONCE", most)
        scene, params = _room()
        image = _image(scene, params, integrator)
        dr.set_grad(params[ALBEDO], 1.0)
        dr.enqueue(dr.ADMode.Forward, params[ALBEDO])
        dr.traverse(dr.ADMode.Forward)
        found.append(np.array(dr.grad(image)))
    assert found[0].sum() > 0
    np.testing.assert_allclose(*found, rtol=1e-3, atol=1e-6 * found[0].max())


@pytest.mark.parametrize(
    ("parameter", "message"),
    [
        ("room.vertex_positions", "parameter `room.vertex_positions` moves geometry"),
        ("ball.to_world", "parameter `ball.to_world` moves geometry"),
    ],
)
def test_what_moves_geometry_is_refused(parameter, message, llvm_variant):
    scene = mi.load_dict(scenes.furnace_sphere())
    params = mi.traverse(scene)
    dr.enable_grad(params[parameter])
    integrator: Any = mi.load_dict({"type": "pssflow", "guide": "none"})
    with pytest.raises(ValueError, match=message) as caught:
        integrator.render_backward(scene, params, None)
    assert "\n" not in str(caught.value)


def test_what_else_is_refused(llvm_variant):
    integrator: Any = mi.load_dict({"type": "pssflow", "guide": "none"})
    glass = mi.load_dict(scenes.glass_room())
    params = mi.traverse(glass)
    name = next(key for key in params.keys() if "specular_" in key)  # noqa: SIM118
    dr.enable_grad(params[name])
    with pytest.raises(ValueError, match="may belong to a delta lobe"):
        integrator.render_backward(glass, params, None)
    scene, params = _room()
    hidden: Any = mi.load_dict({"type": "pssflow", "guide": "none", "hide_emitters": True})
    with pytest.raises((ValueError, RuntimeError), match="`hide_emitters`"):
        dr.backward(dr.sum(_image(scene, params, hidden), axis=None))
    bold: Any = mi.load_dict(
        {"type": "pssflow", "guide": "realnvp", "realnvp_epochs": 1, "uniform_fraction": 0.0}
    )
    with pytest.raises((ValueError, RuntimeError), match="uniform_fraction above 0"):
        dr.backward(dr.sum(_image(scene, params, bold), axis=None))


def test_scalar_variants_have_none(scalar_variant):
    integrator: Any = mi.load_dict({"type": "pssflow", "guide": "none"})
    with pytest.raises(NotImplementedError, match="scalar variants have no derivatives"):
        integrator.render_backward(None, None, None)
