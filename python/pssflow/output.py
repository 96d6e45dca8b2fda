"""Folders for results, and JSON without NaN. Single files are written by `files.write_beside`."""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .files import write_beside

__all__ = ["dump_json", "make_folder", "plain", "write_json"]


def make_folder(path: str | Path) -> Path:
    """Creates a folder for results, with its parents, and finds out whether files can be written there.

    Raises:
        OSError: it cannot be created or written; one line.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(prefix=".pssflow-", dir=path):
            pass
    except OSError as error:
        raise OSError(f"{path}: cannot be written: {error.strerror or error}") from None
    return path


def write_json(path: str | Path, value: Any) -> None:
    """Writes JSON as `dump_json` gives it, one value a line.

    Raises:
        OSError: the file cannot be written.
    """
    text = dump_json(value, indent=1) + "\n"
    write_beside(path, lambda part: part.write_text(text, encoding="utf-8"))


def dump_json(value: Any, indent: int | None = None) -> str:
    """JSON text; numbers that JSON lacks (NaN, infinities) become null."""
    return json.dumps(plain(value), indent=indent, allow_nan=False, ensure_ascii=False)


def plain(value: Any) -> Any:
    """Numbers, strings, lists and dictionaries only; NumPy's scalars and arrays are unpacked."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    return str(value)
