"""Time histories of universal files (dataset 58) and of tables as text or in workbooks.

A table has the time in its first column and a channel in each other one, headed by where and which
way it measures, and by its unit, which tells forces from motions:

    time [s], 1.z [N], 1.z [m/s^2], 2.z [m/s^2], 3.-x [g]

In universal files a channel that comes again begins a new recording.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from modetune.adapters.test_files.kinds import kind_of
from modetune.adapters.test_files.modes_csv import sensor_of
from modetune.adapters.test_files.tables import FileTable, number, read_tables, row_values
from modetune.adapters.test_files.universal.contents import Function
from modetune.adapters.test_files.universal.file import read_file
from modetune.adapters.test_files.universal.units import NEWTONS, motion_label
from modetune.core.errors import CampaignError
from modetune.core.measurement.frf import Response
from modetune.core.measurement.time_histories import TimeHistories
from modetune.core.modes import Floats

TIME = re.compile(r"(time|t|zeit)(_s|\s*[\[(]\s*s\s*[\])])?", re.IGNORECASE)
CHANNEL = re.compile(r"(?:force\s+)?(\S+)\s*[\[(]\s*([^\])]+?)\s*[\])]", re.IGNORECASE)
KINDS: tuple[Response, ...] = ("receptance", "mobility", "accelerance")
TIME_RESPONSE, FORCES = 1, (9, 13)
#: Quantities of dataset 58 by how often they are divided by time.
MOTIONS = {8: 0, 11: 1, 12: 2}
#: Samples may be this part of a step off their times, as printed ones are.
UNEVEN = 0.01

#: node, component, sign, factor to SI, times divided by time (-1 for a force), values, times, where
Channel = tuple[int, int, float, float, int, Floats, Floats, str]


def read_histories(paths: Sequence[Path]) -> tuple[list[TimeHistories], list[str]]:
    """The recordings of files and notes on them; none where files hold other things.

    Raises CampaignError with file and line.
    """
    found: list[TimeHistories] = []
    notes: list[str] = []
    for path in paths:
        form = kind_of(path).form
        if form == "universal":
            found += _of_universal(path, notes)
        elif form in ("table", "workbook"):
            tables = [item for item in read_tables(path) if item.rows]
            found += [
                _recording(_of_table(item))
                for item in tables
                if TIME.fullmatch(item.rows[0].fields[0])
            ]
    return found, notes


def _of_table(table: FileTable) -> list[Channel]:
    head, *rows = table.rows
    problems: list[str] = []
    columns: list[tuple[int, int, float, float, int]] = []
    for place, name in enumerate(head.fields[1:], start=2):
        match = CHANNEL.fullmatch(name)
        sensor = sensor_of(match[1]) if match else None
        unit = _unit(match[2]) if match else None
        if sensor is None or unit is None:
            problems.append(
                f"{head.where}, column {place}: {name!r} is not a channel with its unit, such as "
                "12.z [m/s^2] or 1.z [N]"
            )
        else:
            columns.append((*sensor[0], sensor[1], *unit))
    values = np.full((len(rows), len(head.fields)), np.nan)
    for place, row in enumerate(rows):
        if len(row.fields) != len(head.fields):
            problems.append(
                f"{row.where}: {len(row.fields)} values under {len(head.fields)} headings"
            )
            break
        values[place] = [number(row.fields[0]), *row_values(row, problems)]
        if np.isnan(values[place, 0]):
            problems.append(f"{row.where}: {row.fields[0]!r} where a number must be")
        if problems:
            break
    if problems:
        raise CampaignError(problems)
    return [
        (*column, values[:, place], values[:, 0], head.where)
        for place, column in enumerate(columns, start=1)
    ]


def _of_universal(path: Path, notes: list[str]) -> list[TimeHistories]:
    functions = [
        item
        for item in read_file(path).contents
        if isinstance(item, Function) and item.kind == TIME_RESPONSE
    ]
    runs: list[list[Channel]] = []
    seen: set[tuple[int, ...]] = set()
    unknown = 0
    for item in functions:
        unit = _unit(item.unit)
        quantity = -1 if item.numerator in FORCES else MOTIONS.get(item.numerator)
        if (
            item.node < 1
            or not 1 <= abs(item.direction) <= 6
            or (unit is None and quantity is None)
        ):
            notes.append(
                f"{item.place}: a time history without node, direction or unit; passed over"
            )
            continue
        unknown += unit is None
        factor, order = unit or (1.0, quantity or 0)
        name = item.node, abs(item.direction), order < 0
        if not runs or name in seen:
            runs.append([])
            seen.clear()
        seen.add(name)
        sign = float(np.sign(item.direction))
        values = np.asarray(item.values.real, dtype=np.float64)
        runs[-1].append(
            (item.node, abs(item.direction), sign, factor, order, values, item.abscissae,
             str(item.place))
        )  # fmt: skip
    if unknown:
        notes.append(
            f"doubtful: {path}: {unknown} time histories are taken as SI: their labels tell no unit"
        )
    return [_recording(run) for run in runs]


def _unit(label: str) -> tuple[float, int] | None:
    """SI value of a unit and how often it is divided by time, -1 for a force."""
    force = NEWTONS.get(label.strip().casefold())
    return (force, -1) if force is not None else motion_label(label)


def _recording(channels: list[Channel]) -> TimeHistories:
    """Channels as one. Raises CampaignError where they do not go together."""
    where = channels[0][7] if channels else "a table of times"
    orders = {channel[4] for channel in channels} - {-1}
    times = channels[0][6] if channels else np.zeros(0)
    steps = np.diff(times)
    step = float(steps.mean()) if steps.size else 0.0
    if len(orders) != 1:
        raise CampaignError(
            f"{where}: responses must be of one quantity (displacement, velocity or acceleration)"
        )
    if steps.size < 16 or not step > 0.0 or np.abs(steps - step).max() > UNEVEN * step:
        raise CampaignError(
            f"{where}: its {times.size} times are not evenly spaced, ascending and at least 17"
        )
    for channel in channels:
        if channel[6].size != times.size or abs(channel[6][-1] - times[-1]) > step:
            raise CampaignError(f"{channel[7]}: other times than {where}")
    names = [(channel[0], channel[1], channel[4] < 0) for channel in channels]
    if len(set(names)) < len(names):
        raise CampaignError(f"{where}: a channel is there twice")
    return TimeHistories(
        step_s=step,
        values=np.column_stack([channel[3] * channel[5] for channel in channels]),
        nodes=np.array([channel[0] for channel in channels], dtype=np.int64),
        components=np.array([channel[1] for channel in channels], dtype=np.int64),
        signs=np.array([channel[2] for channel in channels]),
        forces=np.array([channel[4] < 0 for channel in channels]),
        kind=KINDS[orders.pop()],
        where=where,
    )
