"""A chart as values: panels with curves, bars and maps on axes, and nothing of how they are drawn.

What is described here once is drawn by `charts.js` in a page, which answers the pointer, and by
`matplotlib_charts` for print. Texts are plain: what a drawing library would take for markup or for
a formula is escaped where it is drawn. Colours are those of Okabe and Ito (2008), told apart by
everyone; test, before and after have the same colour everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

import numpy as np

from modetune.core.modes import Floats
from modetune.core.storage.keys import Json, number_or_null

TEST, BEFORE, AFTER = "#000000", "#56B4E9", "#D55E00"
PARAMETER_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
GREY = "#8a8f98"
#: Rows and columns of a map up to which its values are written into it.
NUMBERED = 16
#: A written value below it is left out: a field of zeros hides what is to be seen.
ZERO = 0.005


@dataclass(frozen=True, slots=True)
class Curve:
    """Points (n,) joined by a line, or marked, or both; NaN is a gap.

    line: -, --, : or nothing; mark: o, ring, x, +, v, s, or nothing.
    told: the text of each point under the mouse; written: the text next to it.
    """

    name: str
    x: Floats
    y: Floats
    colour: str
    line: str = "-"
    mark: str = ""
    width: float = 1.5
    size: float = 7.0
    told: tuple[str, ...] = ()
    written: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Bars:
    """A bar (n,) for each name of the category axis; a panel may have several, side by side.

    colours: of all, or of each; errors: half widths of intervals, (n,).
    """

    name: str
    values: Floats
    colours: str | tuple[str, ...]
    errors: Floats | None = None
    written: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class HeatMap:
    """Values (n_rows, n_columns) as colours, written in while there is room.

    told: the text of a cell under the mouse, with {row}, {column} and {value}; unit: of the scale,
    which goes from low to high in the colours viridis, RdBu (against and with) or Blues.
    """

    values: Floats
    told: str
    unit: str = ""
    low: float = 0.0
    high: float = 1.0
    scale: str = "viridis"

    @property
    def is_numbered(self) -> bool:
        return max(self.values.shape) <= NUMBERED


@dataclass(frozen=True, slots=True)
class Towers:
    """Values (n_rows, n_columns) in [0, 1] as bars in space; rows go back, columns to the right."""

    values: Floats
    told: str
    unit: str = ""


@dataclass(frozen=True, slots=True)
class Rule:
    """A straight line across a panel, where one axis has a value."""

    name: str
    value: float
    colour: str = GREY
    line: str = ":"
    upright: bool = False


@dataclass(frozen=True, slots=True)
class Axis:
    """The names, numbers and title along an axis.

    names: of categories, at 0, 1, 2 ...; slant: degrees by which they are turned; step: of its
    ticks; span: its ends; turned: whether it begins at the far end.
    """

    label: str = ""
    names: tuple[str, ...] = ()
    slant: int = 0
    log: bool = False
    step: float | None = None
    span: tuple[float, float] | None = None
    turned: bool = False


Item = Curve | Bars | HeatMap | Towers | Rule


@dataclass(frozen=True, slots=True)
class Panel:
    """Things on one pair of axes; sideways: its bars lie, the categories are those of y."""

    items: tuple[Item, ...]
    x: Axis = field(default_factory=Axis)
    y: Axis = field(default_factory=Axis)
    title: str = ""
    square: bool = False
    sideways: bool = False

    @property
    def is_space(self) -> bool:
        return any(isinstance(item, Towers) for item in self.items)


@dataclass(frozen=True, slots=True)
class Chart:
    """Panels in rows of so many; told: what it shows, for who cannot see it.

    size: of a panel in inches; same_x, same_y: whether the panels of a column share their x axis,
    those of a row their y axis; legend: its title. A name that several panels have stands in the
    legend once.
    """

    title: str
    told: str
    panels: tuple[Panel, ...]
    across: int = 1
    size: tuple[float, float] = (6.4, 3.8)
    same_x: bool = False
    same_y: bool = False
    legend: str = ""

    @property
    def down(self) -> int:
        return -(-len(self.panels) // self.across)

    def alone(self, place: int) -> Chart:
        """Return one of its panels as a separate chart."""
        return replace(self, panels=(replace(self.panels[place], title=""),), across=1)


def chart_json(value: Any) -> Json:
    """A chart as `charts.js` reads it: objects of the fields with their kind, six digits a number.

    What no axis can show (NaN) is null.
    """
    if is_dataclass(value):
        found = {item.name: chart_json(getattr(value, item.name)) for item in fields(value)}
        if isinstance(value, HeatMap):
            found["numbered"] = value.is_numbered
        return {"kind": type(value).__name__, **found}
    if isinstance(value, np.ndarray):
        return chart_json(value.tolist())
    if isinstance(value, float):
        return number_or_null(float(f"{value:.6g}"))
    if isinstance(value, tuple | list):
        return [chart_json(item) for item in value]
    return str(value) if value is not None and not isinstance(value, bool | int) else value


def names_of(numbers: Sequence[object]) -> tuple[str, ...]:
    return tuple(str(number) for number in numbers)


def positions(names: Sequence[object]) -> Floats:
    """Return the positions of categories on their axis, (n,)."""
    return np.arange(len(names), dtype=np.float64)


def tick_step(largest: float) -> float:
    """Step of an axis of whole numbers that has a dozen ticks at most."""
    return float(max(1, int(largest) // 12))
