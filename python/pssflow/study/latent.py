"""A RealNVP's two directions in NumPy, from a saved guide: numbers ↔ latent numbers (the thesis' Figures 8 and 9).

Guides hand out samples and densities only; which latent number a sample came from is nobody's business but a study's.
Weights are read from the guide's file (safetensors), whose layout `rust/pss-guide/src/flow/weights.rs` defines. The
test compares the density with that of the guide itself.
"""

from __future__ import annotations

import json
import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..guide import Guide

__all__ = ["Latent"]

F64 = NDArray[np.float64]

SLOPE = 0.01
"""Of LeakyReLU."""


class Latent:
    """The flow of a fitted `realnvp`: x = generate(z), z = normalise(x), both with the sum of the couplings' s.

    Raises:
        ValueError: the guide is another one.
    """

    def __init__(self, guide: Guide) -> None:
        if guide.name != "realnvp":
            raise ValueError(f"the guide is `{guide.name}`; only `realnvp` has latent numbers here")
        options = guide.describe()["options"]
        self.couplings: int = options["couplings"]
        self.layers: int = options["layers"]
        self.s_max: float = options["s_max"]
        self.prior: str = options["prior"]
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "guide.safetensors"
            guide.save(path)
            self.tensors = _tensors(path)

    def generate(self, z: ArrayLike) -> tuple[F64, F64]:
        """Latent numbers (n, d) → numbers (n, d), and ln |∂x/∂z| (n,)."""
        x = np.array(z, np.float64)
        log_det = np.zeros(len(x))
        for coupling in range(self.couplings):
            s, t, changed = self._networks(coupling, x)
            x[:, changed] = x[:, changed] * np.exp(s) + t
            log_det += s.sum(axis=1)
        return x, log_det

    def normalise(self, x: ArrayLike) -> tuple[F64, F64]:
        """Numbers (n, d) → latent numbers (n, d), and ln |∂x/∂z| (n,)."""
        z = np.array(x, np.float64)
        log_det = np.zeros(len(z))
        for coupling in reversed(range(self.couplings)):
            s, t, changed = self._networks(coupling, z)
            z[:, changed] = (z[:, changed] - t) * np.exp(-s)
            log_det += s.sum(axis=1)
        return z, log_det

    def log_prob(self, x: ArrayLike) -> F64:
        """Ln q (n,); −inf outside the image of a hypercube."""
        z, log_det = self.normalise(x)
        if self.prior == "hypercube":
            inside = ((z >= 0.0) & (z <= 1.0)).all(axis=1)
            return np.where(inside, -log_det, -math.inf)
        return -0.5 * (z**2 + math.log(2.0 * math.pi)).sum(axis=1) - log_det

    def _networks(self, coupling: int, x: F64) -> tuple[F64, F64, NDArray[np.intp]]:
        """S and t (n, changed) of a coupling, and the columns that it changes."""
        kept = np.arange(x.shape[1]) % 2 == coupling % 2
        y = np.stack([np.where(kept, x, 0.0)] * 2)  # (2, n, d): the same input for s and t
        for layer in range(self.layers + 1):
            name = f"coupling.{coupling}.linear.{layer}"
            y = y @ self.tensors[f"{name}.weight"] + self.tensors[f"{name}.bias"]
            if layer < self.layers:
                y = np.where(y > 0.0, y, SLOPE * y)
        changed = np.flatnonzero(~kept)
        s = self.s_max * np.tanh(y[0][:, changed] / self.s_max)
        return s, y[1][:, changed], changed


def _tensors(path: Path) -> dict[str, F64]:
    """All tensors of a safetensors file: a JSON header behind its length in eight bytes, then the values."""
    data = path.read_bytes()
    size = int.from_bytes(data[:8], "little")
    header: dict[str, Any] = json.loads(data[8 : 8 + size])
    body = memoryview(data)[8 + size :]
    found = {}
    for name, entry in header.items():
        if name == "__metadata__":
            continue
        begin, end = entry["data_offsets"]
        values = np.frombuffer(body[begin:end], "<f4")
        found[name] = values.reshape(entry["shape"]).astype(np.float64)
    return found
