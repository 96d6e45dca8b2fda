"""`pssflow study capacity`: gains foretold by held-out paths, how small is enough, and the command."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pssflow
from pssflow import metrics
from pssflow.cli import main
from pssflow.metrics import Estimate
from pssflow.study import capacity, harness
from pssflow.study.capacity import FAMILIES, Family, capacity_methods
from pssflow.study.capacity_report import enough, models
from pssflow.study.predicted import HeldOut
from tests import scenes
from tests.unit.test_study_guides import study, synthetic

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def _quick(monkeypatch) -> None:
    """FLIP takes a quarter of a second an image."""
    monkeypatch.setattr(harness, "flip", lambda image, truth: None)


@pytest.fixture(scope="module")
def room() -> pssflow.Scene:
    """Small, with one lamp: what guides are for."""
    return opened("door-ajar")


def opened(name: str) -> pssflow.Scene:
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    return pssflow.Scene(str(ROOT / "scenes" / name / "scene.xml"), size=(48, 48))


@pytest.mark.parametrize("guide", ["table", "realnvp-logit", "direction-table", "ray-table"])
def test_densities_integrate_to_one(room, guide):
    """Over uniform paths the mean of q is 1, within its own standard error, of all numbers and of the directions'."""
    held = HeldOut.of(room, 2, paths=60_000)
    assert len(held.pilot.u) == pytest.approx(60_000, rel=0.05)
    options = {"epochs": 2} if guide == "realnvp-logit" else {}
    fitted = room.pilot(32, seed=5).fit(guide, **options)
    densities = held.densities(fitted)
    for q in densities:
        assert q.min() >= 0.0
        assert abs(q.mean() - 1.0) <= 5 * q.std() / len(q) ** 0.5
    assert bool(np.any(densities.both != densities.nee)) == ("ray" in fitted.models)


@pytest.mark.parametrize(("name", "least"), [("door-ajar", 1.5), ("leaves", 1.0)])
def test_the_gain_is_one_at_a_of_one_and_what_rendering_shows_elsewhere(name, least):
    """A render from the same guide: its variance is what held-out paths foretell, by the spread of both.

    In `leaves` nearly all variance lies in the BSDF-sampled term.
    """
    room = opened(name)
    held = HeldOut.of(room, 2, paths=400_000)
    fitted = room.pilot(64, seed=5).fit("table")
    assert held.gain(fitted, 1.0) == pytest.approx(1.0)
    foretold = held.gain(fitted, 0.1)
    images: list[list[pssflow.Result]] = [
        [room.render(guide, spp=64, seed=s, progress=False, **options) for s in range(3)]
        for guide, options in (("none", {}), (fitted, {"uniform_fraction": 0.1}))
    ]
    # One scale for both: by each image's own square the darker one, of the worse method, would count more.
    scale = metrics.local_scale(np.mean([r.image for of in images for r in of], axis=0), reach=4)
    variances = [np.mean([r.variance / scale for r in of]) for of in images]
    # Tiles hold what pixels differ by, which no guide removes: foretold gains are on the careful side.
    measured = float(variances[0] / variances[1])
    assert least < foretold < 1.5 * measured
    assert foretold > 0.3 * measured


def test_a_gain_holds_what_the_ray_of_the_last_vertex_gains():
    """In `courtyard` renders of 64 spp show 1.37 times the gain with `ray-table`."""
    room = opened("courtyard")
    held, pilot = HeldOut.of(room, 2, paths=400_000), room.pilot(64, seed=5)
    without = pilot.fit("direction-table+emitter-table+light-table")
    assert held.gain(pilot.fit("table"), 0.1) > 1.15 * held.gain(without, 0.1)


def test_a_black_scene_foretells_nothing(llvm_variant):
    description = scenes.furnace_sphere()
    scene = pssflow.Scene(description)
    pilot = scene.pilot(1, seed=1)
    fitted = scene.pilot(8, seed=2).fit("direction-table")
    black = replace(pilot, f_nee=np.zeros_like(pilot.f_nee), f_bsdf=np.zeros_like(pilot.f_bsdf))
    assert np.isnan(HeldOut(black, 2).gain(fitted, 0.5))


SIZES = Family("size", "table", "depth", (1, 2, 3))


def test_the_smallest_model_near_the_best_is_enough(tmp_path):
    """Noise .5, .25, .245 of random sampling's: the second is enough, the first is not, and none at all is far off."""
    noises = {SIZES.label(v): n for v, n in zip(SIZES.values, (0.5, 0.25, 0.245), strict=True)}
    methods = [synthetic("none"), *(synthetic(name, noise=n) for name, n in noises.items())]
    done = study(tmp_path, *methods, scenes=1)
    rows = [
        replace(row, parameters=10 ** int(row.method[-1]) if row.method != "none" else None)
        for row in done.run()
    ]
    found = models(rows, [SIZES], 4.0)
    assert [(m.cell.method, m.parameters) for m in found] == [
        ("none", 0), ("size 1", 10), ("size 2", 100), ("size 3", 1000)
    ]  # fmt: skip
    first, alone = enough(found, [SIZES], "s")
    assert "enough, within 10 % of it, is size 2 (100 parameters)" in first
    assert "enough is size 2 (100 parameters)" in alone
    # With errors as large as the differences, what is smaller is not told from it, and that is said.
    vague = [replace(m, cell=replace(m.cell, work=Estimate(m.cell.work.value, 9.0))) for m in found]
    assert "do not tell random numbers (no parameters) from it" in enough(vague, [SIZES], "s")[0]


def test_every_model_is_a_method_with_its_options():
    methods = capacity_methods(2, None, "s")
    assert len({method.name for method in methods}) == len(methods)
    assert len(methods) == 1 + sum(len(family.values) for family in FAMILIES)
    depth = next(method for method in methods if method.name == "table depth 2")
    assert depth.options == {"guide": "table", "depth": 2}


@pytest.mark.usefixtures("llvm_variant")
def test_the_command_renders_and_resumes(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    few = (
        Family("table depth", "table", "depth", (0, 2)),
        Family("flow", "realnvp-logit", "couplings", (1,)),
    )
    monkeypatch.setattr(capacity, "FAMILIES", few)
    monkeypatch.setattr(capacity.capacity_methods, "__defaults__", (few,))
    command = ["study", "capacity", "scenes/cornell-box", "--spp", "8", "--seeds", "2"]
    command += ["--pixels", "256", "--reference-time", "0.5", "-o", str(tmp_path / "study")]
    assert main(command) == 0, capfd.readouterr().err
    out, _ = capfd.readouterr()
    assert "cornell-box: the least error at equal samples is that of" in out
    with (tmp_path / "study" / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["method"] for row in rows} == {"none", "table depth 0", "table depth 2", "flow 1"}
    learned = [row for row in rows if row["method"] != "none"]
    assert all(int(row["parameters"]) > 0 for row in learned)
    assert all(float(row["predicted_gain"]) > 0.0 for row in learned)
    assert (tmp_path / "study" / "capacity-cornell-box.png").stat().st_size > 5_000
    assert (tmp_path / "study" / "report.html").stat().st_size > 10_000
    assert main(command) == 0
    assert "reference" not in capfd.readouterr().err  # nothing was left to do
    assert main(["study", "capacity", "-o", str(tmp_path / "no")]) == 2
    assert main([*command[:3], "--time", "1", "--spp", "8"]) == 2
    assert "were both given" in capfd.readouterr().err
