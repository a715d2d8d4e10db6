"""The README is true: its campaign, commands, links and length."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from modetune.flows.campaign.schema import CampaignFile

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text()


def test_the_campaign_of_the_readme_is_the_one_that_its_commands_run() -> None:
    text = re.search(r"```yaml\n(.*?)```", README, re.DOTALL)
    assert text is not None
    shown = yaml.safe_load(text.group(1))
    assert shown == yaml.safe_load((ROOT / "configs" / "mast" / "mast.yaml").read_text())
    campaign = CampaignFile.model_validate(shown)
    assert campaign.parameters[1].targets() == ("HEAD",)


def test_the_readme_is_short() -> None:
    assert len(README.splitlines()) <= 100


@pytest.mark.parametrize("name", ["demo", "test"])
def test_make_targets_of_the_readme_exist(name: str) -> None:
    assert f"make {name}" in README
    assert re.search(rf"^{name}:", (ROOT / "Makefile").read_text(), re.MULTILINE)


def test_make_demo_runs_the_case_that_the_readme_shows() -> None:
    makefile = (ROOT / "Makefile").read_text()
    assert re.search(r"^demo:.*\n\t\$\(BIN\)/modetune demo$", makefile, re.MULTILINE)
    assert "$ modetune demo\n" in README


def test_the_whole_campaign_file_of_the_docs_is_one() -> None:
    text = re.search(r"```yaml\n(.*?)```", (ROOT / "docs" / "campaign.md").read_text(), re.DOTALL)
    assert text is not None
    campaign = CampaignFile.model_validate(yaml.safe_load(text.group(1)))
    assert campaign.test.modes == ("modes.csv", "lab.unv")
