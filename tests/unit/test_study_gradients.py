"""`pssflow study gradients`: ratios of variances at equal time, what is differentiated, and the command."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from pssflow.cli import main
from pssflow.study.gradients import GradientRow, Measuring, parameters
from pssflow.study.gradients_report import differing, gains, publish
from pssflow.study.store import Store
from tests import scenes

XML = str(Path(__file__).parents[2] / "scenes" / "cornell-box" / "scene.xml")

ROW = GradientRow(
    scene="room",
    scene_hash="",
    method="none",
    seed=0,
    parameter="wall",
    gradient="[]",
    time=1.0,
    elapsed=1.0,
    spp=4,
    light='{"k": 2}',
    width=8,
    height=8,
    load_before=0.0,
    load_after=0.0,
    configuration="",
    commit="",
    version="",
    mitsuba="",
    processor="1 × any",
    when="",
)


SEEDS = 80


def _rows(method: str, noise: float, elapsed: float = 1.0, bias: float = 0.0) -> list[GradientRow]:
    rng = np.random.default_rng(len(method))
    return [
        replace(
            ROW,
            method=method,
            seed=seed,
            parameter=parameter,
            elapsed=elapsed,
            gradient=json.dumps((bias + size * rng.normal(1.0, noise, 3)).tolist()),
        )
        for seed in range(SEEDS)
        for parameter, size in (("wall", 1.0), ("lamp", 100.0))
    ] + [
        replace(ROW, method=method, seed=seed, parameter="unseen", gradient="[0.0]")
        for seed in range(SEEDS)
    ]


def test_a_gain_is_variance_times_seconds():
    """Half the noise in twice the time: a gain of two, whatever a parameter's unit; no gradient, no ratio."""
    rows = [*_rows("none", 0.2), *_rows("better", 0.1, elapsed=2.0), *_rows("same", 0.2)]
    better, same = gains(rows)
    assert set(better.ratios) == {"wall", "lamp"}
    assert better.mean.value == pytest.approx(2.0, abs=4 * better.mean.error)
    assert 0.05 < better.mean.error < 0.3
    assert (better.verdict, same.verdict) == ("win", "tie")
    assert not differing(rows)


def test_gradients_that_differ_are_told(tmp_path):
    rows = [*_rows("none", 0.2), *_rows("off", 0.2, bias=0.3)]
    study = Measuring(tmp_path, [], ["none", "off"], {"k": 2}, 1.0, range(SEEDS))
    shown = publish(study, rows)
    assert any("BIASED? off on room" in str(part) for part in shown)
    assert (tmp_path / "report.html").stat().st_size > 10_000
    assert "| room | wall |" in (tmp_path / "summary.md").read_text()


def test_what_can_be_differentiated(llvm_variant):
    found = parameters(mi.load_dict(scenes.furnace_sphere()))
    assert "room.bsdf.brdf_0.reflectance.value" in found
    assert "lamp.emitter.radiance.value" in found
    assert not any("vertex" in name or "to_world" in name for name in found)
    # Of glass and mirrors none: their derivative is not seen.
    assert not any("specular" in name for name in parameters(mi.load_dict(scenes.glass_room())))


def test_rows_are_read_again(tmp_path):
    store = Store(tmp_path / "results.csv", GradientRow)
    store.put(_rows("none", 0.2)[:2])
    assert Store(tmp_path / "results.csv", GradientRow).rows == store.rows
    (tmp_path / "results.csv").write_text("scene,seed\nroom,0\n")
    with pytest.raises(ValueError, match="is no table of this version"):
        Store(tmp_path / "results.csv", GradientRow)


@pytest.mark.long
def test_the_command(tmp_path, llvm_variant):
    """Three seeds of every method, and nothing is measured twice."""
    arguments = ["study", "gradients", XML, "--time", "0.05", "--seeds", "3", "--pixels", "64"]
    arguments += ["--max-depth", "3", "-o", str(tmp_path)]
    assert main(arguments) == 0
    assert "uniform numbers ÷ the method" in (tmp_path / "summary.md").read_text()
    with (tmp_path / "results.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    methods = {row["method"] for row in rows}
    assert methods == {"none", "table", "auto", "auto, gradient", "prb"}
    assert len(rows) == 3 * len(methods) * len({row["parameter"] for row in rows})
    before = (tmp_path / "results.csv").read_bytes()
    assert main(arguments) == 0
    assert (tmp_path / "results.csv").read_bytes() == before
