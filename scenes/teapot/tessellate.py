"""Tessellates the Utah teapot from Newell's control points into `meshes/teapot.ply`.

    python scenes/teapot/tessellate.py                  # 20 × 20 quads a patch: 25,440 triangles
    python scenes/teapot/tessellate.py -n 40 -o fine.ply

Newell's 32 bicubic Bézier patches (M. Newell, PhD thesis, University of Utah, 1975; the bottom by F. Crow)
are highly symmetric, so the data are kept here as what they are made of rather than as a table of 306 points:

- rim, body, bottom and lid are surfaces of revolution: a profile of cubic segments (r, z), swept through four quarter
  circles, each the cubic (1, 0), (1, κ), (κ, 1), (0, 1) with Newell's κ = 0.56 (the knob's widest ring: 0.5625);
- handle and spout are sections symmetric in y: an inner point, an outer point and a half width, seven in a row.

Positions and derivatives are evaluated in float64 with additions, multiplications and square roots alone, each of which
IEEE 754 rounds in one way, and rounded to float32 at the end: the same bytes on every machine. Neighbouring patches
share their vertices (grids are built per part, not per patch), so there are no cracks. Normals are the analytic
∂u × ∂v, at the two poles its limit, and point outwards.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

KAPPA = 0.56
"""Newell's quarter circle; the best cubic would have 0.5523."""

KNOB_KAPPA = 0.45 / 0.8
"""The ring of the knob at r = 0.8 departs from KAPPA in the published data."""

SHELL = [
    # rim, from the inner edge on which the lid nearly rests
    (1.4, 2.4), (1.3375, 2.53125), (1.4375, 2.53125), (1.5, 2.4),
    # body
    (1.75, 1.875), (2.0, 1.35), (2.0, 0.9),
    (2.0, 0.45), (1.5, 0.225), (1.5, 0.15),
    # bottom, ends in a pole
    (1.5, 0.075), (1.425, 0.0), (0.0, 0.0),
]  # fmt: skip
"""Profile (r, z) of rim, body and bottom, top to bottom: four cubic segments that share their end points."""

LID = [(0.0, 3.15), (0.8, 3.15), (0.0, 2.85), (0.2, 2.7), (0.4, 2.55), (1.3, 2.55), (1.3, 2.4)]
"""Profile (r, z) of knob and lid: two cubic segments, begins in a pole."""

HANDLE = [
    ((-1.6, 2.025), (-1.5, 2.25), 0.3),
    ((-2.3, 2.025), (-2.5, 2.25), 0.3),
    ((-2.7, 2.025), (-3.0, 2.25), 0.3),
    ((-2.7, 1.8), (-3.0, 1.8), 0.3),
    ((-2.7, 1.575), (-3.0, 1.35), 0.3),
    ((-2.5, 1.125), (-2.65, 0.9375), 0.3),
    ((-2.0, 0.9), (-1.9, 0.6), 0.3),
]
"""Sections of the handle, top to bottom: inner (x, z), outer (x, z), half width in y."""

SPOUT = [
    ((1.7, 1.425), (1.7, 0.6), 0.66),
    ((2.6, 1.425), (3.1, 0.825), 0.66),
    ((2.3, 2.1), (2.4, 2.025), 0.25),
    ((2.7, 2.4), (3.3, 2.4), 0.25),
    ((2.8, 2.475), (3.525, 2.49375), 0.25),
    ((2.9, 2.475), (3.45, 2.5125), 0.15),
    ((2.8, 2.4), (3.2, 2.4), 0.15),
]
"""Sections of the spout, from the body to the tip and a little way back inside: as HANDLE."""


class Mesh(NamedTuple):
    """An indexed triangle mesh with one normal a vertex.

    | field       | shape, type      | meaning                                   |
    |-------------|------------------|-------------------------------------------|
    | `positions` | (P, 3) float32   | scene units, +z up, spout towards +x      |
    | `normals`   | (P, 3) float32   | unit length, outwards                     |
    | `faces`     | (T, 3) uint32    | counter-clockwise seen from outside       |
    """

    positions: NDArray[np.float32]
    normals: NDArray[np.float32]
    faces: NDArray[np.uint32]


class Grid(NamedTuple):
    """A part of the teapot: rows along the profile, columns once around it (the last joins the first).

    `positions` and `normals` are (rows, columns, 3). `open_start`, `open_end`: whether the first and the last row are
    a border of the surface; otherwise the row is a pole, its columns all one point.
    """

    positions: F64
    normals: F64
    open_start: bool
    open_end: bool


def control_patches() -> F64:
    """The 32 patches of 4 × 4 control points, (32, 4, 4, 3): what this file's symmetric description stands for."""
    patches = [patch for net in (_revolved(SHELL), _revolved(LID)) for patch in _turned(net)]
    for sections in (HANDLE, SPOUT):
        patches.extend(_two_sided(_swept(sections)))
    return np.concatenate(patches)


def tessellate(n: int = 20) -> Mesh:
    """Evaluates every patch on an n × n grid of quads, two triangles each (one next to a pole).

    Raises ValueError if n < 2: one segment would leave nothing of the knob.
    """
    if n < 2:
        raise ValueError(f"n = {n} segments a patch: the teapot needs at least 2")
    grids = [
        _part(_turned(_revolved(SHELL)), n, open_start=True, open_end=False),
        _part(_turned(_revolved(LID)), n, open_start=False, open_end=True),
        _part(_two_sided(_swept(HANDLE)), n, open_start=True, open_end=True),
        _part(_two_sided(_swept(SPOUT)), n, open_start=True, open_end=True),
    ]
    positions, normals, faces = [], [], []
    first = 0
    for grid in grids:
        p, m, f = _stitch(grid)
        positions.append(p)
        normals.append(m)
        faces.append(f + first)
        first += len(p)
    return Mesh(
        np.concatenate(positions).astype(np.float32),
        np.concatenate(normals).astype(np.float32),
        np.concatenate(faces).astype(np.uint32),
    )


def ply_bytes(mesh: Mesh) -> bytes:
    """The mesh as a binary little-endian PLY: x y z nx ny nz a vertex, one list of three indices a face."""
    header = (
        "ply\n"
        "format binary_little_endian 1.0\n"
        "comment Utah teapot, Newell's control points, written by tessellate.py\n"
        f"element vertex {len(mesh.positions)}\n"
        + "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
        + f"element face {len(mesh.faces)}\n"
        "property list uchar int vertex_indices\n"
        "end_header\n"
    )
    vertices = np.concatenate([mesh.positions, mesh.normals], axis=1).astype("<f4")
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    faces["count"] = 3
    faces["index"] = mesh.faces
    return header.encode("ascii") + vertices.tobytes() + faces.tobytes()


def _revolved(profile: list[tuple[float, float]]) -> F64:
    """Control nets (segments, 4, 4, 3) of a profile swept through the quarter x, y ≥ 0."""
    net = np.empty((len(profile), 4, 3))
    for row, (r, z) in zip(net, profile, strict=True):
        side = r * (KNOB_KAPPA if (r, z) == (0.8, 3.15) else KAPPA)
        row[:] = [(r, 0.0, z), (r, side, z), (side, r, z), (0.0, r, z)]
    return _segments(net)


def _swept(sections: list[tuple[tuple[float, float], tuple[float, float], float]]) -> F64:
    """Control nets (segments, 4, 4, 3) of the half y ≤ 0 of a symmetric tube, from its inner to its outer side."""
    net = np.empty((len(sections), 4, 3))
    for row, ((x0, z0), (x1, z1), w) in zip(net, sections, strict=True):
        row[:] = [(x0, 0.0, z0), (x0, -w, z0), (x1, -w, z1), (x1, 0.0, z1)]
    return _segments(net)


def _segments(net: F64) -> F64:
    """Cuts rows 0–3, 3–6, … of a control net into the cubic segments that share their end rows."""
    return np.stack([net[i : i + 4] for i in range(0, len(net) - 1, 3)])


def _turned(net: F64) -> list[F64]:
    """The four quarters of a revolved net, by exact quarter turns (x, y) → (−y, x)."""
    quarters = [net]
    for _ in range(3):
        x, y, z = np.moveaxis(quarters[-1], -1, 0)
        quarters.append(np.stack([-y, x, z], axis=-1))
    return quarters


def _two_sided(net: F64) -> list[F64]:
    """Both halves of a tube: the one given, and its mirror image in y run from the outer side back to the inner."""
    return [net, net[:, :, ::-1] * [1.0, -1.0, 1.0]]


def _part(around: list[F64], n: int, *, open_start: bool, open_end: bool) -> Grid:
    """Evaluates a closed ring of nets (each (segments, 4, 4, 3)) on n × n quads a patch.

    Row s·n + i is u = i/n of segment s, column q·n + j is v = j/n of net q. Rows and columns that two patches share are
    evaluated once, on the patch that begins there.
    """
    segments = len(around[0])
    rows, columns = segments * n + 1, len(around) * n
    positions, normals = np.empty((rows, columns, 3)), np.empty((rows, columns, 3))
    t = np.arange(n + 1) / n
    for q, nets in enumerate(around):
        for s, net in enumerate(nets):
            last = s == segments - 1
            u, v = t if last else t[:-1], t[:-1]
            p, du, dv, duv = _evaluate(net, u, v)
            if s == 0 and not open_start:
                dv[0] = duv[0]  # at a pole ∂v vanishes: its limit direction is ∂u∂v …
            if last and not open_end:
                dv[-1] = -duv[-1]  # … reached from the other side at the profile's end
            block = np.s_[s * n : s * n + len(u), q * n : (q + 1) * n]
            positions[block] = p
            normals[block] = _unit(_cross(du, dv))
    return Grid(positions, normals, open_start, open_end)


def _evaluate(net: F64, u: F64, v: F64) -> tuple[F64, F64, F64, F64]:
    """Point, ∂u, ∂v and ∂u∂v of one bicubic patch at every (u, v): four arrays (len(u), len(v), 3)."""
    (bu, cu), (bv, cv) = _bernstein(u), _bernstein(v)
    return _tensor(net, bu, bv), _tensor(net, cu, bv), _tensor(net, bu, cv), _tensor(net, cu, cv)


def _bernstein(t: F64) -> tuple[F64, F64]:
    """The four cubic Bernstein polynomials and their derivatives at t: two arrays (4, len(t))."""
    s = 1.0 - t
    values = np.stack([s * s * s, 3.0 * s * s * t, 3.0 * s * t * t, t * t * t])
    slopes = np.stack(
        [-3.0 * s * s, 3.0 * s * s - 6.0 * s * t, 6.0 * s * t - 3.0 * t * t, 3.0 * t * t]
    )
    return values, slopes


def _tensor(net: F64, a: F64, b: F64) -> F64:
    """Σᵢⱼ aᵢ(u) bⱼ(v) netᵢⱼ. Explicit sums: a matrix product's order and fusing depend on the library."""
    total = np.zeros((a.shape[1], b.shape[1], 3))
    for i in range(4):
        for j in range(4):
            total = total + (a[i][:, None] * b[j][None, :])[..., None] * net[i, j]
    return total


def _cross(a: F64, b: F64) -> F64:
    (ax, ay, az), (bx, by, bz) = np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def _unit(a: F64) -> F64:
    x, y, z = np.moveaxis(a, -1, 0)
    return a / np.sqrt(x * x + y * y + z * z)[..., None]


def _stitch(grid: Grid) -> tuple[F64, F64, NDArray[np.int64]]:
    """A part's vertices, normals and triangles; a pole's row becomes one vertex, its quads triangles."""
    rows, columns = grid.positions.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    if not grid.open_start:
        index[0] = index[0, 0]
    if not grid.open_end:
        index[-1] = index[-1, 0]
    right = np.roll(index, -1, axis=1)
    a, b, c, d = index[:-1], index[1:], right[1:], right[:-1]
    quads = np.stack([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)], axis=2)
    faces = quads.reshape(-1, 3)
    collapsed = (
        (faces[:, 0] == faces[:, 1]) | (faces[:, 1] == faces[:, 2]) | (faces[:, 2] == faces[:, 0])
    )
    used, faces = np.unique(faces[~collapsed], return_inverse=True)
    return (
        grid.positions.reshape(-1, 3)[used],
        grid.normals.reshape(-1, 3)[used],
        faces.reshape(-1, 3),
    )


def main() -> None:
    """Writes the PLY and says what it contains."""
    here = Path(__file__).resolve().parent
    parser = argparse.ArgumentParser(description="Tessellate the Utah teapot.")
    parser.add_argument("-n", type=int, default=20, help="segments a patch edge (default: 20)")
    parser.add_argument("-o", "--output", type=Path, default=here / "meshes" / "teapot.ply")
    options = parser.parse_args()
    mesh = tessellate(options.n)
    options.output.write_bytes(ply_bytes(mesh))
    print(f"{options.output}: {len(mesh.positions)} vertices, {len(mesh.faces)} triangles")


if __name__ == "__main__":
    main()
