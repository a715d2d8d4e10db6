"""Repeated tests as a table with a row a test, in CSV or a sheet of a workbook.

    test, frequency_1_hz, frequency_2_hz, damping_1, damping_2
    1,    15.538,         44.660,         0.0064,    0.0112
    2,    15.558,         ,               0.0067,              (an empty value: not found)

Modes are numbered by their headings; the first column may name the tests. More columns may hold
what else each test measured, under the response's name (`mass`, `displacement 6.x of load case 1`),
in the deck's units. Values may be in the
units of `tables`, and missing ones also be written as -, nan, n/a.
"""

from __future__ import annotations

import re
from itertools import product

import numpy as np

from modetune.adapters.test_files.tables import FileTable, factor, heading, number
from modetune.core.errors import CampaignError, ModesError
from modetune.core.measurement.measurement import Measurement, OtherValues, RepeatedTests
from modetune.core.measurement.repeated_tests import APART, measurement_of
from modetune.core.modes import Floats

NAMED = ("test", "run", "repetition", "specimen", "sample", "measurement")
MISSING = ("", "-", "nan", "na", "n/a")
QUANTITIES = ("frequency_hz", "damping_ratio")
OTHERS = re.compile(r"(mass|centre|inertia|displacement|strain)\b|(centre|inertia)_", re.IGNORECASE)
_OF_MODE = re.compile(r"(?:mode )?([^\d]+?) ?([0-9]{1,6})(?: hz)?|mode ([0-9]{1,6}) ([^\d]+)")


def is_repeated(table: FileTable) -> bool:
    """Return whether a table has a row a test: two headings or more name a quantity and a mode."""
    fields = table.rows[0].fields if table.rows else ()
    return sum(_column(field) is not None for field in fields) > 1


def repeated_of(table: FileTable) -> Measurement:
    """Return the mean of the tests of a table.

    Raises CampaignError with every problem, each with file
    and line."""
    header, *rows = table.rows
    problems: list[str] = []
    columns = [_column(field) for field in header.fields]
    first = heading(header.fields[0])[0] in NAMED
    places: dict[tuple[str, int], tuple[int, float]] = {}
    others: dict[str, int] = {}
    for place, (field, column) in enumerate(zip(header.fields, columns, strict=True)):
        if column is None and OTHERS.match(field.strip()):
            others[re.sub(r"[\s_]+", " ", field.strip())] = place
        elif column is None and not (place == 0 and first):
            problems.append(
                f"{header.where}: column `{field}` is neither a frequency nor a damping of a mode, "
                "such as frequency_1_hz or damping_1, nor a mass, displacement or strain"
            )
        elif column is not None:
            meaning, mode, unit = column
            if (meaning, mode) in places:
                problems.append(f"{header.where}: a second column `{field}`")
            places[meaning, mode] = place, factor(header.where, meaning, unit, problems)
    numbers = sorted({mode for meaning, mode in places if meaning == "frequency_hz"})
    lost = sorted({mode for meaning, mode in places if meaning != "frequency_hz"} - set(numbers))
    if lost or not numbers:
        of = f"mode {lost[0]} has damping" if lost else "there is damping"
        problems.append(f"{header.where}: {of}, but no frequency")
    values = np.full((2, len(rows), len(numbers)), np.nan)
    for test, row in enumerate(rows):
        if len(row.fields) > len(header.fields):
            problems.append(
                f"{row.where}: {len(row.fields)} values under {len(header.fields)} headings"
            )
        for (meaning, mode), (place, scale) in places.items():
            field = row.fields[place].casefold() if place < len(row.fields) else ""
            if field in MISSING or mode not in numbers:
                continue
            value = scale * number(field)
            if np.isnan(value) or (meaning == "frequency_hz" and value <= 0.0):
                problems.append(
                    f"{row.where}: `{header.fields[place]}` has {field!r}, where a number above "
                    "zero must be, or nothing"
                )
            values[QUANTITIES.index(meaning), test, numbers.index(mode)] = value
    beside = np.full((len(rows), len(others)), np.nan)
    for (test, row), (at, own) in product(enumerate(rows), enumerate(others.values())):
        field = row.fields[own].casefold() if own < len(row.fields) else ""
        beside[test, at] = number(field)
        if field not in MISSING and np.isnan(beside[test, at]):
            problems.append(f"{row.where}: `{header.fields[own]}` has {field!r}, not a number")
    if not problems:
        problems = _apart(table, numbers, values[0])
    if problems:
        raise CampaignError(problems)
    try:
        return measurement_of(
            RepeatedTests(
                tuple(row.where for row in rows),
                tuple(numbers),
                values[0],
                values[1],
                others=OtherValues(tuple(others), beside) if others else None,
            )
        )
    except ModesError as error:
        raise CampaignError(f"{table.start}: {error}") from error


def _apart(table: FileTable, numbers: list[int], hz: Floats) -> list[str]:
    """Return why most rows cannot be tests of one structure, or modes of one number be the same."""
    if len(hz) < 2:
        return [f"{table.start}: {len(hz)} test follows; repeated tests are two or more"]
    middle = np.nanmedian(hz, axis=0)
    far = np.abs(hz / middle - 1.0) > APART
    return [
        f"{table.start}: mode {numbers[mode]} is more than {100 * APART:.0f} % from its median, "
        f"{middle[mode]:g} Hz, in {far[:, mode].sum()} of {len(hz)} tests, such as "
        f"{table.rows[1 + int(np.argmax(far[:, mode]))].where}; number the modes alike in all tests"
        for mode in np.flatnonzero(far.sum(axis=0) > 0.25 * len(hz)).tolist()
    ]


def _column(field: str) -> tuple[str, int, str] | None:
    """Return quantity, mode and unit of a column's heading."""
    words, unit = heading(field)
    found = _OF_MODE.fullmatch(words)
    if found is None:
        return None
    name = re.sub(r"[ _]+", " ", found[1] or found[4]).strip()
    meaning = heading({"f": "frequency", "d": "damping"}.get(name, name))[0]
    mode = int(found[2] or found[3])
    return (meaning, mode, unit) if meaning in QUANTITIES else None
