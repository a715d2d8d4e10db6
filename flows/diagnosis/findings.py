"""What is found of a test and a model: what is doubtful or wrong, where, and what helps."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, get_args

#: good: looked at and as it should be; doubtful: a person should look; wrong: do not start so.
Level = Literal["good", "doubtful", "wrong"]
#: What a finding is about.
Subject = Literal["test", "sensors", "model", "modes", "pairing", "parameters"]
ORDER: dict[Level, int] = {"good": 0, "doubtful": 1, "wrong": 2}


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at. where: the mode, sensor or parameter; remedy: may be empty."""

    level: Level
    subject: Subject
    what: str
    where: str = ""
    remedy: str = ""

    @property
    def text(self) -> str:
        """The finding in a sentence, without its level."""
        where = f"{self.where}: " if self.where else ""
        return f"{where}{self.what}{f'; {self.remedy}' if self.remedy else ''}"


@dataclass(frozen=True, slots=True)
class FindingsOf:
    """Makes the findings of one subject."""

    subject: Subject

    def good(self, what: str, where: str = "", remedy: str = "") -> Finding:
        return Finding("good", self.subject, what, where, remedy)

    def doubtful(self, what: str, where: str = "", remedy: str = "") -> Finding:
        return Finding("doubtful", self.subject, what, where, remedy)

    def wrong(self, what: str, where: str = "", remedy: str = "") -> Finding:
        return Finding("wrong", self.subject, what, where, remedy)


TEST, SENSORS, MODEL, MODES, PAIRING, PARAMETERS = map(FindingsOf, get_args(Subject))


def worst(findings: Iterable[Finding]) -> Level:
    """The worst level of all; good where there are none."""
    return max((item.level for item in findings), key=ORDER.__getitem__, default="good")
