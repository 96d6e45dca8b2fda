"""Third-party scenes: does random sampling have Mitsuba's mean, image-wide and by tile, for one, two, three bounces?

Films are reduced to 48 pixels, seeds and samples are those of `pssflow.study.parity`, 16 seeds a side and more where
tiles lack power. Every test but one is long.
"""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pssflow.scene import Scene
from pssflow.study.parity import (
    BOUNCES,
    SANMIGUEL_CAMERAS,
    Plan,
    compare_means,
    load,
    our_runs,
    shared_plans,
    truth_runs,
)
from tests.support.runs import mitsuba_runs
from tests.support.welch import ALPHA, welch_where_power

pytestmark = [pytest.mark.stat, pytest.mark.timeout(1800)]

NAMES = (
    *("cornell-box", "veach-ajar", "veach-bidir", "veach-mis", "staircase2", "bathroom2"),
    *("living-room", "sponza-lajolla"),
    *(f"sanmiguel{camera}" for camera in SANMIGUEL_CAMERAS),
)


@functools.lru_cache(maxsize=1)
def _loaded(plan: Plan) -> Scene:
    """The last scene alone: the largest holds gigabytes."""
    return load(plan)


def _plan(name: str, folder: Path) -> Plan:
    plans = {plan.name: plan for plan in shared_plans(folder)}
    if name not in plans:
        pytest.skip(f"PSSFLOW_SCENES holds no {name}")
    return plans[name]


def _cases() -> list[Any]:
    return [
        pytest.param(
            name,
            k,
            marks=[] if (name, k) == ("cornell-box", 2) else [pytest.mark.long],
            id=f"{name}-{k}",
        )
        for name in NAMES
        # The other cameras of San Miguel see the same surfaces.
        for k in (BOUNCES if "_cam" not in name else (2,))
    ]


@pytest.mark.parametrize(("name", "k"), _cases())
def test_random_numbers_give_mitsubas_mean(
    name: str, k: int, shared_scenes: Path, record: dict[str, Any]
) -> None:
    """H0: equal means. Tiles that no larger tile gives power are counted in the record, not tested."""
    plan = _plan(name, shared_scenes)
    verdict = compare_means(_loaded(plan), plan, k)
    record |= {"p": verdict.p, "tiles": verdict.tiles, "without power": verdict.without_power}
    assert not math.isnan(verdict.p), verdict.explain()
    assert verdict.p > ALPHA / 2, verdict.explain()
    assert verdict.without_power <= verdict.tiles / 2, verdict.explain()


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name in NAMES if "_cam" not in name])
def test_all_light_has_mitsubas_mean(name: str, shared_scenes: Path) -> None:
    """H0: the whole light to depth 4 by `auto` has the mean of Mitsuba's `path` to that depth."""
    plan = _plan(name, shared_scenes)
    scene = _loaded(plan)
    truth = mitsuba_runs(scene.mi_scene, max_depth=4, seeds=range(16), spp=2 * plan.spp)
    ours = np.stack(
        [
            scene.render("auto", plan.spp, max_depth=4, seed=seed, progress=False).image
            for seed in range(1000, 1016)
        ]
    )
    verdict = welch_where_power(truth, ours)
    assert verdict.p > ALPHA / 2, verdict.explain()
    assert verdict.without_power <= verdict.tiles / 2, verdict.explain()


@pytest.mark.long
def test_more_light_in_one_tile_is_refused(shared_scenes: Path) -> None:
    """Power: 5 % more in one tile of `staircase2`, whose mean hides it."""
    plan = _plan("staircase2", shared_scenes)
    scene = _loaded(plan)
    truth = truth_runs(scene, 2, seeds=range(16), spp=plan.spp)
    ours = our_runs(scene, 2, seeds=range(1000, 1016), spp=plan.spp)
    assert welch_where_power(truth, ours).p > ALPHA / 2
    ours[:, :12, :12] *= 1.05
    verdict = welch_where_power(truth, ours)
    assert verdict.p_holm < ALPHA / 2, verdict.explain()
