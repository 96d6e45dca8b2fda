"""The film: every reconstruction filter, the crop's edge, and negative weights, against Mitsuba's film.

Single-bounce light from a point has no noise but that of the film positions, so that means over seeds show a filter's
shape to a per mille: a filter of another width, or one that is cut, moved or normalised wrongly, fails.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from tests.conftest import LLVM
from tests.support.core import core_scene, our_runs
from tests.support.runs import truth_runs
from tests.support.welch import ALPHA, welch

pytestmark = [pytest.mark.parity, pytest.mark.stat]

FILTERS = {
    "box": {},
    "tent": {},
    "tent-wide": {"radius": 2.3},
    "gaussian": {},
    "gaussian-wide": {"stddev": 0.9},
    "mitchell": {},
    "mitchell-other": {"B": 0.1, "C": 0.6},
    "catmullrom": {},
    "lanczos": {},
    "lanczos-two": {"lobes": 2},
}
CROPS = {"whole": (24, 16, 0, 0, 24, 16), "crop": (40, 30, 9, 7, 24, 16)}


def _scene(rfilter: dict[str, Any], crop: str) -> mi.Scene:
    """Stripes narrower than the filters, and a black edge, under a point light."""
    width, height, x, y, crop_width, crop_height = CROPS[crop]
    film: dict[str, Any] = {
        "type": "hdrfilm",
        **{"width": width, "height": height},
        **{"crop_offset_x": x, "crop_offset_y": y},
        **{"crop_width": crop_width, "crop_height": crop_height},
        "pixel_format": "rgb",
        "component_format": "float32",
        "rfilter": rfilter,
    }
    texels = np.random.default_rng(61).choice([0.05, 0.9], (9, 13, 3)).astype(np.float32)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True, "filter_type": "nearest"}
    T = mi.ScalarTransform4f
    return mi.load_dict(
        {
            "type": "scene",
            "camera": {
                "type": "perspective",
                "fov": 40,
                "to_world": T().look_at(origin=[0.3, 0.2, 4], target=[0, 0, 0], up=[0, 1, 0]),
                "film": film,
            },
            "wall": {
                "type": "rectangle",
                "to_world": T().rotate([0, 0, 1], 17),
                "bsdf": {"type": "diffuse", "reflectance": texture},
            },
            "bulb": {
                "type": "point",
                "position": [0.2, -0.3, 2],
                "intensity": {"type": "rgb", "value": [8, 6, 5]},
            },
        }
    )


def _cases() -> list[Any]:
    """Every filter on the whole film; cropped, those of the quick tier that differ most."""
    quick = ("box", "gaussian", "lanczos")
    return [
        pytest.param(
            name,
            crop,
            marks=[] if crop == "whole" or name in quick else [pytest.mark.long],
            id=f"{name}-{crop}",
        )
        for name in FILTERS
        for crop in CROPS
    ]


@pytest.mark.parametrize(("name", "crop"), _cases())
def test_filter_is_mitsubas(name: str, crop: str, artifacts: Path) -> None:
    """H0: equal means, image-wide and in every tile of 2 × 2 pixels. 16 seeds × 256 spp."""
    mi.set_variant(LLVM)
    scene = _scene({"type": name.partition("-")[0]} | FILTERS[name], crop)
    theirs = truth_runs(scene, k=1, seeds=range(16), spp=256)
    core, _ = core_scene(scene)
    ours = our_runs(core, k=1, seeds=range(100, 116), spp=256, emitter_strategy="nee")
    r = welch(theirs, ours, tile=2)
    assert r.p > ALPHA / 2, r.explain(artifacts)


def test_a_filter_of_another_width_is_seen() -> None:
    """Power: a Gaussian of standard deviation .5 beside one of .52 is refused."""
    mi.set_variant(LLVM)
    a, b = (
        truth_runs(
            _scene({"type": "gaussian", "stddev": width}, "whole"), k=1, seeds=seeds, spp=256
        )
        for width, seeds in ((0.5, range(16)), (0.52, range(100, 116)))
    )
    assert welch(a, b, tile=2).p < ALPHA / 2
