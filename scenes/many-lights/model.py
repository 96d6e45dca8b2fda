"""`many-lights`: partitions, furniture and the 36 lamps of an office seen from above."""

from __future__ import annotations

import numpy as np
from modelling import Mesh, box, curve, fraction, join, lathe, ply, unit

SIDE, CELL, HIGH = 6, 2.6, 1.75
"""Cells a side, the side of a cell and the height of a partition."""
LAMP, LAMP_SPOT = 1.2, (0.38, -0.1)
"""Height of a lamp, well below the partitions' tops, and where it hangs over the desk."""
COLOURS = [
    (1.0, 0.78, 0.5),
    (1.0, 0.86, 0.68),
    (0.75, 0.88, 1.0),
    (1.0, 0.7, 0.4),
    (0.9, 1.0, 0.9),
    (1.0, 0.62, 0.55),
]


def cells() -> list[tuple[int, float, float, tuple[float, float, float]]]:
    """Number, centre x and z, and what the desk looks along, of each cell."""
    found = []
    for i in range(SIDE * SIDE):
        x, z = ((c - (SIDE - 1) / 2) * CELL for c in (i % SIDE, i // SIDE))
        found.append((i, x, z, (1.1 * fraction(i) - 0.55, 0.0, 1.0)))
    return found


def partitions(accent: bool) -> Mesh:
    """Walls between rows run through; those between columns leave a passage at the front; a few are painted."""
    parts = []
    half = SIDE * CELL / 2
    for row in range(SIDE + 1):
        for column in range(SIDE):
            painted = (row * 5 + column * 3) % 7 == 0
            high = HIGH if row < SIDE else 0.5  # low in front, so that the first row is seen
            if painted == accent:
                parts.append(
                    box((CELL, high, 0.06), ((column + 0.5) * CELL - half, 0, row * CELL - half))
                )
    for column in range(SIDE + 1):
        for row in range(SIDE):
            depth = CELL if column in (0, SIDE) else 0.68 * CELL
            painted = (row * 2 + column * 5) % 9 == 0
            if painted == accent:
                z = row * CELL - half + depth / 2
                parts.append(box((0.06, HIGH, depth - 0.06), (column * CELL - half, 0, z)))
    return join(parts)


def desk() -> Mesh:
    """A top on two sides."""
    return join(
        [
            box((1.4, 0.05, 0.7), (0, 0.7, 0)),
            box((0.05, 0.7, 0.6), (-0.64, 0, 0)),
            box((0.05, 0.7, 0.6), (0.64, 0, 0)),
        ]
    )


def chair() -> Mesh:
    """A seat on a foot, with a back."""
    return join(
        [
            box((0.46, 0.07, 0.46), (0, 0.42, 0)),
            box((0.09, 0.42, 0.09)),
            box((0.44, 0.42, 0.05), (0, 0.52, 0.24)),
        ]
    )


def shade() -> Mesh:
    """A cone over the lamp, on a stem that stands on the desk."""
    cone = [(0.17, LAMP - 0.03), (0.06, LAMP + 0.13)]
    return join([lathe([cone, [(0.06, LAMP + 0.13), (0.0, LAMP + 0.13)]], 16)])


def pot() -> Mesh:
    """A plant's pot."""
    return lathe(
        [curve([(0.13, 0.0), (0.18, 0.2), (0.2, 0.36)], 3), [(0.2, 0.36), (0.0, 0.34)]], 16
    )


def plant() -> Mesh:
    """Leaves of a plant, as a few bent blades."""
    return lathe([curve([(0.0, 0.34), (0.16, 0.6), (0.19, 0.8), (0.1, 1.0), (0.0, 1.1)], 3)], 8)


def spot(
    x: float, z: float, ahead: tuple[float, float, float], dx: float, dz: float
) -> tuple[float, float]:
    """Where (dx, dz) from a cell's desk lies, turned with the desk: x and z."""
    ux, _, uz = unit(np.array(ahead))
    return x + uz * dx + ux * dz, z - 0.45 + uz * dz - ux * dx


def placed(part: Mesh, dx: float, dz: float, *, every: int = 1, first: int = 0) -> Mesh:
    """The part in every n-th cell, (dx, dz) from where its desk stands, turned with the desk."""
    found = []
    for i, x, z, ahead in cells():
        if i % every == first:
            px, pz = spot(x, z, ahead, dx, dz)
            found.append(part.moved((px, 0, pz), ahead=ahead))
    return join(found)


def lamps() -> str:
    """The lamps as Mitsuba's XML: disks that face down inside their shades."""
    found = ['<scene version="3.0.0">\n    <!-- Written by model.py. -->\n']
    for i, x, z, ahead in cells():
        (px, pz) = spot(x, z, ahead, *LAMP_SPOT)
        power = 60 + 50 * fraction(i, 0.7548776662466927)
        rgb = ", ".join(f"{power * c:.1f}" for c in COLOURS[i * 5 % len(COLOURS)])
        found.append(
            f'    <shape type="disk" id="lamp-{i:02}">\n'
            '        <transform name="to_world">\n'
            '            <scale value="0.12"/>\n'
            '            <rotate x="1" angle="90"/>\n'
            f'            <translate x="{px:.4f}" y="{LAMP}" z="{pz:.4f}"/>\n'
            "        </transform>\n"
            '        <ref id="black"/>\n'
            '        <emitter type="area">\n'
            f'            <rgb name="radiance" value="{rgb}"/>\n'
            "        </emitter>\n"
            "    </shape>\n"
        )
    return "".join(found) + "</scene>\n"


def files() -> dict[str, bytes]:
    """The meshes, and the lamps' XML, by path."""
    screen = join([box((0.6, 0.36, 0.03), (0, 0.85, 0)), box((0.16, 0.11, 0.1), (0, 0.75, -0.02))])
    meshes = {
        "partitions": partitions(False),
        "accents": partitions(True),
        "desks": placed(desk(), 0, 0),
        "chairs": placed(chair(), 0.05, 0.75),
        "screens": placed(screen, -0.22, -0.15),
        "shades": placed(shade(), *LAMP_SPOT),
        "pots": placed(pot(), -0.75, 1.0, every=3),
        "plants": placed(plant(), -0.75, 1.0, every=3),
    }
    return {"lamps.xml": lamps().encode()} | {f"meshes/{n}.ply": ply(m) for n, m in meshes.items()}
