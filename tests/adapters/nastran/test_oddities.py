"""Decks with what Nastran runs or warns about: their modes are those of the plain deck."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from tests.adapters.solved import Binder, on_both, solved

CASE = "SOL 103\nCEND\nSPC = 1\nMETHOD = 1\nBEGIN BULK\n"
#: A bent cantilever of bars with different second moments, which has no repeated modes.
BULK = (
    "EIGRL,1,,,6\n"
    + "".join(
        f"GRID,{at},,{0.7 * at},{0.02 * at * at},{0.1 * (at % 3)}\n" for at in range(7)
    ).replace("GRID,0", "GRID,99")
    + "CBAR,1,1,99,1,0.,0.,1.\n"
    + "".join(f"CBAR,{at + 1},1,{at},{at + 1},0.,0.,1.\n" for at in range(1, 6))
    + "PBAR,1,1,1.E-3,2.E-06,5.E-6,4.-06\nMAT1,1,7.E+10,,.3,2700.\nSPC1,1,123456,99\n"
)
PLAIN = CASE + BULK
ODDITIES = {
    "a set of MPC that is not there": (PLAIN.replace("SPC = 1", "SPC = 1\nMPC = 7"), "`MPC = 7`"),
    "a monitor point": (PLAIN + "MONDSP1,WING,WING AND TIP\n,1,0,0.,0.,0.,123\n", ""),
    "a monitor point cut short": (PLAIN + "MONDSP1,WING,1\n", ""),
    "a rotor with blank fields": (PLAIN + "ROTORD,10,0.,100.,10,,,\n,1,,,,\n", "1 ROTORD"),
    "no decimal points": (
        PLAIN.replace("1.E-3,2.E-06,5.E-6,4.-06", "1E-3,2E-06,5-6,4d-06").replace("7.E", "7E"), ""
    ),
    "a lower frequency": (PLAIN.replace("EIGRL,1,", "EIGRL,1,20."), "the lower frequency 20."),
}  # fmt: skip


@on_both
@pytest.mark.parametrize("name", list(ODDITIES))
def test_modes_of_an_odd_deck_are_those_of_the_plain_one(
    binder: Binder, name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    text, note = ODDITIES[name]
    plain = solved(PLAIN, tmp_path, binder)
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        odd = solved(text, tmp_path, binder)
    # The decks of the jobs say the same numbers; each solver's Krylov space starts at random.
    np.testing.assert_allclose(odd.eigenvalues, plain.eigenvalues, rtol=1e-5)
    assert note in caplog.text if note else not caplog.messages
    assert (tmp_path / "model.bdf").read_text() == text


@on_both
def test_an_spc_set_that_is_not_there_constrains_nothing(binder: Binder, tmp_path: Path) -> None:
    free = solved(CASE.replace("SPC = 1\n", "") + BULK, tmp_path, binder, 9)
    odd = solved(PLAIN.replace("SPC = 1", "SPC = 4"), tmp_path, binder, 9)
    np.testing.assert_allclose(odd.eigenvalues[6:], free.eigenvalues[6:], rtol=1e-5)
    held = solved(PLAIN, tmp_path, binder)
    assert free.eigenvalues[6] > 10.0 * held.eigenvalues[0]
