"""Choosing a Mitsuba variant where the user has not: `import pssflow` sets none, loading a scene needs one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import drjit as dr
import mitsuba as mi

from .export import VARIANTS

__all__ = ["VARIANTS", "ensure_variant", "is_supported", "llvm_problem", "quiet"]

OLDEST_LLVM = 16
"""LLVM 15, as Debian 12 has it, aborts the process on Dr.Jit's code ("Cannot select: fminimum")."""


def ensure_variant() -> str | None:
    """Sets `llvm_ad_rgb` where libLLVM can be used, else `scalar_rgb`; a variant that is already set stays.

    Returns:
        A notice for the user where it had to be the slower one, else None.
    """
    if mi.variant() is not None:
        return None
    problem = llvm_problem()
    mi.set_variant("scalar_rgb" if problem else "llvm_ad_rgb")
    return f"{problem}; Mitsuba renders in scalar_rgb, which is slower" if problem else None


def is_supported() -> bool:
    """Whether scenes of the active variant can be rendered."""
    return mi.variant() in VARIANTS


def llvm_problem() -> str | None:
    """Why Mitsuba's LLVM variants cannot be used here, and what to do; None if they can."""
    if not dr.has_backend(dr.JitBackend.LLVM):
        return "libLLVM was not found: install libllvm19 (or newer), or set DRJIT_LIBLLVM_PATH"
    version = dr.detail.llvm_version()
    if version[0] < OLDEST_LLVM:
        found = ".".join(str(n) for n in version)
        return (
            f"libLLVM {found} is too old for Dr.Jit: install libllvm19, or set DRJIT_LIBLLVM_PATH"
        )
    return None


@contextmanager
def quiet() -> Iterator[None]:
    """Keeps back Mitsuba's warnings for a while; errors are raised as ever. Not for several threads at once."""
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        yield
    finally:
        mi.set_log_level(level)
