"""Rigid elements on MYSTRAN and CalculiX against closed forms of what they tie."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import linalg

from modetune.adapters.nastran.solver import mystran_solver
from modetune.adapters.translation.solver import translated_solver
from modetune.core.errors import ModelError
from modetune.core.modes import Floats
from tests.adapters.solved import Binder, needs_ccx, on_both, solved

#: A table top on three legs: places, and the stiffness of each leg along x, y, z.
LEGS = {1: (0.0, 0.0, 0.0), 2: (2.0, 0.2, 0.1), 3: (0.4, 1.5, -0.2)}
STIFFNESS = (300.0, 500.0, 4000.0)
CENTRE = np.array([0.7, 0.6, 0.5])
BODY = (3.0, (0.4, 0.5, 0.8))
#: Rows are x, y and z of a turned frame.
AXES = np.array([[1.0, 0.0, 0.0], [0.0, 0.8, -0.6], [0.0, 0.6, 0.8]])


def table() -> tuple[str, Floats]:
    """Cards of the legs and the top's mass at point 9, and the top's eigenvalues."""
    text = f"GRID,9,,{CENTRE[0]},{CENTRE[1]},{CENTRE[2]}\nCONM2,90,9,,{BODY[0]}\n"
    text += f",{BODY[1][0]},,{BODY[1][1]},,,{BODY[1][2]}\n"
    stiffness = np.zeros((6, 6))
    for node, place in LEGS.items():
        text += f"GRID,{node},,{place[0]},{place[1]},{place[2]}\n"
        for component, k in enumerate(STIFFNESS, start=1):
            text += f"CELAS2,{10 * node + component},{k},{node},{component}\n"
            axis = np.eye(3)[component - 1]
            row = np.r_[axis, np.cross(np.array(place) - CENTRE, axis)]
            stiffness += k * np.outer(row, row)
    mass = np.diag([BODY[0]] * 3 + list(BODY[1]))
    return text, np.asarray(linalg.eigh(stiffness, mass, eigvals_only=True))


@on_both
def test_a_bar_ties_the_other_end_whole(binder: Binder, tmp_path: Path) -> None:
    text, own = table()
    text += "RBAR,51,9,1,123456,,,123\nRBAR,52,2,9,,123456,123\nRBAR1,53,9,3,123\n"
    for node, place in LEGS.items():  # what is tied by translations alone holds its rotations
        text = text.replace(
            f"GRID,{node},,{place[0]},{place[1]},{place[2]}\n",
            f"GRID,{node},,{place[0]},{place[1]},{place[2]},,456\n",
        )
    assert solved(text, tmp_path, binder).eigenvalues == pytest.approx(own, rel=1e-5)


@needs_ccx
@pytest.mark.parametrize(
    "card",
    [
        "RBE1,51,1,123,2,23,3,3\n,UM,9,123456,2,1,3,12\n",
        "RBAR,51,1,9,1234,23\nRBE2,52,9,123,2,3\n",
    ],
    ids=["RBE1", "RBAR"],
)
def test_six_components_of_several_points_lead_a_body(card: str, tmp_path: Path) -> None:
    text, own = table()
    found = solved(text + card, tmp_path, translated_solver)
    assert found.eigenvalues[:6] == pytest.approx(own, rel=1e-5)


@needs_ccx
def test_a_rod_keeps_the_distance_of_its_ends(tmp_path: Path) -> None:
    # Two masses in a plane on springs, a pendulum rod between them along (0.6, 0.8).
    text = "GRID,1,,0.,0.,0.,,3456\nGRID,2,,.6,.8,0.,,3456\nCONM2,11,1,,2.\nCONM2,12,2,,1.\n"
    stiffness = (100.0, 300.0, 700.0, 500.0)
    for place, k in enumerate(stiffness):
        text += f"CELAS2,{20 + place},{k},{1 + place // 2},{1 + place % 2}\n"
    free = linalg.null_space(np.array([[0.6, 0.8, -0.6, -0.8]]))
    mass = free.T @ np.diag([2.0, 2.0, 1.0, 1.0]) @ free
    own = linalg.eigh(free.T @ np.diag(stiffness) @ free, mass, eigvals_only=True)
    found = solved(text + "RROD,31,1,2,,1\n", tmp_path, translated_solver)
    assert found.eigenvalues == pytest.approx(own, rel=1e-6)


def averaged(turned: set[int]) -> tuple[str, Floats]:
    """A body on the average of three masses on springs, and its eigenvalues.

    turned: points whose output frame, along which their springs act, has x, y and z of AXES.
    """
    text = "CORD2R,7,,0.,0.,0.,0.,.6,.8\n,1.,0.,0.\n"
    stiffness, rows, inertia = np.zeros((9, 9)), [], BODY[1][0]
    for place, (node, xyz) in enumerate(LEGS.items()):
        frame = AXES if node in turned else np.eye(3)
        text += f"GRID,{node},,{xyz[0]},{xyz[1]},{xyz[2]},{7 * (node in turned)},456\n"
        text += f"CONM2,{90 + node},{node},,.5\n"
        for component, k in enumerate(STIFFNESS, start=1):
            text += f"CELAS2,{10 * node + component},{k},{node},{component}\n"
        own = slice(3 * place, 3 * place + 3)
        stiffness[own, own] = frame.T @ np.diag(STIFFNESS) @ frame
        arm = np.array(xyz) - CENTRE
        rows += [np.r_[axis, np.cross(arm, axis)] for axis in np.eye(3)]
    text += f"GRID,9,,{CENTRE[0]},{CENTRE[1]},{CENTRE[2]},{7 * (9 in turned)}\n"
    text += f"CONM2,90,9,,{BODY[0]}\n,{inertia},,{inertia},,,{inertia}\n"
    fit = np.linalg.pinv(np.array(rows))
    body = np.diag([BODY[0]] * 3 + [inertia] * 3)
    mass = 0.5 * np.eye(9) + fit.T @ body @ fit
    text += "RBE3,51,,9,123456,1.,123,1,2\n,3\n"
    return text, np.asarray(linalg.eigh(stiffness, mass, eigvals_only=True))


@on_both
@pytest.mark.parametrize("turned", [set(), {1, 2, 3, 9}], ids=["basic", "turned"])
def test_an_rbe3_in_one_output_frame_is_the_fit_of_its_points(
    binder: Binder, turned: set[int], tmp_path: Path
) -> None:
    text, own = averaged(turned)
    assert solved(text, tmp_path, binder).eigenvalues == pytest.approx(own[:6], rel=1e-5)


@on_both
@pytest.mark.parametrize("turned", [{2}, {9}, {1, 2, 3}], ids=["one", "lead", "others"])
def test_an_rbe3_in_several_output_frames_is_right_or_refused(
    binder: Binder, turned: set[int], tmp_path: Path
) -> None:
    text, own = averaged(turned)
    if binder is mystran_solver:  # reads the components of all in the lead's frame
        with pytest.raises(ModelError, match=r"line \d+: .*RBE3 .* unlike output frames .*CD"):
            solved(text, tmp_path, binder)
    else:
        assert solved(text, tmp_path, binder).eigenvalues == pytest.approx(own[:6], rel=1e-5)


@needs_ccx
def test_an_rbe3_is_the_same_whatever_of_it_depends(tmp_path: Path) -> None:
    text, _ = table()
    text += "CONM2,91,1,,.5\nCONM2,92,2,,.5\nCONM2,93,3,,.5\nRBE3,51,,9,123456,1.,123,1,2\n,3"
    asked = [
        solved(text + rest, tmp_path, translated_solver).eigenvalues
        for rest in ("\n", ",,,,,,,\n,UM,1,123,2,23,3,3\n")
    ]
    assert asked[0] == pytest.approx(asked[1], rel=1e-5)
