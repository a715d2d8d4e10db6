"""Displacements from stored matrices, against those that ccx itself prints; run for real."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import linalg, sparse

from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.solver import MatrixAnalysis, ModalAnalysis, Solver
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.modes import Floats
from modetune.core.updating.job_results import ModalResult
from modetune.core.updating.observation import Observation
from tests.adapters.ccx_decks import (
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

pytestmark = needs_ccx

N_MODES = 8
B31 = "301, 4, 301\n302, 301, 302\n303, 302, 303"
LAMINATE = "*SHELL SECTION, ELSET=P, COMPOSITE\n0.5, , A\n1.5, , A\n"
CLAMPED = "*BOUNDARY\n{0},1,6\n{2},1,6\n"
#: On the plane of symmetry y = 0: rotations about x and z are held, and the motion across.
SYMMETRIC = "*BOUNDARY\n1,2,2\n2,2,2\n3,2,2\n4,2,2\n1,4,4\n2,4,4\n3,4,4\n4,4,4\n1,1,3\n4,3,3\n"
AXES = "*NSET, NSET=TURNED\n{}\n*TRANSFORM, NSET=TURNED, TYPE=R\n1., 1., 0., -1., 1., 0.\n"
TIED = "*EQUATION\n3\n16,3,1., 15,3,-0.5,\n12,3,-0.5\n2\n16,2,2., 16,3,-0.6\n"

#: Decks, and the degrees of freedom that are not known there.
DECKS: dict[str, tuple[str, set[tuple[int, int]]]] = {
    "linear shells": (plate("S4"), set()),
    "reduced linear shells": (plate("S4R"), set()),
    "triangles at linear shells": (
        plate("S4") + "*NODE\n101, 40., 0., 0.\n102, 40., 10., 0.\n"
        "*ELEMENT, TYPE=S3, ELSET=P\n101, 4, 101, 8\n102, 8, 101, 102\n",
        set(),
    ),
    "quadratic shells": (plate("S8"), set()),
    "reduced quadratic shells": (plate("S8R"), set()),
    "quadratic triangles": (plate("S6"), set()),
    "laminate": (plate("S8R", section=LAMINATE), set()),
    "clamped linear shells": (plate("S4", held=CLAMPED), set()),
    "clamped quadratic shells": (plate("S8R", held=CLAMPED), set()),
    "half a plate": (plate("S4", held=SYMMETRIC), set()),
    "held rotations take equations": (plate("S4") + "*BOUNDARY\n12,4,4\n", {(12, 2)}),
    "shells at a corner": (plate("S4") + wall((4, 8, 12), 30.0), set()),
    "shells at a tee": (plate("S4") + wall((3, 7, 11), 20.0), set()),
    "a knot with held motion": (plate("S4") + wall((3, 7, 11), 20.0) + "*BOUNDARY\n3,3,3\n", set()),
    "a knot with held rotation": (
        plate("S4") + wall((3, 7, 11), 20.0) + "*BOUNDARY\n7,4,4\n",
        {(7, 1), (7, 2), (7, 3)},
    ),
    "another thickness": (plate("S4") + strip(1.5), set()),
    "the same thickness": (plate("S4") + strip(2.0), set()),
    "beside their nodes": (
        plate("S4", section="*SHELL SECTION, ELSET=P, MATERIAL=A, OFFSET=0.5\n2.\n"),
        set(),
    ),
    "knots beside their nodes": (
        (plate("S4") + strip(1.5)).replace("ELSET=U, MAT", "ELSET=U, OFFSET=0.5, MAT"),
        {(4, 1), (4, 2), (4, 3), (8, 1), (8, 2), (8, 3), (12, 1), (12, 2), (12, 3)},
    ),
    "spring and mass on linear shells": (plate("S4") + attached(12, 11), set()),
    "spring and mass on quadratic shells": (plate("S8R") + attached(29, 26), set()),
    "spring and mass on a knot": (plate("S4") + wall((4, 8, 12), 30.0) + attached(8, 12), set()),
    "shells on C3D8I": (plate("S4") + block("C3D8I"), set()),
    "shells on C3D8": (plate("S4") + block("C3D8"), set()),
    "an equation between shells": (
        plate("S4") + "*EQUATION\n3\n12,3,1., 11,3,-0.5, 8,3,-0.5\n",
        set(),
    ),
    "an equation between quadratic shells": (
        plate("S8R") + "*EQUATION\n3\n29,3,1., 28,3,-0.5, 27,3,-0.5\n",
        set(),
    ),
    "beams at shells": (plate("S4") + beams("B31", B31), set()),
    "reduced beams at shells": (plate("S4") + beams("B31R", B31), set()),
    "quadratic beams at shells": (plate("S4") + beams("B32R", "301, 4, 301, 302"), set()),
    "C3D8I": (bar("C3D8I"), set()),
    "C3D8": (bar("C3D8", bricks=5), set()),
    "C3D8R": (bar("C3D8R", bricks=5), set()),
    "C3D4": (bar("C3D4", bricks=5), set()),
    "C3D10": (bar("C3D10"), set()),
    "equations": (bar("C3D8I") + TIED, set()),
    "a rigid body": (bar("C3D8I") + body("50, 36., 2., 5.\n"), set()),
    "a rigid body with a rotation node": (
        bar("C3D8I") + body("50, 36., 2., 5.\n51, 36., 2., 5.\n", ", ROT NODE=51"),
        set(),
    ),
    "turned axes": (bar("C3D8I") + AXES.format("13, 14"), set()),
    "held in turned axes": (bar("C3D8I") + AXES.format("4, 1, 13"), {(4, 1)}),
}


def solved(matrices: MatrixResult, n_modes: int) -> tuple[Floats, Floats]:
    """Eigenvalues and mass-normalised shapes by LAPACK, also where M and K are singular."""
    stiffness, mass = matrices.stiffness.toarray(), matrices.mass.toarray()
    # Of the size of the lowest eigenvalues here; M phi = mu (K + s M) phi, mu = 1 / (lambda + s).
    shift = 1e9
    inverted, shapes = linalg.eigh(mass, stiffness + shift * mass)
    kept = inverted[::-1][:n_modes]
    return 1.0 / kept - shift, shapes[:, ::-1][:, :n_modes] / np.sqrt(kept)


def both(text: str, folder: Path) -> tuple[Solver, ModalResult, MatrixResult, Observation]:
    path = folder / "model.inp"
    path.write_text(text)
    solver = calculix_solver(path, ())
    modal = run(solver, {}, ModalAnalysis(N_MODES, tuple(solver.deck.summary.node_ids)), folder)
    matrices = run(solver, {}, MatrixAnalysis(), folder)
    assert isinstance(modal, ModalResult)
    assert isinstance(matrices, MatrixResult)
    return (
        solver,
        modal,
        matrices,
        solver.deck.observation(matrices, modal.modes.nodes, modal.modes.components),
    )


@pytest.mark.parametrize("name", DECKS)
def test_displacements_are_those_that_ccx_prints(name: str, tmp_path: Path) -> None:
    text, unknown = DECKS[name]
    solver, modal, matrices, seen = both(text, tmp_path)
    assert solver.deck.summary.matrix_shapes
    names = list(zip(modal.modes.nodes.tolist(), modal.modes.components.tolist(), strict=True))
    assert {names[row] for row in np.flatnonzero(seen.unknown)} == unknown
    eigenvalues, shapes = solved(matrices, N_MODES)
    # ccx prints eigenvalues with eight digits, displacements with seven; rigid modes are noise.
    elastic = slice(modal.n_rigid, None)
    np.testing.assert_allclose(eigenvalues[elastic], modal.eigenvalues[elastic], rtol=1e-6)
    found = seen.matrix @ shapes
    native = np.real(modal.modes.mode_shapes)
    gaps = np.diff(eigenvalues) / eigenvalues[-1] > 1e-3  # shapes of close modes may mix
    alone = np.concatenate([[True], gaps]) & np.concatenate([gaps, [False]])
    alone[: modal.n_rigid] = False
    assert alone.sum() >= 4
    for mode in np.flatnonzero(alone):
        mine, his = found[~seen.unknown, mode], native[~seen.unknown, mode]
        mine = mine * np.sign(mine @ his)
        np.testing.assert_allclose(mine, his, rtol=0.0, atol=2e-6 * np.abs(his).max())
    held = seen.held
    assert np.abs(native[held]).max() <= 1e-12 * np.abs(native).max()  # means of + and -
    assert held.any()  # all decks are held somewhere


def test_ties_that_are_not_followed_are_unknown(tmp_path: Path) -> None:
    # Two bodies without rotation nodes: which numbers ccx gives them depends on what it read.
    second = (
        "*NODE\n60, 5., 5., 4.\n*NSET, NSET=R2\n5, 6, 7, 8\n*RIGID BODY, NSET=R2, REF NODE=60\n"
    )
    _, modal, _, seen = both(bar("C3D8I") + second + body("50, 36., 2., 5.\n"), tmp_path)
    names = list(zip(modal.modes.nodes.tolist(), modal.modes.components.tolist(), strict=True))
    unknown = {names[row][0] for row in np.flatnonzero(seen.unknown)}
    assert unknown == {5, 6, 7, 8, 13, 14, 15, 16}
    tied = tmp_path / "model.inp"
    tied.write_text(bar("C3D8I") + "*TIE\n")
    assert not calculix_solver(tied, ()).deck.summary.matrix_shapes


def test_elements_of_unknown_kinds_are_unknown(tmp_path: Path) -> None:
    path = tmp_path / "model.inp"
    path.write_text(plate("S4").replace("TYPE=S4", "TYPE=M3D4"))
    solver = calculix_solver(path, ())
    assert not solver.deck.summary.matrix_shapes
    nothing, empty = np.zeros(0, dtype=np.int64), sparse.csr_array((0, 0))
    matrices = MatrixResult(empty, empty, nothing, nothing)
    assert solver.deck.observation(matrices, np.array([1]), np.array([1])).unknown.all()
