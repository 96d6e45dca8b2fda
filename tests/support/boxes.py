"""A small integrator in Python, as a user might bring one."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi


def define_ambient() -> Any:
    """Ambient occlusion within a radius of one unit, of the active variant."""

    class Ambient(mi.SamplingIntegrator):
        """Two numbers a path: a direction at x₁."""

        def sample(
            self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True
        ) -> tuple[Any, Any, list[Any]]:
            """1 where nothing is near in a cosine-distributed direction."""
            del medium
            si = scene.ray_intersect(ray, active)
            valid = active & si.is_valid()
            local = mi.warp.square_to_cosine_hemisphere(sampler.next_2d(valid))
            local.z *= dr.sign(si.wi.z)
            away = si.spawn_ray(si.to_world(local))
            away.maxt = 1.0
            free = valid & ~scene.ray_test(away, valid)
            return mi.Spectrum(dr.select(free, 1.0, 0.0)), valid, []

    return Ambient
