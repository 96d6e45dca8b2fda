"""Learned importance sampling in primary sample space for Mitsuba 3.

pssflow renders the light that reaches the eye after exactly k reflections, from paths whose random numbers a *guide*
has learned to choose. The scene is Mitsuba's; tracing and learning are a Rust core.

| to …                                            | use                                                              |
|-------------------------------------------------|------------------------------------------------------------------|
| render a scene                                  | `render`, or `<integrator type="pssflow">` with `mi.render`      |
| trace given numbers, keep pilot paths           | `Scene.trace`, `Scene.pilot`                                     |
| fit, sample, save a guide, or bring your own    | `Guide`, `pssflow.guide.ForeignGuide`                            |
| measure against Mitsuba's truth                 | `pssflow.reference.reference`, `pssflow.metrics`                 |

Importing sets no Mitsuba variant and prints nothing. It registers the integrator plugin for whatever variant is or will
be set.
"""

from . import plugins as _plugins
from ._core import __version__
from .export import UnsupportedError
from .guide import Guide

# Importing a module binds its name to itself here; this line comes after and makes `render` the function.
from .render import Result, render
from .scene import Pilot, Scene, Trace

__all__ = [
    "Guide",
    "Pilot",
    "Result",
    "Scene",
    "Trace",
    "UnsupportedError",
    "__version__",
    "render",
]

_plugins.register()
