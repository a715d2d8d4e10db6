"""Small models on CalculiX: strings and springs of a few freedoms give all the modes they have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.calculix.deck import read_deck
from modetune.adapters.calculix.model import understand
from modetune.adapters.calculix.spare_unknowns import spare_unknowns
from tests.adapters.test_rigid_modes import STEEL, plate, solved


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


def test_models_of_unknowns_enough_get_none(tmp_path: Path) -> None:
    file = tmp_path / "plate.inp"
    file.write_text(plate("S4"))
    model = understand(read_deck(file))
    assert spare_unknowns(model, 15) == []  # 77 nodes
    assert spare_unknowns(model, 16) != []
