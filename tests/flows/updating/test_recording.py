"""What a campaign's record says of where it came from."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

from modetune.flows.campaign.campaign import Campaign, load_campaign
from modetune.flows.updating.recording import _deck_digest

CONFIGS = Path(__file__).resolve().parents[3] / "configs"


def listed(path: Path) -> str:
    """A line of sha256sum."""
    return f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}"


def six_mass() -> Campaign:
    return load_campaign(CONFIGS / "six_mass" / "campaign.yaml")


def test_the_decks_digest_is_that_of_its_file() -> None:
    assert _deck_digest(six_mass()) == listed(CONFIGS / "six_mass" / "six_mass.yaml")


def test_each_deck_of_several_configurations_is_told_once() -> None:
    one = six_mass()
    joint = replace(one, cases=tuple(replace(one.case, name=name) for name in "ab"))
    assert _deck_digest(joint) == listed(CONFIGS / "six_mass" / "six_mass.yaml")


def test_a_solver_without_a_deck_has_no_digest(bench: Any) -> None:
    assert _deck_digest(bench.campaign({"k1": 1.2})) == ""
