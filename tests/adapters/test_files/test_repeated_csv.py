"""Tables with a row a test."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from openpyxl import Workbook

from modetune.adapters.test_files.hdf5 import write_test_hdf5
from modetune.adapters.test_files.measurements import read_measurement
from modetune.core.errors import CampaignError

TABLE = """# a frame
test,frequency_1_hz,frequency_3_hz,damping_1,damping_3
a,10.0,30.0,0.01,0.02
b,10.1,30.2,,0.03
c,9.9,,0.012,0.025
"""


def read(path: Path, text: str) -> list[str]:
    path.write_text(text)
    with pytest.raises(CampaignError) as raised:
        read_measurement([path])
    return list(raised.value.problems)


def test_a_row_a_test_is_read_with_gaps(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(TABLE)
    found = read_measurement([tmp_path / "t.csv"])
    assert found.modes is not None
    assert found.repeats is not None
    assert found.modes.numbers == (1, 3)
    assert found.modes.modes.frequencies_hz == pytest.approx([10.0, 30.1], rel=2e-3)
    assert found.repeats.places[2] == f"{tmp_path / 't.csv'}, line 5"
    assert np.argwhere(np.isnan(found.repeats.frequencies_hz)).tolist() == [[2, 1]]
    assert np.argwhere(np.isnan(found.repeats.damping_ratios)).tolist() == [[1, 0]]
    assert found.notes == ("of 3 tests not all found every mode: mode 3 in 1 not",)
    write_test_hdf5(tmp_path / "t.h5", found)
    again = read_measurement([tmp_path / "t.h5"])
    assert again.repeats is not None
    assert again.deviations is not None
    assert again.repeats.places == found.repeats.places
    np.testing.assert_array_equal(again.repeats.frequencies_hz, found.repeats.frequencies_hz)
    assert found.deviations is not None
    assert (again.deviations.correlation == found.deviations.correlation).all()  # type: ignore[union-attr]


@pytest.mark.parametrize(
    "text",
    [
        "Test;Mode 1 Frequency [Hz];Mode 2 Frequency [Hz]\n1;10,0;20,0\n2;10,1;-\n3;9,9;20,1\n",
        "f1\tf2\n10\t20\n10.1\tn/a\n9.9\t20.1\n",
        "run,Freq 1 (kHz),Freq 2 (kHz),Damping 1 (%)\n1,.01,.02,1\n2,.0101,,2\n3,.0099,.0201,1\n",
    ],
)
def test_spreadsheets_may_write_it_their_way(tmp_path: Path, text: str) -> None:
    (tmp_path / "t.csv").write_text(text)
    found = read_measurement([tmp_path / "t.csv"]).repeats
    assert found is not None
    expected = np.array([[10.0, 20.0], [10.1, np.nan], [9.9, 20.1]])
    np.testing.assert_allclose(found.frequencies_hz, expected)


def test_a_workbook_is_read_likewise(tmp_path: Path) -> None:
    book = Workbook()
    for line in TABLE.splitlines()[1:]:
        cells = [float(c) if c[:1].isdecimal() else c or None for c in line.split(",")]
        book.active.append(cells)
    book.save(tmp_path / "t.xlsx")
    (tmp_path / "t.csv").write_text(TABLE)
    one, two = (read_measurement([tmp_path / f"t.{kind}"]).repeats for kind in ("csv", "xlsx"))
    assert one is not None
    assert two is not None
    np.testing.assert_array_equal(one.frequencies_hz, two.frequencies_hz)
    assert two.places[2].endswith("row 4")


def test_every_fault_has_its_line(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    found = read(
        path, TABLE.replace("10.1", "ten").replace("30.0", "-30").replace("c,", "c,1,2,3,")
    )
    assert [text.split(":")[0].rpartition(", ")[2] for text in found] == [
        "line 3",
        "line 4",
        "line 5",
    ]
    assert "`frequency_1_hz` has 'ten'" in found[1]
    assert "8 values under 5 headings" in found[2] or "values under 5 headings" in found[2]
    (told,) = read(path, TABLE.replace("damping_3", "damping_4"))
    assert told == f"{path}, line 2: mode 4 has damping, but no frequency"
    (told,) = read(path, TABLE.replace("damping_1", "colour"))
    assert "column `colour` is neither a frequency nor a damping of a mode" in told
    (told,) = read(path, TABLE.replace("10.1", "30").replace("9.9", "30"))
    assert "mode 1 is more than 10 % from its median" in told
    assert "number the modes alike" in told
    (told,) = read(path, "f1,f2\n10,20\n")
    assert told == f"{path}, line 1: 1 test follows; repeated tests are two or more"
    (told,) = read(path, "f1,f2\n10,20\n10,20\n")
    assert "the repeated tests are identical" in told


def test_fifty_tests_of_a_frame(shared_data: Path) -> None:
    """Leibniz University Hannover's 4-DOF benchmark, EURODYN 2026."""
    path = shared_data / "four_storey" / "tests_br.csv"
    found = read_measurement([path])
    assert found.modes is not None
    assert found.repeats is not None
    # Means of the columns; of mode 4 without the one test in which it is 1.2 % too low.
    hz = [15.538615, 44.619224, 70.531457, 87.109371]
    assert found.modes.modes.frequencies_hz == pytest.approx(hz, rel=1e-7)
    wrong, drift = found.notes
    assert wrong.startswith(f"{path}, line 32: mode 4 at 86.0895 Hz is left out")
    assert drift.startswith("the 50 tests drift")
