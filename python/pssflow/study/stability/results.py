"""results.csv of the stability study: a row for each case and guide, and the table and chart that are made of them."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from rich.table import Table

from ... import _core
from ...files import first_line, write_beside
from ...report import markdown_table
from ..store import commit, processor
from ..verdicts import VERDICT_COLOURS, verdict_chart
from .case import THESIS, Case, Effort, Finding

__all__ = ["Row", "Rows", "publish"]

STYLES = {"holds": "green", "degrades": "yellow", "fails": "red"}

FIGURES = (
    "ratio",
    "ratio_error",
    "bound",
    "bound_error",
    "max_weight",
    "p",
    "outlier",
    "pareto_k",
    "warned",
)
"""Numbers of a finding that have a column."""


@dataclasses.dataclass(frozen=True)
class Row:
    """What a guide made of a case."""

    number: int
    case: str
    guide: str
    verdict: str
    figure: str
    why: str
    warnings: str
    """The first two."""
    ratio: str
    """relMSE ÷ that of random numbers at equal samples: medians over seeds, or means (`measure`)."""
    ratio_error: str
    """Its standard error."""
    bound: str
    """a · E[(f/m)²] ÷ E[f²]."""
    bound_error: str
    max_weight: str
    p: str
    """Welch's, of image and tiles."""
    outlier: str
    """The worst seed's relMSE ÷ the median."""
    pareto_k: str
    warned: str
    """Share of the renders that warn."""
    seeds: int
    spp: int
    side: int
    configuration: str
    commit: str
    version: str
    processor: str
    when: str

    @classmethod
    def of(cls, case: Case, guide: str, found: Finding, effort: Effort, configuration: str) -> Row:
        """A finding as a row."""
        numbers = {name: _text(found.numbers.get(name)) for name in FIGURES}
        return cls(
            number=case.number,
            case=case.name,
            guide=guide,
            verdict=found.verdict,
            figure=found.figure,
            why=found.why,
            warnings=" | ".join(found.warnings[:2]),
            **numbers,
            seeds=effort.seeds,
            spp=effort.spp,
            side=effort.side,
            configuration=configuration,
            commit=commit(),
            version=_core.__version__,
            processor=processor(),
            when=datetime.now(timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ"),
        )


class Rows:
    """The rows of one file, rewritten whole after each finding.

    Raises:
        ValueError: the file is there, but is none of ours.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: list[Row] = []
        if not path.exists():
            return
        try:
            with path.open(newline="", encoding="utf-8") as file:
                for texts in csv.DictReader(file):
                    values: dict[str, Any] = {
                        f.name: texts[f.name] for f in dataclasses.fields(Row)
                    }
                    for name in ("number", "seeds", "spp", "side"):
                        values[name] = int(values[name])
                    self.rows.append(Row(**values))
        except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
            raise ValueError(
                f"{path}: is no table of this version of pssflow ({first_line(error)}); "
                "move it away, or choose another folder"
            ) from None

    def find(self, configuration: str) -> Row | None:
        """The row of a configuration, if there is one."""
        return next((row for row in self.rows if row.configuration == configuration), None)

    def put(self, new: Row) -> None:
        """Writes a row in place of that of the same case and guide.

        Raises:
            OSError: the file cannot be written.
        """
        others = [row for row in self.rows if (row.case, row.guide) != (new.case, new.guide)]
        self.rows = sorted([*others, new], key=lambda row: row.number)

        def write(part: Path) -> None:
            with part.open("w", newline="", encoding="utf-8") as file:
                names = [field.name for field in dataclasses.fields(Row)]
                writer = csv.DictWriter(file, names, lineterminator="\n")
                writer.writeheader()
                writer.writerows(dataclasses.asdict(row) for row in self.rows)

        write_beside(self.path, write)


def publish(
    folder: Path, rows: Sequence[Row], guides: Sequence[str], titles: dict[str, str], heading: str
) -> Table:
    """Writes summary.md and the chart, and returns the table for the console.

    Raises:
        OSError: a file cannot be written.
    """
    cases, cells = _grid(rows)
    shown = Table(title=heading)
    shown.add_column("case")
    for guide in guides:
        shown.add_column(guide)
    for case in cases:
        texts = [titles[case]]
        for guide in guides:
            row = cells.get((case, guide))
            texts.append(
                "–" if row is None else f"[{STYLES[row.verdict]}]{row.verdict}[/] {_short(row)}"
            )
        shown.add_row(*texts)
    grid = {
        (titles[case], guide): (row.verdict, _short(row)) for (case, guide), row in cells.items()
    }
    names = [titles[case] for case in cases]
    verdict_chart(folder / "stability.png", heading, names, guides, grid, CAPTION)
    counts = [
        [
            guide,
            *(str(sum(r.verdict == v for r in rows if r.guide == guide)) for v in VERDICT_COLOURS),
        ]
        for guide in guides
    ]
    lines = [
        f"# {heading}",
        CAPTION,
        _verdicts(rows, guides, titles),
        _moments(rows),
        markdown_table(["guide", *VERDICT_COLOURS], counts),
        "## Figures",
        markdown_table(
            ["case", "guide", "verdict", "figure", "beside"],
            [[titles[r.case], r.guide, r.verdict, r.figure, _beside(r)] for r in rows],
            texts=5,
        ),
    ]
    text = "\n\n".join(lines) + "\n"
    write_beside(folder / "summary.md", lambda part: part.write_text(text, encoding="utf-8"))
    return shown


def fill_page(
    page: Path, rows: Sequence[Row], guides: Sequence[str], titles: dict[str, str], heading: str
) -> None:
    """Puts the table, with what it was measured, between the marks of a page that is otherwise written by hand.

    Raises:
        OSError: the page cannot be written.
        ValueError: it has no such marks.
    """
    before, opening, rest = page.read_text(encoding="utf-8").partition(MARKS[0])
    _, closing, after = rest.partition(MARKS[1])
    if not opening or not closing:
        raise ValueError(f"{page}: has no lines {MARKS[0]} and {MARKS[1]} to put a table between")
    days = sorted({row.when[:10] for row in rows})
    made = [" to ".join(dict.fromkeys((days[0], days[-1])))]
    made += ["commit " + ", ".join(sorted({row.commit for row in rows}))]
    made += sorted({row.processor for row in rows})
    parts = [f"{heading}.", _verdicts(rows, guides, titles), _moments(rows), "; ".join(made) + "."]
    text = "\n\n".join([before + opening, *parts, closing + after])
    write_beside(page, lambda part: part.write_text(text, encoding="utf-8"))


MARKS = ("<!-- pssflow study stability -->", "<!-- end -->")
"""Lines of a page between which the table is put."""

CAPTION = (
    "Numbers are relMSE ÷ that of as many random samples: medians over seeds, with their standard errors; means for "
    "thesis and in cases 3 and 15, where a few paths decide. Holds: finite, unbiased, no weight above 1/a, at most "
    "1.3. Degrades: safe, but slower. Fails: biased, unbounded, not finite, or more than ten times slower at a = 0. "
    "thesis: a = 0; all others with the guide's own share a of random numbers."
)


def _grid(rows: Sequence[Row]) -> tuple[list[str], dict[tuple[str, str], Row]]:
    """The cases, and each one's row of each guide."""
    return list(dict.fromkeys(row.case for row in rows)), {(r.case, r.guide): r for r in rows}


def _verdicts(rows: Sequence[Row], guides: Sequence[str], titles: dict[str, str]) -> str:
    """The table of verdicts."""
    cases, cells = _grid(rows)
    lines = [
        [titles[case], *(_cell(cells.get((case, guide))) for guide in guides)] for case in cases
    ]
    return markdown_table(["case", *guides], lines, texts=1 + len(guides))


def _moments(rows: Sequence[Row]) -> str:
    """The largest second moment that a guide with 0 < a < 1 came to, as far as it is sure."""
    bounded = [row for row in rows if row.bound and row.guide not in (THESIS, "auto")]
    if not bounded:
        return ""
    row = max(bounded, key=lambda row: float(row.bound) - 2 * float(row.bound_error))
    return (
        "The largest a·E[(f/m)²] ÷ E[f²] of a guide with a > 0, less two of its standard errors, belongs to "
        f"{row.guide} in case {row.number}; theory allows 1: "
        f"{float(row.bound):.3g} ± {float(row.bound_error):.1g}."
    )


def _short(row: Row) -> str:
    if not row.ratio:
        return ""
    error = f" ± {_rounded(float(row.ratio_error), 1)}" if row.ratio_error else ""
    return _rounded(float(row.ratio), 2) + error


def _rounded(value: float, digits: int) -> str:
    """So many digits, without an exponent while that is no longer than a few zeros."""
    text = f"{value:.{digits}g}"
    return f"{float(text):.0f}" if 1 <= abs(value) < 1e5 and "e" in text else text


def _cell(row: Row | None) -> str:
    return "–" if row is None else f"{row.verdict} {_short(row)}".strip()


def _beside(row: Row) -> str:
    return "; ".join(part for part in (row.why, row.warnings.replace("|", "/")) if part)


def _text(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"
