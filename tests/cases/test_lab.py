"""From the lab's universal file with response functions to a report, as a user would go."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modetune.adapters.test_files.measurements import read_measurement
from modetune.configs.cases import write_case
from modetune.configs.garteur.lab import (
    POINTS,
    TILT_DEGREES,
    TILTED,
    TRUTH,
    claims,
    write_lab,
)
from modetune.core.storage.campaign_record import read_record
from tests.adapters.solved import needs_ccx
from tests.command_line import run_command

pytestmark = needs_ccx


def modetune(folder: Path, *arguments: str) -> dict[str, Any]:
    """What a command tells with --json."""
    done = run_command(folder, *arguments, "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert isinstance(told, dict)
    return told


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lab")
    write_case("garteur", folder)
    write_lab(folder)
    shutil.copyfile(folder / "lab.yaml", folder / "campaign.yaml")
    modetune(folder, "identify", "lab.unv", "--band", "3", "57", "--out", "modes.csv")
    return folder


def test_the_file_holds_what_the_lab_measured(lab: Path) -> None:
    measured = read_measurement([lab / "lab.unv"])
    assert measured.geometry is not None
    assert measured.frfs is not None
    assert measured.geometry.nodes.size == len(POINTS)
    assert measured.geometry.metres == 1.0
    assert measured.frfs.values.shape[1] == 2 * sum(len(point[3]) for point in POINTS)


def test_sensors_find_their_nodes_and_the_tilted_one_its_direction(lab: Path) -> None:
    told = modetune(lab, "sensors", "campaign.yaml")
    rows = {(row["test_node"], row["component"]): row for row in told["sensors"]}
    assert len(rows) == sum(len(point[3]) for point in POINTS)
    # The coarse mesh has a node within 8 mm of every place; the lab knows its points to 2 mm.
    assert max(row["distance"] for row in rows.values()) < 8.0 + 4 * 2.0
    angle = np.deg2rad(TILT_DEGREES)
    tilted = rows[(TILTED, "z")]["direction"]
    np.testing.assert_allclose(tilted, (-np.sin(angle), 0.0, np.cos(angle)), atol=1e-6)


def test_a_lab_file_becomes_an_updated_model_with_report_and_pictures(lab: Path) -> None:
    checked = modetune(lab, "check", "campaign.yaml")
    assert checked["status"] == "good"
    told = modetune(lab, "update", "campaign.yaml", "--no-prefect")
    assert told["status"] == "converged"
    # Modes come from matrices; the solver has the last word.
    assert told["solver_runs"]["modal"] == 1
    record = read_record(lab / "runs" / "garteur-lab" / "campaign.h5")
    assert [claim for claim in claims(record) if not claim.holds] == []
    for name in ("E_fuselage", "E_wing", "E_fin"):
        place = record.parameters.names.index(name)
        assert record.updated[place] == pytest.approx(TRUTH[name[2:].upper()], rel=0.02)
    page = (lab / "runs" / "garteur-lab" / "report.html").read_text(encoding="utf-8")
    assert 'id="responses"' in page  # the lab's own functions beside those of both models
    series = modetune(lab, "files", "paraview", "runs/garteur-lab", "--out", "paraview")
    assert series["status"] == "good"
    assert sorted(path.name for path in (lab / "paraview").glob("*.pvd")) == [
        "initial.pvd",
        "updated.pvd",
    ]


def test_response_functions_alone_tell_the_moduli(lab: Path) -> None:
    told = modetune(lab, "update", "lab_frf.yaml", "--no-prefect", "--set", "update.starts=1")
    assert told["status"] == "converged"
    assert {mode["frequency_weight"] for mode in told["modes"]} == {0.0}
    for item in told["parameters"]:
        truth = TRUTH[item["name"].removeprefix("E_").upper()]
        # 1 % noise on 624 lines: a few 1e-4 of what carries the resonances; functions tell of the
        # tailplane, which no mode below 57 Hz bends much, as far as its standard error says.
        assert abs(item["updated"] - truth) < max(2e-3, 3.0 * item["standard_error"])
    fracs = [row for row in told["responses"] if row["kind"] == "frf"]
    assert len(fracs) == 78
    assert min(row["updated"] for row in fracs) > 0.9 > min(row["initial"] for row in fracs)
    assert told["solver_runs"]["modal"] == 1
