"""Types of the extension module: the Rust core. Shapes and units are stated where they are not obvious.

Errors: a wrong argument is a `ValueError`, a missing file a `FileNotFoundError`, a file that cannot be
written an `OSError`, a failure of a library a `RuntimeError`, Ctrl-C a `KeyboardInterrupt`; always one line.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

__version__: str

F32 = NDArray[np.float32]

class ForeignGuide(Protocol):
    """Any Python object with these methods works as a guide (see `pssflow.guide`)."""

    def fit(self, u: F32, f: F32, g: F32, zeros: int, seed: int) -> None: ...
    def sample(self, n: int, seed: int) -> tuple[F32, F32]: ...
    def log_prob(self, u: F32) -> F32: ...

class Guide:
    """A fitted density on the cube of primary numbers."""

    @staticmethod
    def fit(
        name: str,
        records: dict[str, Any],
        *,
        options: str = "{}",
        seed: int = 0,
        progress: Callable[[str, float], None] | None = None,
    ) -> Guide:
        """Fits guide `name` to paths, of which only those that carry light need be given.

        `records` holds float32 arrays: u (n, d) numbers, f (n,) contributions or whatever else the paths shall weigh,
        and, each of which may be missing or None, f_bsdf (n,) the part of f that the numbers of emitter and light do
        not decide, f_max (n,) its largest component, ray (n, 2) the numbers of the BSDF-sampled ray, g, g_bsdf, g_both
        (n,) densities of the numbers that f_nee and f_bsdf use and of all, pixel (n, 2) in [0, 1)², contexts, a
        dictionary of arrays with a row for each vertex, emitters, a list of (upper end of its interval, whether it
        surrounds the scene), and zeros, the number of paths that are not given.
        """
    @staticmethod
    def learn(
        name: str,
        records: dict[str, Any],
        *,
        paths: float,
        found: float,
        options: str = "{}",
        seed: int = 0,
    ) -> tuple[Guide, float] | None:
        """A guide by name, or what `auto` chooses, and its share of uniform paths; None where nothing pays.

        `paths` are still to be drawn, of which a share `found` has all its vertices. `records` as in `fit`.
        """
    @staticmethod
    def load(
        path: str, columns_hash: str | None = None, scene_hash: str | None = None
    ) -> Guide: ...
    def save(self, path: str, columns_hash: str, scene_hash: str) -> None: ...
    def sample(
        self,
        n: int,
        seed: int = 0,
        decision: str = "path",
        contexts: dict[str, NDArray[Any]] | None = None,
    ) -> tuple[F32, F32]:
        """Draws (n, d) numbers and their log-density (n,); -inf is never returned for a drawn row."""
    def log_prob(
        self, u: F32, decision: str = "path", contexts: dict[str, NDArray[Any]] | None = None
    ) -> F32:
        """Log-density of rows u (n, d), shape (n,)."""
    def cells(self, n: int, decision: str, contexts: dict[str, NDArray[Any]]) -> NDArray[np.int64]:
        """The guide's cell of each place, (n,); -1 where it has none."""
    @property
    def models(self) -> list[str]: ...
    @property
    def name(self) -> str: ...
    @property
    def dims(self) -> int: ...
    @property
    def parameters(self) -> int: ...
    @property
    def mass_outside(self) -> float: ...
    def describe(self) -> str:
        """JSON: configuration and training; `memory` is what it holds, in bytes."""

class Scene:
    """A scene that can be traced, built from `pssflow.export`."""

    def __init__(
        self,
        description: str,
        arrays: Iterable[NDArray[Any]],
        search_dirs: Sequence[str] = (),
    ) -> None: ...
    @property
    def hash(self) -> str: ...
    @property
    def width(self) -> int:
        """Columns of the crop."""
    @property
    def height(self) -> int: ...
    @property
    def embree(self) -> str:
        """Version and path of the library in use."""
    def summary(self) -> str:
        """JSON: counts of shapes, BSDFs, emitters; triangles, degenerate_triangles, geometry_bytes."""
    def columns(self, k: int, emitter_strategy: str) -> list[str]: ...
    def emitter_intervals(self) -> list[tuple[float, bool]]:
        """Per emitter: the upper end of its interval of the emitter's number, and whether it surrounds the scene."""
    def columns_hash(self, k: int, parametrisation: str) -> str: ...
    def auto_strategy(
        self, *, k: int, parametrisation: str, threads: int = 0
    ) -> tuple[str, str, float | None]:
        """What `emitter_strategy="auto"` means here, why, and nee's cost ÷ mis' for one error if it was probed."""
    def trace(
        self,
        u: F32,
        pixels: F32,
        *,
        k: int,
        parametrisation: str,
        emitter_strategy: str,
        threads: int = 0,
    ) -> dict[str, NDArray[Any]]:
        """Columns u (n, 2k+1 or 2k+3), pixels (n, 2) film positions in pixels from the crop's corner,
        or (n, 4) with two numbers in [0, 1) more for the point of a lens; without them its centre.

        Returns f (n,3), f_nee (n,3), f_bsdf (n,3), found (n,) bool, position/normal/outgoing (n,k,3),
        pixel (n,2) in [0,1)², emitter (n,) uint32.
        """
    def pilot(
        self,
        *,
        spp: int,
        k: int,
        parametrisation: str,
        emitter_strategy: str,
        seed: int = 0,
        threads: int = 0,
    ) -> dict[str, NDArray[Any]]:
        """All uniform paths of `spp` samples a pixel: u (n,2k+1 or 2k+3), pixels (n,2), g (n,), and trace's keys.

        With a lens pixels are (n,4), as `trace` takes them.
        """
    def lengths(
        self,
        lengths: Sequence[tuple[int, str]],
        *,
        spp: float,
        parametrisation: str,
        rr_depth: int | None = None,
        threads: int = 0,
    ) -> str:
        """JSON, for each (k, emitter strategy): k, variance, square, rays, lit, mean, and samples per pixel of `spp`.

        With `rr_depth` these halve with each bounce from there on.
        """
    def draw(
        self,
        guide: Guide | None = None,
        *,
        uniform_fraction: float,
        first_sample: int,
        spp: int,
        k: int,
        parametrisation: str,
        emitter_strategy: str,
        seed: int = 0,
        threads: int = 0,
        numbers: bool = False,
    ) -> dict[str, NDArray[Any]]:
        """Draws `spp` paths a pixel as a pass does, rows, pixels and samples in order.

        Returns what `trace` returns, and film (n,2) in pixels from the crop's corner, lens (n,2) or (0,2), m_nee (n,),
        m_bsdf (n,); step_d (n,k,3) directions at x₁ … x_{k-1} and of the BSDF ray at x_k, step_weight (n,k,3)
        f_s·|cos θ| ÷ pdf, step_pdf (n,k), 0 for delta lobes; join_d (n,3), join_scale (n,) w_nee ÷ p_nee, 0 where no
        light was joined; mis (n,) w_bsdf, 0 where the ray met no light. With `numbers` also u (n,d) and m_both (n,),
        the density of all of them.
        """
    def render(
        self,
        options: str,
        guide: Guide | ForeignGuide | None = None,
        progress: Callable[[str, float], None] | None = None,
    ) -> dict[str, Any]:
        """Renders. `options` is JSON:

        {"guide": "none" | "auto" | names of the registry joined by `+`, or an alias | "ready" (the fitted `guide`)
         | "foreign" (the object `guide`),
         "guide_options": {...}, "k": 2 (0: emission), "parametrisation": "bsdf|cosine|uniform",
         "emitter_strategy": "mis|nee", "spp": N or null, "time": seconds or null,
         "snapshots": [shorter times], "replay": [passes of a record] or null,
         "survival": probability that a path is traced, "uniform_fraction": a or null,
         "pilot_spp": n or null, "keep_pilot": true,
         "combine": "samples|variance", "seed": 0, "threads": 0}

        "guide_options", "spp", "time", "snapshots", "replay", "survival", "uniform_fraction", "pilot_spp" and "combine"
        may be left out; one of spp, time and replay must be there.

        A pass is {"kind": "pilot|guided|uniform", "spp": samples per pixel, "record": share of the light-carrying
        paths kept for training, "fit": whether the guide was fitted anew before it}, and if guided also {"guide": name
        of what drew it, "a": its share of uniform paths}. Only kind and spp must be given.

        Returns image (h,w,3), variance (h,w,3) [variance of the mean], found and nonzero (h,w) uint32 [per pixel,
        over all paths in the image], and "record": JSON string with
        {"chosen", "a", "k", "parametrisation", "emitter_strategy", "combine", "seed", "threads", "camera_rays",
         "paths_found", "nonzero", "nonzero_share", "outside", "non_finite",
         "pilot": {the same, "mean_square"}, "mean": [r,g,b],
         "variance": relMSE's formula with the own variance of the mean, "max_weight", "max_contribution", "ess",
         "diagnostics": what docs/diagnostics.md explains, "passes": [pass],
         "candidates": what `auto` considered, [{"name","a","predicted_gain","cost_ratio",
         "training_share","net_gain","chosen","why"}] or null, "notes": [str],
         "training": {"loss","seconds","dropped_nonfinite","outliers_removed","trained_on","samples",
         "guide": its `describe`} or null, "seconds": {"pilot","fit","render"},
         "elapsed": seconds of all phases and between them},
        "guide": Guide, the object that was given, or None, and "snapshots": a list of the same, each with the "time"
        that was asked for.
        """
    # For parity tests: values of single plugins.
    def ray_intersect(self, origins: F32, directions: F32) -> dict[str, NDArray[Any]]:
        """Per ray: valid (n,), p, n, sh_n, dp_dv (n,3), uv (n,2), shape (n,) index, sh_s (n,3) uv-frame tangent."""
    def bsdf_eval_pdf(self, bsdf: int, uv: F32, wi: F32, wo: F32) -> tuple[F32, F32]:
        """Local directions (z = normal): value·cos (n,3) and pdf (n,)."""
    def bsdf_sample(
        self, bsdf: int, uv: F32, wi: F32, u: F32
    ) -> tuple[F32, F32, F32, NDArray[np.bool_]]:
        """Returns wo (n,3), weight (n,3), pdf (n,), delta (n,); pdf 0 where nothing was sampled.

        Where `delta` is set, pdf is the lobe's probability.
        """
    def bsdf_sample_delta(
        self, bsdf: int, uv: F32, wi: F32, u: F32
    ) -> tuple[F32, tuple[F32, F32, F32, NDArray[np.bool_]]]:
        """Delta lobes alone, from one number each: their probability (n,), and what `bsdf_sample` returns."""
    def texture_eval(self, texture: int, uv: F32) -> F32: ...
    def texture_eval_at_hits(self, texture: int, origins: F32, directions: F32) -> tuple[F32, F32]:
        """A texture's colours (n,3) and scalars (n,) where rays meet surfaces; zero where they meet none."""
    def emitter_eval_pdf(self, emitter: int, reference: F32, directions: F32) -> tuple[F32, F32]:
        """What rays see of an emitter, (n, 3), and its density in solid angle, (n,)."""

    def emitter_sample(self, emitter: int, reference: F32, u: F32) -> dict[str, NDArray[Any]]:
        """Returns d (n,3), radiance (n,3), pdf (n,) (0: none), p (n,3)."""
    def film_ray(self, pixels: F32, lens: F32 | None = None) -> tuple[F32, F32]:
        """Origins and directions of camera rays through film positions and points of the lens (None: its centre)."""
    def rays_alone(self, *, spp: int, k: int, threads: int = 0) -> dict[str, float]:
        """Times only the Embree queries that rendering makes: {"seconds", "rays", "rays_per_path"}."""

def last_probed(rr_depth: int) -> int:
    """The longest path length that `Scene.lengths` probes."""

def guide_aliases() -> str:
    """Names that stand for several guides, JSON: {name: guides joined by `+`}."""

def guides() -> str:
    """JSON list of the registry: [{"name", "summary", "options": {default options}}]."""

def read_exr(path: str) -> dict[str, F32]:
    """Channels (h,w) of an EXR's first part by their full names: R, variance.R. On the calling thread alone.

    Raises:
        ValueError: it is missing, no EXR, damaged, or of a kind that is not understood.
    """

def write_exr(path: str, layers: dict[str, F32]) -> None:
    """Writes layers (name -> (h,w,3)) as one-part f32 EXR with dotted channel names; key "" is the image."""
