"""Points, directions and drawing of a test, from node tables and coordinate systems.

The text of the format allows two readings of the axes of a coordinate system in dataset 2420: as
the rows of its matrix, or as the columns. Most programs write rows; Test.Lab from revision 15A on
writes columns, which turn vectors of the system into global ones. The wrong reading turns sensors,
and the numbers alone cannot show it. The lines of the drawing can, where sensors lie along them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, TypeGuard

import numpy as np

from modetune.adapters.test_files.file_kind import Axes
from modetune.adapters.test_files.universal.datasets import (
    Content,
    CoordinateSystem,
    CoordinateSystems,
    DatasetPlace,
    Drawing,
    NodeTable,
    Units,
    UniversalFile,
)
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import TestGeometry
from modetune.core.modes import Floats, Integers

#: How far apart two tables may put one node, relative to the structure's size, and for their digits
#: (6 in dataset 15) relative to the farthest coordinate.
SAME, DIGITS = 1e-4, 1e-5


def geometry(files: Sequence[UniversalFile], notes: list[str]) -> TestGeometry | None:
    """Return the points of all files together, or nothing where no file has any.

    Raises CampaignError where two tables contradict each other.
    """
    tables = [
        (file, table)
        for file in files
        for table in sorted(  # 2411 has more digits than 15
            (item for item in file.contents if isinstance(item, NodeTable)),
            key=lambda table: table.place.dataset != "2411",
        )
    ]
    if not tables:
        return None
    points: dict[int, tuple[Floats, Floats, DatasetPlace]] = {}
    size = max(float(np.ptp(table.coordinates, axis=0).max()) for _, table in tables)
    far = max(float(np.abs(table.coordinates).max()) for _, table in tables)
    for file, table in tables:
        systems = _systems([*(other for other in files if other is not file), file])
        _add_points(points, table, systems, max(SAME * size, DIGITS * far), notes)
    nodes = np.array(list(points), dtype=np.int64)
    lines, faces = _drawing(files, nodes, notes)
    frames = np.array([frame for _, frame, _ in points.values()])
    turned = int((np.abs(frames - np.eye(3)).max(axis=(1, 2)) > 1e-9).sum())
    if turned:
        notes.append(
            f"{turned} of {nodes.size} points have local axes: their sensors' directions are "
            "rotated, and the shapes stay as measured"
        )
    return TestGeometry(
        nodes=nodes,
        coordinates=np.array([place for place, _, _ in points.values()]),
        frames=frames,
        lines=lines,
        faces=faces,
        metres=_metres(files),
    )


def _add_points(
    points: dict[int, tuple[Floats, Floats, DatasetPlace]],
    table: NodeTable,
    systems: dict[int, CoordinateSystem],
    tolerance: float,
    notes: list[str],
) -> None:
    _note_missing(table, systems, notes)
    for row, node in enumerate(table.nodes.tolist()):
        place = _to_global(table.coordinates[row], int(table.definition[row]), systems)
        frame = _axes_at(place, int(table.displacement[row]), systems)
        if node not in points:
            points[node] = place, frame, table.place
            continue
        first, first_frame, where = points[node]
        if np.abs(first - place).max() > tolerance or np.abs(first_frame - frame).max() > 1e-4:
            raise CampaignError(
                f"{table.place} gives node {node} another place or other axes than {where}; leave "
                "out one of the two"
            )


def _note_missing(table: NodeTable, systems: dict[int, CoordinateSystem], notes: list[str]) -> None:
    """Name the systems that are used and not given; they are taken for the global one."""
    for kind, used in (("placed in", table.definition), ("measured along", table.displacement)):
        for number in np.unique(used).tolist():
            if number and number not in systems:
                # number 1 is the global Cartesian system where a program writes none
                doubt = "" if number == 1 else "doubtful: "
                count = int((used == number).sum())
                notes.append(
                    f"{doubt}{table.place}: {count} nodes are {kind} coordinate system {number}, "
                    "which no dataset 18 or 2420 gives; the global axes are taken"
                )


def _systems(files: Sequence[UniversalFile]) -> dict[int, CoordinateSystem]:
    """Return all systems by number, in global axes.

    Those of later files come before earlier ones.
    """
    given: dict[int, tuple[CoordinateSystem, DatasetPlace]] = {}
    for file in files:
        for item in file.contents:
            if isinstance(item, CoordinateSystems):
                given.update({system.number: (system, item.place) for system in item.systems})
    found: dict[int, CoordinateSystem] = {}
    for number in given:
        _resolve(number, given, found)
    return found


def _resolve(
    number: int,
    given: dict[int, tuple[CoordinateSystem, DatasetPlace]],
    found: dict[int, CoordinateSystem],
) -> None:
    """Put a system into global axes, those first that it is given in, however many these are."""
    chain: dict[int, None] = {}
    # A missing one is the global one, as elsewhere.
    while number and number in given and number not in found:
        if number in chain:
            place = given[number][1]
            raise CampaignError(f"{place}: coordinate system {number} is given in terms of itself")
        chain[number] = None
        number = given[number][0].reference
    for link in reversed(chain):
        found[link] = _in_global_axes(given[link][0], found)


def _in_global_axes(
    system: CoordinateSystem, found: dict[int, CoordinateSystem]
) -> CoordinateSystem:
    """Return a system in global axes; the one that it is given in, if any, is in `found`."""
    reference = system.reference
    if reference == 0 or reference not in found:
        return system
    base = found[reference]
    # the points that give the axes are coordinates of the reference too, angles where it has them
    origin = _to_global(system.origin, reference, found)
    axes = (
        system.axes @ base.axes
        if base.kind == 0
        else system.axes @ _axes_at(origin, reference, found)
    )
    return CoordinateSystem(system.number, system.kind, 0, origin, axes)


def _to_global(point: Floats, number: int, systems: dict[int, CoordinateSystem]) -> Floats:
    """Return global coordinates of a point given in a system; angles in degrees."""
    if number == 0 or number not in systems:
        return point
    system = systems[number]
    first, second, third = point.tolist()
    if system.kind == 1:  # radius, angle, height
        angle = math.radians(second)
        point = np.array([first * math.cos(angle), first * math.sin(angle), third])
    elif system.kind == 2:  # radius, angle from z, angle about z
        polar, angle = math.radians(second), math.radians(third)
        around = first * math.sin(polar)
        point = np.array(
            [around * math.cos(angle), around * math.sin(angle), first * math.cos(polar)]
        )
    return np.asarray(system.origin + point @ system.axes)


def _axes_at(place: Floats, number: int, systems: dict[int, CoordinateSystem]) -> Floats:
    """Return a system's directions at a global point, (3, 3), rows in global axes."""
    if number == 0 or number not in systems:
        return np.eye(3)
    system = systems[number]
    if system.kind not in (1, 2):
        return system.axes
    local = system.axes @ (place - system.origin)
    angle = math.atan2(local[1], local[0])
    cosine, sine = math.cos(angle), math.sin(angle)
    if system.kind == 1:
        turn = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        return np.asarray(turn @ system.axes)
    polar = math.atan2(math.hypot(local[0], local[1]), local[2])
    up, out = math.cos(polar), math.sin(polar)
    turn = np.array([
        [out * cosine, out * sine, up],
        [up * cosine, up * sine, -out],
        [-sine, cosine, 0.0],
    ])  # fmt: skip
    return np.asarray(turn @ system.axes)


def _drawing(
    files: Sequence[UniversalFile], nodes: Integers, notes: list[str]
) -> tuple[Integers, Integers]:
    """Return lines and triangles whose nodes all have a place, each once."""
    drawings = [item for file in files for item in file.contents if isinstance(item, Drawing)]
    drawn = []
    for width, parts in (
        (2, [drawing.lines for drawing in drawings]),
        (3, [drawing.faces for drawing in drawings]),
    ):
        whole = np.concatenate([np.zeros((0, width), dtype=np.int64), *parts])
        known = np.isin(whole, nodes).all(axis=1)
        if not known.all():
            what = "lines" if width == 2 else "triangles"
            notes.append(f"{int((~known).sum())} {what} run to nodes without a place; left out")
        whole = whole[known]
        first = np.unique(np.sort(whole, axis=1), axis=0, return_index=True)[1]
        drawn.append(whole[np.sort(first)])
    return drawn[0], drawn[1]


def _metres(files: Sequence[UniversalFile]) -> float:
    """Return the length of the unit of the node tables.

    Raises CampaignError where files differ in it.
    """
    found: Units | None = None
    for file in files:
        if not any(isinstance(item, NodeTable) for item in file.contents):
            continue
        for item in file.contents:
            if not isinstance(item, Units):
                continue
            if found is not None and not math.isclose(found.metres, item.metres, rel_tol=1e-5):
                raise CampaignError(
                    f"{item.place} has lengths in {item.metres:g} m, {found.place} in "
                    f"{found.metres:g} m; give the points in one unit"
                )
            found = found or item
    return math.nan if found is None else found.metres


#: Test.Lab as it names itself, with its revision where it gives one: 15A, 2019.1, 18.
TEST_LAB = re.compile(r"test\.?\s?lab\b(?:\D*(\d+))?", re.IGNORECASE)
#: The first revision that writes columns.
COLUMNS_FROM = 15
#: Whose name Test.Lab has had since 2018, after that revision, with or without a number.
SIMCENTER = "simcenter"
#: A direction along a line: cosine of 2 degrees.
ALONG = 0.9994
#: Least number of conclusive nodes, and the share of them that must agree.
FEWEST, MOST = 3, 0.8


def with_axes(file: UniversalFile, axes: Axes) -> UniversalFile:
    """Return the file with the axes of its datasets 2420 from rows or columns.

    A choice that changes something is noted.
    """
    tables = [item for item in file.contents if _is_matrix(item)]
    turned = [system for item in tables for system in item.systems if _asymmetric(system)]
    if not turned:
        return file
    chosen, reason = (axes, "as asked") if axes != "auto" else _found(file)
    place = tables[0].place
    notes = (*file.notes, f"{place}: axes are the {chosen} of the matrices: {reason}")
    if chosen == "rows":
        return replace(file, notes=notes) if reason else file
    contents = []
    for item in file.contents:
        if _is_matrix(item):
            columns = (replace(system, axes=system.axes.T.copy()) for system in item.systems)
            item = replace(item, systems=tuple(columns))
        contents.append(item)
    return replace(file, contents=tuple(contents), notes=notes)


def _is_matrix(item: Content) -> TypeGuard[CoordinateSystems]:
    return isinstance(item, CoordinateSystems) and item.place.dataset == "2420"


def _asymmetric(system: CoordinateSystem) -> bool:
    return bool(np.abs(system.axes - system.axes.T).max() > 1e-6)


def _found(file: UniversalFile) -> tuple[Literal["rows", "columns"], str]:
    """Return rows or columns by the program's name and the drawing, and the reason if any."""
    known = TEST_LAB.search(file.program)
    revision = int(known.group(1) or 0) if known else 0
    if known and not known.group(1) and SIMCENTER in file.program.lower():
        revision = COLUMNS_FROM
    rows, columns, count = _along_lines(file)
    told = count >= FEWEST and max(rows, columns) >= MOST and abs(rows - columns) > 0.5
    lines = f"the lines of the drawing run along them at {max(rows, columns):.0%} of {count} points"
    if known and revision >= COLUMNS_FROM:
        if told and rows > columns:
            return "rows", f"doubtful: {file.program} writes columns, but {lines}"
        return "columns", f"so {known.group()} writes them; `test.axes: rows` if not"
    if told:
        return ("rows", lines) if rows > columns else ("columns", lines)
    return "rows", ""


def _along_lines(file: UniversalFile) -> tuple[float, float, int]:
    """Return shares of points with an axis along a line, by rows and by columns, and a count.

    Of the points whose two readings differ and that a line reaches.
    """
    matrices = [item for item in file.contents if isinstance(item, CoordinateSystems)]
    axes = {
        system.number: system.axes
        for item in matrices
        if _is_matrix(item)
        for system in item.systems
        if _asymmetric(system)
    }
    places: dict[int, Floats] = {}
    own: dict[int, int] = {}
    for item in file.contents:
        if isinstance(item, NodeTable):
            places.update(zip(item.nodes.tolist(), item.coordinates, strict=True))
            own.update(zip(item.nodes.tolist(), item.displacement.tolist(), strict=True))
    ends: dict[int, list[int]] = {}
    for item in file.contents:
        if isinstance(item, Drawing):
            for one, other in item.lines.tolist():
                ends.setdefault(one, []).append(other)
                ends.setdefault(other, []).append(one)
    hits = []
    for node, others in ends.items():
        matrix = axes.get(own.get(node, 0))
        spans = [places[other] - places[node] for other in others if {node, other} <= places.keys()]
        lengths = [float(np.linalg.norm(span)) for span in spans]
        along = [span / length for span, length in zip(spans, lengths, strict=True) if length > 0.0]
        if matrix is not None and along:
            cosines = [np.abs(np.array(along) @ by.T).max() > ALONG for by in (matrix, matrix.T)]
            hits.append(cosines)
    if not hits:
        return 0.0, 0.0, 0
    rows, columns = np.mean(np.array(hits, dtype=np.float64), axis=0).tolist()
    return rows, columns, len(hits)
