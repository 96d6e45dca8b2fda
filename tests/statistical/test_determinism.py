"""One seed gives one image, bit for bit: on any number of threads, and when a timed render is replayed."""

from __future__ import annotations

import functools
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from pssflow import _core
from tests.conftest import LLVM
from tests.scenes import SCENES
from tests.support.core import core_scene, render

GUIDES = ("none", "realnvp", "realnvp-logit", "table", "mixture-net", "auto")
FLOW = {"epochs": 2, "samples": 4096}
LEARNED = {"realnvp": FLOW, "realnvp-logit": FLOW, "mixture-net": {"epochs": 1}}
COUNTS = (
    "camera_rays",
    "paths_found",
    "nonzero",
    "outside",
    "pilot",
    "mean",
    "max_weight",
    "passes",
)
"""Entries of a record that a seed decides; seconds are not among them."""


@functools.cache
def _scene() -> _core.Scene:
    """Several tiles, a filter wider than a pixel, a crop: sums of neighbours meet at every edge."""
    mi.set_variant(LLVM)
    return core_scene(mi.load_dict(SCENES["glossy_room"]()))[0]


def _render(guide: str, **options: Any) -> dict[str, Any]:
    learned = {"guide_options": LEARNED.get(guide, {})}
    return render(_scene(), guide=guide, **({"uniform_fraction": 0.25} | learned | options))


def _assert_equal(a: dict[str, Any], b: dict[str, Any]) -> None:
    for name in ("image", "variance"):
        assert np.array_equal(a[name], b[name]), (
            f"{name}: {np.sum(a[name] != b[name])} values differ"
        )
    for name in COUNTS:
        assert a["record"][name] == b["record"][name], name


@pytest.mark.parametrize("guide", GUIDES)
def test_threads_do_not_show(guide: str) -> None:
    """Image, variance and counts on 1, 2 and 3 threads, and once more on 2. 40 spp: three chunks of samples a tile."""
    one = _render(guide, threads=1, spp=40)
    assert one["image"].any()
    for threads in (2, 3, 2):
        _assert_equal(one, _render(guide, threads=threads, spp=40))


def test_threads_do_not_show_with_nee_and_three_bounces() -> None:
    options = {"k": 3, "emitter_strategy": "nee", "parametrisation": "cosine", "spp": 40}
    _assert_equal(_render("none", threads=1, **options), _render("none", threads=3, **options))


@pytest.mark.parametrize("guide", GUIDES)
def test_another_seed_is_another_image(guide: str) -> None:
    a, b = _render(guide, seed=1, spp=8), _render(guide, seed=2, spp=8)
    assert np.mean(a["image"] != b["image"]) > 0.9
    assert not np.array_equal(a["image"], _render(guide, seed=1 << 33, spp=8)["image"])
    assert not np.array_equal(a["image"], _render(guide, seed=(1 << 33) + 1, spp=8)["image"])


@pytest.mark.parametrize("guide", GUIDES)
def test_a_timed_render_is_replayed(guide: str) -> None:
    """The recorded passes, whatever the clock made of them, give the same image on another number of threads."""
    timed = _render(guide, time=1.0, threads=2)
    passes = timed["record"]["passes"]
    assert passes
    assert sum(p["spp"] for p in passes) > 1
    replayed = _render(guide, replay=passes, threads=1)
    _assert_equal(timed, replayed)


@pytest.mark.parametrize("guide", GUIDES)
def test_spp_is_replayed(guide: str) -> None:
    asked = _render(guide, spp=20, keep_pilot=False)
    _assert_equal(asked, _render(guide, replay=asked["record"]["passes"], keep_pilot=False))


@pytest.mark.parametrize("guide", ["table", "mixture-net", "auto"])
def test_guides_refined_from_pass_to_pass_are_replayed(guide: str) -> None:
    """Each pass was drawn by what the passes before it taught, and `auto` may have chosen anew: all comes back."""
    asked = _render(guide, spp=96, threads=2, combine="variance")
    passes = asked["record"]["passes"]
    assert sum(p["fit"] for p in passes) > 1, passes
    _assert_equal(asked, _render(guide, replay=passes, threads=3, combine="variance"))


@pytest.mark.parametrize("k", range(1, 7))
def test_auto_renders_any_number_of_bounces_and_says_why(k: int) -> None:
    mi.set_variant(LLVM)
    core, _ = core_scene(mi.load_dict(SCENES["furnace_sphere"]()))
    result = render(core, guide="auto", k=k, spp=16)
    assert np.isfinite(result["image"]).all()
    assert result["image"].any()
    record = result["record"]
    candidates = record["candidates"]
    assert [c["name"] for c in candidates if c["chosen"]] == [record["chosen"]]
    assert {"none"} < {c["name"] for c in candidates}
    assert all(c["why"] for c in candidates)


def test_variance_is_that_of_the_mean() -> None:
    """H0: the reported variance is the spread of images between seeds.

    64 seeds × 16 spp of a scene with the box filter; over the image, the ratio of both means is within five standard
    errors of 1 (by the spread of that ratio between 8 groups of seeds).
    """
    mi.set_variant(LLVM)
    core, _ = core_scene(mi.load_dict(SCENES["furnace_sphere"]()))
    results = [render(core, seed=seed, spp=16) for seed in range(64)]
    images = np.stack([r["image"] for r in results]).astype(np.float64).reshape(8, 8, -1)
    reported = np.stack([r["variance"] for r in results]).astype(np.float64).reshape(8, 8, -1)
    ratios = reported.mean(axis=(1, 2)) / images.var(axis=1, ddof=1).mean(axis=1)
    se = ratios.std(ddof=1) / np.sqrt(len(ratios))
    assert abs(ratios.mean() - 1) < 5 * se, f"{ratios.mean():.4f} ± {se:.4f}"
    assert se < 0.05
