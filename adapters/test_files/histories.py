"""Time histories as a table in a text or a workbook, and the units of their channels.

A table has the time in its first column and a channel in each other column. The heading of a
channel gives its node and direction, and its unit, which distinguishes forces from motions:

    time [s], 1.z [N], 1.z [m/s^2], 2.z [m/s^2], 3.-x [g]
"""

from __future__ import annotations

import re

import numpy as np

from modetune.adapters.test_files.modes_csv import sensor_of
from modetune.adapters.test_files.tables import FileTable, number, row_values
from modetune.core.errors import CampaignError
from modetune.core.measurement.response_functions import Response
from modetune.core.measurement.time_histories import TimeHistories
from modetune.core.modes import Floats

TIME = re.compile(r"(time|t|zeit)(_s|\s*[\[(]\s*s\s*[\])])?", re.IGNORECASE)
CHANNEL = re.compile(r"(?:force\s+)?(\S+)\s*[\[(]\s*([^\])]+?)\s*[\])]", re.IGNORECASE)
#: Standard gravity, m/s^2 (exact by definition).
GRAVITY = 9.80665
METRES = {
    "m": 1.0,
    "nm": 1e-9,
    "cm": 1e-2,
    "mm": 1e-3,
    "um": 1e-6,
    "in": 0.0254,
    "inch": 0.0254,
    "ft": 0.3048,
}
NEWTONS = {
    "n": 1.0, "kn": 1e3, "lbf": 4.4482216152605, "lb": 4.4482216152605, "lbs": 4.4482216152605,
    "kgf": GRAVITY,
}  # fmt: skip
_MOTION = re.compile(r"(nm|um|mm|cm|m|inch|in|ft)(?:/s(?:ec)?((?:\^|\*\*)?2|/s)?)?")
KINDS: tuple[Response, ...] = ("receptance", "mobility", "accelerance")
#: Deviation of a time from the even grid, as a share of a step: printed times are rounded.
UNEVEN = 0.01

#: Node, component, sign, factor to SI, order of its time derivative (-1: a force), values, times,
#: place in its file.
Channel = tuple[int, int, float, float, int, Floats, Floats, str]


def is_history(table: FileTable) -> bool:
    """Return whether a table has times in its first column."""
    return bool(table.rows) and TIME.fullmatch(table.rows[0].fields[0]) is not None


def history_of(table: FileTable) -> TimeHistories:
    """Return the recording of a table. Raises CampaignError with file and line."""
    head, *rows = table.rows
    problems: list[str] = []
    columns: list[tuple[int, int, float, float, int]] = []
    for place, name in enumerate(head.fields[1:], start=2):
        match = CHANNEL.fullmatch(name)
        sensor = sensor_of(match[1]) if match else None
        unit = channel_unit(match[2]) if match else None
        if sensor is None or unit is None:
            problems.append(
                f"{head.where}, column {place}: {name!r} is not a channel with its unit, such as "
                "12.z [m/s^2] or 1.z [N]: the number of a point, a direction and a unit"
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
    return recording(
        [
            (*column, values[:, place], values[:, 0], head.where)
            for place, column in enumerate(columns, start=1)
        ]
    )


def motion_label(label: str) -> tuple[float, int] | None:
    """Return the SI value of a unit of motion, and the order of its time derivative."""
    text = label.strip().lower().strip("()[] ")
    if text in ("g", "gn", "gs", "g's"):
        return GRAVITY, 2
    found = _MOTION.fullmatch(text.replace(" ", ""))
    if found is None:
        return None
    return METRES[found[1]], 2 if found[2] else int("/" in text)


def channel_unit(label: str) -> tuple[float, int] | None:
    """Return the SI value of a unit, and the order of its time derivative, -1 for a force."""
    force = NEWTONS.get(label.strip().casefold())
    return (force, -1) if force is not None else motion_label(label)


def recording(channels: list[Channel]) -> TimeHistories:
    """Join channels. Raises CampaignError where times or quantities differ, or one is twice."""
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
