"""The option `--times` of the studies."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import click

__all__ = ["Times"]


class Times(click.ParamType):
    """Seconds joined by commas, increasing."""

    name = "seconds"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        """Positive numbers, each above the one before."""
        if isinstance(value, tuple):
            return value
        try:
            times = tuple(float(text) for text in str(value).split(","))
        except ValueError:
            times = ()
        increasing = all(a < b for a, b in pairwise(times))
        if not times or not increasing or not 0.0 < times[0] <= times[-1] <= 1e6:
            self.fail(
                f"{value!r} are no times; expected increasing seconds, as 1,3,10,30", param, ctx
            )
        return times
