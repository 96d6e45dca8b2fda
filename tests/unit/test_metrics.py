"""Errors of images: known values, and what they say about truths without light or with noise."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pssflow import metrics


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def test_relmse_of_known_values():
    reference = np.array([[[1.0, 2.0, 3.0]]])
    image = np.array([[[1.5, 2.0, 2.0]]])
    epsilon = (0.1 * 2.0) ** 2
    expected = (0.25 / (1 + epsilon) + 1.0 / (9 + epsilon)) / 3
    assert metrics.epsilon(reference) == pytest.approx(epsilon)
    assert metrics.relmse(image, reference) == pytest.approx(expected, rel=1e-12)


def test_relmse_has_no_scale(rng):
    reference = rng.gamma(2.0, size=(8, 6, 3))
    image = reference * rng.normal(1, 0.2, size=reference.shape)
    error = metrics.relmse(image, reference)
    assert metrics.relmse(1000 * image, 1000 * reference) == pytest.approx(error, rel=1e-12)


def test_the_truths_own_noise_is_subtracted(rng):
    """An exact image against a noisy truth has no error: within five standard errors (false alarm 6e-7)."""
    exact = np.full((64, 64, 3), 2.0)
    variance = np.full(exact.shape, 0.3**2)
    noisy = exact + rng.normal(0, 0.3, exact.shape)
    assert metrics.relmse(exact, noisy) > 0.02
    # ε and r² are of the noisy truth on both sides; what is left has mean zero up to their curvature.
    measured = metrics.relmse_with_error(exact, noisy, variance)
    assert abs(measured.value) < 5 * measured.error + 0.002


def test_a_firefly_counts_once(rng):
    reference = np.ones((40, 50, 3))
    image = reference * rng.normal(1, 0.1, reference.shape)
    before = metrics.relmse_trimmed(image, reference)
    image[3, 4] = 1e4
    assert metrics.relmse(image, reference) > 1e4
    assert metrics.relmse_trimmed(image, reference) == pytest.approx(before, rel=0.02)


def test_trimming_leaves_a_pixel():
    one = np.ones((1, 1, 3))
    assert metrics.relmse_trimmed(2 * one, one) == metrics.relmse(2 * one, one)
    assert metrics.relmse_trimmed([[[1.0], [3.0]]], [[[1.0], [1.0]]], fraction=0.5) == 0.0


def test_black_truths_divide_by_nothing():
    black, lit = np.zeros((2, 2, 3)), np.ones((2, 2, 3))
    assert metrics.relmse(black, black) == 0.0
    assert metrics.relmse(lit, black, black) == math.inf
    assert metrics.relmse_trimmed(lit, black) == math.inf
    assert metrics.relative_variance(black, black) == 0.0
    assert metrics.finite_or_none(metrics.relmse(lit, black)) is None
    assert metrics.finite_or_none(0.5) == 0.5


def test_variance_predicts_relmse(rng):
    """An unbiased image's relMSE is its relative variance: within five standard errors."""
    reference = rng.uniform(0.5, 1.5, (64, 64, 3))
    image = reference + rng.normal(0, 0.1, reference.shape)
    measured = metrics.relmse_with_error(image, reference)
    predicted = metrics.relative_variance(np.full(reference.shape, 0.01), reference)
    assert abs(measured.value - predicted) < 5 * measured.error
    assert metrics.relative_error(np.full(reference.shape, 0.01), reference) == predicted**0.5


def test_mean_and_error():
    value, error = metrics.mean_and_error([1.0, 2.0, 3.0])
    assert value == 2.0
    assert error == pytest.approx(1 / math.sqrt(3))
    assert math.isnan(metrics.mean_and_error([1.0]).error)
    with pytest.raises(ValueError, match="at least one"):
        metrics.mean_and_error([])


@pytest.mark.parametrize(
    ("image", "reference", "message"),
    [
        (np.ones((2, 2, 3)), np.ones((2, 3, 3)), r"shape \(2, 2, 3\), the reference \(2, 3, 3\)"),
        (np.full((1, 1, 3), np.nan), np.ones((1, 1, 3)), "`image` has 3 values of 3"),
        (np.ones((1, 1, 3)), np.array([[[1, np.inf, 1]]]), "`reference` has 1 values of 3"),
        (np.ones((0, 0, 3)), np.ones((0, 0, 3)), "`image` is empty"),
    ],
)
def test_what_cannot_be_compared(image, reference, message):
    with pytest.raises(ValueError, match=message) as caught:
        metrics.relmse(image, reference)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("fraction", [-0.1, 1.0, math.nan])
def test_fractions_out_of_range(fraction):
    with pytest.raises(ValueError, match="fraction"):
        metrics.relmse_trimmed(np.ones((1, 1, 3)), np.ones((1, 1, 3)), fraction=fraction)
