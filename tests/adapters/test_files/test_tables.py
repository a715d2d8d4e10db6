"""Tables as laboratories send them: dialects of CSV, headings in words with units, workbooks."""

from __future__ import annotations

import datetime
import math
import zipfile
from pathlib import Path

import numpy as np
import pytest
from openpyxl import Workbook

from modetune.adapters.test_files.measurements import read_measurement
from modetune.adapters.test_files.modes_csv import read_modes_csv, sensor_of
from modetune.adapters.test_files.tables import heading, number, read_tables
from modetune.core.errors import CampaignError

#: A bell's two modes, a column a mode, as a German spreadsheet saves them.
GERMAN = """\
sep=;
Mode;1;2
Eigenfrequenz [Hz];412,5;1,02E+03
Dämpfung [%];0,25;0,4
11:+X;0,5;-0,25
11:-Z;1;0
"""
#: The same, a row a mode.
BY_ROWS = """\
Mode\tFrequency (kHz)\tDamping ratio\t11.x\t11.z
1\t0.4125\t0.0025\t0.5\t-1
2\t1.02\t0.004\t-0.25\t0
"""


def check(path: Path) -> None:
    found = read_measurement([path]).modes
    assert found is not None
    assert found.numbers == (1, 2)
    np.testing.assert_allclose(found.modes.frequencies_hz, [412.5, 1020.0], rtol=1e-12)
    np.testing.assert_allclose(found.modes.damping_ratios, [0.0025, 0.004], rtol=1e-12)
    assert found.modes.nodes.tolist() == [11, 11]
    assert found.modes.components.tolist() == [1, 3]
    assert found.modes.mode_shapes.tolist() == [[0.5, -0.25], [-1.0, 0.0]]


@pytest.mark.parametrize(
    "data",
    [
        GERMAN.encode("utf-8"),
        GERMAN.encode("latin-1"),
        GERMAN.encode("utf-8-sig"),
        GERMAN.encode("utf-16"),
        GERMAN.replace("\n", "\r\n").encode("cp1252"),
        GERMAN.replace("sep=;\n", "").replace(";", "\t").encode(),
        GERMAN.replace(",", ".").replace("sep=;\n", "").replace(";", ",").encode(),
        BY_ROWS.encode(),
        BY_ROWS.replace("\t", ",").encode(),
        BY_ROWS.replace(".", ",").replace("\t", ";").replace(";11,", ";11.").encode(),
        "\n".join(line.partition("\t")[2] for line in BY_ROWS.splitlines()).encode(),
        b"mode 1 2\nfrequency/Hz 412.5 1020\ndamping_ratio 0.0025 0.004\n11X 0.5 -0.25\n11Z- 1 0",
    ],
    ids=[
        "semicolons and decimal commas",
        "Latin-1",
        "byte order mark",
        "UTF-16",
        "Windows",
        "tabs",
        "commas",
        "a row a mode",
        "a row a mode, commas",
        "a row a mode, decimal commas",
        "a row a mode, not numbered",
        "blanks",
    ],
)
def test_dialects_read_the_same(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "modes.csv"
    path.write_bytes(data)
    check(path)


def book(path: Path, **sheets: list[list[object]]) -> Path:
    made = Workbook()
    made.remove(made.active)
    for name, rows in sheets.items():
        sheet = made.create_sheet(name)
        for row in rows:
            sheet.append(row)
    made.save(path)
    return path


MODES: list[list[object]] = [
    [],
    ["Mode", 1, 2],
    ["Frequency [Hz]", 412.5, 1020],
    ["Damping [%]", 0.25, 0.4],
    ["11.x", 0.5, -0.25],
    ["11.z", -1, 0],
]
PLACES: list[list[object]] = [["Node", "x [mm]", "y [mm]", "z [mm]"], [11, 0, 12.5, -3]]


@pytest.mark.parametrize("name", ["bell.xlsx", "modes.csv", "bell.unv", "bell"])
def test_a_workbook_is_read_whatever_its_name_is(tmp_path: Path, name: str) -> None:
    path = book(tmp_path / name, Notes=[["hammer, 3 g"]], Modes=MODES, Geometry=PLACES)
    check(path)
    found = read_measurement([path])
    assert found.geometry is not None
    assert found.geometry.metres == 0.001
    assert found.geometry.coordinates.tolist() == [[0.0, 12.5, -3.0]]
    assert found.notes == (f"{path}, sheet Notes is passed over",)


def test_a_workbook_without_modes_is_told_by_its_sheets(tmp_path: Path) -> None:
    path = book(tmp_path / "modes.csv", Plan=[["Monday"]], Costs=[[1, 2]])
    with pytest.raises(CampaignError, match="is an Excel workbook with sheets Plan, Costs"):
        read_measurement([path])


def test_a_cell_that_is_no_number_names_sheet_and_row(tmp_path: Path) -> None:
    # Spreadsheets take 5.6 for a date in some countries.
    rows = [*MODES[:4], ["11.x", datetime.date(2024, 6, 5), 1.0]]
    path = book(tmp_path / "bell.xlsx", Modes=rows)
    with pytest.raises(CampaignError) as raised:
        read_measurement([path])
    assert str(raised.value).startswith(f"{path}, sheet Modes, row 5: `11.x` has '2024-06-05")


def test_a_workbook_cut_short_is_refused(tmp_path: Path) -> None:
    path = book(tmp_path / "bell.xlsx", Modes=MODES)
    path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(CampaignError, match="is a ZIP archive or Office file that is cut short"):
        read_measurement([path])


@pytest.mark.parametrize("part", ["xl/workbook.xml", "xl/worksheets/sheet1.xml"])
def test_a_workbook_with_a_broken_part_is_refused(tmp_path: Path, part: str) -> None:
    whole = book(tmp_path / "bell.xlsx", Modes=MODES)
    broken = tmp_path / "broken.xlsx"
    with zipfile.ZipFile(whole) as old, zipfile.ZipFile(broken, "w") as new:
        for item in old.infolist():
            new.writestr(item, b"<a><b>" if item.filename == part else old.read(item))
    with pytest.raises(CampaignError, match="is not a whole Excel workbook"):
        read_measurement([broken])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("mode;1;2\nfrequency_hz;1,234;5.6\n", "line 2: '5.6', and '1,234' in .*line 2: decimal"),
        ("mode,1,2\nfrequency_hz,5,5,6,5\n", "line 2: .* 4 values for 2 modes .decimal commas?"),
        ("mode;1;2\nfrequency [rpm];1;2\n", "line 2: .frequency_hz. has the unit 'rpm'; known are"),
        ("Mode;Frequency\n1;5;6\n", "line 2: 3 values under 2 headings"),
        ("mode;1\nFrequency;5\nfrequency [Hz];5\n", "line 3: a second row `frequency .Hz.`"),
        ("mode;1\nfrequency;5\n7.x;1\nwing:7:-X;2\n", "line 4: a second row `wing:7:-X`"),
    ],
)
def test_what_cannot_be_names_its_line(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "modes.csv"
    path.write_text(text)
    with pytest.raises(CampaignError, match=said):
        read_modes_csv(path)


@pytest.mark.parametrize(
    ("name", "sensor"),
    [
        ("101.x", ((101, 1), 1.0)),
        ("101:+Z", ((101, 3), 1.0)),
        ("wing:101:-Y", ((101, 2), -1.0)),
        ("Point 12 Z", ((12, 3), 1.0)),
        ("12z-", ((12, 3), -1.0)),
        ("7.rz", ((7, 6), 1.0)),
        ("7", None),
        ("x", None),
        ("7.w", None),
        ("7-x", None),  # a dash between, or a sign
        ("1.5.x", None),
    ],
)
def test_sensors_are_known_by_the_names_of_test_systems(
    name: str, sensor: tuple[tuple[int, int], float] | None
) -> None:
    assert sensor_of(name) == sensor


@pytest.mark.parametrize(
    ("text", "meaning"),
    [
        ("Frequency [Hz]", ("frequency_hz", "hz")),
        ("frequency_hz", ("frequency_hz", "")),
        ("Natural frequency (rad/s)", ("frequency_hz", "rad/s")),
        ("Damping in %", ("damping_ratio", "%")),
        ("DÄMPFUNG [%]", ("damping_ratio", "%")),
        ("X/mm", ("x", "mm")),
        ("Point ID", ("node", "")),
        ("remark", ("remark", "")),
    ],
)
def test_headings_are_words_with_units(text: str, meaning: tuple[str, str]) -> None:
    assert heading(text) == meaning


def test_numbers_have_one_decimal_mark() -> None:
    assert [number(text) for text in ("1.5", "1,5", "-2", "1e3", "1,5E-3", "1.0D+02", ".5")] == [
        1.5, 1.5, -2.0, 1000.0, 0.0015, 100.0, 0.5,
    ]  # fmt: skip
    for text in ("", "1.234,5", "1_000", "nan", "inf", "1 000", "0x1p3", "1e999", "٣"):
        assert math.isnan(number(text)), text


def test_a_tables_rows_know_their_places(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text("# a\n\nmode;1\n;;\nfrequency;5;;\n")
    (table,) = read_tables(path)
    assert [(row.where, row.fields) for row in table.rows] == [
        (f"{path}, line 3", ("mode", "1")),
        (f"{path}, line 5", ("frequency", "5")),
    ]


def test_workbooks_that_unpack_without_end_are_refused_before_they_are_read(tmp_path: Path) -> None:
    path = book(tmp_path / "bomb.xlsx", Modes=MODES)
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xl/worksheets/sheet9.xml", b"<row/>" * 4_000_000)
    with pytest.raises(CampaignError, match=r"unpacks from 0\.\d+ to 24 MB, .* as CSV"):
        read_tables(path)


def test_cells_are_counted_while_a_workbook_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("modetune.adapters.test_files.tables.MOST_CELLS", 30)
    path = book(tmp_path / "large.xlsx", Modes=[["mode", 1, 2]] * 5, More=[["mode", 1, 2]] * 5)
    with pytest.raises(CampaignError, match=r"sheet More has more than .* million cells"):
        read_tables(path)
