"""The CI files for users are valid, their commands exist, and they do what the page says."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml

from tests.command_line import run_command

ROOT = Path(__file__).resolve().parents[3]
WORKFLOW = ROOT / "configs" / "ci" / "github-actions.yml"
PAGE = (ROOT / "docs" / "ci.md").read_text(encoding="utf-8")
SIX_MASS = ROOT / "configs" / "six_mass"


def yaml_blocks() -> list[str]:
    return re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)


def workflow_scripts(job: str) -> list[str]:
    """What a job of the GitHub workflow runs, step by step."""
    content: Any = yaml.safe_load(WORKFLOW.read_text(encoding="utf-8"))
    return [step["run"] for step in content["jobs"][job]["steps"] if "run" in step]


def gitlab_script() -> list[str]:
    content: Any = yaml.safe_load(yaml_blocks()[1])
    return list(content["model"]["script"])


def our_lines(scripts: list[str]) -> Iterator[list[str]]:
    """The words of every line that starts modetune."""
    for script in scripts:
        for line in script.splitlines():
            if line.startswith("modetune "):
                yield shlex.split(re.split(r" [|>]", line)[0])


def own(folder: Path) -> dict[str, str]:
    """A home and a store of the folder's own."""
    store = folder / ".modetune" / "store"
    return {"MODETUNE_HOME": str(folder / "home"), "MODETUNE_STORE": str(store)}


def typed(folder: Path, command: str) -> subprocess.CompletedProcess[str]:
    """A command that is not CI's own line, in this process."""
    return run_command(folder, *command.split(), **own(folder))


def run(folder: Path, *command: str) -> subprocess.CompletedProcess[str]:
    """Run a shell line as CI does, with modetune on PATH, in a home of its own."""
    environment = {
        **os.environ,
        **own(folder),
        "PATH": f"{folder / 'bin'}:{os.environ['PATH']}",
        "CAMPAIGN": "campaign.yaml",
        "BASELINE": "baseline.h5",
        "GITHUB_STEP_SUMMARY": str(folder / "summary.md"),
    }
    return subprocess.run(
        ["bash", "-e", "-o", "pipefail", "-c", *command],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A repository of a model: the six-mass campaign and its baseline."""
    folder = tmp_path_factory.mktemp("repository")
    for name in ("campaign.yaml", "six_mass.yaml", "measured.csv"):
        shutil.copyfile(SIX_MASS / name, folder / name)
    ended = run_command(
        folder,
        "update",
        "campaign.yaml",
        "--no-prefect",
        MODETUNE_STORE=str(folder / ".modetune" / "store"),
    )
    assert ended.returncode == 0, ended.stderr
    shutil.move(folder / "runs" / "six-mass" / "campaign.h5", folder / "baseline.h5")
    shutil.rmtree(folder / "runs")
    return folder


@pytest.fixture
def repository(made: Path, tmp_path: Path) -> Path:
    """A copy of it, and modetune on PATH."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    (tmp_path / "bin").mkdir()
    program = tmp_path / "bin" / "modetune"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m modetune "$@"\n')
    program.chmod(0o755)
    return tmp_path


def changed(repository: Path, old: str, new: str) -> None:
    deck = repository / "six_mass.yaml"
    text = deck.read_text()
    assert old in text
    deck.write_text(text.replace(old, new))


def test_the_page_shows_the_workflow_as_it_is() -> None:
    assert yaml_blocks()[0] == WORKFLOW.read_text(encoding="utf-8")


def test_the_workflow_is_one() -> None:
    content: Any = yaml.safe_load(WORKFLOW.read_text(encoding="utf-8"))
    assert set(content[True]) == {"push", "pull_request", "workflow_dispatch"}  # YAML 1.1's `on`
    for job in content["jobs"].values():
        assert {"runs-on", "timeout-minutes", "steps"} <= job.keys()
        for step in job["steps"]:
            assert ("run" in step) != ("uses" in step)
            assert re.fullmatch(r"actions/[a-z/-]+@v\d+", step.get("uses", "actions/none@v1"))


def test_the_gitlab_job_is_one() -> None:
    content: Any = yaml.safe_load(yaml_blocks()[1])
    job = content["model"]
    assert all(isinstance(line, str) for line in (*job["before_script"], *job["script"]))
    assert job["cache"]["paths"] == [".modetune/store"]


def test_every_command_of_ci_is_there_with_its_options() -> None:
    scripts = [*workflow_scripts("deck"), *workflow_scripts("updated"), *gitlab_script()]
    blocks = re.findall(r"^```\w*\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    wanted: dict[str, set[str]] = {}
    for words in our_lines([*scripts, *blocks]):
        options = {word for word in words[2:] if word.startswith("--")}
        name = " ".join(words[1 : 3 if words[1] == "store" else 2])
        wanted.setdefault(name, set()).update(options)
    assert wanted.keys() == {"check", "update", "store explain"}
    for name, options in wanted.items():
        said = run_command(ROOT, *name.split(), "--help", COLUMNS="200").stdout
        assert {option for option in options if option not in said} == set(), name


def test_an_unchanged_repository_passes_what_gitlab_runs(repository: Path) -> None:
    script = gitlab_script()
    # The repository keeps the deck before updating: its second line is for the updated one.
    lines = [f"{line} --state initial" if "frequency-band" in line else line for line in script]
    for line in lines:
        passed = run(repository, line)
        assert passed.returncode == 0, passed.stdout + passed.stderr
    assert "within the band" in passed.stdout


def test_the_job_for_updated_models_passes_what_updating_can_make_good(repository: Path) -> None:
    changed(
        repository,
        "k4: {between: [m1, m2], stiffness: 5000.0}",
        "k4: {between: [m1, m2], stiffness: 5500.0}",
    )
    for script in workflow_scripts("updated")[1:]:
        passed = run(repository, script)
        assert passed.returncode == 0, passed.stdout + passed.stderr


def test_a_change_that_no_parameter_makes_good_fails_both_jobs(repository: Path) -> None:
    changed(repository, "m6: 0.9", "m6: 2.7")
    *_, deck = workflow_scripts("deck")
    failed = run(repository, deck)
    assert failed.returncode == 3
    assert "worse than the baseline: mode" in failed.stdout
    summary = (repository / "summary.md").read_text()
    assert summary.startswith("### six-mass: worse than the baseline: mode")
    assert re.search(r"^\| \*\*2\*\* \|.*\| \*\*no\*\* \|$", summary, re.MULTILINE)
    (suite,) = ElementTree.parse(repository / "modes.xml").getroot()
    failures = [case.get("name") for case in suite if case.find("failure") is not None]
    assert failures
    assert (suite.get("tests"), suite.get("failures")) == ("4", str(len(failures)))
    assert suite[-1].get("name") == "verdict: trusted"  # the baseline's
    assert suite[-1].find("failure") is None
    update, judge = workflow_scripts("updated")[2:]
    assert run(repository, update).returncode == 0  # it ends without e1, which is not the question
    failed = run(repository, judge)
    assert failed.returncode == 3, failed.stdout + failed.stderr


def action_steps() -> list[tuple[str, dict[str, str]]]:
    """The script of each step of the action after its installation, with its inputs' defaults."""
    content: Any = yaml.safe_load((ROOT / "action.yml").read_text(encoding="utf-8"))
    given = {name: item["default"] for name, item in content["inputs"].items()}
    found = []
    for step in content["runs"]["steps"][2:]:
        assert re.fullmatch(r"actions/[a-z/-]+@v\d+", step.get("uses", "actions/none@v1"))
        if "run" in step:
            assert step["shell"] == "bash"
            assert "${{" not in step["run"]  # inputs reach the shell as variables alone
            wanted = [
                (name, re.fullmatch(r"\$\{\{ inputs\.([\w-]+) \}\}", text))
                for name, text in step["env"].items()
                if name != "MODETUNE_STORE"
            ]
            values = {name: given[match[1]] for name, match in wanted if match}
            assert len(values) == len(wanted)
            found.append((step["run"], values))
    return found


def test_the_action_passes_an_unchanged_deck_and_rejects_a_worse_one(repository: Path) -> None:
    steps = action_steps()
    assert len(steps) == 2

    def ends(**inputs: str) -> list[int]:
        lines = [
            "".join(f"export {name}={shlex.quote(value)}\n" for name, value in values.items())
            + "".join(f"export {name}={shlex.quote(value)}\n" for name, value in inputs.items())
            + script
            for script, values in steps
        ]
        return [run(repository, line).returncode for line in lines]

    assert ends(STATE="initial") == [0, 0]
    changed(repository, "m6: 0.9", "m6: 2.7")
    assert ends(STATE="initial") == [0, 3]
    assert (repository / "modes.xml").is_file()


def test_the_page_names_every_input_of_the_action() -> None:
    content: Any = yaml.safe_load((ROOT / "action.yml").read_text(encoding="utf-8"))
    table = re.findall(r"^\| `([\w-]+)` \| ([^|]*) \|", PAGE, re.MULTILINE)
    shown = {name: default.strip("` ") for name, default in table if name in content["inputs"]}
    assert shown == {name: item["default"] for name, item in content["inputs"].items()}


def test_a_dry_run_names_the_job_of_a_changed_deck(repository: Path) -> None:
    changed(repository, "m2: 2.4", "m2: 3.2")
    said = typed(repository, "update campaign.yaml --dry-run")
    assert said.returncode == 0
    key = re.findall(r"^run   (\w{12})", said.stdout, re.MULTILINE)[0]
    told = typed(repository, f"explain {key} --store campaign.yaml")
    assert told.returncode == 0, told.stderr
    assert "not run" in told.stdout


def test_what_the_pre_check_found_is_a_summary_and_tests(repository: Path) -> None:
    for _ in range(2):  # a step adds to what others wrote
        said = typed(repository, "check campaign.yaml --summary s.md --junit j.xml --json")
        assert said.returncode == 0, said.stderr
    assert (repository / "s.md").read_text().count("### six-mass: ") == 2
    (suite,) = ElementTree.parse(repository / "j.xml").getroot()
    assert len(suite) == len(json.loads(said.stdout)["findings"]) > 3
    assert all(case.find("failure") is None for case in suite)
    said = typed(repository, "check campaign.yaml --summary no/s.md")
    assert (said.returncode, said.stderr) == (
        2,
        "reading campaign.yaml\nmodetune: no/s.md: No such file or directory\n",
    )


def test_a_record_without_a_baseline_is_refused(repository: Path) -> None:
    said = typed(repository, "check campaign.yaml --record baseline.h5")
    assert said.returncode == 2
    assert "--against" in said.stderr
