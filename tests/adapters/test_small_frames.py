"""Frames of a few freedoms have all the modes that their masses allow, on both free solvers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import eigh

from modetune.adapters.nastran.solver import mystran_solver
from modetune.adapters.translation.solver import translated_solver
from modetune.core.modes import Floats
from tests.adapters.solved import Binder, needs_ccx, needs_mystran, solved

E, G, AREA, I1, I2, TORSION = 2.1e11, 8.0e10, 1e-4, 2e-8, 1e-8, 2e-8
#: Points, bars between them, and masses at points.
FRAMES: dict[
    str, tuple[list[tuple[float, float, float]], list[tuple[int, int]], dict[int, float]]
] = {
    "three bars and a mass": (
        [(0, 0, 0), (-0.75, 0.73, -0.88), (-0.24, -0.14, -0.02), (0.95, 0.55, -0.38)],
        [(0, 1), (1, 2), (2, 3)],
        {3: 2.5},
    ),
    "a fork": (
        [(0, 0, 0), (0.1, 0, 0.9), (0.7, 0.2, 1.3), (-0.6, -0.3, 1.2)],
        [(0, 1), (1, 2), (1, 3)],
        {2: 1.5, 3: 0.8},
    ),
    "a ring": (
        [(0, 0, 0), (0.8, 0.1, 0.2), (0.9, 0.9, -0.1), (0.1, 0.7, 0.3)],
        [(0, 1), (1, 2), (2, 3), (3, 0)],
        {1: 0.5, 2: 2.0, 3: 1.0},
    ),
}
ORIENTATION = np.array([0.3, 0.5, 0.7])


RHO = 7850.0


def axes_of(first: Floats, second: Floats) -> Floats:
    """Axes of a bar as rows, (3, 3)."""
    x = (second - first) / np.linalg.norm(second - first)
    z = np.cross(x, ORIENTATION)
    z /= np.linalg.norm(z)
    return np.vstack([x, np.cross(z, x), z])


def bar(first: Floats, second: Floats) -> Floats:
    """Stiffness of an Euler-Bernoulli bar in basic coordinates, (12, 12); I1 bends in plane 1."""
    length = float(np.linalg.norm(second - first))
    k = np.zeros((12, 12))
    for place, value in ((0, E * AREA / length), (3, G * TORSION / length)):
        k[np.ix_([place, place + 6], [place, place + 6])] = value * np.array([[1, -1], [-1, 1]])
    for shift, turn, moment, sign in ((1, 5, I1, 1.0), (2, 4, I2, -1.0)):
        a, b = 12.0 * E * moment / length**3, sign * 6.0 * E * moment / length**2
        c, d = 4.0 * E * moment / length, 2.0 * E * moment / length
        places = [shift, turn, shift + 6, turn + 6]
        k[np.ix_(places, places)] = [[a, b, -a, b], [b, c, -b, d], [-a, -b, a, -b], [b, d, -b, c]]
    turned = np.kron(np.eye(4), axes_of(first, second))
    return np.asarray(turned.T @ k @ turned)


def coupled(first: Floats, second: Floats) -> Floats:
    """Coupled mass of a bar in basic coordinates, (12, 12): NASTRAN Theoretical Manual, 5.2."""
    length = float(np.linalg.norm(second - first))
    m = np.zeros((12, 12))
    m[np.ix_([0, 6], [0, 6])] = [[175.0, 35.0], [35.0, 175.0]]
    a, b, c, d = 22.0 * length, 13.0 * length, 4.0 * length**2, 3.0 * length**2
    for places, turn in (([1, 5, 7, 11], 1.0), ([2, 4, 8, 10], -1.0)):
        signs = np.array([1.0, turn, 1.0, turn])
        m[np.ix_(places, places)] = np.outer(signs, signs) * [
            [156.0, a, 54.0, -b], [a, c, b, -d], [54.0, b, 156.0, -a], [-b, -d, -a, c]
        ]  # fmt: skip
    turned = np.kron(np.eye(4), axes_of(first, second))
    return np.asarray(RHO * AREA * length / 420.0 * turned.T @ m @ turned)


def assembled(name: str, matrix: Callable[[Floats, Floats], Floats]) -> Floats:
    """Sum of the bars' matrices, (6 * points, 6 * points)."""
    points, bars, _ = FRAMES[name]
    places = np.array(points, dtype=np.float64)
    whole = np.zeros((6 * len(places), 6 * len(places)))
    for first, second in bars:
        own = np.r_[6 * first : 6 * first + 6, 6 * second : 6 * second + 6]
        whole[np.ix_(own, own)] += matrix(places[first], places[second])
    return whole


def frequencies(name: str) -> Floats:
    """Frequencies in Hz of all modes: masses have no inertia, so rotations are condensed."""
    masses = FRAMES[name][2]
    k = assembled(name, bar)
    free = np.arange(6, len(k))
    massive = np.array([6 * point + axis for point in masses for axis in range(3)])
    flexibility = np.linalg.inv(k[np.ix_(free, free)])[np.ix_(massive - 6, massive - 6)]
    mass = np.diag(np.repeat(list(masses.values()), 3))
    return (
        np.asarray(np.sqrt(eigh(np.linalg.inv(flexibility), mass, eigvals_only=True))) / 2 / np.pi
    )


def deck(name: str, density: float = 0.0) -> str:
    """Bulk data of a frame, with coupled masses if its bars have any."""
    points, bars, masses = FRAMES[name]
    lines = [
        f"MAT1,1,{E:.3E},{G:.3E},,{density}",
        f"PBAR,1,1,{AREA:.1E},{I1:.1E},{I2:.1E},{TORSION:.1E}",
        "SPC1,1,123456,1",
    ]
    if density:
        lines.append("PARAM,COUPMASS,1")
    for number, (x, y, z) in enumerate(points, start=1):
        held = ",,123456" if number == 1 else ""
        lines.append(f"GRID,{number},,{x:.2f},{y:.2f},{z:.2f}{held}")
    for number, (first, second) in enumerate(bars, start=1):
        lines.append(f"CBAR,{number},1,{first + 1},{second + 1},0.3,0.5,0.7")
    for number, (point, mass) in enumerate(masses.items(), start=100):
        lines.append(f"CONM2,{number},{point + 1},,{mass}")
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    "binder",
    [
        pytest.param(translated_solver, marks=needs_ccx),
        pytest.param(mystran_solver, marks=needs_mystran),
    ],
)
@pytest.mark.parametrize("name", FRAMES)
def test_a_small_frame_has_all_modes_that_its_masses_allow(
    name: str, binder: Binder, tmp_path: Path
) -> None:
    nodes, wanted = tuple(range(1, len(FRAMES[name][0]) + 1)), frequencies(name)
    found = solved(deck(name), tmp_path, binder, n_modes=16, nodes=nodes)
    np.testing.assert_allclose(found.modes.frequencies_hz, wanted, rtol=2e-6)


@needs_ccx
@pytest.mark.parametrize("name", FRAMES)
def test_coupled_masses_of_bars_follow_the_manual_of_nastran(name: str, tmp_path: Path) -> None:
    k, m = assembled(name, bar), assembled(name, coupled)
    for point, mass in FRAMES[name][2].items():
        m[range(6 * point, 6 * point + 3), range(6 * point, 6 * point + 3)] += mass
    # Torsion has no mass, so the values of the pencil (M, K) are finite.
    values = eigh(m[6:, 6:], k[6:, 6:], eigvals_only=True)[::-1]
    found = solved(deck(name, RHO), tmp_path, translated_solver, n_modes=8)
    wanted = 1.0 / np.sqrt(values[:8]) / 2.0 / np.pi
    # Spin has a ten-thousandth of its inertia on CalculiX, so that it is not singular.
    np.testing.assert_allclose(found.modes.frequencies_hz, wanted, rtol=1e-5)


@needs_mystran
def test_a_free_frame_has_all_modes_though_its_unknowns_are_few(tmp_path: Path) -> None:
    # Seventeen modes: three of each point, and two by the arm of the mass. Spare unknowns of one
    # eigenvalue stopped MYSTRAN at ten modes.
    places = ("0.,0.,0.", ".4,.1,0.", ".8,.3,.2", ".7,.8,.5", ".1,.6,.9")
    lines = [f"GRID,{n},,{place}" for n, place in enumerate(places, start=1)]
    lines += [f"CBAR,{n},1,{n},{n + 1},0.,0.,1." for n in range(1, 5)]
    lines += ["PBAR,1,1,3.-4,4.-9,9.-9,6.-9", "MAT1,1,7.+10,,.33,2700."]
    lines += ["CONM2,8,5,,1.5,.1,.05,.02"]
    found = solved("\n".join(lines) + "\n", tmp_path, mystran_solver, n_modes=10)
    assert found.n_rigid == 6
    # The same frame by an assembly of Euler and Bernoulli's bars in numpy.
    wanted = [6.91227867, 15.17726209, 25.02513302, 47.82070845]
    np.testing.assert_allclose(found.modes.frequencies_hz[6:], wanted, rtol=1e-6)
