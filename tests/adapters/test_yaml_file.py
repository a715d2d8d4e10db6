"""Values of campaign files set by program: what stands around them stays, byte for byte."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Any

import pytest
import yaml

from modetune.adapters.yaml_file import Place, YamlFile, edited, parse_yaml, read_yaml
from modetune.core.errors import CampaignError

ROOT = Path(__file__).resolve().parents[2]
CAMPAIGNS = [
    path for path in sorted((ROOT / "configs").glob("*/*.yaml")) if "\ntest:" in path.read_text()
]
#: Three ways in which people write the same.
BRIDGE = """\
# Footbridge over the mill stream
test:
    modes: bridge.unv    # "final" (really)
    pairs:
        1: 2   # by Ana
        3: 4

    # mounted upside down
    sensors:
        align: fit
model: {deck: bridge.bdf}
"""
BELL = """\
test: {modes: 'bell.csv', # cast 1890
       pairs: {1: 2, 3: 4}, sensors: {align: fit, tolerance: 2.5}}
model: {deck: bell.inp}"""
MAST = """\
model: {deck: mast.inp}
parameters:
- name: guys
test:
  modes:
  - mast.csv
  - points.csv # tape measure
"""
PAIRS: Place = ("test", "pairs")


def source_of(text: str) -> YamlFile:
    return parse_yaml(Path("campaign.yaml"), text, "a campaign")


def changed(text: str, changes: dict[Place, object]) -> list[str]:
    """Lines that went, and lines that came."""
    after = edited(source_of(text), changes)
    lines = difflib.ndiff(text.splitlines(), after.splitlines())
    return [line for line in lines if line[0] in "+-"]


@pytest.mark.parametrize(
    ("text", "changes", "lines"),
    [
        (BRIDGE, {PAIRS: {1: 5, 3: 4}}, ["-         1: 2   # by Ana", "+         1: 5   # by Ana"]),
        (BRIDGE, {PAIRS: {1: 2, 7: 8}}, ["-         3: 4", "+         7: 8"]),
        (
            BRIDGE,
            {PAIRS: None},
            ["-     pairs:", "-         1: 2   # by Ana", "-         3: 4"],
        ),
        (
            BRIDGE,
            {("test", "sensors", "match"): {9: 7}, ("test", "sensors", "align"): None},
            ["-         align: fit", "+         match: {9: 7}"],
        ),
        (BRIDGE, {("run", "parallel"): 2}, ["+ run: {parallel: 2}"]),
        (
            BELL,
            {PAIRS: {3: 9}},
            [
                "-        pairs: {1: 2, 3: 4}, sensors: {align: fit, tolerance: 2.5}}",
                "+        pairs: {3: 9}, sensors: {align: fit, tolerance: 2.5}}",
            ],
        ),
        (
            BELL,
            {("test", "sensors", "match"): {1: 2}, ("test", "sensors", "align"): None},
            [
                "-        pairs: {1: 2, 3: 4}, sensors: {align: fit, tolerance: 2.5}}",
                "+        pairs: {1: 2, 3: 4}, sensors: {tolerance: 2.5, match: {1: 2}}}",
            ],
        ),
        (BELL, {("name",): "bell"}, ["+ name: bell"]),
        (MAST, {PAIRS: {2: 3}}, ["+   pairs: {2: 3}"]),
        (MAST, {PAIRS: None}, []),
    ],
)
def test_only_what_changes_is_written(
    text: str, changes: dict[Place, object], lines: list[str]
) -> None:
    assert changed(text, changes) == lines


@pytest.mark.parametrize("ends", ["\n", "\r\n"])
@pytest.mark.parametrize("text", [BRIDGE, BELL, MAST])
def test_line_ends_stay_and_what_was_meant_is_read(text: str, ends: str) -> None:
    text = text.replace("\n", ends)
    source = source_of(text)
    after = edited(source, {PAIRS: {4: 5, 6: 7}, ("test", "modes"): ["a b.csv", "ä.unv"]})
    assert after.count("\n") == after.count(ends)
    found: Any = yaml.safe_load(after)
    assert found["test"]["pairs"] == {4: 5, 6: 7}
    assert found["test"]["modes"] == ["a b.csv", "ä.unv"]


@pytest.mark.parametrize(
    ("text", "after"),
    [
        (
            "p:\n  - {a: 1}   # one\n  # two\n  - b: 2\n    c: 3\nq: 4\n",
            "p:\n  # two\n  - b: 2\n    c: 3\nq: 4\n",
        ),
        ("p: [{a: 1}, {b: 2}]   # both\n", "p: [{b: 2}]   # both\n"),
        ("p: [{a: 1}]\n", "p: []\n"),
        ("p:\n- a: 1\n  d: 5\nq: 4\n", "p: []\nq: 4\n"),
    ],
)
def test_an_item_of_a_list_is_removed_with_its_line(text: str, after: str) -> None:
    assert edited(source_of(text), {("p", 0): None}) == after


@pytest.mark.parametrize("path", CAMPAIGNS, ids=lambda path: path.name)
def test_what_is_set_and_removed_again_leaves_every_campaign_as_it_was(path: Path) -> None:
    source = read_yaml(path, "a campaign")
    had = source.at(PAIRS)
    after = edited(source, {PAIRS: {97: 98}})
    assert parse_yaml(path, after, "a campaign").at(PAIRS) == {97: 98}
    if had is None:
        assert edited(parse_yaml(path, after, "a campaign"), {PAIRS: None}) == source.text


@pytest.mark.parametrize(
    "text",
    [
        "base: &b {pairs: {1: 2}}\ntest: *b\n",  # the change would be in `base` too
        "test: [1, 2]\n",
        "test: words\n",
    ],
)
def test_what_cannot_be_changed_here_is_told_with_what_to_write(text: str) -> None:
    with pytest.raises(CampaignError, match=r"write it there by hand: test\.pairs: \{1: 3\}"):
        edited(source_of(text), {PAIRS: {1: 3}})
