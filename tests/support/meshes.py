"""Meshes for tests."""

from __future__ import annotations

from pathlib import Path


def write_octahedron(path: Path, *, uv: bool = False) -> Path:
    """A PLY file of eight faces around the origin, normals outward; returns its path.

    Without texture coordinates, or with `uv` all of them zero, which gives no tangents.
    """
    points = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
    faces = [
        (x, y, z) if (x + y + z) % 2 else (y, x, z) for x in (0, 1) for y in (2, 3) for z in (4, 5)
    ]
    header = [
        *("ply", "format ascii 1.0", f"element vertex {len(points)}"),
        *(f"property float {name}" for name in ("xyzst" if uv else "xyz")),
        *(f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"),
    ]
    rows = [" ".join(map(str, (*point, 0, 0) if uv else point)) for point in points]
    rows += ["3 " + " ".join(map(str, face)) for face in faces]
    path.write_text("\n".join([*header, *rows]) + "\n", encoding="ascii")
    return path
