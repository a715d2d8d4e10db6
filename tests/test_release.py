"""What a release tells of itself, and that CONTRIBUTING names what is there."""

from __future__ import annotations

import os
import re
import tomllib
from pathlib import Path

import pytest
import yaml

from modetune import __version__
from tests.command_line import run_command

ROOT = Path(__file__).resolve().parents[1]


def test_version_is_the_same_wherever_it_stands() -> None:
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert cited["version"] == __version__
    headings = re.findall(r"^## (.+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert headings[0] == "Unreleased"
    assert headings[1].split()[0] == __version__
    told = run_command(ROOT, "--version")
    assert (told.returncode, told.stdout) == (0, f"modetune {__version__}\n")


def test_the_metadata_are_those_of_the_citation() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert project["license"] == cited["license"] == "BSD-3-Clause"  # an SPDX expression
    assert project["authors"] == cited["authors"]
    assert set(cited["keywords"]) <= set(project["keywords"])


def test_the_conda_recipe_has_the_version_and_the_requirements() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    recipe = yaml.safe_load((ROOT / "conda" / "recipe.yaml").read_text())
    assert recipe["context"]["version"] == __version__
    assert recipe["about"]["license"] == project["license"]
    lines = recipe["requirements"]["run"]
    assert lines[:2] == ["__linux", f"python {project['requires-python']}"]
    wanted = {name_and_limits(line.split(";")[0]) for line in project["dependencies"]}
    assert {name_and_limits(line) for line in lines[2:]} == wanted
    (script,) = (line.partition(" = ") for line in recipe["build"]["python"]["entry_points"])
    assert project["scripts"] == {script[0]: script[2]}


def name_and_limits(line: str) -> tuple[str, str]:
    """A requirement's package, under the name of the Python package index, and its versions."""
    found = re.fullmatch(r"([\w.-]+?)\s*((?:[<>=].*)?)", line.strip())
    assert found, line
    name = found[1].lower().replace("_", "-")
    return {"matplotlib-base": "matplotlib"}.get(name, name), found[2].strip()


def test_github_runs_what_a_change_must_pass() -> None:
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())
    (job,) = workflow["jobs"].values()
    assert [step["run"] for step in job["steps"] if "run" in step] == [".ci/run"]
    assert workflow["permissions"] == {"contents": "read"}
    assert os.access(ROOT / ".ci" / "run", os.X_OK)


@pytest.mark.parametrize("name", ["fault", "wrong-result", "wish"])
def test_an_issue_template_is_one(name: str) -> None:
    form = yaml.safe_load((ROOT / ".github" / "ISSUE_TEMPLATE" / f"{name}.yml").read_text())
    assert {"name", "description", "body"} <= form.keys()
    fields = [item for item in form["body"] if item["type"] != "markdown"]
    assert len({item["id"] for item in fields}) == len(fields) > 2
    assert all(item["attributes"]["label"] for item in fields)


def test_places_that_contributing_names_are_there() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text()
    named = re.findall(r"`((?:core|adapters|flows|configs|tests|tools|src|\.ci)/[^`\s]*)`", text)
    assert len(named) > 15
    assert [place for place in named if not (ROOT / place).exists()] == []
    links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text)
    assert [link for link in links if not (ROOT / link).exists()] == []
