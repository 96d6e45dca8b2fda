"""Types of the command's options: each turns text into a value or says in one line what it expects."""

from __future__ import annotations

import json
import re
from typing import Any, NamedTuple

import click


class Text(click.ParamType):
    """Reads text; what is none, such as a default, is a value already."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The value of a text."""
        if not isinstance(value, str):
            return value
        try:
            return self.read(value)
        except ValueError as error:
            self.fail(str(error), param, ctx)

    def read(self, text: str) -> Any:
        """The value.

        Raises:
            ValueError: there is none; the message is what the user reads.
        """
        raise NotImplementedError


class Size(Text):
    """WxH in pixels."""

    name = "WxH"

    def read(self, text: str) -> tuple[int, int]:
        """Two whole numbers; `pssflow.Scene` checks their range."""
        match = re.fullmatch(r"(\d{1,6})[xX×](\d{1,6})", text)
        if not match:
            raise ValueError(f"{text!r} is no film size; expected WIDTHxHEIGHT, as 640x480")
        return int(match[1]), int(match[2])


class Positive(Text):
    """A finite number above zero."""

    name = "number"

    def __init__(self, meaning: str, largest: float = 1e9) -> None:
        self.meaning = meaning
        self.largest = largest

    def read(self, text: str) -> float:
        """Refuses zero, negative numbers, NaN and infinity."""
        try:
            number = float(text)
        except ValueError:
            number = -1.0
        if not 0.0 < number <= self.largest:
            raise ValueError(
                f"{text!r} is no {self.meaning}; expected a number above 0 and at most {self.largest:g}"
            )
        return number


class SceneParameter(Text):
    """key=value for a scene's `$key`."""

    name = "key=value"

    def read(self, text: str) -> tuple[str, str]:
        """The two sides of the first `=`."""
        match = re.fullmatch(r"([A-Za-z_]\w*)=(.*)", text, re.DOTALL)
        if not match:
            raise ValueError(f"{text!r} is no parameter; expected key=value, as resolution=128")
        return match[1], match[2]


class GuideOption(NamedTuple):
    """An option of one guide."""

    guide: str
    name: str
    value: Any


class GuideSetting(Text):
    """guide.option=value; the value is read as JSON, and as text where it is none."""

    name = "guide.option=value"

    def read(self, text: str) -> GuideOption:
        """Splits at the first `=` and the last `.` before it."""
        match = re.fullmatch(r"([\w-]+)\.(\w+)=(.+)", text, re.DOTALL)
        if not match:
            raise ValueError(
                f"{text!r} is no guide option; expected guide.option=value, as realnvp.epochs=7"
            )
        return GuideOption(match[1], match[2], _value(match[3]))


class GuideNames(Text):
    """Guides joined by commas."""

    name = "names"

    def read(self, text: str) -> tuple[str, ...]:
        """At least one, none of them twice."""
        names = tuple(name.strip() for name in text.split(","))
        if not all(names):
            raise ValueError(f"{text!r} names no guide; expected names joined by commas")
        if len(set(names)) < len(names):
            raise ValueError(f"{text!r} names a guide twice")
        return names


def _value(text: str) -> Any:
    """JSON numbers, strings, lists and constants; other text as it is. JSON has no NaN, so neither has this."""
    try:
        return json.loads(text, parse_constant=str)
    except ValueError:
        return text
