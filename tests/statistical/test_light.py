"""The whole light up to a depth: is its mean that of Mitsuba's `path` at the same `max_depth`?

Welch's test of `support/welch.py`, 16 seeds a side. Quick: a scene each for exact shapes, for delta lobes and for a sky
with a sun, at depths 2, 4 and 3; the full product is `long`.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import pssflow
from tests.conftest import LLVM
from tests.support.named import HARD, SHIPPED, load_named
from tests.support.runs import Runs, mitsuba_runs
from tests.support.welch import ALPHA, welch, welch_where_power

pytestmark = [pytest.mark.stat, pytest.mark.timeout(600)]

RUNS = 16
SMALL = ("furnace_sphere", "glossy_room", "open_sky", "sun_and_sky", "glass_room", "carved_room")
DEEP = (("furnace_sphere", 8), ("glass_room", 6), ("cornell-box", 6), ("white-room", 5))
QUICK = {("furnace_sphere", 2, "none"), ("sun_and_sky", 3, "auto"), ("glass_room", 4, "table")}


def light_runs(scene: Any, **options: Any) -> Runs:
    """Our renderer, one image a seed."""
    ours = pssflow.Scene(scene)
    runs = [
        pssflow.render(ours, seed=seed, progress=False, **options).image
        for seed in range(1000, 1000 + RUNS)
    ]
    return np.stack(runs)


def _cases() -> list[Any]:
    cases = [
        *product((*SMALL, *SHIPPED), (2, 3, 4), ("auto",)),
        *((name, depth, "auto") for name, depth in DEEP),
        *((name, depth, "table") for name, depth in product(("glass_room", "open_sky"), (2, 4))),
        *((name, 1, "none") for name in ("open_sky", "cornell-box")),
        ("furnace_sphere", 2, "none"),
        ("cornell-box", 3, "realnvp-logit"),
    ]
    assert set(cases) >= QUICK
    return [
        pytest.param(*case, marks=[] if case in QUICK else [pytest.mark.long]) for case in cases
    ]


@pytest.mark.parametrize(("name", "depth", "guide"), _cases())
def test_all_light_has_mitsubas_mean(name: str, depth: int, guide: str, artifacts: Path) -> None:
    """H0: equal means; and the same runs with 2 % more light fail, so that this could have failed."""
    mi.set_variant(LLVM)
    scene = load_named(name)
    spp = 32 if (name, depth, guide) in QUICK else 128
    truth = mitsuba_runs(scene, max_depth=depth, seeds=range(RUNS), spp=2 * spp)
    ours = light_runs(scene, guide=guide, max_depth=depth, spp=spp)
    r = welch(truth, ours)
    assert r.p > ALPHA / 2, r.explain(artifacts)
    assert r.has_power, r.explain(artifacts)
    assert welch(truth, np.float32(1.02) * ours).p < ALPHA / 2


@pytest.mark.long
@pytest.mark.parametrize(("name", "depth"), [*((name, 4) for name in HARD), ("door-ajar", 8)])
def test_all_light_of_hard_scenes_has_mitsubas_mean(name: str, depth: int) -> None:
    """H0: equal means; tiles that no larger tile gives power are counted, not tested."""
    mi.set_variant(LLVM)
    scene = load_named(name)
    truth = mitsuba_runs(scene, max_depth=depth, seeds=range(RUNS), spp=256)
    verdict = welch_where_power(truth, light_runs(scene, guide="auto", max_depth=depth, spp=128))
    assert verdict.p > ALPHA / 2, verdict.explain()
    assert verdict.without_power <= verdict.tiles / 2, verdict.explain()


@pytest.mark.parametrize(
    ("name", "depth", "rr_depth", "guide"),
    [
        ("furnace_sphere", 9, 2, "none"),
        *(
            pytest.param(*case, marks=pytest.mark.long)
            for case in (
                ("furnace_sphere", 9, 1, "table"),
                ("white-room", 12, 2, "auto"),
                ("glass_room", 10, 3, "auto"),
                ("cornell-box", 8, 3, "table"),
                ("open_sky", 6, 1, "auto"),
            )
        ),
    ],
)
def test_roulette_loses_no_light(
    name: str, depth: int, rr_depth: int, guide: str, artifacts: Path
) -> None:
    """H0: equal means where long paths are left to chance; with 2 % more, and of what they hold half, they are not."""
    mi.set_variant(LLVM)
    scene = load_named(name)
    truth = mitsuba_runs(scene, max_depth=depth, seeds=range(RUNS), spp=128)
    spp = 32 if guide == "none" else 96
    ours = light_runs(scene, guide=guide, max_depth=depth, rr_depth=rr_depth, spp=spp)
    r = welch(truth, ours)
    assert r.p > ALPHA / 2, r.explain(artifacts)
    assert r.has_power, r.explain(artifacts)
    assert welch(truth, np.float32(1.02) * ours).p < ALPHA / 2
    short = mitsuba_runs(scene, max_depth=rr_depth, seeds=range(RUNS), spp=128)
    assert welch(truth, 0.5 * (short + ours)).p < ALPHA / 2
