"""Points of a test as a table, in CSV or a sheet of a workbook, modetune's own documented form.

    # comments and blank lines are skipped
    metres, 0.001                              (optional: the unit of length, here millimetres)
    node, x, y, z, xx, xy, xz, yx, yy, yz, zx, zy, zz
    101,  0.0, 12.5, 3.0                       (motions are measured along the global axes)
    102,  1.0, 12.5, 3.0, 0,1,0, -1,0,0, 0,0,1 (local x, y and z, as unit vectors in global axes)
    line, 101, 102                             (optional: draws the structure)
    face, 101, 102, 103                        (optional: a triangle)

The nine columns of directions may be left out of the header, and of any row. Headings may have
the unit of length, x [mm], in place of the row `metres`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from modetune.adapters.test_files.modes_csv import POINT
from modetune.adapters.test_files.tables import (
    FileTable,
    TableRow,
    factor,
    heading,
    read_tables,
    row_values,
)
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import TestGeometry
from modetune.core.storage.files import writing

HEADER = ("node", "x", "y", "z")
DIRECTIONS = ("xx", "xy", "xz", "yx", "yy", "yz", "zx", "zy", "zz")
#: How far printed directions may be from right angles and unit length.
_RIGHT = 1e-3


def is_geometry(table: FileTable) -> bool:
    """Return whether a table holds points rather than modes, by its first row."""
    return table.first in ("node", "metres")


def read_geometry_csv(path: Path) -> TestGeometry:
    """Read points. Raises CampaignError with every problem, each with file and line."""
    return geometry_of(read_tables(path)[0])


def geometry_of(table: FileTable) -> TestGeometry:
    """Return the points of a table. Raises CampaignError likewise."""
    problems: list[str] = []
    rows = list(table.rows)
    metres = _metres(rows.pop(0), problems) if table.first == "metres" else math.nan
    where = rows[0].where if rows else table.start
    found = [heading(field) for field in rows[0].fields] if rows else []
    if tuple(name for name, _ in found) not in (HEADER, HEADER + DIRECTIONS):
        raise CampaignError(
            f"{where}: the header must be `{','.join(HEADER)}`, or continue with "
            f"`{','.join(DIRECTIONS)}`"
        )
    metres = _unit(where, [unit for _, unit in found[1:4]], metres, problems)
    points: dict[int, tuple[str, list[float]]] = {}
    drawn: dict[str, list[tuple[str, list[int]]]] = {"line": [], "face": []}
    for row in rows[1:]:
        kind = row.fields[0].casefold()
        if kind in drawn:
            count = 2 if kind == "line" else 3
            ends = _numbers(row, count, problems)
            drawn[kind].append((row.where, [int(node) for node in ends]))
        else:
            _add_point(row, points, problems)
    for place, nodes in drawn["line"] + drawn["face"]:
        missing = [node for node in nodes if node not in points]
        if missing:
            problems.append(f"{place}: node {missing[0]} has no row")
    if not points and not problems:
        problems.append(f"{where}: no point follows the header")
    if problems:
        raise CampaignError(problems)
    values = np.array([value for _, value in points.values()])
    return TestGeometry(
        nodes=np.array(list(points), dtype=np.int64),
        coordinates=values[:, :3],
        frames=values[:, 3:].reshape(-1, 3, 3),
        lines=_table([nodes for _, nodes in drawn["line"]], 2),
        faces=_table([nodes for _, nodes in drawn["face"]], 3),
        metres=metres,
    )


def write_geometry_csv(path: Path, geometry: TestGeometry, comment: Sequence[str] = ()) -> None:
    """Write points, exactly, as `read_geometry_csv` reads them. Raises StorageUnavailable."""
    lines = [f"# {line}" for line in comment]
    if not math.isnan(geometry.metres):
        lines.append(f"metres,{geometry.metres!r}")
    turned = (geometry.frames != np.eye(3)).any()
    lines.append(",".join(HEADER + DIRECTIONS if turned else HEADER))
    for node, place, frame in zip(
        geometry.nodes.tolist(), geometry.coordinates, geometry.frames, strict=True
    ):
        numbers = [*place.tolist(), *(frame.ravel().tolist() if turned else ())]
        lines.append(",".join([str(node), *map(repr, numbers)]))
    for name, table in (("line", geometry.lines), ("face", geometry.faces)):
        lines += [",".join([name, *map(str, nodes)]) for nodes in table.tolist()]
    with writing(path) as part:
        part.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _metres(row: TableRow, problems: list[str]) -> float:
    metres = (_numbers(row, 1, problems) or [math.nan])[0]
    if not metres > 0.0:
        problems.append(f"{row.where}: metres must be above zero")
    return metres


def _unit(where: str, units: list[str], metres: float, problems: list[str]) -> float:
    """Return the length of the coordinates' unit; headings with a unit determine it."""
    if len(set(units)) > 1:
        problems.append(f"{where}: the coordinates have different units: {', '.join(units)}")
    told = factor(where, "x", units[0], problems) if units[0] else metres
    if not math.isnan(metres) and not math.isnan(told) and not math.isclose(told, metres):
        problems.append(f"{where}: the unit {units[0]} contradicts `metres, {metres:g}` above it")
    return told


def _add_point(
    row: TableRow, points: dict[int, tuple[str, list[float]]], problems: list[str]
) -> None:
    name, *values = row.fields
    number = re.fullmatch(POINT, name, re.ASCII | re.IGNORECASE)
    if number is None:
        problems.append(
            f"{row.where}: `{name}` is neither a node number, line nor face; give each point a "
            "number, the same as in the table of modes or histories"
        )
        return
    node = int(number.group(1))
    numbers = _numbers(row, 12 if len(values) > 3 else 3, problems)
    if not numbers:
        return
    if node in points:
        problems.append(f"{row.where}: node {node} is in {points[node][0]} already")
    frame = np.array(numbers[3:] or np.eye(3).ravel()).reshape(3, 3)
    if np.abs(frame).max() > 2.0 or np.abs(frame @ frame.T - np.eye(3)).max() > _RIGHT:
        problems.append(
            f"{row.where}: the directions of node {node} are not unit vectors at right angles"
        )
    points[node] = row.where, [*numbers[:3], *frame.ravel().tolist()]


def _numbers(row: TableRow, count: int, problems: list[str]) -> list[float]:
    """Return the numbers of a row behind its name; none where one is missing or is not a number."""
    if len(row.fields) != count + 1:
        problems.append(f"{row.where}: {len(row.fields) - 1} numbers where {count} must be")
        return []
    values = row_values(row, problems)
    return [] if any(map(math.isnan, values)) else values


def _table(rows: list[list[int]], width: int) -> np.ndarray[tuple[int, int], np.dtype[np.int64]]:
    return np.array(rows, dtype=np.int64).reshape(-1, width)
