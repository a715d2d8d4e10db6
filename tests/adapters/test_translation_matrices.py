"""Matrices of translated Nastran decks: affected elements, and displacements; real ccx."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.solver import MatrixAnalysis, ModalAnalysis, Solver
from modetune.adapters.translation.solver import translated_solver
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.parameters import Parameter, Quantity, TargetKind
from modetune.core.updating.job_results import ModalResult
from tests.adapters.calculix.test_observation import solved
from tests.adapters.solved import needs_ccx
from tests.adapters.test_solver_contract import run

pytestmark = needs_ccx

HEAD = "SOL 103\nCEND\nMETHOD = 1\nSPC = 1\nDISP = ALL\nBEGIN BULK\nEIGRL,1,,,8\n"


def deck() -> str:
    """Two plates at a right angle, 2 x 3 shells each, of two materials, the first one clamped.

    Output frames of points 6 and 11 are turned; a rigid element ties point 50, which has a mass,
    to the second plate's end.
    """
    cards = ["CORD2R,5,,0.,0.,0.,0.,0.,1.", "+,1.,1.,0."]
    point = 0
    for row in range(5):
        x, z = (0.01 * row, 0.0) if row < 3 else (0.02, 0.01 * (row - 2))
        for column in range(4):
            point += 1
            turned = 5 if point in (6, 11) else ""
            cards.append(f"GRID,{point},,{x},{0.01 * column},{z},{turned}")
    for row in range(4):
        for column in range(3):
            a = 4 * row + column + 1
            part = 1 if row < 2 else 2
            cards.append(f"CQUAD4,{3 * row + column + 1},{part},{a},{a + 4},{a + 5},{a + 1}")
    return HEAD + "\n".join([
        *cards,
        "MAT1,1,70.E9,,.3,2700.", "MAT1,2,210.E9,,.3,7800.",
        "PSHELL,1,1,.002,1,,1", "PSHELL,2,2,.0015,2,,2",
        "GRID,50,,.02,.015,.03", "RBE2,60,50,123456,17,18,19,20",
        "CONM2,61,50,,.01",
        "SPC1,1,123456,1,2,3,4",
        "ENDDATA",
    ]) + "\n"  # fmt: skip


def parameter(quantity: Quantity, item: int) -> Parameter:
    by: TargetKind = "property" if quantity == "thickness" else "material"
    return Parameter("p", quantity, by, (str(item),), 0.5, 2.0, 0.1)


def solver_of(folder: Path, *parameters: Parameter) -> Solver:
    path = folder / "model.bdf"
    path.write_text(deck())
    return translated_solver(path, parameters)


def matrices_at(solver: Solver, folder: Path, **values: float) -> MatrixResult:
    found = run(solver, values, MatrixAnalysis(), folder)
    assert isinstance(found, MatrixResult)
    return found


def test_displacements_are_in_the_output_frames(tmp_path: Path) -> None:
    solver = solver_of(tmp_path)
    assert solver.deck.summary.matrix_shapes
    modal = run(solver, {}, ModalAnalysis(8, tuple(solver.deck.summary.node_ids)), tmp_path)
    matrices = matrices_at(solver, tmp_path)
    assert isinstance(modal, ModalResult)
    seen = solver.deck.observation(matrices, modal.modes.nodes, modal.modes.components)
    assert not seen.unknown.any()  # points tied by the rigid element too
    eigenvalues, shapes = solved(matrices, 8)
    np.testing.assert_allclose(eigenvalues, modal.eigenvalues, rtol=1e-6)  # printed digits
    found, native = seen.matrix @ shapes, np.real(modal.modes.mode_shapes)
    for mode in range(8):
        mine, his = found[:, mode], native[:, mode]
        mine = mine * np.sign(mine @ his)
        np.testing.assert_allclose(mine, his, rtol=0.0, atol=2e-6 * np.abs(his).max())
    assert np.abs(native[seen.held]).max() <= 1e-12 * np.abs(native).max()


@pytest.mark.parametrize(
    ("quantity", "stiffness", "mass", "powers"),
    [
        ("youngs_modulus", True, False, (1,)),
        ("density", False, True, (1,)),
        ("thickness", True, True, (1, 2, 3)),
    ],
)
def test_affected_elements_are_those_of_the_translation(
    tmp_path: Path, quantity: Quantity, stiffness: bool, mass: bool, powers: tuple[int, ...]
) -> None:
    scaled = parameter(quantity, 2)
    solver = solver_of(tmp_path, scaled)
    found = solver.deck.affected_elements(scaled)
    assert found is not None
    assert (found.stiffness, found.mass, found.powers) == (stiffness, mass, powers)
    # The second plate's points; those of the first it is not joined to stay out.
    assert set(range(9, 21)) | {50} <= found.nodes
    assert not set(range(1, 9)) & found.nodes
    base, other = (matrices_at(solver, tmp_path, p=value) for value in (1.0, 1.3))
    for kind, moves in (("stiffness", stiffness), ("mass", mass)):
        one, two = getattr(base, kind).toarray(), getattr(other, kind).toarray()
        size = np.sqrt(np.outer(np.diag(one), np.diag(one)))
        changed = np.abs(one - two) > 1e-12 * size  # the text has 14 digits
        assert changed.any() == moves
        touched = set(base.nodes[changed.any(axis=1)].tolist())
        assert {node for node in touched if node <= 20} <= found.nodes


@pytest.mark.parametrize("quantity", ["poissons_ratio", "shear_modulus"])
def test_no_polynomial_no_affected_elements(tmp_path: Path, quantity: Quantity) -> None:
    scaled = parameter(quantity, 2)
    assert solver_of(tmp_path, scaled).deck.affected_elements(scaled) is None


def frame(element: str, sections: str) -> str:
    """A portal of three bars with two materials; its beam is the second part."""
    rows = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.6), (0.0, 0.0, 1.2))
    points = (*rows, (0.9, 0.1, 1.3), (1.8, 0.0, 1.2), (1.8, 0.0, 0.0))
    cards = [f"GRID,{n},,{x},{y},{z}" for n, (x, y, z) in enumerate(points, start=1)]
    for n, part in enumerate((1, 1, 2, 2, 1), start=1):
        cards.append(element.format(n=n, part=part, a=n, b=n + 1))
    return HEAD + "\n".join([
        *cards, sections, "MAT1,1,70.E9,,.3,2700.", "MAT1,2,210.E9,,.3,7800.",
        "SPC1,1,123456,1,6", "ENDDATA",
    ]) + "\n"  # fmt: skip


@pytest.mark.parametrize(
    ("element", "sections"),
    [
        ("CBAR,{n},{part},{a},{b},0.,1.,0.",
         "PBAR,1,1,4.-4,3.-8,2.-8,4.-8\nPBAR,2,2,3.-4,2.-8,2.-8,3.-8"),
        ("CBEAM,{n},{part},{a},{b},0.,1.,0.",  # with shear strains and non-structural mass
         "PBEAM,1,1,4.-4,3.-8,2.-8,,4.-8,.05\nPBEAM,2,2,3.-4,2.-8,2.-8,5.-9,3.-8"),
        ("CBEAM,{n},{part},{a},{b},0.,1.,0.\n,,,.02,0.,.01,.02,0.,.01",  # offset channels
         "PBEAML,1,1,,CHAN\n,.06,.08,.004,.005\nPBEAML,2,2,,TUBE\n,.03,.027"),
    ],
    ids=["bars", "beams", "offset"],
)  # fmt: skip
def test_the_stiffness_of_beams_is_linear_in_their_modulus(
    tmp_path: Path, element: str, sections: str
) -> None:
    scaled = parameter("youngs_modulus", 2)
    path = tmp_path / "model.bdf"
    path.write_text(frame(element, sections))
    solver = translated_solver(path, (scaled,))
    found = solver.deck.affected_elements(scaled)
    assert found is not None
    assert (found.stiffness, found.mass, found.powers) == (True, False, (1,))
    half, whole, more = (matrices_at(solver, tmp_path, p=value) for value in (0.5, 1.0, 1.3))
    one, two = half.stiffness.toarray(), whole.stiffness.toarray()
    size = np.sqrt(np.abs(np.outer(np.diag(two), np.diag(two))))
    foreseen = one + (1.3 - 0.5) / 0.5 * (two - one)
    assert (np.abs(more.stiffness.toarray() - foreseen) <= 1e-12 * size).all()  # 14 digits
    assert np.array_equal(whole.mass.toarray(), more.mass.toarray())
