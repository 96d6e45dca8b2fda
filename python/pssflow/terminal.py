"""How commands talk: results on stdout, all else on stderr, one line for each failure, and the exit code.

Mitsuba and the libraries below it write to stdout whenever they like. While a command runs, that goes to stderr, so
that stdout carries nothing but the result: `pssflow render … --json | jq` works.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TextIO

import click
from rich.console import Console

from .files import first_line
from .output import dump_json

__all__ = ["INTERRUPTED", "Terminal", "run_command"]

FAILED, WRONG_INPUT, INTERRUPTED = 1, 2, 130
"""Exit codes: a library or the machine failed; the input is wrong; Ctrl-C."""

PAGE = 160
"""Columns of a table that goes into a file or a pipe, where no window has a width."""


class Terminal:
    """Where a command writes. `click.pass_obj` hands it to the command."""

    def __init__(self, results: TextIO) -> None:
        self.results = results
        self.out = _console(results)
        """For results."""
        self.err = _console(sys.stderr)
        """For notices."""
        self.quiet = False
        self._said: set[str] = set()

    def say(self, text: str) -> None:
        """A line about what is being done."""
        if not self.quiet:
            self.err.print(text, highlight=False, markup=False, soft_wrap=True, style="dim")

    def note(self, text: str) -> None:
        """A notice that the user should read; the same one is given once."""
        if not self.quiet and text not in self._said:
            self._said.add(text)
            self.err.print(f"pssflow: note: {text}", highlight=False, markup=False, soft_wrap=True)

    def json(self, value: Any) -> None:
        """One JSON object, on one line, as the whole output."""
        self.results.write(dump_json(value) + "\n")
        self.results.flush()


def run_command(command: click.Command, arguments: Sequence[str] | None = None) -> int:
    """Runs a command and returns its exit code. A failure is one line on stderr; nobody sees a traceback.

    Set PSSFLOW_TRACEBACK=1 to see one nevertheless.
    """
    try:
        with _results() as results:
            code = command.main(
                None if arguments is None else list(arguments),
                prog_name=f"pssflow {command.name}" if command.name != "pssflow" else "pssflow",
                standalone_mode=False,
                obj=Terminal(results),
            )
    except Exception as error:
        if os.environ.get("PSSFLOW_TRACEBACK"):
            raise
        message, code = _explain(error)
        print(f"pssflow: error: {message}", file=sys.stderr)  # noqa: T201
        return code
    except KeyboardInterrupt:
        print("pssflow: interrupted", file=sys.stderr)  # noqa: T201
        return INTERRUPTED
    return code if isinstance(code, int) else 0


def _explain(error: Exception) -> tuple[str, int]:
    """What to say about an error, and the exit code."""
    if isinstance(error, click.Abort):
        return "interrupted", INTERRUPTED
    if isinstance(error, click.ClickException):
        return " ".join(error.format_message().split()), WRONG_INPUT
    if isinstance(error, BrokenPipeError):
        return "the reader of the output went away", FAILED
    if isinstance(error, FileNotFoundError | ValueError | TypeError):
        return first_line(error), WRONG_INPUT
    if isinstance(error, OSError | RuntimeError):
        return first_line(error), FAILED
    if isinstance(error, MemoryError):
        return "out of memory; try a smaller film (--scale) or fewer samples", FAILED
    hint = "this is a mistake in pssflow; PSSFLOW_TRACEBACK=1 shows where"
    return f"{type(error).__name__}: {first_line(error)} ({hint})", FAILED


@contextmanager
def _results() -> Iterator[TextIO]:
    """A stream to the real stdout, while file descriptor 1 leads to stderr."""
    sys.stdout.flush()
    real = os.dup(1)
    os.dup2(2, 1)
    # Click's own output (help, version) is a result, too.
    before = sys.stdout
    with open(real, "w", encoding="utf-8", errors="replace", closefd=False) as results:
        sys.stdout = results
        try:
            yield results
        finally:
            sys.stdout = before
            results.flush()
            os.dup2(real, 1)
            os.close(real)


def _console(file: TextIO) -> Console:
    """Rich's console; wide where nothing limits the width."""
    return Console(file=file, width=None if file.isatty() else PAGE)
