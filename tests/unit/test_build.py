"""The house itself: what `make` relies on."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests import check_count

ROOT = Path(__file__).resolve().parents[2]


def _features(*selection: str) -> dict[str, str]:
    """Features of every package that cargo would build for `selection`, by name and version."""
    command = ["cargo", "tree", "--locked", "--prefix=none", "--no-dedupe", "-f", "{p} [{f}]"]
    result = subprocess.run(
        [*command, *selection], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    lines = (
        line.removesuffix(" (*)").rstrip("]").rpartition(" [")
        for line in result.stdout.splitlines()
    )
    return {package: features for package, _, features in lines if package}


@pytest.mark.skipif(shutil.which("cargo") is None, reason="no cargo: nothing is built here")
def test_cargo_test_compiles_no_dependency_a_second_time() -> None:
    """The extension and the Rust tests are built by two commands. A dev-dependency that turns on a feature of a package
    which both use makes cargo compile it, and all that stands on it (candle!), twice.
    """
    extension = _features("-p", "pss-py", "-e", "normal,build")
    tests = _features("--workspace", "-e", "normal,build,dev")
    assert len(extension) > 20
    differ = {name: (f, tests[name]) for name, f in extension.items() if tests.get(name) != f}
    assert not differ, f"name these features in the workspace's own dependencies: {differ}"


def test_make_help_lists_every_target() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    documented = set(re.findall(r"^([a-z-]+):[^\n=]*## ", makefile, flags=re.M))
    assert documented == {
        *(
            "help",
            "build",
            "demo",
            "test",
            "test-long",
            "lint",
            "bench",
            "study-scaling",
            "coverage",
            "study-guides",
            "study-speed-accuracy",
            "study-thesis",
            "study-capacity",
            "study-gradients",
            "study-light",
            "study-stability",
            "results",
            "docs",
            "clean",
        )
    }


REPORT = """<testsuites><testsuite>
<testcase name="passes"/>
<testcase name="fails"><failure message="no"/></testcase>
<testcase name="known"><skipped type="pytest.xfail" message="bug"/></testcase>
<testcase name="scenes"><skipped type="pytest.skip" message="PSSFLOW_SCENES names no folder"/></testcase>
<testcase name="page"><skipped type="pytest.skip" message="no Chromium is installed (apt)"/></testcase>
<testcase name="lost"><skipped type="pytest.skip" message="no GPU"/></testcase>
</testsuite></testsuites>"""
LOG = """
test result: ok. 3 passed; 0 failed; 1 ignored; 0 measured; 0 filtered out; finished in 0.00s
test result: FAILED. 1 passed; 2 failed; 0 ignored; 0 measured; 0 filtered out; finished in 0.00s
"""


def test_count_leaves_out_tests_that_were_skipped() -> None:
    assert check_count.ran_in_pytest(REPORT) == 5
    assert check_count.ran_in_cargo(LOG) == 6


@pytest.mark.parametrize(("wanted", "status"), [(9, 0), (10, 0), (11, 1)])
def test_count_fails_when_tests_were_lost(
    wanted: int, status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "count.txt").write_text(f"# a comment\npython-quick {wanted}\n")
    for part in ("unit", "parity"):
        (tmp_path / f"{part}.xml").write_text(REPORT)
    monkeypatch.setattr(check_count, "COUNTS", tmp_path / "count.txt")
    assert check_count.main([f"python-quick={tmp_path}"]) == status
    assert check_count.main(["nonsense"]) == 2
