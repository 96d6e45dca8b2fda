r"""Mitsuba's path tracer, for light of exactly k bounces.

.. _integrator-pssflow_kbounce:

Light of exactly k bounces (:monosp:`pssflow_kbounce`)
------------------------------------------------------

.. pluginparameters::

 * - k
   - |int|
   - Bounces between camera and light, 1 … 32. (Default: 2)
 * - hide_emitters
   - |bool|
   - As in ``path``. |true| is refused: that light is rendered as a difference of two ``path``. (Default: |false|)

What ``path`` renders at ``max_depth`` = k + 1 less what it renders at ``max_depth`` = k, without rendering the rest: a
walk of k − 1 BSDF samples, then one emitter sample and one BSDF sample at x_k, joined by the power heuristic. Delta and
null lobes count as bounces and take part as they do there; there is no Russian roulette. It draws no learned number and
knows nothing of pssflow's core: it is the competitor of our studies, and in LLVM variants their reference.

It works badly where BSDF sampling finds little light: that is what guides are for. In ``scalar_rgb`` Python is called
for every path, which takes far longer than the path itself. Nothing is differentiated.

.. tabs::
    .. code-tab:: xml

        <integrator type="pssflow_kbounce">
            <integer name="k" value="2"/>
        </integrator>

    .. code-tab:: python

        'type': 'pssflow_kbounce',
        'k': 2
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import drjit as dr
import mitsuba as mi

from ..export.walk import is_scalar
from ..options import MAX_BOUNCES, check_integer
from ..variants import quiet

__all__ = ["define"]


def define() -> Callable[[Any], Any]:
    """The integrator of the active variant: a function from `mi.Properties` to an instance."""

    class KBounceIntegrator(mi.SamplingIntegrator):
        """See the module."""

        def __init__(self, props: Any) -> None:
            # As for `pssflow`: only scalar variants warn of Python. Here they are right, but whoever asks for it knows.
            with quiet() if is_scalar() else nullcontext():
                super().__init__(props)
            self.k = check_integer("k", props.get("k", 2), 1, MAX_BOUNCES)
            if self.hide_emitters:
                raise ValueError(
                    "integrator pssflow_kbounce: `hide_emitters` is not supported; "
                    "use the difference of two `path` integrators"
                )

        def sample(
            self,
            scene: Any,
            sampler: Any,
            ray: Any,
            medium: Any = None,
            active: Any = True,
        ) -> tuple[Any, Any, list[Any]]:
            """Radiance along camera rays, whether they hit anything, and no further channels."""
            del medium
            scalar = is_scalar()  # one path: what has ended may not be asked for its BSDF
            ctx = mi.BSDFContext()
            # ---------------------- Walk to x_k ----------------------
            throughput = mi.Spectrum(1.0)
            active = mi.Bool(active)
            si = scene.ray_intersect(ray, mi.RayFlags.All, True, active)
            valid = active & si.is_valid()
            active = mi.Bool(valid)
            black = mi.Spectrum(0.0), valid, []
            # Unrolled: k is small, and a loop of Dr.Jit would carry the whole interaction from turn to turn.
            for _ in range(self.k - 1):
                if scalar and not active:
                    return black
                bs, weight = si.bsdf(ray).sample(
                    ctx, si, sampler.next_1d(active), sampler.next_2d(active), active
                )
                throughput = throughput * weight
                active &= dr.any(throughput != 0.0)
                ray = si.spawn_ray(si.to_world(bs.wo))
                si = scene.ray_intersect(ray, mi.RayFlags.All, False, active)
                active &= si.is_valid()

            if scalar and not active:
                return black
            # -------------------- Emitter sampling --------------------
            bsdf = si.bsdf(ray)
            # A delta lobe alone never meets a sampled direction.
            smooth = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            ds, em_weight = scene.sample_emitter_direction(
                si, sampler.next_2d(smooth), True, smooth
            )
            smooth &= ds.pdf != 0.0
            value, bsdf_pdf = bsdf.eval_pdf(ctx, si, si.to_local(ds.d), smooth)
            mis = dr.select(ds.delta, 1.0, _mis_weight(ds.pdf, bsdf_pdf))
            radiance = dr.select(smooth, throughput * value * em_weight * mis, mi.Spectrum(0.0))

            # ---------------------- BSDF sampling ---------------------
            bs, weight = bsdf.sample(
                ctx, si, sampler.next_1d(active), sampler.next_2d(active), active
            )
            throughput = throughput * weight
            active &= dr.any(throughput != 0.0)
            ray = si.spawn_ray(si.to_world(bs.wo))
            hit = scene.ray_intersect(ray, mi.RayFlags.All, False, active)
            emitter = hit.emitter(scene, active)
            if scalar and emitter is None:
                return radiance, valid, []
            ds = mi.DirectionSample3f(scene, hit, si)
            delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            em_pdf = scene.pdf_emitter_direction(si, ds, active & (delta ^ True))
            mis = _mis_weight(bs.pdf, dr.select(delta, 0.0, em_pdf))
            met = throughput * emitter.eval(hit, active) * mis
            return radiance + dr.select(active, met, mi.Spectrum(0.0)), valid, []

        def to_string(self) -> str:
            """As Mitsuba prints its own."""
            return f"KBounceIntegrator[\n  k = {self.k}\n]"

    return KBounceIntegrator


def _mis_weight(a: Any, b: Any) -> Any:
    """The power heuristic of `path`: a²/(a² + b²), and 0 where neither is positive or a square overflows."""
    a, both = a * a, a * a + b * b
    weight = a / dr.select(both > 0.0, both, 1.0)
    return dr.select(dr.isfinite(weight), weight, 0.0)
