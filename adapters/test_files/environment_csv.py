"""Rows of a table that say when a test was, and what else was measured: temperature, load.

    measured_at,               2026-11-27T02:00:00Z
    environment temperature_C, 21.5
    environment humidity,      0.43

Each has one value; a time without a zone is in UTC. The rows may be anywhere in the table of the
modes, or in a file of their own, for tests whose other files have no place for them.
"""

from __future__ import annotations

import math
import re
from datetime import UTC, datetime

from modetune.adapters.test_files.tables import FileTable, number
from modetune.core.errors import CampaignError

#: The name of the row with the time.
TIME = "measured_at"
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


def split_time(table: FileTable) -> tuple[float, FileTable]:
    """Return when the test was, seconds since 1970 or NaN, and the table without that row.

    Raises CampaignError.
    """
    rows = [row for row in table.rows if row.fields[0].strip().lower() == TIME]
    if not rows:
        return math.nan, table
    if len(rows) > 1:
        raise CampaignError(f"{rows[1].where}: a second row `{TIME}`")
    try:
        (text,) = rows[0].fields[1:]
        at = seconds_of(datetime.fromisoformat(text.strip()))
    except ValueError:
        raise CampaignError(
            f"{rows[0].where}: `{TIME}` has {', '.join(rows[0].fields[1:]) or 'nothing'}, where a "
            "time such as 2026-11-27T02:00:00Z must be"
        ) from None
    return at, FileTable(table.name, tuple(row for row in table.rows if row is not rows[0]))


def seconds_of(at: datetime) -> float:
    """Return a time in seconds since 1970; without a zone it is in UTC."""
    return (at if at.tzinfo else at.replace(tzinfo=UTC)).timestamp()
