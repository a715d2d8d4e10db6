"""Measured modes as a table, in CSV or a sheet of a workbook, modetune's own documented form.

    # comments and blank lines are skipped
    mode,           1,      2,      3
    frequency_hz,   5.51,   15.74,  34.75
    damping_ratio,  0.0042, 0.0031, 0.003       (optional, fraction of critical)
    frequency_deviation, 0.001, 0.001, 0.004    (optional, standard deviation over the frequency)
    shape_deviation,     0.02,  0.02,  0.1      (optional, of a shape's entries, over its rms)
    101.x,          0.12,  -0.40,   0.03        (sensor: node.component x y z rx ry rz)
    101.z,          ...
    environment temperature_C, 21.5             (optional, see `environment_csv`)
    measured_at, 2026-11-27T02:00:00Z           (likewise)

One column a mode, numbered as the test numbers them; or one row a mode, where the first row has
the names. Sensor rows are optional: without them only frequencies are compared. Each shape
may have any scaling. Names may be words with a unit (`tables.heading`), and sensors as test
systems write them: 101:+Z, wing:101:-X, 12Z. A sensor that looks the other way changes its sign.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from modetune.adapters.test_files.environment_csv import TIME
from modetune.adapters.test_files.tables import (
    FileTable,
    TableRow,
    factor,
    heading,
    read_tables,
    row_values,
)
from modetune.core.errors import CampaignError, ModesError
from modetune.core.measurement.measurement import MeasuredDeviations, Measurement
from modetune.core.modes import COMPONENTS, MeasuredModes, ModeSet, mode_set
from modetune.core.storage.files import writing

#: Rows that say how exactly frequencies and shapes were measured.
DEVIATIONS = ("frequency_deviation", "shape_deviation")
#: Rows of one value a mode that are no sensors.
QUANTITIES = ("frequency_hz", "damping_ratio", *DEVIATIONS)
#: A point: its number, which 64 bits hold, perhaps after a word.
POINT = r"(?:node|point|sensor|pt|mp|n|p|s)?\s*([0-9]{1,18})"
_SENSOR = re.compile(rf"(?:[^:]+:)?{POINT}(?:[.:_ ]\s*([+-]?))?(r?[xyz])([+-]?)")


def read_modes_csv(path: Path) -> MeasuredModes:
    """Return the modes of a test.

    Raises CampaignError with every problem, each with file and line.
    """
    found = read_test_csv(path).modes
    assert found is not None
    return found


def read_test_csv(path: Path, computed: bool = False) -> Measurement:
    """Return the modes of a file and how exactly they were measured.

    Raises CampaignError likewise.
    """
    return modes_of(read_tables(path)[0], computed)


def modes_of(table: FileTable, computed: bool = False) -> Measurement:
    """Return the modes of a table and how exactly they were measured.

    Raises CampaignError likewise.

    computed: the modes are a model's, which may be rigid (0 Hz), or move none of these nodes.
    """
    header, *others = _by_columns(table)
    problems: list[str] = []
    numbers = _mode_numbers(header, problems)
    known: dict[str, list[float]] = {}
    sensors: dict[tuple[int, int], list[float]] = {}
    seen: set[str | tuple[int, int]] = set()
    for row in others:
        name = row.fields[0]
        values = _numbers(row, len(header.fields) - 1, problems)
        (meaning, unit), sensor = heading(name), sensor_of(name)
        key = meaning if sensor is None else sensor[0]
        if key in seen:
            problems.append(f"{row.where}: a second row `{name}`")
        seen.add(key)
        if sensor is not None:
            sensors[sensor[0]] = [sensor[1] * value for value in values]
        elif meaning in QUANTITIES:
            scale = factor(row.where, meaning, unit, problems)
            known[meaning] = [scale * value for value in values]
            problems += _wrong(row, meaning, known[meaning], computed)
        else:
            problems.append(
                f"{row.where}: row `{name}` is neither {', '.join(QUANTITIES)} nor a sensor such "
                "as 101.x, the number of a point and a direction"
            )
    if "frequency_hz" not in known:
        problems.append(f"{header.where}: no row `frequency_hz` follows")
    if problems:
        raise CampaignError(problems)
    shapes = np.array(list(sensors.values())).reshape(len(sensors), len(numbers))
    still = np.flatnonzero(~shapes.any(axis=0))
    if sensors and still.size and not computed:
        raise CampaignError(f"{header.where}: mode {numbers[still[0]]} is zero at every sensor")
    places = np.array(list(sensors), dtype=np.int64).reshape(-1, 2)
    modes = mode_set(
        known["frequency_hz"], shapes, places[:, 0], places[:, 1], known.get("damping_ratio", [])
    )
    texts = [np.array(known.get(name, [math.nan] * len(numbers))) for name in DEVIATIONS]
    return Measurement(
        MeasuredModes(numbers, modes),
        deviations=MeasuredDeviations(*texts) if known.keys() & set(DEVIATIONS) else None,
    )


def _by_columns(table: FileTable) -> list[TableRow]:
    """Return the rows of a table with one column a mode; one with a row a mode is turned over."""
    names = table.rows[0].fields if table.rows else ()
    named = [heading(name)[0] in QUANTITIES or sensor_of(name) is not None for name in names[1:]]
    if table.first != "mode" and not (table.first == "frequency_hz" and all(named)):
        raise CampaignError(
            f"{table.start}: the first row must be `mode, 1, 2, ...`, or the headings of a table "
            "with a row a mode"
        )
    header, *others = table.rows
    if table.first == "mode" and not any(named):
        return [header, *others]
    short = next((row for row in others if len(row.fields) != len(names)), None)
    if short is not None:
        raise CampaignError(
            f"{short.where}: {len(short.fields)} values under {len(names)} headings"
        )
    turned = [
        TableRow(
            f"{header.where}, column {place + 1}", (name, *(row.fields[place] for row in others))
        )
        for place, name in enumerate(names)
    ]
    if table.first == "mode":
        return turned
    numbers = ("mode", *(str(place + 1) for place in range(len(others))))
    return [TableRow(header.where, numbers), *turned]


def _mode_numbers(row: TableRow, problems: list[str]) -> tuple[int, ...]:
    fields = row.fields[1:]
    numbers = tuple(int(field) for field in fields if _whole(field))
    if len(numbers) != len(fields) or not numbers or len(set(numbers)) != len(numbers):
        problems.append(
            f"{row.where}: mode numbers must be different whole numbers, found "
            f"{', '.join(fields) or 'none'}"
        )
    return numbers


def _numbers(row: TableRow, count: int, problems: list[str]) -> list[float]:
    name, *fields = row.fields
    if len(fields) != count:
        commas = " (decimal commas? then separate the columns by `;`)" * (len(fields) == 2 * count)
        problems.append(f"{row.where}: `{name}` has {len(fields)} values for {count} modes{commas}")
    return row_values(row, problems)


def _wrong(row: TableRow, meaning: str, values: list[float], computed: bool) -> list[str]:
    """Return why the values of a quantity cannot be."""
    if meaning == "frequency_hz":
        wrong = any(value < 0.0 or (value == 0.0 and not computed) for value in values)
        return [f"{row.where}: frequencies must be above zero"] if wrong else []
    if meaning in DEVIATIONS:
        wrong = any(value <= 0.0 for value in values)
        least = f"`{meaning}` must be above zero, found {min(values, default=0.0):g}"
        return [f"{row.where}: {least}"] if wrong else []
    most = max(values, default=0.0)
    per_cent = f"{most:g} times critical damping; where it is per cent, write `damping [%]`"
    return [f"{row.where}: {per_cent}"] if most > 1.0 else []


def sensor_of(name: str) -> tuple[tuple[int, int], float] | None:
    """Return node and component 1..6 of a sensor's name, and its sign.

    Nothing where it is not one.
    """
    found = _SENSOR.fullmatch(name.casefold())
    if found is None:
        return None
    sign = -1.0 if "-" in (found[2], found[4]) else 1.0
    return (int(found[1]), COMPONENTS.index(found[3]) + 1), sign


def _whole(text: str) -> bool:
    return text.isascii() and text.isdecimal() and len(text) < 19  # what 64 bits hold


def write_modes_csv(
    path: Path,
    numbers: Sequence[int],
    modes: ModeSet,
    comment: Sequence[str] = (),
    deviations: MeasuredDeviations | None = None,
    environment: Mapping[str, float] | None = None,
    measured_at: float = float("nan"),
) -> None:
    """Write real modes in the form that `read_modes_csv` reads.

    Raises ModesError for complex shapes, StorageUnavailable.
    """
    if np.iscomplexobj(modes.mode_shapes):
        raise ModesError(f"{path}: complex mode shapes cannot be written as CSV")
    lines = [f"# {line}" for line in comment]
    lines.append(",".join(["mode", *map(str, numbers)]))
    lines.append(_row("frequency_hz", modes.frequencies_hz.tolist()))
    if modes.damping_ratios.size:
        lines.append(_row("damping_ratio", modes.damping_ratios.tolist()))
    if deviations is not None:
        columns = (deviations.frequencies, deviations.shapes)
        lines += [
            _row(name, values.tolist())
            for name, values in zip(DEVIATIONS, columns, strict=True)
            if np.isfinite(values).all()
        ]
    for row in range(modes.n_dof):
        component = COMPONENTS[modes.components[row] - 1]
        lines.append(_row(f"{modes.nodes[row]}.{component}", modes.mode_shapes[row].tolist()))
    if measured_at == measured_at:
        lines.append(f"{TIME},{datetime.fromtimestamp(measured_at, UTC).isoformat()}")
    lines += [_row(f"environment {name}", [value]) for name, value in (environment or {}).items()]
    with writing(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _row(name: str, values: Sequence[float]) -> str:
    return ",".join([name, *(f"{value:.10g}" for value in values)])
