"""Guides that learn from the gradient's magnitude instead of radiance: `target` = `gradient`, for inverse rendering.

Of a gradient, light that no parameter touches is only noise, and a parameter may matter where there is little light.
So a share of the samples is a pilot: its paths, drawn by the render's own guide, are built anew in Dr.Jit, and of both
terms of each the derivative is taken in forward mode along a random direction v of parameter space, v_i = ±1:

    w = |Σ_c δ_c · ∂f_c/∂π · v|,   E_v[w²] = Σ_i (Σ_c δ_c · ∂f_c/∂π_i)²

(Hutchinson 1990), with δ the derivative of the loss by the path's pixel. In forward mode v is the direction that was
asked for, and w the luminance of |∂f|. The core then learns from w in place of f, and lowers its second moment: that of
the gradient, all parameters alike in their own units. The pilot does not enter the gradient, and every guide is divided
by the mixture that it is drawn from, so that nothing is biased, whatever w is. Where nothing pays it is the render's
guide or uniform numbers, whichever the pilot says is better.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from . import _core
from .guide import Choice, Guide, options_json
from .rebuild import Source, draw, terms
from .rows import LUMINANCE, records

if TYPE_CHECKING:
    from .scene import Scene

__all__ = ["TARGETS", "Target", "check_target", "learned"]

F32 = NDArray[np.float32]

TARGETS = ("radiance", "gradient")
"""What guides learn from."""

PILOT_DIVISOR = 8
"""One sample in so many is the pilot's."""


def check_target(target: Any, choice: Choice) -> str:
    """A target as it is, if a guide can learn from it.

    Raises:
        ValueError: one line.
    """
    if target not in TARGETS:
        raise ValueError(f"`target` = {target!r} is unknown (known: {', '.join(TARGETS)})")
    if target == "gradient" and not choice.learns:
        raise ValueError(
            f"`target` = 'gradient' needs a guide that learns, but `guide` is {choice.label!r}; give `auto`, or a name"
        )
    return str(target)


@dataclass(frozen=True)
class Target:
    """Asks for guides of the gradient."""

    choice: Choice
    """What learns."""
    params: Any
    """`mi.SceneParameters`, of which some have gradients enabled."""
    uniform_fraction: float | None = None
    """As in `render`."""

    def __post_init__(self) -> None:
        if self.params is None:
            raise ValueError(
                "`target` = 'gradient' needs the parameters: call mi.render(scene, params, …)"
            )

    def pilot(self, spp: int) -> int:
        """Samples per pixel of the pilot.

        Raises:
            ValueError: there are too few samples for one.
        """
        if spp < 2:
            raise ValueError(
                f"spp_grad = {spp} leaves no sample after the pilot of `target` = 'gradient'; give 2 or more"
            )
        return max(spp // PILOT_DIVISOR, 1)


def learned(
    target: Target,
    ours: Scene,
    sensor: Any,
    source: Source,
    passes: Sequence[range],
    emitters: Any,
    grad: NDArray[Any] | None,
    left: int,
    *,
    seed: int,
    parametrisation: str,
) -> Source:
    """What to draw paths of this length from: a guide of the gradient, or where none pays `source` or uniform numbers.

    Args:
        target: what is asked for.
        ours: the scene as the core has it.
        sensor: Mitsuba's sensor.
        source: what the pilot is drawn from.
        passes: the pilot's samples.
        emitters: as in `rebuild.terms`.
        grad: the loss's derivative by the image (H, W, C); None in forward mode.
        left: paths to be drawn after the pilot.
        seed: of the paths.
        parametrisation: of directions.
    """
    rng = np.random.Generator(np.random.Philox([seed, source.k]))
    parts: list[dict[str, Any]] = []
    for samples in passes:
        drawn = draw(
            ours, source, samples, seed=seed, parametrisation=parametrisation, numbers=True
        )
        of_loss = None if grad is None else np.repeat(_by_colour(grad), len(samples), axis=0)
        found = _derivatives(
            ours.mi_scene, sensor, drawn, source.k, emitters, target.params, grad is not None, rng
        )
        weights = [
            _magnitude(d, of_loss) * drawn[m]
            for d, m in zip(found, ("m_nee", "m_bsdf"), strict=True)
        ]
        parts.append({name: drawn[name] for name in LEARNED_FROM} | {"w": np.stack(weights, 1)})
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    numbers = 2 * source.k + 1
    rows = records(
        whole["u"][:, :numbers],
        whole["w"].sum(axis=1),
        f_bsdf=whole["w"][:, 1],
        ray=whole["u"][:, numbers:] if whole["u"].shape[1] > numbers else None,
        g=whole["m_nee"],
        g_bsdf=whole["m_bsdf"],
        g_both=whole["m_both"],
        contexts={name: whole[name] for name in CONTEXTS},
        emitters=np.array(ours.core.emitter_intervals(), np.float32).reshape(-1, 2),
    )
    fitted = _core.Guide.learn(
        target.choice.kind,
        rows,
        paths=float(left),
        found=float(whole["found"].mean()),
        options=options_json(target.choice.options),
        seed=seed,
    )
    if fitted is None:
        return source if _lowers(whole) else Source(source.k, None, 1.0, source.strategy)
    core, usual = fitted
    a = usual if target.uniform_fraction is None else target.uniform_fraction
    return Source(source.k, Guide(core), a, source.strategy)


CONTEXTS = ("position", "normal", "outgoing", "pixel", "emitter")
LEARNED_FROM = (*CONTEXTS, "u", "m_nee", "m_bsdf", "m_both", "found")


def _lowers(whole: dict[str, Any]) -> bool:
    """Whether the density that the pilot was drawn from has a smaller second moment than uniform numbers."""
    squares = [
        (whole["w"][:, i].astype(np.float64) ** 2 / whole[m], whole[m])
        for i, m in enumerate(("m_nee", "m_bsdf"))
    ]
    return sum((w / m).sum() for w, m in squares) <= sum(w.sum() for w, _ in squares)


def _derivatives(
    scene: Any,
    sensor: Any,
    drawn: dict[str, Any],
    k: int,
    emitters: Any,
    params: Any,
    at_random: bool,
    rng: np.random.Generator,
) -> list[F32]:
    """Of both terms f ÷ m of each path, (n, 3), along a random direction or along the parameters' own gradients."""
    with dr.resume_grad():
        parts, _ = terms(scene, sensor, drawn, k, emitters)
        known = [part for part in parts if dr.grad_enabled(part)]
        with _directions(params, rng if at_random else None):
            if known:
                # Gradients stay: the parameters' own, and those of what they are computed from.
                dr.forward_to(*known, flags=dr.ADFlag.ClearEdges)
            n = len(drawn["u"])
            return [
                np.broadcast_to(np.array(dr.grad(part), np.float32).reshape(3, -1).T, (n, 3))
                for part in parts
            ]


@contextmanager
def _directions(params: Any, rng: np.random.Generator | None) -> Iterator[None]:
    """Gives each variable of the parameters a gradient of ±1 for a while; without a generator they keep theirs.

    Components may share a variable, as in a grey made of one number: it has one gradient and one sign.
    """
    if rng is None:
        yield
        return
    enabled = [params[name] for name in params.keys() if dr.grad_enabled(params[name])]  # noqa: SIM118
    variables = {flat.index_ad: flat for value in enabled for flat in _flat(value)}
    before = [(flat, dr.grad(flat)) for flat in variables.values()]
    for flat, _ in before:
        numbers: Any = dr.detached_t(type(flat))
        signs = rng.choice(np.array([-1.0, 1.0], np.float32), dr.width(flat))
        dr.set_grad(flat, numbers(signs))
    try:
        yield
    finally:
        for flat, grad in before:
            dr.set_grad(flat, grad)


def _flat(value: Any) -> Iterator[Any]:
    """The components of a parameter that have gradients, each a plain array."""
    if dr.is_tensor_v(value):
        value = value.array
    if dr.depth_v(value) > 1:
        for component in value:
            yield from _flat(component)
    elif dr.grad_enabled(value):
        yield value


def _magnitude(derivative: F32, of_loss: F32 | None) -> F32:
    """What a path's term weighs, (n,); what is not finite is dropped."""
    if of_loss is None:
        weight = np.abs(derivative) @ LUMINANCE
    else:
        weight = np.abs((derivative * of_loss).sum(axis=1))
    return np.where(np.isfinite(weight), weight, np.float32(0.0)).astype(np.float32)


def _by_colour(grad: NDArray[Any]) -> F32:
    """A derivative by the image (H, W, C) as one by RGB radiance, a row for each pixel."""
    flat = grad.reshape(-1, grad.shape[-1]).astype(np.float32)
    # Films of luminance have one channel, or two with alpha.
    return flat[:, :3] if flat.shape[1] >= 3 else flat[:, :1] * LUMINANCE
