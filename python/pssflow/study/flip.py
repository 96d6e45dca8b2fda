"""FLIP: how different two images look when one alternates between them.

The package `flip-evaluator` is NVIDIA's own; it comes with the extra `studies`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["flip", "has_flip"]


def has_flip() -> bool:
    """Whether the package is installed."""
    from importlib.util import find_spec

    return find_spec("flip_evaluator") is not None


def flip(image: ArrayLike, reference: ArrayLike) -> float | None:
    """Mean of HDR-FLIP in [0, 1]; None without the package.

    Exposures are FLIP's own choice from the reference, hence the same for all images of a scene; viewing conditions are
    its defaults (67 pixels per degree). Negative values, of a truth by difference say, count as black.

    Args:
        image: linear sRGB, (H, W, 3).
        reference: the truth, of the same shape.

    References:
        | Visualizing and Communicating Errors in Rendered Images (Andersson et al., 2021)
        | https://github.com/NVlabs/flip
    """
    if not has_flip():
        return None
    import flip_evaluator

    truth, shown = (np.maximum(np.asarray(a, np.float32), 0.0) for a in (reference, image))
    if not truth.any():
        return None  # no exposure suits a black image
    evaluate: Any = flip_evaluator.evaluate
    _, mean, _ = evaluate(truth, shown, "HDR", applyMagma=False)
    return float(mean)
