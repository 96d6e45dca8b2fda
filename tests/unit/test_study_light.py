"""`pssflow study light`: whole images against Mitsuba's path, by a baseline of its own, and the command."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

import pssflow
from pssflow.cli import main
from pssflow.passes import AllLightPass
from pssflow.reference import reference
from pssflow.study import harness
from pssflow.study.light import NOTES, whole_light
from pssflow.study.methods import PATH, Stage
from pssflow.study.report import publish
from pssflow.study.summary import cells, overall
from tests import scenes
from tests.unit.test_study_guides import study, synthetic

XML = str(Path(__file__).parents[2] / "scenes" / "cornell-box" / "scene.xml")


@pytest.fixture(autouse=True)
def _quick(monkeypatch) -> None:
    monkeypatch.setattr(harness, "flip", lambda image, truth: None)


def test_ratios_are_those_of_the_baseline_asked_for(tmp_path):
    """Half the noise of `path` is a win of four over it; `path` itself has no verdict."""
    methods = synthetic(PATH), synthetic("none", noise=2.0), synthetic("auto", noise=0.5)
    done = study(tmp_path, *methods)
    rows = done.run()
    found = {cell.method: cell for cell in cells(rows, PATH) if cell.time == 4.0}
    verdicts = {name: cell.verdict for name, cell in found.items()}
    assert verdicts == {PATH: "", "none": "loss", "auto": "win"}
    gained = found["auto"].gained
    assert gained is not None
    assert gained.value == pytest.approx(4.0, rel=0.3)
    assert {total.method for total in overall(list(found.values()))} == {"none", "auto"}
    publish(done, rows, "synthetic", baseline=PATH, notes=NOTES)
    text = (tmp_path / "summary.md").read_text()
    assert f"## Summary: {PATH} ÷ the method" in text
    assert f"## Ratios to {PATH}" in text
    assert "random sampling" not in text
    assert (tmp_path / "ratio.svg").is_file()


def test_a_whole_light_is_rendered_for_each_time(llvm_variant, tmp_path):
    """Its mean is that of the reference to the same depth, which is another one than to a smaller depth."""
    scene = pssflow.Scene(scenes.furnace_sphere())
    stage = Stage(scene, lambda variant: scene.mi_scene)
    method = whole_light("any", 4, None, "all to depth 4", guide="none", rr_depth=2)
    shots = method.run(stage, 1, (0.05, 0.5), False)
    assert [shot.time for shot in shots] == [0.05, 0.5]
    assert all(shot.spp > 0 and shot.elapsed > 0.0 for shot in shots)
    truth = [
        reference(
            scene, 2, seconds=0.3, cache=tmp_path, progress=False, all_light=True, max_depth=depth
        )
        for depth in (4, 2)
    ]
    assert truth[0].path != truth[1].path
    assert shots[1].image.mean() == pytest.approx(truth[0].image.mean(), rel=0.08)
    assert truth[0].image.mean() > 1.1 * truth[1].image.mean()
    one = AllLightPass(scene.mi_scene, 0, hide=False, max_depth=2)
    assert one.name.endswith("to depth 2")
    image, *_ = one(1, 16)
    one.restore()
    assert np.mean(image) == pytest.approx(truth[1].image.mean(), rel=0.05)


@pytest.mark.long
def test_the_command(tmp_path, llvm_variant):
    arguments = ["study", "light", XML, "--times", "0.2,0.5", "--seeds", "2", "--pixels", "256"]
    arguments += ["--max-depth", "4", "--reference-time", "0.5", "-o", str(tmp_path), "-q"]
    assert main(arguments) == 0
    with (tmp_path / "results.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {row["method"] for row in rows} == {PATH, "none", "table", "auto", "auto, roulette"}
    assert {row["light"] for row in rows} == {"all to depth 4"}
    assert (tmp_path / "report.html").is_file()
