"""Gradients of `<integrator type="pssflow">`: how they are made, and what is refused. Values: `tests/statistical`."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import pssflow
from pssflow import gradient_guides, gradients, rebuild
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
    value, _ = rebuild.radiance(scene, scene.sensors()[0], drawn, k, emitters)
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


def _of_grey(integrator: Any, compute: Any = None) -> tuple[float, float]:
    """Derivative of the image's sum by an albedo of 0.36 grey, backward and forward.

    `compute` is the value of another variable, the albedo's derivative by it, and the albedo as a function of it; None
    for the three components of the parameter itself.
    """

    def prepared() -> tuple[Any, Any, float]:
        scene = mi.load_dict(scenes.furnace_sphere())
        params = mi.traverse(scene)
        start, slope, albedo = compute or (0.36, 1.0, None)
        leaf = mi.Float(start) if albedo else mi.Color3f(start)
        dr.enable_grad(leaf)
        params[ALBEDO] = mi.Color3f(albedo(leaf)) if albedo else leaf
        params.update()
        return _image(scene, params, integrator, 16), leaf, slope

    image, leaf, slope = prepared()
    dr.backward(dr.sum(image, axis=None))
    backward = np.array(dr.grad(leaf)).sum() / slope
    image, leaf, slope = prepared()
    dr.set_grad(leaf, 1.0 / slope)
    dr.enqueue(dr.ADMode.Forward, leaf)
    dr.traverse(dr.ADMode.Forward)
    return float(backward), float(np.array(dr.grad(image)).sum())


@pytest.mark.parametrize("target", ["radiance", "gradient"])
@pytest.mark.parametrize(
    "compute",
    [(0.36, 1.0, lambda x: x), (0.4, 0.8, lambda x: x * x + 0.2)],
    ids=["grey of one number", "of a square"],
)
def test_parameters_may_be_computed(compute, target, llvm_variant, monkeypatch):
    """A parameter that is made from another variable has that one's derivative, over several lengths and passes.

    Guides of the gradient learn backward along random directions, of which there are fewer where components share a
    variable: other paths, and so noise, of which 16 samples of each of 1,024 pixels leave some 1 %.
    """
    monkeypatch.setattr(gradients, "MOST_AT_ONCE", 4096)
    options = {"type": "pssflow", "max_depth": 3, "guide": "table", "target": target}
    integrator: Any = mi.load_dict(options)
    backward, forward = _of_grey(integrator)
    of_another = _of_grey(integrator, compute)
    assert forward > 0.0
    np.testing.assert_allclose(of_another[1], forward, rtol=1e-4)
    np.testing.assert_allclose(of_another[0], backward, rtol=1e-4 if target == "radiance" else 0.05)


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


def _with_maps() -> Any:
    """A room with a bump map, a normal map, and a sky whose `scale` bends nothing."""
    values = np.random.default_rng(0).random((4, 4, 3), np.float32)

    def bitmap(channels: int) -> dict[str, Any]:
        data = mi.Bitmap(np.ascontiguousarray(values[..., :channels]))
        return {"type": "bitmap", "raw": True, "bitmap": data}

    inner = {"type": "diffuse"}
    bump = {"type": "bumpmap", "arbitrary": bitmap(1), "bsdf": inner}
    normal = {"type": "normalmap", "normalmap": bitmap(3), "bsdf": inner}
    return mi.load_dict(
        scenes.furnace_sphere()
        | {
            "bumpy": {
                "type": "sphere",
                "radius": 0.1,
                "bsdf": {"type": "twosided", "nested": bump},
            },
            "bent": {"type": "sphere", "radius": 0.1, "bsdf": normal},
            "sky": {"type": "envmap", "bitmap": mi.Bitmap(values)},
        }
    )


@pytest.mark.parametrize(
    "parameter",
    ["bumpy.bsdf.brdf_0.nested_texture.data", "bent.bsdf.normalmap.data"],
)
def test_what_bends_normals_is_refused(parameter, llvm_variant):
    scene = _with_maps()
    params = mi.traverse(scene)
    dr.enable_grad(params[parameter])
    with pytest.raises(ValueError, match=f"`{parameter}` bends shading normals"):
        gradients.check_parameters(scene, params)
    dr.disable_grad(params[parameter])
    for other in ("bumpy.bsdf.brdf_0.nested_bsdf.reflectance.value", "sky.scale"):
        dr.enable_grad(params[other])
    gradients.check_parameters(scene, params)


def test_delta_lobes_of_instances_are_refused(llvm_variant):
    mirror = {"type": "sphere", "radius": 0.1, "bsdf": {"type": "conductor"}}
    view = scenes.furnace_sphere() | {
        "group": {"type": "shapegroup", "ball": mirror},
        "seen": {"type": "instance", "group": {"type": "ref", "id": "group"}},
    }
    scene = mi.load_dict(view)
    params = mi.traverse(scene)
    dr.enable_grad(params["group.ball.bsdf.specular_reflectance.value"])
    with pytest.raises(ValueError, match="may belong to a delta lobe"):
        gradients.check_parameters(scene, params)


def test_what_was_replaced_is_refused(llvm_variant):
    """The core traces what stands in its place, Mitsuba would differentiate the thing itself."""
    view = scenes.furnace_sphere() | {
        "odd": {"type": "sphere", "radius": 0.1, "bsdf": {"type": "polarizer"}}
    }
    bold: Any = mi.load_dict({"type": "pssflow", "guide": "none", "approximate": True})
    for description, replaces in ((view, True), (scenes.furnace_sphere(), False)):
        scene = mi.load_dict(description)
        params = mi.traverse(scene)
        dr.enable_grad(params[ALBEDO])
        if not replaces:
            dr.backward(dr.sum(_image(scene, params, bold), axis=None))
            assert np.array(dr.grad(params[ALBEDO])).sum() > 0
            continue
        with pytest.raises((ValueError, RuntimeError), match="`approximate` replaced something"):
            dr.backward(dr.sum(_image(scene, params, bold), axis=None))


def test_guides_are_those_of_the_scene(llvm_variant):
    """After another scene, or an edit, what is differentiated is rendered anew; else it is not."""
    integrator: Any = mi.load_dict({"type": "pssflow", "guide": "direction-table"})
    scene, params = _room()
    ones = mi.TensorXf(np.ones((32, 32, 3), np.float32))
    integrator.render(scene, spp=4)
    first = integrator.result
    integrator.render_backward(scene, params, ones, spp=4)
    assert integrator.result is first
    dr.disable_grad(params[ALBEDO])
    params[ALBEDO] = mi.Color3f(0.3)
    params.update()
    dr.enable_grad(params[ALBEDO])
    integrator.render_backward(scene, params, ones, spp=4)
    assert integrator.result is not first


def test_scalar_variants_have_none(scalar_variant):
    integrator: Any = mi.load_dict({"type": "pssflow", "guide": "none"})
    with pytest.raises(NotImplementedError, match="scalar variants have no derivatives"):
        integrator.render_backward(None, None, None)
    with pytest.raises(RuntimeError, match=r"`target` = 'gradient': .* scalar variants have no"):
        mi.load_dict({"type": "pssflow", "target": "gradient"})


class _Signs:
    """In place of a random generator: the components of directions one after another."""

    def __init__(self, directions: Any) -> None:
        self.components = np.ravel(directions).astype(np.float32)

    def choice(self, _values: Any, size: int) -> Any:
        drawn, self.components = np.split(self.components, [size])
        return drawn


def test_a_path_weighs_its_gradients_length(llvm_variant):
    """Over all directions of signs the mean square of a weight is the sum of the squares by each component.

    The gradients that parameters have already stay what they are.
    """
    scene, params = _room()
    ours = pssflow.Scene(scene)
    drawn = _drawn(ours, None, 1.0, 2)
    emitters = mi.UInt32(ours.exported.emitter_order)
    dr.set_grad(params[ALBEDO], mi.Color3f(5.0, 6.0, 7.0))
    signs = [(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]
    of_loss = np.random.default_rng(1).normal(size=(len(drawn["film"]), 3)).astype(np.float32)
    numbers = drawn | {"u": drawn["film"]}

    def weight(rng: Any) -> Any:
        found = gradient_guides._derivatives(
            scene, scene.sensors()[0], numbers, 2, emitters, params, True, rng
        )
        return [gradient_guides._magnitude(d, of_loss).astype(np.float64) for d in found]

    for term in range(2):
        rng = _Signs([*signs, *np.eye(3)])
        mean = np.mean([weight(rng)[term] ** 2 for _ in signs], axis=0)
        length = np.sum([weight(rng)[term] ** 2 for _ in range(3)], axis=0)
        assert length.max() > 0.0
        np.testing.assert_allclose(mean, length, rtol=1e-3, atol=1e-6 * length.max())
    np.testing.assert_array_equal(np.array(dr.grad(params[ALBEDO])).ravel(), [5.0, 6.0, 7.0])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"guide": "none"},
            "`target` = 'gradient' needs a guide that learns, but `guide` is 'none'",
        ),
        ({"guide": "auto", "target": "light"}, "`target` = 'light' is unknown"),
    ],
)
def test_targets_that_make_no_sense_are_refused(options, message, llvm_variant):
    with pytest.raises(RuntimeError, match=message):
        mi.load_dict({"type": "pssflow", "target": "gradient", **options})


def test_a_guide_of_the_gradient_needs_parameters_and_samples(llvm_variant):
    integrator: Any = mi.load_dict({"type": "pssflow", "guide": "auto", "target": "gradient"})
    scene, params = _room()
    ones = mi.TensorXf(np.ones((32, 32, 3), np.float32))
    with pytest.raises(ValueError, match="needs the parameters"):
        integrator.render_backward(scene, None, ones, spp=4)
    with pytest.raises(ValueError, match="spp_grad = 1 leaves no sample after the pilot"):
        integrator.render_backward(scene, params, ones, spp=1)


def test_a_guide_of_the_gradient_is_learned_in_either_mode(llvm_variant):
    """Forward and backward draw from guides of their own; along one parameter both come to the same, noise aside."""
    integrator: Any = mi.load_dict(
        {"type": "pssflow", "max_depth": 3, "guide": "table", "target": "gradient"}
    )
    scene, params = _room()
    dr.backward(dr.sum(_image(scene, params, integrator, 16), axis=None))
    gradient = np.array(dr.grad(params[ALBEDO])).sum()
    scene, params = _room()
    image = _image(scene, params, integrator, 16)
    dr.set_grad(params[ALBEDO], 1.0)
    dr.enqueue(dr.ADMode.Forward, params[ALBEDO])
    dr.traverse(dr.ADMode.Forward)
    derivative = np.array(dr.grad(image)).sum()
    assert gradient != derivative
    assert abs(gradient - derivative) < 0.1 * gradient
