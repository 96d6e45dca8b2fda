"""Studies by samples, all light on scenes of its own, errors against noisy truths, and docs/results.md."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pssflow import metrics
from pssflow.cli import main
from pssflow.passes import AllLightPass
from pssflow.reference import reference
from pssflow.study import harness, report
from pssflow.study.harness import Scenery
from pssflow.study.methods import _counted, named_method
from pssflow.study.report import publish, with_error
from pssflow.study.results import _newest, document
from pssflow.study.store import ALL, Row, Store
from pssflow.study.summary import cells, choices, overall, reaches
from tests import scenes
from tests.unit.test_study_guides import study, synthetic
from tests.unit.test_study_methods import FakePass

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def _quick(monkeypatch) -> None:
    monkeypatch.setattr(harness, "flip", lambda image, truth: float(np.abs(image - truth).mean()))


# --- errors against a noisy truth


def spiky(rng: np.random.Generator, truth: np.ndarray, samples: int) -> tuple[Any, Any]:
    """An unbiased image of few bright paths, and its variance estimated from its own samples."""
    chance = 0.02
    drawn = (rng.random((samples, *truth.shape)) < chance) * (truth / chance)
    return drawn.mean(axis=0), drawn.var(axis=0, ddof=1) / samples


def test_a_noisy_truth_does_not_change_who_is_better():
    """Two methods whose variances are 3 to 1: by each pixel's own square all ratios sink, by its neighbours' they stay.

    The truth has a relative standard error of about a half, and pixels that saw no light at all.
    """
    rng = np.random.default_rng(3)
    truth = np.broadcast_to(np.linspace(0.5, 1.5, 48)[:, None, None], (48, 48, 3))
    ratios: dict[str, list[float]] = {"pixel": [], "local": []}
    for _ in range(6):
        r, variance = spiky(rng, truth, 200)
        scale = metrics.local_scale(r)
        errors: dict[str, list[float]] = {"pixel": [], "local": []}
        for sigma in (3.0**0.5, 1.0):
            x = truth * (1.0 + sigma * rng.normal(size=truth.shape))
            errors["pixel"].append(metrics.relmse(x, r, variance))
            errors["local"].append(metrics.relmse(x, r, variance, scale=scale))
        for name, (worse, better) in errors.items():
            ratios[name].append(worse / better)
    mean, error = metrics.mean_and_error(ratios["local"])
    assert abs(mean - 3.0) < 4 * error + 0.05
    assert np.mean(ratios["pixel"]) < 2.5


def test_the_local_scale_knows_nothing_of_its_pixel():
    r = np.random.default_rng(0).random((9, 7, 3)) + 0.5
    before = metrics.local_scale(r)
    changed = r.copy()
    changed[4, 3] += 100.0
    after = metrics.local_scale(changed) - metrics.epsilon(changed) + metrics.epsilon(r)
    np.testing.assert_allclose(after[4, 3], before[4, 3])
    assert (after[2:7, 1:6].sum(axis=2) > before[2:7, 1:6].sum(axis=2)).sum() == 24
    # In a corner those neighbours that there are: 3 × 3 without itself.
    corner = (r[:3, :3].sum(axis=(0, 1)) - r[0, 0]) / 8
    np.testing.assert_allclose(before[0, 0], corner**2 + metrics.epsilon(r))
    flat = np.full((6, 6, 3), 2.0)
    np.testing.assert_allclose(metrics.local_scale(flat), flat**2 + metrics.epsilon(flat))
    one = np.full((1, 1, 3), 2.0)
    np.testing.assert_allclose(metrics.local_scale(one), one**2 + metrics.epsilon(one))
    with pytest.raises(ValueError, match="expected an image"):
        metrics.local_scale(np.ones(5))
    with pytest.raises(ValueError, match="has shape"):
        metrics.relmse(flat, flat, scale=one)


# --- by samples


def test_mitsubas_passes_end_at_each_number_of_samples():
    """A pass size that divides both budgets, at least two passes to the first one; seeds of its own."""
    scene: Any = type("Film", (), {"width": 2, "height": 2})
    render = FakePass([0.0], [0.1], jit=False)
    first, last = _counted(render, "fake", 1, scene, (12.0, 30.0), None)  # pyright: ignore[reportArgumentType]
    assert (first.spp, last.spp) == (12, 30)
    assert first.variance is not None
    assert len(render.seeds) == 10  # of 3 samples each
    assert min(render.seeds) == 2 << 20
    (single,) = _counted(FakePass([0.0], [0.1]), "fake", 0, scene, (2.0,), None)  # pyright: ignore[reportArgumentType]
    assert single.spp == 2


def test_by_samples_compiling_is_outside_of_the_seconds():
    """A pass of its own comes first, with a number that no other pass has, and is told as warm-up."""
    scene: Any = type("Film", (), {"width": 2, "height": 2})
    render = FakePass([0.0], [0.1])
    (shot,) = _counted(render, "fake", 1, scene, (2.0,), None)  # pyright: ignore[reportArgumentType]
    assert render.seeds == [(2 << 20) - 1, 2 << 20, (2 << 20) + 1]
    assert shot.spp == 2
    assert set(shot.seconds) == {"render", "warm_up"}
    assert shot.elapsed == shot.seconds["render"]


def test_a_mean_says_which_scenes_it_leaves_out(tmp_path):
    """A method whose error drowns in the reference's noise on one scene has no ratio there."""
    rows = study(tmp_path, synthetic("none"), synthetic("better", noise=0.5)).run()
    drowned = [
        replace(row, relmse=-1e-6) if (row.scene, row.method) == ("scene 1", "better") else row
        for row in rows
    ]
    total = overall(cells(drowned))
    assert [o.of for o in total] == ["1 of 2; below the noise on scene 1"] * 2
    assert [o.of for o in overall(cells(rows))] == ["2", "2"]
    text = document(drowned, tmp_path, "results.csv")
    assert (
        "1 of 2; below the noise on scene 1" in text.partition("## In short")[2].partition("##")[0]
    )
    assert f"{with_error(total[-1].mean)} (1 of 2; below the noise on scene 1)" in text


def test_a_crowd_is_judged_by_the_cores_of_the_measured_machine():
    ran = [{"load_before": 5.0, "load_after": 6.0, "commit": "abc"}]
    assert report.machine_lines(ran, "2 × A CPU")[0].startswith("CROWDED: with a load of 6.0 on 2")
    assert len(report.machine_lines(ran, "64 × A CPU")) == 1


def test_by_samples_it_is_the_samples_that_decide(tmp_path):
    """Half the noise at half the speed: four times as good at equal samples, twice at equal time."""
    done = study(tmp_path, synthetic("none"), synthetic("better", noise=0.5, speed=0.5), scenes=1)
    rows = done.run()
    by_time = next(c for c in cells(rows) if (c.method, c.time) == ("better", 4.0))
    by_samples = next(
        c
        for c in cells([replace(row, unit="spp") for row in rows])
        if (c.method, c.time) == ("better", 4.0)
    )
    assert by_time.gained == by_time.equal_time
    assert by_samples.gained == by_samples.equal_samples
    assert by_samples.gained is not None
    assert by_samples.gained.value == pytest.approx(4.0, rel=0.1)
    assert by_samples.spent == 16


@pytest.mark.usefixtures("llvm_variant")
def test_by_samples_a_second_run_gives_the_same_rows(tmp_path, monkeypatch, capfd):
    """All methods, also the foreign ones; only times and loads differ."""
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(report, "_charts", lambda *_: [])
    methods = "none,auto,mitsuba-llvm,python-vegas,mitsuba-path"
    tables = []
    for name in ("a", "b"):
        command = ["study", "speed-accuracy", "scenes/cornell-box", "--guides", methods]
        command += ["--spp", "4,8", "--seeds", "2", "--pixels", "256", "--reference-time", "0.5"]
        assert main([*command, "-o", str(tmp_path / name)]) == 0, capfd.readouterr().err
        with (tmp_path / name / "results.csv").open() as file:
            tables.append(list(csv.DictReader(file)))
    assert len(tables[0]) == 5 * 2 * 2
    times = {"elapsed", "when", "load_before", "load_after"}
    for first, second in zip(*tables, strict=True):
        own = times | {key for key in first if key.startswith("seconds_")}
        assert {k: v for k, v in first.items() if k not in own} == {
            k: v for k, v in second.items() if k not in own
        }
        assert first["unit"] == "spp"
        assert int(first["spp"]) == float(first["time"])
    light = {(row["method"], row["light"], row["scene"]) for row in tables[0]}
    assert ("mitsuba-path", "all", "scenes/cornell-box, all light") in light
    assert ("none", "k bounces", "scenes/cornell-box") in light
    assert len(light) == 5
    told = (tmp_path / "a" / "summary.md").read_text()
    assert "equal samples, geometric mean" in told


@pytest.mark.parametrize("text", ["8,4", "0,2", "x", "1.5,3", "1"])
def test_wrong_samples_are_one_line(text, tmp_path, capfd):
    assert main(["study", "guides", "--spp", text, "-o", str(tmp_path / "no")]) == 2
    assert "are no samples per pixel" in capfd.readouterr().err
    assert not (tmp_path / "no").exists()


def test_seconds_and_samples_are_not_given_together(tmp_path, capfd):
    command = ["study", "guides", "--spp", "8", "--times", "1", "-o", str(tmp_path / "no")]
    assert main(command) == 2
    assert "were both given" in capfd.readouterr().err


# --- all light


def test_all_light_stays_by_itself(tmp_path, monkeypatch):
    """However good it looks, it wins against nobody, reaches no other's error, and is no candidate of `auto`."""
    monkeypatch.setattr(report, "_charts", lambda *_: [])
    path = replace(synthetic("mitsuba-path", noise=0.1), light=ALL)
    done = study(tmp_path, synthetic("none"), synthetic("auto"), path, scenes=1)
    done.sceneries = [
        done.sceneries[0],
        Scenery("scene 0, all light", done.sceneries[0].open, ALL),
    ]
    rows = done.run()
    assert {(row.scene, row.method, row.light) for row in rows} == {
        ("scene 0", "none", "k bounces"),
        ("scene 0", "auto", "k bounces"),
        ("scene 0, all light", "mitsuba-path", "all"),
    }
    found = cells(rows)
    own = next(cell for cell in found if cell.light == ALL)
    assert own.gained is None
    assert own.verdict == ""
    assert {total.method for total in overall(found)} == {"auto"}
    assert {choice.best for choice in choices(found)} == {"none"}
    assert "mitsuba-path" not in {reach.method for reach in reaches(found)}
    publish(done, rows, "synthetic")
    text = (tmp_path / "summary.md").read_text()
    assert "| scene 0, all light | mitsuba-path |" in text.partition("## Ratios")[0]
    assert "mitsuba-path" not in text.partition("## Ratios")[2].partition("relMSE, and")[0]


def test_all_light_is_more_than_its_bounces(llvm_variant, tmp_path):
    """In the furnace of albedo ρ < 1 all bounces add up; references are kept apart by what they hold."""
    import mitsuba as mi

    import pssflow

    scene = pssflow.Scene(scenes.furnace_sphere())
    two = reference(scene, 2, seconds=0.2, cache=tmp_path, progress=False)
    whole = reference(scene, 2, seconds=0.2, cache=tmp_path, progress=False, all_light=True)
    assert whole.k is None
    assert whole.path != two.path
    expected = np.array(
        mi.render(scene.mi_scene, spp=64, integrator=mi.load_dict({"type": "path"}))
    )
    assert whole.image.mean() == pytest.approx(expected[..., :3].mean(), rel=0.02)
    assert whole.image.mean() > 1.2 * two.image.mean()
    method = named_method("mitsuba-path", 2, None, "spp")
    assert method.light == ALL
    render = AllLightPass(scene.mi_scene, 0, hide=False)
    image, spp, bad = render(1, 8)
    render.restore()
    assert (spp, bad) == (8, 0)
    assert image.mean() == pytest.approx(whole.image.mean(), rel=0.05)


# --- docs/results.md


def test_results_say_wins_and_losses_and_how_they_were_measured(tmp_path, capfd):
    done = study(
        tmp_path / "study",
        synthetic("none"),
        synthetic("better", noise=0.5),
        synthetic("worse", noise=1.5),
        synthetic("off", bias=0.1),
    )
    rows = done.run()
    target = tmp_path / "docs" / "results.md"
    target.parent.mkdir()
    assert main(["study", "results", str(tmp_path / "study"), "-o", str(target)]) == 0
    text = target.read_text()
    assert f"wrote {target}" in capfd.readouterr().out
    short = text.partition("## In short")[2].partition("##")[0]
    assert "`better`: 4" in short
    assert "2 won, 0 tied, 0 lost" in short
    assert "`worse`: 0.4" in short
    assert "0 won, 0 tied, 2 lost" in short
    # The best first.
    assert short.index("`better`") < short.index("`worse`")
    assert "**BIASED? off on scene 0" in short
    assert "8 pairs of scene and method were tested" in text
    assert "Those that have it are named above." in text
    for told in (
        "one run of 4 s a seed",
        "snapshots at 1 s",
        "3 seeds",
        "load average",
        rows[0].commit,
    ):
        assert told in text
    assert rows[0].processor in text
    assert "win |" in text
    floor = done.floors()["scene 0", "none"]
    assert with_error(floor) in text.partition("## References")[2]
    assert "loss |" in text
    assert Store(target.with_suffix(".csv"), Row).rows == rows
    # From its own CSV alone the same, but for what the images say.
    again = document(
        Store(target.with_suffix(".csv"), Row).rows, tmp_path / "nowhere", "results.csv"
    )
    assert "Bias was not tested" in again
    errors = [t.partition("## Errors")[2].partition("## References")[0] for t in (again, text)]
    assert errors[0] == errors[1]


def test_results_take_the_newest_settings_only(tmp_path, capfd):
    done = study(tmp_path, synthetic("none"), synthetic("old"), scenes=1)
    done.run()
    other = study(tmp_path, synthetic("none"), scenes=1)
    other.times = (1.0, 4.0, 8.0)
    kept = [replace(row, when="9999-01-01T00:00:00Z") for row in other.run()]
    other.store.put(kept)
    target = tmp_path / "results.md"
    assert main(["study", "results", str(tmp_path), "-o", str(tmp_path / "page.md")]) == 0
    assert "6 rows of other settings" in capfd.readouterr().err
    assert not target.exists()
    assert Store(tmp_path / "page.csv", Row).rows == kept


def test_results_mix_no_settings_and_no_films(tmp_path):
    """By samples, or with another reference, or of an edited scene: rows of one table are of one study."""
    done = study(tmp_path, synthetic("none"), scenes=2, seeds=1)
    old = done.run()
    for change in (
        {"unit": "spp"},
        {"unit": "spp", "times": (1.0, 2.0)},
        {"settings": {**done.settings, "reference_time": 9.0}},
    ):
        other = study(tmp_path / "other", synthetic("none"), scenes=1, seeds=1)
        for name, value in change.items():
            setattr(other, name, value)
        new = [replace(row, when="9999-01-01T00:00:00Z") for row in other.run()]
        assert _newest([*new, *old]) == (new, len(old))
        (tmp_path / "other" / "results.csv").unlink()
    films = [replace(r, when="9999-01-01T00:00:00Z", width=32) for r in old if r.scene == "scene 1"]
    first = [row for row in old if row.scene == "scene 0"]
    assert _newest([*films, *old]) == ([*films, *first], len(films))


def test_results_of_nothing_are_one_line(tmp_path, capfd):
    target = tmp_path / "results.md"
    assert main(["study", "results", str(tmp_path / "none"), "-o", str(target)]) == 2
    assert "there is no such file; run `pssflow study guides" in capfd.readouterr().err
    (tmp_path / "results.csv").write_text("a,b\n1,2\n")
    assert main(["study", "results", str(tmp_path), "-o", str(target)]) == 2
    assert "is no table of this version" in capfd.readouterr().err
    assert not target.exists()


def test_the_viewer_names_the_unit(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "_charts", lambda *_: [])
    done = study(tmp_path, synthetic("none"), scenes=1)
    done.unit = "spp"
    publish(done, done.run(), "synthetic")
    page = (tmp_path / "report.html").read_text()
    data = page.partition('id="data">')[2].partition("</script>")[0]
    assert json.loads(data)["unit"] == "spp"
