"""What a release tells of itself, and that CONTRIBUTING names what is there."""

from __future__ import annotations

import re
from pathlib import Path

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


def test_places_that_contributing_names_are_there() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text()
    named = re.findall(r"`((?:core|adapters|flows|configs|tests|tools|src|\.ci)/[^`\s]*)`", text)
    assert len(named) > 15
    assert [place for place in named if not (ROOT / place).exists()] == []
    links = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text)
    assert [link for link in links if not (ROOT / link).exists()] == []
