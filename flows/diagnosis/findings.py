"""What is found of a test and a model: what is doubtful or wrong, where, and what helps."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal, get_args

#: good: looked at and as it should be; doubtful: a person should look; wrong: do not start so.
Level = Literal["good", "doubtful", "wrong"]
#: What a finding is about.
Subject = Literal["test", "sensors", "model", "modes", "pairing", "parameters"]
ORDER: dict[Level, int] = {"good": 0, "doubtful": 1, "wrong": 2}


@dataclass(frozen=True, slots=True)
class Setting:
    """A key of the campaign file that resolves a finding.

    place: the keys that lead to it, a parameter by its name. value: what the finding offers; None
    where only a user knows it. how: the value is set; its items join the key's list, or leave it
    (`test.use`, which has all test modes by default); or the key is removed.
    """

    place: tuple[str, ...]
    value: object = None
    how: Literal["set", "add", "leave_out", "remove"] = "set"


def setting(key: str, value: object = None) -> Setting:
    """Set a key such as `model.units`."""
    return Setting(tuple(key.split(".")), value)


def modes_left_out(*numbers: int) -> Setting:
    return Setting(("test", "use"), numbers, "leave_out")


def paired_by_hand(pairs: Mapping[int, int]) -> Setting:
    """Set pairs of a test mode and an elastic mode, in addition to those that are set."""
    return Setting(("test", "pairs"), dict(pairs), "add")


def sensors_dropped(*names: str) -> Setting:
    return Setting(("test", "sensors", "drop"), names, "add")


def of_parameter(name: str, key: str, value: object = None) -> Setting:
    return Setting(("parameters", name, key), value)


def without_parameter(name: str) -> Setting:
    return Setting(("parameters", name), None, "remove")


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at.

    where: the mode, sensor or parameter; remedy: may be empty; settings: keys that resolve it, one
    of them being enough.
    """

    level: Level
    subject: Subject
    what: str
    where: str = ""
    remedy: str = ""
    settings: tuple[Setting, ...] = ()

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

    def doubtful(self, what: str, where: str = "", remedy: str = "", *settings: Setting) -> Finding:
        return Finding("doubtful", self.subject, what, where, remedy, settings)

    def wrong(self, what: str, where: str = "", remedy: str = "", *settings: Setting) -> Finding:
        return Finding("wrong", self.subject, what, where, remedy, settings)


TEST, SENSORS, MODEL, MODES, PAIRING, PARAMETERS = map(FindingsOf, get_args(Subject))


def worst(findings: Iterable[Finding]) -> Level:
    """The worst level of all; good where there are none."""
    return max((item.level for item in findings), key=ORDER.__getitem__, default="good")
