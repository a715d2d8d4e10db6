"""Rows of a table that say what else was measured with the test: temperature, humidity, load.

    environment temperature_C, 21.5
    environment humidity,      0.43

Each has one value. The rows may be anywhere in the table of the modes, or in a file of their own,
for tests whose other files have no place for them.
"""

from __future__ import annotations

import math
import re

from modetune.adapters.test_files.tables import FileTable, number
from modetune.core.errors import CampaignError

_ROW = re.compile(r"environment[\s:._]+(\S.*)", re.IGNORECASE)


def split_environment(table: FileTable) -> tuple[dict[str, float], FileTable]:
    """Return the values of the environment by name, and the table without their rows.

    Raises CampaignError with every problem, each with file and line.
    """
    values: dict[str, float] = {}
    problems: list[str] = []
    others = []
    for row in table.rows:
        found = _ROW.fullmatch(row.fields[0])
        if found is None:
            others.append(row)
            continue
        name, fields = found[1], row.fields[1:]
        value = number(fields[0]) if len(fields) == 1 else math.nan
        if math.isnan(value):
            text = ", ".join(fields) or "nothing"
            problems.append(f"{row.where}: `{row.fields[0]}` has {text}, where one number must be")
        if name in values:
            problems.append(f"{row.where}: a second row `{row.fields[0]}`")
        values[name] = value
    if problems:
        raise CampaignError(problems)
    return values, FileTable(table.name, tuple(others))
