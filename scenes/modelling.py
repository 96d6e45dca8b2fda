"""What the scripts beside the scenes model with: lathes, boxes, quads, and the bytes of PLY, PNG and PFM files.

    python scenes/modelling.py                  # writes the files of every scene that has a model.py
    python scenes/modelling.py courtyard leaves

A scene's `model.py` has one function, `files()`, from a path inside the scene's folder to the bytes that belong there.
Everything is computed with additions, multiplications, divisions and square roots, each of which IEEE 754 rounds in one
way, and images are stored without compression: the same bytes on every machine. +y is up, lengths are metres.
"""

from __future__ import annotations

import argparse
import importlib.util
import struct
import sys
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

F64 = NDArray[np.float64]
Point = tuple[float, float, float]
Run = list[tuple[float, float]]


class Mesh(NamedTuple):
    """An indexed triangle mesh; counter-clockwise seen from outside.

    | field       | shape, type    | meaning             |
    |-------------|----------------|---------------------|
    | `positions` | (P, 3) float64 | metres, +y up       |
    | `normals`   | (P, 3) float64 | unit length         |
    | `uv`        | (P, 2) float64 | texture coordinates |
    | `faces`     | (T, 3) int64   | indices             |
    """

    positions: F64
    normals: F64
    uv: F64
    faces: NDArray[np.int64]

    def moved(
        self, to: ArrayLike = (0, 0, 0), *, size: float = 1.0, ahead: Point = (0, 0, 1)
    ) -> Mesh:
        """Scaled by `size`, turned about +y until +z looks along `ahead`, then moved by `to`."""
        x, _, z = unit(np.array([ahead[0], 0.0, ahead[2]]))

        def turn(v: F64) -> F64:
            return np.stack(
                [z * v[:, 0] + x * v[:, 2], v[:, 1], z * v[:, 2] - x * v[:, 0]], axis=-1
            )

        return self._replace(
            positions=turn(self.positions * size) + np.asarray(to, float),
            normals=turn(self.normals),
        )


def unit(v: F64) -> F64:
    """Vectors (…, 3) at length one."""
    x, y, z = np.moveaxis(v, -1, 0)
    return v / np.sqrt(x * x + y * y + z * z)[..., None]


def cross(a: F64, b: F64) -> F64:
    """The cross product of (…, 3), spelt out: the order of its sums is then ours."""
    (ax, ay, az), (bx, by, bz) = np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def fraction(i: int, step: float = 0.6180339887498949) -> float:
    """Number i of a sequence that fills [0, 1) evenly, in place of random numbers; the default step is 1/φ."""
    value = (i + 0.5) * step
    return value - int(value)


def circle(n: int) -> F64:
    """Points (cos, sin) of the unit circle, `n` rows of two, by halving quarters; n = 4, 8, 16, …."""
    if n < 4 or n & (n - 1):
        raise ValueError(f"n = {n} points of a circle: halving quarters gives 4, 8, 16, …")
    points = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    while len(points) < n:
        x, y = (points + np.roll(points, -1, axis=0)).T
        middle = np.stack([x, y], axis=-1) / np.sqrt(x * x + y * y)[:, None]
        points = np.stack([points, middle], axis=1).reshape(-1, 2)
    return points


def join(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh of many."""
    starts = np.cumsum([0] + [len(mesh.positions) for mesh in meshes[:-1]])
    return Mesh(
        np.concatenate([mesh.positions for mesh in meshes]),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([mesh.uv for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
    )


def quad(a: ArrayLike, b: ArrayLike, c: ArrayLike, d: ArrayLike) -> Mesh:
    """A flat quadrilateral, counter-clockwise; uv is (0, 0) at a, (1, 0) at b, (1, 1) at c."""
    corners = np.array([a, b, c, d], float)
    normal = unit(cross(corners[1] - corners[0], corners[3] - corners[0]))
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    return Mesh(corners, np.tile(normal, (4, 1)), uv, np.array([[0, 1, 2], [0, 2, 3]]))


def box(size: Point, to: ArrayLike = (0, 0, 0), *, ahead: Point = (0, 0, 1)) -> Mesh:
    """A box of `size` that stands on y = 0 around the origin, then turned and moved as `Mesh.moved` does."""
    w, h, d = size[0] / 2, size[1], size[2] / 2
    p = [np.array([x * w, y * h, z * d]) for x in (-1, 1) for y in (0, 1) for z in (-1, 1)]
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return join([quad(*(p[i] for i in side)) for side in sides]).moved(to, ahead=ahead)


def beam(a: Point, b: Point, size: tuple[float, float]) -> Mesh:
    """A straight square beam from a to b, wide and high as `size`; not vertical."""
    start, end = np.array(a), np.array(b)
    along = unit(end - start)
    side = unit(cross(along, np.array([0.0, 1.0, 0.0]))) * (size[0] / 2)
    up = unit(cross(side, along)) * (size[1] / 2)
    ring = [-side - up, side - up, side + up, -side + up]
    sides = [
        quad(start + ring[i], start + ring[i - 3], end + ring[i - 3], end + ring[i])
        for i in range(4)
    ]
    caps = [quad(*(end + r for r in ring)), quad(*(start + r for r in ring[::-1]))]
    return join(sides + caps)


def curve(points: Run, steps: int) -> Run:
    """A Catmull-Rom spline through the points, `steps` segments from each to the next."""
    p = np.array([points[0], *points, points[-1]])
    found = [points[0]]
    for i in range(len(points) - 1):
        a, b, c, d = p[i : i + 4]
        for step in range(1, steps + 1):
            t = step / steps
            x = 0.5 * (
                2 * b
                + t * ((c - a) + t * ((2 * a - 5 * b + 4 * c - d) + t * (3 * (b - c) + d - a)))
            )
            found.append((float(x[0]), float(x[1])))
    return found


def lathe(runs: Sequence[Run], n: int = 32) -> Mesh:
    """Profiles (r, y) turned about +y: smooth along each run, a crease between runs.

    Outside is to the right of a profile that goes up. u runs around, v along the run.
    """
    ring = np.concatenate([circle(n), [[1.0, 0.0]]])
    parts = []
    for run in runs:
        profile = np.array(run)
        tangent = np.gradient(profile, axis=0)
        slope = np.stack([tangent[:, 1], -tangent[:, 0]], axis=-1)
        slope = slope / np.sqrt(slope[:, 0] * slope[:, 0] + slope[:, 1] * slope[:, 1])[:, None]

        def turned(rows: F64) -> F64:
            r, y = rows[:, :1], rows[:, 1:]
            return np.stack([r * ring[:, 0], y + 0 * r * ring[:, 0], -r * ring[:, 1]], axis=-1)

        u, v = np.meshgrid(np.arange(n + 1) / n, np.arange(len(run)) / (len(run) - 1))
        index = np.arange(u.size).reshape(u.shape)
        a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
        quads = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2)
        faces = quads.reshape(-1, 3)
        positions = turned(profile).reshape(-1, 3)
        p = positions[faces]
        area = cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
        faces = faces[(area * area).sum(axis=-1) > 1e-20]  # at the axis a quad is one triangle
        parts.append(
            Mesh(
                positions, turned(slope).reshape(-1, 3), np.stack([u, v], -1).reshape(-1, 2), faces
            )
        )
    return join(parts)


def ply(mesh: Mesh) -> bytes:
    """A binary little-endian PLY with normals and uv."""
    rows = np.concatenate([mesh.positions, mesh.normals, mesh.uv], axis=1).astype("<f4")
    faces = np.empty(len(mesh.faces), dtype=[("n", "u1"), ("i", "<u4", 3)])
    faces["n"], faces["i"] = 3, mesh.faces
    names = ("x", "y", "z", "nx", "ny", "nz", "u", "v")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property float {name}" for name in names]
    header += [
        f"element face {len(faces)}",
        "property list uchar uint vertex_indices",
        "end_header",
    ]
    return (
        "".join(line + "\n" for line in header).encode("ascii") + rows.tobytes() + faces.tobytes()
    )


def png(pixels: NDArray[np.uint8]) -> bytes:
    """An 8-bit PNG, grey (H, W) or RGB (H, W, 3). Stored, not compressed: compressors differ by version."""
    height, width = pixels.shape[:2]
    rows = pixels.reshape(height, -1)
    raw = np.concatenate([np.zeros((height, 1), np.uint8), rows], axis=1).tobytes()
    blocks = [raw[i : i + 65535] for i in range(0, len(raw), 65535)]
    data = b"\x78\x01"
    for i, block in enumerate(blocks):
        data += struct.pack("<BHH", i == len(blocks) - 1, len(block), len(block) ^ 0xFFFF) + block
    data += struct.pack(">I", zlib.adler32(raw))
    kind = 2 if pixels.ndim == 3 else 0
    found = b"\x89PNG\r\n\x1a\n"
    for name, body in (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, kind, 0, 0, 0)),
        (b"IDAT", data),
        (b"IEND", b""),
    ):
        found += (
            struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        )
    return found


def pfm(pixels: F64) -> bytes:
    """A little-endian RGB float image (H, W, 3), the first row on top."""
    height, width, _ = pixels.shape
    return f"PF\n{width} {height}\n-1.0\n".encode("ascii") + pixels[::-1].astype("<f4").tobytes()


def outputs(folder: Path) -> dict[str, bytes]:
    """What `folder/model.py` makes: contents by path inside the folder."""
    sys.modules.setdefault("modelling", sys.modules[__name__])
    name = f"{folder.name}-model"
    spec = importlib.util.spec_from_file_location(name, folder / "model.py")
    assert spec is not None and spec.loader is not None, folder  # noqa: PT018
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.files()


def main() -> None:
    """Writes the files of the scenes that were named, or of all."""
    here = Path(__file__).resolve().parent
    known = sorted(path.parent.name for path in here.glob("*/model.py"))
    parser = argparse.ArgumentParser(description="Write the meshes and textures of scenes.")
    parser.add_argument(
        "scenes", nargs="*", metavar="SCENE", help=f"of {', '.join(known)}; all by default"
    )
    names = parser.parse_args().scenes or known
    for name in names:
        if name not in known:
            parser.error(f"no scene {name!r} with a model.py; there are {', '.join(known)}")
        for path, content in outputs(here / name).items():
            target = here / name / path
            target.parent.mkdir(exist_ok=True)
            target.write_bytes(content)
            print(f"{name}/{path}: {len(content)} bytes")


if __name__ == "__main__":
    main()
