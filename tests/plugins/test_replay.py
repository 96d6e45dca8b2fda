"""`<sampler type="pss_replay">`: given numbers reach integrators, in the order that the tables of columns say."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from pssflow.files import first_line
from pssflow.plugins import guided, replay
from tests import scenes

LANES = 1024

INTEGRATORS: dict[str, Any] = {
    "path": {"type": "path", "max_depth": 4},
    "prb": {"type": "prb", "max_depth": 4},
    "direct": {"type": "direct"},
    "prb_basic": {"type": "prb_basic", "max_depth": 4},
}


def _sampler() -> Any:
    return mi.load_dict({"type": "pss_replay"})


def _rays(scene: Any) -> Any:
    place = np.random.default_rng(5).random((2, LANES), np.float32)
    camera = scene.sensors()[0]
    return camera.sample_ray_differential(0.0, 0.0, mi.Point2f(*place), mi.Point2f(0.5))[0]


def _radiance(name: str, scene: Any, sampler: Any, u: Any = None, seed: int = 0) -> np.ndarray:
    sampler.replay(u)
    sampler.seed(seed, LANES)
    value, _ = guided._sample(mi.load_dict(INTEGRATORS[name]), scene, sampler, _rays(scene))
    return np.array(value)


def _numbers(columns: int = 24) -> Any:
    return np.random.default_rng(1).random((LANES, columns), np.float32)


@pytest.mark.parametrize("name", INTEGRATORS)
def test_the_same_numbers_give_the_same_radiance(name, llvm_variant):
    """Whatever the seed: all numbers that these paths ask for are given. Others give something else."""
    scene = mi.load_dict(scenes.furnace_sphere())
    u, sampler = _numbers(), _sampler()
    first = _radiance(name, scene, sampler, u, seed=1)
    np.testing.assert_array_equal(first, _radiance(name, scene, sampler, u, seed=2))
    assert (first != _radiance(name, scene, sampler, u[::-1], seed=1)).any()


@pytest.mark.parametrize("name", INTEGRATORS)
def test_columns_are_drawn_in_the_tables_order(name, llvm_variant):
    """What the body of the integrator asks for, call by call, and how many numbers the longest paths took."""
    calls: list[int] = []

    parent: Any = replay.define()

    class Listening(parent):
        def next_1d(self, active: Any = True) -> Any:
            calls.append(1)
            return super().next_1d(active)

        def next_2d(self, active: Any = True) -> Any:
            value = super().next_2d(active)
            calls[-2:] = [2]
            return value

    scene = mi.load_dict(scenes.furnace_sphere())
    sampler = Listening()
    _radiance(name, scene, sampler, _numbers())
    nested = mi.load_dict(INTEGRATORS[name])
    table = guided.COLUMNS[type(nested).__name__ if name.startswith("prb") else nested.class_name()]
    # A pair is drawn at once and stands in the table as two.
    expected = [2 if part.endswith(".0") else 1 for part in table if not part.endswith(".1")]
    # A loop's body is recorded once, or twice where Dr.Jit looks for what changes in it.
    assert calls[: len(expected)] == expected
    assert len(calls) % len(expected) == 0
    drawn = np.unique(np.array(sampler.drawn))
    assert (drawn % len(table) == 0).all()
    assert drawn.max() == len(table) * (1 if name == "direct" else 4)


@pytest.mark.parametrize("name", ["path", "prb", "prb_basic"])
def test_columns_decide_what_their_names_say(name, llvm_variant):
    """Other numbers in a column change radiance where the column decides something, and nowhere else.

    In a diffuse room without roulette the lobe and the roulette decide nothing; the last vertex sends no ray.
    """
    scene = mi.load_dict(scenes.furnace_sphere())
    u, sampler = _numbers(), _sampler()
    other = np.random.default_rng(2).random(u.shape, np.float32)
    base = _radiance(name, scene, sampler, u)
    nested = mi.load_dict(INTEGRATORS[name])
    names = guided.columns(nested, 3)
    assert names[0].startswith("x1.")
    for i, column in enumerate(names):
        changed = u.copy()
        changed[:, i] = other[:, i]
        same = (_radiance(name, scene, sampler, changed) == base).all()
        assert same == ("lobe" in column or "roulette" in column), column


def test_without_numbers_it_is_mitsubas_own(llvm_variant):
    """Bit for bit, in `mi.render`: seeding, cloning and counting are those of `independent`."""
    images = []
    for kind in ("independent", "pss_replay"):
        view = scenes.furnace_sphere()
        view["camera"] = view["camera"] | {"sampler": {"type": kind, "sample_count": 4}}
        scene = mi.load_dict(view)
        path: Any = mi.load_dict({"type": "path", "max_depth": 4})
        images.append(np.array(mi.render(scene, integrator=path)))
    np.testing.assert_array_equal(*images)


def test_behind_the_columns_come_random_numbers(llvm_variant):
    sampler = _sampler()
    sampler.replay(_numbers(2))
    sampler.seed(0, LANES)
    first = np.array(sampler.next_2d())
    np.testing.assert_array_equal(first, _numbers(2).T)
    rest = np.array(sampler.next_1d())
    assert len(np.unique(rest)) > LANES - 5
    assert abs(rest.mean() - 0.5) < 5 / np.sqrt(12 * LANES)
    assert np.array(sampler.drawn).tolist() == [3] * LANES


def test_lanes_behind_the_last_row_draw_random_numbers(llvm_variant):
    """Fewer rows than lanes: the others have the numbers of a sampler that was given nothing. Of a clone, too."""
    given, plain = _sampler(), _sampler()
    given.replay(_numbers(4)[:16])
    plain.seed(3, LANES)
    other = np.array(plain.next_1d())
    for sampler in (given, given.clone()):
        sampler.seed(3, LANES)
        got = np.array(sampler.next_1d())
        np.testing.assert_array_equal(got[:16], _numbers(4)[:16, 0])
        np.testing.assert_array_equal(got[16:], other[16:])


def test_idle_lanes_keep_their_place(llvm_variant):
    sampler = _sampler()
    u = _numbers(2)
    sampler.replay(u)
    sampler.seed(0, LANES)
    odd = dr.arange(mi.UInt32, LANES) % 2 == 1
    sampler.next_1d(odd)
    got = np.array(sampler.next_1d())
    np.testing.assert_array_equal(got, np.where(np.arange(LANES) % 2 == 1, u[:, 1], u[:, 0]))


def test_a_clone_of_an_unseeded_sampler(llvm_variant):
    sampler = _sampler()
    sampler.replay(_numbers(4))
    clone = sampler.clone()
    clone.seed(0, LANES)
    np.testing.assert_array_equal(np.array(clone.next_1d()), _numbers(4)[:, 0])
    fork = sampler.fork()
    fork.seed(0, LANES)
    assert (np.array(fork.next_1d()) != _numbers(4)[:, 0]).any()


@pytest.mark.parametrize(
    ("u", "message"),
    [
        ([0.5], "`u` has shape \\(1,\\)"),
        (np.zeros((3, 0)), "`u` has shape \\(3, 0\\)"),
        ([[0.5, 1.0]], "`u` holds 1.0"),
        ([[np.nan]], "`u` holds nan"),
    ],
)
def test_bad_numbers(u, message, llvm_variant):
    with pytest.raises(ValueError, match=message):
        _sampler().replay(u)


def test_scalar_variants_have_none(scalar_variant):
    with pytest.raises(Exception, match="sampler pss_replay: the variant scalar_rgb") as caught:
        _sampler()
    assert "\n" not in first_line(caught.value)
