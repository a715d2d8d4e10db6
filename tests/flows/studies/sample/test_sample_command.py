"""`modetune sample` as it is typed, on a spring-mass system."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from modetune.core.errors import CampaignError
from modetune.flows.cli.main import app
from modetune.flows.studies.sample import refinement

SIX_MASS = Path(__file__).resolve().parents[4] / "configs" / "six_mass"
CAMPAIGN = """
name: pair
model: {deck: six_mass.yaml, solver: matrices, units: m-kg-s}
test: {modes: measured.csv}
parameters:
  - {name: k1, quantity: spring_stiffness, elset: k1, bounds: [0.5, 2.0]}
  - {name: k3, quantity: spring_stiffness, elset: k3, bounds: [0.5, 2.0]}
residuals: {frequency_deviation: 0.05}
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("six_mass.yaml", "measured.csv"):
        shutil.copy(SIX_MASS / name, tmp_path / name)
    (tmp_path / "campaign.yaml").write_text(CAMPAIGN)
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))
    monkeypatch.delenv("MODETUNE_STORE", raising=False)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def typed(*arguments: str) -> Result:
    return CliRunner().invoke(
        app, ["sample", "campaign.yaml", "--no-prefect", "--points", "8", *arguments]
    )


def test_the_json_names_every_parameter_response_and_file(folder: Path) -> None:
    result = typed("--steps", "500", "--checks", "2", "--json", "--figures", "figures")
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert told["status"] == "done"
    assert [item["name"] for item in told["parameters"]] == ["k1", "k3"]
    assert [item["response"] for item in told["surrogate"]] == [
        f"{what} of mode {number}" for what in ("frequency", "shape") for number in (2, 3, 4)
    ]
    assert told["checks"] == 2
    assert all((folder / path).is_file() for path in told["written"])
    again = typed("--steps", "500", "--checks", "2")
    assert again.exit_code == 0
    assert re.search(r"solver runs: 0, \d+ cached", again.stdout)
    assert "Posterior, relative to the deck" in again.stdout


def test_the_shipped_campaign_without_a_number_of_points_learns_until_it_is_good(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(SIX_MASS, tmp_path / "six", ignore=shutil.ignore_patterns("runs", "*store*"))
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))
    monkeypatch.delenv("MODETUNE_STORE", raising=False)
    monkeypatch.chdir(tmp_path / "six")
    asked = ["sample", "campaign.yaml", "--no-prefect", "--steps", "500", "--json"]
    result = CliRunner().invoke(app, asked)
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert told["status"] == "done"
    # Forty runs near the posterior left it at 0.42.
    assert told["density_error"] <= refinement.GOOD


def test_a_record_that_is_not_there_is_one_sentence(folder: Path) -> None:
    result = typed("--record", "nowhere")
    assert isinstance(result.exception, CampaignError)
    assert "nowhere is not there" in str(result.exception)
