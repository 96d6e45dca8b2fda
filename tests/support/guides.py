"""Guide files, options of renders and arrays, damaged at random: the cases that forked workers run."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import pssflow
from pssflow.guide import Guide, registry
from pssflow.study.stability.parts import room
from tests.support.border import Answer, Case, Report, judge

SMALL: dict[str, dict[str, Any]] = {
    "vegas": {"bins": 4, "tiles": 2},
    "table": {"memory_mib": 1},
    "realnvp": {"epochs": 1, "samples": 256, "couplings": 2, "hidden": 8, "layers": 1},
    "realnvp-logit": {"epochs": 1, "samples": 256, "couplings": 2, "hidden": 8, "layers": 1},
    "mixture-net": {"epochs": 1, "hidden": 8, "layers": 1, "components": 2},
    "spline-net": {"epochs": 1, "hidden": 8, "layers": 1, "bins": 4},
}
"""Guides and options that make their files small, so that damage hits what matters."""

NUMBERS = (0, 1, -1, 2, 3, 7, 0.5, 1e-9, 1e9, 1e300, -0.0, float("nan"), float("inf"), 2**31, 2**70)
OTHERS = ("", "abc", "1", None, True, [], {}, [1, 2])

VALUES = (np.nan, np.inf, -np.inf, 1e38, -1e38, 1e-42, -1.0, 0.0, 1.0, 0.5, 2.0**24, 1 - 2.0**-24)
"""What numbers of arrays become."""

TYPES = ("float64", "int32", "uint8", "bool", ">f4", "float16", "complex64", "str", "object")

_SCENES: dict[str, pssflow.Scene] = {}


def _scene() -> pssflow.Scene:
    """The scene of all cases, loaded once a process."""
    if "room" not in _SCENES:
        _SCENES["room"] = pssflow.Scene(room(6))
    return _SCENES["room"]


def write_guides(folder: Path) -> None:
    """A small guide of each kind, fitted in the scene that the cases render; a variant must be set."""
    pilot = _scene().pilot(spp=16, seed=1)
    for name, own in SMALL.items():
        pilot.fit(name, **own).save(folder / f"{name}.guide")


def guide_file(case: Case, report: Report) -> Answer:
    """Loads a guide's file with a few bytes changed, moved, added or lost, and renders with what was taken."""
    rng = random.Random(case.seed)
    name = _of_seed(case)
    whole = (Path(case.folder) / f"{name}.guide").read_bytes()
    path = Path(case.folder) / f"case-{case.seed}.guide"
    path.write_bytes(whole if case.seed < 0 else _damaged(whole, rng))

    def render() -> None:
        report("pssflow")
        result = _scene().render(str(path), 1, seed=1, threads=1, progress=False)
        _check(result)

    try:
        return judge(render)
    finally:
        path.unlink(missing_ok=True)


def _of_seed(case: Case) -> str:
    """Guides take turns."""
    return sorted(SMALL)[case.seed % len(SMALL)]


def _damaged(whole: bytes, rng: random.Random) -> bytes:
    data = bytearray(whole)
    for _ in range(rng.choice([1, 1, 1, 2, 5])):
        at = rng.randrange(len(data)) if rng.random() < 0.4 else rng.randrange(min(len(data), 600))
        kind = rng.randrange(8)
        if kind < 3:
            data[at] = rng.randrange(256)
        elif kind == 3:
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 4:
            del data[at : at + rng.choice([1, 4, 64])]
        elif kind == 5:
            data[at:at] = data[at : at + rng.choice([1, 4, 64])]
        elif kind == 6:
            # A number of the payload becomes one that no arithmetic survives.
            value = rng.choice([np.nan, np.inf, -np.inf, 1e38, -1e38, 1e-42, -1.0, 0.0])
            at -= at % 4
            data[at : at + 4] = np.float32(value).tobytes()
        else:
            del data[at:]
        if not data:
            break
    return bytes(data)


def options(case: Case, report: Report) -> Answer:
    """Renders with a guide and options of which one or two are wild."""
    rng = random.Random(case.seed)
    names = ["none", "auto", "table", *registry()]
    name = rng.choice(names)
    known: dict[str, Any] = dict(SMALL.get(name, {}))
    usual = registry().get(name, {"options": {}})["options"]
    how: dict[str, Any] = {
        "guide": name,
        "spp": rng.choice([1, 2, 4, 9]),
        "k": rng.choice([1, 2, 2, 3]),
        "seed": rng.randrange(1000),
        "uniform_fraction": rng.choice([None, 0.1, 1.0, 0.0]),
        "pilot_spp": rng.choice([None, None, 1, 2]),
        "emitter_strategy": rng.choice(["mis", "nee", "auto"]),
        "combine": rng.choice(["samples", "variance"]),
    }
    for _ in range(rng.choice([1, 1, 2])):
        wild = rng.choice([*NUMBERS, *NUMBERS, *OTHERS])
        if usual and rng.random() < 0.7:
            known[rng.choice([*usual, "stranger"])] = wild
        else:
            how[rng.choice(sorted(how))] = wild
    # What is legal may still take hours: that is the user's wish, not a hang.
    for option, most in {"epochs": 50, "samples": 10_000, "hidden": 256, "couplings": 32}.items():
        if isinstance(known.get(option), (int, float)) and known[option] > most:
            known[option] = most
    if (
        isinstance(how["spp"], (int, float))
        and not isinstance(how["spp"], bool)
        and how["spp"] > 1e4
    ):
        how["spp"] = 64

    def render() -> None:
        report(f"pssflow {how} {known}")
        try:
            result = _scene().render(**{**how, **known}, threads=1, progress=False)
        except TypeError as error:
            raise ValueError(str(error)) from None
        _check(result)

    return judge(render)


def arrays(case: Case, report: Report) -> Answer:
    """Traces damaged numbers, asks a guide about damaged numbers and places, or renders with one that was fitted to a
    damaged pilot.
    """
    rng = random.Random(case.seed)
    name = _of_seed(case)
    asked = rng.choice([_trace, _teach, _ask])
    wounds = 0 if case.seed < 0 else rng.choice([1, 1, 1, 2])

    def render() -> None:
        report(f"pssflow {asked.__name__} {name}")
        asked(name, Path(case.folder), _surgeon(rng, wounds))

    return judge(render)


Wound = Callable[[dict[str, Any]], dict[str, Any]]
"""Arrays by name → the same, some of them damaged."""


def _surgeon(rng: random.Random, wounds: int) -> Wound:
    def wound(arrays: dict[str, Any]) -> dict[str, Any]:
        arrays = dict(arrays)
        for _ in range(wounds):
            which = rng.choice(sorted(arrays))
            arrays[which] = _wounded(np.atleast_1d(arrays[which]), rng)
        return arrays

    return wound


def _wounded(array: NDArray[Any], rng: random.Random) -> Any:
    """Other values, another length, width, type or layout."""
    kind = rng.randrange(9)
    if kind < 3 and array.size and array.dtype.kind == "f":
        flat = array.flatten()
        # A row, a stretch, or most of it.
        start, length = rng.randrange(flat.size), rng.choice([1, 7, flat.size])
        flat[start : start + length] = rng.choice(VALUES)
        return flat.reshape(array.shape)
    if kind == 3:
        return array[: rng.choice([0, 1, max(len(array) - 1, 0)])]
    if kind == 4:
        return np.concatenate([array, array[: rng.choice([1, 5])]])
    if kind == 5 and array.ndim > 1:
        return array[..., : rng.choice([0, 1, array.shape[-1] - 1])]
    if kind == 6:
        return rng.choice([array.ravel(), array[None], array[..., None], np.float32(0.5)])
    if kind == 7:
        return array.astype(rng.choice(TYPES))
    return rng.choice([array[::-1], np.asfortranarray(array), np.repeat(array, 2, axis=0)[::2]])


def _trace(name: str, folder: Path, wound: Wound) -> None:
    rng = np.random.default_rng(3)
    u, pixels = rng.random((64, 7), np.float32), 6 * rng.random((64, 2), np.float32)
    traced = _scene().trace(**wound({"u": u, "pixels": pixels}), threads=1)
    if not np.isfinite(traced.f).all():
        raise AssertionError("what was traced is not finite")


def _teach(name: str, folder: Path, wound: Wound) -> None:
    pilot = _scene().pilot(spp=4, seed=1)
    given = (
        "u",
        "f",
        "f_bsdf",
        "g",
        "position",
        "normal",
        "outgoing",
        "pixel",
        "emitter",
        "emitters",
    )
    changed: Any = wound({field: getattr(pilot, field) for field in given})
    guide = replace(pilot, **changed).fit(name, **SMALL[name])
    _check(_scene().render(guide, 1, seed=1, threads=1, progress=False))


def _ask(name: str, folder: Path, wound: Wound) -> None:
    guide = Guide.load(folder / f"{name}.guide")
    decision = guide.models[0]
    rng = np.random.default_rng(4)
    width = {"path": guide.dims, "emitter": 1}.get(decision, 2)
    up = np.tile(np.array([0, 0, 1], np.float32), (32, 1))
    changed = wound(
        {
            "u": rng.random((32, width), np.float32),
            "position": rng.uniform(-1, 1, (32, 3)).astype(np.float32),
            "normal": up,
            "outgoing": up,
            "pixel": rng.random((32, 2), np.float32),
            "emitter": np.zeros(32, np.uint32),
            "bounce": np.ones(32, np.uint32),
        }
    )
    u = changed.pop("u")
    density = guide.log_prob(u, decision=decision, contexts=changed)
    drawn, again = guide.sample(32, 5, decision=decision, contexts=changed)
    for values in (density, again):
        # A density of zero is legal; no number is not.
        if np.isnan(values).any() or (values == np.inf).any():
            raise AssertionError("a density is no number")
    if not np.isfinite(drawn).all():
        raise AssertionError("what was drawn is not finite")


def _check(result: pssflow.Result) -> None:
    if not np.isfinite(result.image).all():
        raise AssertionError("the image holds values that are not finite")
    if (result.image < 0).any():
        raise AssertionError("the image holds negative values")
