"""`modetune report`, and the pictures it writes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from modetune.core.errors import CampaignError
from modetune.core.storage.campaign_record import CampaignRecord, write_record
from modetune.flows.cli.main import app
from modetune.flows.report.campaign_charts import campaign_charts
from modetune.flows.report.matplotlib_charts import save_all

FIGURES = ["comac", "convergence", "estimates", "frequencies", "mac", "mac_map", "parameters",
           "sensitivities", "sensor_shapes"]  # fmt: skip


@pytest.fixture
def folder(record: CampaignRecord, tmp_path: Path) -> Path:
    write_record(tmp_path / "run" / "campaign.h5", record)
    return tmp_path / "run"


def test_a_run_folder_gets_its_report(folder: Path) -> None:
    ended = CliRunner().invoke(app, ["report", str(folder)])
    assert ended.exit_code == 0, ended.output
    assert (folder / "report.html").read_text().startswith("<!DOCTYPE html>")
    assert "report.html" in ended.output


def test_page_and_pictures_go_where_they_are_wanted(folder: Path, tmp_path: Path) -> None:
    command = [
        "report",
        str(folder / "campaign.h5"),
        "--out",
        str(tmp_path / "a.html"),
        "--figures",
        str(tmp_path / "figures"),
        "--format",
        "svg",
        "--json",
    ]
    ended = CliRunner().invoke(app, command)
    assert ended.exit_code == 0, ended.output
    told = json.loads(ended.stdout)
    assert told["page"] == str(tmp_path / "a.html")
    assert sorted(Path(name).name for name in told["figures"]) == [f"{n}.svg" for n in FIGURES]
    assert "<svg" in (tmp_path / "figures" / "mac.svg").read_text()[:800]


def test_names_with_signs_of_formulas_are_drawn(record: CampaignRecord, tmp_path: Path) -> None:
    strange = replace(record, name="a $ of \\alpha_ $ {")
    pictures = save_all(dict(campaign_charts(strange)), tmp_path)
    assert sorted(path.stem for path in pictures) == FIGURES
    assert all(path.read_bytes()[:4] == b"\x89PNG" for path in pictures)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nowhere"], "nowhere is not there; a record is the campaign"),
        (["."], "campaign.h5 is not there; a record is the campaign"),
        (["nowhere", "--format", "pdf"], "--format 'pdf': expected one of png, svg"),
    ],
)
def test_a_mistake_is_told_in_a_sentence(
    arguments: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    ended = CliRunner().invoke(app, ["report", *arguments])
    assert isinstance(ended.exception, CampaignError)
    assert said in str(ended.exception)
