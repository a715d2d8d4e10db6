"""Sensitivities of SOL 200: the one public file that has them, and what damaged ones do."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.nastran.design import read_dscm2
from modetune.core.errors import SolverCrashed

RODS = Path(__file__).parents[1] / "data" / "nastran" / "rods.op2"


def goland(shared_data: Path) -> Path:
    return shared_data / "nastran" / "pn_goland_sol200_dscm2" / "goland_final_test.op2"


def test_the_sensitivities_of_msc_have_their_variables_and_responses(shared_data: Path) -> None:
    found = read_dscm2(goland(shared_data))
    reference = json.loads((shared_data / "refs" / "goland_msc_sol200_dscm2.json").read_text())
    # The reference vouches for two rows and two columns, and prints nine digits.
    wanted = np.array(reference["DSCM2"])[:2, :2]
    np.testing.assert_allclose(found.values[:2, :2], wanted, rtol=1e-8)
    assert found.design_variables.tolist() == [row["id"] for row in reference["desvar_rows"]]
    assert found.responses[:2].tolist() == [1, 4]  # the DRESP1 cards of weight and frequency
    assert found.responses.size == 4
    # An independent solver's central differences of the same model (the reference's own note).
    check = reference["independent_check_MYSTRAN"]
    assert found.values[0, 0] == pytest.approx(check["dWeight_dSkT"], rel=1e-6)
    assert found.values[0, 1] == pytest.approx(check["df1_dSkT_central_FD"], rel=1e-3)


@pytest.mark.parametrize("name", ["DSCM2   ", "DSCMCOL ", "EDOM    "])
def test_a_missing_table_is_refused_with_the_request_that_writes_it(
    shared_data: Path, tmp_path: Path, name: str
) -> None:
    path = tmp_path / "job.op2"
    path.write_bytes(goland(shared_data).read_bytes().replace(name.encode(), b"OTHER   "))
    with pytest.raises(SolverCrashed, match=rf"{name.strip()}.*PARAM,POST,-1.*DSAPRT"):
        read_dscm2(path)


def test_a_modal_file_is_refused() -> None:
    with pytest.raises(SolverCrashed, match="no table DSCM2"):
        read_dscm2(RODS)


def test_a_file_cut_anywhere_is_refused(shared_data: Path, tmp_path: Path) -> None:
    whole = goland(shared_data).read_bytes()
    for length in np.linspace(0, len(whole) - 1, 40).astype(int):
        path = tmp_path / "cut.op2"
        path.write_bytes(whole[:length])
        with pytest.raises(SolverCrashed):
            read_dscm2(path)


def test_a_byte_changed_anywhere_is_refused_or_read(shared_data: Path, tmp_path: Path) -> None:
    whole = goland(shared_data).read_bytes()
    generator = np.random.default_rng(3)
    start = whole.index(b"DSCMCOL ") - 100  # where all that is read stands but EDOM
    for _ in range(200):
        data = bytearray(whole)
        data[generator.integers(start, len(data))] ^= int(generator.integers(1, 256))
        path = tmp_path / "flipped.op2"
        path.write_bytes(data)
        try:
            found = read_dscm2(path)
        except SolverCrashed:
            continue
        assert found.values.shape == (3, 4)
