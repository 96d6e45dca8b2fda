r"""A sampler that hands out given numbers.

.. _sampler-pss_replay:

Given numbers (:monosp:`pss_replay`)
------------------------------------

.. pluginparameters::

 * - sample_count
   - |int|
   - Samples per pixel. (Default: 4)
 * - seed
   - |int|
   - Added to the seed of a render. (Default: 0)

Hands the rows of a matrix of numbers in [0, 1) to whatever integrator asks: lane i gets row i, its columns in the order
in which they are asked for; ``next_2d`` takes two. Behind the last column, in lanes behind the last row, and where
nothing was given, numbers are those of Mitsuba's generator (PCG32), one stream a lane. Numbers are given from Python,
before or after ``seed``:

.. code-block:: python

    sampler = mi.load_dict({"type": "pss_replay"})
    sampler.replay(u)  # (lanes, columns): a NumPy array or a tensor
    sampler.seed(0, len(u))
    L, valid, _ = integrator.sample(scene, sampler, ray)
    sampler.drawn  # how many numbers each lane has asked for

What a column decides is the integrator's business and differs between integrators and variants, since only JIT variants
draw numbers that a lane does not need: ``pss_guided`` lists the tables that are tested. A camera in ``mi.render`` takes
its numbers from the same sampler, first of all: two for the film, two for a lens. LLVM variants only.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..jit import to_jit

__all__ = ["define"]


def define() -> Callable[[Any], Any]:
    """The sampler of the active variant: a function from `mi.Properties` to an instance."""

    class ReplaySampler(mi.Sampler):
        """See the module."""

        def __init__(self, props: Any = None) -> None:
            super().__init__(mi.Properties() if props is None else props)
            if "llvm" not in str(mi.variant()):
                raise ValueError(
                    f"sampler pss_replay: the variant {mi.variant()} hands out one number at a time; use llvm_ad_rgb"
                )
            self.count = self.sample_count()
            self.base = 0 if props is None else int(props.get("seed", 0))
            # Loops of Dr.Jit carry these along: a counter that is a number of Python would stand still in them.
            self.drawn = mi.UInt32(0)
            self.lane = mi.UInt32(0)
            self.rng = self._generator()
            self.numbers = mi.Float(0.0)
            self.columns = mi.UInt32(0)
            self.rows = mi.UInt32(0)

        def replay(self, u: Any) -> None:
            """Gives the numbers (lanes, columns); None takes them back.

            Raises:
                ValueError: they are no matrix, or lie outside [0, 1).
            """
            if u is None:
                self.numbers = mi.Float(0.0)
                self.columns, self.rows = mi.UInt32(0), mi.UInt32(0)
                return
            rows = np.ascontiguousarray(u, np.float32)
            if rows.ndim != 2 or 0 in rows.shape:
                raise ValueError(
                    f"`u` has shape {rows.shape}; expected a row for each lane, a column for each number"
                )
            if not ((rows >= 0.0) & (rows < 1.0)).all():
                bad = rows[~((rows >= 0.0) & (rows < 1.0))][0]
                raise ValueError(f"`u` holds {bad}; numbers must lie in [0, 1)")
            # Opaque, so that other numbers and other columns need no other kernel.
            self.numbers = to_jit(mi.Float, rows)
            self.columns = dr.opaque(mi.UInt32, rows.shape[1])
            self.rows = dr.opaque(mi.UInt32, rows.shape[0])

        def seed(self, seed: Any, wavefront_size: int = 0xFFFFFFFF) -> None:
            """Starts over, with a lane for each of `wavefront_size`."""
            lanes = self.wavefront_size() if wavefront_size == 0xFFFFFFFF else int(wavefront_size)
            super().seed(seed, lanes)
            self.lane = dr.arange(mi.UInt32, lanes)
            self.drawn = dr.zeros(mi.UInt32, lanes)
            # As Mitsuba's own samplers seed theirs.
            tea: Any = mi.sample_tea_32
            # Opaque: as a constant it would make each seed a kernel of its own.
            first = mi.UInt32(seed) + mi.UInt32(self.base)
            dr.make_opaque(first)
            state, stream = tea(first, self.lane)
            self.rng = self._generator(initstate=mi.UInt64(state), initseq=mi.UInt64(stream))

        def next_1d(self, active: Any = True) -> Any:
            """The next column of each active lane."""
            active = mi.Bool(active)
            given = active & (self.drawn < self.columns) & (self.lane < self.rows)
            index = dr.fma(self.lane, self.columns, self.drawn)
            replayed = dr.gather(mi.Float, self.numbers, dr.select(given, index, 0), given)
            # Drawn in any case: what comes behind the columns must not depend on how many there are.
            other = self.rng.next_float32(active)
            self.drawn = dr.select(active, self.drawn + 1, self.drawn)
            return dr.select(given, replayed, other)

        def next_2d(self, active: Any = True) -> Any:
            """The next two."""
            x = self.next_1d(active)
            return mi.Point2f(x, self.next_1d(active))

        @staticmethod
        def _generator(*arguments: Any, **named: Any) -> Any:
            generator: Any = mi.PCG32
            return generator(*arguments, **named)

        def fork(self) -> Any:
            """A sampler of the same kind, without numbers."""
            other = ReplaySampler()
            other.set_sample_count(self.sample_count())
            other.base = self.base
            return other

        def clone(self) -> Any:
            """A copy in the same state; also of a sampler that was not seeded yet."""
            other = self.fork()
            other.drawn, other.lane = mi.UInt32(self.drawn), mi.UInt32(self.lane)
            other.rng = self._generator(self.rng)
            other.numbers = mi.Float(self.numbers)
            other.columns, other.rows = mi.UInt32(self.columns), mi.UInt32(self.rows)
            return other

        def schedule_state(self) -> None:
            """For megakernels."""
            super().schedule_state()
            dr.schedule(self.drawn, self.rng)

        def to_string(self) -> str:
            """As Mitsuba prints its own."""
            return f"ReplaySampler[\n  sample_count = {self.sample_count()}\n]"

    return ReplaySampler
