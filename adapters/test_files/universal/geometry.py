"""Points, directions and drawing of a test from its node tables and coordinate systems."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from modetune.adapters.test_files.universal.contents import (
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
    """The points of all files together, or nothing where no file has any.

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
            f"{turned} of {nodes.size} points have axes of their own: their sensors' directions "
            "are turned, the shapes stay as measured"
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
    """All systems by number, in global axes; those of later files come before earlier ones."""
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
    """A system in global axes; the one that it is given in, if any, is in `found`."""
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
    """Global coordinates of a point given in a system; angles in degrees."""
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
    """A system's directions at a global point, (3, 3), rows in global axes."""
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
    """Lines and triangles whose nodes all have a place, each once."""
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
    """Length of the unit of the node tables. Raises CampaignError where files differ in it."""
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
