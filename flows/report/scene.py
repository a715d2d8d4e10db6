"""Mode shapes of test and model in 3D, as arrays for `shapes.js`.

The model is shown by its surface or, if the record has none, by the points of the sensors. The test
is one point per test node; it moves only in the measured directions. Any test mode can be shown
with any computed mode, whose motion is that of the surface if known, otherwise that of the points.
The maximum of each motion is one; the browser scales the test by the modal scale factor.
"""

from __future__ import annotations

import base64
from dataclasses import dataclass

import numpy as np

from modetune.core.modes import Floats, Integers, ModeSet, common_dofs
from modetune.core.storage.campaign_record import CampaignRecord, IterationRecord
from modetune.core.storage.keys import Json, number_or_null
from modetune.core.surface import Surface, display_surface
from modetune.flows.report.comparison import mac_table
from modetune.flows.report.mode_tables import mode_label

#: Maximum size of the shapes in a page, in base64; a larger surface is coarsened.
SHAPE_BYTES = 1_300_000
#: Bytes of a node (position, two triangles, one and a half edges), and of each of its motions.
NODE_BYTES, MOTION_BYTES = 4 / 3 * (12 + 24 + 12), 4 / 3 * 6
#: Maximum number of nodes that a browser without a graphics card animates smoothly.
AT_MOST = 12_000
#: Motions are stored as integers up to this one, which is precise enough for the eye.
STEPS = 32767


@dataclass(frozen=True, slots=True)
class ShownMode:
    """A mode of test or model with its motion.

    points is (n_points, 3) at the scene's points; surface (n, 3) at its nodes, empty if unknown.
    """

    label: str
    frequency_hz: float
    points: Floats
    surface: Floats


@dataclass(frozen=True, slots=True)
class ShownState:
    """The model's elastic modes in one state.

    pairs (n_pairs, 2) has the positions of test modes and of their partners in `modes`; mac is
    (n_modes, n_test_modes), empty without measured shapes.
    """

    modes: tuple[ShownMode, ...]
    pairs: Integers
    mac: Floats


@dataclass(frozen=True, slots=True)
class Scene:
    """What is drawn and how it moves.

    coordinates: (n, 3); triangles: (n_triangles, 3) and edges: (n_edges, 2), rows of them.
    nodes: (n_points,), test nodes; points: (n_points, 3), where they are; lines: (n_lines, 2),
    rows of the points. tests: the measured modes; states: of the model, by name.
    """

    coordinates: Floats
    triangles: Integers
    edges: Integers
    nodes: Integers
    points: Floats
    lines: Integers
    tests: tuple[ShownMode, ...]
    states: dict[str, ShownState]

    @property
    def length(self) -> float:
        """Of the box round everything, along its diagonal."""
        every = np.concatenate([self.coordinates, self.points])
        return float(np.linalg.norm(np.ptp(every, axis=0))) or 1.0


@dataclass(frozen=True, slots=True)
class _Sensors:
    """Rows of the test's shapes that are drawn, (n,), the point each moves, and which way."""

    rows: Integers
    owners: Integers
    directions: Floats
    nodes: Integers
    points: Floats


def scene(record: CampaignRecord) -> Scene | None:
    """The scene of a campaign; None where neither model nor sensors have a place in space."""
    first, last = record.iterations[0], record.best
    motions = first.pairing.measured.size * 2
    surface = _thin(record.surface, int(SHAPE_BYTES / (NODE_BYTES + motions * MOTION_BYTES)))
    sensors = _sensors(record)
    if surface is not None and not (first.field.n_dof and last.field.n_dof):
        surface = None
    if surface is None and sensors is None:
        return None
    before = _state(record, first, surface, sensors)
    after = _state(record, last, surface, sensors)
    if sensors is None:
        after = _in_phase(after, before)
    points = sensors.points if sensors else np.zeros((0, 3))
    lines = _lines(record, sensors)
    return Scene(
        coordinates=surface.coordinates if surface else points,
        triangles=surface.triangles if surface else np.zeros((0, 3), dtype=np.int64),
        edges=surface.edges if surface else lines,
        nodes=sensors.nodes if sensors else np.zeros(0, dtype=np.int64),
        points=points,
        lines=lines,
        tests=_tests(record, sensors),
        states={"before": before, "after": after},
    )


def _thin(surface: Surface | None, at_most: int) -> Surface | None:
    at_most = min(at_most, AT_MOST)
    if surface is None or surface.nodes.size <= at_most:
        return surface
    return display_surface(surface.mesh(), at_most)


def _sensors(record: CampaignRecord) -> _Sensors | None:
    """The translations that were measured at places that are known."""
    modes = record.test.modes
    rows_m, _ = common_dofs(modes, record.best.computed)
    rows = rows_m[modes.components[rows_m] <= 3]
    found = [_place(record, row) for row in rows.tolist()]
    known = [place for place, item in enumerate(found) if item is not None]
    if not known:
        return None
    rows = rows[known]
    places = np.array([found[place] for place in known])
    nodes, firsts, owners = np.unique(modes.nodes[rows], return_index=True, return_inverse=True)
    return _Sensors(rows, owners.reshape(-1), places[:, 1], nodes, places[firsts, 0])


def _place(record: CampaignRecord, row: int) -> tuple[Floats, Floats] | None:
    """Place and direction, (3,) each, of a row of the test's shapes, or None."""
    node = int(record.test.modes.nodes[row])
    component = int(record.test.modes.components[row])
    sensors, along = record.sensors, np.eye(3)[component - 1]
    on_model = node
    if sensors is not None:
        at = np.flatnonzero((sensors.nodes == node) & (sensors.components == component))
        if at.size == 0:
            return None
        if record.places is not None:
            return record.places.coordinates[at[0]], record.places.directions[at[0]]
        on_model, along = int(sensors.model_nodes[at[0]]), sensors.directions[at[0]]
    surface, geometry = record.surface, record.geometry
    if surface is not None:
        at = np.flatnonzero(surface.nodes == on_model)
        return (surface.coordinates[at[0]], along) if at.size else None
    if geometry is not None:
        at = np.flatnonzero(geometry.nodes == node)
        if at.size:
            return geometry.coordinates[at[0]], geometry.frames[at[0], component - 1]
    return None


def _lines(record: CampaignRecord, sensors: _Sensors | None) -> Integers:
    """The test's lines between points that are drawn, as rows of these."""
    empty = np.zeros((0, 2), dtype=np.int64)
    if sensors is None or record.geometry is None:
        return empty
    rows = {node: row for row, node in enumerate(sensors.nodes.tolist())}
    found = [
        (rows[one], rows[other])
        for one, other in record.geometry.lines.tolist()
        if one in rows and other in rows
    ]
    return np.array(found, dtype=np.int64) if found else empty


def _tests(record: CampaignRecord, sensors: _Sensors | None) -> tuple[ShownMode, ...]:
    modes, none = record.test.modes, np.zeros((0, 3))
    return tuple(
        ShownMode(
            mode_label(record, place),
            float(hz),
            none if sensors is None else _unit(_moved(sensors, modes, sensors.rows, place)),
            none,
        )
        for place, hz in enumerate(modes.frequencies_hz)
    )


def _state(
    record: CampaignRecord, item: IterationRecord, surface: Surface | None, sensors: _Sensors | None
) -> ShownState:
    """The computed modes of an iteration, as many as the table of MAC has."""
    mac = mac_table(record, item) if record.test.has_shapes else np.zeros((0, 0))
    pairs = np.stack([item.pairing.measured, item.pairing.computed], axis=1)
    count = mac.shape[0] or 1 + int(pairs[:, 1].max())
    rows = np.zeros(0, dtype=np.int64)
    if sensors is not None:
        rows_m, rows_c = common_dofs(record.test.modes, item.computed)
        rows = rows_c[np.searchsorted(rows_m, sensors.rows)]
    of = {int(computed): pair for pair, computed in enumerate(pairs[:, 1])}
    modes = []
    for place in range(count):
        points = field = np.zeros((0, 3))
        if sensors is not None:
            points = _moved(sensors, item.computed, rows, place)
        if surface is not None and place in of:
            field = _field(item.field, surface, of[place])
        elif surface is None:
            field = points
        largest = max(_largest(points), _largest(field)) or 1.0
        hz = float(item.computed.frequencies_hz[place])
        modes.append(ShownMode(str(place + 1), hz, points / largest, field / largest))
    return ShownState(tuple(modes), pairs, mac)


def _in_phase(after: ShownState, before: ShownState) -> ShownState:
    """Modes turned by half a period where they would start against their motion before.

    Where shapes were measured both follow the test.
    """
    then = dict(before.pairs.tolist())
    modes = list(after.modes)
    for test, place in after.pairs.tolist():
        mode = modes[place]
        if float(np.sum(mode.surface * before.modes[then[test]].surface)) < 0.0:
            modes[place] = ShownMode(mode.label, mode.frequency_hz, mode.points, -mode.surface)
    return ShownState(tuple(modes), after.pairs, after.mac)


def _largest(motion: Floats) -> float:
    return float(np.linalg.norm(motion, axis=1).max(initial=0.0))


def _unit(motion: Floats) -> Floats:
    return motion / (_largest(motion) or 1.0)


def _moved(sensors: _Sensors, modes: ModeSet, rows: Integers, mode: int) -> Floats:
    """Motion of the points, (n_points, 3), from what a mode has at each sensor's row."""
    moved = np.zeros((sensors.nodes.size, 3))
    values = np.real(modes.mode_shapes[rows, mode])
    np.add.at(moved, sensors.owners, values[:, None] * sensors.directions)
    return moved


def _field(field: ModeSet, surface: Surface, pair: int) -> Floats:
    """Displacements (n, 3) of one mode at the surface's nodes; what is not known is zero."""
    found = np.zeros((surface.nodes.size, 3))
    rows = np.searchsorted(surface.nodes, field.nodes)
    inside = np.minimum(rows, surface.nodes.size - 1)
    good = (surface.nodes[inside] == field.nodes) & (field.components <= 3)
    found[inside[good], field.components[good] - 1] = np.real(field.mode_shapes[good, pair])
    return found


def scene_json(shown: Scene) -> dict[str, Json]:
    """What `shapes.js` draws: arrays as base64 of little-endian numbers, row after row."""
    return {
        "length": shown.length,
        "coordinates": packed(shown.coordinates, "<f4"),
        "triangles": packed(shown.triangles, "<u4"),
        "edges": packed(shown.edges, "<u4"),
        "nodes": shown.nodes.tolist(),
        "points": packed(shown.points, "<f4"),
        "lines": packed(shown.lines, "<u4"),
        "tests": [_mode_json(mode) for mode in shown.tests],
        "states": [
            {
                "name": name,
                "models": [_mode_json(mode) for mode in state.modes],
                "pairs": state.pairs.tolist(),
                "mac": [[number_or_null(value) for value in row] for row in state.mac.tolist()],
            }
            for name, state in shown.states.items()
        ],
    }


def _mode_json(mode: ShownMode) -> dict[str, Json]:
    return {
        "label": mode.label,
        "hz": mode.frequency_hz,
        "points": packed(np.rint(STEPS * mode.points), "<i2"),
        "surface": packed(np.rint(STEPS * mode.surface), "<i2"),
    }


def packed(values: Floats | Integers, kind: str) -> str:
    """Numbers as `modetune.unpack` takes them; kind: of numpy, little-endian."""
    return base64.b64encode(np.ascontiguousarray(values).astype(kind).tobytes()).decode()
