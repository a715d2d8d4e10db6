"""Which entries a parameter moves and in which powers, against matrices of real ccx runs."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.calculix.deck import read_deck
from modetune.adapters.calculix.mesh import read_mesh
from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.solver import AffectedElements, MatrixAnalysis
from modetune.core.parameters import Quantity
from modetune.core.updating.results import MatrixResult
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
from tests.adapters.test_calculix_model import parameter
from tests.adapters.test_solver_contract import run

needs_ccx = pytest.mark.skipif(shutil.which("ccx") is None, reason="ccx is not installed")

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
}  # fmt: skip


@needs_ccx
@pytest.mark.parametrize("name", CASES)
def test_matrices_are_polynomials_within_the_affected_elements(name: str, tmp_path: Path) -> None:
    text, quantity, target, nodes, stiffness, mass = CASES[name]
    path = tmp_path / "model.inp"
    path.write_text(text)
    scaled = parameter(quantity, target)
    solver, every = calculix_solver(path, (scaled,)), read_mesh(read_deck(path)).nodes
    found = solver.deck.affected_elements(scaled)
    assert found is not None
    assert set(found.nodes) == nodes
    assert (found.stiffness, found.mass) == (stiffness, mass)
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
    scaled = parameter(quantity, target)
    return calculix_solver(path, (scaled,)).deck.affected_elements(scaled)


@pytest.mark.parametrize(
    ("text", "quantity", "target"),
    [
        (TWO, "poissons_ratio", "Z"),
        # At 1 both plates share their expanded nodes, at any other value they meet in knots.
        (plate("S4") + strip(2.0), "thickness", "U"),
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
