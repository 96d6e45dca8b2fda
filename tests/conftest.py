"""Fixtures that all tests share: Mitsuba's variants, the folder of third-party scenes, and where pictures go."""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import mitsuba as mi
import pytest

ROOT = Path(__file__).resolve().parents[1]
SCALAR, LLVM = "scalar_rgb", "llvm_ad_rgb"


_status: list[int] = []


def pytest_sessionfinish(exitstatus: int) -> None:
    """Keeps the exit status for `pytest_unconfigure`."""
    _status.append(int(exitstatus))


@pytest.hookimpl(trylast=True)
def pytest_unconfigure() -> None:
    """Leaves the process once all is reported, without its static destructors.

    Mitsuba 3.9.1 frees the cache of its pixel converters there (`struct_jit::clear_cache`, a read at address 8). After
    a session of a thousand tests that crashed once, and a green run counted as red.
    """
    if _status:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(_status[-1])


@pytest.fixture(params=[SCALAR, LLVM])
def variant(request: pytest.FixtureRequest) -> str:
    """Runs the test once in each variant that pssflow supports."""
    mi.set_variant(request.param)
    return request.param


@pytest.fixture
def scalar_variant() -> str:
    """Sets `scalar_rgb`, which needs no LLVM and compiles nothing."""
    mi.set_variant(SCALAR)
    return SCALAR


@pytest.fixture
def llvm_variant() -> str:
    """Sets `llvm_ad_rgb`; a machine without libLLVM fails here, on purpose: see `make`'s notice about libllvm19."""
    mi.set_variant(LLVM)
    return LLVM


@pytest.fixture(scope="session")
def shared_scenes() -> Path:
    """The folder of third-party scenes, from the environment variable PSSFLOW_SCENES; skips where there is none."""
    folder = os.environ.get("PSSFLOW_SCENES")
    if not folder or not Path(folder).is_dir():
        pytest.skip("PSSFLOW_SCENES names no folder: third-party scenes are absent")
    return Path(folder)


def _folder(request: pytest.FixtureRequest, kind: str) -> Path:
    """A test's own folder below `out/tests`."""
    name = re.sub(r"[^\w.-]+", "-", request.node.name).strip("-")
    return ROOT / "out" / "tests" / kind / Path(request.node.path).stem / name


@pytest.fixture
def artifacts(request: pytest.FixtureRequest) -> Path:
    """Where a failing test leaves its pictures: `out/tests/artifacts/<file>/<test>`. Made by who writes there."""
    return _folder(request, "artifacts")


@pytest.fixture
def record(request: pytest.FixtureRequest) -> Iterator[dict[str, float]]:
    """Numbers to keep whether the test passes or not: `out/tests/records/<file>/<test>.json`.

    Not pytest's `record_property`, which the JUnit format of `make test` does not take.
    """
    numbers: dict[str, float] = {}
    yield numbers
    folder = _folder(request, "records")
    folder.parent.mkdir(parents=True, exist_ok=True)
    folder.with_name(folder.name + ".json").write_text(json.dumps(numbers), encoding="utf-8")
