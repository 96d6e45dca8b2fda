"""Mitsuba plugins of pssflow. To add one: a module with `define()`, and a row in `PLUGINS`.

A plugin written in Python belongs to the variant that was active when its class was defined, since it inherits from
that variant's classes; Mitsuba also forgets registrations when the variant changes. So each change defines and
registers all of them anew. Mitsuba's own `mitsuba` command knows nothing of Python plugins: render through `mi.render`
or `pssflow`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi

from ..variants import VARIANTS
from . import guided, integrator, kbounce, replay

__all__ = ["PLUGINS", "register"]

PLUGINS: dict[str, tuple[str, Callable[[], Callable[[Any], Any]]]] = {
    "pssflow": ("register_integrator", integrator.define),
    "pssflow_kbounce": ("register_integrator", kbounce.define),
    "pss_guided": ("register_integrator", guided.define),
    "pss_replay": ("register_sampler", replay.define),
}
"""Name in a scene → the registering function's name in `mitsuba`, and what makes a constructor for one variant."""


def register() -> None:
    """Registers the plugins for the active variant, if one is set, and for each that will be. Twice does no harm."""
    mi.detail.add_variant_callback(_on_variant)
    if mi.variant() is not None:
        _on_variant(None, mi.variant())


def _on_variant(_old: str | None, new: str | None) -> None:
    """Defines and registers all plugins for `new`. Other variants than `VARIANTS` get none: Mitsuba says that it knows
    no such plugin, and its documentation says why.
    """
    if new not in VARIANTS:
        return
    for name, (kind, define) in PLUGINS.items():
        getattr(mi, kind)(name, define())
