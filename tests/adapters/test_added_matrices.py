"""Components as DMIG (K2GG, M2GG) in CalculiX, against NumPy and against their meshes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy import linalg

from modetune.adapters.matrices.dmig import dmig_lines
from modetune.adapters.nastran.solver import mystran_solver
from modetune.adapters.translation.solver import translated_solver
from modetune.core.errors import ModelError
from modetune.core.modes import Floats
from tests.adapters.solved import needs_ccx, solved

#: ccx prints seven digits.
PRINTED = 1e-6
HEAD = "SOL 103\nCEND\nMETHOD = 1\nSPC = 1\nK2GG = KAAX\nM2GG = MAAX\nBEGIN BULK\nEIGRL,1,,,6\n"
#: E A, G J, E I about z and y, mass of a metre: of one bar along x.
AXIAL, TORSION, BENDING_Z, BENDING_Y, LINE_MASS = 2.1e7, 4.2e3, 6.3e3, 1.05e4, 0.78
BAR = "MAT1,1,2.1+11,8.+10,,7800.\nPBAR,1,1,1.-4,3.-8,5.-8,5.25-8\n"


def bar(length: float) -> Floats:
    """Stiffness of a bar along x by Euler and Bernoulli, (12, 12)."""
    k = np.zeros((12, 12))
    for stiffness, row in ((AXIAL / length, 0), (TORSION / length, 3)):
        k[np.ix_([row, row + 6], [row, row + 6])] += stiffness * np.array([[1, -1], [-1, 1]])
    # In the plane xy rotation z is the slope; in xz rotation y is its opposite.
    for bending, rows, sign in ((BENDING_Z, [1, 5, 7, 11], 1.0), (BENDING_Y, [2, 4, 8, 10], -1.0)):
        a, b = 6.0 * sign * length, length**2
        k[np.ix_(rows, rows)] += (
            bending
            / length**3
            * np.array(
                [[12, a, -12, a], [a, 4 * b, -a, 2 * b], [-12, -a, 12, -a], [a, 2 * b, -a, 4 * b]]
            )
        )
    return k


def bars(count: int, length: float) -> tuple[Floats, Floats]:
    """Stiffness and lumped mass of a line of bars, free, (6 count + 6,) squared."""
    size = 6 * count + 6
    stiffness, mass = np.zeros((size, size)), np.zeros((size, size))
    for element in range(count):
        rows = slice(6 * element, 6 * element + 12)
        stiffness[rows, rows] += bar(length)
        for row in (*range(6 * element, 6 * element + 3), *range(6 * element + 6, 6 * element + 9)):
            mass[row, row] += LINE_MASS * length / 2.0
    return stiffness, mass


def dmig(stiffness: Floats, mass: Floats, names: Sequence[tuple[int, int]]) -> str:
    return "\n".join([*dmig_lines("KAAX", stiffness, names), *dmig_lines("MAAX", mass, names), ""])


def six(points: Sequence[int]) -> list[tuple[int, int]]:
    return [(point, component) for point in points for component in range(1, 7)]


def line(points: int) -> str:
    return "".join(f"GRID,{n},,{0.4 * (n - 1):.1f},0.,0.\n" for n in range(1, points + 1))


def cbars(elements: Sequence[int]) -> str:
    return "".join(f"CBAR,{n},1,{n},{n + 1},0.,1.,0.\n" for n in elements)


@needs_ccx
def test_half_a_cantilever_as_matrices_has_the_modes_of_the_mesh(tmp_path: Path) -> None:
    held, (own, mass) = "SPC1,1,123456,1\n", bars(3, 0.4)
    text = line(7) + BAR + held
    found = solved(HEAD + text + cbars(range(1, 4)) + dmig(own, mass, six(range(4, 8))),
                   tmp_path, translated_solver)  # fmt: skip
    (tmp_path / "mesh").mkdir()
    head = HEAD.replace("K2GG = KAAX\nM2GG = MAAX\n", "")
    mesh = solved(head + text + cbars(range(1, 7)), tmp_path / "mesh", translated_solver)
    stiffness, masses = bars(6, 0.4)
    free = slice(6, None)
    expected = massless(stiffness[free, free], masses[free, free])[:6]
    assert found.eigenvalues == pytest.approx(mesh.eigenvalues, rel=PRINTED)
    assert found.eigenvalues == pytest.approx(expected, rel=1e-5)


def massless(stiffness: Floats, mass: Floats) -> Floats:
    """Eigenvalues without those of freedoms that have no mass."""
    heavy = np.diag(mass) > 0.0
    light = ~heavy
    rest = linalg.solve(stiffness[np.ix_(light, light)], stiffness[np.ix_(light, heavy)])
    reduced = stiffness[np.ix_(heavy, heavy)] - stiffness[np.ix_(heavy, light)] @ rest
    return np.asarray(linalg.eigh(reduced, mass[np.ix_(heavy, heavy)], eigvals_only=True))


@needs_ccx
def test_a_craig_bampton_component_keeps_its_modes_on_scalar_points(tmp_path: Path) -> None:
    # The bar from 1 to 7 with 1 and 7 kept, all fixed-interface modes: the modes of the whole bar.
    stiffness, mass = bars(6, 0.4)
    mass += np.diag(np.tile([0.0, 0.0, 0.0, 2e-3, 3e-3, 4e-3], 7))
    kept, inner = [*range(6), *range(36, 42)], list(range(6, 36))
    static = -linalg.solve(stiffness[np.ix_(inner, inner)], stiffness[np.ix_(inner, kept)])
    _, shapes = linalg.eigh(stiffness[np.ix_(inner, inner)], mass[np.ix_(inner, inner)])
    basis = np.zeros((42, 42))
    basis[kept, :12], basis[np.ix_(inner, range(12))] = np.eye(12), static
    basis[np.ix_(inner, range(12, 42))] = shapes
    names = [*six([1, 7]), *((900 + n, 0) for n in range(30))]
    small, light = (basis.T @ matrix @ basis for matrix in (stiffness, mass))
    points = "GRID,1,,0.,0.,0.\nGRID,7,,2.4,0.,0.\nSPOINT,900,THRU,929\nSPC1,1,123456,1\n"
    tip = "CONM2,50,7,,1.5\n,.01,,.01,,,.01\n"
    found = solved(HEAD + points + tip + dmig(small, light, names), tmp_path, translated_solver)
    mass[36:, 36:] += np.diag([1.5, 1.5, 1.5, 0.01, 0.01, 0.01])
    expected = linalg.eigh(stiffness[6:, 6:], mass[6:, 6:], eigvals_only=True)[:6]
    assert found.eigenvalues == pytest.approx(expected, rel=1e-5)


@needs_ccx
def test_matrices_are_summed_with_factors_and_wtmass_leaves_them_alone(tmp_path: Path) -> None:
    random = np.random.default_rng(5)
    half = random.normal(size=(6, 6)) + 4.0 * np.eye(6)
    stiffness, mass = 1e4 * half @ half.T, np.diag([2.0, 2.0, 2.0, 0.5, 0.6, 0.7])
    mass[0, 4] = mass[4, 0] = 0.2
    names = six([1])
    terms = [*dmig_lines("KA", stiffness, names), *dmig_lines("KB", np.eye(6) * 3e4, names)]
    terms += dmig_lines("MA", mass, names)
    head = HEAD.replace("K2GG = KAAX", "K2GG = 1.5*KA, KB").replace("M2GG = MAAX", "M2GG=2.*MA")
    text = head.replace("SPC = 1\n", "") + "PARAM,WTMASS,.01\nGRID,1,,0.,0.,0.\nCONM2,9,1,,100.\n"
    found = solved(text + "\n".join([*terms, ""]), tmp_path, translated_solver)
    masses = 2.0 * mass + np.diag([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    expected = linalg.eigh(1.5 * stiffness + 3e4 * np.eye(6), masses, eigvals_only=True)
    assert found.eigenvalues == pytest.approx(expected, rel=PRINTED)


@needs_ccx
def test_matrices_of_dynamic_response_and_damping_change_no_modes(tmp_path: Path) -> None:
    body = "GRID,1,,0.,0.,0.\nCONM2,9,1,,2.\n,3.,,4.,,,5.\n"
    springs = "".join(f"CELAS2,2{c},500.,1,{c}\n" for c in range(1, 7))
    terms = "\n".join([*dmig_lines("KAAX", 1e6 * np.eye(6), six([1])), ""])
    head = HEAD.replace("SPC = 1\n", "").replace("M2GG = MAAX", "K42GG = KAAX\nB2PP = KAAX")
    text = head.replace("K2GG", "K2PP") + body + springs + terms
    found = solved(text, tmp_path, translated_solver)
    expected = sorted(500.0 / mass for mass in (2.0, 2.0, 2.0, 3.0, 4.0, 5.0))
    assert found.eigenvalues == pytest.approx(expected, rel=PRINTED)


def test_mystran_refuses_added_matrices_and_takes_those_of_nothing(tmp_path: Path) -> None:
    path = tmp_path / "model.bdf"
    stiffness, mass = bars(3, 0.4)
    text = HEAD + line(7) + BAR + "SPC1,1,123456,1\n" + cbars(range(1, 7))
    text += dmig(stiffness, mass, six(range(4, 8)))
    path.write_text(text)
    with pytest.raises(ModelError, match=r"MYSTRAN has no K2GG and M2GG .* `solver: calculix`"):
        mystran_solver(path, ())
    path.write_text(text.replace("K2GG = KAAX\nM2GG = MAAX\n", ""))
    mystran_solver(path, ())


@pytest.mark.parametrize(
    ("case", "said"),
    [("M2GG = NONE", "M2GG = NONE: this DMIG is not there"), ("M2GG = X*MAAX", "'X' is no factor")],
)
def test_a_selection_of_nothing_is_refused(case: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "model.bdf"
    stiffness, mass = bars(3, 0.4)
    text = HEAD.replace("M2GG = MAAX", case) + line(7) + BAR + "SPC1,1,123456,1\n"
    path.write_text(text + cbars(range(1, 7)) + dmig(stiffness, mass, six(range(4, 8))))
    with pytest.raises(ModelError, match=said):
        translated_solver(path, ())
