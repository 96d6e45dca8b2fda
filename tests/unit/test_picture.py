"""The side-by-side picture: where its insets go, what its colours mean, and that it is written at all."""

from __future__ import annotations

import matplotlib.image
import numpy as np
import pytest

from pssflow.picture import Panel, Picture, Row, Window, choose_windows, display, error_map

RNG = np.random.default_rng(7)


def test_insets_lie_where_methods_differ_most():
    noisy = np.full((60, 80), 0.2)
    good = noisy.copy()
    noisy[40:52, 60:72] = 1.0
    noisy[4:16, 8:20] = 0.7
    assert choose_windows([noisy, good]) == [Window(60, 40, 12), Window(8, 4, 12)]


def test_a_firefly_does_not_draw_an_inset():
    noisy = np.full((60, 80), 0.2)
    good = noisy.copy()
    noisy[40:52, 60:72] = 1.0
    good[3, 3] = 1e9
    assert choose_windows([noisy, good], count=1) == [Window(60, 40, 12)]


@pytest.mark.parametrize("shape", [(1, 1), (3, 200), (16, 16), (9, 5)])
def test_insets_fit_into_small_images_and_do_not_overlap(shape):
    windows = choose_windows([RNG.random(shape), RNG.random(shape)])
    for window in windows:
        assert window.cut(np.zeros(shape)).shape == (window.side, window.side)
    assert not any(a.overlaps(b) for a in windows for b in windows if a is not b)


def test_no_error_no_insets():
    assert choose_windows([]) == []


def test_display_is_srgb_and_shows_what_is_broken():
    image = np.array([[[0.0, 0.001, 0.5], [4.0, -1.0, 1.0], [np.nan, 0.0, 0.0]]])
    shown = display(image, 1.0)
    np.testing.assert_allclose(shown[0, 0], [0, 0.01292, 0.735357], atol=1e-5)
    np.testing.assert_allclose(shown[0, 1:], [[1, 0, 1], [1, 0, 1]], atol=1e-12)


def test_error_map_is_the_terms_of_relmse():
    reference = np.full((2, 2, 3), 2.0)
    expected = np.full((2, 2), 1 / (4 + 0.5))
    np.testing.assert_allclose(error_map(reference + 1, reference, 0.5), expected)


@pytest.mark.parametrize("runs", [1, 4])
@pytest.mark.parametrize("shape", [(24, 40, 3), (1, 1, 3), (40, 12, 3)])
def test_a_picture_is_written_for_each_shape(runs, shape, tmp_path):
    image = RNG.random(shape)
    panels = [Panel(f"guide {i}", image, ["8 spp"], image.mean(axis=-1)) for i in range(runs)]
    picture = Picture("a scene", [Row(panels), Row(panels, note="a note")], Panel("truth", image))
    picture.draw(tmp_path / "picture.png")
    assert matplotlib.image.imread(tmp_path / "picture.png").ndim == 3
    assert [path.name for path in tmp_path.iterdir()] == ["picture.png"]


def test_black_images_have_a_picture_too(tmp_path):
    black = np.zeros((16, 16, 3))
    panel = Panel("none", black, error=black.mean(axis=-1))
    Picture("a dark scene", [Row([panel])], Panel("truth", black)).draw(tmp_path / "black.png")
    assert (tmp_path / "black.png").exists()
