"""`<integrator type="pssflow">`: in both variants, after changes of the variant, and of the scene as it is now."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from numpy.typing import NDArray

import pssflow
from pssflow.files import first_line
from pssflow.plugins import PLUGINS, register
from tests import scenes

XML = """<scene version="3.0.0">
<integrator type="pssflow">
    <string name="guide" value="realnvp"/><integer name="realnvp_epochs" value="1"/>
    <integer name="k" value="1"/><float name="uniform_fraction" value="0.5"/>
</integrator>
<sensor type="perspective">
    <transform name="to_world"><lookat origin="0, -4, 2" target="0, 0, 0.3" up="0, 0, 1"/></transform>
    <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/></film>
</sensor>
<shape type="rectangle"/>
<emitter type="point"><point name="position" x="0" y="0" z="2"/></emitter>
</scene>"""


def load(name: str = "furnace_sphere", **integrator: Any) -> Any:
    """A small scene with our integrator in it."""
    description = scenes.SCENES[name]()
    return mi.load_dict(
        description | {"integrator": {"type": "pssflow", "guide": "none"} | integrator}
    )


def image(scene: Any, **options: Any) -> NDArray[np.float32]:
    return np.array(mi.render(scene, **options), np.float32)


def test_it_is_the_function_render(variant):
    scene = load(
        guide="realnvp", realnvp_epochs=1, k=3, parametrisation="cosine", uniform_fraction=0.5
    )
    rendered = image(scene, spp=4, seed=3)
    expected = pssflow.render(
        scene,
        "realnvp",
        4,
        seed=3,
        k=3,
        parametrisation="cosine",
        uniform_fraction=0.5,
        epochs=1,
        progress=False,
    )
    np.testing.assert_array_equal(rendered, expected.image)
    result = scene.integrator().result
    assert isinstance(result, pssflow.Result)
    np.testing.assert_array_equal(result.variance, expected.variance)
    assert result.stats["training"]["guide"]["options"]["epochs"] == 1


def test_from_xml(variant, tmp_path):
    (tmp_path / "scene.xml").write_text(XML)
    scene = mi.load_file(str(tmp_path / "scene.xml"))
    rendered = image(scene, spp=4)
    assert rendered.shape == (16, 16, 3)
    assert rendered.mean() > 0
    assert scene.integrator().result.stats["a"] == 0.5
    text = str(scene.integrator())
    assert text.startswith("PssflowIntegrator[")
    assert "epochs = 1" in text


def test_a_saved_guide_lies_beside_the_scene(scalar_variant, tmp_path):
    (tmp_path / "scene.xml").write_text(XML)
    learned = pssflow.render(tmp_path / "scene.xml", "realnvp", 4, k=1, epochs=1, progress=False)
    assert isinstance(learned.guide, pssflow.Guide)
    learned.guide.save(tmp_path / "guide.safetensors")
    ready = XML.replace('"realnvp"', '"guide.safetensors"')
    ready = ready.replace('<integer name="realnvp_epochs" value="1"/>', "")
    (tmp_path / "ready.xml").write_text(ready)
    scene = mi.load_file(str(tmp_path / "ready.xml"))
    image(scene, spp=4)
    stats = scene.integrator().result.stats
    assert stats["chosen"] == "realnvp"
    assert [entry["kind"] for entry in stats["passes"]] == ["guided"]


def test_beside_a_scene_that_has_another_integrator(variant):
    scene = mi.load_dict(scenes.furnace_sphere() | {"integrator": {"type": "path"}})
    integrator: Any = mi.load_dict({"type": "pssflow", "guide": "none"})
    rendered = image(scene, integrator=integrator, spp=2)
    np.testing.assert_array_equal(rendered, integrator.result.image)


def test_it_survives_changes_of_the_variant():
    images = []
    for variant in ("scalar_rgb", "llvm_ad_rgb", "llvm_ad_mono", "scalar_rgb", "llvm_ad_rgb"):
        mi.set_variant(variant)
        if variant == "llvm_ad_mono":
            with pytest.raises(RuntimeError, match='"pssflow" not found'):
                mi.load_dict({"type": "pssflow"})
            continue
        images.append(image(load(), spp=4))
    np.testing.assert_array_equal(images[0], images[2])
    np.testing.assert_array_equal(images[1], images[3])
    np.testing.assert_allclose(images[0].mean(), images[1].mean(), rtol=1e-3)


def test_registering_twice_does_no_harm(scalar_variant):
    register()
    mi.set_variant("llvm_ad_rgb")
    mi.set_variant("scalar_rgb")
    assert load().integrator().result is None
    assert list(PLUGINS) == ["pssflow", "pssflow_kbounce", "pss_guided", "pss_replay"]


# --- whose arguments win ---------------------------------------------------------------------------------------------


def test_arguments_of_render_win(variant):
    scene = load(spp=2, seed=7)
    integrator = scene.integrator()
    own = image(scene)
    assert (integrator.result.stats["seed"], integrator.result.stats["camera_rays"]) == (
        7,
        2 * 32 * 32,
    )
    other = image(scene, seed=8, spp=3)
    assert (integrator.result.stats["seed"], integrator.result.stats["camera_rays"]) == (
        8,
        3 * 32 * 32,
    )
    np.testing.assert_array_equal(image(scene, seed=7, spp=2), own)
    assert (other != own).any()


def test_samples_come_from_the_sampler_by_default(variant):
    scene = load()
    image(scene)
    assert scene.integrator().result.stats["camera_rays"] == 16 * 32 * 32
    scene = load(guide="realnvp", realnvp_epochs=1, preset="thesis")
    image(scene)
    assert [entry["spp"] for entry in scene.integrator().result.stats["passes"]] == [16, 16]


def test_time_gives_way_to_spp(scalar_variant):
    scene = load(time=0.1)
    image(scene)
    assert scene.integrator().result.stats["budget"] == "0.1 s"
    image(scene, spp=2)
    assert scene.integrator().result.stats["budget"] == "2 spp"


def test_the_sensor_is_the_one_that_is_asked_for(variant):
    description = scenes.furnace_sphere()
    other = description["camera"] | {
        "fov": 30,
        "film": description["camera"]["film"] | {"width": 24},
    }
    description |= {"other": other, "integrator": {"type": "pssflow", "guide": "none"}}
    scene = mi.load_dict(description)
    shapes = []
    for index in range(2):
        rendered = image(scene, sensor=index, spp=2)
        assert rendered.shape == image(scene, sensor=scene.sensors()[index], spp=2).shape
        np.testing.assert_array_equal(
            rendered, pssflow.render(scene, "none", 2, sensor=index, progress=False).image
        )
        shapes.append(rendered.shape)
    assert sorted(shapes) == [(32, 24, 3), (32, 32, 3)]


def test_without_developing_the_film_holds_the_image(variant):
    scene = load()
    film = scene.sensors()[0].film()
    expected = image(scene, spp=2)
    film.clear()
    empty = scene.integrator().render(scene, sensor=0, seed=0, spp=2, develop=False)
    assert np.array(empty).size == 0
    np.testing.assert_array_equal(np.array(film.develop()), expected)
    np.testing.assert_array_equal(np.array(film.bitmap()), expected)


@pytest.mark.parametrize(
    ("pixel_format", "channels"),
    [("luminance", 1), ("luminance_alpha", 2), ("rgba", 4), ("xyz", 3)],
)
def test_pixel_formats(variant, pixel_format, channels):
    description = scenes.glossy_room()
    description["camera"]["film"]["pixel_format"] = pixel_format
    description["integrator"] = {"type": "pssflow", "guide": "none"}
    scene = mi.load_dict(description)
    rendered = image(scene, spp=2)
    truth = scene.integrator().result.image
    assert rendered.shape == (32, 48, channels)
    if channels in (2, 4):
        assert (rendered[..., -1] == 1).all()
    if pixel_format == "rgba":
        np.testing.assert_array_equal(rendered[..., :3], truth)
    if pixel_format == "luminance":
        weights = np.array([0.212671, 0.715160, 0.072169])
        np.testing.assert_allclose(rendered[..., 0], truth @ weights, rtol=1e-4, atol=1e-6)


# --- a scene as it is now --------------------------------------------------------------------------------------------


def turned(degrees: float) -> Any:
    T = mi.ScalarTransform4f
    return T().rotate([0, 0, 1], degrees) @ T().look_at(
        origin=[0.2, -1.8, 0.1], target=[0, 0, -0.3], up=[0, 0, 1]
    )


EDITS: dict[str, tuple[str, Any, Any]] = {
    "colour": ("ball.bsdf.nested_bsdf.reflectance.value", lambda _: [0.9, 0.1, 0.1], "ball"),
    "emitter": ("lamp.emitter.radiance.value", lambda _: [1.0, 9.0, 2.0], "lamp"),
    "vertex": ("room.vertex_positions", lambda old: np.array(old) * np.float32(0.9), "room"),
    "camera": ("camera.to_world", lambda _: turned(20), "camera"),
}


@pytest.mark.parametrize("edit", EDITS)
def test_an_edited_scene_renders_its_new_state(variant, edit):
    """The image changes, and is that of a scene that was loaded with the new value."""
    # Mitsuba merges objects that are alike on loading, and then knows them by other names.
    description: dict[str, Any] = scenes.furnace_sphere()
    description["integrator"] = {"type": "pssflow", "guide": "none"}
    scene = mi.load_dict(description, optimize=False)
    before = image(scene, spp=8)

    parameters = mi.traverse(scene)
    suffix, value, owner = EDITS[edit]
    (key,) = (key for key in parameters.keys() if _matches(key, suffix))  # noqa: SIM118
    parameters[key] = value(parameters[key])
    parameters.update()
    after = image(scene, spp=8)

    if edit == "colour":
        description[owner]["bsdf"]["bsdf"]["reflectance"]["value"] = [0.9, 0.1, 0.1]
    elif edit == "emitter":
        description[owner]["light"]["radiance"]["value"] = [1.0, 9.0, 2.0]
    elif edit == "vertex":
        description[owner]["to_world"] = mi.ScalarTransform4f().scale(1.8)
    else:
        description[owner]["to_world"] = turned(20)
    expected = image(mi.load_dict(description, optimize=False), spp=8)
    assert np.abs(after - before).mean() > 0.02 * before.mean()
    # A few paths may go another way where a coordinate differs in its last bit.
    assert np.mean(~np.isclose(after, expected, rtol=1e-3, atol=1e-6)) < 0.01


def _matches(key: str, suffix: str) -> bool:
    """Whether a traversed key is the one meant: plugins between the named ones are skipped."""
    names, wanted = key.split("."), suffix.split(".")
    return (
        names[0] == wanted[0]
        and names[-1] == wanted[-1]
        and (len(wanted) < 3 or wanted[-2] in names)
    )


# --- what is refused -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"bounces": 3},
            r'unreferenced property in integrator plugin of type "pssflow":\s+- integer "bounces"',
        ),
        ({"guide": "none", "realnvp_epochs": 3}, '"realnvp_epochs"'),
        ({"guide": "realnvp", "realnvp_epoch": 3}, '"realnvp_epoch"'),
        ({"k": 0}, "`k` = 0: expected an integer between 1 and 32"),
        ({"guide": "vegasse"}, "`guide` = 'vegasse' is unknown"),
        ({"parametrisation": "sphere"}, "`parametrisation` = 'sphere' is unknown"),
        ({"uniform_fraction": 2.0}, "`uniform_fraction` = 2.0"),
        ({"spp": 4, "time": 1.0}, "`spp` = 4 and `time` = 1.0 were both given"),
        ({"preset": "paper"}, "`preset` = 'paper'"),
    ],
)
def test_wrong_properties_are_found_on_loading(scalar_variant, options, message):
    with pytest.raises(RuntimeError, match=message) as caught:
        load(**options)
    line = first_line(caught.value)
    assert "\n" not in line
    assert "Traceback" not in line


def test_unsupported_scenes_are_refused_when_rendered(variant):
    description = scenes.furnace_sphere() | {"integrator": {"type": "pssflow", "guide": "none"}}
    description["fog"] = {"type": "sphere", "bsdf": {"type": "polarizer"}}
    # In JIT variants Dr.Jit wraps the error; ours is its cause.
    with pytest.raises((pssflow.UnsupportedError, RuntimeError)) as caught:
        mi.render(mi.load_dict(description), spp=1)
    assert 'BSDF "polarizer"' in first_line(caught.value)


def test_nothing_is_printed(scalar_variant, capfd):
    """Mitsuba warns of integrators in Python in scalar variants; that is beside the point here."""
    before = mi.log_level()
    mi.set_log_level(mi.LogLevel.Warn)  # the command sets another one
    try:
        image(load(), spp=1)
        assert capfd.readouterr() == ("", "")
        assert mi.log_level() == mi.LogLevel.Warn
    finally:
        mi.set_log_level(before)
