"""Types of the command's options: each turns text into a value or says in one line what it expects."""

from __future__ import annotations

import json
import re
from typing import Any, NamedTuple

import click


class Size(click.ParamType):
    """WxH in pixels."""

    name = "WxH"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int]:
        """Two whole numbers; `pssflow.Scene` checks their range."""
        if isinstance(value, tuple):
            return value
        match = re.fullmatch(r"(\d{1,6})[xX×](\d{1,6})", str(value))
        if not match:
            self.fail(f"{value!r} is no film size; expected WIDTHxHEIGHT, as 640x480", param, ctx)
        return int(match[1]), int(match[2])


class Positive(click.ParamType):
    """A finite number above zero."""

    name = "number"

    def __init__(self, meaning: str, largest: float = 1e9) -> None:
        self.meaning = meaning
        self.largest = largest

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Refuses zero, negative numbers, NaN and infinity."""
        try:
            number = float(value)
        except ValueError:
            number = -1.0
        if not 0.0 < number <= self.largest:
            self.fail(
                f"{value!r} is no {self.meaning}; expected a number above 0 and at most {self.largest:g}",
                param,
                ctx,
            )
        return number


class SceneParameter(click.ParamType):
    """key=value for a scene's `$key`."""

    name = "key=value"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, str]:
        """The two sides of the first `=`."""
        if isinstance(value, tuple):
            return value
        match = re.fullmatch(r"([A-Za-z_]\w*)=(.*)", str(value), re.DOTALL)
        if not match:
            self.fail(
                f"{value!r} is no parameter; expected key=value, as resolution=128", param, ctx
            )
        return match[1], match[2]


class GuideOption(NamedTuple):
    """An option of one guide."""

    guide: str
    name: str
    value: Any


class GuideSetting(click.ParamType):
    """guide.option=value; the value is read as JSON, and as text where it is none."""

    name = "guide.option=value"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> GuideOption:
        """Splits at the first `=` and the last `.` before it."""
        if isinstance(value, GuideOption):
            return value
        match = re.fullmatch(r"([\w-]+)\.(\w+)=(.+)", str(value), re.DOTALL)
        if not match:
            self.fail(
                f"{value!r} is no guide option; expected guide.option=value, as realnvp.epochs=7",
                param,
                ctx,
            )
        return GuideOption(match[1], match[2], _value(match[3]))


class GuideNames(click.ParamType):
    """Guides joined by commas."""

    name = "names"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, ...]:
        """At least one, none of them twice."""
        if isinstance(value, tuple):
            return value
        names = tuple(name.strip() for name in str(value).split(","))
        if not all(names):
            self.fail(f"{value!r} names no guide; expected names joined by commas", param, ctx)
        if len(set(names)) < len(names):
            self.fail(f"{value!r} names a guide twice", param, ctx)
        return names


def _value(text: str) -> Any:
    """JSON numbers, strings, lists and constants; other text as it is. JSON has no NaN, so neither has this."""
    try:
        return json.loads(text, parse_constant=str)
    except ValueError:
        return text
