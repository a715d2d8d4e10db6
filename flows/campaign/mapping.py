"""Assignment of each sensor of a test to a node and a direction of the model.

There are three steps, each of which can refuse the test: the test's points are transformed to the
model's axes and length (`alignment`), each sensor takes the nearest node within a tolerance, and
its direction is rotated into the axes of the model's results at that node. Without coordinates a
sensor is the model's node of the same number, along the axes of that node's results.

Stick models have nodes on an axis and sensors on a surface round it. There a sensor that is not
at a node is rigidly attached to the section of the bar next to it.

A node that cannot move in the sensor's direction, such as the grounded end of a spring under the
structure, is passed over for the next one that can, unless the test has no motion there either.
Sensors whose node cannot move at all are left out, and named: they say nothing about the model.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import TestGeometry
from modetune.core.measurement.registration import Alignment
from modetune.core.measurement.sensor_map import (
    Sections,
    SensorMap,
    bar_ends,
    bar_sections,
    mean_edge,
    next_nodes,
    nodes_within,
    result_directions,
    section_factors,
)
from modetune.core.mesh import NOTHING_FIXED, Fixed, Mesh
from modetune.core.modes import COMPONENTS, Floats, Integers, ModeSet, dof_name
from modetune.core.near_names import suggestion
from modetune.core.storage.store import Store
from modetune.flows.campaign.alignment import Laid, align_test, diagonal, unit_name
from modetune.flows.campaign.schema import SensorSection

Verdict = Literal["good", "doubtful", "left out"]

#: What a user can do about an uncertain alignment.
REMEDY = (
    "Check the picture (`modetune sensors --picture`); in test.sensors give three or more "
    "landmarks in `match` without `align`, or `rotation` and `translation` with `align: none`"
)
CHOICE = (
    "In test.sensors combine one of these with `align: fit`, or a landmark to `match` "
    "(test node: model node)"
)
#: Maximum number of poses in a message.
LISTED_POSES = 6
#: Maximum number of sensors in a message, each with its reason.
REASONS = 20
#: Maximum number of sensors: each gets a sentence, which takes seconds for so large a number.
MOST = 100_000
#: Largest distance of a sensor from its node, as a part of the model's box diagonal.
TOLERANCE = 0.02
#: Largest distance of a sensor from the axis of a stick model, as a part of the model's diagonal:
#: half the root chord of a wing, or the radius of a fuselage, with some reserve.
REACH = 0.15
#: A second node counts as equally near if its extra distance is at most this part of the distance.
AS_NEAR = 0.1
#: Number of test points of one node that are compared with each other and named in a message.
COMPARED = 8
#: A sensor whose direction is that of fixed components to within this part sees no motion: sensors
#: are glued on to a few degrees.
FREE_PART = 0.1
#: A sensor is at rest whose motion is below this part of the largest one in every measured mode.
AT_REST = 0.02
#: Test points closer than this part of the tolerance have the same position.
ONE_PLACE = 0.05


@dataclass(frozen=True, slots=True)
class SensorRow:
    """A sensor: the node where it is read in the model, and how certain that is.

    model_node: None where left out. distance: from that node; misfit: from the surface of a model
    that the test was fitted to; both in the model's length, NaN where unknown. direction: unit
    vector in the model's global axes, or in the node's where mapped by number. node_name: what a
    deck with instances calls the node. at_rest: left out, as neither its node nor the test moves.
    """

    test_node: int
    component: str
    model_node: int | None
    distance: float
    direction: tuple[float, float, float]
    verdict: Verdict
    reason: str = ""
    misfit: float = float("nan")
    node_name: str = ""
    at_rest: bool = False

    @property
    def sensor(self) -> str:
        return f"{self.test_node}.{self.component}"


@dataclass(frozen=True, slots=True)
class Mapping:
    """The sensors of a test on the model.

    sensors: those with a node. rows: (n_sensors,), their rows in the test's shapes. alignment: None
    where sensors go by number. table: every sensor of the test, in its order. places: (n_rows, 3),
    of the sensors in the table, in the model's axes and length: by the test, or of the nodes where
    sensors go by number; NaN where unknown. tolerance: in the model's length, which `unit` names
    ("" where it has no name). notes: remarks, a sentence each. doubts: why the alignment is
    uncertain. others: the same sensors at poses that fit as well.
    """

    sensors: SensorMap
    rows: Integers
    alignment: Alignment | None
    places: Floats
    table: tuple[SensorRow, ...]
    tolerance: float
    unit: str = ""
    notes: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    others: tuple[Mapping, ...] = ()

    @property
    def uncertain(self) -> tuple[tuple[str, str], ...]:
        """Why the alignment is uncertain, and what to do, a sentence each; mostly none."""
        texts = [(doubt, REMEDY) for doubt in self.doubts]
        if self.others:
            poses = "; ".join(pose_of(item) for item in (self, *self.others)[:LISTED_POSES])
            more = len(self.others) + 1 - LISTED_POSES
            poses += f" and {more} more" if more > 0 else ""
            many = f"{1 + len(self.others)} poses of the test fit equally well"
            texts.append((f"{many}: {poses}", CHOICE))
        return tuple(texts)

    @property
    def doubtful(self) -> tuple[SensorRow, ...]:
        return tuple(row for row in self.table if row.verdict == "doubtful")

    def read_at(self, mesh: Mesh) -> Floats:
        """Return the places (n_sensors, 3) whose motion sensors read: nodes, or ends of arms."""
        at_nodes = mesh.coordinates[mesh.rows(self.sensors.model_nodes)]
        return np.where(self.sensors.on_bars[:, None], self.places[self.rows], at_nodes)

    @property
    def left_out(self) -> tuple[SensorRow, ...]:
        return tuple(row for row in self.table if row.verdict == "left out")


def pose_of(mapping: Mapping) -> str:
    """Return the pose of an alignment as campaign keys."""
    assert mapping.alignment is not None
    from scipy.spatial.transform import Rotation  # few campaigns turn their sensors

    pose = mapping.alignment
    angles = Rotation.from_matrix(pose.rotation).as_euler("xyz", degrees=True)
    turned = ", ".join(f"{angle + 0.0:.4g}" for angle in np.round(angles, 2))
    digits = 4 - int(np.floor(np.log10(mapping.tolerance)))
    moved = ", ".join(f"{value + 0.0:.7g}" for value in np.round(pose.translation, digits))
    return f"rotation: [{turned}], translation: [{moved}]"


@dataclass(frozen=True, slots=True)
class MappedNode:
    """The node where a test point is read.

    node: 0 where there is none, for the reason in `missing`. distance: in the mesh's length, NaN
    where unknown. passed: the nearest node where that one is fixed, else 0. section: of the bar
    that carries the point, from its end `node`: the other end, the part of the bar's length, and
    the arm (3,) from there, global axes.
    """

    node: int
    distance: float = float("nan")
    missing: str = ""
    doubts: tuple[str, ...] = ()
    passed: int = 0
    section: tuple[int, float, Floats] | None = None


#: By sensor: test point and component.
Nodes = dict[tuple[int, int], MappedNode]


def tolerance_of(settings: SensorSection, mesh: Mesh) -> float:
    """Return how far a sensor may be from its node, in the model's length."""
    if settings.tolerance is not None:
        return settings.tolerance
    return max(TOLERANCE * diagonal(mesh.coordinates), mean_edge(mesh) / 2.0)


def map_sensors(
    modes: ModeSet,
    geometry: TestGeometry | None,
    mesh: Mesh,
    settings: SensorSection,
    metres_per_model_length: float,
    components: frozenset[int] = frozenset(range(1, 7)),
    store: Store | None = None,
    fixed: Fixed = NOTHING_FIXED,
) -> Mapping:
    """Map the sensors of a test (the degrees of freedom of `modes`) to nodes of a model.

    components: 1..6, those that the model's results have. store: keeps a pose that was found.
    fixed: components that cannot move, by node.
    Raises CampaignError, all problems at once, for sensors that cannot be mapped.
    """
    if modes.n_dof > MOST:
        raise CampaignError(
            f"the test has {modes.n_dof:,} sensors, but at most {MOST:,} can be mapped; use a test "
            "file with fewer measured points or directions"
        )
    settings = _numbered(settings, mesh)
    match = {point: node for point, node in settings.match.items() if isinstance(node, int)}
    lost = sorted(set(match.values()) - set(mesh.nodes.tolist()))
    if lost:
        raise CampaignError(f"`match` names model node {_listed(lost)}, which has no results")
    tolerance, unit = tolerance_of(settings, mesh), unit_name(metres_per_model_length)
    mapper = _Mapper(modes, mesh, settings, components, match, tolerance, unit, fixed)
    if geometry is not None and settings.by == "position" and modes.n_dof:
        metres = metres_per_model_length
        laid = align_test(geometry, mesh, settings, metres, tolerance, store)
        return mapper.by_position(geometry, laid)
    if geometry is None and settings.places:
        raise CampaignError(
            "the test has no coordinates for `align`, `scale`, `rotation` and `translation`; leave "
            "these out to map sensors by node number"
        )
    return mapper.by_number()


def _numbered(settings: SensorSection, mesh: Mesh) -> SensorSection:
    """Return the settings with node numbers for the names in `match`. Raises CampaignError."""
    by_name = {name: number for number, name in mesh.names.items()}
    match = dict(settings.match)
    for point, node in settings.match.items():
        if isinstance(node, str):
            if node.upper() not in by_name:
                near = suggestion(node.upper(), by_name)
                raise CampaignError(f"`match` names model node {node}, which is not there{near}")
            match[point] = by_name[node.upper()]
    return settings.model_copy(update={"match": match})


@dataclass(frozen=True, slots=True)
class _Mapper:
    """Maps the sensors of a test, the degrees of freedom of `modes`, to a model.

    components: those that the model's results have. match: test point to model node, given by the
    user. tolerance: in the model's length, which `unit` names. fixed: components by node.
    """

    modes: ModeSet
    mesh: Mesh
    settings: SensorSection
    components: frozenset[int]
    match: dict[int, int]
    tolerance: float
    unit: str
    fixed: Fixed

    @property
    def dofs(self) -> list[tuple[int, int]]:
        """Test point and component of each sensor."""
        return list(zip(self.modes.nodes.tolist(), self.modes.components.tolist(), strict=True))

    def length(self, value: float) -> str:
        """Return a length as people read it."""
        return f"{value:.4g} {self.unit}".rstrip()

    def by_number(self) -> Mapping:
        """Map sensors to the nodes of the same number, in the axes of the results there."""
        known = set(self.mesh.nodes.tolist())
        nodes: Nodes = {}
        for sensor in self.dofs:
            node = self.match.get(sensor[0], sensor[0])
            missing = "" if node in known else f"the model has no results at a node {node}"
            nodes[sensor] = MappedNode(0, missing=missing) if missing else MappedNode(node, 0.0)
        axes = np.eye(3)[(self.modes.components - 1) % 3]
        table, at = self._table(nodes, axes, axes), self._node_numbers(nodes)
        places = np.full((at.size, 3), np.nan)
        found = at > 0
        places[found] = self.mesh.coordinates[self.mesh.rows(at[found])]
        return self._mapping(table, axes, places, None, self._refused(table, nodes), nodes)

    def by_position(self, geometry: TestGeometry, laid: Laid) -> Mapping:
        """Map sensors to the nodes next to them, at the first pose; the others are alternatives."""
        best = self._at_pose(geometry, laid.poses[0], laid.misfits, laid.notes)
        others = []
        for pose in laid.poses[1:]:
            try:
                other = self._at_pose(geometry, pose, pose.residuals, ())
            except CampaignError:  # ignore poses whose sensors find no nodes
                continue
            if np.array_equal(other.rows, best.rows):
                others.append(other)
        return replace(best, doubts=laid.doubts, others=tuple(others))

    def _at_pose(
        self,
        geometry: TestGeometry,
        alignment: Alignment,
        misfits: Floats,
        notes: tuple[str, ...],
    ) -> Mapping:
        """Map sensors where an alignment puts them; misfits: (n_points,) or empty."""
        at = {node: row for row, node in enumerate(geometry.nodes.tolist())}
        laid = alignment.apply(geometry.coordinates)
        points = self.modes.nodes
        rows = np.array([at.get(node, 0) for node in points.tolist()], dtype=np.int64)
        directions = alignment.turn(geometry.frames[rows, (self.modes.components - 1) % 3])
        nodes = self._nodes_at(geometry.nodes, laid, directions)
        turned = result_directions(self._node_numbers(nodes), directions, self.mesh)
        table = self._table(nodes, directions, turned)
        if misfits.size:
            table = tuple(
                replace(row, misfit=float(misfits[at[row.test_node]]))
                if row.test_node in at
                else row
                for row in table
            )
        places = laid[rows]
        places[~np.isin(points, geometry.nodes)] = np.nan
        size = diagonal(places[np.isfinite(places).all(axis=1)])
        if 0.0 < size < self.tolerance:  # shrunk to a point, where all would find a node
            raise CampaignError(
                [
                    f"all sensors are within {self.length(size)}, less than the tolerance "
                    f"({self.length(self.tolerance)}): check `scale` and units",
                    *notes,
                ]
            )
        notes = (*notes, *_passed_over(nodes), *self._attached(nodes))
        notes += self._refused(table, nodes, notes)
        return self._mapping(table, turned, places, alignment, notes, nodes)

    def _attached(self, nodes: Nodes) -> list[str]:
        """Return a sentence about the points that bars carry, if any."""
        arms = {sensor[0]: item.distance for sensor, item in nodes.items() if item.section}
        if not arms:
            return []
        far = max(arms, key=lambda point: arms[point])
        count = f"{len(arms)} test point{' is' if len(arms) == 1 else 's are'}"
        return [
            f"{count} attached rigidly to the nearest bar, up to {self.length(arms[far])} off its "
            f"axis (test point {far}), and moved by its translation and rotation"
        ]

    def _nodes_at(self, names: Integers, places: Floats, directions: Floats) -> Nodes:
        """Return the nodes next to places (n, 3) of the points `names` (n,), for all sensors.

        directions: (n_dof, 3), global axes.
        """
        wanted = set(self.modes.nodes.tolist())
        at = {name: places[row] for row, name in enumerate(names.tolist()) if name in wanted}
        missing = MappedNode(0, missing="the test has no coordinates of it")
        nodes = dict.fromkeys(self.dofs, missing)
        if not at:
            return nodes
        next_ones, distances = next_nodes(np.array([*at.values()]), self.mesh)
        carried = self._carried(
            {point: place for point, place in at.items() if point not in self.match},
            {point: float(distances[row, 0]) for row, point in enumerate(at)},
        )
        nearest = {
            point: self._matched(self.match[point], place)
            if point in self.match
            else self._nearest(next_ones[row], distances[row])
            for row, (point, place) in enumerate(at.items())
        } | carried
        nodes |= {sensor: nearest[sensor[0]] for sensor in nodes if sensor[0] in nearest}
        held = np.isin(next_ones, np.fromiter(self.fixed, np.int64, len(self.fixed))).any(axis=1)
        near = {point for point, is_held in zip(at, held, strict=True) if is_held}
        near -= self.match.keys() | carried.keys()
        for (point, component), direction, rests in zip(
            self.dofs, directions, self._at_rest(), strict=True
        ):
            if point in near and not rests:
                there = nodes[point, component]
                moving = self._moving(there, at[point], direction, component)
                nodes[point, component] = moving
        return self._shared(nodes, at)

    @property
    def _can_attach(self) -> bool:
        """Whether the model has bars, and its results their rotations."""
        return self.components >= set(range(1, 7)) and bool(bar_ends(self.mesh).size)

    def _carried(self, at: dict[int, Floats], to_node: dict[int, float]) -> dict[int, MappedNode]:
        """Return those of the points at some places that bars carry on rigid arms.

        to_node: distances from the nearest node, which is preferred if it is within the tolerance
        and nearer than any bar: it ends an arm of the model's own.
        """
        apart = {point: at[point] for point in at if to_node[point] > ONE_PLACE * self.tolerance}
        if not apart or self.settings.attach is False or not self._can_attach:
            return {}
        if self.settings.attach is None and not _is_stick(self.mesh):
            return {}
        reach = np.inf if self.settings.attach else REACH * diagonal(self.mesh.coordinates)
        found = bar_sections(np.array([*apart.values()]), self.mesh)
        return {
            point: MappedNode(first, distance, section=(second, part, arm))
            for point, (first, second), part, arm, distance in zip(
                apart,
                found.nodes.tolist(),
                found.parts.tolist(),
                found.arms,
                found.distances.tolist(),
                strict=True,
            )
            if distance <= reach
            and (to_node[point] > self.tolerance or distance <= to_node[point] * (1.0 + 1e-9))
        }

    def _at_rest(self) -> list[bool]:
        """Return of each sensor whether the test has no motion there."""
        sizes = np.abs(self.modes.mode_shapes)
        return list((sizes <= AT_REST * sizes.max(axis=0, initial=0.0)).all(axis=1))

    def _moving(
        self, nearest: MappedNode, place: Floats, direction: Floats, component: int
    ) -> MappedNode:
        """Return the node next to a place that can move in a direction, in global axes.

        It is the nearest of all where none within the tolerance can.
        """
        near = nodes_within(place, self.mesh, self.tolerance)
        turned = result_directions(near, np.tile(direction, (near.size, 1)), self.mesh)
        can_move = [
            not self._is_fixed(node, along, component)
            for node, along in zip(near.tolist(), turned, strict=True)
        ]
        free = near[np.array(can_move, dtype=bool)]
        if not free.size:
            if nearest.missing:
                return nearest
            doubt = f"node {nearest.node} is fixed in this direction, as all within the tolerance"
            return replace(nearest, doubts=(*nearest.doubts, doubt))
        apart = self.mesh.coordinates[self.mesh.rows(free[:2])] - place
        distances = np.append(np.linalg.norm(apart, axis=1), np.inf)
        chosen = self._nearest(np.append(free[:2], 0), distances)
        return replace(chosen, passed=0 if can_move[0] else int(near[0]))

    def _is_fixed(self, node: int, direction: Floats, component: int) -> bool:
        """Return whether a node cannot move in a direction, in the axes of its results."""
        first = 1 if component <= 3 else 4
        held = [axis + first in self.fixed.get(node, ()) for axis in range(3)]
        return bool(np.linalg.norm(direction[np.logical_not(held)]) < FREE_PART)

    def _matched(self, node: int, place: Floats) -> MappedNode:
        partner = self.mesh.coordinates[self.mesh.rows(np.array([node]))[0]]
        distance = float(np.linalg.norm(place - partner))
        far = distance > self.tolerance
        return MappedNode(node, distance, doubts=("farther than the tolerance",) if far else ())

    def _nearest(self, nodes: Integers, distances: Floats) -> MappedNode:
        node, distance = int(nodes[0]), float(distances[0])
        if distance > self.tolerance:  # and no bar carries it
            text = f"the nearest node, {node}, is {self.length(distance)} away"
            return MappedNode(0, distance, text)
        doubts = []
        if distance > self.tolerance / 2.0:
            doubts.append("more than half the tolerance away")
        gap = float(distances[1]) - distance
        if gap <= 1e-6 * self.tolerance and distance <= AS_NEAR * self.tolerance:
            doubts.append(f"node {nodes[1]} has the same position")
        elif gap <= AS_NEAR * distance and distance > AS_NEAR * self.tolerance:
            doubts.append(f"node {nodes[1]} is as near")
        return MappedNode(node, distance, doubts=tuple(doubts))

    def _shared(self, nodes: Nodes, places: dict[int, Floats]) -> Nodes:
        """Add a doubt where test points at different places are read at one node."""
        sharing: dict[int, dict[int, list[int]]] = {}
        for (point, component), mapped in nodes.items():
            if mapped.section is not None:
                continue
            sharing.setdefault(mapped.node, {}).setdefault(point, []).append(component)
        doubted = dict(nodes)
        for node, points in sharing.items():
            if not node or len(points) < 2:
                continue
            first = list(points)[:COMPARED]
            where = np.array([places[other] for other in first])
            more = f" and {len(points) - COMPARED} more" if len(points) > COMPARED else ""
            for point, components in points.items():
                far = np.linalg.norm(where - places[point], axis=1) > ONE_PLACE * self.tolerance
                if far.any():
                    apart = [other for other, is_far in zip(first, far, strict=True) if is_far]
                    doubt = f"read at the same node as test point {_listed(apart)}{more}"
                    for sensor in ((point, component) for component in components):
                        doubts = (*nodes[sensor].doubts, doubt)
                        doubted[sensor] = replace(nodes[sensor], doubts=doubts)
        return doubted

    def _node_numbers(self, nodes: Nodes) -> Integers:
        """Return the model's node of each sensor, 0 where it has none."""
        return np.array([nodes[sensor].node for sensor in self.dofs], dtype=np.int64)

    def _table(self, nodes: Nodes, directions: Floats, turned: Floats) -> tuple[SensorRow, ...]:
        """Return a row per sensor; directions: (n_dof, 3), in global axes or the node's.

        turned: the same in the axes of the results.
        """
        rows = []
        for (point, component), direction, seen, rests in zip(
            self.dofs, directions, turned, self._at_rest(), strict=True
        ):
            mapped = nodes[point, component]
            held = self._held(mapped, point, component)
            missing = mapped.missing or held or self._not_computed(component, seen)
            verdict: Verdict = "left out" if missing else "doubtful" if mapped.doubts else "good"
            rows.append(
                SensorRow(
                    point,
                    COMPONENTS[component - 1],
                    None if missing else mapped.node,
                    mapped.distance,
                    (float(direction[0]), float(direction[1]), float(direction[2])),
                    verdict,
                    missing or "; ".join((*self._reason(mapped), *mapped.doubts)),
                    node_name="" if missing else self.mesh.names.get(mapped.node, ""),
                    at_rest=bool(held) and rests,
                )
            )
        return tuple(rows)

    def _reason(self, mapped: MappedNode) -> list[str]:
        """Return why a sensor is not read at the nearest node, where it is not."""
        if mapped.section is not None:
            bar = f"bar {mapped.node}-{mapped.section[0]}"
            return [f"attached rigidly to {bar}, {self.length(mapped.distance)} from its axis"]
        passed = f"the nearest node, {mapped.passed}, is fixed in this direction"
        return [passed] * bool(mapped.passed)

    def _held(self, mapped: MappedNode, point: int, component: int) -> str:
        """Return why a sensor's node has no motion in the model; "" if it has, or is matched."""
        axes = {1, 2, 3} if component <= 3 else {4, 5, 6}
        free = mapped.section is not None or point in self.match
        held = not free and axes <= set(self.fixed.get(mapped.node, ()))
        return f"node {mapped.node} cannot move in the model" if held else ""

    def _not_computed(self, component: int, direction: Floats) -> str:
        """Return why the model's results do not show a sensor's motion; "" where they do."""
        first = 1 if component <= 3 else 4
        absent = {first, first + 1, first + 2} - self.components
        lost = [axis for axis in sorted(absent) if abs(direction[axis - first]) > 1e-6]
        named = ", ".join(COMPONENTS[axis - 1] for axis in lost)
        return f"the model's results have no {named}" if lost else ""

    def _refused(
        self, table: tuple[SensorRow, ...], nodes: Nodes, notes: Iterable[str] = ()
    ) -> tuple[str, ...]:
        """Return sentences about the sensors that are left out.

        Raises CampaignError with them, and possible causes, unless they may be left out and some
        sensors remain.
        """
        reasons: dict[str, None] = {}
        held: list[str] = []
        for row, sensor in zip(table, self.dofs, strict=True):
            if not nodes[sensor].missing and self._held(nodes[sensor], *sensor):
                held.append(dof_name(sensor))
            elif row.verdict == "left out":
                turns = len(row.component) == 2
                name = f"{row.test_node}.{row.component}" if turns else f"{row.test_node}"
                reasons.setdefault(f"sensor {name}: {row.reason}")
        remain = any(row.verdict != "left out" for row in table)
        still: tuple[str, ...] = ()
        if held:
            more = f" and {len(held) - REASONS} more" if len(held) > REASONS else ""
            named = ", ".join(held[:REASONS]) + more
            count = "1 sensor" if len(held) == 1 else f"{len(held)} sensors"
            still = (f"left out: {count} at nodes that cannot move in the model: {named}",)
            if not remain and not reasons:
                raise CampaignError([f"{still[0]}; no other sensor remains", *notes])
        if not reasons:
            return still
        count = "1 sensor is" if len(reasons) == 1 else f"{len(reasons)} sensors are"
        text = (
            f"{count} without a node in the model (tolerance {self.length(self.tolerance)}): "
            + "; ".join([*reasons][:REASONS])
            + (f"; and {len(reasons) - REASONS} more" if len(reasons) > REASONS else "")
        )
        if self.settings.unmapped == "leave_out" and remain:
            return (*still, f"left out: {text}")
        ways = []
        if self.settings.by == "position" and self.modes.n_dof:
            if self._can_attach and not self.settings.attach:
                ways += ["`attach: true` attaches them rigidly to bars"]
            fit = "`align: fit` fits rotation, scale and position"
            ways += ["`match` assigns nodes" if self.settings.fits else fit]
            ways += ["`tolerance` allows larger distances"]
        ways += ["`unmapped: leave_out` drops them"] if remain else ["no other sensor remains"]
        remedy = f"In test.sensors: {', '.join(ways)}"
        if self.settings.attach is not False and _is_stick(self.mesh) and not self._can_attach:
            remedy += (
                "; results of this solver have no rotations, with which Nastran and MYSTRAN attach "
                "sensors to bars"
            )
        raise CampaignError([f"{text}. {remedy}", *notes])

    def _mapping(
        self,
        table: tuple[SensorRow, ...],
        directions: Floats,
        places: Floats,
        alignment: Alignment | None,
        notes: tuple[str, ...],
        nodes: Nodes,
    ) -> Mapping:
        rows = [place for place, row in enumerate(table) if row.verdict != "left out"]
        kept = np.array(rows, dtype=np.int64)
        sensors = SensorMap(
            nodes=self.modes.nodes[kept],
            components=self.modes.components[kept],
            model_nodes=np.array([table[row].model_node for row in rows], dtype=np.int64),
            directions=directions[kept],
            turns=self.modes.components[kept] > 3,
            distances=np.array([table[row].distance for row in rows], dtype=np.float64),
            sections=self._sections(nodes, rows),
        )
        return Mapping(sensors, kept, alignment, places, table, self.tolerance, self.unit, notes)

    def _sections(self, nodes: Nodes, rows: list[int]) -> Sections | None:
        """Return what moves those of the sensors in these rows of the table that bars carry."""
        terms, dofs = [], self.dofs
        for sensor, row in enumerate(rows):
            mapped = nodes[dofs[row]]
            if mapped.section is not None:
                second, part, arm = mapped.section
                turns = dofs[row][1] > 3
                own = section_factors(mapped.node, second, part, arm, turns, self.mesh)
                terms.append((np.full(own[0].size, sensor), *own))
        if not terms:
            return None
        return Sections(*(np.concatenate(items) for items in zip(*terms, strict=True)))


def _is_stick(mesh: Mesh) -> bool:
    """Return whether most elements of a mesh are bars: of those that are no points."""
    n_elements = sum(item.elements.size for item in mesh.cells if item.kind != "vertex")
    return 2 * len(mesh.bars) > n_elements


def _passed_over(nodes: Nodes) -> list[str]:
    """Return a sentence about sensors whose nearest node is fixed in their direction, if any."""
    named = [
        f"{dof_name(sensor)} ({mapped.node} instead of {mapped.passed})"
        for sensor, mapped in nodes.items()
        if mapped.passed and mapped.node
    ]
    if not named:
        return []
    more = f" and {len(named) - REASONS} more" if len(named) > REASONS else ""
    one = len(named) == 1
    return [
        f"{len(named)} sensor{' is' if one else 's are'} read at the next node that can move, "
        f"because the nearest one is fixed in {'its' if one else 'their'} direction: "
        f"{', '.join(named[:REASONS])}{more}"
    ]


def _listed(numbers: Iterable[int]) -> str:
    return ", ".join(map(str, numbers))
