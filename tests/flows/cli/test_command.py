"""A study is deployed as it is typed; its options are checked before a server hears of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from modetune.core.errors import CampaignError
from modetune.flows.cli.command import parse_study


@pytest.mark.parametrize(
    ("line", "name", "parameters"),
    [
        ("screen --method morris --points 40", "screen", {"method": "morris", "points": 40}),
        ("pretest --modes 1-3,5 --mass", "pretest", {"modes": [1, 2, 3, 5], "by_mass": True}),
        ("scatter --of a --of b", "scatter", {"of": ["a", "b"]}),
        ("validate --leave-one-out", "validate", {"leave_one_out": True}),
        ("update --starts 3", "update", {"starts": 3}),
        ("check", "check", {}),
    ],
)
def test_a_line_becomes_a_study_and_the_parameters_that_it_names(
    line: str, name: str, parameters: dict[str, object]
) -> None:
    study, found = parse_study(line)
    assert (study.name, found) == (name, parameters)


def test_paths_of_a_line_are_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "masters.txt").write_text("1.x\n")
    assert parse_study("screen --figures 'my figures'")[1] == {
        "figures": str(tmp_path / "my figures")
    }
    assert parse_study("correlate run/campaign.h5")[1] == {
        "second": [str(tmp_path / "run" / "campaign.h5")]
    }
    assert parse_study("reduce a.unv,b.csv --masters masters.txt")[1] == {
        "test": [str(tmp_path / "a.unv"), str(tmp_path / "b.csv")],
        "masters": str(tmp_path / "masters.txt"),
    }


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("polish", "expected one of go, pretest, check, modes"),
        ("screen --metod morris", "--metod"),
        ("screen --method mories", "--method 'mories': expected one of local, morris"),
        ("screen --points many", "--points"),
        ("pretest --modes 3-1", "--modes '3-1': expected numbers"),
        ("screen --set a=b", "--set is not part of a study"),
        ("update --dry-run", "--dry-run is not part of a study"),
        ("screen 'morris", "expected a command and its options"),
        ("", "expected a command and its options"),
    ],
)
def test_a_line_that_is_no_study_is_one_sentence(line: str, said: str) -> None:
    with pytest.raises(CampaignError, match=said) as refused:
        parse_study(line)
    assert "\n" not in str(refused.value)
