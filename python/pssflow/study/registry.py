"""The studies by name: `pssflow study NAME`. A new one is a file with a click command, and a line here."""

from __future__ import annotations

from importlib import import_module

import click

__all__ = ["STUDIES", "Studies"]

STUDIES = {
    "thesis": (
        "thesis",
        "The source thesis reproduced: its tables and figures beside ours, and what it left open.",
    ),
    "guides": (
        "guides",
        "What each guide gains, costs and comes to at equal time; what `auto` chose.",
    ),
    "speed-accuracy": (
        "speed_accuracy",
        "Error against wall time: guides, Mitsuba and others, with charts and an image viewer.",
    ),
    "stability": (
        "stability.command",
        "Planted failures: what holds, degrades or fails with each guide, and with the thesis' method.",
    ),
    "capacity": (
        "capacity",
        "Error and predicted gain against the size of the model at equal time: how small is enough.",
    ),
    "gradients": (
        "gradients",
        "Variance of gradients against uniform numbers at equal time, parameter by parameter.",
    ),
    "light": (
        "light",
        "Whole images against Mitsuba's path at the same depth: error × time, wins and losses.",
    ),
    "results": (
        "results",
        "docs/results.md from a finished study: wins and losses of every method, and how it was measured.",
    ),
}
"""Name → the module in this package that defines a command of that name, and what it shows."""


class Studies(click.Group):
    """A group whose commands are imported when they are called for: help needs neither Mitsuba nor matplotlib."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """In the registry's order."""
        return list(STUDIES)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The command of that name, imported."""
        if cmd_name not in STUDIES:
            return None
        module = import_module(f".{STUDIES[cmd_name][0]}", __package__)
        return getattr(module, cmd_name.replace("-", "_"))

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """The list in `--help`, without importing anything."""
        with formatter.section("Studies"):
            formatter.write_dl([(name, what) for name, (_, what) in STUDIES.items()])
