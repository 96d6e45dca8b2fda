"""`max_depth`: the whole light as a sum of path lengths. Its mean is tested in `tests/statistical/test_light.py`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import pssflow
from pssflow import light
from pssflow.cli import main
from pssflow.options import Plan
from tests import scenes

XML = str(Path(__file__).parents[2] / "scenes" / "cornell-box" / "scene.xml")


@pytest.fixture
def scene(llvm_variant: str) -> pssflow.Scene:
    return pssflow.Scene(mi.load_dict(scenes.furnace_sphere()))


def _render(scene: Any, guide: str = "table", **options: Any) -> pssflow.Result:
    arguments: dict[str, Any] = {"max_depth": 4, **options}
    return pssflow.render(scene, guide, progress=False, **arguments)


def test_the_image_is_the_sum_of_its_lengths(scene):
    result = _render(scene, spp=8, seed=3)
    assert [part.stats["k"] for part in result.parts] == [0, 1, 2, 3]
    for name in ("image", "variance"):
        total = np.sum([getattr(part, name) for part in result.parts], axis=0, dtype=np.float32)
        np.testing.assert_array_equal(getattr(result, name), total)
    assert result.stats["nonzero"] == sum(part.stats["nonzero"] for part in result.parts)
    np.testing.assert_array_equal(result.layers["k2"], result.parts[2].image)
    assert 0 < result.layers["nonzero_share"].mean() <= 1


def test_a_length_is_the_render_of_its_k(scene):
    """What `k` renders alone is what it adds to the whole: nothing is shared that could bias it."""
    part = _render(scene, spp=8, seed=3).parts[2]
    alone = pssflow.render(
        scene, "table", spp=_spp(part), k=2, seed=part.stats["seed"], progress=False
    )
    np.testing.assert_array_equal(part.image, alone.image)


def test_lengths_draw_numbers_of_their_own(scene):
    assert len({part.stats["seed"] for part in _render(scene, spp=4, seed=7).parts}) == 4


def test_samples_go_where_they_lower_the_error(scene):
    """All lengths together cost what `spp` of each would, rounding aside, and none gets less than an eighth."""
    stats = _render(scene, spp=64).stats
    probes = [length["probe"] for length in stats["lengths"]]
    cost = sum(length["spp"] * length["probe"]["rays"] for length in stats["lengths"])
    whole = sum(64 * probe["rays"] for probe in probes)
    assert abs(cost - whole) <= sum(probe["rays"] for probe in probes)
    shares = np.array([length["spp"] for length in stats["lengths"]])
    assert shares.min() >= 8
    error = [probe["variance"] / probe["rays"] for probe in probes]
    assert np.argmax(shares) == np.argmax(error)


def test_one_seed_gives_one_image_on_any_number_of_threads(scene):
    a, b = (_render(scene, "auto", spp=8, threads=threads).image for threads in (1, 2))
    np.testing.assert_array_equal(a, b)


def test_what_the_camera_sees_shine(scene):
    """At depth 1 there are lamps alone: in `quad`, white squares of radiance 6 where the lamp is seen from below."""
    view = scenes.quad() | {
        "floor": {"type": "rectangle", "emitter": {"type": "area", "radiance": 6.0}}
    }
    image = _render(mi.load_dict(view), "none", max_depth=1, spp=4).image
    assert np.unique(np.round(image, 4)).max() == 6.0
    truth = np.array(
        mi.render(
            mi.load_dict(view), integrator=mi.load_dict({"type": "path", "max_depth": 1}), spp=64
        )
    )
    assert abs(image.mean() - truth.mean()) < 0.02 * truth.mean()


@pytest.mark.parametrize("budget", [{"spp": 8}, {"time": 0.5}])
def test_a_recorded_run_is_repeated(scene, budget):
    """Also where time decided: the passes of every length are in the record."""
    first = _render(scene, "auto", **budget)
    record = json.loads(json.dumps(first.stats))
    again = pssflow.render(scene, replay=record, progress=False)
    np.testing.assert_array_equal(first.image, again.image)
    assert again.stats["max_depth"] == 4
    with pytest.raises(ValueError, match="`max_depth` was given"):
        pssflow.render(scene, replay=record["lengths"][2]["passes"], max_depth=4, progress=False)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"k": 2}, "`k` = 2 was given, but `replay` holds all light to `max_depth` = 3"),
        ({"max_depth": 5}, "`max_depth` = 5 was given, but `replay` holds all light to"),
    ],
)
def test_a_record_decides_the_depth(scene, options, message):
    record = _render(scene, "none", spp=1, max_depth=3).stats
    with pytest.raises(ValueError, match=message):
        pssflow.render(scene, replay=record, progress=False, **options)
    one = record["lengths"][2]
    other: dict[str, Any] = dict.fromkeys(options, 5)
    with pytest.raises(ValueError, match="was given, but `replay` holds a render of k = 2"):
        pssflow.render(scene, replay=one, progress=False, **other)
    again = pssflow.render(scene, replay=record, progress=False, max_depth=3)
    assert again.stats["max_depth"] == 3


@pytest.mark.parametrize(
    "damage",
    [
        {"lengths": 7},
        {"lengths": [7]},
        {"lengths": {"k": 2}},
        *({"k": "two"}, {"a": 2.0}, {"seed": -1}, {"passes": 3}, {"probe": 1}),
        {"emitter_strategy": "all"},
    ],
)
def test_damaged_records_are_refused(scene, damage):
    record = json.loads(json.dumps(_render(scene, "none", spp=1, max_depth=2).stats))
    (record if "lengths" in damage else record["lengths"][1]).update(damage)
    with pytest.raises(ValueError, match=next(iter(damage))) as caught:
        pssflow.render(scene, replay=record, progress=False)
    assert "\n" not in str(caught.value)


def test_auto_without_its_pilot_renders_lengths_of_one_sample(scene):
    result = _render(scene, "auto", spp=1, keep_pilot=False)
    assert min(length["spp"] for length in result.stats["lengths"]) == 1
    assert result.image.mean() > 0


def test_what_diagnostics_say_is_said_of_a_length():
    diagnostics = {"warnings": ["the tail is heavy"]}
    notes = ["sky: baked", "the tail is heavy", "the image is black: no light"]
    length = {"k": 2, "diagnostics": diagnostics, "notes": notes}
    assert list(light._notes(length)) == ["sky: baked", "k=2: the tail is heavy"]


@pytest.mark.parametrize(("guide", "spp"), [("none", 2), ("table", 40)])
def test_progress_is_one_bar(scene, guide, spp):
    """Also where passes and training take turns."""
    told: list[tuple[str, float]] = []
    pssflow.render(scene, guide, spp, max_depth=3, progress=lambda *a: told.append(a))
    assert {phase for phase, _ in told} <= {"render"}
    shares = [share for _, share in told]
    assert shares == sorted(shares)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_depth": -1}, "`max_depth` = -1: paths of any length are not supported"),
        ({"max_depth": 0}, "`max_depth` = 0: expected an integer between 1 and 33"),
        ({"max_depth": 3, "k": 2}, "`k` = 2 and `max_depth` = 3 were both given"),
        ({"max_depth": 3, "preset": "thesis"}, "`preset` = 'thesis' renders light of one k"),
        ({"max_depth": 3, "time": 1.0, "snapshots": (0.5,)}, "`snapshots` are not supported"),
    ],
)
def test_what_cannot_be(scene, options, message):
    with pytest.raises(ValueError, match=message) as caught:
        pssflow.render(scene, progress=False, **options)
    assert "\n" not in str(caught.value)


def test_a_fitted_guide_is_for_one_k(scene):
    guide = pssflow.render(scene, "direction-table", 4, progress=False).guide
    with pytest.raises(ValueError, match="a fitted guide is for paths of one length"):
        pssflow.render(scene, guide, 4, max_depth=3, progress=False)


# --- the command -----------------------------------------------------------------------------------------------------


def _command(*arguments: str) -> int:
    return main([*arguments])


def test_the_command_writes_a_layer_for_each_length(tmp_path, capfd):
    target = tmp_path / "all.exr"
    small = ("--size", "16x16", "-q")
    assert _command("render", XML, "--max-depth", "3", "--spp", "4", *small, "-o", str(target)) == 0
    assert "all light to depth 3" in capfd.readouterr().out
    layers = pssflow._core.read_exr(str(target))
    names = ("R", "k0.R", "k1.G", "k2.B", "variance.R", "nonzero_share.R")
    assert set(names) <= layers.keys()
    total = sum(layers[f"k{k}.G"] for k in range(3))
    np.testing.assert_allclose(layers["G"], total, rtol=1e-6)
    again = tmp_path / "again.exr"
    replay = ("--replay", str(target.with_suffix(".json")))
    assert _command("render", XML, *replay, *small, "-o", str(again)) == 0
    np.testing.assert_array_equal(pssflow._core.read_exr(str(again))["R"], layers["R"])


def test_the_command_refuses_both(tmp_path, capfd):
    arguments = ("render", XML, "--k", "2", "--max-depth", "3", "-o", str(tmp_path / "x.exr"))
    assert _command(*arguments) != 0
    assert "--max-depth" in capfd.readouterr().err
    assert not list(tmp_path.iterdir())


# --- the plugin ------------------------------------------------------------------------------------------------------


def test_the_plugin_is_the_function(variant):
    scene = mi.load_dict(scenes.furnace_sphere())
    integrator: Any = mi.load_dict({"type": "pssflow", "guide": "table", "max_depth": 3})
    rendered = np.array(mi.render(scene, integrator=integrator, spp=4), np.float32)
    expected = _render(scene, max_depth=3, spp=4)
    np.testing.assert_array_equal(rendered, expected.image)
    assert "max_depth = 3" in str(integrator)


def test_the_plugins_channels(llvm_variant):
    scene = mi.load_dict(scenes.furnace_sphere())
    integrator: Any = mi.load_dict(
        {"type": "pssflow", "guide": "none", "max_depth": 3, "aovs": True}
    )
    image = np.array(mi.render(scene, integrator=integrator, spp=2), np.float32)
    names = integrator.aov_names()
    assert image.shape[2] == 3 + len(names)
    assert names[0] == "k0.R"
    assert names[-1] == "nonzero_share.B"
    for i, layer in enumerate(("k0", "k1", "k2")):
        np.testing.assert_array_equal(
            image[..., 3 + 3 * i : 6 + 3 * i], integrator.result.layers[layer]
        )
    with pytest.raises(Exception, match="`k` and `max_depth` were both given"):
        mi.load_dict({"type": "pssflow", "k": 2, "max_depth": 3})


def _spp(part: pssflow.Result) -> int:
    return sum(entry["spp"] for entry in part.stats["passes"])


# --- Russian roulette


def test_long_paths_are_left_to_chance(scene):
    """From the depth of roulette on there may be less than a sample a pixel; before it nothing is left to chance."""
    stats = _render(scene, "none", spp=16, max_depth=12, rr_depth=3).stats
    assert stats["rr_depth"] == 3
    by_k = {length["k"]: length for length in stats["lengths"]}
    assert sorted(by_k) == list(range(12))
    for k, length in by_k.items():
        expected = length["probe"]["spp"]
        paths = 32 * 32 * length["spp"]
        if k < 3:
            assert length["survival"] == 1.0
            assert length["camera_rays"] == paths
            continue
        if expected >= 2.0:
            assert (length["survival"], length["spp"]) == (1.0, round(expected))
            continue
        assert length["spp"] == 4
        assert length["spp"] * length["survival"] == pytest.approx(expected, abs=4.0 / 2**24)
        traced = length["camera_rays"]
        spread = (paths * length["survival"] * (1.0 - length["survival"])) ** 0.5
        assert abs(traced - paths * length["survival"]) <= 5.0 * spread
    assert by_k[11]["survival"] < 0.1
    cost = {k: length["camera_rays"] * length["probe"]["rays"] for k, length in by_k.items()}
    assert sum(cost[k] for k in range(6, 12)) < 0.1 * sum(cost.values())


def test_chance_goes_by_the_seed_alone(scene):
    """One seed gives one image on any number of threads, and a record repeats it; another seed ends other paths."""
    options: dict[str, Any] = {"spp": 4, "max_depth": 9, "rr_depth": 2, "seed": 5}
    one, two = (_render(scene, "auto", threads=n, **options) for n in (1, 2))
    np.testing.assert_array_equal(one.image, two.image)
    record = json.loads(json.dumps(one.stats))
    again = pssflow.render(scene, replay=record, progress=False)
    np.testing.assert_array_equal(one.image, again.image)
    assert again.stats["rr_depth"] == 2
    ended = [
        part.found == 0
        for part in (one.parts[8], _render(scene, "auto", **options | {"seed": 6}).parts[8])
    ]
    assert ended[0].any()
    assert (ended[0] != ended[1]).any()


def test_a_length_is_repeated_alone(scene):
    """Its record holds the chance that its paths had, as well as its passes."""
    whole = _render(scene, "auto", spp=4, max_depth=9, rr_depth=2)
    assert whole.parts[8].stats["survival"] < 0.5
    for part in (whole.parts[2], whole.parts[8]):
        again = pssflow.render(scene, replay=part.stats, progress=False)
        for name in ("image", "variance", "found"):
            np.testing.assert_array_equal(getattr(part, name), getattr(again, name))
        assert again.stats["survival"] == part.stats["survival"]
    damaged = whole.parts[8].stats | {"survival": 0.0}
    with pytest.raises(ValueError, match=r"`survival` = 0\.0: expected a number in \(0, 1\]"):
        pssflow.render(scene, replay=damaged, progress=False)


@pytest.mark.parametrize("guide", ["auto", "table"])
def test_a_pilot_may_be_all_there_was(guide, llvm_variant):
    """Its rays tell what there is time for: with hidden emitters the first length is its pilot and nothing else."""
    room = mi.load_dict(scenes.furnace_sphere())
    # So many pixels that there is no time for a second sample.
    hidden = pssflow.Scene(room, size=(256, 256), hide_emitters=True)
    stats = _render(hidden, guide, time=1e-3, max_depth=6, rr_depth=2, threads=1).stats
    lengths = stats["lengths"]
    assert lengths[0]["camera_rays"] == 0 < lengths[0]["pilot"]["camera_rays"]
    assert all(0.0 < length["survival"] <= 1.0 for length in lengths)
    assert lengths[4]["survival"] < 1.0


def test_a_chance_is_one_that_the_core_can_give(scene):
    """The core's numbers have 24 bits: a path that lived more often than it says would count too much."""
    plan = Plan.make(learns=False, spp=4)
    for wanted in (0.0, 1e-12, 1e-7, 0.1, 1.9):
        survival = light._left_to_chance(plan, wanted).survival
        assert 0.0 < survival == np.float32(survival)
        assert (survival * 2**24).is_integer()
        assert 0.0 <= 4.0 * survival - wanted <= 4.0 / 2**24


def test_what_is_far_behind_the_roulette_is_not_looked_at(scene, monkeypatch):
    """Neither for its share nor for how its light is joined."""
    looked: list[int] = []

    def resolve(strategy: str, k: int, *_: Any) -> tuple[str, str]:
        looked.append(k)
        return ("nee" if k == 4 else "mis"), strategy

    monkeypatch.setattr(scene, "resolve_strategy", resolve)
    plan = Plan.make(learns=False, spp=1, emitter_strategy="auto")
    parts = light._probe(scene, plan, 12, 2)
    assert looked == [1, 2, 3, 4]
    assert [part.strategy for part in parts] == ["nee", *["mis"] * 3, *["nee"] * 8]
    looked.clear()
    light._probe(scene, plan, 6, None)
    assert looked == [1, 2, 3, 4, 5]


def _plan(time: float) -> Plan:
    return Plan.make(learns=False, time=time)


def test_by_time_the_chance_is_what_a_sample_is_worth(scene):
    """Where there is no time for a sample of each length; with time enough nothing is left to chance."""
    survival = {}
    for time in (1e-3, 1e3):
        parts = light._probe(scene, _plan(time), 9, 2)
        one = pssflow.render(scene, "none", spp=1, k=1, progress=False)
        speed = light._speed(parts, [one])
        assert speed > 0.0
        rays = parts[8].probe["rays"] * scene.width * scene.height
        survival[time] = light._left_to_chance(_plan(time), time * speed / rays).survival
    assert 0.0 < survival[1e-3] < survival[1e3] == 1.0
    stats = _render(scene, "none", time=1e-3, max_depth=9, rr_depth=2).stats
    assert stats["lengths"][1]["survival"] == 1.0
    assert 0.0 < stats["lengths"][8]["survival"] < 0.5


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_depth": None, "rr_depth": 3}, "`rr_depth` = 3: Russian roulette is for the whole"),
        ({"rr_depth": 0}, "`rr_depth` = 0: expected an integer between 1 and 33"),
    ],
)
def test_roulette_without_a_depth_is_refused(scene, options, message):
    with pytest.raises(ValueError, match=message):
        _render(scene, "none", spp=1, **options)


def test_a_record_decides_the_roulette(scene):
    record = _render(scene, "none", spp=1, max_depth=3).stats
    with pytest.raises(ValueError, match="`rr_depth` was given, but `replay` repeats"):
        pssflow.render(scene, replay=record, rr_depth=2, progress=False)
