"""The meshes of `courtyard`: one side of the arcade, the roofs, their beams, and what stands in the court."""

from __future__ import annotations

from itertools import pairwise

from modelling import Mesh, beam, box, circle, curve, join, lathe, ply, quad

BAYS, WIDTH = 5, 2.0
"""A side of the court is five bays of 2 m."""
SPRING, RADIUS, TOP, THICK = 2.1, 0.84, 3.7, 0.4
"""Height at which the arches begin, their radius, the top of the wall above them, its thickness."""
SIDES = [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (-1.0, 0.0, 0.0)]


def arcade() -> Mesh:
    """Arches along z = 5, from x = −5 to 5, on six columns."""
    half = BAYS * WIDTH / 2
    arc = circle(32)[:17][::-1] * RADIUS
    line = [(-half, SPRING)]
    for bay in range(BAYS):
        centre = -half + (bay + 0.5) * WIDTH
        line += [(centre + x, SPRING + y) for x, y in arc]
    line.append((half, SPRING))
    front, back = half - THICK / 2, half + THICK / 2
    parts = []
    for (x0, y0), (x1, y1) in pairwise(line):
        # Mitred at the corners of the court, where the next side begins.
        (a, b), (c, d) = (
            (x - m, x + m) for x in (x0, x1) for m in [THICK / 2 * (x / half) * (abs(x) == half)]
        )
        if x1 - x0 > 1e-9:
            parts += [
                quad((c, y1, front), (a, y0, front), (a, TOP, front), (c, TOP, front)),
                quad((b, y0, back), (d, y1, back), (d, TOP, back), (b, TOP, back)),
            ]
        parts.append(quad((a, y0, front), (c, y1, front), (d, y1, back), (b, y0, back)))
    shaft = [(0.16, 0.22), (0.165, 0.9), (0.155, 1.5), (0.135, 1.86)]
    column = join(
        [
            lathe(
                [
                    curve(
                        [(0.21, 0.1), (0.225, 0.13), (0.21, 0.16), (0.175, 0.18), (0.16, 0.22)], 2
                    ),
                    curve(shaft, 1),
                    curve([(0.135, 1.86), (0.165, 1.875), (0.165, 1.9), (0.14, 1.91)], 1),
                    curve([(0.14, 1.91), (0.16, 1.97), (0.23, 2.02)], 3),
                ],
                16,
            ),
            box((0.48, 0.1, 0.48)),
            box((0.5, 0.08, 0.44), (0, SPRING - 0.08, 0)),
        ]
    )
    # The last column is the first one of the next side.
    return join(parts + [column.moved((-half + i * WIDTH, 0, half)) for i in range(BAYS)])


def roof() -> Mesh:
    """A tilted roof over each gallery, mitred at the corners, with a face below it."""
    inner, outer, low, high = 4.45, 8.3, 3.62, 4.75
    parts = []
    for y in (0.0, 0.14):
        a, b = (-inner, low + y, inner), (inner, low + y, inner)
        c, d = (outer, high + y, outer), (-outer, high + y, outer)
        parts.append(quad(b, a, d, c) if y == 0 else quad(a, b, c, d))
    eave = quad(
        (-inner, low, inner),
        (inner, low, inner),
        (inner, low + 0.14, inner),
        (-inner, low + 0.14, inner),
    )
    side = join([*parts, eave])
    return join([side.moved(ahead=ahead) for ahead in SIDES])


def beams() -> Mesh:
    """Rafters under the roofs."""
    rafters = []
    for i in range(-9, 10):
        x = 0.86 * i
        start = max(4.5, abs(x))
        if start < 7.9:
            rise = (4.75 - 3.62) / (8.3 - 4.45)
            y = 3.5 + (start - 4.45) * rise
            rafters.append(beam((x, y, start), (x, 3.5 + (8.0 - 4.45) * rise, 8.0), (0.12, 0.18)))
    return join([join(rafters).moved(ahead=ahead) for ahead in SIDES])


def walls() -> Mesh:
    """The outer walls, one quad a side, turned inwards, and a plinth along each."""
    side = join(
        [
            quad((8, 0, 8), (-8, 0, 8), (-8, 5, 8), (8, 5, 8)),
            box((16, 0.22, 0.12), (0, 0, 7.95)),
        ]
    )
    return join([side.moved(ahead=ahead) for ahead in SIDES])


def fountain() -> Mesh:
    """An eight-sided basin, a stem, a bowl."""
    basin = [
        [(1.5, 0.0), (1.5, 0.5)],
        [(1.5, 0.5), (1.3, 0.5)],
        [(1.3, 0.5), (1.3, 0.12)],
        [(1.3, 0.12), (0.0, 0.12)],
    ]
    stem = curve([(0.3, 0.12), (0.17, 0.4), (0.13, 0.8), (0.2, 1.0), (0.75, 1.22)], 5)
    bowl = curve([(0.72, 1.22), (0.4, 1.1), (0.0, 1.06)], 5)
    return join([lathe(basin, 8), lathe([stem, [(0.75, 1.22), (0.72, 1.22)], bowl], 32)])


def urns() -> Mesh:
    """Earthen jars along a gallery."""
    body = [(0.16, 0.0), (0.27, 0.25), (0.31, 0.5), (0.22, 0.78), (0.15, 0.86), (0.2, 0.94)]
    inside = [(0.18, 0.94), (0.13, 0.86), (0.19, 0.76), (0.0, 0.6)]
    jar = lathe([curve(body, 4), [(0.2, 0.94), (0.18, 0.94)], curve(inside, 2)], 16)
    places = [
        (-7.45, 4.1, 1.0),
        (-7.5, 3.35, 0.72),
        (-7.4, -0.4, 1.15),
        (-7.5, -4.6, 0.9),
        (4.0, -7.4, 1.1),
    ]
    return join([jar.moved((x, 0, z), size=size) for x, z, size in places])


def bench() -> Mesh:
    """A seat on two blocks, a little askew."""
    ahead = (1.0, 0.0, -0.08)
    x, z = -7.35, 1.5
    return join(
        [
            box((1.7, 0.07, 0.45), (x, 0.4, z), ahead=ahead),
            box((0.16, 0.4, 0.36), (x, 0, z + 0.6), ahead=ahead),
            box((0.16, 0.4, 0.36), (x, 0, z - 0.6), ahead=ahead),
        ]
    )


def files() -> dict[str, bytes]:
    """The meshes by path."""
    meshes = {"arcade": arcade(), "roof": roof(), "beams": beams(), "walls": walls()}
    meshes |= {"fountain": fountain(), "urns": urns(), "bench": bench()}
    return {f"meshes/{name}.ply": ply(mesh) for name, mesh in meshes.items()}
