r"""The integrator plugin.

.. _integrator-pssflow:

Learned light of exactly k bounces (:monosp:`pssflow`)
------------------------------------------------------

.. pluginparameters::

 * - guide
   - |string|
   - What chooses the random numbers: ``none``, a guide's name (several joined by ``+``), or the path of a saved guide.
     (Default: ``auto``; with the preset ``thesis``, ``realnvp``)
 * - k
   - |int|
   - Bounces between camera and light, 1 … 32. (Default: 2)
 * - max_depth
   - |int|
   - In place of ``k``: all light up to this depth, counted as in ``path``: 1 is emission alone, 2 has direct light, 3
     light of two bounces. Each length has a guide and a share of the budget of its own; ``spp`` is what each would get
     if all got the same. -1 is refused. (Default: none)
 * - rr_depth
   - |int|
   - With ``max_depth``, bounces from which on long paths are left to chance: their samples halve with each bounce, and
     may be less than one to a pixel. (Default: none, every length has one or more)
 * - aovs
   - |bool|
   - With ``max_depth``, whether the image has further channels: the light of each length (``k0.R`` …), the variance
     and the share of paths that carry light. (Default: |false|)
 * - spp
   - |int|
   - Samples per pixel in all, pilot inside. (Default: the sampler's ``sample_count``; ``spp`` of ``mi.render`` wins)
 * - time
   - |float|
   - Seconds in place of ``spp``, for pilot, fit and rendering. (Default: none; ``spp`` of ``mi.render`` wins)
 * - hide_emitters
   - |bool|
   - Whether camera rays pass through the surfaces of emitters, as in Mitsuba's ``path``. (Default: |false|)
 * - approximate
   - |bool|
   - Whether what is not supported is replaced where there is a replacement: a BSDF by a diffuse one of its mean
     reflectance, a texture by its mean; media and emitters are left out. ``result.notes`` names each.
     (Default: |false|)
 * - parametrisation
   - |string|
   - ``bsdf``, ``cosine`` or ``uniform``: what a direction's two numbers mean. (Default: ``bsdf``)
 * - emitter_strategy
   - |string|
   - ``mis``, ``nee`` or ``auto``. (Default: ``mis``)
 * - target
   - |string|
   - ``radiance`` or ``gradient``: what the guides of ``dr.backward`` and ``dr.forward`` learn from. With ``gradient``
     an eighth of ``spp_grad`` is a pilot, of whose paths the derivative is taken one by one; the image's own guides
     learn from radiance all the same. It pays where the parameters touch a part of the light alone.
     (Default: ``radiance``)
 * - uniform_fraction
   - |float|
   - Share of uniform paths in the mixture, in [0, 1]. (Default: the guide's, 0.25 for flows; bounds weights by 1/0.25)
 * - pilot_spp
   - |int|
   - Samples per pixel of the pilot. (Default: for a guide that later passes refine a thirty-second of ``spp`` or
     a fortieth to a tenth of ``time``; for one that is trained once a quarter or a seventh)
 * - keep_pilot
   - |bool|
   - Whether the pilot's paths enter the image. (Default: |true|)
 * - preset
   - |string|
   - ``thesis``: NEE alone, half of the samples for a pilot that is discarded, no uniform paths. (Default: none)
 * - seed
   - |int|
   - Used where ``mi.render`` gets no seed, or 0. (Default: 0)
 * - threads
   - |int|
   - Threads of the core, 0 for all cores. (Default: 0)
 * - progress
   - |bool|
   - Bars on stderr, if that is a terminal. (Default: |false|)
 * - <guide>_<option>
   - |int|, |float|, |bool| or |string|
   - An option of the guide, its name written with ``_``: ``realnvp_epochs``, ``realnvp_logit_hidden``. A dictionary's
     keys cannot hold the dot of the command's ``--set realnvp.epochs=7``. Options of another guide are refused.

Without ``max_depth`` it renders only light that was reflected exactly k times on its way from an emitter: no emitter is
seen, and for k = 2 no direct light. The image is unbiased for every guide as long as ``uniform_fraction`` is positive,
since each sample is divided by the mixture's density; the preset ``thesis`` has none and may be biased. A guide costs a
pilot and training in every call of ``render``: expect no gain at few samples, nor in easy scenes, and compare with
``guide`` = ``none``.

Paths are traced by pssflow's core, not by Mitsuba, in ``scalar_rgb`` and ``llvm_ad_rgb``; other variants know no such
plugin. The scene is read anew in each call, edits through ``mi.traverse`` included, and may hold only what ``pssflow
info`` calls supported. Alpha is 1 everywhere. Attribute ``result`` keeps the last ``pssflow.Result``: variance,
statistics, the guide.

In ``llvm_ad_rgb`` it is differentiable: after ``mi.render(scene, params, …)`` come ``dr.backward`` or ``dr.forward``.
The guides of that render draw paths with a seed of their own, ``spp_grad`` a pixel for each length, and Dr.Jit
evaluates BSDFs, textures and emitters along them. Parameters that move geometry, or that belong to delta lobes, are
refused by name, and so are hidden emitters and a sun beside a sky.

.. tabs::
    .. code-tab:: xml

        <integrator type="pssflow">
            <string name="guide" value="realnvp"/>
            <integer name="k" value="2"/>
            <integer name="realnvp_epochs" value="7"/>
        </integrator>

    .. code-tab:: python

        'type': 'pssflow',
        'guide': 'realnvp',
        'k': 2,
        'realnvp_epochs': 7
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import gradients
from .. import guide as guides
from ..export.walk import is_scalar
from ..gradient_guides import Target, check_target
from ..light import check_depth, check_roulette, render_light
from ..options import DEFAULT_SPP, Plan
from ..render import Result, run
from ..scene import Scene
from ..variants import quiet

__all__ = ["define"]

PARAMETERS: tuple[str, ...] = (
    "spp",
    "time",
    "k",
    "parametrisation",
    "emitter_strategy",
    "uniform_fraction",
    "pilot_spp",
    "keep_pilot",
    "combine",
    "preset",
    "seed",
)
"""Those that mean what they mean in `pssflow.render`."""


def define() -> Callable[[Any], Any]:
    """The integrator of the active variant: a function from `mi.Properties` to an instance."""

    class PssflowIntegrator(mi.SamplingIntegrator):
        """See the module."""

        def __init__(self, props: Any) -> None:
            # Scalar variants warn that integrators in Python are slow; this one runs in Rust. JIT variants do not
            # warn, and construct plugins in several threads.
            with quiet() if is_scalar() else nullcontext():
                super().__init__(props)
            guide = str(props.get("guide", guides.usual_guide(props.get("preset", None))))
            if guides.is_path(guide):
                # As every file that a scene names: relative to the scene's own folder.
                resolver: Any = mi.file_resolver
                guide = str(resolver().resolve(guide))
            self.choice = guides.choose(guide, _guide_options(props, guide))
            given = {name: props.get(name) for name in PARAMETERS if name in props}
            self.arguments: dict[str, Any] = given
            self.arguments["threads"] = props.get("threads", 0) or None
            self.max_depth: int | None = props.get("max_depth") if "max_depth" in props else None
            if self.max_depth is not None and "k" in given:
                raise ValueError("`k` and `max_depth` were both given; give one")
            rr_depth: Any = props.get("rr_depth") if "rr_depth" in props else None
            self.rr_depth = check_roulette(rr_depth, self.max_depth)
            self.aovs = bool(props.get("aovs", False)) and self.max_depth is not None
            self.target = check_target(props.get("target", "radiance"), self.choice)
            if self.target == "gradient" and is_scalar():
                raise ValueError(f"`target` = 'gradient': {NO_GRADIENTS}")
            self.progress = bool(props.get("progress", False))
            self.approximate = bool(props.get("approximate", False))
            self.result: Result | None = None
            self.rendered = ""
            # Wrong values are found where the scene is loaded, not when it is rendered.
            plan = self._plan(spp=0, seed=0, sample_count=DEFAULT_SPP)
            if self.max_depth is not None:
                check_depth(self.max_depth, self.choice, plan, self.arguments.get("preset"))

        def render(
            self,
            scene: Any,
            sensor: Any = 0,
            seed: Any = 0,
            spp: int = 0,
            develop: bool = True,
            evaluate: bool = True,
        ) -> Any:
            """Renders into the sensor's film; returns its developed image, or an empty tensor without `develop`."""
            del evaluate  # The image is computed here and now in either case.
            camera = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            plan = self._plan(
                spp=int(spp),
                seed=_scalar(seed),
                sample_count=camera.sampler().sample_count(),
            )
            ours = Scene(
                scene, camera, hide_emitters=self.hide_emitters, approximate=self.approximate
            )
            if self.max_depth is None:
                self.result = run(ours, self.choice, plan, self.progress)
            else:
                self.result = render_light(
                    *(ours, self.choice, plan, self.max_depth, self.progress),
                    rr_depth=self.rr_depth,
                )
            self.rendered = ours.hash
            _fill(camera.film(), self.result, self.aov_names())
            return camera.film().develop() if develop else mi.TensorXf()

        def render_forward(
            self, scene: Any, params: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0
        ) -> Any:
            """The image's derivative along the parameters' gradients; see `pssflow.gradients`."""
            camera, drawn = self._to_differentiate(scene, params, sensor, spp)
            with dr.suspend_grad():
                return gradients.forward(
                    *drawn[:2], camera, _scalar(seed), *drawn[2:], self._learner(params)
                )

        def render_backward(
            self,
            scene: Any,
            params: Any,
            grad_in: Any,
            sensor: Any = 0,
            seed: Any = 0,
            spp: int = 0,
        ) -> None:
            """Adds the gradients of the parameters to what they have; see `pssflow.gradients`."""
            camera, drawn = self._to_differentiate(scene, params, sensor, spp)
            with dr.suspend_grad():
                gradients.backward(
                    *drawn[:2], camera, grad_in, _scalar(seed), *drawn[2:], self._learner(params)
                )

        def _to_differentiate(
            self, scene: Any, params: Any, sensor: Any, spp: int
        ) -> tuple[Any, tuple[Scene, Result, int, str]]:
            """The camera, and what is drawn from: scene, render, samples per pixel, parametrisation."""
            if is_scalar():
                raise NotImplementedError(NO_GRADIENTS)
            gradients.check_parameters(scene, params)
            camera = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            if self.aovs:
                raise ValueError("gradients are not supported with `aovs`")
            ours = Scene(
                scene, camera, hide_emitters=self.hide_emitters, approximate=self.approximate
            )
            # The guides of another scene, or of this one before an edit, may know nothing of this one.
            if self.result is None or self.rendered != ours.hash:
                self.render(scene, camera, spp=spp)
            assert self.result is not None
            samples = int(spp) or self.arguments.get("spp") or camera.sampler().sample_count()
            return camera, (ours, self.result, samples, self.result.stats["parametrisation"])

        def _learner(self, params: Any) -> Target | None:
            """What asks for guides of the gradient, if that is the target."""
            if self.target != "gradient":
                return None
            return Target(self.choice, params, self.arguments.get("uniform_fraction"))

        def aov_names(self) -> list[str]:
            """With `max_depth` and `aovs` a name for each channel of `result`'s layers; else none."""
            if not self.aovs or self.max_depth is None:
                return []
            layers = [f"k{k}" for k in range(self.max_depth)]
            return [f"{layer}.{c}" for layer in (*layers, *OTHER_LAYERS) for c in "RGB"]

        def to_string(self) -> str:
            """As Mitsuba prints its own."""
            values = {"guide": self.choice.label, "max_depth": self.max_depth}
            values |= {"rr_depth": self.rr_depth, "target": self.target}
            values |= {**self.arguments, **self.choice.options}
            lines = [f"  {name} = {value}" for name, value in values.items() if value is not None]
            return "PssflowIntegrator[\n" + ",\n".join(lines) + "\n]"

        def _plan(self, *, spp: int, seed: int, sample_count: int) -> Plan:
            """The arguments of one call: `mi.render`'s own win; there 0 says "not given"."""
            arguments = dict(self.arguments)
            if spp:
                arguments["spp"] = spp
                arguments.pop("time", None)
            elif not {"spp", "time"} & arguments.keys() and "preset" not in arguments:
                arguments["spp"] = sample_count
            if seed:
                arguments["seed"] = seed
            auto = self.choice.kind == "auto"
            return Plan.make(learns=self.choice.learns, may_end_in_none=auto, **arguments)

    return PssflowIntegrator


NO_GRADIENTS = "integrator pssflow: scalar variants have no derivatives; use llvm_ad_rgb"


def _guide_options(props: Any, guide: str) -> dict[str, Any]:
    """The options of the guides in use. Those of others are not read: Mitsuba lists them as unreferenced."""
    options: dict[str, Any] = {}
    known = guides.registry()
    for part in guides.aliases().get(guide, guide).split("+"):
        prefix = part.replace("-", "_") + "_"
        for option in known.get(part, {}).get("options", ()):
            if prefix + option in props:
                options[f"{part}.{option}"] = props.get(prefix + option)
    return options


OTHER_LAYERS = ("variance", "nonzero_share")
"""Channels beside those of the path lengths."""


def _fill(film: Any, result: Result, aovs: list[str]) -> None:
    """Makes an image (H, W, 3) and its layers the film's content, so that it develops to its own pixel format."""
    channels = film.prepare(aovs)
    # R G B W, or R G B A W, then others; the image is filtered and divided by its weights already.
    values = np.ones((*result.image.shape[:2], channels), np.float32)
    values[..., :3] = result.image
    layers = {"variance": result.variance, **result.layers}
    for i, name in enumerate(aovs):
        layer, _, channel = name.rpartition(".")
        values[..., channels - len(aovs) + i] = (
            layers[layer][..., "RGB".index(channel)] if layer in layers else 0.0
        )
    tensor: Any = mi.TensorXf(values)
    film.put_block(mi.ImageBlock(tensor, film.crop_offset(), border=False))


def _scalar(seed: Any) -> int:
    """A seed, which JIT variants may pass as an array of one."""
    return int(seed) if isinstance(seed, int) else int(np.asarray(seed).ravel()[0])
