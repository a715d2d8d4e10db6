"""GENEL, K2GG, CBUSH1D and old OFFT in CalculiX, against closed forms and elements they stand for.

MYSTRAN has none of the first three.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import linalg

from modetune.adapters.translation.solver import translated_solver
from modetune.core.errors import ModelError
from modetune.core.modes import Floats
from tests.adapters.solved import HEAD, Binder, needs_ccx, on_both, solved

#: ccx prints seven digits.
PRINTED = 1e-6
#: A body of mass 2 and inertias 3, 4, 5 at grid point 2, and a held one at a lever from it.
BODY = "GRID,1,,0.,0.,0.,,123456\nGRID,2,,.5,.2,-.3\nCONM2,9,2,,2.\n,3.,,4.,,,5.\nSPC1,1,123456,1\n"
MASSES = np.diag([2.0, 2.0, 2.0, 3.0, 4.0, 5.0])
#: A stiffness with couplings, positive definite by its dominant diagonal.
STIFFNESS = 1e3 * (
    np.diag([8.0, 9.0, 10.0, 11.0, 12.0, 13.0])
    + np.add.outer(np.arange(6), np.arange(6)) / 10.0 * (1.0 - np.eye(6))
)


def continued(first: str, words: list[str]) -> str:
    """Free-field lines of a card that begin with a word in the first field."""
    words = [first, *words]
    return "".join("," + ",".join(words[i : i + 8]) + "\n" for i in range(0, len(words), 8))


def upper(matrix: Floats) -> list[str]:
    return [f"{value:.15g}" if value % 1 else f"{value:.1f}" for value in
            matrix[np.triu_indices(len(matrix))]]  # fmt: skip


def general(kind: str, matrix: Floats, support: str = "") -> str:
    """A GENEL of grid point 2."""
    ul = [word for c in range(1, 7) for word in ("2", str(c))]
    lines = f"GENEL,50,,{','.join(ul[:6])}\n" + "," + ",".join(ul[6:]) + "\n"
    return lines + support + continued(kind, upper(matrix))


@needs_ccx
@pytest.mark.parametrize("kind", ["K", "Z"])
def test_a_general_element_is_its_matrix(kind: str, tmp_path: Path) -> None:
    matrix = STIFFNESS if kind == "K" else linalg.inv(STIFFNESS)
    found = solved(BODY + general(kind, matrix), tmp_path, translated_solver)
    expected = linalg.eigh(STIFFNESS, MASSES, eigvals_only=True)
    assert found.eigenvalues == pytest.approx(expected, rel=PRINTED)


@needs_ccx
def test_a_general_element_between_points_leaves_six_rigid_modes(tmp_path: Path) -> None:
    # S is the rigid motion of point 1, which is free here and has a body of its own.
    support = ",UD,,1,1,1,2,1,3\n,1,4,1,5,1,6\n"
    free = BODY.replace(",,123456", "").replace(
        "SPC1,1,123456,1\n", "CONM2,8,1,,1.\n,1.,,1.,,,1.\n"
    )
    found = solved(free + general("K", STIFFNESS, support), tmp_path, translated_solver, 12)
    arm = np.array([0.5, 0.2, -0.3])
    lever = np.eye(6)
    lever[:3, 3:] = np.array([[0, arm[2], -arm[1]], [-arm[2], 0, arm[0]], [arm[1], -arm[0], 0]])
    relative = np.hstack([-lever, np.eye(6)])
    masses = linalg.block_diag(np.eye(6), MASSES)
    expected = linalg.eigh(relative.T @ STIFFNESS @ relative, masses, eigvals_only=True)
    assert found.eigenvalues[6:] == pytest.approx(expected[6:], rel=PRINTED)
    assert np.abs(found.eigenvalues[:6]).max() < PRINTED * expected[6]


@needs_ccx
def test_k2gg_adds_its_matrix(tmp_path: Path) -> None:
    columns = "".join(
        f"DMIG,KX,2,{j + 1},,2,{i + 1},{STIFFNESS[i, j]:.8g}\n".replace("e+", "+")
        if "." in f"{STIFFNESS[i, j]:.8g}"
        else f"DMIG,KX,2,{j + 1},,2,{i + 1},{STIFFNESS[i, j]:.1f}\n"
        for j in range(6)
        for i in range(j, 6)
    )
    head = HEAD.replace("METHOD", "K2GG = KX\nMETHOD")
    springs = "".join(f"CELAS2,2{c},500.,2,{c}\n" for c in range(1, 7))
    text = head + BODY + springs + "DMIG,KX,0,6,2,0\n" + columns
    found = solved(text, tmp_path, translated_solver)
    expected = linalg.eigh(STIFFNESS + 500.0 * np.eye(6), MASSES, eigvals_only=True)
    assert found.eigenvalues == pytest.approx(expected, rel=PRINTED)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("GENEL,50,,2,1,2,2\n,K,1.,2.\n", "requires 3 numbers"),
        ("GENEL,50,,2,1\n,UD,,1,1\n,K,1.\n", "six freedoms"),
        ("GENEL,50,,2,1,2,2\n,Z,1.,1.,1.\n", "no inverse"),
        ("PBUSH1D,7,1.,,3.\nCBUSH1D,51,7,1,2\n", "CONM2"),
        ("PBUSH1D,7,1.\nCBUSH1D,51,7,2\n", "needs a CID"),
        ("PBUSH1D,7,1.\nCBUSH1D,51,7,1,2,0\n", "not along the line"),
        ("BOLT,7,3\n,TOP,1\n,BOTTOM,2\n", "BOLT joins"),
    ],
)
def test_what_is_wrong_with_them_is_said(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "model.bdf"
    path.write_text(HEAD + BODY + text)
    with pytest.raises(ModelError, match=said):
        translated_solver(path, ())


@pytest.mark.parametrize(("name", "form"), [("KY", 6), ("KX", 1)])
def test_a_matrix_that_is_no_stiffness_is_refused(name: str, form: int, tmp_path: Path) -> None:
    head = HEAD.replace("METHOD", f"K2GG = {name}\nMETHOD")
    path = tmp_path / "model.bdf"
    path.write_text(head + BODY + f"DMIG,KX,0,{form},2,0\nDMIG,KX,2,1,,2,1,1.\n")
    with pytest.raises(ModelError, match=f"K2GG = {name}"):
        translated_solver(path, ())


@needs_ccx
@pytest.mark.parametrize("cid", ["", "5"])
def test_a_line_bush_is_a_spring_along_its_line(cid: str, tmp_path: Path) -> None:
    # x of system 5 is along (3, 4, 0); the body moves along x alone: k cos^2 / m.
    text = (
        "CORD2R,5,,0.,0.,0.,0.,0.,1.\n,3.,4.,0.\n"
        "GRID,1,,0.,0.,0.,,123456\nGRID,2,,.6,.8,0.,,23456\nCONM2,9,2,,2.\n"
        f"PBUSH1D,7,1000.,9.\nCBUSH1D,51,7,1,2,{cid}\n"
        "GRID,3,,6.,0.,0.,,23456\nCONM2,10,3,,2.\nCBUSH1D,52,7,3,,5\n"
    )
    found = solved(text, tmp_path, translated_solver, 2)
    assert found.eigenvalues == pytest.approx([180.0, 180.0], rel=PRINTED)


@on_both
def test_old_flags_of_the_orientation_change_nothing(binder: Binder, tmp_path: Path) -> None:
    text = (
        "GRID,1,,0.,0.,0.,,123456\nGRID,2,,1.,0.,0.\nGRID,3,,0.,1.,0.,,123456\n"
        "CONM2,9,2,,2.\n,.1,,.2,,,.3\nMAT1,1,1.+7,,.3\nPBAR,1,1,1.-2,2.-5,1.-5,3.-5\n"
    )
    bars = {"new": "0.,1.,0.", "vector": "0.,1.,0.,1", "point": "3,,,2"}
    found = []
    for name, end in bars.items():
        (tmp_path / name).mkdir()
        found.append(solved(f"{text}CBAR,1,1,1,2,{end}\n", tmp_path / name, binder).eigenvalues)
    assert found[1] == pytest.approx(found[0], rel=PRINTED)
    assert found[2] == pytest.approx(found[0], rel=PRINTED)


@needs_ccx
def test_a_pin_on_a_bar_without_that_stiffness_releases_nothing(tmp_path: Path) -> None:
    # Without I1 the bar holds its tip along x and z; the pins name rotation about z.
    text = (
        "GRID,1,,0.,0.,0.,,123456\nGRID,2,,1.,0.,0.,,2456\nCONM2,9,2,,2.\nMAT1,1,1.+7,,.3\n"
        "PBAR,1,1,1.-2,,1.-5,3.-5\nCBAR,1,1,1,2,0.,1.,0.\n,6,6\n"
    )
    found = solved(text, tmp_path, translated_solver, 2)
    # 12 E I2 / L^3 / m, for the tip's rotation is held, and E A / L / m.
    assert found.eigenvalues == pytest.approx([12.0 * 100.0 / 2.0, 1e5 / 2.0], rel=PRINTED)
