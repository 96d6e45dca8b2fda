"""Arguments of a render, checked once for all who take them: `render`, the integrator plugin and the command.

Each check raises a `ValueError` of one line that names the argument, its value and the rule. Ranges that only the core
knows (a guide's own options) are left to the core.
"""

from __future__ import annotations

import json
import math
import operator
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .files import first_line

__all__ = [
    "COMBINATIONS",
    "DEFAULT_GUIDE",
    "EMITTER_STRATEGIES",
    "MAX_BOUNCES",
    "PARAMETRISATIONS",
    "PRESETS",
    "Plan",
    "check_integer",
    "check_number",
    "check_path_options",
    "check_threads",
    "read_replay",
]

PARAMETRISATIONS = ("bsdf", "cosine", "uniform")
"""What a direction's two numbers mean: the BSDF's own sampling, a cosine-weighted or a uniform hemisphere."""

EMITTER_STRATEGIES = ("mis", "nee", "auto")
"""How the light is joined at x_k: emitter and BSDF samples (MIS), emitter samples alone, or whichever pays."""

PASS_KINDS = ("pilot", "guided", "uniform")

COMBINATIONS = ("samples", "variance")
"""How passes become one image: every sample the same but for half of a pilot's, or each pass by its variance."""

DEFAULT_GUIDE = "auto"
"""Whatever pays, or none."""

MAX_BOUNCES = 32
MAX_SPP = 1 << 24
DEFAULT_SPP = 16
MOST_THREADS = 4096


@dataclass(frozen=True)
class Preset:
    """Values that take the place of the defaults; an argument that is given wins over them."""

    emitter_strategy: str
    spp: int
    uniform_fraction: float
    keep_pilot: bool
    pilot_share: float
    """The pilot's share of the samples."""
    guide: str
    """Where none is given."""


PRESETS: Mapping[str, Preset] = {
    # Half of the samples teach and are discarded, the other half is drawn from the flow alone.
    "thesis": Preset("nee", 32, 0.0, keep_pilot=False, pilot_share=0.5, guide="realnvp"),
}
"""`thesis`: 16 spp of pilot, discarded, then 16 spp learned, NEE alone, no uniform paths. With a = 0 the mean is not
guaranteed: it reproduces the thesis, and nothing else should use it."""


@dataclass(frozen=True)
class Plan:
    """Checked arguments of a render. `core()` is what the core takes."""

    spp: int | None
    time: float | None
    k: int
    parametrisation: str
    emitter_strategy: str
    uniform_fraction: float | None
    pilot_spp: int | None
    keep_pilot: bool
    combine: str
    seed: int
    threads: int
    replay: list[dict[str, Any]] | None
    snapshots: tuple[float, ...] = ()
    survival: float = 1.0
    """Probability that a path is traced at all; see `light`."""

    @classmethod
    def make(
        cls,
        *,
        learns: bool,
        may_end_in_none: bool = False,
        spp: int | None = None,
        time: float | None = None,
        k: int = 2,
        parametrisation: str = "bsdf",
        emitter_strategy: str | None = None,
        uniform_fraction: float | None = None,
        pilot_spp: int | None = None,
        keep_pilot: bool | None = None,
        combine: str | None = None,
        seed: int = 0,
        threads: int | None = None,
        preset: str | None = None,
        replay: Sequence[Mapping[str, Any]] | None = None,
        snapshots: Sequence[float] = (),
        survival: float = 1.0,
    ) -> Plan:
        """Checks the arguments of a render and fills in defaults.

        `learns` says whether its guide needs a pilot, `may_end_in_none` whether that may be all.

        Raises:
            ValueError: one line.
        """
        if preset is not None and preset not in PRESETS:
            raise ValueError(f"`preset` = {preset!r} is unknown (known: {', '.join(PRESETS)})")
        if spp is not None and time is not None:
            raise ValueError(f"`spp` = {spp} and `time` = {time} were both given; give one")
        values = None if preset is None else PRESETS[preset]
        if emitter_strategy is None:
            emitter_strategy = "mis" if values is None else values.emitter_strategy
        k, parametrisation, emitter_strategy = check_path_options(
            k, parametrisation, emitter_strategy
        )
        passes = None if replay is None else check_passes(replay)
        if time is not None:
            time = check_number("time", time, 0.0, 1e9, above=True, unit=" (seconds)")
        elif passes is not None:
            spp = sum(entry["spp"] for entry in passes)
        elif spp is None:
            spp = DEFAULT_SPP if values is None or not learns else values.spp
        if spp is not None:
            spp = check_integer("spp", spp, 1, MAX_SPP)
        if pilot_spp is not None:
            pilot_spp = check_integer("pilot_spp", pilot_spp, 1, MAX_SPP)
        elif values is not None and spp is not None and learns:
            pilot_spp = max(int(spp * values.pilot_share), 1)
        needs_a_pass = learns and not may_end_in_none and passes is None
        if needs_a_pass and spp is not None and spp < (pilot_spp or 1) + 1:
            raise ValueError(
                f"`spp` = {spp} leaves no sample for the guide after a pilot of {pilot_spp or 1} spp: "
                "spp is the total, pilot inside; raise it, or use the guide `none`"
            )
        if uniform_fraction is not None:
            uniform_fraction = check_number("uniform_fraction", uniform_fraction, 0.0, 1.0)
        elif values is not None:
            uniform_fraction = values.uniform_fraction
        if keep_pilot is None:
            keep_pilot = values is None or values.keep_pilot
        return cls(
            spp=None if passes is not None else spp,
            time=time,
            k=k,
            parametrisation=parametrisation,
            emitter_strategy=emitter_strategy,
            uniform_fraction=uniform_fraction,
            pilot_spp=pilot_spp,
            keep_pilot=bool(keep_pilot),
            combine=check_choice("combine", combine or COMBINATIONS[0], COMBINATIONS),
            seed=check_integer("seed", seed, 0, 2**64 - 1),
            threads=check_threads(threads),
            replay=passes,
            snapshots=check_snapshots(snapshots, time),
            survival=survival,
        )

    def core(self, guide: str, guide_options: Mapping[str, Any], strategy: str) -> str:
        """The options as the core takes them, JSON; `strategy` is what `auto` turned out to mean."""
        return json.dumps(
            {
                "guide": guide,
                "guide_options": dict(guide_options),
                "k": self.k,
                "parametrisation": self.parametrisation,
                "emitter_strategy": strategy,
                "spp": self.spp,
                "time": self.time,
                "snapshots": self.snapshots,
                "replay": self.replay,
                "survival": self.survival,
                "uniform_fraction": self.uniform_fraction,
                "pilot_spp": self.pilot_spp,
                "keep_pilot": self.keep_pilot,
                "combine": self.combine,
                "seed": self.seed,
                "threads": self.threads,
            },
            allow_nan=False,
        )

    def budget(self, *, learns: bool, snapshot: float | None = None) -> str:
        """The budget in words, as tables and titles show it; of the whole render, or of a snapshot."""
        if snapshot is not None:
            inside = " incl. pilot and training" if learns else ""
            return f"first {snapshot:g} of {self.time:g} s{inside}"
        if self.time is not None:
            return f"{self.time:g} s" + (" incl. pilot and training" if learns else "")
        if self.replay is not None:
            return f"{sum(entry['spp'] for entry in self.replay)} spp, replayed"
        if not learns:
            return f"{self.spp} spp"
        if self.keep_pilot:
            return f"{self.spp} spp, pilot inside"
        return f"{self.spp} spp, of these {self.pilot_spp} of a pilot that is discarded"


def check_path_options(k: Any, parametrisation: Any, emitter_strategy: Any) -> tuple[int, str, str]:
    """Bounces, parametrisation and emitter strategy, as they are if they are right."""
    return (
        check_integer("k", k, 1, MAX_BOUNCES),
        check_choice("parametrisation", parametrisation, PARAMETRISATIONS),
        check_choice("emitter_strategy", emitter_strategy, EMITTER_STRATEGIES),
    )


def check_choice(name: str, value: Any, choices: Sequence[str]) -> str:
    """One of a few names."""
    if value not in choices:
        raise ValueError(f"`{name}` = {value!r} is unknown (known: {', '.join(choices)})")
    return str(value)


def check_integer(name: str, value: Any, least: int, most: int) -> int:
    """An integer in [least, most]; booleans and floats are none."""
    try:
        number = operator.index(value)
    except TypeError:
        number = None
    if number is None or isinstance(value, bool) or not least <= number <= most:
        raise ValueError(f"`{name}` = {value!r}: expected an integer between {least} and {most}")
    return number


def check_number(
    name: str, value: Any, least: float, most: float, *, above: bool = False, unit: str = ""
) -> float:
    """A finite number in [least, most], or in (least, most] if it must lie above."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    inside = least < number <= most if above else least <= number <= most
    if isinstance(value, bool) or not inside:
        bracket = "(" if above else "["
        raise ValueError(
            f"`{name}` = {value!r}: expected a number in {bracket}{least:g}, {most:g}]{unit}"
        )
    return number


def check_threads(threads: int | None) -> int:
    """Threads for the core: 0 stands for all cores."""
    return 0 if threads is None else check_integer("threads", threads, 1, MOST_THREADS)


def check_snapshots(snapshots: Sequence[float], time: float | None) -> tuple[float, ...]:
    """Times of snapshots in seconds: increasing, and below the time of the render."""
    if isinstance(snapshots, (str, bytes)) or not isinstance(snapshots, Sequence):
        raise ValueError(f"`snapshots` = {snapshots!r}: expected a list of seconds, as (1, 3, 10)")
    if not snapshots:
        return ()
    if time is None:
        raise ValueError(
            f"`snapshots` = {tuple(snapshots)} were given without a `time`: a render by samples has none"
        )
    checked = tuple(
        check_number(f"snapshots[{i}]", value, 0.0, 1e9, above=True, unit=" (seconds)")
        for i, value in enumerate(snapshots)
    )
    if any(later <= earlier for earlier, later in zip(checked, (*checked[1:], time), strict=True)):
        raise ValueError(
            f"`snapshots` = {checked}: expected times that increase and are below {time:g} s"
        )
    return checked


def check_passes(replay: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The passes of an earlier render, `[{"kind": …, "spp": …}, …]`."""
    if isinstance(replay, (str, bytes)) or not isinstance(replay, Sequence) or not replay:
        raise ValueError(f"`replay` = {replay!r}: expected the list `passes` of an earlier render")
    checked = []
    for i, entry in enumerate(replay):
        if not isinstance(entry, Mapping) or not {"kind", "spp"} <= entry.keys():
            raise ValueError(f'`replay`[{i}] = {entry!r}: expected {{"kind": …, "spp": …}}')
        kind = check_choice(f"replay[{i}].kind", entry["kind"], PASS_KINDS)
        spp = check_integer(f"replay[{i}].spp", entry["spp"], 1, MAX_SPP)
        record = check_number(f"replay[{i}].record", entry.get("record", 1.0), 0.0, 1.0)
        told = {"kind": kind, "spp": spp, "record": record, "fit": bool(entry.get("fit", False))}
        if entry.get("guide") is not None:
            told["guide"] = str(entry["guide"])
        if entry.get("a") is not None:
            told["a"] = check_number(f"replay[{i}].a", entry["a"], 0.0, 1.0)
        checked.append(told)
    return checked


REPLAYED = (
    "passes",
    "k",
    "parametrisation",
    "emitter_strategy",
    "seed",
    "keep_pilot",
    "combine",
    "a",
    "guide",
    "guide_options",
)
"""Keys of a run's statistics that decide its image."""


def read_replay(replay: str | os.PathLike[str] | Mapping[str, Any]) -> dict[str, Any]:
    """What decides the image of an earlier run, from its statistics or the JSON file that holds them.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it holds no run of pssflow.
    """
    where = "`replay`"
    stats: Any = replay
    if isinstance(replay, (str, os.PathLike)):
        where = str(replay)
        try:
            stats = json.loads(Path(replay).read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise FileNotFoundError(f"{where}: there is no such file") from None
        except (OSError, ValueError) as error:
            raise ValueError(f"{where}: is no JSON: {first_line(error)}") from None
    if not isinstance(stats, Mapping):
        raise ValueError(f"{where}: holds a {type(stats).__name__}, not the record of a render")
    missing = [key for key in REPLAYED if key not in stats]
    lengths = stats.get("lengths") or []
    if not isinstance(lengths, list) or not all(isinstance(one, Mapping) for one in lengths):
        raise ValueError(f"{where}: `lengths` is damaged; expected a list of records")
    missing += [key for length in lengths for key in REPLAYED if key not in length]
    if missing:
        raise ValueError(f"{where}: lacks `{missing[0]}`; expected the record that `--json` prints")
    told = {key: stats[key] for key in REPLAYED} | {"survival": _survival(stats)}
    if lengths:
        told["max_depth"] = check_integer("max_depth", stats.get("max_depth"), 1, MAX_BOUNCES + 1)
        if stats.get("rr_depth") is not None:
            told["rr_depth"] = check_integer("rr_depth", stats["rr_depth"], 1, MAX_BOUNCES + 1)
        told["lengths"] = [_length(length) for length in lengths]
    return told


def _length(record: Mapping[str, Any]) -> dict[str, Any]:
    """What decides the image of one length of a whole light; k = 0 is emission."""
    probe = record.get("probe")
    if probe is not None and not isinstance(probe, Mapping):
        raise ValueError(f"`probe` = {probe!r}: expected a record, or null")
    return {key: record[key] for key in REPLAYED} | {
        "passes": check_passes(record["passes"]),
        "k": check_integer("k", record["k"], 0, MAX_BOUNCES),
        "seed": check_integer("seed", record["seed"], 0, 2**64 - 1),
        "survival": _survival(record),
        "a": check_number("a", record["a"], 0.0, 1.0),
        "emitter_strategy": check_choice(
            "emitter_strategy", record["emitter_strategy"], EMITTER_STRATEGIES
        ),
        "probe": probe,
    }


def _survival(record: Mapping[str, Any]) -> float:
    """What only a length of a whole light has below 1; the sum of all has none."""
    return check_number("survival", record.get("survival", 1.0), 0.0, 1.0, above=True)
