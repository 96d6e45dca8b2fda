"""The options `--times` and `--spp` of the studies."""

from __future__ import annotations

from itertools import pairwise

from ..params import Text

__all__ = ["Samples", "Times"]


class Times(Text):
    """Seconds joined by commas, increasing."""

    name = "seconds"

    def read(self, text: str) -> tuple[float, ...]:
        """Positive numbers, each above the one before."""
        try:
            times = tuple(float(part) for part in text.split(","))
        except ValueError:
            times = ()
        increasing = all(a < b for a, b in pairwise(times))
        if not times or not increasing or not 0.0 < times[0] <= times[-1] <= 1e6:
            raise ValueError(f"{text!r} are no times; expected increasing seconds, as 1,3,10,30")
        return times


class Samples(Text):
    """Samples per pixel joined by commas, increasing."""

    name = "samples"

    def read(self, text: str) -> tuple[float, ...]:
        """Whole numbers from 2 on, each above the one before."""
        try:
            samples = tuple(int(part) for part in text.split(","))
        except ValueError:
            samples = ()
        increasing = all(a < b for a, b in pairwise(samples))
        if not samples or not increasing or not 2 <= samples[0] <= samples[-1] <= 1 << 20:
            raise ValueError(
                f"{text!r} are no samples per pixel; expected increasing whole numbers from 2 on, as 8,32"
            )
        return tuple(float(spp) for spp in samples)
