"""Work in named parts, each kept as soon as it is done: what an interrupted study finds again.

A part's value is JSON in a file of its own, beside the hash of all that decides it. With another hash it is done anew.
"""

from __future__ import annotations

import json
import math
import os
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from ..output import make_folder, plain, write_json
from .harness import file_name
from .store import commit, configuration

__all__ = ["Parts"]


class Parts:
    """The parts of one folder.

    Args:
        folder: where they are kept; made if it is not there.
        say: told of each part that is really done.
        **common: what decides all of them, beside the compiled core.

    Raises:
        OSError: the folder cannot be written.
    """

    def __init__(self, folder: Path, say: Callable[[str], None], **common: Any) -> None:
        self.folder = make_folder(folder)
        self.say = say
        self.common = common
        self._lock = threading.Lock()  # parts may be done side by side
        self._expected = self._met = self._done = 0
        self._start = 0.0

    def expect(self, parts: int) -> None:
        """Tells that so many more parts are to come, for the time left."""
        self._expected += parts

    def _told(self, name: str) -> str:
        """A part that begins: which one it is, and how long the rest will take by those that were done."""
        with self._lock:
            now = time.monotonic()
            self._start = self._start or now
            place = f"[{self._met}/{max(self._expected, self._met)}] " if self._expected else ""
            left = ""
            if self._done and self._expected > self._met:
                each = (now - self._start) / self._done
                left = f"; about {math.ceil(each * (self._expected - self._met + 1) / 60)} min left"
            return f"{place}{name}{left}"

    def __call__(
        self,
        name: str,
        make: Callable[[], Mapping[str, Any]],
        *,
        files: Iterable[Path] = (),
        **decides: Any,
    ) -> dict[str, Any]:
        """The value of a part, from its file or from `make`; `ran` in it says when, at which commit and load.

        Args:
            name: unique in the folder.
            make: does the work; its value has a JSON form.
            files: what it writes beside its value; if one is missing, the part is done anew.
            **decides: all that decides the value, beside what is common.
        """
        path = self.folder / f"{file_name(name)}.json"
        key = configuration(part=name, **self.common, **decides)
        with self._lock:
            self._met += 1
        kept = _read(path)
        if kept.get("configuration") == key and all(file.is_file() for file in files):
            return kept["value"]
        self.say(self._told(name))
        before = os.getloadavg()[0]
        value = plain(make())
        value["ran"] = {
            "commit": commit(),
            "when": datetime.now(timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ"),
            "load_before": before,
            "load_after": os.getloadavg()[0],
        }
        write_json(path, {"configuration": key, "value": value})
        with self._lock:
            self._done += 1
        return value


def _read(path: Path) -> dict[str, Any]:
    """What a file holds; nothing where it is missing or damaged."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) and "value" in found else {}
