"""The numbers that say whether a render's variance can be believed: right where the truth is known, the same always."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import pssflow
from pssflow.study.stability.parts import room
from tests.conftest import ROOT, SCALAR

pytestmark = pytest.mark.timeout(300)

GUIDES: dict[str, dict[str, Any]] = {
    "none": {},
    "table": {},
    "vegas": {},
    "realnvp-logit": {"epochs": 2, "samples": 2048},
    "mixture-net": {"epochs": 2},
    "spline-net": {"epochs": 2},
    "auto": {},
}


def _render(guide: str, *, threads: int = 1, **options: Any) -> pssflow.Result:
    mi.set_variant(SCALAR)
    how = {"spp": 64, "seed": 5, **options}
    return pssflow.render(room(40), guide, threads=threads, progress=False, **how)


@pytest.mark.parametrize("guide", GUIDES)
def test_diagnostics_are_the_same_on_any_number_of_threads(guide: str) -> None:
    """Bit for bit, image and numbers, on 1, 2, 3 and 7 threads; 40² pixels are several tiles and chunks."""
    first, *others = (_render(guide, threads=n, **GUIDES[guide]) for n in (1, 2, 3, 7))
    for other in others:
        assert np.array_equal(first.image, other.image)
        assert first.stats["diagnostics"] == other.stats["diagnostics"]


@pytest.mark.parametrize("guide", ["table", "vegas", "mixture-net"])
def test_the_mean_weight_is_one(guide: str) -> None:
    """E[1/m] = 1 where the guide's densities are those it draws with: 100,000 paths, five standard errors.

    1/m lies between 0 and 1/a, so that its variance is at most (1/a − 1).
    """
    result = _render(guide, **GUIDES[guide])
    found = result.stats["diagnostics"]
    error = np.sqrt((1 / result.stats["a"] - 1) / result.stats["camera_rays"])
    assert abs(found["mean_weight"] - 1) < 5 * error, found["mean_weight"]
    assert found["max_weight"] <= 1 / result.stats["a"] * (1 + 1e-5)
    moment = found["second_moment"]
    assert moment["uniform_pool"]["value"] > 0
    assert moment["guide"]["value"] > 0


def test_random_numbers_have_no_weight_and_no_pool() -> None:
    found = _render("none").stats["diagnostics"]
    assert (found["mean_weight"], found["max_weight"]) == (1.0, 1.0)
    for name in ("second_moment", "means", "mass_outside", "outside_share"):
        assert found[name] is None, name
    assert found["pareto_k"] < 0.5
    assert found["warnings"] == []


def test_the_brightest_pixels_are_those_of_the_image() -> None:
    result = _render("none", spp=4)
    found = result.stats["diagnostics"]
    luminance = np.sort(result.image.astype(np.float64) @ [0.212671, 0.715160, 0.072169], axis=None)
    assert found["brightest_pixels"] == 2
    expected = luminance[-2:].sum() / luminance.sum()
    assert found["brightest_share"] == pytest.approx(expected, rel=1e-5)


def test_a_flow_that_leaves_the_cube_is_told() -> None:
    """The thesis' prior: the share of its paths that is lost is the one that it knows of, within five errors."""
    result = _render("realnvp", preset="thesis", epochs=2, samples=2048)
    found = result.stats["diagnostics"]
    lost, drawn = found["outside_share"], result.stats["camera_rays"]
    assert lost > 0.01
    error = np.sqrt(lost * (1 - lost) / drawn) + 0.005
    assert abs(lost - found["mass_outside"]) < 5 * error


def test_warnings_are_notes() -> None:
    """A heavy tail is said where a user reads it: emitter samples alone, a lamp almost on the wall."""
    from pssflow.study.stability.lights import CLOSE

    mi.set_variant(SCALAR)
    scene = CLOSE.settings[0].scene(16)
    result = pssflow.render(scene, "none", 64, emitter_strategy="nee", seed=1, progress=False)
    found = result.stats["diagnostics"]
    assert found["pareto_k"] > 0.7
    assert found["warnings"]
    assert set(found["warnings"]) <= set(result.notes)


ISA = """
import numpy as np, mitsuba as mi, sys
mi.set_variant("scalar_rgb")
import pssflow
from pssflow.study.stability.parts import room
scene = pssflow.Scene(room(32))
for name in sys.argv[3:]:
    guide = "none" if name == "none" else f"{sys.argv[1]}/{name}.guide"
    np.save(f"{sys.argv[2]}-{name}.npy", scene.render(guide, 64, seed=3, threads=1, progress=False).image)
"""

SAME = 1e-4
"""Relative difference of two pixels that only rounding explains."""

OTHER_PATHS = {"none": 0.01, "table": 0.001, "mixture-net": 0.001}
"""For random numbers the share of pixels that may differ by more than `SAME`; for guides the median pixel's change."""


@pytest.mark.timeout(1200)
def test_instruction_sets_agree(tmp_path: Path, record: dict[str, Any]) -> None:
    """Embree rounds differently on AVX-512, AVX2 and SSE4.2, and so do our kernels without FMA.

    A path that grazes an edge may go another way. With random numbers that changes its own pixel alone: at most 1 % of
    the pixels differ by more than 1e-4, and the mean by no more than 1e-4. A guide's numbers are rounded, too, and each
    path with them: the median pixel differs by at most .1 %, and the mean. The guides are made once: what learns anew,
    with one path more or less, is another guide.
    """
    flags = Path("/proc/cpuinfo").read_text(encoding="ascii") if sys.platform == "linux" else ""
    known = ["sse4.2", *(["avx2"] if "avx2" in flags else [])]
    known += ["avx512"] if "avx512vl" in flags else []
    mi.set_variant(SCALAR)
    pilot = pssflow.Scene(room(32)).pilot(spp=32, seed=1)
    pilot.fit("table").save(tmp_path / "table.guide")
    pilot.fit("mixture-net", epochs=2).save(tmp_path / "mixture-net.guide")
    for isa in known:
        subprocess.run(
            [sys.executable, "-c", ISA, str(tmp_path), str(tmp_path / isa), *OTHER_PATHS],
            check=True,
            env={**os.environ, "PSSFLOW_ISA": isa},
            cwd=ROOT,
            timeout=600,
        )
    for guide, most in OTHER_PATHS.items():
        *others, widest = (
            np.load(tmp_path / f"{isa}-{guide}.npy").astype(np.float64) for isa in known
        )
        assert np.isfinite(widest).all()
        for isa, image in zip(known, others, strict=False):
            apart = np.abs(image - widest)
            differ = float(np.mean(apart > SAME * np.abs(widest)))
            middle = float(np.median(apart) / np.median(np.abs(widest)))
            mean = abs(image.mean() / widest.mean() - 1)
            record |= {f"{guide} {isa} share": differ, f"{guide} {isa} median": middle}
            record[f"{guide} {isa} mean"] = mean
            assert (differ if guide == "none" else middle) <= most, (guide, isa)
            assert mean <= (1e-4 if guide == "none" else 1e-3), (guide, isa)
