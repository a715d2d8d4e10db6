"""Whether the axes of a coordinate system are the rows or the columns of its dataset 2420.

The format's text can be read either way. Most programs write rows; Test.Lab from revision 15A on
writes columns (it turns vectors of the system into global ones). A wrong reading turns sensors the
other way round, which the numbers alone cannot tell; the lines of the drawing can, where sensors
sit along them.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Literal, TypeGuard

import numpy as np

from modetune.adapters.test_files.universal.contents import (
    Content,
    CoordinateSystem,
    CoordinateSystems,
    Drawing,
    NodeTable,
    UniversalFile,
)
from modetune.core.modes import Floats

Axes = Literal["rows", "columns", "auto"]

#: Test.Lab as it names itself, with its revision where it gives one: 15A, 2019.1, 18.
TEST_LAB = re.compile(r"test\.?\s?lab\b(?:\D*(\d+))?", re.IGNORECASE)
#: The first revision that writes columns.
COLUMNS_FROM = 15
#: Whose name Test.Lab has had since 2018, after that revision, with or without a number.
SIMCENTER = "simcenter"
#: A direction along a line: cosine of 2 degrees.
ALONG = 0.9994
#: Nodes that must tell, and the share of them that must agree.
FEWEST, MOST = 3, 0.8


def with_axes(file: UniversalFile, axes: Axes) -> UniversalFile:
    """The file with the axes of its datasets 2420 taken from rows or columns, as asked or found.

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
    contents = tuple(_transposed(item) if _is_matrix(item) else item for item in file.contents)
    return replace(file, contents=contents, notes=notes)


def _is_matrix(item: Content) -> TypeGuard[CoordinateSystems]:
    return isinstance(item, CoordinateSystems) and item.place.dataset == "2420"


def _asymmetric(system: CoordinateSystem) -> bool:
    return bool(np.abs(system.axes - system.axes.T).max() > 1e-6)


def _transposed(item: CoordinateSystems) -> CoordinateSystems:
    systems = tuple(replace(system, axes=system.axes.T.copy()) for system in item.systems)
    return replace(item, systems=systems)


def _found(file: UniversalFile) -> tuple[Literal["rows", "columns"], str]:
    """What the program's name and the drawing say; rows, and no reason, where neither does."""
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
    """Shares of points with an axis along a line there, by rows and by columns, and their number.

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
