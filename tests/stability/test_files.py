"""Files that are cut, disks that are full, studies that are stopped: one line, and never half a file."""

from __future__ import annotations

import resource
import signal
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import pssflow
from pssflow.cli import commands
from pssflow.guide import Guide
from pssflow.study.stability.life import in_a_worker
from pssflow.study.stability.parts import room
from pssflow.terminal import run_command
from tests.conftest import SCALAR

GUIDES: dict[str, dict[str, Any]] = {
    "vegas": {"bins": 4, "tiles": 1},
    "table": {"memory_mib": 1},
    "realnvp": {"epochs": 1, "samples": 256, "couplings": 2, "hidden": 8, "layers": 1},
    "mixture-net": {"epochs": 1, "hidden": 8, "layers": 1, "components": 2},
}
"""Guides as small as they can be."""


def _fitted(name: str) -> Guide:
    mi.set_variant(SCALAR)
    pilot = pssflow.Scene(room(8)).pilot(spp=8, seed=1)
    return pilot.fit(name, **GUIDES[name])


def _check_cuts(name: str, folder: Path, step: int) -> int:
    path = folder / "cut.guide"
    _fitted(name).save(path)
    whole = path.read_bytes()
    Guide.load(path)
    cuts = range(0, len(whole), step)
    for cut in cuts:
        path.write_bytes(whole[:cut])
        with pytest.raises(ValueError, match=r"cut\.guide") as caught:
            Guide.load(path)
        assert "\n" not in str(caught.value)
    return len(cuts)


@pytest.mark.timeout(300)
@pytest.mark.parametrize("name", GUIDES)
def test_a_guide_cut_short_is_refused(name: str, tmp_path: Path) -> None:
    _check_cuts(name, tmp_path, 1 if name == "vegas" else 101)


@pytest.mark.long
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("name", GUIDES)
def test_a_guide_cut_at_every_byte_is_refused(name: str, tmp_path: Path) -> None:
    _check_cuts(name, tmp_path, 1)


@pytest.mark.timeout(900)
def test_a_full_disk_leaves_nothing(tmp_path: Path) -> None:
    """A limit on the size of files stands for the disk: guide, image and pilot are refused and removed."""
    mi.set_variant(SCALAR)
    scene = pssflow.Scene(room(16))
    pilot = scene.pilot(spp=1)
    result = scene.render("none", 1, progress=False)
    # The core's part is loaded by now; the worker only writes.
    writers = {
        "guide": pilot.fit("vegas").save,
        "image.exr": result.write,
        "pilot.npz": pilot.save,
    }
    for name, write in writers.items():
        answer = in_a_worker(_write_full, (write, str(tmp_path / name)))
        assert answer.startswith("OSError"), answer
        assert "\n" not in answer
    assert list(tmp_path.iterdir()) == []


def _write_full(job: Any) -> str:
    write, path = job
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
    try:
        write(path)
    except OSError as error:
        return f"OSError: {error}"
    return "written"


@pytest.mark.timeout(300)
def test_an_interrupt_ends_a_render(tmp_path: Path) -> None:
    """What a progress function raises is what Ctrl-C raises; the render is over in a moment and can be repeated."""
    mi.set_variant(SCALAR)
    scene = pssflow.Scene(room(256))

    def interrupt(phase: str, share: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        scene.render("table", 4096, progress=interrupt)
    assert np.isfinite(scene.render("table", 2, progress=False).image).all()


@pytest.mark.timeout(900)
def test_the_study_resumes(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """What was found out once is not found out again; an interrupted study goes on behind it."""
    folder = tmp_path / "out"
    command = ["study", "stability", "--quick", "--seeds", "2", "--cases", "14,files-nope"]
    assert run_command(commands, [*command, "-o", str(folder)]) == 2
    command[command.index("14,files-nope")] = "14"
    assert run_command(commands, [*command, "--guides", "vegas", "-o", str(folder)]) == 0
    first = (folder / "results.csv").read_text(encoding="utf-8").splitlines()
    capfd.readouterr()
    page = tmp_path / "page.md"
    more = [*command, "--guides", "vegas,auto", "-o", str(folder), "--page", str(page)]
    page.write_text("# Limits\n", encoding="utf-8")
    assert run_command(commands, more) == 2
    said = capfd.readouterr().err
    assert "page.md: has no lines <!-- pssflow study stability -->" in said
    assert "easy-scene, auto" in said
    assert "easy-scene, vegas" not in said
    second = (folder / "results.csv").read_text(encoding="utf-8").splitlines()
    assert len(first) == 2
    assert set(first) < set(second)
    names = {path.name for path in folder.iterdir()}
    assert names == {"results.csv", "summary.md", "stability.png", "stability.svg"}
    assert "| 14. An easy scene | vegas |" in (folder / "summary.md").read_text(encoding="utf-8")
    # What was written by hand stays, and what stood between the marks does not.
    hand = "# Limits\n\n<!-- pssflow study stability -->{}<!-- end -->\n\nIn plain words.\n"
    page.write_text(hand.format("\nstale\n"), encoding="utf-8")
    assert run_command(commands, more) == 0
    filled = page.read_text(encoding="utf-8")
    start, end = hand.split("{}")
    assert filled.startswith(start)
    assert filled.endswith(end)
    assert "| case | vegas | auto |" in filled
    assert "stale" not in filled
    assert [p.name for p in (tmp_path / "page").iterdir()] == ["easy-scene.png"]
