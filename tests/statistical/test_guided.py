"""`pss_guided`: has any integrator the mean that it has without?

Welch's test of `support/welch.py`, 16 seeds a side, each of which learns a guide of its own; and a scene in which a
guide must gain, so that these tests see guided paths and not only uniform ones.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from pssflow.examples import guide_any_integrator
from tests import scenes
from tests.conftest import LLVM
from tests.support.named import load_named
from tests.support.runs import integrator_runs
from tests.support.welch import ALPHA, welch

pytestmark = [pytest.mark.stat, pytest.mark.timeout(600)]

RUNS = 16
NESTED: dict[str, Any] = {
    "path": {"type": "path", "max_depth": 4},
    "direct": {"type": "direct"},
    "prb_basic": {"type": "prb_basic", "max_depth": 3},
    "volpath": {"type": "volpath", "max_depth": 4},
    "ambient": {"type": "pssflow_example_ambient"},
}
SPP = {"prb_basic": 64}


def _cases() -> list[Any]:
    quick = {
        ("furnace_sphere", "path", "vegas"),
        ("sun_and_sky", "direct", "vegas"),
        ("open_sky", "prb_basic", "vegas"),
        ("furnace_sphere", "ambient", "vegas"),
    }
    more = [
        (scene, nested, guide)
        for scene in ("furnace_sphere", "open_sky", "glossy_room")
        for nested in NESTED
        for guide in ("auto", "vegas", "realnvp-logit", "realnvp")
    ]
    return [
        pytest.param(*case, marks=[] if case in quick else [pytest.mark.long])
        for case in sorted({*quick, *more})
    ]


@pytest.mark.parametrize(("name", "nested", "guide"), _cases())
def test_its_mean_is_the_integrators(name: str, nested: str, guide: str, artifacts: Path) -> None:
    """H0: equal means, the guide always used, a = .25, an eighth of the samples its pilot."""
    mi.set_variant(LLVM)
    guide_any_integrator.register_ambient()
    scene = load_named(name)
    spp = SPP.get(nested, 16)
    truth = integrator_runs(scene, NESTED[nested], seeds=range(RUNS), spp=4 * spp)
    own = {"type": "pss_guided", "guide": guide, "nested": NESTED[nested]}
    own |= {"dimensions": 6, "uniform_fraction": 0.25}
    ours = integrator_runs(scene, own, seeds=range(1000, 1000 + RUNS), spp=spp)
    r = welch(truth, ours)
    assert r.p > ALPHA / 2, r.explain(artifacts)
    assert r.has_power, r.explain(artifacts)
    assert welch(truth, np.float32(1.05) * ours).p < ALPHA / 2


def test_a_guide_gains_where_light_is_in_one_place() -> None:
    """A lamp found by BSDF sampling alone: `auto` foresees a gain, and the variance of a sample falls."""
    mi.set_variant(LLVM)
    scene = mi.load_dict(scenes.quad())
    nested = {"type": "prb_basic", "max_depth": 2}
    own = {"type": "pss_guided", "dimensions": 3, "pilot_spp": 64, "nested": nested}
    integrator: Any = mi.load_dict(own)
    mi.render(scene, integrator=integrator, spp=256)
    assert integrator.stats["chosen"] == "vegas"
    assert integrator.stats["predicted_gain"] > 1.2, integrator.stats
    assert integrator.stats["gain"] > 1.2, integrator.stats
