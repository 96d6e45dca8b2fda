"""Fails when fewer tests ran than `count.txt` says: a suite that silently shrinks looks as green as a full one.

    python tests/check_count.py python-quick=out/tests/python rust-quick=out/tests/rust.log

A Python report is a folder of pytest's JUnit XML files, a Rust one the output of `cargo test`. Tests that ran and
failed count as run. Skipped ones do not, unless their reason names what a machine may lack: PSSFLOW_SCENES, the folder
of third-party scenes, or Chromium, a browser.
"""

from __future__ import annotations

import re
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

COUNTS = Path(__file__).resolve().parent / "count.txt"
ALLOWED_SKIPS = ("PSSFLOW_SCENES", "no Chromium is installed")


def expected(text: str) -> dict[str, int]:
    """The numbers of `count.txt`, by name; `#` starts a comment line."""
    pairs = (line.split() for line in text.splitlines() if line.strip() and line[0] != "#")
    return {name: int(number) for name, number in pairs}


def ran_in_pytest(xml: str) -> int:
    """Tests of a JUnit report that ran, or were skipped for want of what a machine may lack."""
    skips = [
        skip.get("message", "")
        for skip in ET.fromstring(xml).iter("skipped")
        if skip.get("type") != "pytest.xfail"  # an expected failure did run
    ]
    lost = sum(not any(allowed in reason for allowed in ALLOWED_SKIPS) for reason in skips)
    return sum(1 for _ in ET.fromstring(xml).iter("testcase")) - lost


def ran_in_cargo(log: str) -> int:
    """Tests and doctests of all crates that ran, passed or not."""
    results = re.findall(r"^test result: .*? (\d+) passed; (\d+) failed;", log, flags=re.M)
    return sum(int(passed) + int(failed) for passed, failed in results)


def main(arguments: list[str]) -> int:
    """Compares each `name=report`; returns the exit status."""
    wanted = expected(COUNTS.read_text(encoding="utf-8"))
    status = 0
    for argument in arguments:
        name, _, report = argument.partition("=")
        if name not in wanted or not report:
            print(f"{argument!r}: expected NAME=REPORT with NAME one of {', '.join(wanted)}")
            return 2
        if name.startswith("rust"):
            ran = ran_in_cargo(Path(report).read_text(encoding="utf-8"))
        else:
            parts = sorted(Path(report).glob("*.xml"))
            ran = sum(ran_in_pytest(part.read_text(encoding="utf-8")) for part in parts)
        if ran < wanted[name]:
            print(
                f"{name}: {ran} tests ran, {wanted[name]} must. "
                f"Tests were lost or skipped ({report}); if on purpose, lower tests/count.txt"
            )
            status = 1
        elif ran > wanted[name]:
            print(
                f"{name}: {ran} tests ran, more than the {wanted[name]} of tests/count.txt: raise it"
            )
        else:
            print(f"{name}: {ran} tests ran, as many as they should")
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
