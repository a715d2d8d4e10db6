"""Frames of a few freedoms have all the modes that their masses allow, on both free solvers."""

from __future__ import annotations

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


def bar(first: Floats, second: Floats) -> Floats:
    """Stiffness of an Euler-Bernoulli bar in basic coordinates, (12, 12); I1 bends in plane 1."""
    length = float(np.linalg.norm(second - first))
    x = (second - first) / length
    z = np.cross(x, ORIENTATION)
    z /= np.linalg.norm(z)
    axes = np.vstack([x, np.cross(z, x), z])
    k = np.zeros((12, 12))
    for place, value in ((0, E * AREA / length), (3, G * TORSION / length)):
        k[np.ix_([place, place + 6], [place, place + 6])] = value * np.array([[1, -1], [-1, 1]])
    for shift, turn, moment, sign in ((1, 5, I1, 1.0), (2, 4, I2, -1.0)):
        a, b = 12.0 * E * moment / length**3, sign * 6.0 * E * moment / length**2
        c, d = 4.0 * E * moment / length, 2.0 * E * moment / length
        places = [shift, turn, shift + 6, turn + 6]
        k[np.ix_(places, places)] = [[a, b, -a, b], [b, c, -b, d], [-a, -b, a, -b], [b, d, -b, c]]
    turned = np.kron(np.eye(4), axes)
    return np.asarray(turned.T @ k @ turned)


def frequencies(name: str) -> Floats:
    """Frequencies in Hz of all modes: masses have no inertia, so rotations are condensed."""
    points, bars, masses = FRAMES[name]
    places = np.array(points, dtype=np.float64)
    k = np.zeros((6 * len(places), 6 * len(places)))
    for first, second in bars:
        own = np.r_[6 * first : 6 * first + 6, 6 * second : 6 * second + 6]
        k[np.ix_(own, own)] += bar(places[first], places[second])
    free = np.arange(6, len(k))
    massive = np.array([6 * point + axis for point in masses for axis in range(3)])
    flexibility = np.linalg.inv(k[np.ix_(free, free)])[np.ix_(massive - 6, massive - 6)]
    mass = np.diag(np.repeat(list(masses.values()), 3))
    return (
        np.asarray(np.sqrt(eigh(np.linalg.inv(flexibility), mass, eigvals_only=True))) / 2 / np.pi
    )


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
    points, bars, masses = FRAMES[name]
    lines = [
        f"MAT1,1,{E:.3E},{G:.3E}",
        f"PBAR,1,1,{AREA:.1E},{I1:.1E},{I2:.1E},{TORSION:.1E}",
        "SPC1,1,123456,1",
    ]
    for number, (x, y, z) in enumerate(points, start=1):
        held = ",,123456" if number == 1 else ""
        lines.append(f"GRID,{number},,{x:.2f},{y:.2f},{z:.2f}{held}")
    for number, (first, second) in enumerate(bars, start=1):
        lines.append(f"CBAR,{number},1,{first + 1},{second + 1},0.3,0.5,0.7")
    for number, (point, mass) in enumerate(masses.items(), start=100):
        lines.append(f"CONM2,{number},{point + 1},,{mass}")
    nodes, wanted = tuple(range(1, len(points) + 1)), frequencies(name)
    text = "\n".join(lines) + "\n"
    found = solved(text, tmp_path, binder, n_modes=16, nodes=nodes)
    np.testing.assert_allclose(found.modes.frequencies_hz, wanted, rtol=2e-6)
