"""The studies' harness: on synthetic methods it finds what was planted; the command runs, resumes and stops cleanly."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pssflow import metrics
from pssflow.cli import main
from pssflow.reference import Reference
from pssflow.study.harness import Case, Method, Scenery, Shot, Study
from pssflow.study.report import biased, publish
from pssflow.study.store import Row, Store
from pssflow.study.summary import Cell, cells, choices, overall

ROOT = Path(__file__).parents[2]
TRUTH = np.full((64, 64, 3), 2.0, np.float32)
NOISE, PER_SECOND = 1.0, 8
"""Standard deviation of a sample, and samples a pixel in a second."""


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
    assert len(Store(tmp_path / "results.csv").rows) == 8
    assert published == [6, 8]
    rows = study(tmp_path, counted(synthetic("none")), scenes=2).run()
    assert len(calls) == 6
    assert len(rows) == 12
    other = replace(counted(synthetic("none")), options={"epochs": 7})
    rows = study(tmp_path, other, scenes=2).run()
    assert len(calls) == 12
    assert len(rows) == 12
    assert not list(tmp_path.glob("**/*.part"))


def test_rows_come_back_as_they_were(tmp_path):
    rows = study(tmp_path, synthetic("none"), scenes=1, seeds=1).run()
    assert Store(tmp_path / "results.csv").rows == rows
    (tmp_path / "results.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match="is no table of this version"):
        Store(tmp_path / "results.csv")
    with pytest.raises(ValueError, match="column `scene` is missing"):
        Row.parse({})


def test_tables_and_charts_are_written(tmp_path):
    done = study(tmp_path, synthetic("none"), synthetic("better", noise=0.5))
    shown = publish(done, done.run(), "synthetic")
    text = (tmp_path / "summary.md").read_text()
    assert "| scene 0 | better |" in text
    assert "load average" in text
    for name in ("error.png", "error.svg", "ratio.png", "ratio.svg"):
        assert (tmp_path / name).stat().st_size > 5_000
    assert shown[-1].startswith("wrote ")


@pytest.mark.usefixtures("llvm_variant")
def test_the_command_renders_and_resumes(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    command = ["study", "guides", "scenes/cornell-box", "--guides", "none,table"]
    command += ["--times", "0.1,0.2", "--seeds", "2", "--pixels", "256", "--reference-time", "0.5"]
    command += ["-o", str(tmp_path / "study")]
    assert main(command) == 0, capfd.readouterr().err
    with (tmp_path / "study" / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 2 * 2
    assert {row["time"] for row in rows} == {"0.1", "0.2"}
    assert all(float(row["seconds_render"]) >= 0.0 and row["commit"] for row in rows)
    capfd.readouterr()
    assert main(command) == 0
    _, err = capfd.readouterr()
    assert "reference" not in err  # nothing was left to do
    for wrong, message in (
        (["--times", "3,1"], "expected increasing seconds"),
        (["nowhere.xml"], "there is no such file, and no scene of that name"),
        (["--guides", "nonsense"], "is unknown"),
    ):
        assert main(["study", "guides", "-o", str(tmp_path / "no"), *wrong]) == 2
        assert message in capfd.readouterr().err
