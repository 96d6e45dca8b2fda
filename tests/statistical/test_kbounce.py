"""`pssflow_kbounce`: is its mean `path` to depth k + 1 minus `path` to depth k?

Welch's test of `support/welch.py`, 16 seeds a side; the competitor of our studies, and their reference in LLVM
variants, would be no good without it.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from tests.conftest import LLVM, SCALAR
from tests.support.named import load_named
from tests.support.runs import Runs, integrator_runs, truth_runs
from tests.support.welch import ALPHA, welch

pytestmark = [pytest.mark.stat, pytest.mark.timeout(600)]

RUNS = 16
SPP = {"cornell-box": 64, "glass_room": 64, "glossy_room": 128, "sun_and_sky": 64}
SPP |= {
    "furnace_sphere": 64,
    "open_sky": 256,
    "carved_room": 64,
    "many-lights": 1024,
    "teapot": 128,
}
"""Of each run."""
QUICK = {("glass_room", 1), ("glass_room", 2), ("cornell-box", 3)}
"""Every delta lobe, where NEE alone is blind; three bounces."""


def _kbounce_runs(scene: Any, *, k: int, seeds: range, spp: int) -> Runs:
    integrator = {"type": "pssflow_kbounce", "k": k}
    return integrator_runs(scene, integrator, seeds=seeds, spp=spp)


@pytest.mark.parametrize(
    ("name", "k"),
    [
        pytest.param(name, k, marks=[] if (name, k) in QUICK else [pytest.mark.long])
        for name, k in product(SPP, (1, 2, 3))
    ],
)
def test_its_mean_is_the_difference_of_two_depths(name: str, k: int, artifacts: Path) -> None:
    """H0: equal means; and the same runs with 3 % more light fail, so that this could have failed."""
    mi.set_variant(LLVM)
    scene = load_named(name)
    truth = truth_runs(scene, k=k, seeds=range(RUNS), spp=SPP[name])
    ours = _kbounce_runs(scene, k=k, seeds=range(1000, 1000 + RUNS), spp=SPP[name])
    r = welch(truth, ours)
    assert r.p > ALPHA / 2, r.explain(artifacts)
    assert r.has_power, r.explain(artifacts)
    if (name, k) in QUICK:
        assert welch(truth, np.float32(1.03) * ours).p < ALPHA / 2


@pytest.mark.long
@pytest.mark.parametrize("k", [1, 2])
def test_in_scalar_variants_the_mean_is_the_same(k: int, artifacts: Path) -> None:
    """H0: equal means of `scalar_rgb`, path by path in Python, and the difference in `llvm_ad_rgb`. 4 spp × 8 seeds."""
    mi.set_variant(LLVM)
    truth = truth_runs(load_named("glass_room"), k=k, seeds=range(RUNS), spp=64)
    mi.set_variant(SCALAR)
    ours = _kbounce_runs(load_named("glass_room"), k=k, seeds=range(1000, 1008), spp=4)
    r = welch(truth, ours)
    assert r.p > ALPHA / 2, r.explain(artifacts)
