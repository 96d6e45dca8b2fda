r"""Learned numbers for any Mitsuba integrator.

.. _integrator-pss_guided:

Learned primary-sample-space importance sampling (:monosp:`pss_guided`)
-----------------------------------------------------------------------

.. pluginparameters::

 * - (nested)
   - |integrator|
   - Turns numbers into radiance: any integrator with a method ``sample`` and no further channels. Used as a black box.
 * - guide
   - |string|
   - ``auto`` takes ``vegas`` (a histogram of each number), by tile of the image or for the whole, over all or half of
     the numbers, whichever a held-out half of the pilot finds best, or none where nothing pays. ``vegas``, ``realnvp``
     or ``realnvp-logit`` by name is always used. ``none``. (Default: ``auto``)
 * - dimensions
   - |int|
   - How many of its numbers are learned, the first ones, 2 … 64. (Default: 12, two bounces of ``path``)
 * - uniform_fraction
   - |float|
   - Share of uniform paths in the mixture, in (0, 1]; bounds every weight by 1 / itself. (Default: what the held-out
     half finds best of 0.1, 0.25, 0.5)
 * - pilot_spp
   - |int|
   - Samples per pixel of the pilot, 2 or more. (Default: an eighth)
 * - seed
   - |int|
   - Added to that of ``mi.render``. (Default: 0)

A pilot is rendered with uniform numbers that are written down; a guide q learns where they were bright; the rest is
drawn from the mixture m = a + (1 − a)·q and divided by it. That is unbiased for every guide, since m ≥ a > 0, as long
as radiance is a function of the camera ray and of numbers that come from the sampler: an integrator that remembers
earlier samples, or draws numbers of its own, breaks it. The pilot's samples count half. Film position and lens are
never learned.

Expect little where noise comes from behind the first ``dimensions`` numbers, or where numbers mean something else in
each pixel: this guide knows a path's tile, not its vertices. For scenes that it supports, ``pssflow`` does better.

LLVM variants only: there all lanes draw the same columns (:monosp:`COLUMNS`). Nothing is differentiated. ``stats`` on
the integrator says what was chosen and what it gained: the variance of uniform samples over that of guided ones.

.. tabs::
    .. code-tab:: xml

        <integrator type="pss_guided">
            <integrator type="path"/>
        </integrator>

    .. code-tab:: python

        'type': 'pss_guided',
        'nested': {'type': 'path'}
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..guide import Guide, registry
from ..jit import columns as jit_columns
from ..jit import to_jit
from ..options import check_integer, check_number
from ..rows import LUMINANCE
from . import replay

__all__ = ["COLUMNS", "columns", "define"]

F32 = NDArray[np.float32]

BOUNCE = ("emitter.0", "emitter.1", "lobe", "direction.0", "direction.1", "roulette")
COLUMNS: dict[str, tuple[str, ...]] = {
    "PathIntegrator": BOUNCE,
    "PRBIntegrator": BOUNCE,
    # Two arguments of one call in C++: the compiler evaluates the last one first.
    "DirectIntegrator": (*BOUNCE[:2], *BOUNCE[3:5], "lobe"),
    "BasicPRBIntegrator": BOUNCE[2:5],
}
"""What the numbers of a bounce decide, in the order in which LLVM variants draw them, by class. `DirectIntegrator` has
one bounce. Integrators that are not here are guided as well; their columns have no names."""

SHARES = (0.1, 0.25, 0.5)
"""Shares of uniform paths that are tried."""
PILOT_DIVISOR = 8
PILOT_WEIGHT = 0.5
"""As in the estimator of `pssflow`: fixed before sampling, and above an eighth of the samples a cap on all gains."""
MOST_AT_ONCE = 1 << 19
"""Samples of a pass: bounds memory."""
MOST_LEARNED = 1 << 21
"""Samples of the pilot that are kept to learn from, to the end of a pass; those after them are in the image alone."""
TILES = 8
"""Along each side of the image, for the prediction; as `vegas` has them."""


def columns(integrator: Any, bounces: int = 2) -> list[str]:
    """Names of the first columns of an integrator's numbers, as `x1.lobe`; empty where they are not known."""
    names = COLUMNS.get(type(integrator).__name__, COLUMNS.get(integrator.class_name(), ()))
    return [f"x{b}.{name}" for b in range(1, bounces + 1) for name in names]


@dataclass
class _Samples:
    """A pass, as arrays; samples of a pixel lie next to each other."""

    u: F32
    pixel: F32
    """Film positions in [0, 1)² of the crop."""
    f: F32
    """Luminance, undivided."""
    m: F32
    """Density of the numbers."""


class _Sums:
    """What is left of samples that nothing is learned from: by tile their number, Σ e and Σ e² of e = f ÷ m."""

    def __init__(self) -> None:
        self.n, self.first, self.second = np.zeros((3, TILES**2))

    def add(self, samples: _Samples) -> None:
        """Adds a pass."""
        tile, estimate = _tiles(samples.pixel), samples.f.astype(np.float64) / samples.m
        self.n += np.bincount(tile, minlength=TILES**2)
        self.first += np.bincount(tile, estimate, TILES**2)
        self.second += np.bincount(tile, estimate**2, TILES**2)

    @property
    def mean(self) -> float:
        """Of all samples."""
        return float(self.first.sum() / max(self.n.sum(), 1.0))

    def variance(self, whole: float) -> float:
        """Variance of a sample, relative to its tile's mean, summed over tiles; `whole`: mean of the image."""
        counts = np.maximum(self.n, 1.0)
        mean, second = self.first / counts, self.second / counts
        return float(np.sum((second - mean**2) / np.maximum(mean**2 + (0.1 * whole) ** 2, 1e-30)))


@dataclass(frozen=True)
class _Candidate:
    """What might be learned: a guide over the first `dimensions` numbers."""

    name: str
    dimensions: int
    condition: str | None = None

    def fit(self, u: F32, f: F32, pixel: F32, seed: int) -> Guide:
        """Learns from samples (n, …) drawn uniformly."""
        # Guides ask for vertices, of which there are half as many as numbers; those of whole paths look at none.
        nowhere = np.zeros((len(u), (self.dimensions - 1) // 2, 3), np.float32)
        contexts = {"position": nowhere, "normal": nowhere, "outgoing": nowhere, "pixel": pixel}
        options: dict[str, Any] = {} if self.condition is None else {"condition": self.condition}
        return Guide.fit(
            self.name, u[:, : self.dimensions], np.abs(f), contexts=contexts, seed=seed, **options
        )

    @staticmethod
    def density(guide: Guide, u: F32, pixel: F32) -> NDArray[np.float64]:
        """Q of the numbers that the guide models; the others are uniform."""
        log_q = guide.log_prob(u[:, : guide.dims], contexts={"pixel": pixel})
        return np.exp(log_q.astype(np.float64))


def define() -> Callable[[Any], Any]:
    """The integrator of the active variant: a function from `mi.Properties` to an instance."""
    sampler_class: Any = replay.define()

    class GuidedIntegrator(mi.SamplingIntegrator):
        """See the module."""

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            if "llvm" not in str(mi.variant()):
                raise ValueError(
                    f"integrator pss_guided: in {mi.variant()} lanes do not draw the same numbers; use llvm_ad_rgb"
                )
            self.nested = _nested(props)
            self.guide = str(props.get("guide", "auto"))
            if self.guide not in ("auto", "none", *WHOLE_PATH):
                raise ValueError(
                    f"integrator pss_guided: `guide` = {self.guide!r} does not model all numbers at once "
                    f"(known: auto, none, {', '.join(WHOLE_PATH)})"
                )
            self.dimensions = check_integer("dimensions", props.get("dimensions", 12), 2, 64)
            self.uniform_fraction: float | None = None
            if "uniform_fraction" in props:
                self.uniform_fraction = check_number(
                    "uniform_fraction", props.get("uniform_fraction"), 0.0, 1.0, above=True
                )
            self.pilot_spp: int | None = None
            if "pilot_spp" in props:
                self.pilot_spp = check_integer("pilot_spp", props.get("pilot_spp"), 2, 1 << 24)
            self.base_seed = check_integer("seed", props.get("seed", 0), 0, 2**32 - 1)
            self.stats: dict[str, Any] = {}

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
            del evaluate  # What is learned must be known before the rest is drawn.
            camera = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            if camera.get_medium() is not None:
                raise ValueError("integrator pss_guided: cameras inside a medium are not supported")
            spp = int(spp) or camera.sampler().sample_count()
            first = int(np.asarray(seed).ravel()[0]) + self.base_seed
            with dr.suspend_grad():
                film = camera.film()
                film.prepare([])
                block = film.create_block()
                self._fill(scene, camera, block, spp, np.random.Philox(first % 2**64))
                film.put_block(block)
                return film.develop() if develop else mi.TensorXf()

        def render_forward(self, *_args: Any, **_kwargs: Any) -> Any:
            """Raises: there are no derivatives."""
            raise NotImplementedError(NO_GRADIENTS)

        def render_backward(self, *_args: Any, **_kwargs: Any) -> None:
            """Raises: there are no derivatives."""
            raise NotImplementedError(NO_GRADIENTS)

        def to_string(self) -> str:
            """As Mitsuba prints its own."""
            inner = str(self.nested).replace("\n", "\n  ")
            values = {"guide": self.guide, "dimensions": self.dimensions, "nested": inner}
            return (
                "GuidedIntegrator[\n"
                + ",\n".join(f"  {k} = {v}" for k, v in values.items())
                + "\n]"
            )

        def _fill(self, scene: Any, camera: Any, block: Any, spp: int, bits: Any) -> None:
            """Pilot, guide, rest."""
            rng = np.random.Generator(bits)
            pilot_spp = self.pilot_spp or max(spp // PILOT_DIVISOR, 2)
            learns = self.guide != "none" and pilot_spp < spp
            clock = [time.perf_counter()]
            kept: list[_Samples] = []
            pilot = _Sums()
            if learns:
                for samples in self._passes(
                    scene, camera, block, pilot_spp, rng, None, 1.0, PILOT_WEIGHT
                ):
                    pilot.add(samples)
                    if sum(len(s.f) for s in kept) < MOST_LEARNED:
                        kept.append(samples)
            clock.append(time.perf_counter())
            guide, a, promised = self._learn(kept, rng) if learns else (None, 1.0, None)
            kept.clear()
            clock.append(time.perf_counter())
            rest = spp - pilot_spp if learns else spp
            drawn = _Sums()
            for samples in self._passes(scene, camera, block, rest, rng, guide, a, 1.0):
                drawn.add(samples)
            clock.append(time.perf_counter())
            gain: float | None = None
            if guide is not None and rest > 1:
                gain = pilot.variance(pilot.mean) / max(drawn.variance(pilot.mean), 1e-30)
            pilot_s, fit_s, render_s = (float(s) for s in np.diff(clock))
            self.stats = {
                "chosen": "none" if guide is None else guide.name,
                "a": a,
                "predicted_gain": promised,
                "gain": gain,
                "spp": spp,
                "pilot_spp": pilot_spp if learns else 0,
                "dimensions": self.dimensions if guide is None else guide.dims,
                "columns": columns(self.nested, self.dimensions)[: self.dimensions],
                "seconds": {"pilot": pilot_s, "fit": fit_s, "render": render_s},
            }
            gained = "" if gain is None else f", variance of a sample lower by {gain:.2f}"
            log: Any = mi.Log
            log(mi.LogLevel.Info, f"pss_guided: {self.stats['chosen']} at a = {a:g}{gained}")

        def _passes(
            self,
            scene: Any,
            camera: Any,
            block: Any,
            spp: int,
            rng: np.random.Generator,
            guide: Guide | None,
            a: float,
            weight: float,
        ) -> Iterator[_Samples]:
            """Renders `spp` samples a pixel, a few at a time, and puts them on the film with a weight."""
            width, height = (int(n) for n in camera.film().crop_size())
            most = max(MOST_AT_ONCE // (width * height), 1)
            for start in range(0, spp, most):
                n = min(most, spp - start)
                yield self._pass(scene, camera, block, n, rng, guide, a, weight)

        def _pass(
            self,
            scene: Any,
            camera: Any,
            block: Any,
            spp: int,
            rng: np.random.Generator,
            guide: Guide | None,
            a: float,
            weight: float,
        ) -> _Samples:
            film = camera.film()
            width, height = (int(n) for n in film.crop_size())
            lanes = width * height * spp
            # Samples of a pixel next to each other, rows from the top.
            index = np.arange(lanes) // spp
            corner = np.stack([index % width, index // width], axis=1)
            offset = rng.random((lanes, 2), np.float32)
            place = (corner + offset) / np.array([width, height])
            place = np.minimum(place, np.float32(1.0 - 2.0**-24)).astype(np.float32)
            lens = rng.random((lanes, 2), np.float32)
            shutter = rng.random(lanes, np.float32)
            u, m = self._numbers(lanes, place, rng, guide, a)
            sampler = sampler_class()
            sampler.set_sample_count(spp)
            sampler.replay(u)
            sampler.seed(int(rng.integers(2**32)), lanes)
            ray, ray_weight = camera.sample_ray_differential(
                camera.shutter_open() + to_jit(mi.Float, shutter) * camera.shutter_open_time(),
                0.0,
                jit_columns(mi.Point2f, mi.Float, place),
                jit_columns(mi.Point2f, mi.Float, lens),
            )
            if ray.has_differentials:
                ray.scale_differential(mi.Float(1.0 / np.sqrt(spp)))
            radiance, valid = _sample(self.nested, scene, sampler, ray)
            value = radiance * ray_weight
            value = dr.select(dr.all(dr.isfinite(value)), value, 0.0)
            estimate = value / to_jit(mi.Float, m)
            alpha = dr.select(valid, mi.Float(1.0), mi.Float(0.0))
            channels = [estimate.x, estimate.y, estimate.z]
            if block.channel_count() == 5:
                channels.append(alpha)
            channels.append(dr.ones(mi.Float, lanes))
            if film.rfilter().is_box_filter():
                # Summed by pixel in a fixed order: lanes that add to one pixel at once would round as they come.
                channels = [dr.block_sum(c, spp) for c in channels]
                at = corner[::spp]
            else:
                at = corner + offset
            at = (at + np.array(film.crop_offset())).astype(np.float32)
            where = jit_columns(mi.Point2f, mi.Float, at)
            block.put(where, [c * weight for c in channels])
            rgb = np.array(value, np.float32).reshape(3, -1)
            dr.eval(block.tensor())
            f = (LUMINANCE @ np.broadcast_to(rgb, (3, lanes))).astype(np.float32)
            return _Samples(u, place, f, m)

        def _numbers(
            self, n: int, place: F32, rng: np.random.Generator, guide: Guide | None, a: float
        ) -> tuple[F32, F32]:
            """Numbers from the mixture, and its density there: one coin a path."""
            u = rng.random((n, self.dimensions), np.float32)
            if guide is None:
                return u, np.ones(n, np.float32)
            drawn, _ = guide.sample(n, int(rng.integers(2**63)), contexts={"pixel": place})
            guided = rng.random(n) >= a
            inside = ((drawn >= 0.0) & (drawn < 1.0)).all(axis=1)
            rows = guided & inside
            u[rows, : guide.dims] = drawn[rows]
            m = a + (1.0 - a) * _Candidate.density(guide, u, place)
            # Guided rows outside the cube cannot be replayed, and carry no light.
            m[guided & ~inside] = np.inf
            return u, m.astype(np.float32)

        def _learn(
            self, pilot: Sequence[_Samples], rng: np.random.Generator
        ) -> tuple[Guide | None, float, float | None]:
            """A guide, its share of uniform paths and the gain that half of the pilot promises."""
            u, pixel, f = (
                np.concatenate([getattr(p, name) for p in pilot]) for name in ("u", "pixel", "f")
            )
            seed = int(rng.integers(2**63))
            held = np.arange(len(f)) % 2 == 1
            lit = np.count_nonzero(f[held])
            if min(lit, np.count_nonzero(f[~held])) < LEAST_LIT:
                return None, 1.0, None
            shares = SHARES if self.uniform_fraction is None else (self.uniform_fraction,)
            plain = _second_moment(f[held], np.ones(int(held.sum())), pixel[held])
            gains: dict[tuple[_Candidate, float], float] = {}
            for candidate in self._candidates():
                guide = candidate.fit(u[~held], f[~held], pixel[~held], seed)
                q = candidate.density(guide, u[held], pixel[held])
                for a in shares:
                    second = _second_moment(f[held], a + (1.0 - a) * q, pixel[held])
                    gains[candidate, a] = plain / max(second, 1e-30)
            (best, a), gain = max(gains.items(), key=lambda item: item[1])
            if self.guide == "auto" and gain <= 1.05 + 4.0 / np.sqrt(lit):
                return None, 1.0, gain
            return best.fit(u, f, pixel, seed), a, gain

        def _candidates(self) -> list[_Candidate]:
            if self.guide != "auto":
                return [_Candidate(self.guide, self.dimensions)]
            widths = dict.fromkeys((self.dimensions, max(self.dimensions // 2, 1)))
            return [_Candidate("vegas", d, by) for d in widths for by in ("none", "pixel")]

    return GuidedIntegrator


NO_GRADIENTS = (
    "integrator pss_guided: it has no derivatives; use `pssflow`, or the nested integrator itself"
)

LEAST_LIT = 256
"""Paths that carry light of which a guide can be learned."""

WHOLE_PATH = [name for name in ("vegas", "realnvp", "realnvp-logit") if name in registry()]
"""Guides that model all numbers at once, and so need not know what they decide."""


def _nested(props: Any) -> Any:
    """The only integrator among the properties, if it can be a black box."""
    found = [props[name] for name in props.keys() if isinstance(props[name], mi.Integrator)]  # noqa: SIM118
    if len(found) != 1:
        raise ValueError(
            f"integrator pss_guided: it holds {len(found)} integrators; give the one that it shall guide"
        )
    nested = found[0]
    what = f"integrator pss_guided: `{type(nested).__name__}`"
    if not isinstance(nested, mi.SamplingIntegrator) or not hasattr(nested, "sample"):
        raise ValueError(f"{what} has no method `sample` that turns numbers into radiance")
    if any(base.__name__ == "PSIntegrator" for base in type(nested).__mro__):
        raise ValueError(
            f"{what} draws silhouettes beside paths, which are no function of a path's numbers"
        )
    if nested.aov_names():
        raise ValueError(
            f"{what} has further channels ({nested.aov_names()[0]}, …), which cannot be divided by a density"
        )
    return nested


def _sample(nested: Any, scene: Any, sampler: Any, ray: Any) -> tuple[Any, Any]:
    """Radiance along rays and whether they hit anything, of integrators in C++ and of Python's differentiable ones."""
    if hasattr(nested, "sample_rays"):
        radiance, valid, _, _ = nested.sample(
            mode=dr.ADMode.Primal,
            scene=scene,
            sampler=sampler,
            ray=ray,
            depth=mi.UInt32(0),
            δL=None,
            δaovs=None,
            state_in=None,
            active=mi.Bool(True),
        )
    else:
        radiance, valid, _ = nested.sample(scene, sampler, ray, None, mi.Bool(True))
    return radiance, valid


def _tiles(pixel: F32) -> NDArray[np.int64]:
    x, y = np.minimum((pixel * TILES).astype(np.int64), TILES - 1).T
    return y * TILES + x


def _second_moment(f: F32, m: NDArray[np.float64], pixel: F32) -> float:
    """V = Σ over tiles of (mean f² ÷ m − Ī²) ÷ (Ī² + ε) from uniform samples, ε = (0.1 · mean of all)²."""
    tile = _tiles(pixel)
    counts = np.maximum(np.bincount(tile, minlength=TILES**2), 1)
    mean = np.bincount(tile, f, TILES**2) / counts
    second = np.bincount(tile, f.astype(np.float64) ** 2 / m, TILES**2) / counts
    epsilon = (0.1 * f.mean(dtype=np.float64)) ** 2
    return float(np.sum((second - mean**2) / np.maximum(mean**2 + epsilon, 1e-30)))
