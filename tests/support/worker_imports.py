"""What every forked worker needs, imported once: Mitsuba in the variant that starts no threads and compiles nothing."""

import mitsuba as mi

import pssflow  # noqa: F401

mi.set_variant("scalar_rgb")
