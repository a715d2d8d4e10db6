"""What the README says is so: its campaign is one, and its commands are there."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import yaml

from modetune.flows.campaign.schema import CampaignFile

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text()


def test_the_campaign_of_the_readme_is_a_campaign() -> None:
    text = re.search(r"```yaml\n(.*?)```", README, re.DOTALL)
    assert text is not None
    campaign = CampaignFile.model_validate(yaml.safe_load(text.group(1)))
    assert campaign.parameters[1].targets() == ("FIN",)


def test_every_command_of_the_readme_is_there() -> None:
    said = subprocess.run(
        [sys.executable, "-m", "modetune", "--help"], capture_output=True, text=True, check=True
    ).stdout
    blocks = "\n".join(re.findall(r"```\n(.*?)```", README, re.DOTALL))
    for command in set(re.findall(r"^modetune (\w+)", blocks, re.MULTILINE)):
        assert re.search(rf"\b{command}\b", said), command


def test_the_whole_campaign_file_of_the_docs_is_one() -> None:
    text = re.search(r"```yaml\n(.*?)```", (ROOT / "docs" / "campaign.md").read_text(), re.DOTALL)
    assert text is not None
    campaign = CampaignFile.model_validate(yaml.safe_load(text.group(1)))
    assert campaign.test.modes == ("modes.csv", "lab.unv")
