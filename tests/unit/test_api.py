"""The Python API: `render`, `Scene`, `Guide`, guides of another make, and what they say about wrong arguments."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import pssflow
from pssflow import guide as guides
from pssflow.export import export
from pssflow.options import PRESETS, Plan, read_replay
from pssflow.reference import reference
from tests import scenes

CORNELL = Path(__file__).parents[2] / "scenes" / "cornell-box" / "scene.xml"

COUNTS = {"camera_rays", "paths_found", "nonzero", "nonzero_share", "outside"}
RUN = COUNTS | {
    "scene", "guide", "chosen", "a", "k", "parametrisation", "emitter_strategy", "seed", "threads", "pilot", "mean",
    "variance", "relmse", "relmse_trimmed", "max_weight", "max_contribution", "ess", "diagnostics", "passes", "notes",
    "training", "seconds", "budget", "version", "variant",
}  # fmt: skip
"""Names of a run's JSON object that others rely on."""


class Box:
    """The example of `pssflow.guide`: uniform on the box of what carried light."""

    def fit(self, u, f, g, zeros, seed):
        assert u.dtype == f.dtype == g.dtype == np.float32
        assert u.ndim == 2
        assert f.shape == g.shape == (len(u),)
        assert (f > 0).all()
        assert (g == 1).all()
        self.zeros, self.seed = zeros, seed
        self.low, self.high = u.min(axis=0), u.max(axis=0)

    def sample(self, n, seed):
        u = np.random.default_rng(seed).uniform(self.low, self.high, (n, len(self.low)))
        u = np.clip(u.astype(np.float32), self.low, self.high)
        return u, self.log_prob(u)

    def log_prob(self, u):
        inside = ((u >= self.low) & (u <= self.high)).all(axis=1)
        volume = -np.log(self.high - self.low).sum()
        return np.where(inside, volume, -np.inf).astype(np.float32)


@pytest.fixture
def furnace(scalar_variant) -> pssflow.Scene:
    return pssflow.Scene(scenes.furnace_sphere())


def quick(scene: Any, guide: Any = "none", spp: int | None = 4, **options: Any) -> pssflow.Result:
    return pssflow.render(scene, guide, spp, progress=False, **options)


# --- import ----------------------------------------------------------------------------------------------------------


def run_python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True
    )


def test_import_sets_no_variant_and_prints_nothing():
    done = run_python(
        "import pssflow, mitsuba as mi; assert mi.variant() is None; assert callable(pssflow.render)\n"
        "import pssflow.render, pssflow.scene, pssflow.reference; assert callable(pssflow.render)\n"
        "from pssflow.render import Result; assert Result is pssflow.Result\n"
        "import sys; assert not {'rich', 'matplotlib', 'click', 'embreex'} & set(sys.modules)"
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_a_path_alone_is_enough():
    """Loading sets a variant where there is none."""
    done = run_python(
        f"import pssflow, mitsuba as mi\nr = pssflow.render({str(CORNELL)!r}, 'none', 1)\n"
        "assert mi.variant() == r.stats['variant'] == 'llvm_ad_rgb', mi.variant()"
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_names():
    assert set(pssflow.__all__) <= set(dir(pssflow))
    assert pssflow.__version__.count(".") == 2
    assert issubclass(pssflow.UnsupportedError, ValueError)


# --- render ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("guide", ["none", "realnvp"])
def test_a_result_is_complete(variant, guide):
    result = quick(scenes.glossy_room(), guide, 4, seed=5, k=3)
    assert result.image.shape == result.variance.shape == (32, 48, 3)
    assert result.image.dtype == result.variance.dtype == np.float32
    assert np.isfinite(result.image).all()
    assert (result.variance >= 0).all()
    assert result.image.mean() > 0
    stats = result.stats
    assert stats.keys() >= RUN
    assert json.loads(json.dumps(stats, allow_nan=False)) == stats
    assert stats["pilot"].keys() >= COUNTS
    assert result.timings.keys() == {"load", "export", "bvh", "pilot", "fit", "render"}
    assert stats["seconds"]["total"] == pytest.approx(sum(result.timings.values()))
    assert (stats["k"], stats["seed"], stats["variant"]) == (3, 5, variant)
    assert stats["guide"] == stats["chosen"] == guide
    assert stats["camera_rays"] + stats["pilot"]["camera_rays"] == 4 * 32 * 48
    assert stats["budget"] == ("4 spp" if guide == "none" else "4 spp, pilot inside")
    assert stats["mean"] == pytest.approx(result.image.mean(axis=(0, 1)).tolist(), rel=1e-4)
    for name, counted in (("paths_found", result.found), ("nonzero", result.nonzero)):
        assert counted.shape == (32, 48)
        assert counted.sum() == stats[name] + stats["pilot"][name]
    if guide == "none":
        assert result.guide is None
    else:
        assert isinstance(result.guide, pssflow.Guide)
        assert result.guide.dims == 7


def test_all_kinds_of_scenes_are_one(scalar_variant):
    loaded = mi.load_dict(scenes.furnace_sphere(), optimize=False)
    images = [
        quick(scenes.furnace_sphere()).image,
        quick(loaded).image,
        quick(pssflow.Scene(loaded)).image,
        pssflow.Scene(loaded).render("none", 4, progress=False).image,
    ]
    for image in images[1:]:
        np.testing.assert_array_equal(image, images[0])


def test_defaults(furnace):
    stats = furnace.render(progress=False).stats
    assert (stats["guide"], stats["k"], stats["combine"]) == ("auto", 2, "samples")
    assert (stats["parametrisation"], stats["emitter_strategy"]) == ("bsdf", "mis")
    assert [entry["spp"] for entry in stats["passes"]] == [1, 1, 2, 4, 8]
    assert stats["passes"][0]["kind"] == "pilot"
    assert sum(candidate["chosen"] for candidate in stats["candidates"]) == 1


def test_tables_are_fitted_and_asked_in_python(furnace):
    """The density of a cell's numbers integrates to one, and samples are distributed as it says."""
    pilot = furnace.pilot(spp=64, k=2)
    guide = pilot.fit("table")
    assert guide.models == ["direction", "emitter", "light", "ray"]
    n = 20_000
    row = int(np.flatnonzero(pilot.f.any(axis=1))[0])
    place = {
        name: np.tile(getattr(pilot, name)[row, 0], (n, 1))
        for name in ("position", "normal", "outgoing")
    }
    uniform = np.random.default_rng(3).random((n, 2), dtype=np.float32)
    q = np.exp(guide.log_prob(uniform, decision="direction", contexts=place))
    assert abs(q.mean() - 1) < 5 * q.std() / np.sqrt(n) + 1e-6
    u, log_q = guide.sample(n, 4, decision="direction", contexts=place)
    np.testing.assert_allclose(
        guide.log_prob(u, decision="direction", contexts=place), log_q, atol=1e-4
    )
    # E_q[1/q] is the cube's volume where q > 0, which here is everywhere.
    weights = np.exp(-log_q)
    assert abs(weights.mean() - 1) < 5 * weights.std() / np.sqrt(n) + 1e-6


@pytest.mark.parametrize("none", [None, [], (), np.empty((0, 2))])
def test_no_emitters_may_be_an_empty_list(none):
    u = np.random.default_rng(4).random((50, 5), np.float32)
    guide = pssflow.Guide.fit("realnvp-logit", u, np.ones(50, np.float32), emitters=none, epochs=1)
    assert np.isfinite(guide.log_prob(u)).all()
    with pytest.raises(ValueError, match=r"`emitters` has shape \(3,\); expected \(m, 2\)"):
        pssflow.Guide.fit("realnvp-logit", u, np.ones(50, np.float32), emitters=[1.0, 0.0, 1.0])


def test_a_guide_that_looks_says_what_it_misses(furnace):
    pilot = furnace.pilot(spp=4, k=2)
    guide = pilot.fit("direction-table")
    for call, message in (
        (lambda: guide.sample(3), 'has no decision "path"'),
        (lambda: guide.sample(3, decision="light"), 'has no decision "light"'),
        (lambda: guide.sample(3, decision="direction"), "give `contexts`"),
        (lambda: guide.sample(3, decision="where"), 'decision "where" is unknown'),
        (
            lambda: guide.sample(3, decision="direction", contexts={"place": [[0, 0, 0]] * 3}),
            r'contexts\["place"\] is unknown',
        ),
        (
            lambda: guide.sample(3, decision="direction", contexts={"position": [[0, 0, 0]]}),
            "position has 1 rows, expected 3",
        ),
        (
            lambda: pssflow.Guide.fit("table", pilot.u[:, :5], pilot.f),
            "give `contexts`",
        ),
        (
            lambda: pssflow.Guide.fit("ray-table", pilot.u[:, :5], pilot.f, ray=pilot.u[:-1, 5:]),
            r"`ray` has shape \(\d+, 2\); expected",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_a_preset_has_a_guide_of_its_own(furnace):
    stats = furnace.render(spp=4, preset="thesis", progress=False).stats
    assert (stats["guide"], stats["a"]) == ("realnvp", 0.0)


@pytest.mark.parametrize("combine", ["samples", "variance"])
@pytest.mark.parametrize("guide", ["table", "emitter-table+direction-table", "auto"])
def test_tables_render_and_repeat(furnace, guide, combine):
    first = furnace.render(guide, 16, seed=3, combine=combine, threads=1, progress=False)
    again = furnace.render(guide, 16, seed=3, combine=combine, threads=3, progress=False)
    np.testing.assert_array_equal(first.image, again.image)
    assert sum(entry["spp"] for entry in first.stats["passes"]) == 16
    replayed = pssflow.render(furnace, replay=first.stats, progress=False)
    np.testing.assert_array_equal(first.image, replayed.image)


def test_auto_may_end_in_its_pilot(furnace):
    stats = furnace.render("auto", 1, progress=False).stats
    assert (stats["chosen"], [entry["spp"] for entry in stats["passes"]]) == ("none", [1])


def test_one_seed_one_image(furnace):
    images = [
        furnace.render("realnvp", 4, seed=seed, threads=threads, progress=False).image
        for seed, threads in ((1, 1), (1, 2), (2, 1))
    ]
    np.testing.assert_array_equal(images[0], images[1])
    assert (images[0] != images[2]).any()


def test_guide_options_are_passed(furnace):
    for options in ({"epochs": 2}, {"realnvp.epochs": 2}):
        result = furnace.render("realnvp", 4, progress=False, **options)
        assert result.stats["training"]["guide"]["options"]["epochs"] == 2
        assert result.stats["guide_options"] == {"epochs": 2}


def test_preset_thesis(furnace):
    stats = quick(furnace, "realnvp", None, preset="thesis").stats
    assert [(entry["kind"], entry["spp"]) for entry in stats["passes"]] == [
        ("pilot", 16),
        ("guided", 16),
    ]
    assert (stats["a"], stats["emitter_strategy"], stats["keep_pilot"]) == (0.0, "nee", False)
    assert stats["budget"] == "32 spp, of these 16 of a pilot that is discarded"
    stats = quick(
        furnace, "realnvp", 8, preset="thesis", uniform_fraction=0.1, keep_pilot=True
    ).stats
    assert [(entry["kind"], entry["spp"]) for entry in stats["passes"]] == [
        ("pilot", 4),
        ("guided", 4),
    ]
    assert (round(stats["a"], 6), stats["keep_pilot"]) == (0.1, True)
    stats = quick(furnace, "none", None, preset="thesis").stats
    assert [(entry["kind"], entry["spp"]) for entry in stats["passes"]] == [("uniform", 16)]
    assert set(PRESETS) == {"thesis"}


def test_the_renderer_takes_the_arrays_over(llvm_variant):
    """It holds the scene's arrays once, bytes as bytes; nothing of the export keeps them alive."""
    texels = np.random.default_rng(1).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    photo = {"type": "bitmap", "bitmap": mi.Bitmap(texels)}
    court = scenes.open_sky() | {
        "photo": {"type": "cube", "bsdf": {"type": "diffuse", "reflectance": photo}}
    }
    exported = export(mi.load_dict(court))
    bitmaps = [e for e in exported.description["textures"] if e["type"] == "bitmap"]
    assert {exported.arrays[entry["data"]].dtype.name for entry in bitmaps} >= {"uint8"}
    held = pssflow.Scene(court)
    assert held.exported.arrays == []
    summary = held.summary
    size = sum(array.nbytes for array in exported.arrays)
    # Rectangles come without arrays; a table of 256 numbers goes with each bitmap of bytes.
    assert summary["geometry_bytes"] + summary["texture_bytes"] < size + 8192
    assert summary["bvh_bytes"] > 0


def test_auto_strategy_says_why(furnace):
    stats = quick(furnace, emitter_strategy="auto").stats
    assert stats["emitter_strategy"] in ("mis", "nee")
    assert any(note.startswith("emitter_strategy auto") for note in stats["notes"])


def test_a_timed_render_is_replayed(furnace, tmp_path):
    timed = quick(furnace, "realnvp", None, time=0.5, epochs=1, seed=4, parametrisation="cosine")
    assert timed.stats["budget"] == "0.5 s incl. pilot and training"
    (tmp_path / "run.json").write_text(json.dumps(timed.stats))
    for replay in (timed.stats, tmp_path / "run.json"):
        again = quick(furnace, spp=None, replay=replay)
        np.testing.assert_array_equal(again.image, timed.image)
        assert again.stats["passes"] == timed.stats["passes"]
    by_hand = quick(
        furnace,
        "realnvp",
        None,
        replay=timed.stats["passes"],
        epochs=1,
        seed=4,
        parametrisation="cosine",
    )
    np.testing.assert_array_equal(by_hand.image, timed.image)


def test_light_that_never_arrives_is_no_failure(scalar_variant, tmp_path):
    for guide in ("none", "realnvp"):
        result = quick(scenes.quad(), guide)
        assert not result.image.any()
        assert any("black" in note for note in result.notes)
        assert result.stats["chosen"] == "none"
        truth = reference(scenes.quad(), seconds=0, progress=False, cache=False)
        result.measure(truth)
        json.dumps(result.stats, allow_nan=False)


def test_a_result_is_measured_and_written(furnace, tmp_path):
    result = quick(furnace)
    truth = reference(furnace, seconds=0, progress=False, cache=False)
    result.measure(truth)
    assert result.stats["relmse"] is not None
    assert result.stats["relmse_trimmed"] < result.stats["relmse"]
    result.write(tmp_path / "image.exr")
    layers = dict(mi.Bitmap(str(tmp_path / "image.exr")).split())
    np.testing.assert_array_equal(np.array(layers["<root>"]), result.image)
    np.testing.assert_array_equal(np.array(layers["variance"]), result.variance)
    with pytest.raises(OSError, match=r"nowhere"):
        result.write(tmp_path / "nowhere" / "image.exr")


# --- progress --------------------------------------------------------------------------------------------------------


def test_progress(furnace, capfd):
    told = []
    furnace.render("realnvp", 64, progress=lambda phase, done: told.append((phase, done)))
    assert {phase for phase, _ in told} <= {"pilot", "fit", "render"}
    assert told
    assert all(0 <= done <= 1 for _, done in told)
    furnace.render("realnvp", 64, progress=True)  # stderr is no terminal here
    assert capfd.readouterr() == ("", "")
    furnace.render("realnvp", 64, progress="always")
    out, err = capfd.readouterr()
    assert out == ""
    assert "Fit" in err


def test_ctrl_c_comes_through(furnace):
    def stop(_phase: str, _done: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        furnace.render("none", 1 << 20, progress=stop)


# --- Scene -----------------------------------------------------------------------------------------------------------


def test_trace_and_pilot(furnace):
    pilot = furnace.pilot(2, k=3, seed=6)
    n = 2 * 32 * 32
    assert len(pilot) == n
    assert pilot.u.shape == (n, len(pilot.columns)) == (n, 9)
    assert pilot.learned == 7
    assert pilot.pixels.shape == pilot.pixel.shape == (n, 2)
    assert pilot.position.shape == pilot.normal.shape == pilot.outgoing.shape == (n, 3, 3)
    assert (pilot.g == 1).all()
    assert pilot.found.dtype == bool
    assert not pilot.f[~pilot.found].any()
    np.testing.assert_array_equal(pilot.f, pilot.f_nee + pilot.f_bsdf)
    traced = furnace.trace(pilot.u, pilot.pixels, k=3)
    np.testing.assert_array_equal(traced.f, pilot.f)
    np.testing.assert_array_equal(traced.position, pilot.position)
    nee = furnace.trace(pilot.u[:, :7], pilot.pixels, k=3, emitter_strategy="nee")
    assert not nee.f_bsdf.any()
    assert furnace.columns(3, "nee") == pilot.columns[:7]


def test_the_mean_of_f_is_the_image(furnace):
    """H0: both estimate the furnace's mean two-bounce radiance; five standard errors, false alarm 6e-7."""
    f = furnace.pilot(16, seed=1).f.astype(np.float64).mean(axis=1)
    result = quick(furnace, spp=16, seed=2)
    error = np.hypot(
        f.std() / len(f) ** 0.5, result.variance.sum() ** 0.5 * 3**0.5 / result.image.size
    )
    assert abs(f.mean() - result.image.mean(dtype=np.float64)) < 5 * error


def test_a_pilot_is_saved(furnace, tmp_path):
    pilot = furnace.pilot(1)
    pilot.save(tmp_path / "pilot.npz")
    again = pssflow.Pilot.load(tmp_path / "pilot.npz")
    assert vars(pilot).keys() == vars(again).keys()
    for name, value in vars(pilot).items():
        np.testing.assert_array_equal(getattr(again, name), value, err_msg=name)
    assert (again.columns, again.scene_hash) == (pilot.columns, furnace.hash)
    assert [file.name for file in tmp_path.iterdir()] == ["pilot.npz"]
    with pytest.raises(OSError, match="cannot be written"):
        pilot.save(tmp_path / "nowhere" / "pilot.npz")
    with pytest.raises(FileNotFoundError, match=r"none\.npz: there is no such file"):
        pssflow.Pilot.load(tmp_path / "none.npz")
    (tmp_path / "pilot.npz").write_bytes(b"PK\x03\x04 and nothing more")
    with pytest.raises(ValueError, match="is no pilot saved by pssflow"):
        pssflow.Pilot.load(tmp_path / "pilot.npz")


def test_a_scene_knows_itself(furnace):
    assert (furnace.width, furnace.height, furnace.variant) == (32, 32, "scalar_rgb")
    assert furnace.timings.keys() == {"load", "export", "bvh"}
    assert furnace.summary["shapes"] == {"cylinder": 1, "disk": 1, "mesh": 1, "sphere": 2}
    assert "libembree4" in furnace.summary["embree"]
    assert repr(furnace) == "Scene('dict', 32×32, scalar_rgb)"


def test_film_sizes(scalar_variant):
    assert quick(pssflow.Scene(CORNELL, size=(24, 16)), spp=1).image.shape == (16, 24, 3)
    scaled = pssflow.Scene(scenes.glossy_room(), scale=0.5)
    film = scaled.exported.description["film"]
    assert (film["size"], film["crop_offset"], film["crop_size"]) == ([32, 24], [4, 5], [24, 16])
    truth = reference(scaled, seconds=0, progress=False, cache=False)
    assert truth.image.shape == quick(scaled, spp=1).image.shape
    with pytest.raises(ValueError, match="both given"):
        pssflow.Scene(CORNELL, size=(24, 16), scale=2)
    with pytest.raises(ValueError, match="`size` = 0"):
        pssflow.Scene(CORNELL, size=(24, 0))


def test_xml_parameters(scalar_variant, tmp_path):
    (tmp_path / "scene.xml").write_text(
        """<scene version="3.0.0"><default name="side" value="8"/>
        <sensor type="perspective"><film type="hdrfilm">
        <integer name="width" value="$side"/><integer name="height" value="4"/></film></sensor>
        <shape type="sphere"/><emitter type="point"/></scene>"""
    )
    assert pssflow.Scene(tmp_path / "scene.xml").width == 8
    assert pssflow.Scene(tmp_path / "scene.xml", side=12).width == 12
    with pytest.raises(ValueError, match=r"unused parameters: - \$other=1"):
        pssflow.Scene(tmp_path / "scene.xml", other=1)
    with pytest.raises(ValueError, match="`side` was given as a parameter of the XML file"):
        pssflow.Scene(scenes.quad(), side=12)


# --- guides ----------------------------------------------------------------------------------------------------------


def test_a_guide_by_itself(furnace, tmp_path):
    pilot = furnace.pilot(2)
    guide = pilot.fit("realnvp-logit", seed=3, epochs=1)
    assert (guide.name, guide.dims) == ("realnvp-logit", 5)
    assert guide.describe()["options"]["epochs"] == 1
    u, log_q = guide.sample(1000, seed=1)
    assert u.shape == (1000, 5)
    assert ((u >= 0) & (u < 1)).all()
    np.testing.assert_allclose(guide.log_prob(u), log_q, atol=1e-3)
    guide.save(tmp_path / "guide.safetensors")
    again = pssflow.Guide.load(tmp_path / "guide.safetensors")
    np.testing.assert_array_equal(again.sample(1000, seed=1)[0], u)
    same = pssflow.Guide.fit("realnvp-logit", pilot.u[:, :5], pilot.f, seed=3, epochs=1)
    np.testing.assert_array_equal(same.sample(1000, seed=1)[0], u)
    with pytest.raises(ValueError, match="`u` has 3 columns; this guide has 5"):
        guide.log_prob(u[:, :3])


def test_rows_of_zero_are_counted(furnace, monkeypatch):
    seen = {}

    def fit(*args: Any, **options: Any) -> str:
        seen.update(options, **args[1])
        return "core"

    core = {
        "Guide": type("G", (), {"fit": staticmethod(fit)}),
        "guides": staticmethod(lambda: "[]"),
        "guide_aliases": staticmethod(lambda: "{}"),
    }
    monkeypatch.setattr(guides, "_core", type("Core", (), core))
    f = np.array([[0, 0, 0], [1, 2, 3], [np.nan, 0, 0]], np.float32)
    pssflow.Guide.fit("any", np.zeros((3, 2)), f, zeros=4, alpha=1)
    assert len(seen["u"]) == 2
    assert seen["zeros"] == 5
    np.testing.assert_allclose(seen["f"][0], 0.212671 + 2 * 0.715160 + 3 * 0.072169, rtol=1e-6)
    assert seen["f_max"][0] == 3
    assert json.loads(seen["options"]) == {"alpha": 1}


def test_a_guide_is_used_again(furnace, tmp_path):
    learned = quick(furnace, "realnvp", 8, epochs=1)
    assert isinstance(learned.guide, pssflow.Guide)
    learned.guide.save(tmp_path / "guide.safetensors")
    ready = quick(furnace, learned.guide)
    assert [entry["kind"] for entry in ready.stats["passes"]] == ["guided"]
    assert ready.stats["guide"] == "realnvp"
    for path in (tmp_path / "guide.safetensors", str(tmp_path / "guide.safetensors")):
        loaded = quick(furnace, path)
        np.testing.assert_array_equal(loaded.image, ready.image)
        assert loaded.stats["guide"] == str(path)
    with pytest.raises(ValueError, match="k"):
        quick(furnace, learned.guide, k=3)
    with pytest.raises(ValueError, match="scene"):
        quick(scenes.open_sky(), tmp_path / "guide.safetensors")
    with pytest.raises(ValueError, match="columns"):
        quick(furnace, tmp_path / "guide.safetensors", k=3)


@pytest.mark.parametrize("content", [b"", b"no tensors", b"\xff" * 4096])
def test_corrupt_guides_are_refused(furnace, tmp_path, content):
    (tmp_path / "guide.safetensors").write_bytes(content)
    with pytest.raises(ValueError, match=r"guide\.safetensors") as caught:
        quick(furnace, tmp_path / "guide.safetensors")
    assert "\n" not in str(caught.value)


def test_a_guide_of_another_make(furnace):
    """Box against random numbers: image means agree within five standard errors (false alarm 6e-7)."""
    box = Box()
    assert isinstance(box, guides.ForeignGuide)
    guided = quick(furnace, box, 16, seed=11)
    assert guided.guide is box
    assert guided.stats["guide"] == guided.stats["chosen"] == "Box"
    assert box.zeros > 0
    uniform = quick(furnace, "none", 16, seed=12)
    error = ((guided.variance.sum() + uniform.variance.sum()) * 3) ** 0.5 / guided.image.size
    assert abs(guided.image.mean(dtype=float) - uniform.image.mean(dtype=float)) < 5 * error


def test_errors_of_a_guide_of_another_make(furnace):
    class Broken(Box):
        def sample(self, n, seed):
            raise ZeroDivisionError("mine")

    with pytest.raises(ZeroDivisionError, match="mine"):
        quick(furnace, Broken())
    with pytest.raises(TypeError, match="`guide` is a object without `fit`, `sample`, `log_prob`"):
        quick(furnace, object())
    with pytest.raises(ValueError, match="takes no options"):
        quick(furnace, Box(), epochs=1)


def test_what_guide_means():
    assert guides.choose("realnvp", {"epochs": 1}).options == {"epochs": 1}
    assert guides.choose("none", {}).kind == "none"
    both = guides.choose("realnvp+realnvp-logit", {"epochs": 1, "realnvp-logit.hidden": 8})
    assert both.options == {"realnvp": {"epochs": 1}, "realnvp-logit": {"epochs": 1, "hidden": 8}}
    assert guides.guide_names()[0] == "none"
    for options, message in (
        ({"realnvp-logit.epochs": 1}, "is an option of `realnvp-logit`, but `guide` is 'realnvp'"),
        ({"epochs": object()}, "no option's value"),
        ({"epochs": float("nan")}, "no option's value"),
    ):
        with pytest.raises(ValueError, match=message):
            guides.choose("realnvp", options)


# --- wrong arguments -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"spp": 0}, "`spp` = 0: expected an integer between 1"),
        ({"spp": 2.5}, "`spp` = 2.5"),
        ({"spp": True}, "`spp` = True"),
        ({"spp": 4, "time": 1.0}, "both given"),
        ({"spp": None, "time": 0.0}, r"`time` = 0.0: expected a number in \(0"),
        ({"spp": None, "time": float("nan")}, "`time` = nan"),
        ({"k": 0}, "`k` = 0"),
        ({"k": 33}, "`k` = 33"),
        (
            {"parametrisation": "sphere"},
            "`parametrisation` = 'sphere' is unknown .known: bsdf, cosine, uniform",
        ),
        ({"emitter_strategy": "both"}, "`emitter_strategy` = 'both'"),
        ({"uniform_fraction": 1.5}, "`uniform_fraction` = 1.5"),
        ({"uniform_fraction": float("nan")}, "`uniform_fraction` = nan"),
        ({"seed": -1}, "`seed` = -1"),
        ({"seed": 2**64}, "`seed` = 18446744073709551616"),
        ({"threads": 0}, "`threads` = 0"),
        ({"sensor": 1}, "`sensor`"),
        ({"preset": "paper"}, "`preset` = 'paper' is unknown .known: thesis"),
        ({"pilot_spp": 0}, "`pilot_spp` = 0"),
        ({"guide": "realnvp", "spp": 1}, "leaves no sample for the guide"),
        ({"guide": "realnvp", "spp": 4, "pilot_spp": 4}, "leaves no sample for the guide"),
        (
            {"guide": "vegasse"},
            "`guide` = 'vegasse' is unknown .known: none, auto, realnvp, realnvp-logit",
        ),
        ({"guide": "realnvp", "epoch": 3}, "epoch"),
        ({"guide": "realnvp", "epochs": -3}, "epochs"),
        ({"guide": "none", "epochs": 3}, "`epochs` was given, but `guide` is `none`"),
        ({"spp": None, "replay": []}, "`replay` = "),
        ({"spp": None, "replay": [{"kind": "pilot"}]}, r"`replay`\[0\]"),
        ({"spp": None, "replay": [{"kind": "guess", "spp": 1}]}, r"replay\[0\].kind"),
        (
            {"spp": None, "replay": [{"kind": "pilot", "spp": 1, "record": 2}]},
            r"replay\[0\].record",
        ),
        ({"spp": None, "replay": {"k": 2}}, "lacks `passes`"),
        ({"spp": 4, "replay": [{"kind": "uniform", "spp": 1}]}, "leave out `spp`"),
    ],
)
def test_wrong_arguments_are_one_line(furnace, options, message):
    guide = options.pop("guide", "none")
    with pytest.raises(ValueError, match=message) as caught:
        pssflow.render(furnace, guide, progress=False, **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "there is no such file"),
        ("", "No document element found"),
        ("<scene version='3.0.0'><shape type=", "attribute"),
        (
            "<scene version='3.0.0'><shape type='klein-bottle'/></scene>",
            'Plugin "klein-bottle" not found',
        ),
        (
            "<scene version='3.0.0'><shape type='sphere'><float name='bad' value='1'/></shape></scene>",
            '"bad"',
        ),
        (
            "<scene version='3.0.0'><integrator type='pssflow'><integer name='k' value='0'/></integrator></scene>",
            "`k`",
        ),
        ("<bsdf version='3.0.0' type='diffuse'/>", "not a scene"),
        ("<scene version='3.0.0'/>", "sensor"),
    ],
)
def test_files_that_are_no_scene(scalar_variant, tmp_path, content, message):
    path = tmp_path / "scene.xml"
    if content is not None:
        path.write_text(content)
    with pytest.raises((ValueError, FileNotFoundError), match=message) as caught:
        quick(path)
    assert "\n" not in str(caught.value)
    assert "Traceback" not in str(caught.value)


def test_scenes_that_are_none(scalar_variant, tmp_path):
    with pytest.raises(FileNotFoundError, match="is a folder"):
        quick(tmp_path)
    with pytest.raises(TypeError, match="`scene` is a int"):
        quick(3)
    with pytest.raises(ValueError, match=r"scene dictionary: .*klein-bottle"):
        quick({"type": "scene", "shape": {"type": "klein-bottle"}})
    with pytest.raises(pssflow.UnsupportedError, match='"hair"'):
        quick(
            {
                "type": "scene",
                "sensor": {"type": "perspective"},
                "ball": {"type": "sphere", "bsdf": {"type": "hair"}},
            }
        )


def test_records_that_are_none(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_replay(tmp_path / "none.json")
    for content, message in (("{", "is no JSON"), ("[]", "holds a list"), ("{}", "lacks `passes`")):
        (tmp_path / "run.json").write_text(content)
        with pytest.raises(ValueError, match=message):
            read_replay(tmp_path / "run.json")


def test_a_plan_speaks_json():
    plan = Plan.make(learns=True, spp=8, seed=2**64 - 1, uniform_fraction=0.5)
    options = json.loads(plan.core("realnvp", {}, "mis"))
    assert (options["spp"], options["seed"], options["uniform_fraction"]) == (8, 2**64 - 1, 0.5)
