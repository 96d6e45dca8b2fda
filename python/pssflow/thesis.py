"""What the source thesis measured, to stand beside our own numbers: `compare --thesis`, `study thesis`, `make demo`.

Its figure of merit is the share of paths found that carry light, with random and with learned numbers, from
next-event estimation. A share depends on the scene and on what counts as found, so captions say what to compare.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

__all__ = ["CAMERA_RAYS", "PARAMETERS", "SCENES", "ThesisScene"]

CAMERA_RAYS = 1_081_600
"""Of each row of its Table 2: 260² pixels × 16, since PBRT samples the filter's border, too."""

PARAMETERS = 92_400
"""Of its network, as it says; its description gives 85,840."""


@dataclass(frozen=True)
class ThesisScene:
    """One scene's shares."""

    title: str
    shares: Mapping[str, tuple[float, float]]
    """Non-zero paths in per cent of the paths found, with random and with learned numbers, by parametrisation."""
    caption: str
    """How our scene differs from it; one line."""
    per_ray: Mapping[str, float] = field(default_factory=dict)
    """Non-zero paths per camera ray, learned ÷ random, by parametrisation."""

    def share(self, run: Mapping[str, Any]) -> float | None:
        """The share that stands beside a run's record; None where the thesis has none of its kind."""
        both = self.shares.get(run["parametrisation"])
        column = {"none": 0, "realnvp": 1}.get(run["guide"])
        return None if both is None or column is None else both[column]

    def describe(self) -> dict[str, Any]:
        """What a JSON record says about it: shares as fractions."""
        shares = {name: [s / 100 for s in both] for name, both in self.shares.items()}
        return {
            "scene": self.title,
            "nonzero_share": shares,
            "nonzero_per_camera_ray_ratio": dict(self.per_ray),
            "caption": self.caption,
        }


SCENES: dict[str, ThesisScene] = {
    "teapot": ThesisScene(
        "teapot",
        {"bsdf": (28.27, 52.16), "cosine": (18.87, 46.16), "uniform": (17.73, 40.94)},
        "scenes/teapot is rebuilt from the thesis' facts: compare how a share changes, not its level",
        {"bsdf": 3.3, "cosine": 6.1, "uniform": 4.9},
    ),
    "san-miguel": ThesisScene(
        "San Miguel",
        # One pair only, put with the parametrisation that is the default here.
        {"bsdf": (2.30, 5.91)},
        "the thesis rendered the whole San Miguel; the one that tests use is reduced (no alpha masks, trunks, ivy, "
        "fountain water or environment map; sunsky without sun, and a directional sun): compare how the share "
        "changes, not its level",
    ),
}
"""By the name that `--thesis` takes."""
