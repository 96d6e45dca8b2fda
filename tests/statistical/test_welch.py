"""The test of the test: Welch sees a small bias, accepts the absence of one, and copes with black tiles."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from tests.conftest import LLVM, ROOT
from tests.support.runs import Runs, mitsuba_runs
from tests.support.welch import (
    ALPHA,
    HEAVY,
    Moments,
    holm,
    luminance,
    p_value,
    tile_means,
    welch,
    welch_where_power,
)

pytestmark = pytest.mark.stat


@pytest.fixture(scope="module")
def cbox_runs() -> tuple[Runs, Runs]:
    """A 64² Cornell box by Mitsuba's `path`, twice 16 seeds × 64 spp: two sides that are equal by construction."""
    mi.set_variant(LLVM)
    scene = mi.load_file(str(ROOT / "scenes" / "cornell-box" / "scene.xml"), resolution=64)
    a = mitsuba_runs(scene, max_depth=6, seeds=range(16), spp=64)
    return a, mitsuba_runs(scene, max_depth=6, seeds=range(100, 116), spp=64)


def test_welch_accepts_equal_renderers(cbox_runs: tuple[Runs, Runs], artifacts: Path) -> None:
    r = welch(*cbox_runs)
    assert r.p > ALPHA / 2, r.explain(artifacts)
    assert r.has_power


def test_welch_sees_a_one_percent_bias(cbox_runs: tuple[Runs, Runs]) -> None:
    """Each question sees it alone; measured: p_mean 8e-5, p_holm 5e-10 (1 % is 4.4 standard errors of the means)."""
    a, b = cbox_runs
    r = welch(a, 1.01 * b)
    assert r.p_mean < ALPHA
    assert r.p_holm < ALPHA / 1000
    assert r.p < ALPHA / 2


def test_welch_sees_two_percent_in_one_tile(cbox_runs: tuple[Runs, Runs], artifacts: Path) -> None:
    a, b = cbox_runs
    b = b.copy()
    b[:, 32:48, 16:32] *= 1.02
    r = welch(a, b)
    assert r.p_holm < ALPHA / 20
    assert r.p_mean > ALPHA / 2, "the image's mean hides it: that is what tiles are for"
    assert "row 2, column 1" in r.explain(artifacts)


def test_p_values_are_uniform_under_the_null(cbox_runs: tuple[Runs, Runs]) -> None:
    """H0 holds for every split of 32 equal runs into halves, tile by tile: the p-values' distribution is uniform.

    Kolmogorov's distance of 16 tiles × 40 splits (dependent, so only its size is checked: .15 where 640 independent
    ones would give .05 at 5 %).
    """
    runs = np.concatenate(cbox_runs)
    rng = np.random.default_rng(1)
    tiles = tile_means(luminance(runs, "runs"), 16)
    p = []
    for _ in range(40):
        order = rng.permutation(32)
        p.append(p_value(Moments.of(tiles[order[:16]]), Moments.of(tiles[order[16:]])).ravel())
    assert stats.kstest(np.concatenate(p), "uniform").statistic < 0.15


def test_welch_agrees_with_scipy() -> None:
    rng = np.random.default_rng(2)
    a, b = rng.normal(1, 0.1, (9, 16, 16)), rng.normal(1.01, 0.3, (14, 16, 16))
    _, expected = stats.ttest_ind(a.mean(axis=(1, 2)), b.mean(axis=(1, 2)), equal_var=False)
    assert welch(a, b).p_mean == pytest.approx(expected, rel=1e-9)


def test_holm_steps_down() -> None:
    np.testing.assert_allclose(holm(np.array([0.01, 0.04, 0.03])), [0.03, 0.06, 0.06])
    np.testing.assert_allclose(holm(np.array([[0.9, 0.8]])), [[1.0, 1.0]])


def test_tiles_without_variance_are_equal_or_not() -> None:
    """Black tiles: nothing to divide by. A constant that differs is a difference, however small the scale."""
    rng = np.random.default_rng(3)
    a = np.zeros((4, 16, 48))
    a[:, :, 16:32] = rng.normal(1, 0.1, (4, 16, 16))
    b = a[::-1].copy()
    assert welch(a, b).p == pytest.approx(1.0)
    assert welch(a, b).p_tiles[0, 0] == 1.0

    b[:, :, 32:] = 1e-20
    r = welch(a, b)
    assert r.p_tiles[0].tolist() == [1.0, 1.0, 0.0]
    assert r.p == 0.0


def test_tiles_without_variance_on_one_side_are_tested() -> None:
    rng = np.random.default_rng(4)
    noisy = rng.normal(1, 0.1, (16, 16, 16))
    assert welch(np.ones((4, 16, 16)), noisy).p > ALPHA
    assert welch(np.full((4, 16, 16), 1.1), noisy).p < ALPHA


def test_tiles_at_the_edge_are_means_of_fewer_pixels() -> None:
    a = np.random.default_rng(5).random((3, 20, 33))
    r = welch(a, a, tile=16)
    assert r.p_tiles.shape == (2, 3)
    assert r.tiles[0].mean[1, 2] == pytest.approx(a[:, 16:, 32:].mean())


def test_a_heavy_tail_is_said(artifacts: Path) -> None:
    """One firefly hides a bias of 20 %: the test passes, and says that this means nothing."""
    rng = np.random.default_rng(6)
    a, b = rng.normal(1, 0.01, (2, 16, 16, 16))
    b *= 1.2
    assert welch(a, b).p < ALPHA
    b[3, 8, 8] = 2000.0
    r = welch(a, b)
    assert r.p > ALPHA
    assert not r.has_power
    assert "no power" in r.explain(artifacts)


def test_pictures_are_written(artifacts: Path, scalar_variant: str) -> None:
    a = np.random.default_rng(7).random((3, 20, 33))
    welch(a, a).explain(artifacts)
    for name in ("a.mean", "a.var", "b.mean", "b.var", "p"):
        assert mi.Bitmap(str(artifacts / f"{name}.exr")).size().numpy().tolist() == [33, 20]


@pytest.mark.parametrize(
    ("a", "b", "message"),
    [
        (np.ones((1, 8, 8)), np.ones((2, 8, 8)), "two or more runs"),
        (np.ones((2, 8, 8)), np.ones((2, 8, 9)), "cannot be compared"),
        (np.ones((2, 8, 8)), np.full((2, 8, 8), np.nan), "b holds 128 values"),
        (np.full((2, 8, 8), np.inf), np.ones((2, 8, 8)), "a holds 128 values"),
        (np.ones((2, 8, 8, 4)), np.ones((2, 8, 8)), "expected"),
    ],
)
def test_welch_refuses_what_would_pass_in_silence(a, b, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        welch(a, b)


def _noise(seed: int, runs: int = 16) -> np.ndarray:
    """Images (runs, 24, 36) of mean 1."""
    return np.random.default_rng(seed).gamma(2.0, 0.5, (runs, 24, 36))


def test_tiles_with_power_are_tested_as_before() -> None:
    a, b = _noise(1), _noise(2)
    plain, verdict = welch(a, b, tile=12), welch_where_power(a, b)
    assert (verdict.tiles, verdict.enlarged, verdict.without_power) == (6, 0, 0)
    assert verdict.p_holm == pytest.approx(plain.p_holm)
    assert verdict.p_mean == pytest.approx(plain.p_mean)
    assert verdict.p > ALPHA


def test_a_bias_is_seen_where_there_is_power() -> None:
    b = _noise(2)
    b[:, 12:, :12] *= 1.2
    verdict = welch_where_power(_noise(1), b)
    assert verdict.p_holm < ALPHA / 2
    assert "row 1, column 0" in verdict.explain()


def test_a_tile_of_one_sample_is_tested_in_a_larger_one() -> None:
    """A spike above a tenth of its tile's sum, but not of the next larger tile's."""
    b = _noise(2)
    share = 2 * HEAVY
    b[3, 5, 5] = share * 16 * 144
    verdict = welch_where_power(_noise(1), b)
    assert (verdict.enlarged, verdict.without_power) == (1, 0)
    assert verdict.p > ALPHA


def test_a_tile_that_stays_heavy_is_counted_not_tested() -> None:
    """A dark tile with one bright sample is no bias that can be told; the other tiles still are."""
    a, b = _noise(1), _noise(2)
    b[3, 5, 5] = 16 * 24 * 36
    verdict = welch_where_power(a, b, sizes=(12, 24))
    assert verdict.without_power == 1
    assert np.isnan(verdict.p_mean)
    assert verdict.p > ALPHA
    b[:, 12:, 24:] *= 1.2
    assert welch_where_power(a, b, sizes=(12, 24)).p < ALPHA / 2
