"""Families of structures, each drawn at random: a deck or matrices, candidates, sensor nodes.

Lengths in mm, forces in N, masses in t. Every family is a function of a random generator, so a
structure is its family and a seed. None is meant to look like the aircraft, the launcher or the
fixture: they are symmetric, stand on soft mounts, carry offset masses, are preloaded or layered,
or come from a mesher.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from benchmarks.mesher import gmsh_model

from modetune.core.modes import Floats

Generator = np.random.Generator


@dataclass(frozen=True, slots=True)
class Structure:
    """A structure to update.

    deck: its text, or arrays of a model of matrices; parameters: candidates as in a campaign
    file; sensors: nodes at which a test may measure; n_modes: elastic modes of the test.
    """

    family: str
    deck: str | dict[str, Any]
    parameters: tuple[dict[str, Any], ...]
    sensors: tuple[int, ...]
    n_modes: int
    solver: str = "calculix"


def modulus(material: str) -> dict[str, Any]:
    return {"name": f"E_{material}", "quantity": "youngs_modulus", "material": material}


def rows(items: Iterable[Sequence[object]]) -> str:
    """Lines of a deck, at most sixteen entries each."""
    lines = []
    for item in items:
        words = [f"{word:.10g}" if isinstance(word, float) else str(word) for word in item]
        parts = [words[at : at + 12] for at in range(0, len(words), 12)]
        lines += [", ".join(part) + ("," if part is not parts[-1] else "") for part in parts]
    return "\n".join(lines) + "\n"


def material(name: str, rng: Generator) -> str:
    """A metal or polymer with moduli of its own."""
    young, density = [(71e3, 2.7e-9), (207e3, 7.85e-9), (113e3, 4.43e-9), (3e3, 1.2e-9)][
        int(rng.integers(4))
    ]
    return f"*MATERIAL, NAME={name}\n*ELASTIC\n{young * rng.uniform(0.9, 1.1):.6g}, 0.31\n" + (
        f"*DENSITY\n{density:.6g}\n"
    )


def halves(n: int) -> tuple[range, range]:
    """Numbers 1 .. n in two parts."""
    return range(1, n // 2 + 1), range(n // 2 + 1, n + 1)


def elements(kind: str, name: str, numbers: Iterable[int], table: Sequence[Sequence[int]]) -> str:
    chosen = [(number, *table[number - 1]) for number in numbers]
    return f"*ELEMENT, TYPE={kind}, ELSET={name}\n{rows(chosen)}"


def spread(rng: Generator, nodes: Sequence[int], n: int) -> tuple[int, ...]:
    chosen = rng.choice(np.array(nodes), size=min(n, len(nodes)), replace=False)
    return tuple(sorted(int(node) for node in chosen))


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
) -> str:
    """Two materials, half of the elements each, some nodes held."""
    first, second = halves(len(table))
    return (
        f"*NODE, NSET=NALL\n{rows(nodes)}"
        + elements(kind, "LOWER", first, table)
        + elements(kind, "UPPER", second, table)
        + material("LOWER", rng)
        + material("UPPER", rng)
        + "*SOLID SECTION, ELSET=LOWER, MATERIAL=LOWER\n"
        + "*SOLID SECTION, ELSET=UPPER, MATERIAL=UPPER\n"
        + more
        + (f"*BOUNDARY\n{rows((node, 1, 3) for node in held)}" if held else "")
    )


TWO_MODULI = (modulus("LOWER"), modulus("UPPER"))


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


def quads(nx: int, ny: int, closed: bool) -> tuple[dict[tuple[int, int], int], list[list[int]]]:
    """Numbers of nodes (i, j) and eight-node quadrilaterals; closed: round in the second."""
    ids: dict[tuple[int, int], int] = {}
    last = 2 * ny if closed else 2 * ny + 1
    for i in range(2 * nx + 1):
        for j in range(last):
            if not (i % 2 and j % 2):
                ids[i, j] = len(ids) + 1
    local = [(0, 0), (2, 0), (2, 2), (0, 2), (1, 0), (2, 1), (1, 2), (0, 1)]
    table = [
        [ids[2 * a + i, (2 * b + j) % (2 * ny) if closed else 2 * b + j] for i, j in local]
        for a in range(nx)
        for b in range(ny)
    ]
    return ids, table


def shell_deck(
    nodes: Sequence[Sequence[object]],
    table: Sequence[Sequence[int]],
    sections: str,
    rng: Generator,
    more: str = "",
) -> str:
    first, second = halves(len(table))
    return (
        f"*NODE, NSET=NALL\n{rows(nodes)}"
        + elements("S8R", "LOWER", first, table)
        + elements("S8R", "UPPER", second, table)
        + material("LOWER", rng)
        + material("UPPER", rng)
        + sections
        + more
    )


def plain_shells(thickness: float) -> str:
    return "".join(
        f"*SHELL SECTION, ELSET={name}, MATERIAL={name}\n{thickness:.6g}\n"
        for name in ("LOWER", "UPPER")
    )


def tube(rng: Generator) -> Structure:
    """A clamped tube of shells: bending and ovalising in doublets."""
    length, radius = rng.uniform(300, 600), rng.uniform(40, 90)
    ids, table = quads(6, 8, closed=True)
    nodes = [
        (
            node,
            length * i / 12,
            radius * float(np.cos(np.pi * j / 8)),
            radius * float(np.sin(np.pi * j / 8)),
        )
        for (i, j), node in ids.items()
    ]
    held = rows((node, 1, 6) for (i, _), node in ids.items() if i == 0)
    deck = shell_deck(nodes, table, plain_shells(rng.uniform(1.5, 4)), rng, f"*BOUNDARY\n{held}")
    free = [node for (i, _), node in ids.items() if i]
    return Structure("tube", deck, TWO_MODULI, spread(rng, free, 24), 5)


def laminate(rng: Generator) -> Structure:
    """A square plate on two edges, of two plies of one material between two of another."""
    size, n = rng.uniform(200, 400), 5
    ids, table = quads(n, n, closed=False)
    nodes = [(node, size * i / (2 * n), size * j / (2 * n), 0.0) for (i, j), node in ids.items()]
    ply = rng.uniform(0.3, 0.6)
    sections = "".join(
        f"*SHELL SECTION, ELSET={name}, COMPOSITE\n"
        + "".join(f"{ply:.6g}, , {one}\n" for one in ("LOWER", "UPPER", "UPPER", "LOWER"))
        for name in ("LOWER", "UPPER")
    )
    held = rows((node, 1, 3) for (i, j), node in ids.items() if i == 0 or j == 0)
    deck = shell_deck(nodes, table, sections, rng, f"*BOUNDARY\n{held}")
    free = [node for (i, j), node in ids.items() if i and j]
    return Structure("laminate", deck, TWO_MODULI, spread(rng, free, 20), 5)


def stiffened_plate(rng: Generator) -> Structure:
    """A free plate with a blade across it, shells that meet at a right angle."""
    size, height = rng.uniform(250, 500), rng.uniform(20, 50)
    n = 6
    ids, table = quads(n, n, closed=False)
    nodes: list[Sequence[object]] = [
        (node, size * i / (2 * n), size * j / (2 * n), 0.0) for (i, j), node in ids.items()
    ]
    blade: dict[tuple[int, int], int] = {(i, 0): ids[i, n] for i in range(2 * n + 1)}
    for i in range(2 * n + 1):
        for k in (1, 2):
            if not (i % 2 and k % 2):
                blade[i, k] = len(nodes) + 1
                nodes.append((blade[i, k], size * i / (2 * n), size / 2, height * k / 2))
    local = [(0, 0), (2, 0), (2, 2), (0, 2), (1, 0), (2, 1), (1, 2), (0, 1)]
    blades = [[blade[2 * a + i, k] for i, k in local] for a in range(n)]
    numbers = range(len(table) + 1, len(table) + n + 1)
    deck = (
        f"*NODE, NSET=NALL\n{rows(nodes)}"
        + elements("S8R", "LOWER", range(1, len(table) + 1), table)
        + elements("S8R", "UPPER", numbers, table + blades)
        + material("LOWER", rng)
        + material("UPPER", rng)
        + plain_shells(rng.uniform(1.5, 4))
    )
    return Structure("stiffened_plate", deck, TWO_MODULI, spread(rng, list(ids.values()), 24), 5)


def beams(
    family: str,
    nodes: Sequence[Sequence[object]],
    bars: dict[str, list[tuple[int, int]]],
    held: Sequence[int],
    rng: Generator,
    normal: Sequence[float],
    n_modes: int,
    more: str = "",
) -> Structure:
    """A frame of B31 beams, each group with a section and a material of its own."""
    text, number, parameters = f"*NODE, NSET=NALL\n{rows(nodes)}", 1, []
    for name, pairs in bars.items():
        table = [(number + place, *pair) for place, pair in enumerate(pairs)]
        number += len(pairs)
        a, b = rng.uniform(8, 20), rng.uniform(8, 20)
        text += f"*ELEMENT, TYPE=B31, ELSET={name}\n{rows(table)}{material(name, rng)}"
        text += f"*BEAM SECTION, ELSET={name}, MATERIAL={name}, SECTION=RECT\n{a:.6g}, {b:.6g}\n"
        text += ", ".join(f"{value:g}" for value in normal) + "\n"
        parameters.append(modulus(name))
    text += more + (f"*BOUNDARY\n{rows((node, 1, 6) for node in held)}" if held else "")
    free = [int(str(node[0])) for node in nodes if node[0] not in held]
    return Structure(family, text, tuple(parameters), spread(rng, free, 20), n_modes)


def tower(rng: Generator) -> Structure:
    """A square tower of four legs and rings: every sway comes twice."""
    side, height, n = rng.uniform(200, 400), rng.uniform(200, 400), 4
    corners = [(0, 0), (1, 0), (1, 1), (0, 1)]
    nodes = [
        (4 * level + place + 1, side * x, side * y, height * level)
        for level in range(n + 1)
        for place, (x, y) in enumerate(corners)
    ]
    legs = [(4 * level + p + 1, 4 * level + p + 5) for level in range(n) for p in range(4)]
    rings = [
        (4 * level + p + 1, 4 * level + (p + 1) % 4 + 1)
        for level in range(1, n + 1)
        for p in range(4)
    ]
    return beams(
        "tower", nodes, {"LEGS": legs, "RINGS": rings}, [1, 2, 3, 4], rng, (0.6, 0.8, 0.1), 5
    )


def grillage(rng: Generator) -> Structure:
    """Beams crossing in a plane, held at the corners."""
    size, n = rng.uniform(400, 900), 4
    ids = {(i, j): i * (n + 1) + j + 1 for i in range(n + 1) for j in range(n + 1)}
    nodes = [(node, size * i / n, size * 0.8 * j / n, 0.0) for (i, j), node in ids.items()]
    along = [(ids[i, j], ids[i + 1, j]) for i in range(n) for j in range(n + 1)]
    across = [(ids[i, j], ids[i, j + 1]) for i in range(n + 1) for j in range(n)]
    held = [ids[0, 0], ids[n, 0], ids[0, n], ids[n, n]]
    return beams("grillage", nodes, {"ALONG": along, "ACROSS": across}, held, rng, (0, 0, 1), 5)


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
    first = len(groups[0])
    axis = np.hypot(points[:, 0] - 0.6 * size, points[:, 1] - 0.35 * size)
    held = [int(n) + 1 for n in np.flatnonzero(axis < 0.121 * size)]
    nodes = [(place, *map(float, point)) for place, point in enumerate(points, start=1)]
    corners = sorted({n for row in table for n in row[:4]} - set(held))
    deck = (
        f"*NODE, NSET=NALL\n{rows(nodes)}"
        + elements("C3D10", "LOWER", range(1, first + 1), table)
        + elements("C3D10", "UPPER", range(first + 1, len(table) + 1), table)
        + material("LOWER", rng)
        + material("UPPER", rng)
        + "*SOLID SECTION, ELSET=LOWER, MATERIAL=LOWER\n"
        + "*SOLID SECTION, ELSET=UPPER, MATERIAL=UPPER\n"
        + f"*BOUNDARY\n{rows((node, 1, 3) for node in held)}"
    )
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


def stick(rng: Generator) -> Structure:
    """A wing of bars with masses off the axis, as a Nastran deck."""
    n, span = 16, rng.uniform(1500, 4000)
    text = "SOL 103\nCEND\nMETHOD = 1\nSPC = 1\nBEGIN BULK\nEIGRL,1,,,20\nPARAM,GRDPNT,0\n"
    for place in range(n + 1):
        text += f"GRID,{place + 1},,{span * place / n:.2f},0.,0.\n"
    for place in range(n):
        text += f"CBAR,{place + 1},{1 + (place >= n // 2)},{place + 1},{place + 2},0.,0.,1.\n"
        offset, mass = rng.uniform(20, 120), rng.uniform(0.0005, 0.002)
        text += f"CONM2,{100 + place},{place + 2},,{mass:.6f},0.,{offset:.2f},0.\n"
        text += f",{mass * 2000:.4f},,{mass * 3000:.4f},,,{mass * 3000:.4f}\n"
    for number in (1, 2):
        area = rng.uniform(400, 900)
        text += f"PBAR,{number},{number},{area:.2f},{area * 90:.1f},{area * 400:.1f},"
        text += f"{area * 200:.1f}\nMAT1,{number},{rng.uniform(65e3, 75e3):.1f},,.33,2.7-9\n"
    text += "SPC1,1,123456,1\nENDDATA\n"
    parameters = tuple(
        {"name": f"E_{place}", "quantity": "youngs_modulus", "material": place} for place in (1, 2)
    )
    return Structure("stick", text, parameters, tuple(range(2, n + 2)), 5)


def chain(rng: Generator) -> Structure:
    """A building of many storeys as matrices, a spring a candidate."""
    n = int(rng.integers(5, 9))
    stiffness, mass = np.zeros((n, n)), np.diag(rng.uniform(0.5, 2.0, n))
    parts: dict[str, Any] = {}
    for place in range(n):
        own = spring(n, place - 1, place, float(rng.uniform(800, 2000)))
        stiffness += own
        parts[f"k{place + 1}"] = {"stiffness": own}
    return matrices("chain", stiffness, mass, parts, [f"k{p + 1}" for p in range(0, n, 2)], n)


def mechanism(rng: Generator) -> Structure:
    """Two free beams of masses joined by a hinge: three modes at zero in the plane, not two."""
    n = 12
    stiffness, mass = np.zeros((n, n)), np.diag(rng.uniform(0.8, 1.2, n))
    groups = {"left": np.zeros((n, n)), "right": np.zeros((n, n))}
    value = float(rng.uniform(2e4, 6e4))
    for place in range(n - 2):
        if place + 1 == n // 2:
            continue  # the hinge: no bending across it
        bend = np.zeros(n)
        bend[place : place + 3] = 1.0, -2.0, 1.0
        groups["left" if place < n // 2 else "right"] += value * np.outer(bend, bend)
    stiffness = groups["left"] + groups["right"]
    parts = {name: {"stiffness": own} for name, own in groups.items()}
    return matrices("mechanism", stiffness, mass, parts, list(parts), 5)


def polar_masses(rng: Generator) -> Structure:
    """Masses alike in x and y: every mode twice, by matrices."""
    n = 6
    alike: Floats = np.zeros((n, n))
    parts: dict[str, Any] = {}
    for place in range(n):
        alike += spring(n, place - 1, place, 1000.0 + 100.0 * place)
    both = np.eye(2)
    half = {"low": range(n // 2), "high": range(n // 2, n)}
    for name, places in half.items():
        own = sum((spring(n, p - 1, p, 1000.0 + 100.0 * p) for p in places), np.zeros((n, n)))
        parts[name] = {"stiffness": np.kron(own, both)}
    dofs = [f"{place + 1}.{axis}" for place in range(n) for axis in "xy"]
    mass = np.kron(np.diag(rng.uniform(0.5, 1.5, n)), both)
    return matrices("polar_masses", np.kron(alike, both), mass, parts, list(parts), 6, dofs)


def assembly(rng: Generator) -> Structure:
    """Two free chains of stiff springs joined by soft joints, whose stiffness is sought."""
    n = 10
    stiffness, mass = np.zeros((n, n)), np.diag(rng.uniform(0.5, 2.0, n))
    for first, second in [
        *zip(range(4), range(1, 5), strict=True),
        *zip(range(5, 9), range(6, 10), strict=True),
    ]:
        stiffness += spring(n, first, second, float(rng.uniform(3e4, 6e4)))
    parts: dict[str, Any] = {}
    for place, (first, second) in enumerate([(0, 5), (2, 7), (4, 9)], start=1):
        own = spring(n, first, second, float(rng.uniform(1e3, 4e3)))
        stiffness += own
        parts[f"joint{place}"] = {"stiffness": own}
    return matrices("assembly", stiffness, mass, parts, list(parts), 6)


def spring(n: int, first: int, second: int, value: float) -> Floats:
    """The stiffness (n, n) of a spring between two unknowns; -1 is the ground."""
    ends = np.zeros(n)
    ends[second] = 1.0
    if first >= 0:
        ends[first] = -1.0
    return value * np.outer(ends, ends)


def matrices(
    family: str,
    stiffness: Floats,
    mass: Floats,
    parts: dict[str, Any],
    sought: Sequence[str],
    n_modes: int,
    dofs: Sequence[str] | None = None,
) -> Structure:
    model = {"stiffness": stiffness, "mass": mass, "parts": parts}
    if dofs is not None:
        model["dofs"] = list(dofs)
    n_nodes = len(stiffness) // (2 if dofs else 1)
    parameters = tuple({"name": name, "quantity": "matrix_factor", "part": name} for name in sought)
    return Structure(
        family,
        model,
        parameters,
        tuple(range(1, n_nodes + 1)),
        min(n_modes, len(stiffness) - 2),
        "matrices",
    )


FAMILIES: dict[str, Callable[[Generator], Structure]] = {
    made.__name__: made
    for made in (
        square_bar,
        round_bar,
        tube,
        laminate,
        stiffened_plate,
        bracket,
        tower,
        grillage,
        soft_mounts,
        string,
        stick,
        chain,
        mechanism,
        polar_masses,
        assembly,
    )
}
