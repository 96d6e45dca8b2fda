"""Cases that are no scenes: damaged files, full disks, interrupts, and memory that runs out."""

from __future__ import annotations

import multiprocessing
import resource
import signal
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from ...files import first_line
from ...guide import Guide
from ...scene import Scene
from .case import THESIS, Case, Effort, Finding, render_options
from .parts import room

__all__ = ["FILES", "MEMORY"]

FLOWS = (THESIS, "realnvp", "realnvp-logit")
"""Guides of the whole path."""

CUTS = 200
"""Lengths that a guide's file is cut to in the study; `tests/stability` cuts at every byte."""

PATIENCE = 600.0
"""Seconds for a worker, which takes a few: whoever is not done by then hangs."""


def _files(guide: str, effort: Effort, folder: Path) -> Finding | None:
    """Interrupts a render, cuts a guide's file, and fills the disk while it is written."""
    how = render_options(guide, effort) | {"threads": effort.threads, "progress": False}
    interrupted = Scene(room(256))
    try:
        # So long that it cannot be over before it is asked for its progress.
        interrupted.render(**{**how, "progress": _interrupt}, spp=1024)
        return Finding("fails", "an interrupt was ignored")
    except KeyboardInterrupt:
        pass
    again, fresh = (s.render(**how, spp=2, seed=3).image for s in (interrupted, Scene(room(256))))
    if not np.array_equal(again, fresh):
        return Finding("fails", "after an interrupt the scene renders another image")
    scene = Scene(room(effort.side))
    result = scene.render(**how, spp=effort.spp, seed=3)
    if not isinstance(result.guide, Guide):
        return Finding("holds", "interrupted at once; there is no file")
    path = folder / f"cut-{guide.replace('+', '_')}.guide"
    result.guide.save(path)
    whole = path.read_bytes()
    try:
        for cut in sorted({round(i * (len(whole) - 1) / CUTS) for i in range(CUTS + 1)}):
            path.write_bytes(whole[:cut])
            try:
                Guide.load(path)
                return Finding("fails", f"{cut} of {len(whole)} bytes were taken for a guide")
            except ValueError as error:
                if "\n" in str(error):
                    return Finding("fails", "the refusal has several lines")
        path.unlink()
        full = in_a_worker(_write_on_full_disk, (result.guide, str(path)))
        if full != "refused":
            return Finding("fails", f"full disk: {full}")
        left = [p.name for p in folder.iterdir() if p.name.startswith((path.name, f".{path.name}"))]
        if left:
            return Finding("fails", f"half-written files are left: {', '.join(left)}")
    finally:
        path.unlink(missing_ok=True)
    return Finding(
        "holds", f"{min(CUTS + 1, len(whole))} cuts of {len(whole)} bytes refused, full disk told"
    )


def _interrupt(phase: str, share: float) -> None:
    raise KeyboardInterrupt


def _write_on_full_disk(job: tuple[Guide, str]) -> str:
    guide, path = job
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (64, 64))
    try:
        guide.save(path)
    except OSError:
        return "refused"
    return "written into 64 bytes"


FILES = Case(
    17,
    "interrupts-and-files",
    "Interrupts, cut files, full disks",
    "Ctrl-C in the middle, a guide's file cut at any byte, a disk without room: one clear line, nothing half-written.",
    probe=_files,
)


def _memory(guide: str, effort: Effort, folder: Path) -> Finding | None:
    """Renders in a process whose memory does not suffice: it must end with a word, and leave no file."""
    target = folder / f"memory-{guide.replace('+', '_')}.exr"
    answer = in_a_worker(_render_in_little, (guide, effort, str(target)))
    left = [p.name for p in folder.iterdir() if target.name in p.name and p != target]
    target.unlink(missing_ok=True)
    if left:
        return Finding("fails", f"half-written files are left: {', '.join(left)}")
    if answer == f"died: {signal.SIGABRT.name}":
        return Finding(
            "degrades", answer, "the system's allocator ends the process; no file is half-written"
        )
    if answer.startswith("died"):
        return Finding("fails", answer)
    if answer.startswith("fits"):
        return Finding("holds", f"not tested: it {answer}")
    return Finding("holds", answer)


ROOM = 64 << 20
"""Bytes that a render may take beyond what loading and a first small one took: less than its records want."""


def _render_in_little(job: tuple[str, Effort, str]) -> str:
    guide, effort, target = job
    scene = Scene(room(256))
    how = render_options(guide, effort) | {"threads": 1, "progress": False}
    # Twenty-four vertices a path; whole-path flows keep none, and learn two bounces as ever.
    how["k"] = 2 if guide in FLOWS else 24
    # What threads and libraries take once does not count.
    scene.render(**how, spp=2)
    with Path("/proc/self/statm").open(encoding="ascii") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + ROOM, used + ROOM))
    try:
        result = scene.render(**how, spp=8, pilot_spp=4, seed=1)
        result.write(target)
    except (MemoryError, RuntimeError, OSError, ValueError) as error:
        return f"told: {first_line(error)[:100]}"
    short = [note for note in result.notes if "memory" in note]
    return short[0] if short else f"fits into {ROOM >> 20} MiB more"


MEMORY = Case(
    18,
    "memory-runs-out",
    "Memory runs out while learning",
    "The records of a pilot do not fit: the process may stop, but with a word and without half a file.",
    probe=_memory,
)


def in_a_worker(function: Callable[[Any], str], job: Any) -> str:
    """What `function(job)` returned in a process of its own, or how that died."""
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe()
    worker = context.Process(target=_work, args=(theirs, function, job), daemon=True)
    worker.start()
    theirs.close()
    try:
        if not ours.poll(PATIENCE):
            return f"died: not done after {PATIENCE:g} s"
        return ours.recv()
    except EOFError:
        worker.join()
        code = worker.exitcode or 0
        return f"died: {signal.Signals(-code).name if code < 0 else f'exit code {code}'}"
    finally:
        worker.kill()
        worker.join()
        ours.close()


def _work(answers: Connection, function: Callable[[Any], str], job: Any) -> None:
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    answers.send(function(job))
