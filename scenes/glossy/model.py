"""The meshes of `glossy`: a tray with a curved backdrop, a folding screen, and vessels from the lathe."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from modelling import Mesh, box, circle, curve, join, lathe, ply, quad, unit


def backdrop() -> Mesh:
    """A table that rises into a wall through a quarter circle."""
    arc = circle(64)[48:] * 0.8  # from straight down to level
    profile = [(2.2, 0.0), (-0.9, 0.0)]
    profile += [(-0.9 - float(x), 0.8 + float(y)) for x, y in arc[1:]]
    profile += [(-1.7, 0.8), (-1.7, 2.6)]
    strips = []
    for (z0, y0), (z1, y1) in pairwise(profile):
        strips.append(quad((-3, y0, z0), (3, y0, z0), (3, y1, z1), (-3, y1, z1)))
    mesh = join(strips)
    # Smooth over the bend: the normal points at the arc's axis.
    positions = mesh.positions
    bend = (positions[:, 2] < -0.9) & (positions[:, 1] < 0.8)
    towards = np.stack(
        [0 * positions[:, 0], 0.8 - positions[:, 1], -0.9 - positions[:, 2]], axis=-1
    )
    normals = mesh.normals.copy()
    normals[bend] = unit(towards[bend])
    return mesh._replace(normals=normals)


def tray() -> Mesh:
    """A round tray of brushed metal with a raised rim; its u runs around."""
    rim = curve([(1.16, 0.0), (1.2, 0.03), (1.19, 0.055), (1.16, 0.05), (1.12, 0.02)], 3)
    return lathe([rim, [(1.12, 0.02), (0.6, 0.015), (0.0, 0.015)]], 64).moved((0, 0, 0.15))


def screen() -> Mesh:
    """A folding screen of three silver leaves behind the vessels."""
    leaves = [
        (-0.62, -0.48, (0.34, 0.0, 1.0)),
        (0.0, -0.56, (-0.2, 0.0, 1.0)),
        (0.6, -0.5, (-0.55, 0.0, 1.0)),
    ]
    return join([box((0.6, 0.92, 0.015), (x, 0, z), ahead=ahead) for x, z, ahead in leaves])


def vase() -> Mesh:
    """A glazed vase with a narrow neck."""
    outside = [
        (0.12, 0.0),
        (0.2, 0.12),
        (0.25, 0.28),
        (0.19, 0.46),
        (0.075, 0.6),
        (0.065, 0.7),
        (0.12, 0.78),
    ]
    inside = [(0.11, 0.78), (0.055, 0.7), (0.06, 0.6), (0.0, 0.5)]
    return lathe([curve(outside, 6), [(0.12, 0.78), (0.11, 0.78)], curve(inside, 4)], 64).moved(
        (-0.5, 0.015, 0.05)
    )


def bowl() -> Mesh:
    """A copper bowl on a foot."""
    outside = [(0.13, 0.0), (0.1, 0.04), (0.2, 0.1), (0.31, 0.2), (0.36, 0.32)]
    inside = [(0.345, 0.32), (0.29, 0.2), (0.18, 0.11), (0.0, 0.07)]
    return lathe([curve(outside, 5), [(0.36, 0.32), (0.345, 0.32)], curve(inside, 6)], 64).moved(
        (0.3, 0.015, 0.0)
    )


def goblet() -> Mesh:
    """A golden goblet in front."""
    outside = [
        (0.12, 0.0),
        (0.1, 0.02),
        (0.025, 0.05),
        (0.02, 0.16),
        (0.05, 0.2),
        (0.11, 0.27),
        (0.115, 0.4),
    ]
    inside = [(0.107, 0.4), (0.1, 0.28), (0.04, 0.22), (0.0, 0.21)]
    return lathe([curve(outside, 5), [(0.115, 0.4), (0.107, 0.4)], curve(inside, 4)]).moved(
        (-0.42, 0.015, 0.72)
    )


def side() -> Mesh:
    """A copper panel at the left, askew."""
    return box((1.1, 1.3, 0.03), (-1.5, 0, 0.1), ahead=(1.0, 0.0, 0.35))


def files() -> dict[str, bytes]:
    """The meshes by path."""
    parts = (backdrop, tray, screen, vase, bowl, goblet, side)
    return {f"meshes/{part.__name__}.ply": ply(part()) for part in parts}
