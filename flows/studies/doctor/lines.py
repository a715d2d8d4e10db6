"""The lines of a doctor's report: what was looked at, how it stands, and what to do."""

from __future__ import annotations

import re
import socket
from collections.abc import Callable
from dataclasses import dataclass, replace
from getpass import getuser
from pathlib import Path
from typing import Annotated, Literal, get_args

from modetune.flows.report.tables import Column

State = Literal["passed", "failed", "not available"]
STATES: tuple[State, ...] = get_args(State)


@dataclass(frozen=True, slots=True)
class DoctorLine:
    """One thing that was looked at.

    topic: what it is of, the machine or a solver; said: what was found, or the reason; remedy:
    what to do, empty where nothing is to be done; seconds: what it took.
    """

    topic: Annotated[str, Column("of")]
    item: Annotated[str, Column("what")]
    state: Annotated[State, Column("state")]
    said: Annotated[str, Column("found")]
    remedy: Annotated[str, Column("what to do")] = ""
    seconds: Annotated[float, Column("time", "s", ".1f")] = 0.0

    @property
    def text(self) -> str:
        """The line for people."""
        more = f"; {self.remedy}" if self.remedy else ""
        return f"{self.state:<13} {self.topic}: {self.item}: {self.said}{more}"


#: Is told each line as it comes.
Tell = Callable[[DoctorLine], None]


def without_names(line: DoctorLine) -> DoctorLine:
    """The line without home folder, user and host, so that the report can be sent."""
    return replace(line, said=_anonymous(line.said), remedy=_anonymous(line.remedy))


def _anonymous(text: str) -> str:
    text = text.replace(str(Path.home()), "~")
    for name, shown in ((getuser(), "USER"), (socket.gethostname(), "HOST")):
        if len(name) > 1:
            text = re.sub(rf"(?<![\w.-]){re.escape(name)}(?![\w-])", shown, text)
    return text
