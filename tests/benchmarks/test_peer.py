"""The peer and modetune on structures of bricks: both come to the truth, and so to one answer."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from benchmarks.dakota import write_study
from benchmarks.plain import PlainModel
from benchmarks.problem import Problem, set_up, write_problem
from benchmarks.ways import WAYS, run_way

from modetune.core.modes import mode_set
from modetune.core.parameters import Parameter
from tests.adapters.solved import needs_ccx, needs_mystran

pytest.importorskip("dakota.environment", reason="Dakota is not installed")
pytestmark = needs_ccx

#: Edges of a brick, mm: unequal, so that no two modes are alike by symmetry.
EDGES = np.array([20.0, 12.0, 16.0])
#: A brick by its place in the grid.
Cell = tuple[int, int, int]
#: The material of a brick, empty where there is none.
Bricks = Callable[[Cell], str]


def fork(cell: Cell) -> str:
    """A tuning fork with unequal prongs on a stem."""
    x, y, _ = cell
    if x < 3:
        return "STEM" if y == 2 else ""
    if x == 3:
        return "YOKE"
    return "PRONGS" if y == 0 or (y == 4 and x < 9) else ""


def table(cell: Cell) -> str:
    """A table whose top stands out beyond its legs on one side."""
    x, y, z = cell
    if z == 4:
        return "TOP"
    return "LEGS" if x in (0, 5) and y in (0, 3) else ""


def stairs(cell: Cell) -> str:
    """A flight of steps between a landing and the air, thicker below."""
    x, y, z = cell
    if not 0 <= x - 2 * z <= 2 or y > 2:
        return ""
    return "LOWER" if z < 2 else "UPPER"


#: Bricks, size of the grid, hidden moduli relative to the deck's, and sensors. Without sensors the
#: moduli keep the order of the modes; the fork's third and fourth change places.
STRUCTURES: dict[str, tuple[Bricks, Cell, dict[str, float], int]] = {
    "fork": (fork, (11, 5, 1), {"STEM": 0.8, "YOKE": 1.2, "PRONGS": 1.1}, 9),
    "table": (table, (8, 4, 5), {"LEGS": 1.3, "TOP": 0.85}, 0),
    "stairs": (stairs, (9, 3, 4), {"LOWER": 1.15, "UPPER": 0.9}, 0),
}
#: Corners of a C3D8I in its order.
CORNERS = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]


def deck(bricks: Bricks, grid: Cell) -> Iterator[str]:
    """The lines of a CalculiX deck: steel, held where x + z is least."""
    nx, ny, nz = map(range, grid)
    cells = {cell: name for cell in product(nx, ny, nz) if (name := bricks(cell))}
    places = [[tuple(np.add(cell, corner)) for corner in CORNERS] for cell in cells]
    number = {place: n for n, place in enumerate(sorted({p for row in places for p in row}), 1)}
    yield "*NODE, NSET=ALL"
    for place, node in number.items():
        yield ", ".join([str(node), *(f"{value:.6f}" for value in EDGES * place)])
    for name in sorted(set(cells.values())):
        yield f"*ELEMENT, TYPE=C3D8I, ELSET={name}"
        for element, (own, row) in enumerate(zip(cells.values(), places, strict=True), start=1):
            if own == name:
                yield ", ".join(map(str, [element, *(number[place] for place in row)]))
        yield f"*MATERIAL, NAME={name}\n*ELASTIC\n210000., 0.3\n*DENSITY\n7.85e-9"
        yield f"*SOLID SECTION, ELSET={name}, MATERIAL={name}"
    face = 2 if grid[2] > 1 else 0  # the feet of what stands, the end of what lies
    yield "*BOUNDARY"
    for place, node in number.items():
        if place[face] == 0:
            yield f"{node}, 1, 3"
    yield "*STEP\n*FREQUENCY\n10\n*NODE FILE\nU\n*END STEP"


def problem(name: str, folder: Path) -> Problem:
    """A structure with the frequencies of its hidden twin."""
    bricks, grid, truth, n_sensors = STRUCTURES[name]
    folder.mkdir()
    parameters = tuple(
        Parameter(f"E_{material}", "youngs_modulus", "material", (material,), 0.5, 2.0, 0.2)
        for material in truth
    )
    lines = list(deck(bricks, grid))
    n_nodes = next(place for place, line in enumerate(lines) if line.startswith("*ELEMENT")) - 1
    sensors = tuple(np.linspace(1, n_nodes, n_sensors).astype(int).tolist())
    empty = Problem(
        name, "only", folder, parameters, tuple(truth.values()), 5, 0, sensors, 1e-5, mode_set([])
    )
    empty.deck.write_text("\n".join(lines) + "\n")
    twin, _ = PlainModel(empty).modes(np.array(empty.truth))
    found = replace(empty, measured=twin.select(range(empty.n_modes)))
    write_problem(found)
    return found


def plate_problem(name: str, folder: Path) -> Problem:
    """A plate of five strips for MYSTRAN, whose own modes are the test."""
    empty = set_up(name, "tiny", 1e-4, folder)
    found = replace(empty, measured=PlainModel(empty).modes(np.array(empty.truth))[0])
    write_problem(found)
    return found


@pytest.mark.parametrize(
    ("name", "made"),
    [
        ("fork", problem),
        ("stairs", problem),
        pytest.param("plate", plate_problem, marks=needs_mystran),
    ],
)
def test_the_driver_of_dakota_gives_the_residual(
    name: str, made: Callable[[str, Path], Problem], tmp_path: Path
) -> None:
    case = made(name, tmp_path / name)
    solver = shutil.which("ccx" if case.solver == "calculix" else "mystran")
    assert solver is not None
    _, flag, study = write_study(case, tmp_path, solver)
    assert flag == "-i"
    driver = re.search(r"analysis_drivers '(.*)'", (tmp_path / study).read_text())
    assert driver is not None
    theta = case.parameter_set.initial * np.linspace(0.97, 1.05, len(case.parameters))
    rows = [
        f"{value!r} {each.name}"
        for value, each in zip(theta.tolist(), case.parameters, strict=True)
    ]
    point = "\n".join([f"{len(rows)} variables", *rows, "1 functions", ""])
    (tmp_path / "params.in").write_text(point)
    command = [*shlex.split(driver[1]), "params.in", "results.out"]
    subprocess.run(command, cwd=tmp_path, check=True)
    expected = PlainModel(case).agreement(theta).residual
    # Shapes are printed with seven digits, frequencies of an F06 too, over deviations of 0.002.
    np.testing.assert_allclose(np.loadtxt(tmp_path / "results.out"), expected, atol=1e-3)
    assert not (tmp_path / "met.json").exists()
    assert not [*tmp_path.glob("run-*")]


@pytest.mark.parametrize("name", STRUCTURES)
def test_the_peer_and_modetune_give_the_same_answer(name: str, tmp_path: Path) -> None:
    case = problem(name, tmp_path / name)
    model = PlainModel(case)
    peer, ours = (run_way(WAYS[letter], case, model, tmp_path / letter, "none") for letter in "fe")
    assert peer.converged
    assert ours.converged
    for trial in (peer, ours):
        # Frequencies to 1e-5 are moduli to some 2e-5 over the share of a modulus in them, which
        # is a hundredth or more here.
        assert trial.largest_distance < 2e-3
    assert peer.parameters == pytest.approx(ours.parameters, abs=4e-3)
    n_parameters = len(case.parameters)
    # At least the start, its differences and the end; modetune has strain energies instead.
    assert peer.cost.modal_runs >= n_parameters + 2
    assert ours.cost.modal_runs + ours.cost.matrix_runs < peer.cost.modal_runs
