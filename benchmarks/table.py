"""A table of speeds: its rows, rounds and output.

In each round every row is measured once, one after the other. Both sides of a ratio are measured in
the same round, so that other load on the machine affects both. The figure of a row is the median of
its rounds; its parts are those of the round with the median.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Generic, TypeVar

from benchmarks.journal import Journal
from benchmarks.time_spent import ORDER

from modetune.core.errors import ModetuneError

R = TypeVar("R")


@dataclass(frozen=True, slots=True)
class Figure:
    """value: in the row's unit. made_of: the seconds and counts it comes from, by name."""

    value: float
    made_of: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Row(Generic[R]):
    """A line of the table. measure: takes the round; unit: none for ratios.

    aim: the required value; at_least: higher values are better, otherwise lower ones.
    """

    name: str
    what: str
    aim: float
    at_least: bool
    measure: Callable[[R], Figure]
    unit: str = ""

    @property
    def told_aim(self) -> str:
        return f"{'at least' if self.at_least else 'at most'} {self.aim:g}{self._unit}"

    @property
    def _unit(self) -> str:
        return f" {self.unit}" if self.unit else ""

    def told(self, value: float) -> str:
        return f"{value:.3g}{self._unit}"


@dataclass(slots=True)
class Measured(Generic[R]):
    """A row with the figures of its rounds, and why there are none where it failed."""

    row: Row[R]
    figures: list[Figure] = field(default_factory=list)
    error: str = ""

    @property
    def figure(self) -> Figure | None:
        """That of the middle: the lower one of two."""
        ordered = sorted(self.figures, key=lambda figure: figure.value)
        return ordered[(len(ordered) - 1) // 2] if ordered else None

    @property
    def value(self) -> float | None:
        """The median of the rounds."""
        values = sorted(figure.value for figure in self.figures)
        half = len(values) // 2
        if not values:
            return None
        return values[half] if len(values) % 2 else 0.5 * (values[half - 1] + values[half])

    @property
    def reached(self) -> bool | None:
        """Return whether the figure meets its aim; None without a figure."""
        if self.value is None:
            return None
        return self.value >= self.row.aim if self.row.at_least else self.value <= self.row.aim


def measure(
    rows: Sequence[Row[R]], rounds: Sequence[R], journal: Journal | None = None
) -> list[Measured[R]]:
    """Measure all rows in every round; a row that fails is printed and left out of later rounds.

    journal: has the figures of an interrupted benchmark, which are not measured again.
    """
    found = [Measured(row) for row in rows]
    for number, each in enumerate(rounds, start=1):
        for item in (item for item in found if not item.error):
            started, piece = time.monotonic(), f"round {number}, {item.row.name}"
            if journal is not None and piece in journal.results:
                item.figures.append(Figure(**journal.results[piece]))
                continue
            try:
                item.figures.append(item.row.measure(each))
                if journal is not None:
                    journal.add(piece, asdict(item.figures[-1]))
                said = item.row.told(item.figures[-1].value)
            except (ModetuneError, SystemExit, OSError, ValueError, AssertionError) as error:
                item.error = said = str(error).strip() or type(error).__name__
            wall_s = time.monotonic() - started
            sys.stderr.write(f"{piece}: {said} (took {wall_s:.0f} s)\n")
            sys.stderr.flush()
    return found


def markdown(found: Sequence[Measured[R]]) -> str:
    """The table as Markdown."""
    lines = ["| row | what | figure | aim | made of |", "| --- | --- | --- | --- | --- |"]
    for item in found:
        row, figure, value = item.row, item.figure, item.value
        if figure is None or value is None:
            told, parts = "failed", item.error.splitlines()[-1].replace("|", "/")
        else:
            told = row.told(value) if item.reached else f"**{row.told(value)}**"
            parts = ", ".join(f"{name} {_short(part)}" for name, part in figure.made_of.items())
        lines.append(f"| `{row.name}` | {row.what} | {told} | {row.told_aim} | {parts} |")
    return "\n".join(lines)


def _short(value: float) -> str:
    return f"{value:,.0f}" if value >= 1000 or value == int(value) else f"{value:.3g}"


def time_table(seconds: Mapping[str, Mapping[str, float]]) -> str:
    """Where the time of commands went, a column each, as Markdown."""
    parts = [part for part in ORDER if any(part in each for each in seconds.values())]
    lines = [
        f"| seconds | {' | '.join(seconds)} |",
        f"| --- |{' --- |' * len(seconds)}",
    ]
    for part in parts:
        cells = " | ".join(f"{each.get(part, 0.0):.1f}" for each in seconds.values())
        lines.append(f"| {part} | {cells} |")
    return "\n".join(lines)


def told(found: Sequence[Measured[R]]) -> list[dict[str, object]]:
    """The table for machines."""
    return [
        {
            "name": item.row.name,
            "what": item.row.what,
            "unit": item.row.unit,
            "aim": item.row.aim,
            "at_least": item.row.at_least,
            "value": item.value,
            "reached": item.reached,
            "rounds": [asdict(figure) for figure in item.figures],
            "error": item.error,
        }
        for item in found
    ]
