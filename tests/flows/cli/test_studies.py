"""A study is deployed as it is typed; what it asks for is checked before a server hears of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from modetune.core.errors import CampaignError
from modetune.flows.cli.ending import StudyEnd
from modetune.flows.cli.studies import Study, read_study
from modetune.flows.cli.study import Opened

CAMPAIGN = Path("wing.yaml")


def test_a_line_becomes_a_study_with_paths_that_hold_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    study = read_study("screen --method morris --points 40 --figures 'my figures'", CAMPAIGN)
    figures = str(tmp_path / "my figures")
    options = ("--method", "morris", "--points", "40", "--figures", figures)
    assert study == Study("screen", options)
    line = study.arguments(Path("/x/wing.yaml"), ["run.parallel=2"], Path("/x/runs"))
    assert line == ["screen", "/x/wing.yaml", "--set", "run.parallel=2", "--runs", "/x/runs",
                    *options]  # fmt: skip
    assert read_study("correlate run/campaign.h5", CAMPAIGN).options == (
        str(tmp_path / "run" / "campaign.h5"),
    )
    assert read_study("pretest --modes 1-3,5 --mass", CAMPAIGN).options == (
        "--modes", "1-3,5", "--mass",
    )  # fmt: skip
    assert read_study("scatter --of a --of b", CAMPAIGN).options == ("--of", "a", "--of", "b")
    assert read_study("validate --leave-one-out", CAMPAIGN).options == ("--leave-one-out",)
    assert read_study("check", CAMPAIGN).arguments(CAMPAIGN, [], tmp_path) == ["check", "wing.yaml"]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("polish", "expected one of update, screen"),
        ("screen --metod morris", "--metod"),
        ("screen --points many", "--points"),
        ("screen --set a=b", "--set is not part of a study"),
        ("update --dry-run", "--dry-run is not part of a study"),
        ("screen 'morris", "expected a command and its options"),
        ("", "expected a command and its options"),
    ],
)
def test_a_line_that_is_no_study_is_one_sentence(line: str, said: str) -> None:
    with pytest.raises(CampaignError, match=said):
        read_study(line, CAMPAIGN)


class Logged:
    """Pages that keep their log."""

    def __init__(self) -> None:
        self.heard: list[str] = []

    def log(self, text: str) -> None:
        self.heard.append(text)

    def done(self, said: str, *more: object, good: bool) -> None:
        self.heard.append(f"{said}: {good}")


def test_what_a_study_says_is_the_log_of_its_pages() -> None:
    said: list[str] = []
    pages: Any = Logged()
    nothing: Any = None
    Opened(nothing, pages, said.append).working("points of the design")
    StudyEnd("two chosen", {}, [], ["1 of 12 points failed"]).reported(("screen", "x"), pages)
    assert said == ["points of the design"]
    assert pages.heard == ["points of the design", "1 of 12 points failed", "two chosen: True"]
