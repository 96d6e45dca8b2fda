"""Mitsuba's own truth for light of exactly k bounces, in passes, cached and resumed.

truth = `path` with max_depth k + 1 minus `path` with max_depth k, the same film and filter, no Russian roulette before
depth k + 2. In LLVM variants both are rendered from the same seed: they share all random numbers up to the last
bounce, so that the common terms cancel exactly. In `scalar_rgb` the streams part ways, and the truth needs more samples.

It is averaged over passes of other seeds; their spread gives each pixel's variance of the mean. This is a truth to
measure against, not a competitor: it renders the directly lit scene as well, only to throw it away.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from . import metrics
from .export import Export, export
from .files import first_line, write_beside
from .options import MAX_BOUNCES, check_integer, check_number
from .progress import Progress, reporting
from .scene import Scene, SceneLike, load_scene

__all__ = ["Reference", "cache_path", "default_cache", "read_exr", "reference"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

FORMAT = 1
"""Version of the cached file; others are rendered anew."""

PATHS_PER_PASS = 1 << 18
"""Camera paths of a pass, about: a pass must end soon after Ctrl-C, and many are needed for a variance."""

LEAST_PASSES = 4
"""Fewer say nothing about a variance; they are rendered even if the time is out."""

SAVE_EVERY = 30.0
"""Seconds between two writes of the cache while rendering."""
