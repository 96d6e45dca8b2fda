"""Cases that may crash or hang, each in a forked worker with a time limit.

Importing Mitsuba costs a second, so a server imports it once, before any thread is started, and forks. A worker takes
case after case until one kills it or outlasts its time; a new one goes on behind that case.
"""

from __future__ import annotations

import multiprocessing
import resource
import signal
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

PRELOAD = "tests.support.worker_imports"

START = 60.0
"""Seconds for the first worker, which waits for the imports, to say that it is there."""

MEMORY = 6 << 30
"""Address space of a worker in bytes: a mutation that asks for a terabyte must fail, not swap."""


@dataclass(frozen=True)
class Outcome:
    """What became of one case."""

    case: Any
    answer: Any = None
    """What the function returned, if the worker lived."""
    death: str | None = None
    """How the worker ended, if it did: a signal's name, or "hang"."""
    stage: str = ""
    """The last stage that the function reported before that."""


def run_cases(
    function: Callable[[Any, Callable[[str], None]], Any], cases: Sequence[Any], *, seconds: float
) -> Iterator[Outcome]:
    """Calls `function(case, report)` for each case in forked workers; `report(stage)` says how far it came.

    Args:
        function: of a module that workers can import.
        cases: what pickle can carry.
        seconds: a case may take.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([PRELOAD])
    done = 0
    while done < len(cases):
        ours, theirs = context.Pipe()
        worker = context.Process(target=_work, args=(theirs, function, cases[done:]), daemon=True)
        worker.start()
        theirs.close()
        stage = ""
        try:
            if not ours.poll(START):
                raise RuntimeError(f"no worker started within {START:g} s")
            ours.recv()
            while done < len(cases):
                if not ours.poll(seconds):
                    yield Outcome(cases[done], death="hang", stage=stage)
                    done += 1
                    break
                kind, value = ours.recv()
                if kind == "stage":
                    stage = value
                else:
                    yield Outcome(cases[done], answer=value)
                    done, stage = done + 1, ""
        except (EOFError, ConnectionResetError):
            worker.join()
            code = worker.exitcode or 0
            death = signal.Signals(-code).name if code < 0 else f"exit code {code}"
            yield Outcome(cases[done], death=death, stage=stage)
            done += 1
        finally:
            worker.kill()
            worker.join()
            ours.close()


def _work(answers: Connection, function: Callable[..., Any], cases: Sequence[Any]) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    answers.send(("stage", "started"))
    for case in cases:
        answer = function(case, lambda stage: answers.send(("stage", stage)))
        answers.send(("answer", answer))


def checked(
    kind: str,
    function: Callable[[Any, Callable[[str], None]], Any],
    cases: Sequence[Any],
    *,
    seconds: float,
    excused: str | None = None,
) -> Counter[str]:
    """How often each kind of answer came; asserts that no case died, or answered `bad`.

    Deaths in the stage `excused` are counted apart, as "Mitsuba died".
    """
    counts: Counter[str] = Counter()
    bad = []
    for outcome in run_cases(function, cases, seconds=seconds):
        if outcome.death and outcome.stage == excused:
            counts["Mitsuba died"] += 1
        elif outcome.death:
            bad.append(f"{outcome.case.seed}: {outcome.death} while in {outcome.stage!r}")
        elif outcome.answer.kind == "bad":
            bad.append(f"{outcome.case.seed}: {outcome.answer.text}")
        else:
            counts[outcome.answer.kind] += 1
    assert not bad, f"{len(bad)} of {len(cases)} {kind}:\n" + "\n".join(bad[:20])
    assert counts.total() == len(cases)
    return counts
