"""Guide files and options of renders, damaged at random: the cases that forked workers run."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import numpy as np

import pssflow
from pssflow.guide import registry
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
    name = sorted(SMALL)[case.seed % len(SMALL)]
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


def _check(result: pssflow.Result) -> None:
    if not np.isfinite(result.image).all():
        raise AssertionError("the image holds values that are not finite")
    if (result.image < 0).any():
        raise AssertionError("the image holds negative values")
