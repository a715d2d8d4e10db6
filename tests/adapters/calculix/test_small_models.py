"""Small models on CalculiX: strings and springs of a few freedoms give all the modes they have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.calculix.deck import read_deck
from modetune.adapters.calculix.job import spare_unknowns
from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.calculix.structure import understand
from modetune.adapters.solver import ModalAnalysis
from modetune.core.updating.job_results import ModalResult
from tests.adapters.calculix.test_model import parameter
from tests.adapters.solved import needs_ccx
from tests.adapters.test_rigid_modes import STEEL, hinged, plate, solved
from tests.adapters.test_solver_contract import run


def chain(n: int) -> str:
    """Masses of 1 on springs of 1000 in a row, the first to ground."""
    nodes = "".join(f"{node}, {node}., 0., 0.\n" for node in range(1, n + 1))
    masses = "".join(f"{node}, {node}\n" for node in range(1, n + 1))
    links = "".join(f"{200 + node}, {node}, {node + 1}\n" for node in range(1, n))
    text = f"*NODE, NSET=NALL\n{nodes}*ELEMENT, TYPE=MASS, ELSET=M\n{masses}*MASS, ELSET=M\n1.\n"
    text += "*ELEMENT, TYPE=SPRING1, ELSET=G\n100, 1\n*SPRING, ELSET=G\n1\n1000.\n"
    if n > 1:
        text += f"*ELEMENT, TYPE=SPRING2, ELSET=L\n{links}*SPRING, ELSET=L\n1, 1\n1000.\n"
    return text + "*BOUNDARY\nNALL, 2, 3\n"


@pytest.mark.parametrize("n", [1, 2, 5, 18])
@pytest.mark.parametrize("asked", [1, 16])
def test_a_chain_gives_as_many_modes_as_it_has_freedoms(tmp_path: Path, n: int, asked: int) -> None:
    # Fixed-free chain of equal links: sqrt(k / m) / pi sin((2 j - 1) pi / (4 n + 2)).
    result = solved(chain(n), tmp_path, asked, (1,))
    expected = min(n, asked)
    angles = (2 * np.arange(1, expected + 1) - 1) * np.pi / (4 * n + 2)
    assert result.modes.frequencies_hz == pytest.approx(
        1000.0**0.5 / np.pi * np.sin(angles), rel=1e-6
    )
    assert result.n_rigid == 0
    assert result.mass == pytest.approx(n)
    assert result.energy_balance == pytest.approx(np.ones(expected), abs=1e-5)


def test_a_string_of_five_trusses_gives_its_modes(tmp_path: Path) -> None:
    nodes = "".join(f"{n + 1}, {n / 5:.9g}, 0., 0.\n" for n in range(6))
    rods = "".join(f"{n}, {n}, {n + 1}\n" for n in range(1, 6))
    text = f"*NODE\n{nodes}*ELEMENT, TYPE=T3D2, ELSET=EALL\n{rods}{STEEL}"
    text += "*SOLID SECTION, ELSET=EALL, MATERIAL=STEEL\n1e-6\n*BOUNDARY\n1, 1, 3\n6, 2, 3\n"
    text += "*STEP, NLGEOM\n*STATIC\n*CLOAD\n6, 1, 100.\n*END STEP\n"
    text += "*STEP, PERTURBATION\n*FREQUENCY\n4\n*END STEP\n"
    result = solved(text, tmp_path, 16)
    # Four nodes with three translations, and one that moves along.
    assert result.modes.n_modes == 13
    expected = 0.5 * (100.0 / 7.8e-3) ** 0.5 * np.arange(1, 4)  # k / 2 l sqrt(T / mu)
    assert result.modes.frequencies_hz[:3] == pytest.approx(expected, rel=0.03)


@needs_ccx
@pytest.mark.parametrize("asked", [8, 11, 13, 16, 20])
@pytest.mark.parametrize("n_hinges", [1, 2])
def test_free_hinges_keep_their_modes_beside_spare_ones(
    n_hinges: int, asked: int, tmp_path: Path
) -> None:
    """A singular K: spare eigenvalues too large, or too near each other, hide its modes."""
    result = solved(hinged(n_hinges), tmp_path, asked, (1,))
    assert result.n_rigid == min(6 + n_hinges, asked)
    assert result.modes.n_modes == asked


def test_models_of_unknowns_enough_get_none(tmp_path: Path) -> None:
    file = tmp_path / "plate.inp"
    file.write_text(plate("S4"))
    model = understand(read_deck(file))
    assert spare_unknowns(model, 15) == []  # 77 nodes
    assert spare_unknowns(model, 16) != []


@needs_ccx
def test_users_shells_have_modes_without_energies_and_mass(tmp_path: Path) -> None:
    """A clamped strip of ccx's own user shells, US3, of which it prints neither."""
    places = [(i, j) for j in range(3) for i in range(9)]
    number = {place: at for at, place in enumerate(places, start=1)}
    rows: list[str] = []
    for i, j in places:
        if i < 8 and j < 2:
            a, b, c, d = (number[i + x, j + y] for x, y in ((0, 0), (1, 0), (1, 1), (0, 1)))
            rows += [f"{len(rows) + 1}, {a}, {b}, {c}", f"{len(rows) + 2}, {a}, {c}, {d}"]
    text = "*NODE\n" + "".join(f"{n}, {25 * i}., {10 * j}., 0.\n" for (i, j), n in number.items())
    text += "*USER ELEMENT, TYPE=US3, NODES=3, INTEGRATION POINTS=3, MAXDOF=6\n"
    text += "*ELEMENT, TYPE=US3, ELSET=E\n" + "\n".join(rows)
    text += "\n*MATERIAL, NAME=A\n*ELASTIC\n70000., 0.\n*DENSITY\n2.7e-9\n"
    text += "*USER SECTION, ELSET=E, MATERIAL=A, CONSTANTS=1\n2.\n*BOUNDARY\n"
    text += "".join(f"{number[0, j]}, 1, 6\n" for j in range(3))
    path = tmp_path / "strip.inp"
    path.write_text(text)
    wanted = parameter("youngs_modulus", "A")
    solver = calculix_solver(path, (wanted,))
    assert solver.deck.energy_sets(wanted) == ()
    result = run(solver, {"p": 1.21}, ModalAnalysis(2, (9, 18)), tmp_path)
    assert isinstance(result, ModalResult)
    # Euler and Bernoulli, without Poisson's ratio: 1.8751^2 / (2 pi l^2) sqrt(E t^2 / (12 rho)).
    first = 1.8751**2 / (2 * np.pi * 200.0**2) * np.sqrt(1.21 * 70000.0 * 2.0**2 / (12 * 2.7e-9))
    assert result.modes.frequencies_hz[0] == pytest.approx(first, rel=0.01)
    assert result.modes.n_dof == 6  # translations alone of the six unknowns
    assert np.isnan(result.mass)
    assert np.isnan(result.total_strain_energy).all()
