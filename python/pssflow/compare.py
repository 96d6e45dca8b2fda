"""Several guides on one scene, beside Mitsuba's reference: what `pssflow compare` does.

The runs come first, so that it is known how good a reference they need: its standard error should be below a tenth of
the best run's error (the root of its relMSE), or it would decide the comparison. It is rendered until then, or until
its time is out, which is noted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from . import metrics
from .output import make_folder, write_json
from .progress import Progress
from .reference import Reference, read_exr, reference
from .render import Result
from .report import compare_picture
from .scene import Scene

__all__ = ["SHARE_OF_ERROR", "Comparison", "compare", "measured_reference", "results_folder"]

SHARE_OF_ERROR = 0.1
"""The reference's standard error is to be below this share of the best run's error."""


@dataclass(frozen=True)
class Comparison:
    """Runs of one scene, measured against one reference."""

    scene: Scene
    runs: Sequence[Result]
    truth: Reference

    def records(self) -> list[dict[str, Any]]:
        """One JSON object for each run."""
        return [run.stats for run in self.runs]

    def record(self) -> dict[str, Any]:
        """All as one JSON object: `{"reference": …, "runs": […]}`."""
        best = min((run.stats["relmse"] or math.inf for run in self.runs), default=math.inf)
        share = self.truth.standard_error / math.sqrt(best) if best > 0 else math.inf
        known = bool(self.truth.variance.any())
        return {
            "reference": self.truth.describe()
            | {"share_of_best_error": share if known and math.isfinite(best) else None},
            "runs": self.records(),
        }

    def reference_line(self) -> str:
        """The reference in words."""
        share = self.record()["reference"]["share_of_best_error"]
        text = f"reference: {self.truth.note}"
        if share is None:
            return text
        judged = "" if share <= 1.05 * SHARE_OF_ERROR else ": too noisy to tell close runs apart"
        return f"{text}; its standard error is {share:.2g} of the best run's error{judged}"

    def write(self, folder: Path) -> list[Path]:
        """Writes all EXRs with their records, the picture and results.json; returns what was written.

        Raises:
            OSError: a file cannot be written.
        """
        written = []
        for run in self.runs:
            image = folder / f"{_file_name(run.stats['guide'])}.exr"
            run.write(image)
            write_json(image.with_suffix(".json"), run.stats)
            written += [image, image.with_suffix(".json")]
        self.truth.write(folder / "reference.exr")
        compare_picture(self.scene.name, self.runs, self.truth, self.reference_line()).draw(
            folder / "comparison.png"
        )
        write_json(folder / "results.json", self.record())
        return [
            *written,
            *(folder / n for n in ("reference.exr", "comparison.png", "results.json")),
        ]


def compare(
    scene: Scene,
    guides: Sequence[tuple[str, Mapping[str, Any]]],
    arguments: Mapping[str, Any],
    *,
    reference_file: str | None = None,
    reference_time: float = 120.0,
    progress: Progress = True,
    note: Callable[[str], None] = lambda text: None,
) -> Comparison:
    """Renders with each guide and measures the images.

    Args:
        scene: what is rendered.
        guides: names with the guides' own options.
        arguments: of `pssflow.render`, the same for all.
        reference_file: an EXR to compare with, in place of Mitsuba's rendering.
        reference_time: seconds for that, at most.
        progress: as in `pssflow.render`.
        note: told of each notice.

    Raises:
        ValueError: an argument is wrong, or the reference has another size.
    """
    # Before minutes of rendering: whether there is a reference that fits.
    given = None if reference_file is None else _fitting(read_exr(reference_file), scene)
    runs = []
    for name, settings in guides:
        run = scene.render(name, progress=progress, **arguments, **settings)
        for text in run.notes:
            note(text if text in scene.notes else f"{name}: {text}")
        runs.append(run)
    if given is None:
        given = measured_reference(scene, runs, reference_time, progress)
    for run in runs:
        run.measure(given)
    return Comparison(scene, runs, given)


def measured_reference(
    scene: Scene, runs: Sequence[Result], seconds: float, progress: Progress = True
) -> Reference:
    """Mitsuba's reference, good enough to measure these runs, or as good as the time allows."""
    k = runs[0].stats["k"]
    # A rough one tells how large the errors are, and with that how good it has to become.
    truth = reference(scene, k, seconds=min(seconds, ROUGH_SECONDS), progress=progress)
    while True:
        errors = (metrics.relmse(run.image, truth.image, truth.variance) for run in runs)
        best = min((error for error in errors if 0.0 < error < math.inf), default=None)
        if best is None:
            return truth
        target = SHARE_OF_ERROR * math.sqrt(best)
        # Estimates of the error waver; a hair's breadth is not worth another round.
        if truth.standard_error <= 1.02 * target or truth.seconds >= seconds:
            return truth
        truth = reference(scene, k, seconds=seconds, target_se=target, progress=progress)


ROUGH_SECONDS = 3.0
"""For the first look; also for runs that saw no light at all."""


@contextmanager
def results_folder(path: str | Path) -> Iterator[Path]:
    """A folder for results; if work fails before anything is written, one that was made for it goes again."""
    path = Path(path)
    made = [p for p in (path, *path.parents) if not p.exists()]
    folder = make_folder(path)
    try:
        yield folder
    except BaseException:
        for created in made:
            if any(created.iterdir()):
                break
            created.rmdir()
        raise


def _fitting(truth: Reference, scene: Scene) -> Reference:
    shape = (scene.height, scene.width, 3)
    if truth.image.shape != shape:
        height, width = truth.image.shape[:2]
        raise ValueError(
            f"{truth.path}: has {width}×{height} pixels, the scene's crop {scene.width}×{scene.height}"
        )
    return truth


def _file_name(guide: str) -> str:
    """A guide's name as a file's: paths of saved guides are cut to their last part."""
    return Path(guide).stem if guide.endswith(".safetensors") else guide.replace("/", "_")
