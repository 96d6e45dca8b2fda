"""Writing files so that nobody ever sees half of one, and messages that fit into one line."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from pathlib import Path

__all__ = ["check_writable", "first_line", "write_beside"]


def write_beside(path: str | Path, write: Callable[[Path], object]) -> None:
    """Lets `write` fill a file next to `path`, then renames it; whatever fails, nothing half-written is left.

    Raises:
        OSError: the file cannot be written; the message names it.
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        write(part)
        part.replace(path)
    except OSError as error:
        raise OSError(f"{path}: cannot be written: {error.strerror or first_line(error)}") from None
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def check_writable(path: str | Path) -> None:
    """Finds out before minutes of work whether a file can be written later. Leaves nothing behind.

    Raises:
        OSError: it cannot; the message names the file and says why.
    """
    path = Path(path)
    if path.is_dir():
        raise OSError(f"{path}: cannot be written: it is a folder; name a file in it")
    if not path.parent.is_dir():
        raise OSError(f"{path}: cannot be written: there is no folder {path.parent}")
    probe = path.with_name(f".{path.name}.{os.getpid()}.probe")
    try:
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise OSError(f"{path}: cannot be written: {error.strerror}") from None


def first_line(error: BaseException) -> str:
    """An exception's message in one line.

    Mitsuba prefixes its messages with a place in its own source, and appends Python's traceback where a plugin written
    in Python failed; of that only the last line tells a user something.
    """
    text = str(error).strip() or type(error).__name__
    if text.endswith("(see above).") and error.__cause__ is not None:
        return first_line(error.__cause__)  # Dr.Jit wraps what a renderer raised
    before, traceback, after = text.partition("Traceback (most recent call last):")
    if traceback:
        lines = [line for line in after.splitlines() if line.strip()]
        text = before + (lines[-1].partition(": ")[2] or lines[-1] if lines else "")
    text = " ".join(text.split())
    if text.startswith("[") and ".cpp:" in text.partition("]")[0]:
        text = text.partition("]")[2].strip()
    return text
