"""A chart as values: panels with curves, bars and maps on axes, independent of drawing.

`charts.js` draws a chart in an interactive page, `matplotlib_charts` for print. Texts are plain;
the drawing code escapes markup and formulas. The colours are those of Okabe and Ito (2008), which
colour-blind readers can distinguish, three of them darkened: each has a contrast of at least 3 to
the paper by day and by night. Test, before and after have the same colours everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

import numpy as np

from modetune.core.modes import Floats
from modetune.core.storage.keys import Json, number_or_null

TEST, BEFORE, AFTER = "#000000", "#3A94CC", "#D55E00"
PARAMETER_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#C4689A", "#B07A00", BEFORE, TEST)
GREY = "#8a8f98"
#: Maximum number of rows and columns of a map with printed values.
NUMBERED = 16
#: Smaller values are not printed: a field of zeros hides the others.
ZERO = 0.005


@dataclass(frozen=True, slots=True)
class Curve:
    """Points (n,) with a line, markers or both; NaN is a gap.

    line is -, --, : or ""; mark is o, ring, x, +, v, s or "". Each point may have a tooltip and a
    label next to it.
    """

    name: str
    x: Floats
    y: Floats
    colour: str
    line: str = "-"
    mark: str = ""
    width: float = 1.5
    size: float = 7.0
    tooltips: tuple[str, ...] = ()
    labels: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Bars:
    """A bar (n,) for each name of the category axis; several sets appear side by side.

    colours has one for all or one for each bar; errors are half widths of intervals, (n,).
    """

    name: str
    values: Floats
    colours: str | tuple[str, ...]
    errors: Floats | None = None
    labels: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class HeatMap:
    """Values (n_rows, n_columns) as colours, printed in their cells if there is room.

    tooltip contains {row}, {column} and {value}. The scale from low to high has a unit and the
    colours viridis, RdBu or Blues.
    """

    values: Floats
    tooltip: str
    unit: str = ""
    low: float = 0.0
    high: float = 1.0
    scale: str = "viridis"

    @property
    def is_numbered(self) -> bool:
        return max(self.values.shape) <= NUMBERED


@dataclass(frozen=True, slots=True)
class Towers:
    """Values (n_rows, n_columns) in [0, 1] as 3D bars; rows go back, columns to the right."""

    values: Floats
    tooltip: str
    unit: str = ""


@dataclass(frozen=True, slots=True)
class Rule:
    """A straight line across a panel at one value of an axis."""

    name: str
    value: float
    colour: str = GREY
    line: str = ":"
    upright: bool = False


@dataclass(frozen=True, slots=True)
class Axis:
    """An axis with its title.

    names are categories at 0, 1, 2 ..., rotated by slant degrees; step is the distance of ticks;
    span contains the ends; turned reverses the direction.
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
    """Items on one pair of axes; sideways makes bars horizontal, with categories along y."""

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
    """Panels in rows of `across`, with a description for screen readers.

    size is that of a panel in inches; same_x shares the x axis within a column, same_y the y axis
    within a row; legend is the title of the legend, which lists each name once.
    """

    title: str
    description: str
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
    """Return a chart as JSON for `charts.js`, with six digits per number and null for NaN."""
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
    """Return the step of an integer axis with at most about a dozen ticks."""
    return float(max(1, int(largest) // 12))
