"""The studies' harness: on synthetic methods it finds what was planted; the command runs, resumes and stops cleanly."""

from __future__ import annotations

import csv
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from pssflow import metrics
from pssflow.cli import main
from pssflow.reference import Reference, read_exr
from pssflow.study import harness, report
from pssflow.study.harness import Case, Method, Scenery, Shot, Study
from pssflow.study.report import biased, publish
from pssflow.study.store import Row, Store, parse
from pssflow.study.summary import Cell, cells, choices, overall, reaches, time_to_reach

ROOT = Path(__file__).parents[2]
TRUTH = np.full((64, 64, 3), 2.0, np.float32)
NOISE, PER_SECOND = 1.0, 8
"""Standard deviation of a sample, and samples a pixel in a second."""


@pytest.fixture(autouse=True)
def _quick(request, monkeypatch) -> None:
    """FLIP takes a quarter of a second an image, charts some seconds; the tests that are about them do without this."""
    if "slowly" in request.fixturenames:
        return
    monkeypatch.setattr(harness, "flip", lambda image, truth: float(np.abs(image - truth).mean()))
    monkeypatch.setattr(report, "_charts", lambda *_: [])


@pytest.fixture
def slowly() -> None:
    """As it is: with charts."""


def truth() -> Reference:
    rng = np.random.default_rng(7)
    variance = np.full_like(TRUTH, 1e-4)
    image = TRUTH + rng.normal(0.0, 1e-2, TRUTH.shape).astype(np.float32)
    return Reference(image, variance, passes=0, spp=0, seconds=1.0, note="synthetic")


def synthetic(name: str, *, noise: float = 1.0, speed: float = 1.0, bias: float = 0.0) -> Method:
    """Normal noise about the truth, or about something else: variance noise² ÷ samples."""

    def run(scene, seed, times, progress):
        rng = np.random.default_rng([seed, *name.encode()])
        shots, total, n = [], np.zeros(TRUTH.shape), 0
        for time in times:
            more = round(time * PER_SECOND * speed) - n
            total += rng.normal(0.0, noise * NOISE * np.sqrt(more), TRUTH.shape)
            n += more
            image = (TRUTH + bias + total / n).astype(np.float32)
            variance = np.full_like(TRUTH, (noise * NOISE) ** 2 / n)
            shots.append(Shot(time, time, image, variance, n, chosen=name))
        return shots

    return Method(name, run)


def study(folder: Path, *methods: Method, scenes: int = 2, seeds: int = 3) -> Study:
    case = Case(digest="flat", scene=None, truth=truth)
    return Study(
        folder=folder,
        sceneries=[Scenery(f"scene {i}", lambda: case) for i in range(scenes)],
        methods=methods,
        times=(1.0, 4.0),
        seeds=range(seeds),
        settings={"k": 2, "emitter_strategy": "mis", "threads": 1},
    )


def by_method(found: list[Cell], time: float = 4.0) -> dict[str, Cell]:
    return {cell.method: cell for cell in found if (cell.scene, cell.time) == ("scene 0", time)}


def test_a_better_method_comes_out_better_within_its_band(tmp_path):
    """Half the noise at half the speed: 4 times per path, twice at equal time; and the other way round."""
    better = synthetic("better", noise=0.5, speed=0.5)
    worse = synthetic("worse", noise=1.0, speed=0.5)
    done = study(
        tmp_path, synthetic("none"), better, worse, synthetic("auto", noise=0.5, speed=0.5)
    )
    rows = done.run()
    found = by_method(cells(rows))
    for name, gain, equal_time, verdict in (("better", 4, 2, "win"), ("worse", 1, 0.5, "loss")):
        cell = found[name]
        assert cell.gain is not None
        assert cell.equal_time is not None
        assert cell.cost is not None
        assert cell.gain.value == pytest.approx(gain, rel=1e-3)
        assert cell.cost.value == pytest.approx(2.0)
        # Five standard errors of the estimate itself; three seeds know it only roughly, hence the 2 %.
        assert (
            abs(cell.equal_time.value - equal_time) < 5 * cell.equal_time.error + 0.02 * equal_time
        )
        assert cell.verdict == verdict
        # σ² ÷ (r² + (0.1 r)²) ÷ n
        n = 4 * PER_SECOND * 0.5
        sigma = {"better": 0.25, "worse": 1.0}[name]
        assert cell.relmse.value == pytest.approx(sigma / n / (4 + 0.04), rel=0.03)
    totals = {o.method: o for o in overall(cells(rows)) if o.time == 4.0}
    assert (totals["better"].wins, totals["worse"].losses) == (2, 2)
    assert totals["better"].mean.value == pytest.approx(2.0, rel=0.03)
    picked = choices(cells(rows))
    assert len(picked) == 4
    assert all(choice.close and choice.best == "better" for choice in picked)
    assert not biased(done, rows)


def test_a_bad_choice_is_told(tmp_path):
    rows = study(tmp_path, synthetic("none"), synthetic("auto", noise=1.5)).run()
    assert [choice.close for choice in choices(cells(rows))] == [False] * 4


def test_a_competitor_is_no_candidate(tmp_path):
    """`auto` could not have chosen Mitsuba, however good that is."""
    fast = synthetic("mitsuba-llvm", noise=0.1)
    rows = study(tmp_path, synthetic("none"), synthetic("auto"), fast, scenes=1).run()
    (choice, _) = choices(cells(rows), competitors=["mitsuba-llvm"])
    assert choice.best == "none"
    assert {c.best for c in choices(cells(rows))} == {"mitsuba-llvm"}


def test_the_same_seeds_give_the_same_rows_but_for_times(tmp_path):
    own = {"elapsed", "when", "load_before", "load_after", "reference_seconds"}
    tables = []
    for name in ("a", "b"):
        rows = study(tmp_path / name, synthetic("none"), synthetic("better", noise=0.5)).run()
        tables.append([{k: v for k, v in asdict(row).items() if k not in own} for row in rows])
    assert tables[0] == tables[1]


def test_a_crowded_machine_is_told(tmp_path):
    done = study(tmp_path, synthetic("none"), scenes=1, seeds=1)
    rows = [replace(row, load_before=1000.0) for row in done.run()]
    assert any(str(line).startswith("CROWDED") for line in publish(done, rows, "synthetic"))


def test_a_planted_bias_is_flagged(tmp_path):
    """A tenth of the noise of the longest run is enough, and its relMSE lies above its own variance."""
    offset = 0.3 * NOISE / np.sqrt(4 * PER_SECOND)
    done = study(tmp_path, synthetic("none"), synthetic("biased", bias=offset), scenes=1)
    rows = done.run()
    (line,) = biased(done, rows)
    assert line.startswith("BIASED? biased on scene 0")
    floor = done.floors()["scene 0", "biased"]
    assert abs(floor.value - offset**2 / 4.04) < 5 * floor.error
    clean = done.floors()["scene 0", "none"]
    assert abs(clean.value) < 5 * clean.error


def test_the_floor_needs_two_images_of_one_size():
    with pytest.raises(ValueError, match="two or more seeds"):
        metrics.floor([TRUTH], TRUTH)
    with pytest.raises(ValueError, match="has shape"):
        metrics.floor([TRUTH, TRUTH[:8]], TRUTH)


def test_finished_runs_are_kept_and_not_run_again(tmp_path):
    """Ctrl-C in the middle, then the rest; another option or core would run anew."""
    calls: list[int] = []

    def counted(method: Method, stop: int | None = None) -> Method:
        def run(scene, seed, times, progress):
            if len(calls) == stop:
                raise KeyboardInterrupt
            calls.append(seed)
            return method.run(scene, seed, times, progress)

        return replace(method, run=run)

    published: list[int] = []
    first = study(tmp_path, counted(synthetic("none"), stop=4), scenes=2)
    first.publish = lambda rows: published.append(len(rows))
    with pytest.raises(KeyboardInterrupt):
        first.run()
    assert len(Store(tmp_path / "results.csv", Row).rows) == 8
    assert published == [6, 8]
    rows = study(tmp_path, counted(synthetic("none")), scenes=2).run()
    assert len(calls) == 6
    assert len(rows) == 12
    other = replace(counted(synthetic("none")), options={"epochs": 7})
    rows = study(tmp_path, other, scenes=2).run()
    assert len(calls) == 12
    assert len(rows) == 12
    assert not list(tmp_path.glob("**/*.part"))


@pytest.mark.parametrize("setting", ["settings", "digest", "times"])
def test_a_resumed_study_shows_rows_of_its_own_settings_only(tmp_path, setting):
    """With another reference, an edited scene or other times, kept rows are no longer this study's."""
    first = study(tmp_path, synthetic("none"), synthetic("better", noise=0.5), scenes=1)
    assert len(first.run()) == 12
    other = study(tmp_path, synthetic("none"), synthetic("better", noise=0.5), scenes=1)
    if setting == "settings":
        other.settings = {**other.settings, "reference_time": 600.0}
    elif setting == "times":
        other.times = (1.0, 4.0, 8.0)
    else:
        case = Case(digest="edited", scene=None, truth=truth)
        other.sceneries = [Scenery("scene 0", lambda: case)]
    if setting != "digest":  # only an opened scene says what it is
        assert other.rows == []

    def stop(scene, seed, times, progress):
        raise KeyboardInterrupt

    other.methods = [other.methods[0], replace(other.methods[1], run=stop)]
    published: list[Row] = []
    other.publish = published.extend
    with pytest.raises(KeyboardInterrupt):
        other.run()
    assert {row.method for row in published} == {"none"}
    assert {row.seed for row in published} == {0}
    # Nothing else was thrown away: the first study still finds what it did not share.
    kept = study(tmp_path, synthetic("none"), synthetic("better", noise=0.5), scenes=1)
    assert {row.method for row in kept.rows} == {"none", "better"}


def test_a_scene_without_a_reference_is_left_out_with_a_line(tmp_path):
    def fails() -> Reference:
        raise RuntimeError("no plugin of that name\nand more")

    done = study(tmp_path, synthetic("none"), scenes=2)
    broken = Case(digest="broken", scene=None, truth=fails)
    done.sceneries = [Scenery("broken", lambda: broken), *done.sceneries]
    told: list[str] = []
    done.say = told.append
    rows = done.run()
    assert {row.scene for row in rows} == {"scene 0", "scene 1"}
    assert done.failures == {"broken": "no plugin of that name and more"}
    assert "broken is left out: no plugin of that name and more" in told
    lines = publish(done, rows, "synthetic")
    assert "left out: broken: no plugin of that name and more" in lines


def test_a_method_that_fails_does_not_end_the_study(tmp_path):
    def fails(scene, seed, times, progress):
        raise ValueError("it cannot")

    done = study(tmp_path, synthetic("none"), Method("broken", fails), scenes=1)
    assert {row.method for row in done.run()} == {"none"}
    assert done.failures == {"broken on scene 0": "it cannot"}


def test_a_method_without_an_image_yet_says_so(tmp_path):
    """It has a row, so that nobody waits for it again, but no point in a chart and no cell in a table."""
    whole = synthetic("slow")
    slow = replace(whole, run=lambda *a: [s for s in whole.run(*a) if s.time > 1.0])
    never = Method("never", lambda *a: [])
    done = study(tmp_path, synthetic("none"), slow, never, scenes=1)
    rows = done.run()
    assert len(rows) == 3 * 3 * 2
    assert {(c.method, c.time) for c in cells(rows)} == {
        ("none", 1.0), ("none", 4.0), ("slow", 4.0)
    }  # fmt: skip
    lines = publish(done, rows, "synthetic")
    assert "no image yet: never on scene 0 at 1, 4 s" in lines
    assert "no image yet: slow on scene 0 at 1 s" in lines
    calls: list[int] = []
    again = study(tmp_path, synthetic("none"), slow, scenes=1)
    again.methods = [*again.methods, replace(never, run=lambda *a: calls.append(1) or [])]
    again.run()
    assert not calls


def test_a_study_of_methods_without_any_image_is_published(tmp_path):
    never = Method("never", lambda *a: [])
    done = study(tmp_path, never, scenes=1)
    lines = publish(done, done.run(), "synthetic")
    assert "no image yet: never on scene 0 at 1, 4 s" in lines
    assert lines[-1].startswith("wrote ")


def test_every_film_has_a_truth_of_its_own(tmp_path):
    """Another size under the same name, stopped at its first run: kept rows are shown with their own truth."""
    first = study(tmp_path, synthetic("none"), scenes=1)
    rows = first.run()
    before = first.floors()
    small = replace(truth(), image=truth().image[:32] + 1.0, variance=truth().variance[:32])
    other = study(tmp_path, synthetic("none"), scenes=1)
    case = Case(digest="flat", scene=None, truth=lambda: small)
    other.sceneries = [Scenery("scene 0", lambda: case)]
    other.settings = {**other.settings, "pixels": 2048}

    def stop(scene, seed, times, progress):
        raise KeyboardInterrupt

    other.methods = [replace(synthetic("none"), run=stop)]
    with pytest.raises(KeyboardInterrupt):
        other.run()
    assert first.floors() == before
    assert read_exr(first.reference_path(rows[0])).image.shape == TRUTH.shape
    publish(first, rows, "synthetic")


@pytest.mark.parametrize(
    ("target", "floor", "expected"),
    [
        (0.5, 0.0, 2.0),  # slope −1: half the error after twice the time
        (0.1, 0.0, 10.0),
        (1.0, 0.0, 1.0),
        (2.0, 0.0, "< 1 s"),
        (0.05, 0.0, "> 10 s"),
        (0.05, 0.06, "below the noise"),
        (0.15, 0.12, None),
    ],
)
def test_the_time_to_an_error_is_read_from_a_line_on_logarithmic_axes(target, floor, expected):
    """Nothing is extrapolated, nothing read below the reference's noise."""
    points = [(10.0, 0.1), (1.0, 1.0), (3.0, 1 / 3)]
    seconds, bound = time_to_reach(points, target, floor)
    if isinstance(expected, str):
        assert (seconds, bound) == (None, expected)
    elif expected is not None:
        assert seconds == pytest.approx(expected)
    else:  # between the last two, drawn to the floor and no further
        assert seconds is not None
        assert 3.0 < seconds < 10.0
    assert time_to_reach([], 1.0, 0.0) == (None, "no image")


def test_a_method_of_half_the_variance_is_there_in_half_the_time(tmp_path):
    done = study(tmp_path, synthetic("none"), synthetic("better", noise=0.5**0.5), scenes=1)
    found = {(r.method, r.target): r for r in reaches(cells(done.run()))}
    last = min(target for _, target in found)
    base, better = found["none", last].seconds, found["better", last].seconds
    assert base is not None
    assert better is not None
    assert base / better == pytest.approx(2.0, rel=0.05)


def test_rows_come_back_as_they_were(tmp_path):
    rows = study(tmp_path, synthetic("none"), scenes=1, seeds=1).run()
    assert Store(tmp_path / "results.csv", Row).rows == rows
    (tmp_path / "results.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match="is no table of this version"):
        Store(tmp_path / "results.csv", Row)
    with pytest.raises(ValueError, match="column `scene` is missing"):
        parse(Row, {})


def test_tables_and_charts_are_written(tmp_path, slowly):
    done = study(tmp_path, synthetic("none"), synthetic("better", noise=0.5))
    shown = publish(done, done.run(), "synthetic")
    text = (tmp_path / "summary.md").read_text()
    assert "| scene 0 | better |" in text
    assert "## Time to an error" in text
    assert "load average" in text
    for name in ("error", "error-trimmed", "mape", "flip", "ratio"):
        for kind in ("png", "svg"):
            assert (tmp_path / f"{name}.{kind}").stat().st_size > 5_000
    assert shown[-1].startswith("wrote ")


@pytest.mark.usefixtures("llvm_variant")
@pytest.mark.parametrize(
    ("name", "methods"),
    [("guides", "none,table"), ("speed-accuracy", "none,mitsuba-llvm,python-vegas")],
)
def test_the_command_renders_and_resumes(tmp_path, monkeypatch, capfd, name, methods):
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    command = ["study", name, "scenes/cornell-box", "--guides", methods]
    command += ["--times", "0.1,0.2", "--seeds", "2", "--pixels", "256", "--reference-time", "0.5"]
    command += ["-o", str(tmp_path / "study")]
    assert main(command) == 0, capfd.readouterr().err
    with (tmp_path / "study" / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == (1 + methods.count(",")) * 2 * 2
    assert {row["method"] for row in rows} == set(methods.split(","))
    assert {row["time"] for row in rows} == {"0.1", "0.2"}
    assert all(row["commit"] and row["budget"] for row in rows)
    assert all(float(row["seconds_render"]) >= 0.0 for row in rows if int(row["spp"]))
    passes = [row for row in rows if row["method"] == "mitsuba-llvm" and int(row["spp"])]
    assert all(float(row["elapsed"]) <= float(row["time"]) for row in passes)
    assert (tmp_path / "study" / "report.html").stat().st_size > 10_000
    capfd.readouterr()
    assert main(command) == 0
    _, err = capfd.readouterr()
    assert "reference" not in err  # nothing was left to do
    for wrong, message in (
        (["--times", "3,1"], "expected increasing seconds"),
        (["nowhere.xml"], "there is no such file, and no scene of that name"),
        (["--guides", "nonsense"], "is unknown"),
    ):
        assert main(["study", name, "-o", str(tmp_path / "no"), *wrong]) == 2
        assert message in capfd.readouterr().err
