"""What `--approximate` puts in the place of things that are not supported.

Each replacement is a function from the object to an entry, or None where there is none; `INSTEAD` says in words what
it does, for messages. Numbers are Mitsuba's: a mean reflectance is that of samples that the BSDF itself draws.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from .walk import Entry, Walk

F64 = NDArray[np.float64]

PROBES = 4096
"""Points at which Mitsuba is asked; in scalar variants an eighth of them, one call each."""

GREY = [0.5, 0.5, 0.5]
"""Where Mitsuba cannot be asked for a mean."""

INSTEAD = {
    "BSDF": "is replaced by a diffuse one of its mean reflectance",
    "texture": "is replaced by its mean",
    "emitter": "is left out",
    "shape": "is left out",
    "medium": "is left out",
}
"""By kind. Sensors, films and variants have no replacement."""


def replacement(
    walk: Walk, kind: str, obj: Any, where: str, owner: int | None = None
) -> tuple[Entry, str] | None:
    """An entry in the place of `obj` without `id`, and a note of what it is; `owner`: the shape of an emitter."""
    if kind == "BSDF":
        return _bsdf(walk, obj, where)
    if kind == "texture":
        rgb = mean_of_texture(obj)
        return {"type": "constant", "value": rgb or GREY}, f"is replaced by its mean, {_words(rgb)}"
    if kind == "emitter" and owner is None:
        dark = {"position": [0.0] * 3, "intensity": [0.0] * 3, "sampling_weight": 0.0}
        return {"type": "point", **dark}, "is left out"
    if kind == "emitter":
        # Its shape names it, so that there must be one.
        radiance = walk.children(obj).get("radiance")
        rgb = [0.0] * 3 if radiance is None else mean_of_texture(radiance)
        light = {"radiance": _constant(walk, where, rgb or GREY), "sampling_weight": 1.0}
        return {"type": "area", "shape": owner, **light}, f"shines evenly, {_words(rgb)}"
    if kind == "shape":
        # A mesh without triangles, so that the others keep their numbers.
        empty: Entry = {
            "type": "mesh",
            "positions": walk.add_array(np.zeros((1, 3), np.float32)),
            "faces": walk.add_array(np.zeros((0, 3), np.uint32)),
            "normals": None,
            "texcoords": None,
            "flip_normals": False,
        }
        return empty, "is left out"
    return None


def _bsdf(walk: Walk, obj: Any, where: str) -> tuple[Entry, str]:
    """A map of normals or heights gives way to what it nests; everything else to a diffuse BSDF."""
    nested = walk.children(obj).get("nested_bsdf")
    if nested is not None:
        index = walk.bsdf(nested, f"{where}.nested_bsdf")
        entry = {k: v for k, v in walk.entries["BSDF"][index].items() if k != "id"}
        return entry, "gives way to the BSDF that it nests"
    rgb = mean_reflectance(obj)
    entry = {"type": "diffuse", "reflectance": _constant(walk, where, rgb or GREY)}
    return entry, f"is replaced by a diffuse one of its mean reflectance, {_words(rgb)}"


def _constant(walk: Walk, where: str, rgb: list[float]) -> int:
    walk.entries["texture"].append({"type": "constant", "id": f"{where}.mean", "value": rgb})
    return len(walk.entries["texture"]) - 1


def mean_reflectance(bsdf: Any) -> list[float] | None:
    """Share of light that comes back from a surface lit evenly from above, RGB; None where Mitsuba gives no value."""
    rng = np.random.default_rng(0)
    n = _count()
    uv, u = rng.random((n, 2)), rng.random((n, 3))
    radius, phi = np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    wi = np.stack([radius * np.cos(phi), radius * np.sin(phi), np.sqrt(1 - radius**2)], axis=1)
    context = mi.BSDFContext()
    try:
        if _scalar():
            drawn = [
                bsdf.sample(context, _surface(uv[i], wi[i]), float(u[i, 0]), mi.Point2f(*u[i, 1:]))
                for i in range(n)
            ]
            z = np.array([float(s.wo.z) for s, _ in drawn])
            weight = np.array([np.array(w, np.float64).ravel()[:3] for _, w in drawn])
        else:
            si = _surface(uv.T.astype(np.float32), wi.T.astype(np.float32))
            wide = u.T.astype(np.float32)
            sample, value = bsdf.sample(context, si, mi.Float(wide[0]), mi.Point2f(wide[1:]))
            z = np.array(dr.detach(sample.wo.z), np.float64)
            weight = np.array(dr.detach(value), np.float64).T
        mean = np.nan_to_num(np.where((z > 0)[:, None], weight, 0.0)).mean(axis=0)
    except RuntimeError:
        return None
    return np.clip(np.broadcast_to(mean, 3), 0.0, 1.0).tolist()


def mean_of_texture(texture: Any) -> list[float] | None:
    """Its mean over uv in [0, 1)², in RGB; None where Mitsuba gives no value."""
    uv = np.random.default_rng(0).random((_count(), 2))
    up = np.tile([0.0, 0.0, 1.0], (len(uv), 1))
    try:
        if _scalar():
            points = (_surface(uv[i], up[i]) for i in range(len(uv)))
            values = np.array([np.array(texture.eval(si), np.float64).ravel()[:3] for si in points])
        else:
            si = _surface(uv.T.astype(np.float32), up.T.astype(np.float32))
            values = np.array(dr.detach(texture.eval(si)), np.float64).T
        mean = values.reshape(len(values), -1).mean(axis=0)
    except RuntimeError:
        return None
    if not np.isfinite(mean).all():
        return None
    return np.broadcast_to(mean, 3).tolist()


def _surface(uv: Any, wi: Any) -> Any:
    """Points of the xy plane, one or many."""
    si: Any = (
        mi.SurfaceInteraction3f() if _scalar() else dr.zeros(mi.SurfaceInteraction3f, uv.shape[1])
    )
    si.uv, si.wi = mi.Point2f(uv), mi.Vector3f(wi)
    x, y, z = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1)
    si.n, si.dp_du, si.dp_dv, si.t = mi.Normal3f(z), x, y, 1.0
    si.sh_frame = mi.Frame3f(x, y, z)
    return si


def _scalar() -> bool:
    return (mi.variant() or "").startswith("scalar")


def _count() -> int:
    return PROBES // 8 if _scalar() else PROBES


def _words(rgb: list[float] | None) -> str:
    if rgb is None:
        return "taken for .5 because Mitsuba gives no value"
    return "(" + ", ".join(f"{x:.3f}" for x in rgb) + ")"
