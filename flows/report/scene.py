"""Mode shapes of test and model laid over each other in space, as arrays for an animation.

The model is its surface, or where the record has none, the points that the sensors look at. The
test is a point a test node, moved along the directions in which it was measured; directions that
were not measured stand still. Both move in the same phase. The test's shape has the modal scale
of the model's (the factor in which it is nearest), and the largest motion of the model is one.
"""

from __future__ import annotations

import base64
from dataclasses import dataclass

import numpy as np

from modetune.core.mesh import Cells, Mesh
from modetune.core.modes import Floats, Integers, ModeSet, common_dofs
from modetune.core.storage.keys import Json
from modetune.core.storage.record import CampaignRecord, IterationRecord
from modetune.core.surface import Surface, display_surface
from modetune.flows.report.comparison import model_scales, scaled_test
from modetune.flows.report.mode_tables import mode_label

#: Nodes of a surface that a browser without a graphics card still moves smoothly.
AT_MOST = 12_000
#: A test that moves this often farther than the model is drawn no farther: its shape is a mismatch.
FARTHEST = 2.5
#: Motions are whole numbers of this many steps, which no eye tells from more.
STEPS = 32767


@dataclass(frozen=True, slots=True)
class Motion:
    """A mode in one state: its frequency and MAC (may be NaN), and the largest displacements.

    model: (n, 3) at the scene's nodes. test: (n_points, 3) at its points.
    """

    frequency_hz: float
    mac: float
    model: Floats
    test: Floats


@dataclass(frozen=True, slots=True)
class SceneMode:
    """A measured mode before and after updating."""

    label: str
    test_hz: float
    before: Motion
    after: Motion


@dataclass(frozen=True, slots=True)
class Scene:
    """What is drawn and how it moves.

    coordinates: (n, 3); triangles: (n_triangles, 3) and edges: (n_edges, 2), rows of them.
    nodes: (n_points,), test nodes; points: (n_points, 3), where they are; lines: (n_lines, 2),
    rows of the points. comac: (n_points,), the least of each point's sensors, NaN if unknown.
    """

    coordinates: Floats
    triangles: Integers
    edges: Integers
    nodes: Integers
    points: Floats
    lines: Integers
    modes: tuple[SceneMode, ...]

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
    surface, sensors = _thin(record.surface), _sensors(record)
    if surface is not None and not all(
        item.field.n_dof for item in (record.iterations[0], record.best)
    ):
        surface = None
    if surface is None and sensors is None:
        return None
    first, last = record.iterations[0], record.best
    modes = []
    for pair in range(first.pairing.measured.size):
        measured = int(first.pairing.measured[pair])
        before, after = (_motion(record, item, pair, surface, sensors) for item in (first, last))
        modes.append(
            SceneMode(
                mode_label(record, measured),
                float(record.test.modes.frequencies_hz[measured]),
                before,
                _in_phase(after, before),
            )
        )
    coordinates = (
        surface.coordinates if surface else sensors.points if sensors else np.zeros((0, 3))
    )
    return Scene(
        coordinates=coordinates,
        triangles=surface.triangles if surface else np.zeros((0, 3), dtype=np.int64),
        edges=surface.edges if surface else _lines(record, sensors),
        nodes=sensors.nodes if sensors else np.zeros(0, dtype=np.int64),
        points=sensors.points if sensors else np.zeros((0, 3)),
        lines=_lines(record, sensors),
        modes=tuple(modes),
    )


def _thin(surface: Surface | None, at_most: int = AT_MOST) -> Surface | None:
    if surface is None or surface.nodes.size <= at_most:
        return surface
    blocks = []
    if surface.triangles.size:
        blocks.append(_cells("triangle", surface.nodes[surface.triangles]))
    if surface.edges.size:
        blocks.append(_cells("line", surface.nodes[surface.edges]))
    return display_surface(Mesh(surface.nodes, surface.coordinates, tuple(blocks)), at_most)


def _cells(kind: str, nodes: Integers) -> Cells:
    numbers = np.arange(1, nodes.shape[0] + 1)
    return Cells("triangle" if kind == "triangle" else "line", numbers, nodes)


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


def _motion(
    record: CampaignRecord,
    item: IterationRecord,
    pair: int,
    surface: Surface | None,
    sensors: _Sensors | None,
) -> Motion:
    test = np.zeros((0, 3))
    model = np.zeros((0, 3))
    scale = float(model_scales(record, item)[pair]) if record.test.has_shapes else 1.0
    if sensors is not None:
        shapes_t, shapes_m = scaled_test(record, item)
        rows_m, _ = common_dofs(record.test.modes, item.computed)
        at = np.searchsorted(rows_m, sensors.rows)
        test = _moved(sensors, shapes_t[at, pair])
        model = _moved(sensors, shapes_m[at, pair])
    if surface is not None:
        model = scale * _field(item.field, surface, pair)
    largest = float(np.linalg.norm(model, axis=1).max(initial=0.0)) or 1.0
    lengths = np.linalg.norm(test, axis=1) / largest
    too_far = np.maximum(lengths.max(initial=0.0) / FARTHEST, 1.0)
    return Motion(
        frequency_hz=float(item.computed.frequencies_hz[item.pairing.computed[pair]]),
        mac=float(item.pairing.mac[pair]),
        model=model / largest,
        test=test / largest / too_far,
    )


def _in_phase(after: Motion, before: Motion) -> Motion:
    """Turned by half a period where the model would start against its motion before.

    Where shapes were measured both follow the test already.
    """
    if after.test.size or float(np.sum(after.model * before.model)) >= 0.0:
        return after
    return Motion(after.frequency_hz, after.mac, -after.model, after.test)


def _moved(sensors: _Sensors, values: Floats) -> Floats:
    """Motion of the points, (n_points, 3), from what each sensor (n,) measures."""
    moved = np.zeros((sensors.nodes.size, 3))
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


def told_scene(shown: Scene) -> dict[str, Json]:
    """What `shapes.js` draws: arrays as base64 of little-endian numbers, row after row."""
    return {
        "length": shown.length,
        "coordinates": _packed(shown.coordinates, "<f4"),
        "triangles": _packed(shown.triangles, "<u4"),
        "edges": _packed(shown.edges, "<u4"),
        "nodes": shown.nodes.tolist(),
        "points": _packed(shown.points, "<f4"),
        "lines": _packed(shown.lines, "<u4"),
        "modes": [
            {
                "label": mode.label,
                "test_hz": mode.test_hz,
                "before": _told_motion(mode.before),
                "after": _told_motion(mode.after),
            }
            for mode in shown.modes
        ],
    }


def _told_motion(motion: Motion) -> dict[str, Json]:
    return {
        "hz": motion.frequency_hz,
        "mac": motion.mac if np.isfinite(motion.mac) else None,
        "model": _packed(np.rint(STEPS * motion.model), "<i2"),
        "test": _packed(motion.test, "<f4"),
    }


def _packed(values: Floats | Integers, kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values).astype(kind).tobytes()).decode()
