"""Mitsuba's truth: cancellation, variance over passes, cache, resumption, and what ends it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import pssflow
from pssflow import _core, passes
from pssflow import reference as module
from pssflow.reference import Reference, default_cache, read_exr, reference
from tests import scenes
from tests.support.runs import truth_runs


@pytest.fixture(autouse=True)
def _small_passes(monkeypatch):
    """Eight samples a pixel and pass: quick, and enough passes for a variance."""
    monkeypatch.setattr(module, "PATHS_PER_PASS", 8 * 32 * 32)


def render(cache: Any, **options: Any) -> Reference:
    """The furnace at k = 2, quietly."""
    options = {"seconds": 0.0, "progress": False, "cache": cache} | options
    return reference(mi.load_dict(scenes.furnace_sphere()), **options)


def test_a_reference_is_the_mean_over_passes(llvm_variant, tmp_path):
    """Of the difference, and of the k-bounce path tracer that takes its place; no file of one serves the other."""
    shorter = render(tmp_path)
    assert shorter.note.startswith("Mitsuba path, k bounces only, llvm_ad_rgb")
    hidden = scenes.furnace_sphere() | {"integrator": {"type": "path", "hide_emitters": True}}
    found = reference(mi.load_dict(hidden), seconds=0.0, progress=False, cache=tmp_path)
    assert found.note.startswith("difference of two Mitsuba path, llvm_ad_rgb")
    assert found.path != shorter.path
    scene = mi.load_dict(scenes.furnace_sphere())
    integrator: Any = mi.load_dict({"type": "pssflow_kbounce"})
    images = [np.array(integrator.render(scene, seed=s, spp=8)) for s in range(4)]
    np.testing.assert_allclose(shorter.image, np.mean(images, 0)[..., :3], atol=1e-5)
    assert found.passes == module.LEAST_PASSES
    assert found.spp == 8 * found.passes
    assert found.image.shape == found.variance.shape == (32, 32, 3)
    assert found.image.dtype == found.variance.dtype == np.float32

    scene = mi.load_dict(hidden)
    images = truth_runs(scene, k=2, seeds=range(found.passes), spp=8).astype(np.float64)
    np.testing.assert_allclose(found.image, np.mean(images, 0), atol=1e-5)
    np.testing.assert_allclose(
        found.variance, np.var(images, 0, ddof=1) / found.passes, rtol=1e-2, atol=1e-6
    )


def test_light_that_both_depths_see_cancels(llvm_variant, tmp_path):
    """The lamp is a thousand times brighter than what its light leaves after two bounces; no pixel shows it."""
    found = render(tmp_path)
    assert found.image.min() >= 0
    assert found.image.max() < 0.5


@pytest.mark.parametrize("pixel_format", ["luminance", "rgba", "xyz"])
def test_the_films_format_does_not_matter(llvm_variant, tmp_path, pixel_format):
    description = scenes.furnace_sphere()
    plain = reference(description, seconds=0, progress=False, cache=False)
    description["camera"]["film"]["pixel_format"] = pixel_format
    found = reference(description, seconds=0, progress=False, cache=False)
    np.testing.assert_allclose(found.image, plain.image, atol=1e-5)
    assert found.path is None


def test_it_agrees_with_our_own_image(variant, tmp_path):
    """The image means differ by less than five standard errors of both."""
    scene = pssflow.Scene(scenes.furnace_sphere())
    found = reference(scene, target_se=0.2, seconds=2.0, progress=False, cache=tmp_path)
    ours = scene.render("none", 64, progress=False)
    difference = found.image.mean(dtype=float) - ours.image.mean(dtype=float)
    # A box filter: pixels are independent. Scalar truths have a heavy tail where the lamp is seen.
    error = np.sqrt((found.variance.sum() + ours.variance.sum()) * 3) / found.image.size
    assert abs(difference) < 5 * error
    assert scene.variant in found.note


def test_a_second_call_renders_nothing(llvm_variant, tmp_path, monkeypatch):
    first = render(tmp_path)
    monkeypatch.setattr(passes.Pass, "__call__", None)
    second = render(tmp_path)
    assert (second.passes, second.seconds) == (first.passes, first.seconds)
    np.testing.assert_array_equal(second.image, first.image)
    np.testing.assert_array_equal(second.variance, first.variance)
    assert "4 of 4 passes from the cache" in second.note
    assert list(tmp_path.iterdir()) == [second.path]


def test_it_is_resumed(llvm_variant, tmp_path):
    """Four passes and then more are what as many at once are: the seeds go on."""
    first = render(tmp_path)
    more = render(tmp_path, seconds=None, target_se=0.8 * first.standard_error)
    assert more.reached
    assert more.passes > first.passes
    at_once = render(tmp_path / "other", seconds=None, target_se=0.8 * first.standard_error)
    assert at_once.passes == more.passes
    np.testing.assert_allclose(more.image, at_once.image, atol=1e-6)
    assert more.standard_error <= 0.8 * first.standard_error


def test_time_ends_it(llvm_variant, tmp_path):
    found = render(tmp_path, seconds=0.2, target_se=1e-6)
    assert not found.reached
    assert "out of time after 0.2 s" in found.note
    assert "1e-06 was asked for" in found.note
    assert found.describe()["reached"] is False


def test_what_changes_the_image_changes_the_file(llvm_variant, tmp_path):
    scene = mi.load_dict(scenes.furnace_sphere())
    first = reference(scene, seconds=0, progress=False, cache=tmp_path)
    deeper = reference(scene, 1, seconds=0, progress=False, cache=tmp_path)
    other_seed = reference(scene, seed0=100, seconds=0, progress=False, cache=tmp_path)
    parameters = mi.traverse(scene)
    key = next(key for key in parameters.keys() if key.endswith("radiance.value"))  # noqa: SIM118
    parameters[key] = [50.0, 45.0, 40.0]
    parameters.update()
    edited = reference(scene, seconds=0, progress=False, cache=tmp_path)
    assert len({found.path for found in (first, deeper, other_seed, edited)}) == 4
    assert edited.image.mean() == pytest.approx(10 * first.image.mean(), rel=0.01)


def test_the_scene_is_left_as_it_was(variant, tmp_path):
    scene = mi.load_dict(scenes.furnace_sphere())
    reference(scene, seconds=0, progress=False, cache=tmp_path)
    assert scene.sensors()[0].sampler().sample_count() == 16


def test_a_damaged_file_is_rendered_anew(llvm_variant, tmp_path):
    path = render(tmp_path).path
    assert path is not None
    path.write_bytes(path.read_bytes()[:1000])
    again = render(tmp_path)
    assert "was damaged" in again.note
    assert again.passes == module.LEAST_PASSES


def test_ctrl_c_keeps_finished_passes(llvm_variant, tmp_path):
    def stop(_phase: str, _done: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render(tmp_path, seconds=60.0, progress=stop)
    (file,) = tmp_path.iterdir()
    assert render(tmp_path).passes == module.LEAST_PASSES
    assert file.suffix == ".npz"


def test_progress_is_reported(llvm_variant):
    told = []
    render(False, seconds=0.5, progress=lambda phase, done: told.append((phase, done)))
    assert {phase for phase, _ in told} == {"reference"}
    assert all(0 <= done < 1 for _, done in told)


def test_an_exr_goes_around(llvm_variant, tmp_path):
    found = render(False)
    found.write(tmp_path / "truth.exr")
    read = read_exr(tmp_path / "truth.exr")
    np.testing.assert_array_equal(read.image, found.image)
    np.testing.assert_array_equal(read.variance, found.variance)
    pixels = found.image[:, :, :1]
    mi.Bitmap(np.ascontiguousarray(pixels)).write(str(tmp_path / "grey.exr"))
    grey = read_exr(tmp_path / "grey.exr")
    np.testing.assert_array_equal(grey.image, np.repeat(pixels, 3, axis=2))
    assert not grey.variance.any()
    assert grey.describe()["standard_error"] is None


ONE_CORE = """
import os, sys
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
import mitsuba as mi
mi.set_variant("scalar_rgb")
import numpy as np
from pssflow import _core, passes
from pssflow.reference import read_exr
image = np.arange(60, dtype=np.float32).reshape(4, 5, 3)
_core.write_exr(sys.argv[1], {"": image, "variance": image + 1})
read = read_exr(sys.argv[1])
assert np.array_equal(read.image, image) and np.array_equal(read.variance, image + 1)
"""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores cannot be taken away here")
def test_an_exr_is_read_where_one_core_is_usable(tmp_path):
    """Mitsuba's own reader never returns there."""
    command = [sys.executable, "-c", ONE_CORE, str(tmp_path / "truth.exr")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr


def test_layers_of_an_exr_of_ours_are_mitsubas(llvm_variant, tmp_path):
    """Channel by channel; what ours does not know, as a grey image, is left to Mitsuba."""
    rng = np.random.default_rng(1)
    image, variance = rng.random((2, 5, 7, 3), np.float32)
    path = tmp_path / "image.exr"
    Reference(image, variance, 1, 1, 0.0, "").write(path)
    read = _core.read_exr(str(path))
    assert sorted(read) == sorted([*"RGB", *(f"variance.{c}" for c in "RGB")])
    for name, layer in mi.Bitmap(str(path)).split():
        prefix = "" if name == "<root>" else f"{name}."
        for i, c in enumerate("RGB"):
            np.testing.assert_array_equal(read[prefix + c], np.array(layer)[:, :, i])
    with pytest.raises(ValueError, match=r"cannot read .*none\.exr"):
        _core.read_exr(str(tmp_path / "none.exr"))


def test_bad_files(llvm_variant, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.exr: there is no such file"):
        read_exr(tmp_path / "none.exr")
    (tmp_path / "text.exr").write_text("no image")
    with pytest.raises(ValueError, match=r"text\.exr: cannot be read as an image") as caught:
        read_exr(tmp_path / "text.exr")
    assert "\n" not in str(caught.value)
    mi.Bitmap(np.full((2, 2, 3), np.nan, np.float32)).write(str(tmp_path / "nan.exr"))
    with pytest.raises(ValueError, match=r"nan\.exr: 12 values of its image are not finite"):
        read_exr(tmp_path / "nan.exr")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"k": 0}, "`k` = 0"),
        ({"seconds": -1.0}, "`seconds` = -1.0"),
        ({"seconds": None}, "both None"),
        ({"target_se": 0.0}, "`target_se` = 0.0"),
        ({"seed0": -1}, "`seed0` = -1"),
        ({"sensor": 3}, "`sensor` = 3"),
    ],
)
def test_bad_arguments(llvm_variant, options, message):
    with pytest.raises(ValueError, match=message):
        render(False, **options)


def test_a_folder_that_cannot_be_written(llvm_variant, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="references cannot be kept there"):
        render(tmp_path / "file" / "folder")


def test_the_default_folder(monkeypatch, llvm_variant, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_cache() == tmp_path / "pssflow" / "references"
    kept = render(None).path
    assert kept is not None
    assert kept.parent == default_cache()
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert default_cache() == Path.home() / ".cache" / "pssflow" / "references"
    # Where the default cannot be written, the work goes on.
    (tmp_path / "blocked").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "blocked"))
    found = render(None)
    assert found.path is None
    assert "not cached" in found.note
