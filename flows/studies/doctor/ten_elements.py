"""Models of ten elements, as campaigns on each solver, and their modes in closed form.

Nastran and MYSTRAN: a cantilever of massless beams of length h that bends in one plane, a mass m at
each of the nodes x_i = i h. Its stiffness is the inverse of the influence coefficients of Euler and
Bernoulli's beam, which beam elements without shear have exactly,

    F_ij = x_i^2 (3 x_j - x_i) / (6 E I),  x_i <= x_j,      eigenvalues 1 / eig(F m).

CalculiX: a bar of ten bricks that stretches, without Poisson's ratio. Linear elements with their
consistent mass, held at one end, have the modes sin((2 j - 1) pi x / (2 L)) with

    lambda_j = (6 E / (rho h^2)) (1 - cos a) / (2 + cos a),  a = (2 j - 1) pi / (2 n).

Matrices: a chain of n springs k and masses m, held at one end,

    lambda_j = 4 (k / m) sin^2((2 j - 1) pi / (4 n + 2)).

Units are mm, t, s. (Meirovitch 2001, Fundamentals of Vibrations, chapters 7 and 8.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from modetune.core.modes import Floats
from modetune.flows.campaign.schema import NastranDialect

ELEMENTS = 10
#: Length of an element; modulus, density; second moments and area of the section; mass of a node.
SPAN, E, RHO, I1, I2, J, AREA, MASS = 50.0, 70_000.0, 2.7e-9, 600.0, 900.0, 1200.0, 80.0, 1e-4
STIFFNESS = 50.0
RUN = "run: {retries: 0, licence_pause_s: 1, licence_wait_s: 1, timeout_s: 600}\n"


@dataclass(frozen=True, slots=True)
class TenElements:
    """A model of ten elements.

    text: the deck. parameters: YAML, one per line. eigenvalues: (10,), the closed form, (rad/s)^2.
    nodes, component: where shapes are computed. mass: of each of these nodes, 0 for a consistent
    mass.
    """

    suffix: str
    text: str
    parameters: str
    eigenvalues: Floats
    nodes: tuple[int, ...]
    component: int
    mass: float

    def write(self, folder: Path, solver: str, dialect: NastranDialect) -> Path:
        """Write deck and campaign into a folder; returns the campaign file."""
        (folder / f"ten{self.suffix}").write_text(self.text, encoding="utf-8")
        campaign = folder / "campaign.yaml"
        model = f"deck: ten{self.suffix}, solver: {solver}, dialect: {dialect}, units: mm-t-s"
        text = f"name: doctor\nmodel: {{{model}}}\nparameters:\n{self.parameters}{RUN}"
        campaign.write_text(text, encoding="utf-8")
        return campaign


def _beams(kind: str) -> TenElements:
    """The cantilever; kind: of the beams of its outer half, CBAR or CBEAM."""
    nodes = range(1, ELEMENTS + 2)
    half = ELEMENTS // 2
    lines = ["$ ten beams in a row, a mass at each node", "CEND", "SPC = 1", "BEGIN BULK"]
    lines += [f"GRID,{node},,{(node - 1) * SPAN},0.,0." for node in nodes]
    for element in range(1, ELEMENTS + 1):
        name, number = ("CBAR", 1) if element <= half else (kind, 2)
        lines.append(f"{name},{element},{number},{element},{element + 1},0.,1.,0.")
    lines.append(f"PBAR,1,1,{AREA},{I1},{I2},{J}")
    if kind == "CBAR":
        lines.append(f"PBAR,2,2,{AREA},{I1},{I2},{J}")
    else:  # K1 and K2 are zero: no shear
        lines += [f"PBEAM,2,2,{AREA},{I1},{I2},,{J}", ",,,,,,,,", ",0.,0."]
    lines += [f"MAT1,{number},{E},,.3" for number in (1, 2)]
    lines += [f"CONM2,{100 + node},{node},,{MASS}" for node in nodes[1:]]
    held = [nodes[1:half], nodes[half:]]
    lines.append("SPC1,1,123456,1")
    lines += [f"SPC1,1,1345,{','.join(map(str, some))}" for some in held]
    x = SPAN * np.arange(1, ELEMENTS + 1)
    low, high = np.minimum.outer(x, x), np.maximum.outer(x, x)
    flexibility = low**2 * (3.0 * high - low) / (6.0 * E * I1)
    return TenElements(
        ".bdf",
        "\n".join([*lines, "ENDDATA", ""]),
        "  - {name: E_root, quantity: youngs_modulus, material: 1}\n"
        "  - {name: I_tip, quantity: inertia_1, property: 2}\n"
        "  - {name: m_tip, quantity: mass, element: 111}\n",
        np.sort(1.0 / np.linalg.eigvalsh(MASS * flexibility)),
        tuple(nodes[1:]),
        2,
        MASS,
    )


def _bricks() -> TenElements:
    """The bar of bricks of SPAN x 10 x 10 mm; nodes of the section i are 4 i + 1 .. 4 i + 4."""
    corners = ((0, 0), (10, 0), (10, 10), (0, 10))
    lines = ["*NODE, NSET=ALL"]
    for section in range(ELEMENTS + 1):
        lines += [
            f"{4 * section + place}, {section * SPAN}, {y}, {z}"
            for place, (y, z) in enumerate(corners, start=1)
        ]
    half = ELEMENTS // 2
    for name, first in (("ROOT", 1), ("TIP", half + 1)):
        lines.append(f"*ELEMENT, TYPE=C3D8, ELSET={name}")
        for element in range(first, first + half):
            near = range(4 * element - 3, 4 * element + 1)
            lines.append(", ".join(map(str, (element, *near, *(node + 4 for node in near)))))
        lines += [f"*MATERIAL, NAME={name}", f"*ELASTIC\n{E}, 0.", f"*DENSITY\n{RHO}"]
        lines.append(f"*SOLID SECTION, ELSET={name}, MATERIAL={name}")
    lines += ["*BOUNDARY", "1, 1, 1", "2, 1, 1", "3, 1, 1", "4, 1, 1", "ALL, 2, 3"]
    angle = (2 * np.arange(1, ELEMENTS + 1) - 1) * np.pi / (2 * ELEMENTS)
    factor = 6.0 * E / (RHO * SPAN**2)
    return TenElements(
        ".inp",
        "\n".join([*lines, ""]),
        "  - {name: E_root, quantity: youngs_modulus, material: ROOT}\n"
        "  - {name: E_tip, quantity: youngs_modulus, material: TIP}\n"
        "  - {name: rho_tip, quantity: density, material: TIP}\n",
        factor * (1.0 - np.cos(angle)) / (2.0 + np.cos(angle)),
        tuple(range(5, 4 * ELEMENTS + 5)),
        1,
        0.0,
    )


def _chain() -> TenElements:
    lines = ["masses:"]
    lines += [f"  m{number}: {MASS}" for number in range(1, ELEMENTS + 1)]
    lines.append("springs:")
    for number in range(1, ELEMENTS + 1):
        before = f"m{number - 1}" if number > 1 else "ground"
        lines.append(f"  k{number}: {{between: [{before}, m{number}], stiffness: {STIFFNESS}}}")
    angle = (2 * np.arange(1, ELEMENTS + 1) - 1) * np.pi / (4 * ELEMENTS + 2)
    return TenElements(
        ".yaml",
        "\n".join([*lines, ""]),
        "  - {name: k_root, quantity: spring_stiffness, elset: k1}\n"
        "  - {name: k_tip, quantity: spring_stiffness, elset: k10}\n"
        "  - {name: m_tip, quantity: mass, elset: m10}\n",
        4.0 * STIFFNESS / MASS * np.sin(angle) ** 2,
        tuple(range(1, ELEMENTS + 1)),
        1,
        MASS,
    )


#: The model of ten elements for each solver that has one.
MODELS: dict[str, Callable[[], TenElements]] = {
    "calculix": _bricks,
    "mystran": lambda: _beams("CBAR"),
    "nastran": lambda: _beams("CBEAM"),
    "matrices": _chain,
}
