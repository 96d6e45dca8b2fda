"""results.csv: a row for each image, or other thing, that a study measured.

A run (one method, one scene, one seed) yields as many rows as it had times. The file is rewritten whole and renamed, so
that it never holds half a run, whatever interrupts the study.
"""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import json
import os
import platform
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol, TypeVar

from ..files import first_line, write_beside

__all__ = [
    "ALL",
    "BOUNCES",
    "Row",
    "Store",
    "Stored",
    "commit",
    "configuration",
    "parse",
    "processor",
    "write_rows",
]

BOUNCES, ALL = "k bounces", "all"
"""What a truth, and a method, holds: light of exactly k bounces, or all light. The two are never compared."""


@dataclasses.dataclass(frozen=True)
class Row:
    """One image and its errors, relative to the reference about each pixel (`pssflow.metrics.local_scale`)."""

    scene: str
    scene_hash: str
    """Of what was rendered."""
    method: str
    seed: int
    time: float
    """Budget in seconds, or samples per pixel; `budget` says what is inside."""
    unit: str
    """Of the budget: `s` or `spp`."""
    light: str
    """What was rendered: light of `k bounces`, or `all`."""
    budget: str
    """What the time counts and what it does not, in words."""
    elapsed: float
    """Seconds really used."""
    longest: float
    """Budget of the run that this is a part of; by samples, each is a run of its own."""
    chosen: str
    """What drew the last pass."""
    width: int
    height: int
    k: int
    emitter_strategy: str
    spp: int
    """Samples per pixel in the image; 0 where the method had none by that time: then the errors are NaN."""
    paths: int
    seconds_pilot: float | None
    seconds_fit: float | None
    seconds_render: float | None
    seconds_warm_up: float | None
    """Outside of the time: compiling, where the method does."""
    nonzero_share: float | None
    """Paths that carry light, of those found."""
    parameters: int | None
    """Weights that the method learned."""
    predicted_gain: float | None
    """Variance per path, random ÷ the method's, foretold by held-out paths."""
    relmse: float
    relmse_error: float
    """Standard error from the spread between pixels."""
    relmse_trimmed: float
    relmse_pixel: float
    """RelMSE by its usual formula, ÷ each pixel's own square: comparable with other programs, and off where the
    reference is noisy."""
    mape: float
    flip: float | None
    """Mean of HDR-FLIP; None where the package `flip-evaluator` is missing."""
    own_variance: float | None
    """The image's relMSE as predicted by its own variance, without the truth's noise."""
    reference_variance: float
    """The truth's own, in the same measure: subtracted from `relmse`."""
    reference_seconds: float
    threads: int
    load_before: float
    """Load average of one minute; it holds the run itself as well."""
    load_after: float
    options: str
    """The method's own, JSON."""
    configuration: str
    """Hash of all that decides the row, but for the machine."""
    study: str
    """Hash of what all rows of a study share: budgets, settings, sources. Others are compared with none of these."""
    commit: str
    version: str
    mitsuba: str
    processor: str
    when: str

    @property
    def spent(self) -> float:
        """What was used of the budget, in its unit."""
        return self.elapsed if self.unit == "s" else float(self.spp)

    @property
    def run(self) -> tuple[str, str, int]:
        """Scene, method, seed."""
        return self.scene, self.method, self.seed


T = TypeVar("T", bound="Stored")


class Stored(Protocol):
    """A row of a table: a dataclass of texts and numbers, each of which may be None if its type says so."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def run(self) -> tuple[str, str, int]:
        """What it is a result of; a run's rows are kept or replaced together."""
        ...

    @property
    def configuration(self) -> str:
        """Hash of all that decides it."""
        ...


def parse(kind: type[T], texts: Mapping[str, str]) -> T:
    """A row as the file has it.

    Raises:
        ValueError: a column is missing or holds no number.
    """
    values: dict[str, Any] = {}
    for item in dataclasses.fields(kind):
        text = texts.get(item.name)
        if text is None:
            raise ValueError(f"column `{item.name}` is missing")
        declared = str(item.type)
        if text == "" and "None" in declared:
            values[item.name] = None
        elif declared.startswith("int"):
            values[item.name] = int(text)
        elif declared.startswith("float"):
            values[item.name] = float(text)
        else:
            values[item.name] = text
    return kind(**values)


class Store(Generic[T]):
    """The rows of one file.

    Raises:
        ValueError: the file is there, but is none of ours.
    """

    def __init__(self, path: str | Path, kind: type[T]) -> None:
        self.path = Path(path)
        self.rows: list[T] = []
        if self.path.exists():
            try:
                with self.path.open(newline="", encoding="utf-8") as file:
                    self.rows = [parse(kind, texts) for texts in csv.DictReader(file)]
            except (OSError, ValueError, csv.Error) as error:
                raise ValueError(
                    f"{self.path}: is no table of this version of pssflow ({first_line(error)}); "
                    "move it away, or choose another folder"
                ) from None

    def has(self, configuration: str) -> bool:
        """Whether a finished run of this configuration is there."""
        return any(row.configuration == configuration for row in self.rows)

    def put(self, rows: Iterable[T]) -> None:
        """Writes the rows of one run, in place of those of the same scene, method and seed.

        Raises:
            OSError: the file cannot be written.
        """
        new = list(rows)
        runs = {row.run for row in new}
        self.rows = [row for row in self.rows if row.run not in runs] + new
        write_rows(self.path, self.rows)


def write_rows(path: Path, rows: Sequence[Stored]) -> None:
    """Rows of one kind, at least one, as a CSV that `Store` reads.

    Raises:
        OSError: the file cannot be written.
    """

    def write(part: Path) -> None:
        with part.open("w", newline="", encoding="utf-8") as file:
            names = [item.name for item in dataclasses.fields(rows[0])]
            writer = csv.DictWriter(file, names, lineterminator="\n")
            writer.writeheader()
            writer.writerows(dataclasses.asdict(row) for row in rows)

    write_beside(path, write)


def configuration(**what: Any) -> str:
    """Hash of all that decides a run; the compiled core, and with it the estimator, and what measures are in it."""
    text = json.dumps(what | {"core": _core_hash(), "sources": _sources_hash()}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


@cache
def _core_hash() -> str:
    from .. import _core

    return hashlib.sha256(Path(str(_core.__file__)).read_bytes()).hexdigest()


SHOWING = ("charts", "drawing", "findings", "page", "report", "results", "summary")
"""Last words of modules that only show what was measured: an edit there makes no run another one."""


@cache
def _sources_hash() -> str:
    """Of the measures and of the studies' own sources."""
    here = Path(__file__).parent
    deciding = [path for path in here.rglob("*.py") if path.stem.split("_")[-1] not in SHOWING]
    found = hashlib.sha256()
    for path in sorted([*deciding, here.parent / "metrics.py"]):
        found.update(f"{path.relative_to(here.parent)}\0".encode() + path.read_bytes())
    return found.hexdigest()


@cache
def commit() -> str:
    """The commit of the sources, with a plus sign if files differ from it; `unknown` outside a repository."""
    command = ["git", "describe", "--always", "--abbrev=8", "--exclude=*", "--dirty=+"]
    try:
        folder = Path(__file__).parent
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return done.stdout.strip()


@cache
def processor() -> str:
    """Model and number of cores."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        text = ""
    names = (line.partition(":")[2] for line in text.splitlines() if line.startswith("model name"))
    return f"{os.cpu_count()} × {' '.join(next(names, platform.machine()).split())}"
