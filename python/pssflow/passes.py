"""Passes of Mitsuba's own renderers: images of one seed each, whose mean is a truth, or a competitor of our studies."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .export.sensors import select_sensor
from .variants import quiet

__all__ = ["AllLightPass", "KBouncePass", "Pass", "TruthPass", "is_jit"]

F64 = NDArray[np.float64]


def is_jit(scene: Any) -> bool:
    """Whether an `mi.Scene` belongs to a variant that compiles."""
    return not scene.variant_name().startswith("scalar")


class Pass:
    """What both ways to render a pass share: the film, read raw, and the sampler, left as it was."""

    name = ""
    """For notes and the cache's names."""

    def __init__(self, scene: Any, sensor: Any) -> None:
        self.scene = scene
        self.camera = select_sensor(scene, sensor)
        self.jit = is_jit(scene)
        self.sample_count = self.camera.sampler().sample_count()

    def __call__(self, seed: int, spp: int) -> tuple[F64, int, int]:
        """The image (H, W, 3), samples that the sampler made of `spp`, and values that were not finite."""
        # Its warnings are of Ctrl-C, which is answered elsewhere, and of values that are counted here.
        with dr.suspend_grad(), quiet():
            image = self._render(seed, spp)
        bad = ~np.isfinite(image)
        image[bad] = 0.0
        return image, self.camera.sampler().sample_count(), int(np.count_nonzero(bad))

    def _render(self, seed: int, spp: int) -> F64:
        """The image, with whatever is in it."""
        raise NotImplementedError

    def restore(self) -> None:
        """Gives the sampler its own count back: rendering with another one changes it."""
        self.camera.sampler().set_sample_count(self.sample_count)

    def _image(self, integrator: Any, seed: int, spp: int) -> F64:
        integrator.render(
            self.scene, sensor=self.camera, seed=seed, spp=spp, develop=False, evaluate=True
        )
        # Raw, R G B (A) W: the same for each pixel format of the film.
        raw = np.array(self.camera.film().develop(raw=True), np.float64)
        weight = raw[..., -1:]
        return raw[..., :3] / np.where(weight == 0.0, 1.0, weight)


class TruthPass(Pass):
    """One pass of the truth, from a seed of its own: the difference of two path integrators.

    Args:
        scene: an `mi.Scene`.
        sensor: index of the sensor, or a sensor object.
        k: bounces.
        hide: whether emitters are seen through, as Mitsuba's `hide_emitters`.
    """

    name = "difference of two Mitsuba path"

    def __init__(self, scene: Any, sensor: Any, k: int, *, hide: bool) -> None:
        super().__init__(scene, sensor)
        self.deep, self.shallow = (
            mi.load_dict(
                {"type": "path", "max_depth": depth, "rr_depth": k + 2, "hide_emitters": hide}
            )
            for depth in (k + 1, k)
        )

    def _render(self, seed: int, spp: int) -> F64:
        # A scalar sampler's streams part ways at the last bounce, so that one seed for both would buy nothing.
        seeds = (seed, seed) if self.jit else (2 * seed, 2 * seed + 1)
        return self._image(self.deep, seeds[0], spp) - self._image(self.shallow, seeds[1], spp)


class KBouncePass(Pass):
    """One pass of Mitsuba's path tracer for light of exactly k bounces (`plugins/kbounce.py`).

    Args:
        scene: an `mi.Scene` of the active variant.
        sensor: index of the sensor, or a sensor object.
        k: bounces.
    """

    name = "Mitsuba path, k bounces only"

    def __init__(self, scene: Any, sensor: Any, k: int) -> None:
        super().__init__(scene, sensor)
        self.integrator = mi.load_dict({"type": "pssflow_kbounce", "k": k})

    def _render(self, seed: int, spp: int) -> F64:
        return self._image(self.integrator, seed, spp)


class AllLightPass(Pass):
    """One pass of Mitsuba's `path` as everyone uses it: all light, Russian roulette from its own default depth on.

    Args:
        scene: an `mi.Scene` of the active variant.
        sensor: index of the sensor, or a sensor object.
        hide: as in `TruthPass`.
        max_depth: as `path` has it: longest path, -1 for no end.
    """

    name = "Mitsuba path, all light"

    def __init__(self, scene: Any, sensor: Any, *, hide: bool, max_depth: int = -1) -> None:
        super().__init__(scene, sensor)
        if max_depth != -1:
            self.name = f"{self.name} to depth {max_depth}"
        self.integrator = mi.load_dict(
            {"type": "path", "max_depth": max_depth, "hide_emitters": hide}
        )

    def _render(self, seed: int, spp: int) -> F64:
        return self._image(self.integrator, seed, spp)
