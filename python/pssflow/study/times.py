"""The option `--times` of the studies."""

from __future__ import annotations

from itertools import pairwise

from ..params import Text

__all__ = ["Times"]


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
