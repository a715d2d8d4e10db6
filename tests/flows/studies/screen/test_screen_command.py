"""`modetune screen` as a user meets it, on the six masses with their embedded solver."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from subprocess import CompletedProcess

import pytest

from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.studies.screen.record import SCREENING
from tests.command_line import run_command

SIX_MASS = Path(__file__).resolve().parents[4] / "configs" / "six_mass"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("campaign.yaml", "six_mass.yaml", "measured.csv"):
        shutil.copyfile(SIX_MASS / name, tmp_path / name)
    return tmp_path


def screen(folder: Path, *arguments: str) -> CompletedProcess[str]:
    return run_command(folder, "screen", "campaign.yaml", "--no-prefect", *arguments)


def test_a_screening_leaves_record_proposal_figures_and_one_json_object(folder: Path) -> None:
    done = screen(
        folder,
        "--method",
        "morris",
        "--points",
        "20",
        "--choose",
        "2",
        "--out",
        "proposed.yaml",
        "--figures",
        "figures",
        "--json",
    )
    assert done.returncode == 0, done.stderr
    shown = json.loads(done.stdout)
    assert shown["status"] == "done"
    assert shown["points"] == 20  # four trajectories along four springs
    assert len(shown["chosen"]) == 2
    assert json.loads((folder / "runs/six-mass/screening.json").read_text()) == shown
    assert SCREENING.read(folder / "runs/six-mass/screening.h5").choice.chosen == tuple(
        shown["chosen"]
    )
    assert set(load_campaign(folder / "proposed.yaml").parameters.names) == set(shown["chosen"])
    assert {"morris.png", "sensitivities.png", "cosines.png"} <= {
        path.name for path in (folder / "figures").iterdir()
    }
    assert all((folder / name).is_file() for name in shown["written"])

    again = json.loads(screen(folder, "--method", "morris", "--points", "20", "--json").stdout)
    assert (again["solver_runs"]["modal"], again["solver_runs"]["sensitivity"]) == (0, 0)
    assert again["parameters"][0]["indices"] == shown["parameters"][0]["indices"]


def test_people_see_tables_reasons_and_where_files_are(folder: Path) -> None:
    done = screen(folder)
    assert done.returncode == 0, done.stderr
    for said in (
        "At the deck's values",
        "Candidates",
        "proposed: ",
        "solver runs: 1 modal",
        "written: runs/six-mass/screening.h5",
    ):
        assert said in done.stdout


@pytest.mark.parametrize("option", ["--figures", "--runs", "--out"])
def test_a_place_that_cannot_be_made_is_one_sentence(folder: Path, option: str) -> None:
    done = screen(folder, option, "/proc/nothing/x")
    assert done.returncode == 5, done.stderr
    assert done.stderr.splitlines()[-1].startswith("modetune: /proc/nothing")
    assert "cannot be written (No such file or directory)" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--method", "guess"), "expected one of local, morris, sobol, lhs"),
        (("--method", "sobol", "--points", "40"), "sobol needs at least 48 for these parameters"),
        (("--out", "campaign.yaml"), "is the campaign itself"),
    ],
)
def test_a_mistake_is_one_sentence_before_any_run(
    folder: Path, arguments: tuple[str, ...], said: str
) -> None:
    done = screen(folder, *arguments)
    assert done.returncode == 2
    assert "\nmodetune: " in f"\n{done.stderr}"
    assert said in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(folder.glob(".modetune/store/??/*.h5"))
