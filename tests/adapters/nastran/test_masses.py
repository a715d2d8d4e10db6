"""Lumped masses: closed forms, MYSTRAN's own and MSC Nastran's frequencies; real solvers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benchmarks.corpus import solve
from benchmarks.references import reference
from scipy.linalg import eigh

from modetune.adapters.nastran.f06 import read_f06
from modetune.adapters.nastran.solver import mystran_solver
from modetune.adapters.solver import MatrixAnalysis, Solver
from modetune.adapters.translation.solver import translated_solver
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.modes import Floats
from modetune.core.parameters import Parameter
from tests.adapters.solved import Binder, needs_ccx, needs_mystran, solved
from tests.adapters.test_solver_contract import run

SOLVERS = [
    pytest.param(translated_solver, marks=needs_ccx),
    pytest.param(mystran_solver, marks=needs_mystran),
]
STEEL = "MAT1,1,2.1+11,,.3,7850."


def column(count: int, length: float, side: float) -> str:
    """A column of bricks that stretches alone: held across, and along at its foot."""
    lines = [STEEL, "PSOLID,1,1"]
    corners = ((0.0, 0.0), (side, 0.0), (side, side), (0.0, side))
    for level in range(count + 1):
        for corner, (x, y) in enumerate(corners):
            held = "123" if not level else "12"
            place = f"{x},{y},{level * length / count}"
            lines.append(f"GRID,{4 * level + corner + 1},,{place},,{held}")
    for level in range(count):
        nodes = ",".join(str(4 * level + place) for place in range(1, 7))
        lines.append(f"CHEXA,{level + 1},1,{nodes}")
        lines.append(f",{4 * level + 7},{4 * level + 8}")
    return "\n".join(lines) + "\n"


def rods(count: int, length: float, side: float) -> str:
    """A clamped rod that stretches alone."""
    lines = [STEEL, f"PROD,1,1,{side * side}", "GRID,1,,0.,0.,0.,,123456"]
    for place in range(1, count + 1):
        lines.append(f"GRID,{place + 1},,{place * length / count},0.,0.,,23456")
        lines.append(f"CROD,{place},1,{place},{place + 1}")
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("binder", SOLVERS)
def test_a_coarse_chain_of_lumped_rods_has_its_closed_form(binder: Binder, tmp_path: Path) -> None:
    """Masses m and springs k, the last mass a half: w_j = 2 sqrt(k/m) sin((2 j - 1) pi / (4 n))."""
    count, length = 3, 1.2
    found = solved(rods(count, length, 0.03), tmp_path, binder, n_modes=count)
    wave, step = np.sqrt(2.1e11 / 7850.0), length / count
    phase = (2.0 * np.arange(1, count + 1) - 1.0) * np.pi / (4.0 * count)
    wanted = 2.0 * wave / step * np.sin(phase) / (2.0 * np.pi)
    # Printed with seven digits.
    np.testing.assert_allclose(found.modes.frequencies_hz, wanted, rtol=1e-6)


@pytest.mark.parametrize("binder", SOLVERS)
def test_a_column_of_lumped_bricks_has_its_closed_form(binder: Binder, tmp_path: Path) -> None:
    """As the rods, with the modulus of a body that cannot give way sideways."""
    count, length, side, nu = 3, 1.2, 0.3, 0.3
    stiff = 2.1e11 * (1.0 - nu) / ((1.0 + nu) * (1.0 - 2.0 * nu))
    found = solved(column(count, length, side), tmp_path, binder, n_modes=1)
    step = length / count
    wanted = 2.0 * np.sqrt(stiff / 7850.0) / step * np.sin(np.pi / (4.0 * count)) / (2.0 * np.pi)
    # The strain is uniform in a brick; printed with seven digits.
    np.testing.assert_allclose(found.modes.frequencies_hz[0], wanted, rtol=1e-6)


LADDER = (
    "PBEAM,1,1,4.-4,3.-8,2.-8,,4.-8,.05\n" + STEEL + "\nPBAR,2,1,2.-4,1.-8,1.5-8,2.-8\n"
    + "".join(f"GRID,{2 * row + side + 1},,{0.3 * side},{0.4 * row},{0.05 * row * row}\n"
              for row in range(4) for side in range(2))
    + "".join(f"CBEAM,{2 * row + side + 1},1,{2 * row + side + 1},{2 * row + side + 3},0.,0.,1.\n"
              for row in range(3) for side in range(2))
    + "".join(f"CBAR,{row + 11},2,{2 * row + 1},{2 * row + 2},0.,0.,1.\n" for row in range(4))
)  # fmt: skip
TRAY = (
    STEEL + "\nMAT1,2,7.+10,,.33,2700.\nPSHELL,1,1,.002,1,,1,,1.5\nPSHELL,2,2,.003,2,,2\n"
    + "".join(f"GRID,{4 * row + col + 1},,{0.1 * row + 0.02 * col},{0.08 * col},"
              f"{0.05 * (col == 3)}\n" for row in range(4) for col in range(4))
    + "".join(f"CQUAD4,{3 * row + col + 1},{1 + col // 2},{4 * row + col + 1},{4 * row + col + 5},"
              f"{4 * row + col + 6},{4 * row + col + 2}\n" for row in range(3) for col in range(2))
    + "".join(f"CTRIA3,{2 * row + 21},2,{4 * row + 3},{4 * row + 7},{4 * row + 8}\n"
              f"CTRIA3,{2 * row + 22},2,{4 * row + 3},{4 * row + 8},{4 * row + 4}\n"
              for row in range(3))
)  # fmt: skip
FOOT = (
    STEEL + "\nPSOLID,1,1\nPSOLID,2,2\nMAT1,2,7.+10,,.33,2700.\n"
    + "".join(f"GRID,{4 * level + corner + 1},,{x * (1 - 0.1 * level)},{y},{0.1 * level}\n"
              for level in range(3) for corner, (x, y) in
              enumerate(((0.0, 0.0), (0.12, 0.0), (0.1, 0.09), (0.0, 0.1))))
    + "GRID,13,,.05,.05,.3\nCHEXA,1,1,1,2,3,4,5,6\n,7,8\nCPENTA,2,2,5,6,7,9,10,11\n"
    + "CPENTA,3,2,5,7,8,9,11,12\nCTETRA,4,1,9,10,11,13\nCTETRA,5,1,9,11,12,13\n"
)  # fmt: skip


def grid_masses(solver: Solver, folder: Path) -> Floats:
    """(n_grids, 3), what moves with a displacement of each grid point; all other terms of it 0."""
    folder.mkdir()
    found = run(solver, {}, MatrixAnalysis(), folder)
    assert isinstance(found, MatrixResult)
    nodes = sorted(solver.deck.summary.node_ids)
    masses = np.zeros((len(nodes), 3))
    mass = found.upper_mass.tocoo()
    size = np.abs(mass.data).max()
    for row, column_, value in zip(mass.row, mass.col, mass.data, strict=True):
        node, component = int(found.nodes[row]), int(found.components[row])
        if node in nodes and component <= 3:
            if row == column_:
                masses[nodes.index(node), component - 1] += value
            elif int(found.components[column_]) <= 3:
                assert abs(value) <= 1e-9 * size
    return masses


@needs_ccx
@needs_mystran
@pytest.mark.parametrize("bulk", [LADDER, TRAY, FOOT], ids=["ladder", "tray", "foot"])
def test_grid_points_have_the_masses_that_mystran_gives_them(bulk: str, tmp_path: Path) -> None:
    path = tmp_path / "model.bdf"
    path.write_text("SOL 103\nCEND\nMETHOD = 1\nBEGIN BULK\nEIGRL,1,,,8\n" + bulk + "ENDDATA\n")
    mine = grid_masses(translated_solver(path, ()), tmp_path / "ccx")
    his = grid_masses(mystran_solver(path, ()), tmp_path / "mystran")
    assert his.sum() > 0.0
    np.testing.assert_allclose(mine, his, rtol=0.0, atol=1e-6 * his.max())


@needs_ccx
def test_a_density_moves_lumped_masses_in_proportion(tmp_path: Path) -> None:
    path = tmp_path / "model.bdf"
    path.write_text("SOL 103\nCEND\nMETHOD = 1\nBEGIN BULK\nEIGRL,1,,,8\n" + FOOT + "ENDDATA\n")
    density = Parameter("rho", "density", "material", ("2",), 0.5, 2.0, 0.1)
    solver = translated_solver(path, (density,))
    moved = solver.deck.affected_elements(density)
    assert moved is not None
    assert (moved.stiffness, moved.mass, moved.powers) == (False, True, (1,))
    masses = []
    for value in (1.0, 1.5, 2.0):
        folder = tmp_path / str(value)
        folder.mkdir()
        found = run(solver, {"rho": value}, MatrixAnalysis(), folder)
        assert isinstance(found, MatrixResult)
        masses.append(found.upper_mass.diagonal())
    assert (masses[1] > masses[0] * (1.0 + 1e-3)).any()
    np.testing.assert_allclose(masses[1] - masses[0], masses[2] - masses[1], atol=1e-9)


def test_masses_at_midside_nodes_are_told_to_be_consistent(tmp_path: Path) -> None:
    path = tmp_path / "model.bdf"
    corners = ("0.,0.,0.", "1.,0.,0.", "0.,1.,0.", "0.,0.,1.")
    middles = (".5,0.,0.", ".5,.5,0.", "0.,.5,0.", "0.,0.,.5", ".5,0.,.5", "0.,.5,.5")
    lines = [f"GRID,{n},,{place}" for n, place in enumerate((*corners, *middles), start=1)]
    lines += ["CTETRA,1,1,1,2,3,4,5,6", ",7,8,9,10", "PSOLID,1,1", STEEL, "EIGRL,1,,,8", "ENDDATA"]
    path.write_text("\n".join(["SOL 103", "CEND", "METHOD = 1", "BEGIN BULK", *lines]) + "\n")
    for solver in (translated_solver(path, ()), mystran_solver(path, ())):
        assert "are consistent where elements have midside nodes" in solver.other_masses


@needs_ccx
@pytest.mark.parametrize("name", ["pn_beam_modes/beam_modes", "yeti_gpwg1/rdop2gpwg_1"])
def test_beams_have_the_frequencies_of_msc_nastran(
    name: str, shared_data: Path, tmp_path: Path
) -> None:
    deck = next((shared_data / "nastran").glob(f"{name}.dat"))
    printed = read_f06(deck.with_suffix(".f06")).modes.eigenvalues
    wanted = np.sqrt(printed[printed > 1.0])[:4] / (2.0 * np.pi)
    solver = translated_solver(deck, ())
    assert not solver.other_masses
    frequencies = solve(solver, tmp_path).frequencies_hz
    np.testing.assert_allclose(frequencies[frequencies > 0.0][:4], wanted, rtol=1e-6)


#: Trusses: points, those that are held, and rods between points.
TRUSSES: dict[
    str, tuple[list[tuple[float, float, float]], tuple[int, ...], list[tuple[int, int]] | None]
] = {
    "cantilever": (
        [(0, 0, 0), (0, 1, 0), (0.9, 0, 0), (1.1, 1.2, 0), (2, 0.2, 0)],
        (0, 1),
        [(0, 2), (1, 2), (1, 3), (2, 3), (2, 4), (3, 4)],
    ),
    "tripod": ([(1, 0, 0), (-0.5, 0.8, 0), (-0.4, -0.9, 0.2), (0.1, 0, 1.3)], (0, 1, 2), None),
    "mast": (
        [(0, 0, 0), (1, 0, 0), (0.4, 0.9, 0), (0.1, 0.1, 1), (0.8, 0.1, 1), (0.4, 0.7, 1.1)],
        (0, 1, 2),
        None,
    ),
}


def truss_frequencies(
    points: Floats, held: tuple[int, ...], rods: list[tuple[int, int]], area: float
) -> Floats:
    """Frequencies in Hz, with 5/12 and 1/12 of each mass along a rod and halves across it."""
    size = 3 * len(points)
    k, m = np.zeros((size, size)), np.zeros((size, size))
    for first, second in rods:
        rod = points[second] - points[first]
        length = np.linalg.norm(rod)
        along = np.outer(rod, rod) / length**2
        across, mass = np.eye(3) - along, 7850.0 * area * length
        places = np.r_[3 * first : 3 * first + 3, 3 * second : 3 * second + 3]
        own = np.ix_(places, places)
        k[own] += 2.1e11 * area / length * np.kron([[1.0, -1.0], [-1.0, 1.0]], along)
        m[own] += mass * np.kron([[5.0, 1.0], [1.0, 5.0]], along) / 12.0
        m[own] += mass * np.kron(0.5 * np.eye(2), across)
    fixed = [3 * point + axis for point in held for axis in range(3)]
    flat = [3 * p + 2 for p in range(len(points))] if not points[:, 2].any() else []
    free = np.setdiff1d(np.arange(size), fixed + flat)
    values = eigh(k[np.ix_(free, free)], m[np.ix_(free, free)], eigvals_only=True)
    return np.asarray(np.sqrt(values) / (2.0 * np.pi))


@needs_ccx
@pytest.mark.parametrize("name", TRUSSES)
@pytest.mark.parametrize("kind", ["CROD", "CONROD", "CTUBE"])
def test_coupled_masses_of_trusses_follow_the_rule_of_msc_nastran(
    name: str, kind: str, tmp_path: Path
) -> None:
    points, held, rods = TRUSSES[name]
    places = np.array(points, dtype=np.float64)
    ends = rods or [
        (a, b) for b in range(len(points)) for a in range(b) if not (a in held and b in held)
    ]
    flat = "" if places[:, 2].any() else "3"
    outer, wall = 0.05, 0.004
    area = np.pi * wall * (outer - wall)
    lines = [STEEL, f"PROD,1,1,{area}", f"PTUBE,2,1,{outer},{wall}", "PARAM,COUPMASS,1"]
    for place, (x, y, z) in enumerate(places.tolist()):
        lines.append(
            f"GRID,{place + 1},,{x},{y},{z},,{'123456' if place in held else flat + '456'}"
        )
    last = {"CROD": "", "CTUBE": "", "CONROD": f",{area}"}[kind]
    number = {"CROD": ",1", "CTUBE": ",2", "CONROD": ""}[kind]
    middle = {"CROD": "", "CTUBE": "", "CONROD": ",1"}[kind]
    for place, (first, second) in enumerate(ends, start=1):
        lines.append(f"{kind},{place}{number},{first + 1},{second + 1}{middle}{last}")
    wanted = truss_frequencies(places, held, ends, area)
    text = "\n".join(lines) + "\n"
    found = solved(text, tmp_path, translated_solver, n_modes=wanted.size - 1)
    np.testing.assert_allclose(found.modes.frequencies_hz, wanted[:-1], rtol=1e-5)


@needs_ccx
def test_a_truss_with_coupled_masses_has_the_frequencies_of_msc_nastran(
    shared_data: Path, tmp_path: Path
) -> None:
    folder = shared_data / "nastran" / "cofe" / "system_verification" / "001_ten_bar_truss"
    deck = folder / "nastran_runs" / "modes.dat"
    known = reference(deck)
    assert known is not None
    found = solve(translated_solver(deck, ()), tmp_path).frequencies_hz
    # The print file has seven digits, the result file of CalculiX as many.
    np.testing.assert_allclose(found, known.modes.frequencies_hz, rtol=1e-6)


@needs_mystran
def test_a_mixed_model_comes_near_msc_nastran(shared_data: Path, tmp_path: Path) -> None:
    """Solids, shells and bars; 11 % off with consistent masses of solids."""
    deck = shared_data / "nastran" / "pn_mode_solid_shell_bar" / "mode_solid_shell_bar.bdf"
    frequencies = solve(mystran_solver(deck, ()), tmp_path).frequencies_hz
    known = reference(deck)
    assert known is not None
    np.testing.assert_allclose(frequencies[:3], known.modes.frequencies_hz, rtol=9e-3)
