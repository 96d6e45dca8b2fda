"""Guides: densities on the cube of primary numbers, and how to bring one's own.

A *guide* is a density q over the numbers u ∈ [0, 1)^d that decide a path (columns: `Scene.columns`). It is learned from
uniform paths, frozen, and then says where paths are worth tracing; the image stays unbiased because each path is
divided by the mixture a + (1 − a)·q(u), which is at least a > 0.

Any Python object with the methods of `ForeignGuide` works wherever a guide does:

```python
class Box:
    "Uniform on the box that holds all light seen so far: not the best of ideas, but a guide."

    def fit(self, u, f, g, zeros, seed):
        self.low, self.high = u.min(axis=0), u.max(axis=0)

    def sample(self, n, seed):
        u = np.random.default_rng(seed).uniform(self.low, self.high, (n, len(self.low)))
        u = u.astype(np.float32)
        return u, self.log_prob(u)

    def log_prob(self, u):
        inside = ((u >= self.low) & (u <= self.high)).all(axis=1)
        return np.where(inside, -np.log(self.high - self.low).sum(), -np.inf).astype(np.float32)


pssflow.render("scene.xml", guide=Box())
```
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _core
from .options import DEFAULT_GUIDE, PRESETS, check_integer
from .rows import matrix, places, records

__all__ = [
    "Choice",
    "ForeignGuide",
    "Guide",
    "aliases",
    "choose",
    "guide_names",
    "is_path",
    "registry",
    "usual_guide",
]

F32 = NDArray[np.float32]

MAX_SEED = 2**64 - 1


@runtime_checkable
class ForeignGuide(Protocol):
    """What an object of another make needs to be used as a guide.

    Arrays are float32. `save(path)` and `load(path)` are for its owner: pssflow does not call them. The estimate is
    unbiased for whatever density the object has, provided that `sample` and `log_prob` agree with each other (tests of
    one's own guide belong there) and a > 0; at a = 0 also q > 0 is needed wherever f > 0. Methods are called from
    another thread, one call at a time; Ctrl-C waits for the call under way.
    """

    def fit(self, u: F32, f: F32, g: F32, zeros: int, seed: int) -> None:
        """Learns from the pilot's paths that carry light.

        Args:
            u: numbers (n, 2k+1).
            f: luminance that each path contributes (n,), W·sr⁻¹·m⁻², undivided by any density, positive.
            g: density that the numbers were drawn from (n,); 1 for a uniform pilot.
            zeros: how many further paths carried no light; they count in a mean.
            seed: for whatever is random; the same seed must give the same guide.
        """
        ...

    def sample(self, n: int, seed: int) -> tuple[F32, F32]:
        """Draws numbers (n, 2k+1) and their log-density (n,). Rows outside [0, 1) contribute nothing."""
        ...

    def log_prob(self, u: F32) -> F32:
        """Log-density (n,) of numbers (n, 2k+1), also of such as `sample` would not draw; -inf is legal there."""
        ...


class Guide:
    """A fitted guide of pssflow's own: `fit`, `sample`, `log_prob`, `save`, `load`."""

    def __init__(self, core: _core.Guide, *, columns_hash: str = "", scene_hash: str = "") -> None:
        self.core = core
        self.columns_hash = columns_hash
        """Hash of the columns it was fitted for; empty if unknown."""
        self.scene_hash = scene_hash
        """Hash of the scene it was fitted in; empty if unknown."""

    def __repr__(self) -> str:
        return f"Guide({self.name!r}, dims={self.dims}, parameters={self.parameters})"

    @classmethod
    def fit(
        cls,
        name: str,
        u: ArrayLike,
        f: ArrayLike,
        *,
        f_bsdf: ArrayLike | None = None,
        ray: ArrayLike | None = None,
        g: ArrayLike | None = None,
        zeros: int = 0,
        contexts: Mapping[str, ArrayLike] | None = None,
        emitters: ArrayLike | None = None,
        seed: int = 0,
        columns_hash: str = "",
        scene_hash: str = "",
        progress: Callable[[str, float], None] | None = None,
        **options: Any,
    ) -> Guide:
        """Fits the guide `name` of the registry.

        | name | shape          | unit, range | meaning                                                     |
        |------|----------------|-------------|-------------------------------------------------------------|
        | `u`  | (n, d)         | [0, 1)      | numbers                                                     |
        | `f`  | (n,) or (n, 3) | ≥ 0         | what they contributed; rows of zero are counted, not learned |
        | `g`  | (n,)           | > 0         | density that they were drawn from; None for 1                |

        `Pilot.fit` gives all of this. Guides that look at where paths are need `contexts`: `position`, `normal`,
        `outgoing` (n, k, 3) of x₁ … x_k, `pixel` (n, 2) in [0, 1)², and `emitter` (n,), the one chosen at x_k.

        Args:
            name: a name of `registry()`, several joined by `+`, or one of `aliases()`.
            u: see above.
            f: see above; of RGB values the luminance, and for resampling the largest component, is learned.
            f_bsdf: the part of f that the emitter's and the light's numbers do not decide, shaped as f; None for 0.
            ray: numbers of the BSDF-sampled ray at the last vertex, (n, 2); None where there is none.
            g: see above.
            contexts: see above.
            emitters: per emitter the upper end of its interval of the emitter's number and whether it surrounds the
                scene (m, 2); None for a single one.
            zeros: paths without light that were left out of `u`.
            seed: of the initial weights and the order of training.
            columns_hash: stored by `save`; see `Pilot`.
            scene_hash: stored by `save`.
            progress: called with "fit" and the share done.
            **options: the guide's own; `registry()` lists them with their defaults.

        Raises:
            ValueError: an unknown name or option, wrong shapes, values out of range, too few paths.
        """
        rows = records(
            u, f, f_bsdf=f_bsdf, ray=ray, g=g, zeros=zeros, contexts=contexts, emitters=emitters
        )
        core = _core.Guide.fit(
            name,
            rows,
            options=options_json(_by_part(name, options)),
            seed=check_integer("seed", seed, 0, MAX_SEED),
            progress=progress,
        )
        return cls(core, columns_hash=columns_hash, scene_hash=scene_hash)

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        *,
        columns_hash: str | None = None,
        scene_hash: str | None = None,
    ) -> Guide:
        """Reads what `save` wrote, and refuses it where a hash is given and differs.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it is no guide, of another version, or of another scene or other columns.
        """
        core = _core.Guide.load(os.fspath(path), columns_hash, scene_hash)
        return cls(core, columns_hash=columns_hash or "", scene_hash=scene_hash or "")

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes weights, configuration and hashes (safetensors). A failed write leaves nothing behind.

        Raises:
            OSError: it cannot be written.
        """
        self.core.save(os.fspath(path), self.columns_hash, self.scene_hash)

    def sample(
        self,
        n: int,
        seed: int = 0,
        *,
        decision: str = "path",
        contexts: Mapping[str, ArrayLike] | None = None,
    ) -> tuple[F32, F32]:
        """Draws numbers (n, d) and their log-density (n,). Some guides put rows outside [0, 1): see `mass_outside`.

        Args:
            n: rows.
            seed: the same seed gives the same rows.
            decision: one of `models`: `path` (all numbers at once), `direction` (d = 2), `emitter` (1), `light` (2) or
                `ray` (2), the BSDF-sampled one at the last vertex.
            contexts: where it is taken, a row each, for guides that look: `position`, `normal`, `outgoing` (n, 3),
                `pixel` (n, 2), `emitter`, `bounce` (n,); what is missing is zero, and bounce 1.

        Raises:
            ValueError: the guide does not model the decision, or looks at contexts and has none.
        """
        rows = check_integer("n", n, 0, 2**40)
        seed = check_integer("seed", seed, 0, MAX_SEED)
        return self.core.sample(rows, seed, decision, places(contexts))

    def log_prob(
        self,
        u: ArrayLike,
        *,
        decision: str = "path",
        contexts: Mapping[str, ArrayLike] | None = None,
    ) -> F32:
        """Log-density (n,) of a decision's numbers (n, d); `decision` and `contexts` as in `sample`.

        Raises:
            ValueError: `u` has another number of columns, or as `sample`.
        """
        u = matrix(u)
        if decision == "path" and "path" in self.models and u.shape[1] != self.dims:
            raise ValueError(f"`u` has {u.shape[1]} columns; this guide has {self.dims}")
        return self.core.log_prob(u, decision, places(contexts))

    def cells(
        self, contexts: Mapping[str, ArrayLike], *, decision: str = "direction"
    ) -> NDArray[np.int64]:
        """Which of the guide's cells each place belongs to, (n,): its density is the same throughout a cell.

        Numbers mean nothing but themselves; -1 where the guide has no cell. `contexts` as in `sample`.

        Raises:
            ValueError: the guide does not model the decision, or the arrays differ in length.
        """
        where = places(contexts) or {}
        rows = len(next(iter(where.values()), ()))
        return self.core.cells(rows, decision, where)

    @property
    def models(self) -> list[str]:
        """The decisions that it models."""
        return self.core.models

    @property
    def name(self) -> str:
        """Its name in the registry."""
        return self.core.name

    @property
    def dims(self) -> int:
        """Numbers that it models."""
        return self.core.dims

    @property
    def parameters(self) -> int:
        """Weights that were learned."""
        return self.core.parameters

    @property
    def mass_outside(self) -> float:
        """Share of its samples outside the cube, estimated when it was fitted; these contribute nothing."""
        return self.core.mass_outside

    def describe(self) -> dict[str, Any]:
        """Configuration and training."""
        return json.loads(self.core.describe())


@dataclass(frozen=True)
class Choice:
    """What an argument `guide` means."""

    label: str
    """As asked, for records."""
    kind: str
    """What the core is told: `none`, a name of the registry, `ready` or `foreign`."""
    learns: bool
    """Whether it takes a pilot; `auto` may end there."""
    options: dict[str, Any]
    """The guide's own options."""
    given: Guide | ForeignGuide | None = None
    """The object itself, for `ready` and `foreign`."""
    path: Path | None = None
    """A saved guide, to be loaded when the scene is known."""


def registry() -> dict[str, dict[str, Any]]:
    """Guides by name: a `summary` of one line, and their `options` with defaults. `none` is not among them."""
    return {entry.pop("name"): entry for entry in json.loads(_core.guides())}


def aliases() -> dict[str, str]:
    """Names that stand for several guides, and these, joined by `+`."""
    return json.loads(_core.guide_aliases())


def guide_names() -> list[str]:
    """All names that `guide=` understands; those of the registry may be joined by `+`."""
    return ["none", "auto", *registry(), *aliases()]


def usual_guide(preset: str | None) -> str:
    """The guide where none is given."""
    return PRESETS[preset].guide if preset is not None and preset in PRESETS else DEFAULT_GUIDE


def choose(guide: Any, options: Mapping[str, Any]) -> Choice:
    """Understands an argument `guide`: a name, a path, a `Guide`, or another's object.

    Args:
        guide: see `pssflow.render`.
        options: the guide's own, plain or with the guide's name and a dot before them (`realnvp.epochs`).

    Raises:
        ValueError: an unknown name, or options where there are none to take.
        TypeError: an object that is no guide.
    """
    if isinstance(guide, Guide):
        _no_options(options, "a guide that is fitted already")
        return Choice(guide.name, "ready", learns=False, options={}, given=guide)
    if isinstance(guide, os.PathLike) or (isinstance(guide, str) and is_path(guide)):
        _no_options(options, "a guide that is fitted already")
        path = Path(guide)
        if not path.is_file():
            raise FileNotFoundError(
                f"{path}: there is no such file (as a name, `guide` is one of {_known()})"
            )
        return Choice(str(guide), "ready", learns=False, options={}, path=path)
    if isinstance(guide, str):
        return _named(guide, options)
    missing = [
        name for name in ("fit", "sample", "log_prob") if not callable(getattr(guide, name, None))
    ]
    if missing:
        raise TypeError(
            f"`guide` is a {type(guide).__name__} without `{'`, `'.join(missing)}`; expected a name ({_known()}), "
            "a file, or an object with fit, sample and log_prob"
        )
    _no_options(options, "an object of your own; set them there")
    return Choice(type(guide).__name__, "foreign", learns=True, options={}, given=guide)


def is_path(guide: str) -> bool:
    """Whether a text is a saved guide's path rather than a name; a file that is called as a guide needs its `./`."""
    if set(guide.split("+")) <= {*guide_names()}:
        return False
    return os.sep in guide or guide.endswith(".safetensors") or Path(guide).is_file()


def options_json(options: Mapping[str, Any]) -> str:
    """A guide's options as JSON.

    Raises:
        ValueError: a value has no JSON form.
    """
    for name, value in options.items():
        try:
            json.dumps(value, allow_nan=False)
        except (TypeError, ValueError):
            raise ValueError(
                f"`{name}` = {value!r} is no option's value: no number, text, list or bool"
            ) from None
    return json.dumps(dict(options))


def _named(guide: str, options: Mapping[str, Any]) -> Choice:
    if guide == "none":
        _no_options(options, "`none`")
        return Choice(guide, guide, learns=False, options={})
    if guide == "auto":
        _no_options(options, "`auto`")
        return Choice(guide, guide, learns=True, options={})
    known = registry()
    parts = aliases().get(guide, guide).split("+")
    for part in parts:
        if part not in known:
            raise ValueError(
                f"`guide` = {guide!r} is unknown (known: {_known()}; or the path of a saved guide)"
            )
    options_json(options)
    return Choice(guide, guide, learns=True, options=_by_part(guide, options))


def _by_part(guide: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a guide as the core takes them: those of a composite by the names of its parts."""
    known = registry()
    parts = aliases().get(guide, guide).split("+")
    if any(part not in known for part in parts):
        return dict(options)  # the core refuses the name, and lists what there is
    by_part: dict[str, dict[str, Any]] = {part: {} for part in parts}
    for key, value in options.items():
        if key in by_part and isinstance(value, Mapping):
            by_part[key] |= value  # as a record has them
            continue
        owner, dot, option = key.rpartition(".")
        if dot and owner not in by_part:
            raise ValueError(f"`{key}` is an option of `{owner}`, but `guide` is {guide!r}")
        owners = [owner] if dot else [part for part in parts if option in known[part]["options"]]
        if not owners and len(parts) == 1:
            owners = parts  # the core refuses it, and lists what there is
        if not owners:
            raise ValueError(f"`{option}` is no option of {' or '.join(parts)}")
        for part in owners:
            by_part[part][option] = value
    return by_part[parts[0]] if len(parts) == 1 else by_part


def _known() -> str:
    return ", ".join(guide_names())


def _no_options(options: Mapping[str, Any], what: str) -> None:
    if options:
        raise ValueError(
            f"`{next(iter(options))}` was given, but `guide` is {what} and takes no options"
        )
