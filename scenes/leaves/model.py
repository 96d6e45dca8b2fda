"""The files of `leaves`: trunk and branches, quads for the leaves, the leaf's shape and colours, and the sky."""

from __future__ import annotations

import numpy as np
from modelling import F64, Mesh, box, circle, cross, fraction, join, pfm, ply, png, quad, unit
from numpy.typing import NDArray

TWIGS, PER_TWIG = 160, 9
SHAPE = (96, 64)
"""Rows and columns of the leaf's images."""

SUN = (0.55, 0.7, 0.25)
"""Towards the soft sun, in the environment's own axes."""

LIMBS: list[tuple[list[tuple[float, float, float]], float, float]] = [
    (
        [
            (0.0, -0.05, 0.0),
            (0.06, 0.5, 0.02),
            (-0.03, 1.0, 0.0),
            (0.05, 1.5, -0.04),
            (0.0, 2.1, 0.02),
        ],
        0.15,
        0.05,
    ),
    (
        [(-0.02, 0.95, 0.0), (-0.35, 1.35, 0.12), (-0.7, 1.65, 0.3), (-1.05, 1.85, 0.35)],
        0.075,
        0.02,
    ),
    ([(0.03, 1.2, -0.02), (0.4, 1.55, 0.15), (0.75, 1.75, 0.3), (1.1, 1.8, 0.5)], 0.07, 0.02),
    ([(0.05, 1.5, -0.04), (0.2, 1.85, -0.4), (0.45, 2.2, -0.7)], 0.06, 0.02),
    ([(0.04, 1.55, -0.03), (-0.25, 2.0, -0.3), (-0.6, 2.4, -0.5)], 0.06, 0.02),
    ([(0.0, 2.05, 0.02), (0.1, 2.4, 0.2), (0.3, 2.75, 0.3)], 0.05, 0.015),
    ([(0.0, 2.05, 0.02), (-0.15, 2.45, 0.15), (-0.35, 2.75, 0.35)], 0.05, 0.015),
]
"""Trunk and branches: points of the axis, radius at the root and at the tip."""


def limb(axis: list[tuple[float, float, float]], root: float, tip: float) -> Mesh:
    """A tapering tube along a bent axis."""
    p = np.array(axis)
    along = unit(np.gradient(p, axis=0))
    side = unit(cross(along, np.broadcast_to([0.0, 0.1, 1.0], along.shape)))
    front = cross(side, along)
    ring = circle(16)
    ring = np.concatenate([ring, ring[:1]])
    radius = (root + (tip - root) * np.arange(len(p)) / (len(p) - 1))[:, None, None]
    normals = side[:, None] * ring[:, :1] + front[:, None] * ring[:, 1:]
    positions = p[:, None] + radius * normals
    index = np.arange(len(p) * 17).reshape(len(p), 17)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.stack([np.stack([a, c, b], -1), np.stack([a, d, c], -1)], axis=2).reshape(-1, 3)
    u, v = np.meshgrid(np.arange(17) / 16, np.arange(len(p)) / (len(p) - 1))
    return Mesh(
        positions.reshape(-1, 3), normals.reshape(-1, 3), np.stack([u, v], -1).reshape(-1, 2), faces
    )


def _direction(i: int) -> F64:
    """Direction i of a sequence that covers the sphere, by throwing out what is not in the unit ball."""
    k = 37 * i
    while True:
        v = np.array(
            [
                2 * fraction(k, step) - 1
                for step in (0.8191725133961645, 0.671043606703789, 0.549700477901970)
            ]
        )
        k += 1
        if 0.01 < v[0] * v[0] + v[1] * v[1] + v[2] * v[2] < 1:
            return unit(v)


def leaf(root: F64, along: F64, up: F64, length: float) -> Mesh:
    """One quad from `root` along `along`, its upper side towards `up`."""
    side = unit(cross(along, up)) * (length / 3)
    tip = root + along * length
    return quad(root - side, root + side, tip + side, tip - side)


def crown() -> Mesh:
    """Leaves around twigs that leave the branches' outer parts."""
    leaves = []
    number = 0
    for twig in range(TWIGS):
        axis = np.array(LIMBS[1 + twig % (len(LIMBS) - 1)][0])
        where = (0.35 + 0.65 * fraction(twig)) * (len(axis) - 1)
        i = min(int(where), len(axis) - 2)
        root = axis[i] + (axis[i + 1] - axis[i]) * (where - i)
        out = unit(_direction(twig) + np.array([0.0, 0.35, 0.0]))
        reach = 0.25 + 0.35 * fraction(twig, 0.7548776662466927)
        for j in range(PER_TWIG):
            number += 1
            at = root + out * (reach * (j + 1) / PER_TWIG)
            along = unit(out * 0.6 + _direction(1000 + number) + np.array([0.0, -0.25, 0.0]))
            up = unit(np.array([0.0, 1.2, 0.0]) + _direction(5000 + number))
            leaves.append(leaf(at, along, up, 0.15 + 0.09 * fraction(number, 0.569840290998)))
    return join(leaves)


def fallen() -> Mesh:
    """Dry leaves on the ground, each a little tilted."""
    leaves = []
    for i in range(90):
        x, z = 3.6 * fraction(i, 0.7548776662466927) - 1.8, 3.4 * fraction(i, 0.569840290998) - 1.2
        d = _direction(9000 + i)
        along = unit(np.array([d[0], 0.15 + 0.1 * d[1], d[2]]))
        leaves.append(
            leaf(np.array([x, 0.012, z]), along, np.array([0.2 * d[2], 1.0, -0.2 * d[0]]), 0.16)
        )
    return join(leaves)


def wall() -> Mesh:
    """A garden wall behind the tree, askew, with a coping."""
    ahead = (0.18, 0.0, 1.0)
    return join(
        [
            box((9, 1.5, 0.25), (0.3, 0, -2.2), ahead=ahead),
            box((9.1, 0.09, 0.36), (0.3, 1.5, -2.2), ahead=ahead),
        ]
    )


def bench() -> Mesh:
    """A stone bench under the branches."""
    ahead = (-0.45, 0.0, 1.0)
    seat = box((1.3, 0.1, 0.42)).moved((0, 0.38, 0))
    feet = [box((0.16, 0.38, 0.34)).moved((x, 0, 0)) for x in (-0.45, 0.45)]
    return join([join([seat, *feet]).moved((1.05, 0, -0.35), ahead=ahead)])


def shape() -> F64:
    """Coverage of the leaf, (rows, columns) in [0, 1], its tip in the first row: a blade with a waved edge, a stalk."""
    rows, columns = SHAPE
    over = 4
    v = 1 - (np.arange(rows * over) + 0.5) / (rows * over)
    u = 2 * (np.arange(columns * over) + 0.5) / (columns * over) - 1
    t = np.clip((v - 0.12) / 0.88, 0, 1)
    blade = 2.6 * t * (1 - t) * (1.25 - 0.5 * t) * (t > 0)
    teeth = np.abs(12 * t - np.floor(12 * t) - 0.5) * 0.22  # saw teeth
    inside = (np.abs(u)[None] < (blade * (1 - teeth))[:, None]) & (t > 0)[:, None]
    stalk = (np.abs(u)[None] < 0.05) & (v < 0.2)[:, None]
    return (inside | stalk).reshape(rows, over, columns, over).mean(axis=(1, 3))


def colours() -> NDArray[np.uint8]:
    """The leaf's colours, sRGB bytes: green, lighter along the veins, yellow at the rim."""
    rows, columns = SHAPE
    v = (1 - (np.arange(rows) + 0.5) / rows)[:, None]
    u = np.abs(2 * (np.arange(columns) + 0.5) / columns - 1)[None]
    rib = np.clip(1 - u * 14, 0, 1)
    slant = 8 * (v - 0.35 * u)
    vein = np.clip(1 - 10 * np.abs(slant - np.floor(slant) - 0.5), 0, 1) * (u < 0.7)
    light = np.maximum(rib, 0.6 * vein)[..., None]
    rim = (u * u * (0.4 + 0 * v))[..., None]
    base = np.array([70.0, 122.0, 38.0]) * (1 - rim) + np.array([150.0, 140.0, 40.0]) * rim
    return np.floor(
        base * (1 - 0.5 * light) + np.array([175.0, 195.0, 110.0]) * 0.5 * light + 0.5
    ).astype(np.uint8)


def sky() -> F64:
    """An environment (32, 64, 3): thin clouds, a soft sun to the right and above, dim ground below the horizon."""
    up = circle(64)[:33]  # cos θ from the zenith down
    cosine = (up[:-1, 0] + up[1:, 0])[:, None] / 2
    sine = (up[:-1, 1] + up[1:, 1])[:, None] / 2
    around = circle(64)
    x, z = sine * around[:, 0], sine * around[:, 1]
    y = cosine + 0 * x
    sun = unit(np.array(SUN))
    away = (x - sun[0]) * (x - sun[0]) + (y - sun[1]) * (y - sun[1]) + (z - sun[2]) * (z - sun[2])
    glow = 1 / (1 + away / 0.02)
    glow = (glow * glow)[..., None]
    blue = (
        np.array([0.2, 0.33, 0.6])
        + (np.array([0.6, 0.64, 0.68]) - [0.2, 0.33, 0.6]) * (1 - np.abs(y))[..., None]
    )
    above = blue + glow * np.array([140.0, 118.0, 84.0])
    return np.where((y > 0)[..., None], above, np.array([0.09, 0.08, 0.06]))


def files() -> dict[str, bytes]:
    """Meshes and textures by path."""
    tree = join([limb(*part) for part in LIMBS])
    meshes = {"tree": tree, "crown": crown(), "fallen": fallen(), "wall": wall(), "bench": bench()}
    found = {f"meshes/{name}.ply": ply(mesh) for name, mesh in meshes.items()}
    found["textures/shape.png"] = png(np.floor(shape() * 255 + 0.5).astype(np.uint8))
    found["textures/leaf.png"] = png(colours())
    found["textures/sky.pfm"] = pfm(sky())
    return found
