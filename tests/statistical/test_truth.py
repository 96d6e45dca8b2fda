"""Does the mean equal Mitsuba's truth: `path` to depth k + 1 minus `path` to depth k?

Every comparison is Welch's test of `support/welch.py`, image-wide and in every tile of 16², 16 seeds a side, level
1e-4. Its power on each scene is tested too (`test_more_light_is_refused`), and no single sample may dominate
(`has_power`). The quick tier takes the cases that differ most; the full product of scenes, k, parametrisations and
strategies is `long`.
"""

from __future__ import annotations

import functools
from itertools import product
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from pssflow import _core
from tests.conftest import LLVM
from tests.scenes import SCENES
from tests.support.core import core_scene, our_runs, render
from tests.support.lights import LIGHTS, MISSED_BY_MITSUBA, light
from tests.support.named import HARD, SHIPPED, load_named
from tests.support.runs import Runs, mitsuba_runs, truth_runs
from tests.support.welch import ALPHA, welch

pytestmark = [pytest.mark.stat, pytest.mark.timeout(600)]

RUNS = 16
SPP = {
    "cornell-box": 128,
    "teapot": 128,
    "furnace_sphere": 64,
    "glossy_room": 256,
    "open_sky": 256,
    "quad": 16,
    "sun_and_sky": 64,
    "glass_room": 64,
    "carved_room": 64,
    "instances": 32,
    "courtyard": 256,
    "door-ajar": 1024,
    "glossy": 1024,
    "leaves": 512,
    "many-lights": 1024,
    "white-room": 64,
}
"""Of each run: more where two-bounce light is noisier."""
SMALL = ("furnace_sphere", "glossy_room", "open_sky", "sun_and_sky", "glass_room", "carved_room")
"""`quad` has a test of its own: its two-bounce light is zero."""
BLIND = ("glass_room", "carved_room", "leaves")
"""Scenes where NEE alone misses light, at a mirror or behind a mask say, so that strategy `nee` is not right."""


def _load(name: str) -> mi.Scene:
    mi.set_variant(LLVM)
    return load_named(name)


@functools.cache
def _truth(name: str, k: int) -> Runs:
    return truth_runs(_load(name), k=k, seeds=range(RUNS), spp=SPP[name])


@functools.cache
def _core_of(name: str) -> _core.Scene:
    return core_scene(_load(name))[0]


def _ours(name: str, **options: Any) -> Runs:
    options = {"seeds": range(1000, 1000 + RUNS), "spp": SPP[name]} | options
    return our_runs(_core_of(name), **options)


@functools.cache
def _ours_by_default(name: str) -> Runs:
    """Random numbers, k = 2, `bsdf`, `mis`."""
    return _ours(name)


def _cases() -> list[Any]:
    """All scenes × k × parametrisations × strategies; those left to the long tier are marked."""
    quick = {
        *((name, 2, "bsdf", "mis") for name in (*SHIPPED, *SMALL, "courtyard", "white-room")),
        *((name, 2, p, "mis") for name in ("teapot", "glossy_room") for p in ("cosine", "uniform")),
        *product(("glass_room",), (2, 3), ("bsdf", "cosine", "uniform"), ("mis",)),
        *((name, 2, "bsdf", "nee") for name in (*SHIPPED, "sun_and_sky")),
        *((name, 1, "bsdf", "mis") for name in ("glossy_room", "open_sky", "sun_and_sky")),
        *((name, 3, "bsdf", "mis") for name in ("cornell-box", "furnace_sphere")),
        ("carved_room", 2, "uniform", "mis"),
        ("glossy_room", 3, "cosine", "nee"),
    }
    cases = []
    for case in product(
        (*SHIPPED, *SMALL, *HARD), (1, 2, 3), ("bsdf", "cosine", "uniform"), ("mis", "nee")
    ):
        name, k, parametrisation, strategy = case
        if strategy == "nee" and name in BLIND:
            continue
        if k == 1 and parametrisation != "bsdf":
            continue  # one bounce draws no direction
        if name in HARD and (parametrisation != "bsdf" or (strategy == "nee" and k != 2)):
            continue  # what these scenes add is not how directions are drawn
        marks = [] if case in quick else [pytest.mark.long]
        cases.append(pytest.param(*case, marks=marks, id="-".join(map(str, case))))
    assert sum(not case.marks for case in cases) == len(quick)
    return cases


@pytest.mark.parametrize(("name", "k", "parametrisation", "strategy"), _cases())
def test_random_numbers_give_mitsubas_mean(
    name: str, k: int, parametrisation: str, strategy: str, artifacts: Path, record
) -> None:
    """H0: `none` and the truth have equal means. 16 seeds × `SPP` each."""
    if (k, parametrisation, strategy) == (2, "bsdf", "mis"):
        ours = _ours_by_default(name)
    else:
        ours = _ours(name, k=k, parametrisation=parametrisation, emitter_strategy=strategy)
    r = welch(_truth(name, k), ours)
    record |= {"p": r.p, "largest sample's share": max(r.heaviest)}
    assert r.p > ALPHA / 2, r.explain(artifacts)
    assert r.has_power or strategy == "nee", r.explain(artifacts)


@pytest.mark.parametrize(
    ("name", "factor"),
    [
        ("cornell-box", 1.01),
        ("furnace_sphere", 1.01),
        ("glossy_room", 1.02),
        ("open_sky", 1.02),
        ("teapot", 1.03),
    ],
)
def test_more_light_is_refused(name: str, factor: float) -> None:
    """Power: the very runs that pass above fail with f × `factor`."""
    assert welch(_truth(name, 2), np.float32(factor) * _ours_by_default(name)).p < ALPHA / 2


@pytest.mark.long
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(("name", "times"), [("glossy_room", 5), ("open_sky", 5), ("teapot", 12)])
def test_one_per_cent_is_refused(name: str, times: int, artifacts: Path) -> None:
    """Power: with more seeds, one per cent more light is seen on noisy scenes, too, while the truth still passes."""
    seeds = range(RUNS * times)
    truth = truth_runs(_load(name), k=2, seeds=seeds, spp=SPP[name])
    ours = _ours(name, seeds=range(1000, 1000 + len(seeds)))
    r = welch(truth, ours)
    assert r.p > ALPHA / 2, r.explain(artifacts)
    assert welch(truth, np.float32(1.01) * ours).p < ALPHA / 2


def test_one_bounce_less_is_refused() -> None:
    """Power: a renderer that is off by a bounce does not pass for want of samples."""
    assert welch(_truth("teapot", 2), _ours("teapot", k=1)).p < 1e-12


@pytest.mark.parametrize("k", [2, 3])
def test_light_that_never_arrives_is_black(k: int) -> None:
    """From the only surface that reflects in `quad`, no ray meets another one that does: zero, on both sides."""
    assert not _ours("quad", k=k).any()
    assert np.abs(_truth("quad", k)).max() < 1e-6


def test_what_two_depths_share_cancels() -> None:
    """One seed draws the same numbers at both depths, so that the truth is never negative: not in a single sample.

    With the box filter and one sample a pixel, each pixel is one path's k-bounce light.
    """
    scene = _load("cornell-box")
    deep = mitsuba_runs(scene, max_depth=3, seeds=range(4), spp=1)
    shallow = mitsuba_runs(scene, max_depth=2, seeds=range(4), spp=1)
    difference = deep - shallow
    assert difference.min() > -1e-5 * deep.max()
    assert difference.max() > 0
    assert np.mean(difference == 0) > 0.1, "paths without two-bounce light cancel to the last bit"


@pytest.mark.parametrize("k", [1, 2])
def test_baked_sunsky_gives_mitsubas_mean(k: int, artifacts: Path) -> None:
    """H0: sky and sun as two emitters light a court as Mitsuba's single one does. 16 seeds × 64 spp."""
    mi.set_variant(LLVM)
    sky = {"type": "sunsky", "sun_direction": [0.4, -0.5, 0.6], "sun_aperture": 6.0}
    sky |= {"sun_scale": 0.02, "sky_scale": 3.0, "turbidity": 4.0}
    scene = mi.load_dict(SCENES["open_sky"]() | {"sky": sky})
    truth = truth_runs(scene, k=k, seeds=range(RUNS), spp=64)
    core = core_scene(scene)[0]
    ours = our_runs(core, seeds=range(1000, 1000 + RUNS), spp=64, k=k)
    r = welch(truth, ours)
    assert r.p > ALPHA / 2, r.explain(artifacts)
    assert r.has_power, r.explain(artifacts)


@pytest.mark.parametrize("k", [1, 2])
def test_instances_give_mitsubas_mean(k: int, artifacts: Path) -> None:
    """H0: two towers and a ball that are seen several times each, one view mirrored, light each other as in Mitsuba."""
    mi.set_variant(LLVM)
    court = SCENES["open_sky"]()
    T = mi.ScalarTransform4f
    group = {"type": "shapegroup", "tower": court.pop("tower"), "wall": court.pop("wall")}
    court |= {"group": group}
    for i, place in enumerate(
        (T(), T().translate([1.2, -1.6, 0]).scale([-0.5, 0.5, 0.7]), T().rotate([0, 0, 1], 150))
    ):
        court[f"view-{i}"] = {
            "type": "instance",
            "to_world": place,
            "group": {"type": "ref", "id": "group"},
        }
    scene = mi.load_dict(court)
    spp = SPP["instances"]
    truth = truth_runs(scene, k=k, seeds=range(RUNS), spp=spp)
    core = core_scene(scene)[0]
    ours = our_runs(core, seeds=range(1000, 1000 + RUNS), spp=spp, k=k)
    r = welch(truth, ours)
    assert r.p > ALPHA / 2, r.explain(artifacts)
    assert r.has_power, r.explain(artifacts)


def _lit_floor(lamp: Any) -> mi.Scene:
    """A glossy floor under one light, so that both terms of `mis` carry weight."""
    floor = {
        "type": "roughplastic",
        "alpha": 0.3,
        "diffuse_reflectance": {"type": "rgb", "value": [0.4, 0.3, 0.2]},
    }
    film = {"type": "hdrfilm", "width": 32, "height": 32, "pixel_format": "rgb"}
    T = mi.ScalarTransform4f
    camera = {
        "type": "perspective",
        "fov": 35,
        "to_world": T().look_at(origin=[-3, -2, 2.5], target=[0, 0, 0], up=[0, 0, 1]),
        "film": film | {"rfilter": {"type": "box"}},
    }
    return mi.load_dict(
        {
            "type": "scene",
            "camera": camera,
            "floor": {"type": "rectangle", "bsdf": floor},
            "lamp": lamp,
        }
    )


def _light_cases() -> list[Any]:
    quick = {
        *((name, False, "mis") for name in ("disk-flipped", "cylinder", "mesh", "sphere-around")),
        *((name, True, "mis") for name in ("disk", "cylinder-flipped")),
        ("cube", False, "nee"),
    }
    cases = []
    for case in product(LIGHTS, (False, True), ("mis", "nee")):
        name, textured, strategy = case
        if textured and name in MISSED_BY_MITSUBA:
            continue
        marks = [] if case in quick else [pytest.mark.long]
        kind = "textured" if textured else "plain"
        cases.append(pytest.param(*case, marks=marks, id=f"{name}-{kind}-{strategy}"))
    return cases


@pytest.mark.parametrize(("name", "textured", "strategy"), _light_cases())
def test_every_light_gives_mitsubas_mean(
    name: str, textured: bool, strategy: str, tmp_path: Path, artifacts: Path
) -> None:
    """H0: one-bounce light from each shape of light has equal means. 16 seeds × 64 spp.

    Its sampling, its density, and what a ray sees that hits it, belong together.
    """
    mi.set_variant(LLVM)
    scene = _lit_floor(light(name, tmp_path, textured=textured))
    truth = truth_runs(scene, k=1, seeds=range(RUNS), spp=64)
    ours = our_runs(
        core_scene(scene)[0],
        seeds=range(1000, 1000 + RUNS),
        spp=64,
        k=1,
        emitter_strategy=strategy,
    )
    r = welch(truth, ours)
    assert r.p > ALPHA / 2, r.explain(artifacts)
    assert r.has_power, r.explain(artifacts)


LEARNED = {"epochs": 2, "samples": 4096}
"""A guide need not be good for its estimate to be right."""


def _learned_cases() -> list[Any]:
    quick = {
        ("cornell-box", "realnvp", 0.1, "bsdf"),
        ("cornell-box", "realnvp", 0.5, "bsdf"),
        ("teapot", "realnvp", 0.1, "bsdf"),
        ("teapot", "realnvp", 0.5, "cosine"),
        ("cornell-box", "realnvp-logit", 0.1, "bsdf"),
    }
    cases = []
    for case in product(
        SHIPPED, ("realnvp", "realnvp-logit"), (0.1, 0.5), ("bsdf", "cosine", "uniform")
    ):
        marks = [] if case in quick else [pytest.mark.long]
        cases.append(pytest.param(*case, marks=marks, id="-".join(map(str, case))))
    return cases


@pytest.mark.parametrize(("name", "guide", "a", "parametrisation"), _learned_cases())
def test_learned_numbers_give_mitsubas_mean(
    name: str, guide: str, a: float, parametrisation: str, artifacts: Path, record
) -> None:
    """H0: a flow in the mixture has the truth as mean, its pilot kept: each of 16 seeds learns a flow of its own.

    64 spp, 8 of them pilot, strategy `mis`.
    """
    options = {"guide": guide, "guide_options": LEARNED, "uniform_fraction": a}
    options |= {"pilot_spp": 8, "spp": 64}
    r = welch(_truth(name, 2), _ours(name, parametrisation=parametrisation, **options))
    record["p"] = r.p
    assert r.p > ALPHA / 2, r.explain(artifacts)
    assert r.has_power, r.explain(artifacts)


@pytest.mark.parametrize(
    ("name", "a"),
    [
        ("cornell-box", 0.1),
        pytest.param("cornell-box", 0.5, marks=pytest.mark.long),
        pytest.param("teapot", 0.1, marks=pytest.mark.long),
    ],
)
def test_a_flow_that_looks_at_the_pixel_gives_mitsubas_mean(
    name: str, a: float, artifacts: Path, record
) -> None:
    """H0: as above, the flow's networks knowing the film position: each pixel has a density of its own."""
    learned = {"guide": "realnvp-logit", "guide_options": LEARNED | {"condition": "pixel"}}
    r = welch(_truth(name, 2), _ours(name, **learned, uniform_fraction=a, pilot_spp=8, spp=64))
    record["p"] = r.p
    assert r.p > ALPHA / 2, r.explain(artifacts)
    assert r.has_power, r.explain(artifacts)


NET = "mixture-net+emitter-table+light-table+ray-table"
SPLINES = "spline-net+emitter-table+light-table+ray-table"
TABLES = (
    *("direction-table", "emitter-table", "light-table", "table"),
    *("mixture-net", NET, "spline-net", SPLINES, "auto"),
)


def _table_cases() -> list[Any]:
    """One emitter, two, 36, a sky, a sky and a sun; the quick tier takes one of each kind."""
    quick = {
        ("cornell-box", "table", 0.1, 2, "mis"),
        ("glossy_room", "table", 0.1, 2, "mis"),
        ("open_sky", "table", 0.5, 2, "mis"),
        ("sun_and_sky", "table", 0.1, 3, "mis"),
        ("sun_and_sky", "mixture-net", 0.1, 3, "mis"),
        ("sun_and_sky", NET, 0.5, 2, "mis"),
        ("glass_room", "spline-net", 0.1, 2, "mis"),
        ("sun_and_sky", "auto", 0.1, 2, "nee"),
        ("glass_room", "auto", 0.1, 2, "mis"),
    }
    scenes = ("cornell-box", "glossy_room", "open_sky", "sun_and_sky", "glass_room", "many-lights")
    cases = []
    for case in product(scenes, TABLES, (0.1, 0.5), (2, 3), ("mis", "nee")):
        name, _, a, k, strategy = case
        if strategy == "nee" and (name in BLIND or (a, k) != (0.1, 2)):
            continue
        marks = [] if case in quick else [pytest.mark.long]
        cases.append(pytest.param(*case, marks=marks, id="-".join(map(str, case))))
    assert sum(not case.marks for case in cases) == len(quick)
    return cases


@pytest.mark.parametrize(("name", "guide", "a", "k", "strategy"), _table_cases())
def test_tables_give_mitsubas_mean(
    name: str, guide: str, a: float, k: int, strategy: str, artifacts: Path, record
) -> None:
    """H0: tables and nets that are refined from pass to pass have the truth as mean, all passes kept."""
    options = {"guide": guide, "uniform_fraction": a, "emitter_strategy": strategy, "k": k}
    r = welch(_truth(name, k), _ours(name, **options))
    record |= {"p": r.p, "largest sample's share": max(r.heaviest)}
    assert r.p > ALPHA / 2, r.explain(artifacts)
    assert r.has_power or strategy == "nee", r.explain(artifacts)


@pytest.mark.parametrize("k", [2, 3, 4])
@pytest.mark.parametrize("a", [0.1, 0.5])
def test_no_weight_exceeds_one_over_a(k: int, a: float) -> None:
    """One coin a path: however many numbers are guided, 1/m ≤ 1/a."""
    result = render(_core_of("sun_and_sky"), guide="table", k=k, uniform_fraction=a, spp=32)
    weight = result["record"]["max_weight"]
    assert 1.0 < weight <= 1.0 / a * (1.0 + 1e-6)


@pytest.mark.parametrize("strategy", ["mis", pytest.param("nee", marks=pytest.mark.long)])
def test_the_mixture_alone_gives_mitsubas_mean(strategy: str, artifacts: Path) -> None:
    """H0: as above without the pilot in the image, whose uniform paths would water a bias down."""
    options = {"guide": "realnvp", "guide_options": LEARNED, "uniform_fraction": 0.1, "spp": 64}
    options |= {"pilot_spp": 4, "keep_pilot": False, "emitter_strategy": strategy}
    r = welch(_truth("cornell-box", 2), _ours("cornell-box", **options))
    assert r.p > ALPHA / 2, r.explain(artifacts)
    assert r.has_power, r.explain(artifacts)


@pytest.mark.parametrize("name", [pytest.param("cornell-box", marks=pytest.mark.long), "teapot"])
def test_the_thesis_own_estimate_is_put_on_record(name: str, record) -> None:
    """The flow alone, a = 0: its density has no lower bound. Its mean is recorded, not asserted: paths that it hardly
    ever draws are missing from any finite image, and weigh without limit when they come.

    What must hold: the image is finite, and no path drawn outside the cube counts as found.
    """
    options = {"guide": "realnvp", "guide_options": LEARNED, "uniform_fraction": 0.0}
    options |= {"pilot_spp": 8, "keep_pilot": False, "emitter_strategy": "nee"}
    core = _core_of(name)
    results = [render(core, seed=seed, spp=32, **options) for seed in range(1000, 1000 + RUNS)]
    runs = np.stack([result["image"] for result in results])
    assert np.isfinite(runs).all()
    r = welch(_truth(name, 2), runs)
    record["mean ÷ truth"] = float(r.images[1].mean / r.images[0].mean)
    record["p"] = r.p
    record["largest weight"] = max(result["record"]["max_weight"] for result in results)
    for counts in (result["record"] for result in results):
        assert counts["outside"] > 0
        assert counts["paths_found"] + counts["outside"] <= counts["camera_rays"]
        assert counts["nonzero"] <= counts["paths_found"]
