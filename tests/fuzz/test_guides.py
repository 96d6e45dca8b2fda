"""Damaged guide files, damaged arrays, wild options: an image, or one clear line; no crash, no hang, no file left.

Each case runs in a forked worker with a time limit, as those of `test_border.py` do. The long tier has 24,000.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from pssflow.guide import Guide
from tests.conftest import SCALAR
from tests.support.border import Answer, Case
from tests.support.guides import SMALL, arrays, guide_file, options, write_guides
from tests.support.workers import checked

QUICK = 150
ALL = 8_000
SECONDS = 30.0

KINDS: dict[str, Callable[..., Answer]] = {
    "guide files": guide_file,
    "options": options,
    "arrays": arrays,
}


def _check(kind: str, seeds: range, folder: Path) -> Counter[str]:
    mi.set_variant(SCALAR)
    write_guides(folder)
    files = sorted(folder.iterdir())
    cases = [Case(str(folder), seed) for seed in seeds]
    counts = checked(kind, KINDS[kind], cases, seconds=SECONDS)
    assert sorted(folder.iterdir()) == files
    return counts


@pytest.mark.parametrize("kind", KINDS)
def test_wild_guides_are_told_in_one_line(
    kind: str, tmp_path: Path, record: dict[str, Any]
) -> None:
    counts = _check(kind, range(QUICK), tmp_path)
    record |= dict(counts)
    assert counts["refused"] > QUICK / 5
    # A file's checksum lets next to no damage pass.
    assert kind == "guide files" or counts["rendered"] > QUICK / 50


@pytest.mark.parametrize("kind", ["guide files", "arrays"])
def test_whole_inputs_render(kind: str, tmp_path: Path) -> None:
    """Or the damaged ones would be refused for a reason that is none of theirs."""
    # Of arrays each guide is asked in three ways; which, the number decides.
    whole = range(-4 * len(SMALL), 0)
    assert _check(kind, whole, tmp_path)["rendered"] == len(whole)


@pytest.mark.parametrize("name", SMALL)
def test_numbers_outside_the_cube_have_no_density(name: str, tmp_path: Path) -> None:
    """Only the thesis' flow has mass there; no guide answers with what is no number."""
    mi.set_variant(SCALAR)
    write_guides(tmp_path)
    guide = Guide.load(tmp_path / f"{name}.guide")
    places = {key: np.zeros((5, 3), np.float32) for key in ("position", "normal", "outgoing")}
    for decision in guide.models:
        width = {"path": guide.dims, "emitter": 1}.get(decision, 2)
        u = np.full((5, width), 0.5, np.float32)
        u[:, -1] = [1.0, -1e-6, np.inf, -np.inf, np.nan]
        density = guide.log_prob(u, decision=decision, contexts=places)
        assert not np.isnan(density).any(), decision
        assert name == "realnvp" or (density == -np.inf).all(), decision


@pytest.mark.long
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("kind", KINDS)
def test_very_many_wild_guides_are_told_in_one_line(
    kind: str, tmp_path: Path, record: dict[str, Any]
) -> None:
    record |= dict(_check(kind, range(QUICK, QUICK + ALL), tmp_path))
