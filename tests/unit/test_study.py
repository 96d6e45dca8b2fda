"""`make demo` and `make bench` run, on small films, and write what they promise."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pssflow.study.bench import bench
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


def test_bench(llvm_variant, tmp_path, capfd):
    arguments = ["-o", tmp_path, "--scenes", ROOT / "scenes", "--scale", "0.125", "--spp", "1"]
    assert run_command(bench, [str(a) for a in [*arguments, "--rounds", "1"]]) == 0
    out, _ = capfd.readouterr()
    assert "load average" in out
    record = json.loads((tmp_path / "bench.json").read_text())
    for scene in ("cornell-box", "teapot"):
        for threads in (1, 2):
            rows = {
                row["contestant"]: row
                for row in record["rows"]
                if (row["scene"], row["threads"]) == (scene, threads)
            }
            assert rows.keys() == {
                "pssflow, mis", "pssflow, nee", "mis, its rays alone", "Mitsuba scalar_rgb", "Mitsuba llvm_ad_rgb",
            }  # fmt: skip
            assert all(row["paths_per_second"] > 0 for row in rows.values())
            # A path of k = 2 has at most three rays to surfaces and two to emitters.
            assert all(1 <= row["rays_per_path"] <= 5 for row in rows.values())
