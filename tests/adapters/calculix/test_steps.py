"""Decks with several steps, against plain runs of the same decks by ccx."""

from __future__ import annotations

import logging
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.calculix.constraints import read_constraints
from modetune.adapters.calculix.deck import read_deck
from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.calculix.steps import frequency_steps
from modetune.adapters.calculix.structure import understand
from modetune.adapters.solver import ModalAnalysis
from modetune.core.errors import ModelError
from modetune.core.modes import Floats
from tests.adapters.solved import needs_ccx, result_of

CORNERS = ((0.0, 0.0), (20.0, 0.0), (20.0, 10.0), (0.0, 10.0))
NODES = "".join(
    f"{4 * at + corner + 1},{100.0 * at},{y},{z}\n"
    for at in range(11)
    for corner, (y, z) in enumerate(CORNERS)
)
BRICKS = "".join(
    ",".join(map(str, [at + 1, *range(4 * at + 1, 4 * at + 9)])) + "\n" for at in range(10)
)
ROOT, TIP = range(1, 5), range(41, 45)
#: A cantilever 1 m long; a tip load along it of 288 N would buckle it.
BEAM = (
    f"*NODE\n{NODES}*ELEMENT, TYPE=C3D8I, ELSET=BEAM\n{BRICKS}"
    "*MATERIAL, NAME=ALU\n*ELASTIC\n70000., 0.3\n*DENSITY\n2.7e-9\n"
    "*SOLID SECTION, ELSET=BEAM, MATERIAL=ALU\n*NSET, NSET=ROOT, GENERATE\n1,4\n"
    "*NSET, NSET=TIP, GENERATE\n41,44\n*BOUNDARY\nROOT,1,3\n"
)
FREE = "*STEP\n*FREQUENCY\n4\n*NODE FILE\nU\n*END STEP\n"
PINNED = "*STEP\n*BOUNDARY\nTIP,3,3\n*FREQUENCY\n4\n*NODE FILE\nU\n*END STEP\n"
TENSION = "*STEP\n*STATIC\n*CLOAD\nTIP,1,500.\n*NODE FILE\nU\n*END STEP\n"
LOADED = "*STEP, PERTURBATION\n*FREQUENCY\n4\n*NODE FILE\nU\n*END STEP\n"
UNPINNED = "*STEP\n*BOUNDARY, OP=NEW\nROOT,1,3\n*FREQUENCY\n4\n*NODE FILE\nU\n*END STEP\n"
#: The root, and the tip's other direction instead.
MOVED = UNPINNED.replace("ROOT,1,3\n", "ROOT,1,3\n*BOUNDARY, OP=NEW\nTIP,2,2\n")
DECKS = {
    "free, then preloaded": (FREE + TENSION + LOADED, (1, 3)),
    "preloaded, then free": (TENSION + LOADED + FREE, (2, 3)),
    "supports of a step stay": (FREE + PINNED + TENSION + LOADED, (1, 2, 4)),
    "until a step has new ones": (PINNED + FREE + UNPINNED, (1, 2, 3)),
    "new ones of two cards move on": (PINNED + MOVED + TENSION + LOADED, (1, 2, 4)),
    "steps in a row": (TENSION + LOADED + PINNED + LOADED, (2, 3, 4)),
}


def ccx_tables(folder: Path, text: str) -> list[Floats]:
    """Eigenvalues of each step with modes, by ccx from the deck as it is."""
    (folder / "author.inp").write_text(text)
    program = shutil.which("ccx")
    assert program is not None
    subprocess.run([program, "-i", "author"], cwd=folder, check=True, capture_output=True)
    printed = (folder / "author.dat").read_text()
    tables = []
    for part in printed.split("E I G E N V A L U E   O U T P U T")[1:]:
        rows = re.findall(
            r"^ +\d+ +(\S+) +\S+ +\S+ +\S+ *$", part.split("P A R T I C I P")[0], re.M
        )
        tables.append(np.array(rows, dtype=float))
    return tables


@needs_ccx
@pytest.mark.parametrize("name", list(DECKS))
def test_modes_of_each_step_are_those_of_the_authors_deck(name: str, tmp_path: Path) -> None:
    steps, modal = DECKS[name]
    path = tmp_path / "beam.inp"
    path.write_text(BEAM + steps)
    expected = ccx_tables(tmp_path, BEAM + steps)
    assert len(expected) == len(modal)
    assert [item.number for item in frequency_steps(read_deck(path))] == list(modal)
    for number, table in zip(modal, expected, strict=True):
        solver = calculix_solver(path, (), number)
        found = result_of(solver, ModalAnalysis(4, (41,)), tmp_path / f"step_{number}")
        # Seven printed digits of one eigensolver, whose Krylov space starts at random.
        np.testing.assert_allclose(found.eigenvalues, table, rtol=2e-6)
    last = result_of(calculix_solver(path, ()), ModalAnalysis(4, (41,)), tmp_path / "last")
    np.testing.assert_allclose(last.eigenvalues, expected[-1], rtol=2e-6)
    assert path.read_text() == BEAM + steps


@needs_ccx
def test_modes_below_a_lower_frequency_keep_their_numbers(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """ccx itself prints the modes 4 to 6 of six for this range, by these numbers."""
    path = tmp_path / "beam.inp"
    path.write_text(BEAM + FREE.replace("4\n*NODE", "6, 100.\n*NODE"))
    (above,) = ccx_tables(tmp_path, path.read_text())
    assert len(above) == 3
    with caplog.at_level(logging.WARNING):
        found = result_of(calculix_solver(path, ()), ModalAnalysis(6, (41,)), tmp_path / "job")
    np.testing.assert_allclose(found.eigenvalues[3:], above, rtol=2e-6)
    assert (found.eigenvalues[:3] < (2.0 * np.pi * 100.0) ** 2).all()
    assert "line 71: the lower frequency 100 of *FREQUENCY is left out" in caplog.text


@needs_ccx
def test_a_preload_moves_the_modes_and_is_reported_of_its_step_alone(tmp_path: Path) -> None:
    path = tmp_path / "beam.inp"
    path.write_text(BEAM + FREE + TENSION + LOADED)
    free, loaded = ccx_tables(tmp_path, BEAM + FREE + TENSION + LOADED)
    assert np.sqrt(loaded[0] / free[0]) > 1.5  # 7 times the buckling load, pulling
    assert "step before that of the frequencies" in calculix_solver(path, ()).deck.preload()
    assert calculix_solver(path, (), 1).deck.preload() == ""


def test_the_default_is_the_last_step_and_is_reported(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "beam.inp"
    path.write_text(BEAM + FREE + TENSION + LOADED)
    with caplog.at_level(logging.WARNING):
        calculix_solver(path, ())
    (said,) = caplog.messages
    start = 1 + (BEAM + FREE + TENSION).count("\n")
    first = 1 + BEAM.count("\n")
    assert said.startswith(f"{path}, line {start}: the modes are those of step 3, the last with")
    assert said.endswith(f"chooses another: 1 (line {first})")
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        calculix_solver(path, (), 1)
        path.write_text(BEAM + TENSION + LOADED)
        calculix_solver(path, ())
    assert caplog.messages == []


@pytest.mark.parametrize("number", [2, 4])
def test_a_step_without_modes_is_refused_with_those_that_have_them(
    number: int, tmp_path: Path
) -> None:
    path = tmp_path / "beam.inp"
    path.write_text(BEAM + FREE + TENSION + LOADED)
    with pytest.raises(ModelError) as caught:
        calculix_solver(path, (), number)
    first, last = (1 + text.count("\n") for text in (BEAM, BEAM + FREE + TENSION))
    assert str(caught.value) == (
        f"{path}: step {number} has no *FREQUENCY, or is not there; steps with *FREQUENCY: "
        f"1 (line {first}), 3 (line {last}, PERTURBATION)"
    )


def test_supports_are_those_of_the_step(tmp_path: Path) -> None:
    path = tmp_path / "beam.inp"
    path.write_text(BEAM + FREE + PINNED + UNPINNED)
    root = {(node, component) for node in ROOT for component in (1, 2, 3)}
    both = root | {(node, 3) for node in TIP}
    for step, held in ((1, root), (2, both), (3, root), (0, root)):
        assert read_constraints(understand(read_deck(path, step))).held == held
