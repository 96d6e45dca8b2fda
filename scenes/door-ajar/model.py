"""The meshes of `door-ajar`: two rooms, the wall between them, the door, and what stands in the dark room."""

from __future__ import annotations

from modelling import Mesh, beam, box, curve, join, lathe, ply, quad

LEFT, RIGHT, TALL = 0.5, 1.4, 2.05
"""The doorway, in x and y; the wall around it is at z = −2 … −2.12."""
OPEN = (0.6, 0.0, 0.8)
"""What the face of the open door looks along; the hinge is on the right."""


def shell() -> Mesh:
    """The walls of the dark room, inwards, with the wall around the doorway."""
    a, b, near, far, high = -2.4, 2.4, 2.6, -2.0, 2.7
    return join(
        [
            quad((a, 0, near), (a, 0, far), (a, high, far), (a, high, near)),
            quad((b, 0, far), (b, 0, near), (b, high, near), (b, high, far)),
            quad((b, 0, near), (a, 0, near), (a, high, near), (b, high, near)),
            box((LEFT + 2.4, high, 0.06), ((LEFT - 2.4) / 2, 0, -2.03)),
            box((2.4 - RIGHT, high, 0.06), ((RIGHT + 2.4) / 2, 0, -2.03)),
            box((RIGHT - LEFT, high - TALL, 0.06), ((LEFT + RIGHT) / 2, TALL, -2.03)),
        ]
    )


def bright_shell() -> Mesh:
    """The walls of the bright room, inwards, with its side of the wall around the doorway."""
    a, b, near, far, high = -2.0, 2.9, -2.06, -5.4, 2.7
    return join(
        [
            quad((a, 0, near), (a, 0, far), (a, high, far), (a, high, near)),
            quad((b, 0, far), (b, 0, near), (b, high, near), (b, high, far)),
            quad((a, 0, far), (b, 0, far), (b, high, far), (a, high, far)),
            box((LEFT - a, high, 0.06), ((LEFT + a) / 2, 0, -2.09)),
            box((b - RIGHT, high, 0.06), ((RIGHT + b) / 2, 0, -2.09)),
            box((RIGHT - LEFT, high - TALL, 0.06), ((LEFT + RIGHT) / 2, TALL, -2.09)),
        ]
    )


def ceilings() -> Mesh:
    """Both ceilings, facing down."""
    return quad((-2.5, 2.7, -5.5), (3.0, 2.7, -5.5), (3.0, 2.7, 2.7), (-2.5, 2.7, 2.7))


def frame() -> Mesh:
    """Posts and lintel around the doorway, and a skirting board on the left."""
    return join(
        [
            box((0.09, TALL + 0.09, 0.04), (LEFT - 0.045, 0, -1.98)),
            box((0.09, TALL + 0.09, 0.04), (RIGHT + 0.045, 0, -1.98)),
            box((RIGHT - LEFT, 0.09, 0.04), ((LEFT + RIGHT) / 2, TALL, -1.98)),
            box((LEFT - 0.09 + 2.4, 0.09, 0.02), ((LEFT - 0.09 - 2.4) / 2, 0, -1.99)),
            box((0.02, 0.09, 4.6), (-2.39, 0, 0.3)),
        ]
    )


def door() -> Mesh:
    """The leaf with four raised panels; built with its edge at the origin, then swung open about the post."""
    w = RIGHT - LEFT - 0.01
    parts = [box((w, TALL - 0.005, 0.04), (-w / 2, 0.005, 0.02))]
    for y, h in ((0.18, 0.7), (1.1, 0.8)):
        for x in (-0.27 * w, -0.73 * w):
            parts.append(box((0.36 * w, h, 0.02), (x, y, 0.04)))
    return join(parts).moved((RIGHT, 0, -2.0), ahead=OPEN)


def table() -> Mesh:
    """A low table, askew, and a picture frame that leans on the left wall."""
    ahead, x, z = (0.35, 0.0, 1.0), -1.05, -0.75
    legs = [box((0.06, 0.68, 0.06)).moved((dx, 0, dz)) for dx in (-0.6, 0.6) for dz in (-0.3, 0.3)]
    top = box((1.35, 0.05, 0.75)).moved((0, 0.68, 0))
    bars = [beam((-0.6, 0.2, dz), (0.6, 0.2, dz), (0.04, 0.05)) for dz in (-0.3, 0.3)]
    return join([join([top, *legs, *bars]).moved((x, 0, z), ahead=ahead)])


def books(which: int) -> Mesh:
    """A stack of books on the table, each turned a little; every second one belongs to each colour."""
    parts = []
    for i in range(5):
        ahead = (0.25 + 0.12 * (i * 7 % 5 - 2), 0.0, 1.0)
        size = (0.26 - 0.012 * i, 0.04, 0.19 - 0.008 * i)
        if i % 2 == which:
            parts.append(box(size, (-0.72, 0.73 + 0.04 * i, -0.75), ahead=ahead))
    return join(parts)


def jug() -> Mesh:
    """A jug of copper on the table."""
    outside = curve(
        [(0.09, 0.0), (0.15, 0.09), (0.14, 0.2), (0.075, 0.3), (0.07, 0.36), (0.1, 0.42)], 6
    )
    inside = curve([(0.095, 0.42), (0.064, 0.36), (0.07, 0.3), (0.12, 0.2), (0.0, 0.05)], 4)
    return lathe([outside, [(0.1, 0.42), (0.095, 0.42)], inside]).moved((-1.25, 0.73, -0.72))


def vase() -> Mesh:
    """A tall glazed vase on the floor."""
    outside = curve(
        [(0.11, 0.0), (0.2, 0.25), (0.18, 0.5), (0.09, 0.72), (0.08, 0.8), (0.13, 0.88)], 6
    )
    inside = curve([(0.12, 0.88), (0.07, 0.8), (0.08, 0.7), (0.0, 0.5)], 4)
    return lathe([outside, [(0.13, 0.88), (0.12, 0.88)], inside]).moved((0.08, 0, -1.5))


def files() -> dict[str, bytes]:
    """The meshes by path."""
    meshes = {
        "shell": shell(),
        "bright-shell": bright_shell(),
        "ceilings": ceilings(),
        "frame": frame(),
    }
    meshes |= {"door": door(), "table": table(), "jug": jug(), "vase": vase()}
    meshes |= {"red-books": books(0), "blue-books": books(1)}
    return {f"meshes/{name}.ply": ply(mesh) for name, mesh in meshes.items()}
