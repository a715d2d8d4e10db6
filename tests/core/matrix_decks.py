"""Small CalculiX models whose matrices and native modes tests compare with."""

from __future__ import annotations

import itertools
import os
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from modetune.adapters.calculix.matrices import read_matrices
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.modes import Floats
from tests.adapters.ccx_decks import EDGES, TETRAHEDRA

E_MODULUS, POISSON, DENSITY = 70_000.0, 0.3, 2.7e-9
SIDE = 10.0


def bar(
    moduli: Sequence[float], densities: Sequence[float] | None = None, held: bool = True
) -> tuple[str, list[frozenset[int]]]:
    """A bar of C3D8I, 10 x 8 mm, two elements a material, and each material's nodes.

    moduli, densities: relative values, one a material along the bar.
    """
    count = 2 * len(moduli)
    node = {
        (i, j, k): 100 * (i + 1) + 10 * j + k
        for i in range(count + 1)
        for j in range(3)
        for k in range(3)
    }
    lines = ["*NODE, NSET=ALL"]
    lines += [f"{n}, {SIDE * i}, {5.0 * j}, {4.0 * k}" for (i, j, k), n in node.items()]
    node_groups = []
    number = itertools.count(1)
    for place in range(len(moduli)):
        lines.append(f"*ELEMENT, TYPE=C3D8I, ELSET=P{place}")
        for i, j, k in itertools.product(range(2 * place, 2 * place + 2), range(2), range(2)):
            ring = [(j, k), (j + 1, k), (j + 1, k + 1), (j, k + 1)]
            corners = [node[i + a, b, c] for a in (0, 1) for b, c in ring]
            lines.append(f"{next(number)}, " + ", ".join(map(str, corners)))
        node_groups.append(
            frozenset(n for (i, _, _), n in node.items() if 2 * place <= i <= 2 * place + 2)
        )
    for place, (modulus, density) in enumerate(
        zip(moduli, densities or [1.0] * len(moduli), strict=True)
    ):
        lines += [
            f"*MATERIAL, NAME=M{place}",
            "*ELASTIC",
            f"{E_MODULUS * modulus!r}, {POISSON}",
            "*DENSITY",
            f"{DENSITY * density!r}",
            f"*SOLID SECTION, ELSET=P{place}, MATERIAL=M{place}",
        ]
    if held:
        lines += ["*BOUNDARY", *(f"{n}, 1, 3" for (i, _, _), n in node.items() if i == 0)]
    return "\n".join(lines) + "\n", node_groups


def bracket(moduli: Sequence[float], dust: float) -> tuple[str, list[frozenset[int]]]:
    """A free L of C3D10: the outer arm, the knee and the upright are of a material each.

    moduli: relative values; dust: coordinates are off by up to this times 10 mm, as those of a
    mesh that was moved or turned. Returns the nodes of each material too.
    """
    lying = [(i, j, 0) for i in range(4) for j in range(2)]
    standing = [(0, j, k) for k in range(1, 4) for j in range(2)]
    corners = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1),
               (0, 1, 1))  # fmt: skip
    node: dict[tuple[int, ...], int] = {}
    rows: list[list[list[int]]] = [[], [], []]
    for cell in (*lying, *standing):
        ring = [tuple(2 * (c + d) for c, d in zip(cell, corner, strict=True)) for corner in corners]
        place = 0 if cell[0] >= 2 else 1 if cell[2] < 2 else 2
        for four in TETRAHEDRA:
            ends = [ring[number - 1] for number in four]
            middles = [
                tuple((a + b) // 2 for a, b in zip(ends[i], ends[j], strict=True)) for i, j in EDGES
            ]
            rows[place].append([node.setdefault(p, len(node) + 1) for p in (*ends, *middles)])
    random = np.random.default_rng(0)
    lines = ["*NODE, NSET=ALL"]
    for point, n in node.items():
        at = np.array(point) * [5.0, 3.5, 3.0] + 10.0 * dust * random.uniform(-1.0, 1.0, 3)
        lines.append(f"{n}, " + ", ".join(f"{value:.14f}" for value in at))
    number = itertools.count(1)
    for place, (elements, modulus) in enumerate(zip(rows, moduli, strict=True)):
        lines.append(f"*ELEMENT, TYPE=C3D10, ELSET=P{place}")
        lines += [f"{next(number)}, " + ", ".join(map(str, nodes)) for nodes in elements]
        lines += [
            f"*MATERIAL, NAME=M{place}",
            "*ELASTIC",
            f"{E_MODULUS * modulus!r}, {POISSON}",
            "*DENSITY",
            f"{DENSITY!r}",
            f"*SOLID SECTION, ELSET=P{place}, MATERIAL=M{place}",
        ]
    return "\n".join(lines) + "\n", [frozenset(itertools.chain(*part)) for part in rows]


def plates(
    thicknesses: tuple[float, float],
    angle: float,
    held: bool = True,
    moduli: tuple[float, float] = (1.0, 1.0),
) -> str:
    """Two plates of S4, 60 x 44 mm and 40 x 44 mm, that meet along an edge at an angle, degrees.

    An angle of 0 has them in one plane. Held means clamped at the far edge of the first.
    """
    node = {(i, j): 100 * (i + 1) + j for i in range(11) for j in range(5)}
    turn = np.radians(angle)
    lines = ["*NODE, NSET=ALL"]
    for (i, j), n in node.items():
        along, beyond = SIDE * min(i, 6), SIDE * max(i - 6, 0)
        x, z = along + beyond * np.cos(turn), beyond * np.sin(turn)
        lines.append(f"{n}, {x:.12g}, {11.0 * j}, {z:.12g}")
    for name, columns in (("P0", range(6)), ("P1", range(6, 10))):
        lines.append(f"*ELEMENT, TYPE=S4, ELSET={name}")
        for i, j in itertools.product(columns, range(4)):
            corners = [node[i, j], node[i + 1, j], node[i + 1, j + 1], node[i, j + 1]]
            lines.append(f"{10 * i + j + 1}, " + ", ".join(map(str, corners)))
    for place, (thickness, modulus) in enumerate(zip(thicknesses, moduli, strict=True)):
        lines += [
            f"*MATERIAL, NAME=M{place}",
            "*ELASTIC",
            f"{E_MODULUS * modulus!r}, {POISSON}",
            "*DENSITY",
            f"{DENSITY!r}",
            f"*SHELL SECTION, ELSET=P{place}, MATERIAL=M{place}",
            f"{thickness!r}",
        ]
    if held:
        lines += ["*BOUNDARY", *(f"{node[0, j]}, 1, 6" for j in range(5))]
    return "\n".join(lines) + "\n"


def _solve(deck: str, step: str, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "job.inp").write_text(f"{deck}*STEP\n{step}\n*END STEP\n")
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    subprocess.run(["ccx", "job"], cwd=folder, env=environment, capture_output=True, check=True)


def matrices_of(deck: str, folder: Path) -> MatrixResult:
    """What ccx stores for a deck without steps."""
    _solve(deck, "*FREQUENCY, SOLVER=MATRIXSTORAGE\n1", folder)
    return read_matrices(folder, "job")


def native_eigenvalues(deck: str, n_modes: int, folder: Path) -> Floats:
    """What ccx prints for a deck without steps, (n_modes,), seven digits."""
    _solve(deck, f"*FREQUENCY\n{n_modes}", folder)
    table = (folder / "job.dat").read_text().split("P A R T I C I P A T I O N")[0]
    rows = [line.split() for line in table.splitlines()]
    values = [float(row[1]) for row in rows if len(row) == 5 and row[0].isdigit()]
    return np.array(values)[:n_modes]


def scaled_difference(one: MatrixResult, other: MatrixResult) -> tuple[float, float]:
    """Largest |a_ij - b_ij| / sqrt(a_ii a_jj) of stiffness and mass."""
    found = []
    for a, b in ((one.upper_stiffness, other.upper_stiffness), (one.upper_mass, other.upper_mass)):
        difference = (a - b).tocoo()
        size = np.sqrt(a.diagonal())
        largest = size[difference.row] * size[difference.col]
        moves = largest > 0.0
        assert not np.abs(difference.data[~moves]).any()
        found.append(float(np.max(np.abs(difference.data[moves]) / largest[moves], initial=0.0)))
    return found[0], found[1]
