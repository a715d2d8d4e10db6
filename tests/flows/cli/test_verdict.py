"""The verdict on an update reaches whoever asks: exit code, first line, JSON, Python, CI."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

import modetune
from modetune.core.errors import CampaignError
from modetune.core.updating.verdict import TrustVerdict
from modetune.flows.report.headline import first_line
from modetune.flows.report.page import page
from modetune.flows.server.artifacts import result_artifacts
from tests.command_line import run_command

CONFIGS = Path(__file__).resolve().parents[3] / "configs"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Campaigns on matrices with each verdict, by one store."""
    made = tmp_path_factory.mktemp("verdicts")
    for case in ("six_mass", "four_storey"):
        shutil.copytree(CONFIGS / case, made / case, ignore=shutil.ignore_patterns("__py*", "*.py"))
    return made


def update(folder: Path, campaign: str, *options: str) -> Any:
    return run_command(
        folder,
        "update",
        campaign,
        "--no-prefect",
        *options,
        MODETUNE_STORE=str(folder / "store"),
    )


TRUSTED, NOT_TRUSTED = "six_mass/campaign.yaml", "four_storey/storeys.yaml"
RESERVATIONS = "four_storey/bounded.yaml"
#: Other starting points do not change the lowest verdict.
ALONE = ("--set", "update.starts=1")
SHORT = ("--set", "update.max_iterations=1", *ALONE)


@pytest.mark.parametrize(
    ("campaign", "options", "code"),
    [
        (TRUSTED, ("--fail-on", "doubt"), 0),
        (RESERVATIONS, (), 0),
        (RESERVATIONS, ("--fail-on", "not-trusted"), 0),
        (RESERVATIONS, ("--fail-on", "doubt"), 6),
        (NOT_TRUSTED, ALONE, 0),
        (NOT_TRUSTED, (*ALONE, "--fail-on", "not-trusted"), 6),
        (NOT_TRUSTED, (*ALONE, "--set", "run.fail_on=doubt"), 6),
        (NOT_TRUSTED, (*ALONE, "--set", "run.fail_on=doubt", "--fail-on", "never"), 0),
        # e1 not met comes first, whatever the verdict.
        (TRUSTED, (*SHORT, "--fail-on", "doubt"), 3),
    ],
)
def test_each_exit_code(folder: Path, campaign: str, options: tuple[str, ...], code: int) -> None:
    ended = update(folder, campaign, *options)
    assert ended.returncode == code, ended.stdout + ended.stderr
    first, *_, last = ended.stdout.splitlines()
    assert ("excludes this verdict" in last) is (code == 6)
    name = {TRUSTED: "six-mass", RESERVATIONS: "bounded", NOT_TRUSTED: "four-storeys"}[campaign]
    assert first.startswith(f"{name}: 4 parameters updated, k")
    assert ("e1 not met" in first) is (code == 3)


def test_an_unknown_verdict_is_refused(folder: Path) -> None:
    ended = update(folder, TRUSTED, "--fail-on", "doubts")
    assert ended.returncode == 2
    assert "doubt" in ended.stderr


def test_a_repeated_run_gives_the_verdict_from_the_store(folder: Path) -> None:
    words = (NOT_TRUSTED, *ALONE, "--fail-on", "doubt", "--json")
    ends = [update(folder, *words) for _ in range(2)]
    first, again = (json.loads(end.stdout) for end in ends)
    assert [end.returncode for end in ends] == [6, 6]
    assert again["solver_runs"]["modal"] + again["solver_runs"]["sensitivity"] == 0
    assert first["verdict"] == again["verdict"] == first["trust"]["verdict"] == "not to be trusted"
    assert first["headline"] == again["headline"]
    assert (again["status"], again["fail_on"], again["exit_code"]) == ("converged", "doubt", 6)


def test_python_has_the_verdict_and_the_exit_code(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MODETUNE_STORE", str(folder / "store"))
    monkeypatch.setenv("MODETUNE_NO_PREFECT", "1")
    monkeypatch.chdir(folder)
    run = modetune.update(NOT_TRUSTED, fail_on="doubt")
    assert run.converged
    assert (run.verdict, run.exit_code) == (TrustVerdict.NOT_TRUSTED, 6)
    assert modetune.update(NOT_TRUSTED).exit_code == 0
    line = first_line(run.record)
    assert line.startswith("four-storeys: 4 parameters updated, k1 the most (")
    assert "not to be trusted: do not use these values (4 of 4 parameters in doubt" in line
    assert repr(run).splitlines()[0] == line
    assert line in page(run.record)
    result = {item.key: item for item in result_artifacts(run.record, run.folder)}
    assert str(result["four-storeys-record"].data).startswith(f"**{line}**")
    assert result["four-storeys-record"].description.endswith(": not to be trusted")
    assert modetune.read_record(run.folder).verdict is TrustVerdict.NOT_TRUSTED


def test_ci_gets_the_verdict_of_the_record_that_it_checks(folder: Path) -> None:
    assert update(folder, NOT_TRUSTED, *ALONE).returncode == 0
    record = folder / "runs" / "four-storeys" / "campaign.h5"
    words = ["check", NOT_TRUSTED, "--against", str(record), "--record", str(record)]
    words += ["--junit", "found.xml", "--summary", "found.md", "--no-prefect"]
    for fail_on, code in (("never", 0), ("not-trusted", 6)):
        ended = run_command(folder, *words, "--fail-on", fail_on)
        assert ended.returncode == code, ended.stderr
        assert f"verdict of {record}: not to be trusted" in ended.stdout
        (suite,) = ElementTree.parse(folder / "found.xml").getroot()
        assert suite[-1].get("name") == "verdict: not to be trusted"
        assert (suite[-1].find("failure") is not None) is (code == 6)
        assert "not to be trusted" in (folder / "found.md").read_text()
        (folder / "found.md").unlink()
    found = json.loads(run_command(folder, *words, "--json").stdout)
    assert (found["status"], found["verdict"]) == ("within", "not to be trusted")


def test_a_verdict_without_an_update_is_refused(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    with pytest.raises(CampaignError, match="name its record with --against"):
        modetune.check(NOT_TRUSTED, fail_on="doubt")  # type: ignore[call-overload]
