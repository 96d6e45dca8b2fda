"""Snapshots of a timed render: what they hold, that each is replayed, and what is refused.

That none holds more than its time allows is tested where passes are cut: `rust/pssflow/tests/passes.rs`.
"""

from __future__ import annotations

import numpy as np
import pytest

import pssflow
from tests import scenes


@pytest.fixture
def furnace(scalar_variant) -> pssflow.Scene:
    return pssflow.Scene(scenes.furnace_sphere())


@pytest.mark.parametrize("combine", ["samples", "variance"])
@pytest.mark.parametrize("guide", ["none", "table", "auto"])
def test_each_snapshot_is_a_result_that_can_be_replayed(furnace, guide, combine):
    times = (0.02, 0.1, 0.25)
    whole = furnace.render(
        guide, time=0.5, snapshots=times, combine=combine, seed=3, progress=False
    )
    assert len(whole.snapshots) == len(times)
    spp = [sum(p["spp"] for p in part.stats["passes"]) for part in (*whole.snapshots, whole)]
    assert spp == sorted(spp)
    learned = "" if guide == "none" else " incl. pilot and training"
    for time, part in zip(times, whole.snapshots, strict=True):
        assert part.stats["budget"] == f"first {time:g} of 0.5 s{learned}"
        assert part.stats["passes"] == whole.stats["passes"][: len(part.stats["passes"])]
        assert part.stats["elapsed"] <= whole.stats["elapsed"]
        assert part.image.shape == part.variance.shape == whole.image.shape
        again = furnace.render(replay=part.stats, progress=False)
        np.testing.assert_array_equal(again.image, part.image)
        np.testing.assert_array_equal(again.variance, part.variance)
    np.testing.assert_array_equal(
        furnace.render(replay=whole.stats, progress=False).image, whole.image
    )


def test_a_foreign_guide_is_in_its_snapshots(furnace):
    class Uniform:
        def fit(self, u, f, g, zeros, seed):
            self.dims = u.shape[1]

        def sample(self, n, seed):
            u = np.random.default_rng(seed).random((n, self.dims), np.float32)
            return u, np.zeros(n, np.float32)

        def log_prob(self, u):
            return np.zeros(len(u), np.float32)

    guide = Uniform()
    whole = furnace.render(guide, time=0.6, snapshots=[0.4], progress=False)
    (part,) = whole.snapshots
    assert part.guide is (guide if part.stats["chosen"] == "Uniform" else None)
    assert part.stats["guide"] == "Uniform"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"spp": 4, "snapshots": (1,)}, r"`snapshots` = \(1,\) were given without a `time`"),
        ({"time": 2, "snapshots": (1, 1)}, "expected times that increase and are below 2 s"),
        ({"time": 2, "snapshots": (2,)}, "expected times that increase and are below 2 s"),
        ({"time": 2, "snapshots": (0, 1)}, r"`snapshots\[0\]` = 0: expected a number in \(0"),
        ({"time": 2, "snapshots": "1"}, "expected a list of seconds"),
        ({"time": 2, "snapshots": 1}, "expected a list of seconds"),
    ],
)
def test_wrong_snapshots_are_refused(furnace, arguments, message):
    with pytest.raises(ValueError, match=message):
        furnace.render("none", progress=False, **arguments)
