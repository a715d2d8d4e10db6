"""Points of a test as CSV, modetune's own documented form.

    # comments and blank lines are skipped
    metres, 0.001                              (optional: the unit of length, here millimetres)
    node, x, y, z, xx, xy, xz, yx, yy, yz, zx, zy, zz
    101,  0.0, 12.5, 3.0                       (motions are measured along the global axes)
    102,  1.0, 12.5, 3.0, 0,1,0, -1,0,0, 0,0,1 (local x, y and z, as unit vectors in global axes)
    line, 101, 102                             (optional: draws the structure)
    face, 101, 102, 103                        (optional: a triangle)

The nine columns of directions may be left out of the header, and of any row.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from modetune.adapters.regular_file import read_regular
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import TestGeometry
from modetune.core.storage.files import writing

HEADER = ("node", "x", "y", "z")
DIRECTIONS = ("xx", "xy", "xz", "yx", "yy", "yz", "zx", "zy", "zz")
#: How far printed directions may be from right angles and unit length.
_RIGHT = 1e-3

Row = tuple[int, list[str]]


def is_geometry_csv(path: Path) -> bool:
    """Whether a CSV file holds points rather than modes, by its first row."""
    try:
        rows = _rows(path)
    except CampaignError:
        return False
    return bool(rows) and rows[0][1][0] in ("node", "metres")


def read_geometry_csv(path: Path) -> TestGeometry:
    """Read points. Raises CampaignError with every problem, each with file and line."""
    rows = _rows(path)
    problems: list[str] = []
    metres = _metres(path, rows.pop(0), problems) if _is_metres(rows) else math.nan
    header = tuple(rows[0][1]) if rows else ()
    if header not in (HEADER, HEADER + DIRECTIONS):
        line = rows[0][0] if rows else 1
        raise CampaignError(
            f"{path}, line {line}: the header must be `{','.join(HEADER)}`, or go on with "
            f"`{','.join(DIRECTIONS)}`"
        )
    points: dict[int, tuple[int, list[float]]] = {}
    drawn: dict[str, list[tuple[int, list[int]]]] = {"line": [], "face": []}
    for line, fields in rows[1:]:
        if fields[0] in drawn:
            count = 2 if fields[0] == "line" else 3
            ends = _numbers(path, line, fields[1:], count, problems)
            drawn[fields[0]].append((line, [int(node) for node in ends]))
        else:
            _add_point(path, line, fields, points, problems)
    for line, nodes in drawn["line"] + drawn["face"]:
        missing = [node for node in nodes if node not in points]
        if missing:
            problems.append(f"{path}, line {line}: node {missing[0]} has no row")
    if not points and not problems:
        problems.append(f"{path}, line {rows[0][0]}: no point follows the header")
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


def _is_metres(rows: list[Row]) -> bool:
    return bool(rows) and rows[0][1][0] == "metres"


def _metres(path: Path, row: Row, problems: list[str]) -> float:
    line, fields = row
    metres = (_numbers(path, line, fields[1:], 1, problems) or [math.nan])[0]
    if not metres > 0.0:
        problems.append(f"{path}, line {line}: metres must be above zero")
    return metres


def _add_point(
    path: Path,
    line: int,
    fields: list[str],
    points: dict[int, tuple[int, list[float]]],
    problems: list[str],
) -> None:
    name, values = fields[0], fields[1:]
    if not (name.isascii() and name.isdecimal() and len(name) < 19):  # what 64 bits hold
        problems.append(f"{path}, line {line}: `{name}` is neither a node number, line nor face")
        return
    numbers = _numbers(path, line, values, 12 if len(values) > 3 else 3, problems)
    if not numbers:
        return
    if int(name) in points:
        first = points[int(name)][0]
        problems.append(f"{path}, line {line}: node {name} stands on line {first} already")
    frame = np.array(numbers[3:] or np.eye(3).ravel()).reshape(3, 3)
    if np.abs(frame).max() > 2.0 or np.abs(frame @ frame.T - np.eye(3)).max() > _RIGHT:
        problems.append(
            f"{path}, line {line}: the directions of node {name} are not unit vectors at right "
            "angles"
        )
    points[int(name)] = line, [*numbers[:3], *frame.ravel().tolist()]


def _numbers(
    path: Path, line: int, fields: list[str], count: int, problems: list[str]
) -> list[float]:
    """The numbers of a row; none where one is missing or is not a number."""
    if len(fields) != count:
        problems.append(f"{path}, line {line}: {len(fields)} numbers where {count} must be")
        return []
    values = []
    for field in fields:
        try:
            value = float(field)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            problems.append(f"{path}, line {line}: {field!r} where a number must be")
            return []
        values.append(value)
    return values


def _rows(path: Path) -> list[Row]:
    try:
        text = read_regular(path).decode("utf-8-sig")
    except OSError as error:
        raise CampaignError(f"test file {path} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise CampaignError(f"test file {path} is not a text file: {error}") from error
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip(" \t,;") or line.lstrip().startswith("#"):
            continue
        try:
            fields = [field.strip() for field in next(csv.reader([line]))]
        except csv.Error as error:
            raise CampaignError(f"{path}, line {number}: {error}") from error
        while len(fields) > 1 and not fields[-1]:  # what spreadsheets add to shorter rows
            fields.pop()
        rows.append((number, fields))
    return rows


def _table(rows: list[list[int]], width: int) -> np.ndarray[tuple[int, int], np.dtype[np.int64]]:
    return np.array(rows, dtype=np.int64).reshape(-1, width)
