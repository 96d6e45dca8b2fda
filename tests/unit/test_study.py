"""`make demo` and `make bench` run, on small films, and write what they promise."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from pssflow.study import scaling
from pssflow.study.bench import bench
from pssflow.study.bench_guides import GUIDES, kernels
from pssflow.study.coverage import KINDS, coverage, document
from pssflow.study.demo import METHODS, THESIS, demo
from pssflow.terminal import run_command

ROOT = Path(__file__).parents[2]


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    """No reference of an earlier run, and none left in the user's cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_demo(cache, llvm_variant, tmp_path, capfd):
    folder = tmp_path / "demo"
    scene = ROOT / "scenes" / "teapot" / "scene.xml"
    arguments = ["-o", folder, "--scene", scene, "--scale", "0.125", "--reference-time", "1"]
    assert run_command(demo, [str(a) for a in arguments]) == 0
    out, err = capfd.readouterr()
    for both in THESIS.values():
        assert all(f"{share:.2f} %" in out for share in both)
    assert f"Look at {folder / 'demo.png'}" in out
    assert "Traceback" not in err

    record = json.loads((folder / "results.json").read_text())
    methods = {method.name: method for method in METHODS}
    assert len(record["runs"]) == len(THESIS) * len(METHODS)
    for run in record["runs"]:
        # Equal spp where it is claimed, and never more than Table 2 has.
        pixels = 32 * 32
        spent = run["camera_rays"] + run["pilot"]["camera_rays"]
        assert spent == pixels * (16 if run["method"] == "none-16" else 32)
        assert run["emitter_strategy"] == "nee"
        assert run["guide"] == methods[run["method"]].guide
        assert (folder / f"{run['parametrisation']}-{run['method']}.exr").exists()
    assert (folder / "demo.png").stat().st_size > 10_000
    assert (folder / "reference.exr").exists()


def test_bench(llvm_variant, tmp_path, monkeypatch, capfd):
    """Every key of the record and every table, the kernels' part from a program that writes what `guide_cost` does."""
    monkeypatch.chdir(ROOT)
    fused = {"sample_us": 0.5, "sample_share_of_peak": 0.75, "cost_ratio_of_the_registry": 0.25}
    told = {
        "peak": {"gflops_per_core": 100.0, "instructions": "avx2"},
        "guides": dict.fromkeys(GUIDES, fused),
        "training": {
            "rows": 2000,
            "realnvp": {"1": 2.0, "1_processor": None, "2": 1.0, "scaling": 2.0},
        },
    }
    program = tmp_path / "guide_cost"
    program.write_text(f"#!/bin/sh\ncat > $2 <<'END'\n{json.dumps(told)}\nEND\n")
    program.chmod(0o755)
    arguments = ["-o", tmp_path, "--scenes", "scenes/cornell-box", "--side", "32", "--spp", "1"]
    arguments += ["--rounds", "1", "--kernels", program, "--rows", "2000"]
    assert run_command(bench, [str(a) for a in arguments]) == 0, capfd.readouterr().err
    out, _ = capfd.readouterr()
    for text in ("load average", "× the time of its rays", "avx2", "75%", "2.000"):
        assert text in out
    record = json.loads((tmp_path / "bench.json").read_text())
    keys = "machine peak rays mitsuba scenes guides training"
    assert record.keys() >= set(keys.split())
    assert record["guides"].keys() == set(GUIDES)
    assert record["peak"] == told["peak"]
    assert record["training"] == told["training"]
    for name in ("realnvp", "direction-table", "mixture-net"):
        row = record["guides"][name]
        assert row["sample_us"] == 0.5
        assert row["added"]["share"] > -1
    # The direction's, the emitter's, the light's and the ray's table.
    assert record["guides"]["table"]["cost_ratio_of_the_registry"] == 4 * 0.25
    scene = record["scenes"]["scenes/cornell-box"]
    for threads in ("1", "2"):
        rows = {name: row for name, row in scene[threads].items() if name != "ratios"}
        assert rows.keys() == {
            "pssflow, mis", "pssflow, nee", "mis, its rays alone", "Mitsuba scalar_rgb", "Mitsuba llvm_ad_rgb",
        }  # fmt: skip
        assert all(row["paths_per_second"] > 0 for row in rows.values())
        # A path of k = 2 has at most three rays to surfaces and two to emitters.
        assert all(1 <= row["rays_per_path"] <= 5 for row in rows.values())
        ours, alone = rows["pssflow, mis"]["seconds"], rows["mis, its rays alone"]["seconds"]
        assert scene[threads]["ratios"]["over_rays"] == pytest.approx(ours[0] / alone[0])
        assert record["rays"]["scenes/cornell-box"][threads] == rows["mis, its rays alone"]
    assert set(record["mitsuba"]) == {"scalar_rgb", "llvm_ad_rgb"}

    assert run_command(bench, ["--scenes", "nowhere", "-o", str(tmp_path)]) == 2
    assert "there is no scene 'nowhere'" in capfd.readouterr().err
    with pytest.raises(RuntimeError, match="cannot be run"):
        kernels(str(tmp_path / "missing"), 1, print)
    with pytest.raises(RuntimeError, match="wrote no figures"):
        kernels("true", 1, print)


def test_scaling(tmp_path, capfd):
    """A row for each value of an axis and a chart; what grows too fast is said, what does not is not."""
    arguments = ["-o", str(tmp_path), "--axes", "emitters,spp", "--most", "4", "--rounds", "1"]
    assert run_command(scaling.scaling, arguments) == 0, capfd.readouterr().err
    with (tmp_path / "scaling.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["axis"], row["value"]) for row in rows] == [
        ("emitters", "1"), ("spp", "1"), ("spp", "4"),
    ]  # fmt: skip
    assert all(float(row["us_per_path"]) > 0 and float(row["held_mib"]) > 0 for row in rows)
    assert (tmp_path / "scaling.png").stat().st_size > 10_000

    def row(axis, value, us_per_path=1.0, over_rays=2.0, render_s=1.0):
        row = {"axis": axis, "value": value, "render_s": render_s}
        return row | {"us_per_path": us_per_path, "over_rays": over_rays}

    rows = [row("emitters", 1), row("emitters", 10, over_rays=2.5)]
    rows.append(row("emitters", 100, over_rays=3.0))
    assert [text.split(":")[0] for text in scaling.judge("emitters", rows)] == ["emitters = 100"]
    rows = [row("spp", 1, us_per_path=0.1, render_s=1e-3), row("spp", 4), row("spp", 16)]
    assert scaling.judge("spp", rows) == []


def test_coverage(llvm_variant, tmp_path, monkeypatch, capfd):
    """One scene's row, its findings kept; the document says its machine, and what was met and what was not."""
    monkeypatch.chdir(ROOT)
    monkeypatch.delenv("PSSFLOW_SCENES", raising=False)
    output, work = tmp_path / "coverage.md", tmp_path / "work"
    arguments = ["-o", output, "--work", work, "--scenes", "scenes/cornell-box"]
    arguments += ["--effort", "0.02", "--rounds", "1"]
    assert run_command(coverage, [str(a) for a in arguments]) == 0, capfd.readouterr().err
    text = output.read_text()
    assert "| scenes/cornell-box |" in text
    assert "3 of 3 comparisons agree" in text
    for told in ("commit", "cores", "load average", "≥ 1.4", "≥ 3", "target of 3"):
        assert told in text
    found = json.loads((work / "scenes-cornell-box.json").read_text())
    assert found["parity"]["2"]["without_power"] == 0
    assert found["shares"]["2"] == pytest.approx(0.248, rel=0.05)
    assert 0 < found["speed"]["over scalar_rgb"] < 100
    assert run_command(coverage, ["--scenes", "nowhere", "-o", str(output)]) == 2
    assert "there is no scene 'nowhere'" in capfd.readouterr().err


def test_a_scene_that_fails_is_one_row():
    """Neither the table nor the sums stumble over it, or over what could not be tested."""
    test = {"p": None, "tiles": 12, "without_power": 12, "ratio": None, "ratio_se": None}
    row = {"scene": "dark", "triangles": 1, "held_bytes": 1, "peak_bytes": 1, "shares": {}}
    row |= {"timings": {"load": 0, "export": 0, "bvh": 0}, "parity": dict.fromkeys("123", test)}
    row |= {"speed": {"ours": 1e6, "rays": 2e6}, "features": {key: {"area": 2} for key in KINDS}}
    state = {"effort": 1.0, "rounds": 1, "threads": 1, "commit": "abc", "command": "x"}
    state |= {"before": (0, 0, 0), "after": (0, 0, 0), "seconds": 1.0}
    text = document([{"scene": "broken", "failed": "not done after 1 s"}, row], state)
    assert "| broken | **not done after 1 s** |" in text
    assert "0 of 0 comparisons agree, 3 have no power at all; 36 of 36 tiles have none." in text
