"""A thousand damaged scene files, and as many damaged exports: a clear line or an image, no crash, no hang.

Each case is loaded and rendered in a forked worker with a time limit. A file over which Mitsuba itself dies is
counted, and not ours to mend.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import pytest

from tests.conftest import SCALAR
from tests.support.border import Answer, Case, exported, scene_file, write_assets
from tests.support.workers import checked, run_cases

QUICK = 100
ALL = 1000
SECONDS = 20.0
"""For one case, which usually takes a hundredth of one: other work may keep the machine busy."""

KINDS: dict[str, Callable[..., Answer]] = {"scene files": scene_file, "exports": exported}


def _check(kind: str, seeds: range, folder: Path) -> Counter[str]:
    mi.set_variant(SCALAR)
    write_assets(folder)
    cases = [Case(str(folder), seed) for seed in seeds]
    return checked(kind, KINDS[kind], cases, seconds=SECONDS, excused="mitsuba")


@pytest.mark.parametrize("kind", KINDS)
def test_whole_inputs_render(kind: str, tmp_path: Path) -> None:
    """Or the others would be refused for a reason that is none of theirs."""
    assert _check(kind, range(-1, 0), tmp_path)["rendered"] == 1


@pytest.mark.parametrize("kind", KINDS)
def test_damage_is_told_in_one_line(kind: str, tmp_path: Path, record: dict[str, Any]) -> None:
    counts = _check(kind, range(QUICK), tmp_path)
    record |= dict(counts)
    assert counts["refused"] > QUICK / 5
    assert counts["rendered"] > QUICK / 20
    assert counts["Mitsuba died"] < QUICK / 10


@pytest.mark.long
@pytest.mark.timeout(900)
@pytest.mark.parametrize("kind", KINDS)
def test_much_damage_is_told_in_one_line(kind: str, tmp_path: Path, record: dict[str, Any]) -> None:
    counts = _check(kind, range(QUICK, QUICK + ALL), tmp_path)
    record |= dict(counts)
    assert counts["Mitsuba died"] < ALL / 10


def test_workers_that_die_or_hang_are_noticed() -> None:
    """The test of the test: a crash and a hang are told from an answer, and the cases behind them still run."""
    cases = ["answer", "crash", "hang", "answer"]
    outcomes = list(run_cases(_misbehave, cases, seconds=2.0))
    assert [o.answer for o in outcomes] == ["fine", None, None, "fine"]
    assert [o.death for o in outcomes] == [None, "SIGSEGV", "hang", None]
    assert [o.stage for o in outcomes] == ["", "before", "before", ""]


def _misbehave(case: str, report: Callable[[str], None]) -> str:
    import faulthandler
    import os
    import signal
    import time

    report("before")
    if case == "crash":
        faulthandler.disable()
        os.kill(os.getpid(), signal.SIGSEGV)
    if case == "hang":
        time.sleep(60)
    return "fine"
