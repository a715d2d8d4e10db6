"""What else was measured with a test: rows of its tables, files of their own, campaign keys."""

from __future__ import annotations

from pathlib import Path

import pytest
from openpyxl import Workbook

from modetune.adapters.test_files.measurements import read_measurement, write_test
from modetune.core.errors import CampaignError
from modetune.flows.campaign.campaign import load_campaign
from tests.command_line import run_command

MODES = "mode, 1, 2\nfrequency_hz, 3.0, 5.0\n101.x, 1, 0.5\n102.x, 0.7, -1\n"
ROWS = "environment temperature_C, 21.5\nEnvironment: wind m/s, -3\n"
VALUES = {"temperature_C": 21.5, "wind m/s": -3.0}
SIX_MASS = Path(__file__).resolve().parents[3] / "configs" / "six_mass"


def file(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text)
    return path


@pytest.mark.parametrize("text", [MODES + ROWS, ROWS + MODES])
def test_rows_may_be_anywhere_in_a_table_of_modes(tmp_path: Path, text: str) -> None:
    found = read_measurement([file(tmp_path, "night.csv", text)])
    assert found.environment == VALUES
    assert found.modes is not None
    assert (found.modes.numbers, found.modes.modes.n_dof) == ((1, 2), 2)


def test_rows_below_a_table_with_a_row_a_mode(tmp_path: Path) -> None:
    text = "Mode;Frequency [Hz];11:+X\n1;412,5;0,5\n2;1020;-0,25\nenvironment temperature_C;21,5\n"
    found = read_measurement([file(tmp_path, "night.csv", text)])
    assert found.environment == {"temperature_C": 21.5}
    assert found.modes is not None
    assert found.modes.modes.frequencies_hz.tolist() == [412.5, 1020.0]


def test_a_file_with_these_rows_alone_joins_the_other_files(tmp_path: Path) -> None:
    modes, weather = file(tmp_path, "m.csv", MODES), file(tmp_path, "weather.csv", ROWS)
    assert read_measurement([modes, weather]).environment == VALUES
    with pytest.raises(CampaignError, match="two files give temperature_C of the environment"):
        read_measurement([file(tmp_path, "n.csv", MODES + ROWS), weather])


def test_a_sheet_of_a_workbook_may_hold_them(tmp_path: Path) -> None:
    book = Workbook()
    sheet = book.active
    for row in (["mode", 1], ["frequency_hz", 3.0], ["101.x", 1.0]):
        sheet.append(row)
    book.create_sheet("weather").append(["environment temperature_C", 21.5])
    book.save(tmp_path / "night.xlsx")
    assert read_measurement([tmp_path / "night.xlsx"]).environment == {"temperature_C": 21.5}


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("environment temperature_C, warm", "line 5: `environment temperature_C` has warm, where"),
        ("environment temperature_C", "has nothing, where one number must be"),
        ("environment temperature_C, 20, 21", "has 20, 21, where one number must be"),
        (f"{ROWS}environment temperature_C, 3", "line 7: a second row `environment temperature_C`"),
    ],
)
def test_a_wrong_row_is_refused_with_its_line(tmp_path: Path, row: str, said: str) -> None:
    with pytest.raises(CampaignError) as caught:
        read_measurement([file(tmp_path, "night.csv", f"{MODES}{row}\n")])
    assert said in str(caught.value)


@pytest.mark.parametrize("name", ["again.csv", "again.h5"])
def test_they_are_read_as_they_were_written(tmp_path: Path, name: str) -> None:
    test = read_measurement([file(tmp_path, "night.csv", MODES + ROWS)])
    write_test(tmp_path / name, test)
    assert read_measurement([tmp_path / name]).environment == VALUES


def test_a_campaign_has_those_of_its_test_and_its_own_key_replaces_them(tmp_path: Path) -> None:
    text = (SIX_MASS / "measured.csv").read_text() + ROWS
    file(tmp_path, "measured.csv", text)
    file(tmp_path, "six_mass.yaml", (SIX_MASS / "six_mass.yaml").read_text())
    campaign = file(tmp_path, "campaign.yaml", (SIX_MASS / "campaign.yaml").read_text())
    assert load_campaign(campaign).environment == VALUES
    own = load_campaign(campaign, ["test.environment.temperature_C=-4"]).environment
    assert own == {**VALUES, "temperature_C": -4.0}
    with pytest.raises(CampaignError, match="environment"):
        load_campaign(campaign, ["test.environment.temperature_C=warm"])


def test_inspect_lists_them(tmp_path: Path) -> None:
    file(tmp_path, "night.csv", MODES + ROWS)
    shown = run_command(tmp_path, "files", "inspect", "night.csv").stdout
    assert "environment temperature_C 21.5, wind m/s -3" in shown
