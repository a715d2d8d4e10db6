"""Which entries a parameter moves and in which powers, against matrices of real ccx runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.calculix.deck import read_deck
from modetune.adapters.calculix.mesh import read_mesh
from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.solver import AffectedElements, MatrixAnalysis
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.parameters import Quantity
from tests.adapters.calculix.test_model import parameter
from tests.adapters.ccx_decks import (
    MATERIAL,
    attached,
    bar,
    beams,
    block,
    body,
    plate,
    strip,
    wall,
)
from tests.adapters.solved import needs_ccx
from tests.adapters.test_solver_contract import run

OTHER = MATERIAL.replace("NAME=A", "NAME=Z")
#: A plate on which a wall of another material stands at its end x = 30, a spring and a mass.
TWO = (
    plate("S4")
    + OTHER
    + wall((4, 8, 12), 30.0).replace("MATERIAL=A", "MATERIAL=Z")
    + attached(110, 111)
)
WALL = {4, 8, 12, 100, 101, 102, 110, 111, 112}
BLOCKS = plate("S4") + OTHER + block("C3D8I").replace("MATERIAL=A", "MATERIAL=Z")
BEAM = beams("B31", "301, 4, 301\n302, 301, 302\n303, 302, 303").replace("MATERIAL=A", "MATERIAL=Z")
BEAMS = plate("S4") + OTHER + BEAM
#: A wall of plies on springs, with masses: engineering constants, axes of its own.
PLIES = (
    "*MATERIAL, NAME=A\n*ELASTIC, TYPE=ENGINEERING CONSTANTS\n"
    "130000., 9000., 9500., .3, .28, .4, 5000., 4800.\n3300.\n*DENSITY\n1.6e-9\n"
    "*ORIENTATION, NAME=O1\n1., 0., 0., 0., 1., 0.\n3, 30.\n"
    "*ORIENTATION, NAME=O2\n1., 0., 0., 0., 1., 0.\n3, -45.\n"
)
ORTHOTROPIC = (
    bar("C3D8I", held="")
    .replace(MATERIAL, PLIES)
    .replace("MATERIAL=A\n", "MATERIAL=A, ORIENTATION=O1\n")
    + attached(1, 16)
    + attached(4, 13).replace("ET=K", "ET=L").replace("ET=M", "ET=N").replace("20", "30")
)
#: The same elements of a D-matrix.
D_MATRIX = ORTHOTROPIC.replace(
    PLIES[: PLIES.index("*DENSITY")],
    "*MATERIAL, NAME=A\n*ELASTIC, TYPE=ANISO\n"
    "90000., 30000., 80000., 20000., 25000., 70000., 900., 800.\n"
    "700., 20000., 600., 500., 400., 300., 21000., 200.\n100., 90., 80., 70., 22000.\n",
)
LAMINATE = plate(
    "S8R", section="*SHELL SECTION, ELSET=P, COMPOSITE\n1., , A, O1\n.5, , A, O2\n"
).replace(MATERIAL, PLIES)
BLOCK = set(range(1, 17))
#: Two beams at an angle, a spring and a mass at their ends.
FRAME = beams("B31", "301, 301, 302\n302, 302, 303") + MATERIAL + attached(301, 303)
CURVED = beams("B32R", "301, 301, 302, 303") + MATERIAL
Case = tuple[str, Quantity, str, set[int], bool, bool]
CASES: dict[str, Case] = {
    "modulus": (TWO, "youngs_modulus", "Z", WALL, True, False),
    "density": (TWO, "density", "Z", WALL, False, True),
    "thickness": (TWO, "thickness", "U", WALL, True, True),
    "thickness of the foot": (TWO, "thickness", "P", set(range(1, 13)), True, True),
    "spring": (TWO, "spring_stiffness", "K", {110}, True, False),
    "mass": (TWO, "mass", "M", {111}, False, True),
    "modulus of solids under shells": (
        BLOCKS, "youngs_modulus", "Z", {4, 8, 12, *range(100, 103), *range(110, 113),
                                       *range(120, 123)}, True, False),
    "density of solids under shells": (
        BLOCKS, "density", "Z", {4, 8, 12, *range(100, 103), *range(110, 113),
                                 *range(120, 123)}, False, True),
    "modulus of beams": (BEAMS, "youngs_modulus", "Z", {4, 301, 302, 303}, True, False),
    "thickness beside another": (
        plate("S4") + strip(1.5), "thickness", "U", {4, 8, 12, 100, 101, 102}, True, True),
    "thickness of quadratic shells": (
        plate("S8R"), "thickness", "P", set(range(1, 30)), True, True),
    "mass on a rigid body": (
        bar("C3D8I") + body("50, 36., 2., 5.\n"), "mass", "M", {*range(13, 17), 50}, False, True),
    "shells tied by equations": (
        plate("S4") + attached(12, 11) + "*EQUATION\n2\n12,3,1., 10,3,-0.5\n2\n10,1,1., 5,1,-0.5\n",
        "spring_stiffness", "K", {12, 10, 5}, True, False),
    "all moduli": (ORTHOTROPIC, "youngs_modulus", "A", BLOCK, True, False),
    "shear modulus, 23": (ORTHOTROPIC, "shear_modulus", "A", BLOCK, True, False),
    "density of plies": (ORTHOTROPIC, "density", "A", BLOCK, False, True),
    "D-matrix": (D_MATRIX, "youngs_modulus", "A", BLOCK, True, False),
    "D-matrix, 1122": (D_MATRIX, "youngs_modulus", "A", BLOCK, True, False),
    "D-matrix, 1323": (D_MATRIX, "youngs_modulus", "A", BLOCK, True, False),
    "all layers": (LAMINATE, "thickness", "P", set(range(1, 30)), True, True),
    "moduli of layers": (LAMINATE, "youngs_modulus", "A", set(range(1, 30)), True, False),
    "shear modulus of layers, 12": (LAMINATE, "shear_modulus", "A", set(range(1, 30)), True, False),
    "width of a frame, 1": (FRAME, "dimension", "B", {301, 302, 303}, True, True),
    "height of a beam, 2": (
        beams("B32R", "301, 301, 302, 303").replace("303, 60., 0., 5.", "303, 60., 0., 0.")
        + MATERIAL, "dimension", "B", {301, 302, 303}, True, True),
}  # fmt: skip
#: Cases in which the stiffness of the elements is proportional to the parameter.
PROPORTIONAL = {"all moduli", "D-matrix"}


@needs_ccx
@pytest.mark.parametrize("name", CASES)
def test_matrices_are_polynomials_within_the_affected_elements(name: str, tmp_path: Path) -> None:
    text, quantity, target, nodes, stiffness, mass = CASES[name]
    path = tmp_path / "model.inp"
    path.write_text(text)
    item = int(name.rpartition(", ")[2]) if ", " in name else 0
    scaled = replace(parameter(quantity, target), item=item)
    solver, every = calculix_solver(path, (scaled,)), read_mesh(read_deck(path)).nodes
    found = solver.deck.affected_elements(scaled)
    assert found is not None
    assert set(found.nodes) == nodes
    assert (found.stiffness, found.mass) == (stiffness, mass)
    if text in (ORTHOTROPIC, D_MATRIX, LAMINATE):
        assert found.proportional == (name in PROPORTIONAL)
    powers = (0, *found.powers)
    # As many samples as there are powers, over the range of an updating campaign, and one between.
    at = [*np.linspace(0.6, 1.6, len(powers)), 1.07]
    results = []
    for value in at:
        result = run(solver, {"p": value}, MatrixAnalysis(), tmp_path)
        assert isinstance(result, MatrixResult)
        results.append(result)
    fit = np.linalg.solve(
        np.array([[value**power for power in powers] for value in at[:-1]]),
        np.eye(len(powers)),
    )
    weights = np.array([at[-1] ** power for power in powers]) @ fit
    for kind, moves in (("stiffness", stiffness), ("mass", mass)):
        matrices = [getattr(result, kind).toarray() for result in results]
        size = np.sqrt(np.outer(np.diag(matrices[-1]), np.diag(matrices[-1])))
        # The text has 14 digits; what entries of other rows show beyond is not a change.
        changed = np.abs(matrices[0] - matrices[-1]) > 1e-12 * size
        assert changed.any() == moves
        rows = np.flatnonzero(changed.any(axis=1))
        names = {int(node) for node in results[0].nodes[rows] if node in every}
        assert names <= found.nodes
        expected = sum(
            weight * matrix for weight, matrix in zip(weights, matrices[:-1], strict=True)
        )
        np.testing.assert_allclose(expected / size, matrices[-1] / size, rtol=0.0, atol=1e-11)


def affected_elements(
    folder: Path, text: str, quantity: Quantity, target: str
) -> AffectedElements | None:
    path = folder / "model.inp"
    path.write_text(text)
    item = text in (BEAMS, LAMINATE, ORTHOTROPIC) or "B32R" in text
    scaled = replace(parameter(quantity, target), item=int(item))
    return calculix_solver(path, (scaled,)).deck.affected_elements(scaled)


@pytest.mark.parametrize(
    ("text", "quantity", "target"),
    [
        (TWO, "poissons_ratio", "Z"),
        # At 1 both plates share their expanded nodes, at any other value they meet in knots.
        (plate("S4") + strip(2.0), "thickness", "U"),
        # A beam that meets shells; a curved one; a pipe, which is integrated in parts.
        (BEAMS, "dimension", "B"),
        (CURVED, "dimension", "B"),
        (CURVED.replace("0., 5.", "0., 0.").replace("RECT", "PIPE"), "dimension", "B"),
        # One layer of two: where the other lies depends on it.
        (LAMINATE, "thickness", "P"),
        # One of several coupled moduli.
        (ORTHOTROPIC, "youngs_modulus", "A"),
        # What the preload does to the stiffness depends on the stiffness.
        (
            bar("C3D8I")
            + "*STEP\n*STATIC\n*END STEP\n*STEP, PERTURBATION\n*FREQUENCY\n5\n*END STEP\n",
            "youngs_modulus",
            "A",
        ),
        (
            plate("S4") + strip(2.0).replace("MATERIAL=A", "MATERIAL=A, NODAL THICKNESS"),
            "thickness",
            "P",
        ),
    ],
)
def test_no_polynomial_no_affected_elements(
    tmp_path: Path, text: str, quantity: Quantity, target: str
) -> None:
    assert affected_elements(tmp_path, text, quantity, target) is None


def test_ties_that_are_not_followed_may_touch_all_nodes(tmp_path: Path) -> None:
    found = affected_elements(
        tmp_path, bar("C3D8I") + body("50, 1., 1., 1.\n") + "*TIE\n", "mass", "M"
    )
    assert found is not None
    assert found.nodes == {*range(1, 17), 50}


def test_equal_thickness_at_an_angle_is_a_knot_anyway(tmp_path: Path) -> None:
    text = plate("S4") + wall((4, 8, 12), 30.0, thickness=2.0)
    assert affected_elements(tmp_path, text, "thickness", "U") is not None
