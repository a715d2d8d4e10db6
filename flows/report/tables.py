"""Tables of results for terminal, page, JSON, Prefect and data frames.

A row is a frozen dataclass; the type of each visible field describes its column:

    test_hz: Annotated[float, Column("test", "Hz")]

The field's name is the key in JSON and the column of a data frame; the heading appears on the
terminal, in pages and in Prefect's tables. If the columns depend on the result (one per mode or
parameter), a table consists of columns and rows of plain values instead.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_origin, get_type_hints

from modetune.core.storage.keys import Json, number_or_null

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import Console
    from rich.table import Table as TerminalTable
    from rich.text import Text

#: Terminal style of values outside their tolerance.
OUTSIDE = "bold red"


@dataclass(frozen=True, slots=True)
class Column:
    """The heading and format of one column.

    unit follows the heading; values in % are stored as fractions. form is a format as in f-strings;
    without it frequencies have five digits. unknown is the text of NaN. words aligns texts to the
    left. name is that of the field.
    """

    heading: str
    unit: str = ""
    form: str = ""
    unknown: str = "-"
    words: bool = False
    name: str = ""

    @property
    def head(self) -> str:
        return f"{self.heading}, {self.unit}" if self.unit else self.heading

    def shown(self, value: Any) -> str:
        """Return the text of a value."""
        if hasattr(value, "tolist"):  # numbers and arrays of numpy
            value = value.tolist()
        if value is None or isinstance(value, str):
            return value or ""
        if isinstance(value, bool):
            return "yes" if value else "no"
        if isinstance(value, tuple | list):
            return ", ".join(self.shown(item) for item in value)
        if isinstance(value, int) and self.unit != "%":
            return str(value)
        if not math.isfinite(value):
            return self.unknown
        if self.unit == "Hz" and not self.form:
            return hertz(value)
        text = format(100.0 * value if self.unit == "%" else value, self.form or ".4g")
        # A number that rounds to zero has no sign.
        return text if float(text) else text.lstrip("+-")


@dataclass(frozen=True, slots=True)
class Table:
    """A table: columns, rows of values, and summary rows in the foot.

    outside has the row and the column's name of each value outside its tolerance; the name ""
    marks the whole row. links: addresses, by the row whose first cell leads there on a page.
    """

    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Any, ...], ...]
    foot: tuple[tuple[Any, ...], ...] = ()
    outside: frozenset[tuple[int, str]] = frozenset()
    links: Mapping[int, str] = dataclasses.field(default_factory=dict)

    def is_outside(self, row: int, column: Column) -> bool:
        return bool({(row, column.name), (row, "")} & self.outside)

    @property
    def texts(self) -> list[list[str]]:
        """The texts of all rows."""
        return [_texts(self.columns, row) for row in self.rows]

    @property
    def foot_texts(self) -> list[list[str]]:
        return [_texts(self.columns, row) for row in self.foot]


def table_of(
    title: str,
    rows: Sequence[Any],
    kind: type | Sequence[Column],
    only: str = "",
    foot: Sequence[Sequence[Any]] = (),
    outside: Iterable[tuple[int, str]] = (),
) -> Table:
    """Return a table of rows of one class.

    kind is that class, or columns named after attributes; only lists the names of the columns to
    show, all if it is empty.
    """
    columns = columns_of(kind) if isinstance(kind, type) else tuple(kind)
    if only:
        by_name = {column.name: column for column in columns}
        columns = tuple(by_name[name] for name in only.split())
    values = tuple(tuple(getattr(row, column.name) for column in columns) for row in rows)
    return Table(title, columns, values, tuple(map(tuple, foot)), frozenset(outside))


@cache
def columns_of(kind: type) -> tuple[Column, ...]:
    """Return the columns of a class of rows, in the order of its fields."""
    found = []
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if get_origin(hint) is not Annotated:
            continue
        bare, *notes = get_args(hint)
        found += [
            dataclasses.replace(note, name=name, words=note.words or bare is str)
            for note in notes
            if isinstance(note, Column)
        ]
    return tuple(found)


def terminal_table(table: Table) -> TerminalTable:
    """Return a table as Rich's."""
    from rich.table import Table as TerminalTable
    from rich.text import Text

    made = TerminalTable(title=Text(table.title) if table.title else None, title_justify="left")
    for column in table.columns:
        # Do not truncate names.
        made.add_column(
            Text(column.head), justify="left" if column.words else "right", overflow="fold"
        )
    for place, texts in enumerate(table.texts):
        cells = [
            Text(text, style=OUTSIDE if table.is_outside(place, column) else "")
            for column, text in zip(table.columns, texts, strict=True)
        ]
        made.add_row(*cells)
    if table.foot:
        made.add_section()
    for texts in table.foot_texts:
        made.add_row(*map(Text, texts))
    return made


def show(parts: Iterable[Table | Text | str], console: Console | None = None) -> None:
    """Print sentences and nonempty tables on the terminal or another console."""
    from rich.text import Text

    from modetune.flows.report.terminal import terminal

    console = console or terminal()
    for part in parts:
        if not isinstance(part, Table):
            # Do not wrap lines in files and pipes.
            console.print(Text(part) if isinstance(part, str) else part, soft_wrap=True)
        elif part.rows:
            if part.title:  # Rich's own title is as narrow as the table
                console.print(Text(part.title, style="italic"), soft_wrap=True)
            console.print(terminal_table(dataclasses.replace(part, title="")))


def artifact_rows(table: Table) -> list[Json]:
    """Return rows for Prefect's tables, with integers as numbers, so that they sort."""
    heads = [column.head for column in table.columns]
    return [
        {
            head: value if type(value) is int else text
            for head, value, text in zip(heads, values, texts, strict=True)
        }
        for values, texts in zip(table.rows, table.texts, strict=True)
    ]


def frame(rows: Sequence[Any], kind: type) -> pd.DataFrame:
    """Return rows of a class as a data frame with one column per field.

    Columns of numbers have the type of their field whatever the rows hold: None becomes NaN.
    """
    import pandas as pd  # takes half a second, and a campaign needs none

    names = [item.name for item in dataclasses.fields(kind)]
    made = pd.DataFrame([[getattr(row, name) for name in names] for row in rows], columns=names)
    hints = get_type_hints(kind)
    types = {name: _TYPES[hints[name]] for name in names if hints[name] in _TYPES}
    return made.astype(types)


#: Types of columns of numbers by those of their fields.
_TYPES: dict[Any, str] = {int: "int64", bool: "bool", float: "float64", float | None: "float64"}


def json_of(value: Any) -> Json:
    """Return a result as JSON: dataclasses as objects of their fields, arrays as lists.

    Numbers that are not finite become null. Raises TypeError for unsupported types.
    """
    if value is None or isinstance(value, str | bool | int):
        return value.value if isinstance(value, Enum) else value
    if isinstance(value, float):
        return number_or_null(value)
    if hasattr(value, "tolist"):
        return json_of(value.tolist())
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, dict):
        return {str(key): json_of(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [json_of(item) for item in value]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {item.name: json_of(getattr(value, item.name)) for item in dataclasses.fields(value)}
    raise TypeError(f"{type(value).__name__} has no form in JSON")


def json_object(result: object = None, names: str = "", **named: Any) -> dict[str, Json]:
    """Return the `--json` object of a result: the named attributes, and other values."""
    found = {name: json_of(getattr(result, name)) for name in names.split()}
    return found | {name: json_of(value) for name, value in named.items()}


def hertz(value: float) -> str:
    """Return a frequency with five significant digits and at most three decimals."""
    decimals = min(3, max(0, 4 - math.floor(math.log10(abs(value))))) if value else 3
    return f"{value:.{decimals}f}"


def signed(text: str) -> str:
    """Return a number with a typographic minus, a dash if it is unknown."""
    return "\N{EN DASH}" if text == "-" else text.replace("-", "\N{MINUS SIGN}")


def _texts(columns: Sequence[Column], row: Sequence[Any]) -> list[str]:
    return [column.shown(value) for column, value in zip(columns, row, strict=True)]
