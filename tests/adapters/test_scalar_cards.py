"""Scalar points, springs and masses on MYSTRAN and CalculiX against closed forms."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import linalg

from modetune.adapters.translation.solver import translated_solver
from modetune.core.modes import Floats
from tests.adapters.solved import HEAD, Binder, needs_ccx, on_both, solved

#: Both solvers print seven digits.
PRINTED = 1e-6


def eigenvalues(stiffness: Any, mass: Any) -> Floats:
    return np.asarray(linalg.eigh(stiffness, mass, eigvals_only=True))


@on_both
@pytest.mark.parametrize("frame", ["", "5"], ids=["basic", "turned"])
def test_scalar_masses_act_along_one_component_of_the_output_frame(
    frame: str, binder: Binder, tmp_path: Path
) -> None:
    text = (
        "CORD2R,5,,0.,0.,0.,0.,0.,1.\n,1.,1.,0.\n"
        f"GRID,1,,1.,0.,0.,{frame},456\n"
        "PELAS,1,1000.,,,2,2000.\nCELAS1,1,1,1,1\nCELAS1,2,2,1,2\nCELAS2,3,3000.,1,3\n"
        "PMASS,7,1.,8,2.\nCMASS1,11,7,1,1\nCMASS1,12,8,1,2\nCMASS2,13,4.,1,3\n"
    )
    found = solved(text, tmp_path, binder)
    # All modes of the model, though three are fewer than a Lanczos solver wants.
    assert found.eigenvalues == pytest.approx([750.0, 1000.0, 1000.0], rel=PRINTED)


@on_both
def test_scalar_masses_and_springs_turn_too(binder: Binder, tmp_path: Path) -> None:
    text = "GRID,1,,1.,0.,0.,,123\n" + "".join(
        f"CELAS2,{c},1000.,1,{c}\nCMASS2,1{c},{2.0 ** (c - 4)},1,{c}\n" for c in (4, 5, 6)
    )
    found = solved(text, tmp_path, binder)
    assert found.eigenvalues == pytest.approx([250.0, 500.0, 1000.0], rel=PRINTED)


@on_both
def test_a_drive_train_of_scalar_points_and_a_gear(binder: Binder, tmp_path: Path) -> None:
    # Engine 1 - shaft - gear 2, which turns gear 3 by -1/2.5; shaft - propeller 4; a mount to
    # ground. Points 3 and 4 are named by elements alone. The grid point is the engine's block.
    text = (
        HEAD.replace("METHOD", "SPC = 9\nMPC = 4\nMETHOD") + "SPOINT,1,2\n"
        "PELAS,5,4.E4,,,6,900.\nPMASS,5,1.2,6,.05,7,.3,8,2.\n"
        "CELAS3,21,5,1,2\nCELAS3,22,6,3,4\nCELAS1,23,6,1\n"
        "CMASS3,31,5,1\nCMASS4,32,.05,2\nCMASS3,33,7,3\nCMASS3,34,8,4\n"
        "MPC,4,3,,1.,2,0,.4\n"
        "GRID,50,,0.,0.,0.,,3456\nCELAS2,24,8.E3,50,1\nCELAS2,25,9.E3,50,2,51,0\n"
        "SPOINT,51\nSPC1,9,0,51\nCONM2,40,50,,3.\n"
    )
    ratio = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -0.4, 0.0], [0.0, 0.0, 1.0]])
    shafts = np.zeros((4, 4))
    for first, second, k in ((0, 1, 4e4), (2, 3, 900.0)):
        shafts[np.ix_([first, second], [first, second])] += k * np.array([[1, -1], [-1, 1]])
    shafts[0, 0] += 900.0
    own = eigenvalues(ratio.T @ shafts @ ratio, ratio.T @ np.diag([1.2, 0.05, 0.3, 2.0]) @ ratio)
    found = solved(text, tmp_path, binder, nodes=(50,))
    assert found.eigenvalues == pytest.approx(sorted([*own, 8e3 / 3.0, 3e3]), rel=2e-6)


@needs_ccx
def test_a_mass_between_two_points_weighs_their_difference(tmp_path: Path) -> None:
    text = (
        "GRID,1,,0.,0.,0.,,23456\nGRID,2,,1.,0.,0.,,23456\nCELAS2,1,1000.,1,1\n"
        "CELAS2,2,3000.,1,1,2,1\nCMASS2,3,1.,1,1\nCMASS2,4,2.,2,1,1,1\n"
    )
    own = eigenvalues([[4e3, -3e3], [-3e3, 3e3]], [[3.0, -2.0], [-2.0, 2.0]])
    found = solved(text, tmp_path, translated_solver)
    assert found.eigenvalues == pytest.approx(own, rel=PRINTED)


@needs_ccx
def test_a_model_of_scalar_points_alone(tmp_path: Path) -> None:
    text = "CELAS4,1,1000.,1\nCELAS4,2,2000.,1,2\nCMASS4,3,1.,1\nCMASS4,4,1.,2\n"
    own = eigenvalues([[3e3, -2e3], [-2e3, 2e3]], np.eye(2))
    found = solved(text, tmp_path, translated_solver)
    assert found.eigenvalues == pytest.approx(own, rel=PRINTED)


@on_both
def test_a_bush_has_its_mass_at_both_ends_and_acts_where_it_is_put(
    binder: Binder, tmp_path: Path
) -> None:
    # A platform (mass 4, inertia 0.5 about z) on bushes of 2e3 along y at x = 0.3 and -0.1 of the
    # turned system 7, whose mass of 0.2 goes by halves to their ends.
    text = (
        "GRID,1,,0.,0.,0.,,1345\nGRID,2,,0.,-1.,0.,,123456\nCONM2,9,1,,4.\n,,,,,,.5\n"
        "CORD2R,7,,0.,0.,0.,0.,0.,1.\n,0.,1.,0.\nPBUSH,5,K,,2.E3\n,,M,.2\n"
        "CBUSH,21,5,1,2,,,,0\n,,7,0.,-.3,0.\nCBUSH,22,5,1,2,,,,0\n,,7,0.,.1,0.\n"
    )
    arms = np.array([0.3, -0.1])
    stiffness = 2e3 * np.array([[2.0, arms.sum()], [arms.sum(), arms @ arms]])
    own = eigenvalues(stiffness, np.diag([4.2, 0.5]))
    found = solved(text, tmp_path, binder)
    assert found.eigenvalues == pytest.approx(
        own, rel=1e-5
    )  # in CalculiX tetrahedra stand for the springs
    assert found.mass == pytest.approx(4.4, rel=1e-6)


@needs_ccx
def test_a_conm1_is_a_body_or_six_masses_of_its_own(tmp_path: Path) -> None:
    grid = "GRID,1,,1.,0.,0.\n" + "".join(f"CELAS2,{c},{c}00.,1,{c}\n" for c in range(1, 7))
    # M of a body with mass 2, its centre at (0, 0.1, 0): x couples with -z, z with x.
    body = "CONM1,11,1,,2.,,2.,,\n,2.,,,.2,.3,,,\n,,.4,-.2,,,,,.5\n"
    conm2 = "CONM2,11,1,,2.,0.,.1,0.\n,.28,,.4,,,.48\n"
    asked = [solved(grid + text, tmp_path, translated_solver).eigenvalues for text in (body, conm2)]
    assert asked[0] == pytest.approx(asked[1], rel=1e-6)
    # Added mass of water: other along than across, and sway with yaw.
    water = "CONM1,11,1,,2.,,3.,,\n,4.,,,,.3,,,\n,,.4,,.5,,,,.6\n"
    mass = np.diag([2.0, 3.0, 4.0, 0.3, 0.4, 0.6])
    mass[5, 1] = mass[1, 5] = 0.5
    found = solved(grid + water, tmp_path, translated_solver)
    own = eigenvalues(np.diag([100.0, 200.0, 300.0, 400.0, 500.0, 600.0]), mass)
    assert found.eigenvalues == pytest.approx(own, rel=1e-5)
