"""Families of solids: bars, a bracket from a mesher, a block on soft mounts, a string."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from benchmarks.mesher import gmsh_model
from benchmarks.zoo.structure import (
    TWO_MODULI,
    Generator,
    Structure,
    elements,
    material,
    rows,
    spread,
)


def bricks(
    nx: int, ny: int, nz: int, place: Callable[[float, float, float], Sequence[float]]
) -> tuple[list[Sequence[object]], list[list[int]], dict[tuple[int, int, int], int]]:
    """Nodes and C3D20 bricks of a block of nx x ny x nz; place: from (0..1)^3 into space."""
    ids: dict[tuple[int, int, int], int] = {}
    nodes: list[Sequence[object]] = []
    for i in range(2 * nx + 1):
        for j in range(2 * ny + 1):
            for k in range(2 * nz + 1):
                if i % 2 + j % 2 + k % 2 <= 1:
                    ids[i, j, k] = len(ids) + 1
                    at = place(i / (2 * nx), j / (2 * ny), k / (2 * nz))
                    nodes.append((ids[i, j, k], *map(float, at)))
    corner = [(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0)]
    middle = [(1, 0, 0), (2, 1, 0), (1, 2, 0), (0, 1, 0)]
    local = (
        corner
        + [(i, j, 2) for i, j, _ in corner]
        + middle
        + [(i, j, 2) for i, j, _ in middle]
        + [(i, j, 1) for i, j, _ in corner]
    )
    table = [
        [ids[2 * a + i, 2 * b + j, 2 * c + k] for i, j, k in local]
        for a in range(nx)
        for b in range(ny)
        for c in range(nz)
    ]
    return nodes, table, ids


def solid_deck(
    nodes: Sequence[Sequence[object]],
    table: Sequence[Sequence[int]],
    held: Sequence[int],
    rng: Generator,
    kind: str = "C3D20",
    more: str = "",
    lower: int = 0,
) -> str:
    """Two materials, half of the elements each or the first of them lower, some nodes held."""
    lower = lower or len(table) // 2
    return (
        f"*NODE, NSET=NALL\n{rows(nodes)}"
        + elements(kind, "LOWER", range(1, lower + 1), table)
        + elements(kind, "UPPER", range(lower + 1, len(table) + 1), table)
        + material("LOWER", rng)
        + material("UPPER", rng)
        + "*SOLID SECTION, ELSET=LOWER, MATERIAL=LOWER\n"
        + "*SOLID SECTION, ELSET=UPPER, MATERIAL=UPPER\n"
        + more
        + (f"*BOUNDARY\n{rows((node, 1, 3) for node in held)}" if held else "")
    )


def square_bar(rng: Generator) -> Structure:
    """A cantilever alike in y and z: bending comes in doublets."""
    length, width = rng.uniform(300, 900), rng.uniform(15, 40)
    nodes, table, ids = bricks(8, 1, 1, lambda x, y, z: (length * x, width * y, width * z))
    held = [node for (i, _, _), node in ids.items() if i == 0]
    ends = [node for (i, j, k), node in ids.items() if i and not (i % 2 or j % 2 or k % 2)]
    return Structure(
        "square_bar", solid_deck(nodes, table, held, rng), TWO_MODULI, spread(rng, ends, 16), 5
    )


def round_bar(rng: Generator) -> Structure:
    """A free round bar, meshed as a square that is pressed into a circle."""
    length, radius = rng.uniform(300, 900), rng.uniform(10, 25)

    def place(x: float, y: float, z: float) -> Sequence[float]:
        a, b = 2 * y - 1, 2 * z - 1
        return length * x, radius * a * np.sqrt(1 - b * b / 2), radius * b * np.sqrt(1 - a * a / 2)

    nodes, table, ids = bricks(8, 2, 2, place)
    surface = [node for (_, j, k), node in ids.items() if j in (0, 4) or k in (0, 4)]
    return Structure(
        "round_bar",
        solid_deck(nodes, table, [], rng, "C3D20R"),
        TWO_MODULI,
        spread(rng, surface, 20),
        4,
    )


def bracket(rng: Generator) -> Structure:
    """An angle with a hole, meshed with tetrahedra by gmsh, held by the hole; coordinates carry the
    mesher's rounding."""
    size, thick = rng.uniform(60, 120), rng.uniform(6, 12)
    with gmsh_model() as gmsh:
        shape = gmsh.model.occ
        foot = shape.addBox(0, 0, 0, size, 0.7 * size, thick)
        wall = shape.addBox(0, 0, thick, thick, 0.7 * size, 0.8 * size)
        hole = shape.addCylinder(0.6 * size, 0.35 * size, -1, 0, 0, thick + 2, 0.12 * size)
        cut, _ = shape.cut([(3, foot)], [(3, hole)])
        shape.fragment(cut, [(3, wall)])
        shape.synchronize()
        gmsh.option.setNumber("Mesh.MeshSizeMax", 1.3 * thick)
        gmsh.model.mesh.generate(3)
        gmsh.model.mesh.setOrder(2)
        numbers, places, _ = gmsh.model.mesh.getNodes()
        ids = {int(number): place for place, number in enumerate(numbers, start=1)}
        points = np.reshape(places, (-1, 3))
        groups = []
        for _, volume in gmsh.model.getEntities(3):
            _, _, held = gmsh.model.mesh.getElements(3, volume)
            groups.append([[ids[int(n)] for n in row] for row in np.reshape(held[0], (-1, 10))])
    table = [[*row[:8], row[9], row[8]] for group in groups for row in group]  # gmsh's last two
    axis = np.hypot(points[:, 0] - 0.6 * size, points[:, 1] - 0.35 * size)
    held = [int(n) + 1 for n in np.flatnonzero(axis < 0.121 * size)]
    nodes = [(place, *map(float, point)) for place, point in enumerate(points, start=1)]
    corners = sorted({n for row in table for n in row[:4]} - set(held))
    deck = solid_deck(nodes, table, held, rng, "C3D10", lower=len(groups[0]))
    return Structure("bracket", deck, TWO_MODULI, spread(rng, corners, 24), 5)


def soft_mounts(rng: Generator) -> Structure:
    """A block on four soft springs: six modes of the suspension far below the elastic ones."""
    size = rng.uniform(200, 400)
    nodes, table, ids = bricks(6, 3, 1, lambda x, y, z: (size * x, size * y / 2, size * z / 12))
    corners = [node for (i, j, k), node in ids.items() if i in (0, 12) and j in (0, 6) and k == 0]
    stiffness = rng.uniform(0.02, 0.2)
    springs = ""
    for axis in (1, 2, 3):
        numbers = [(900 + 10 * axis + place, node) for place, node in enumerate(corners)]
        springs += f"*ELEMENT, TYPE=SPRING1, ELSET=MOUNT{axis}\n{rows(numbers)}"
        springs += f"*SPRING, ELSET=MOUNT{axis}\n{axis}\n{stiffness:.6g}\n"
    deck = solid_deck(nodes, table, [], rng, "C3D20R", springs)
    ends = [node for (i, j, k), node in ids.items() if not (i % 2 or j % 2 or k % 2)]
    return Structure("soft_mounts", deck, TWO_MODULI, spread(rng, ends, 18), 9)


def string(rng: Generator) -> Structure:
    """A beam under tension: a static step before the frequencies."""
    length, n, width = rng.uniform(400, 900), 12, rng.uniform(2, 4)
    nodes, table, ids = bricks(n, 1, 1, lambda x, y, z: (length * x, width * y, width * z))
    left = [node for (i, _, _), node in ids.items() if i == 0]
    right = [node for (i, _, _), node in ids.items() if i == 2 * n]
    load = rng.uniform(200, 800) / len(right)
    text = solid_deck(nodes, table, left, rng)
    text += f"*BOUNDARY\n{rows((node, 2, 3) for node in right)}"
    text += f"*STEP\n*STATIC\n*CLOAD\n{rows((node, 1, load) for node in right)}*END STEP\n"
    text += "*STEP, PERTURBATION\n*FREQUENCY\n10\n*END STEP\n"
    middle = [node for (i, j, k), node in ids.items() if 0 < i < 2 * n and j == 0 and k == 0]
    return Structure("string", text, TWO_MODULI, spread(rng, middle, 14), 4)
