"""Decks with several subcases, against hand-written decks with one."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.nastran.case_control import modal_subcases, read_case_control
from modetune.adapters.nastran.deck import read_deck
from modetune.adapters.nastran.solver import mystran_solver, nastran_solver
from modetune.adapters.solver import ModalAnalysis, Solver
from modetune.adapters.translation.solver import translated_solver
from modetune.core.errors import ModelError
from modetune.core.parameters import Parameter
from tests.adapters.solved import needs_ccx, needs_mystran, result_of

#: A beam of eight bars in steel and aluminium; supports and ties in sets of their own.
BEAM = "".join([
    *(f"GRID,{n},,{0.1 * (n - 1):.1f},0.,0.\n" for n in range(1, 10)),
    *(f"CBAR,{n},{1 if n < 5 else 2},{n},{n + 1},0.,0.,1.\n" for n in range(1, 9)),
    "PBAR,1,1,2.-4,4.-9,3.-9,5.-9\nPBAR,2,2,2.-4,4.-9,3.-9,5.-9\n",
    "MAT1,1,2.1+11,,.3,7850.\nMAT1,2,7.+10,,.33,2700.\nCONM2,50,9,,.2\n",
    "SPC1,1,123456,1\nSPC1,2,1234,1\nSPC1,2,123,9\nSPC1,3,123456,1,9\n",
    "MPC,5,7,3,1.,5,3,-.5\nMPC,6,3,3,1.,5,3,-.5\nEIGRL,1,,,4\nEIGRL,7,,,6\nENDDATA\n",
])  # fmt: skip
#: A plate of two thicknesses.
PLATE = "".join([
    *(f"GRID,{n + 6 * m},,{0.1 * n:.1f},{0.1 * m:.1f},0.\n" for m in range(4)
      for n in range(1, 6)),
    *(f"CQUAD4,{n + 6 * m},{1 if n < 3 else 2},{n + 6 * m},{n + 1 + 6 * m},{n + 7 + 6 * m},"
      f"{n + 6 + 6 * m}\n" for m in range(3) for n in range(1, 5)),
    "PSHELL,1,1,.002,1,,1\nPSHELL,2,1,.003,1,,1\nMAT1,1,7.+10,,.33,2700.\n",
    "SPC1,1,123456,1,7,13,19\nSPC1,2,123456,5,11,17,23\nSPC1,3,123456,1,19\nSPC1,3,123,5,23\n",
    "MPC,5,11,3,1.,17,3,-1.\nEIGRL,1,,,4\nEIGRL,7,,,6\nENDDATA\n",
])  # fmt: skip
#: A truss with springs to the ground.
TRUSS = "".join([
    *(f"GRID,{n},,{0.5 * n:.1f},{0.3 * (n % 2):.1f},{0.1 * (n % 3):.1f}\n" for n in range(1, 8)),
    *(f"CROD,{10 * n + m},1,{n},{n + m}\n" for n in range(1, 7) for m in (1, 2, 3) if n + m < 8),
    "PROD,1,1,3.-4\nMAT1,1,2.1+11,,.3,7850.\n",
    *(f"CELAS2,{100 + 10 * n + c},2.+6,{n},{c}\n" for n in range(1, 8) for c in (1, 2, 3)),
    "SPC1,1,123,1,2\nSPC1,2,123,6\nSPC1,3,123,1,7\n",
    "MPC,5,4,3,1.,5,3,-1.\nEIGRL,1,,,4\nEIGRL,7,,,6\nENDDATA\n",
])  # fmt: skip
CASES = """\
SOL 103
CEND
TITLE = THREE STATES
METHOD = 1
SPC = 3
DISP = ALL
SUBCASE 1
  LABEL = CLAMPED
  SPC = 1
SUBCASE 2
  SUBTITLE = HINGED
  METHOD = 7
  SPC = 2
SUBCASE 40 $ as above
  LABEL = TIED
  MPC = 5
BEGIN BULK
"""
#: What a hand-written deck of each subcase alone selects.
ALONE = {
    1: "METHOD = 1\nSPC = 1\n",
    2: "METHOD = 7\nSPC = 2\n",
    40: "METHOD = 1\nSPC = 3\nMPC = 5\n",
}
STRUCTURES = {"beam": BEAM, "plate": PLATE, "truss": TRUSS}


@pytest.mark.parametrize(
    "binder",
    [
        pytest.param(mystran_solver, marks=needs_mystran, id="mystran"),
        pytest.param(translated_solver, marks=needs_ccx, id="calculix"),
    ],
)
@pytest.mark.parametrize("name", list(STRUCTURES))
def test_modes_of_a_subcase_are_those_of_a_deck_with_it_alone(
    name: str, binder: Callable[..., Solver], tmp_path: Path
) -> None:
    """To the last bit: both decks give the same job."""
    bulk, seen = STRUCTURES[name], []
    path = tmp_path / "model.bdf"
    for number, selections in ALONE.items():
        results = []
        for text, chosen in (
            (CASES + bulk, number),
            (f"SOL 103\nCEND\n{selections}BEGIN BULK\n{bulk}", 0),
        ):
            path.write_text(text)
            solver = binder(path, (), chosen)
            nodes = tuple(sorted(solver.deck.summary.node_ids))
            job = tmp_path / f"job_{number}_{chosen}"
            results.append(result_of(solver, ModalAnalysis(4, nodes), job))
        own, other = results
        np.testing.assert_array_equal(own.eigenvalues, other.eigenvalues)
        np.testing.assert_array_equal(own.modes.mode_shapes, other.modes.mode_shapes)
        seen.append(tuple(np.round(own.eigenvalues[own.n_rigid :], 1)))
    assert len(set(seen)) == 3  # and the states differ


def test_selections_above_are_replaced_by_those_of_the_subcase(tmp_path: Path) -> None:
    path = tmp_path / "model.bdf"
    path.write_text(CASES + BEAM)
    found = {number: read_case_control(read_deck(path, number)) for number in ALONE}
    assert {number: case.method for number, case in found.items()} == {1: 1, 2: 7, 40: 1}
    assert {number: case.selections for number, case in found.items()} == {
        1: ("SPC = 1",),
        2: ("SPC = 2",),
        40: ("SPC = 3", "MPC = 5"),
    }


#: Two subcases with a METHOD of their own and a static one.
TWO = """\
SOL 103
CEND
SUBCASE 1
  LABEL = CLAMPED
  SPC = 1
  METHOD = 1
SUBCASE 2
  METHOD = 7
  SPC = 2
SUBCASE 3
  SPC = 3
BEGIN BULK
"""


def test_without_a_choice_the_subcases_are_named(tmp_path: Path) -> None:
    path = tmp_path / "model.bdf"
    path.write_text(TWO + BEAM)
    with pytest.raises(ModelError) as caught:
        nastran_solver(path, ())
    assert str(caught.value).endswith(
        "`model.subcase` (`--subcase` with a deck) chooses one: 1 (CLAMPED, SPC = 1, METHOD = 1); "
        "2 (METHOD = 7, SPC = 2); 3 (SPC = 3)"
    )
    cases = modal_subcases(read_deck(path))
    assert [(item.number, item.default) for item in cases] == [(1, False), (2, False)]
    path.write_text(CASES.split("SUBCASE")[0] + "BEGIN BULK\n" + BEAM)
    assert modal_subcases(read_deck(path)) == ()


def test_what_counts_without_a_choice_is_reported(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "model.bdf"
    path.write_text(CASES + BEAM)
    cases = modal_subcases(read_deck(path))
    assert [(item.number, item.default) for item in cases] == [(1, False), (2, True), (40, False)]
    with caplog.at_level(logging.WARNING):
        nastran_solver(path, ())
    (said,) = caplog.messages
    assert said == (
        f"{path}: the modes are those of subcase 2 (HINGED, METHOD = 7, SPC = 2); `model.subcase` "
        "(`--subcase` with a deck) chooses another: 1 (CLAMPED, SPC = 1); 40 (TIED, MPC = 5)"
    )
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        nastran_solver(path, (), subcase=1)
        path.write_text(TWO.replace("  METHOD = 7\n", "") + BEAM)
        nastran_solver(path, ())  # one with a METHOD, the others are static
    assert caplog.messages == []


@pytest.mark.parametrize(
    ("text", "number", "said"),
    [
        (CASES, 3, "has no subcase 3; it has 1 (CLAMPED, SPC = 1); 2 (HINGED, METHOD = 7, SPC"),
        ("SOL 103\nCEND\nMETHOD = 1\nBEGIN BULK\n", 2, "so `model.subcase: 2` names none"),
        (CASES.replace("MPC = 5", "STATSUB = 1"), 40, "line 16: STATSUB asks for modes of a pre"),
        (CASES.replace("SUBCASE 40", "SUBCOM 40"), 40, "has no subcase 40"),
    ],
)
def test_subcases_that_cannot_be_taken_are_refused(
    text: str, number: int, said: str, tmp_path: Path
) -> None:
    path = tmp_path / "model.bdf"
    path.write_text(text + BEAM)
    with pytest.raises(ModelError) as caught:
        nastran_solver(path, (), subcase=number)
    assert said in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_parameter_of_another_subcase_does_not_count(tmp_path: Path) -> None:
    path = tmp_path / "model.bdf"
    path.write_text(CASES.replace("  MPC = 5\n", "  MPC = 5\n  PARAM,WTMASS,.5\n") + BEAM)
    masses = [translated_solver(path, (), number).deck.wave_speeds()["MAT1 1"] for number in ALONE]
    assert masses[0] == masses[1]
    assert masses[2] == pytest.approx(masses[0] * 2**0.5)


def test_an_updated_deck_keeps_all_its_subcases(tmp_path: Path) -> None:
    path = tmp_path / "model.bdf"
    path.write_bytes((CASES + BEAM).replace("\n", "\r\n").encode())
    item = Parameter("E", "youngs_modulus", "material", ("2",), 0.5, 2.0, 0.1)
    deck = nastran_solver(path, (item,), subcase=2).deck
    written = deck.write_updated({"E": 1.1}, tmp_path / "updated").read_bytes().splitlines(True)
    before = path.read_bytes().splitlines(True)
    (changed,) = [n for n, pair in enumerate(zip(before, written, strict=True)) if len({*pair}) > 1]
    assert before[changed].startswith(b"MAT1,2,")
    assert written[changed].endswith(b"\r\n")
