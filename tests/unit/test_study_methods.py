"""Methods of the studies: what their time counts, the foreign guide, and which of them a machine has."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import pssflow
from pssflow.study import methods
from pssflow.study.flip import flip
from pssflow.study.harness import Shot
from pssflow.study.methods import Stage, missing, named_method
from pssflow.study.vegas_guide import VegasGuide
from tests import scenes


class FakePass:
    """A renderer of 2×2 pixels whose passes take, by a clock of its own, what it is told."""

    def __init__(self, clock: list[float], takes: list[float], *, jit: bool = True) -> None:
        self.clock, self.takes, self.jit = clock, takes, jit
        self.seeds: list[int] = []

    def __call__(self, seed: int, spp: int) -> tuple[Any, int, int]:
        self.seeds.append(seed)
        self.clock[0] += self.takes[min(len(self.seeds), len(self.takes)) - 1]
        return np.full((2, 2, 3), float(len(self.seeds))), spp, 0


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    now = [100.0]
    monkeypatch.setattr(methods, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    return now


def passes(render: FakePass, times: tuple[float, ...], seed: int = 0) -> list[Shot]:
    """Film of 2×2."""
    scene: Any = SimpleNamespace(width=2, height=2)
    return methods._passes(render, "fake", seed, scene, times, None)  # pyright: ignore[reportArgumentType]


def test_no_pass_counts_that_ends_after_its_time(clock):
    """One compiles, one is measured, then passes of 0.4 s: four by 1.7 s, seven by 3 s, none half."""
    render = FakePass(clock, [5.0, 0.4])
    first, last = passes(render, (1.7, 3.0))
    assert [round(shot.elapsed, 9) for shot in (first, last)] == [1.6, 2.8]
    spp = methods.PATHS_PER_PASS[0] // 4
    assert [shot.spp for shot in (first, last)] == [4 * spp, 7 * spp]
    assert first.image[0, 0, 0] == pytest.approx(np.mean([3, 4, 5, 6]))
    assert last.seconds["warm_up"] == pytest.approx(5.4)
    assert last.variance is not None
    assert last.variance[0, 0, 0] == pytest.approx(np.var(range(3, 10), ddof=1) / 7)
    # A pass that would end too late is not begun.
    assert len(render.seeds) == 2 + 7


def test_passes_are_cut_to_the_shortest_time(clock):
    """A pass of 1 s is too long for 1 s: a quarter of its samples, compiled and measured anew, takes 0.25 s."""
    render = FakePass(clock, [5.0, 1.0, 5.0, 0.25])
    (first, _) = passes(render, (1.0, 3.1))
    assert first.spp == 4 * methods.PATHS_PER_PASS[0] // 16
    assert first.seconds["warm_up"] == pytest.approx(11.25)


def test_passes_grow_to_fill_their_share_of_the_shortest_time(clock):
    """One of 0.1 s is short for 2 s: five times its samples would fill it, four times are the most."""
    render = FakePass(clock, [5.0, 0.1, 5.0, 0.4])
    (first, _) = passes(render, (2.0, 4.0))
    assert first.spp == 4 * methods.PATHS_PER_PASS[1] // 4
    assert first.elapsed == pytest.approx(1.6)


def test_a_pass_that_turns_out_too_long_is_dropped(clock):
    (shot,) = passes(FakePass(clock, [1.0, 0.5, 0.5, 9.0]), (2.0, 3.0))[-1:]
    assert shot.elapsed == pytest.approx(0.5)
    assert shot.variance is None
    assert passes(FakePass(clock, [9.0], jit=False), (1.0, 2.0)) == []


def test_times_before_the_first_pass_have_no_shot(clock):
    shots = passes(FakePass(clock, [1.5], jit=False), (1.0, 2.0, 4.0))
    assert [(shot.time, shot.spp) for shot in shots] == [(2.0, 1), (4.0, 2)]


def test_seeds_share_no_pass_with_each_other_or_a_reference(clock):
    """References count their passes from 0: the same numbers in a competitor would make its error vanish."""
    drawn = []
    for seed in range(3):
        render = FakePass(clock, [0.1])
        passes(render, (1.0,), seed)
        drawn += render.seeds
    assert len(set(drawn)) == len(drawn)
    assert min(drawn) > 1 << 19


@pytest.mark.parametrize("name", ["mitsuba-llvm", "mitsuba-scalar"])
def test_mitsuba_renders_in_its_own_variant(llvm_variant, name):
    """On a film of 16², and whoever comes next finds the variant as it was."""
    description = scenes.furnace_sphere()
    description["camera"]["film"] |= {"width": 16, "height": 16}
    scene = pssflow.Scene(description)

    def load(variant: str) -> Any:
        mi.set_variant(variant)
        again = scenes.furnace_sphere()  # transforms belong to a variant
        again["camera"]["film"] |= {"width": 16, "height": 16}
        return mi.load_dict(again)

    stage = Stage(scene, load)
    method = named_method(name, k=2, threads=None)
    shots = method.run(stage, 0, (0.5, 1.0), False)
    assert mi.variant() == llvm_variant
    assert "compiling outside" in method.budget
    assert shots
    assert all(shot.elapsed <= shot.time and shot.spp > 0 for shot in shots)
    expected = scene.render("none", 64, progress=False).image.mean()
    assert shots[-1].image.mean() == pytest.approx(expected, rel=0.2)


def test_vegas_is_a_density_that_it_draws_from():
    """The density integrates to one, `sample` and `log_prob` agree, and more of it lies where the light is."""
    rng = np.random.default_rng(1)
    u = rng.random((20_000, 3), dtype=np.float32)
    lit = u[:, 0] < 0.25
    f = np.where(lit, 1.0 + u[:, 1], 0.0).astype(np.float32)
    guide = VegasGuide()
    guide.fit(u[lit], f[lit], np.ones(lit.sum(), np.float32), int((~lit).sum()), 0)
    drawn, log_q = guide.sample(50_000, 3)
    np.testing.assert_array_equal(log_q, guide.log_prob(drawn))
    assert drawn.min() >= 0.0
    assert drawn.max() < 1.0
    assert np.exp(guide.log_prob(u)).mean() == pytest.approx(1.0, abs=0.05)
    assert np.exp(-log_q).mean() == pytest.approx(1.0, abs=0.05)
    assert (drawn[:, 0] < 0.25).mean() > 0.7
    assert (drawn[:, 1] > 0.5).mean() > 0.55
    assert (drawn[:, 2] < 0.5).mean() == pytest.approx(0.5, abs=0.03)


def test_vegas_guides_a_render(llvm_variant):
    """The mean stays; its object is new in each run, so that seeds share nothing."""
    scene = pssflow.Scene(scenes.furnace_sphere())
    method = named_method("python-vegas", k=2, threads=None)
    (shot,) = method.run(Stage(scene, lambda variant: scene.mi_scene), 1, (1.0,), False)
    expected = scene.render("none", 64, progress=False).image.mean()
    assert shot.image.mean() == pytest.approx(expected, rel=0.1)
    assert "vegas" in method.options


def test_what_is_missing_is_told(monkeypatch):
    assert missing("none") is None
    with pytest.raises(ValueError, match=r"'nonsense' is unknown.*python-vegas"):
        missing("nonsense")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    told = missing("python-vegas")
    assert told is not None
    assert "pssflow[studies]" in told
    assert flip(np.ones((8, 8, 3)), np.ones((8, 8, 3))) is None


def test_flip_tells_how_different_images_look():
    rng = np.random.default_rng(0)
    truth = rng.random((32, 32, 3)).astype(np.float32)
    noisy = truth * rng.gamma(4.0, 0.25, truth.shape).astype(np.float32)
    same, little, much = (flip(x, truth) for x in (truth, 0.5 * (truth + noisy), noisy))
    assert same == 0.0
    assert little is not None
    assert much is not None
    assert 0.0 < little < much < 1.0
    assert flip(truth, np.zeros_like(truth)) is None
