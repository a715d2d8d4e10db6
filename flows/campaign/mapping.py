"""Which node of the model each sensor of a test is read at, and along which direction.

Three steps, each of which can refuse: the test's points are brought into the model's axes and
length (`alignment`), each sensor takes the nearest node within a tolerance, and its direction is
turned into the axes in which the model has its results at that node. Without coordinates a sensor
is the model's node of the same number, along the axes of that node's results.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from modetune.core.errors import CampaignError
from modetune.core.measurement.alignment import Alignment
from modetune.core.measurement.measurement import TestGeometry
from modetune.core.measurement.sensors import SensorMap, mean_edge, next_nodes, result_directions
from modetune.core.mesh import Mesh
from modetune.core.modes import COMPONENTS, Floats, Integers, ModeSet
from modetune.core.storage.store import Store
from modetune.flows.campaign.alignment import align_test, diagonal, unit_name
from modetune.flows.campaign.schema import SensorSection

#: A second node this little farther, as a part of the distance, is as near.
AS_NEAR = 0.1
#: Test points of one node that each is compared with, and that are named.
COMPARED = 8
#: Test points nearer than this part of the tolerance are in one place.
ONE_PLACE = 0.05


@dataclass(frozen=True, slots=True)
class MappedNode:
    """Where a test point is read.

    node: 0 where nowhere, and `missing` says why. distance: the mesh's length, NaN where unknown.
    """

    node: int
    distance: float = float("nan")
    missing: str = ""
    doubts: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class NodeMapping:
    """What mapped_nodes are given by.

    match: test node to model node, decided by the user. tolerance: the mesh's length, which `unit`
    names. Mapped nodes are told by the number of their test point.
    """

    mesh: Mesh
    match: dict[int, int]
    tolerance: float
    unit: str

    def length(self, value: float) -> str:
        """A length as people read it."""
        return f"{value:.4g} {self.unit}".rstrip()

    def by_number(self, measured: Integers) -> dict[int, MappedNode]:
        """Mapped nodes at the nodes of the same number."""
        known = set(self.mesh.nodes.tolist())
        mapped_nodes = {}
        for name in np.unique(measured).tolist():
            node = self.match.get(name, name)
            missing = "" if node in known else f"the model has no results at a node {node}"
            mapped_nodes[name] = (
                MappedNode(0, missing=missing) if missing else MappedNode(node, 0.0)
            )
        return mapped_nodes

    def by_position(
        self, measured: Integers, names: Integers, places: Floats
    ) -> dict[int, MappedNode]:
        """Mapped nodes next to places (n, 3) of the points `names` (n,), for `measured`."""
        mapped_nodes = {
            name: MappedNode(0, missing="the test has no coordinates of it")
            for name in np.unique(measured).tolist()
        }
        at = {name: row for row, name in enumerate(names.tolist()) if name in mapped_nodes}
        if not at:
            return mapped_nodes
        found = next_nodes(places[list(at.values())], self.mesh)
        for row, name in enumerate(at):
            if name in self.match:
                mapped_nodes[name] = self._matched(self.match[name], places[at[name]])
            else:
                mapped_nodes[name] = self._nearest(found.nodes[row], found.distances[row])
        return self._shared(mapped_nodes, {name: places[row] for name, row in at.items()})

    def _matched(self, node: int, place: Floats) -> MappedNode:
        partner = self.mesh.coordinates[self.mesh.rows(np.array([node]))[0]]
        distance = float(np.linalg.norm(place - partner))
        far = distance > self.tolerance
        return MappedNode(node, distance, doubts=("farther than the tolerance",) if far else ())

    def _nearest(self, nodes: Integers, distances: Floats) -> MappedNode:
        node, distance = int(nodes[0]), float(distances[0])
        if distance > self.tolerance:
            return MappedNode(
                0, distance, f"the next node, {node}, is {self.length(distance)} away"
            )
        doubts = []
        if distance > self.tolerance / 2.0:
            doubts.append("more than half the tolerance away")
        gap = float(distances[1]) - distance
        if gap <= 1e-6 * self.tolerance and distance <= AS_NEAR * self.tolerance:
            doubts.append(f"node {nodes[1]} is in the same place")
        elif gap <= AS_NEAR * distance and distance > AS_NEAR * self.tolerance:
            doubts.append(f"node {nodes[1]} is as near")
        return MappedNode(node, distance, doubts=tuple(doubts))

    def _shared(
        self, mapped_nodes: dict[int, MappedNode], places: dict[int, Floats]
    ) -> dict[int, MappedNode]:
        """Mapped nodes, with a doubt where test points that are apart are read at one node."""
        sharing: dict[int, list[int]] = {}
        for name, mapped_node in mapped_nodes.items():
            sharing.setdefault(mapped_node.node, []).append(name)
        told = dict(mapped_nodes)
        for node, names in sharing.items():
            first = names[:COMPARED]
            where = np.array([places[other] for other in first] if node else []).reshape(-1, 3)
            for name in names if node and len(names) > 1 else []:
                far = np.linalg.norm(where - places[name], axis=1) > ONE_PLACE * self.tolerance
                if far.any():
                    apart = [other for other, is_far in zip(first, far, strict=True) if is_far]
                    more = f" and {len(names) - COMPARED} more" if len(names) > COMPARED else ""
                    doubt = f"read at the same node as test point {listed(apart)}{more}"
                    told[name] = replace(
                        mapped_nodes[name], doubts=(*mapped_nodes[name].doubts, doubt)
                    )
        return told


def listed(numbers: Iterable[int]) -> str:
    """Numbers with commas."""
    return ", ".join(str(number) for number in numbers)


Verdict = Literal["good", "doubtful", "left out"]

#: What a user may do about an alignment that is not certain.
REMEDY = (
    "Look at it (`modetune sensors --picture`); in test.sensors name three or more landmarks in "
    "`match` without `align`, or give `rotation` and `translation` with `align: none`"
)
CHOICE = (
    "In test.sensors put one of these beside `align: fit`, or a landmark into `match` "
    "(test node: model node)"
)
#: Poses that are told of many.
TOLD = 6
#: Sensors that are named one by one with what is wrong with them.
REASONS = 20
#: Sensors that are mapped: each has a sentence of its own, which takes seconds for so many.
MOST = 100_000
#: Part of the model's box diagonal that a sensor may be away from its node.
TOLERANCE = 0.02


@dataclass(frozen=True, slots=True)
class SensorRow:
    """One sensor: where it is read in the model, and how sure that is.

    model_node: None where left out; distance: from it, misfit: of its place from the surface of a
    model that the test was fitted to, the model's length, NaN where not known.
    direction: unit vector in the model's global axes, or in the node's where mapped by number.
    """

    test_node: int
    component: str
    model_node: int | None
    distance: float
    direction: tuple[float, float, float]
    verdict: Verdict
    reason: str = ""
    misfit: float = float("nan")

    @property
    def sensor(self) -> str:
        return f"{self.test_node}.{self.component}"


@dataclass(frozen=True, slots=True)
class Mapping:
    """The sensors of a test on the model.

    sensors: those with a node. rows: (n_sensors,), their rows in the test's shapes.
    alignment: None where sensors go by number. table: every sensor of the test, in its order.
    places: (n_rows, 3), where those of the table are, in the model's axes and length: as the test
    says, or the nodes where sensors go by number; NaN where not known.
    tolerance: the model's length, which `unit` names ("" where it has no name).
    notes: what is to be known, a sentence each. doubts: why the alignment is not certain. others:
    the same sensors at poses that cannot be told from this one.
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
        """Why the alignment is not certain, and what to do, a sentence each; mostly none."""
        said = [(doubt, REMEDY) for doubt in self.doubts]
        if self.others:
            poses = "; ".join(pose_of(item) for item in (self, *self.others)[:TOLD])
            more = len(self.others) + 1 - TOLD
            poses += f" and {more} more" if more > 0 else ""
            many = f"{1 + len(self.others)} poses of the test fit alike"
            said.append((f"{many} and places cannot tell them apart: {poses}", CHOICE))
        return tuple(said)

    @property
    def doubtful(self) -> tuple[SensorRow, ...]:
        return tuple(row for row in self.table if row.verdict == "doubtful")

    @property
    def left_out(self) -> tuple[SensorRow, ...]:
        return tuple(row for row in self.table if row.verdict == "left out")


def pose_of(mapping: Mapping) -> str:
    """The pose of an alignment as a campaign has it."""
    assert mapping.alignment is not None
    from scipy.spatial.transform import Rotation  # few campaigns turn their sensors

    pose = mapping.alignment
    angles = Rotation.from_matrix(pose.rotation).as_euler("xyz", degrees=True)
    turned = ", ".join(f"{angle + 0.0:.4g}" for angle in np.round(angles, 2))
    digits = 4 - int(np.floor(np.log10(mapping.tolerance)))
    moved = ", ".join(f"{value + 0.0:.7g}" for value in np.round(pose.translation, digits))
    return f"rotation: [{turned}], translation: [{moved}]"


@dataclass(frozen=True, slots=True)
class _Task:
    modes: ModeSet
    settings: SensorSection
    components: frozenset[int]
    node_mapping: NodeMapping
    store: Store | None

    @property
    def mesh(self) -> Mesh:
        return self.node_mapping.mesh


def tolerance_of(settings: SensorSection, mesh: Mesh) -> float:
    """How far a sensor may be from its node, the model's length."""
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
) -> Mapping:
    """Map the sensors of a test (the degrees of freedom of `modes`) to nodes of a model.

    components: 1..6, those that the model's results have. store: keeps a pose that was found.
    Raises CampaignError, all problems at once, for sensors that cannot be mapped.
    """
    if modes.n_dof > MOST:
        raise CampaignError(
            f"the test has {modes.n_dof:,} sensors, at most {MOST:,} are mapped to the model; "
            "give a test file with fewer measured points or directions"
        )
    by_hand = {point: node for point, node in settings.match.items() if isinstance(node, int)}
    lost = sorted(set(by_hand.values()) - set(mesh.nodes.tolist()))
    if lost:
        raise CampaignError(f"`match` names model node {listed(lost)}, which carries no results")
    tolerance = tolerance_of(settings, mesh)
    unit = unit_name(metres_per_model_length)
    node_mapping = NodeMapping(mesh, by_hand, tolerance, unit)
    task = _Task(modes, settings, components, node_mapping, store)
    if geometry is not None and settings.by == "position" and modes.n_dof:
        return _by_position(task, geometry, metres_per_model_length)
    if geometry is None and settings.places:
        raise CampaignError(
            "the test data hold no coordinates, which `align`, `scale`, `rotation` and "
            "`translation` are about; leave these out, and sensors go by node number"
        )
    return _by_number(task)


def _by_number(task: _Task) -> Mapping:
    """Sensors are nodes of the model, in the axes of its results as ever."""
    mapped_nodes = task.node_mapping.by_number(task.modes.nodes)
    axes = np.eye(3)[(task.modes.components - 1) % 3]
    table = _table(task, mapped_nodes, axes, axes)
    nodes = np.array(
        [mapped_nodes[name].node for name in task.modes.nodes.tolist()], dtype=np.int64
    )
    places = np.full((nodes.size, 3), np.nan)
    found = nodes > 0
    places[found] = task.mesh.coordinates[task.mesh.rows(nodes[found])]
    return _mapping(task, table, axes, places, None, _refused(task, table))


def _by_position(task: _Task, geometry: TestGeometry, metres: float) -> Mapping:
    laid = align_test(
        geometry, task.mesh, task.settings, metres, task.node_mapping.tolerance, task.store
    )
    best = _at_pose(task, geometry, laid.poses[0], laid.misfits, laid.notes)
    others = []
    for pose in laid.poses[1:]:
        try:
            other = _at_pose(task, geometry, pose, pose.residuals, ())
        except CampaignError:  # a pose whose sensors find no nodes is none
            continue
        if np.array_equal(other.rows, best.rows):
            others.append(other)
    return replace(best, doubts=laid.doubts, others=tuple(others))


def _at_pose(
    task: _Task,
    geometry: TestGeometry,
    alignment: Alignment,
    misfits: Floats,
    notes: tuple[str, ...],
) -> Mapping:
    """The sensors where an alignment puts them; misfits: (n_points,) of the geometry, or empty."""
    at = {node: row for row, node in enumerate(geometry.nodes.tolist())}
    mapped_nodes = task.node_mapping.by_position(
        task.modes.nodes, geometry.nodes, alignment.apply(geometry.coordinates)
    )
    rows = np.array([at.get(node, 0) for node in task.modes.nodes.tolist()], dtype=np.int64)
    directions = alignment.turn(geometry.frames[rows, (task.modes.components - 1) % 3])
    nodes = np.array(
        [mapped_nodes[name].node for name in task.modes.nodes.tolist()], dtype=np.int64
    )
    turned = result_directions(nodes, directions, task.mesh)
    table = _table(task, mapped_nodes, directions, turned)
    if misfits.size:
        table = tuple(
            replace(row, misfit=float(misfits[at[row.test_node]])) if row.test_node in at else row
            for row in table
        )
    places = alignment.apply(geometry.coordinates)[rows]
    places[~np.isin(task.modes.nodes, geometry.nodes)] = np.nan
    _require_spread(task, places, notes)
    notes += _refused(task, table, notes)
    return _mapping(task, table, turned, places, alignment, notes)


def _require_spread(task: _Task, places: Floats, notes: tuple[str, ...]) -> None:
    """Refuse a test shrunk onto one place of the model, whose sensors would all find a node."""
    size = diagonal(places[np.isfinite(places).all(axis=1)])
    nodes = task.node_mapping
    if 0.0 < size < nodes.tolerance:
        raise CampaignError(
            [
                f"all sensors lie within {nodes.length(size)}, less than the tolerance "
                f"({nodes.length(nodes.tolerance)}), so their nodes would mean nothing",
                *notes,
            ]
        )


def _table(
    task: _Task, mapped_nodes: dict[int, MappedNode], directions: Floats, turned: Floats
) -> tuple[SensorRow, ...]:
    """A row a sensor; directions: (n_dof, 3), as they are told, turned: in the results' axes."""
    rows = []
    for name, component, direction, seen in zip(
        task.modes.nodes.tolist(), task.modes.components.tolist(), directions, turned, strict=True
    ):
        mapped_node = mapped_nodes[name]
        missing = mapped_node.missing or _not_computed(task, component, seen)
        verdict: Verdict = "left out" if missing else "doubtful" if mapped_node.doubts else "good"
        rows.append(
            SensorRow(
                name,
                COMPONENTS[component - 1],
                None if missing else mapped_node.node,
                mapped_node.distance,
                (float(direction[0]), float(direction[1]), float(direction[2])),
                verdict,
                missing or "; ".join(mapped_node.doubts),
            )
        )
    return tuple(rows)


def _not_computed(task: _Task, component: int, direction: Floats) -> str:
    """Why the model's results do not show a sensor's motion; "" where they do."""
    first = 1 if component <= 3 else 4
    absent = {first, first + 1, first + 2} - task.components
    lost = [axis for axis in sorted(absent) if abs(direction[axis - first]) > 1e-6]
    named = ", ".join(COMPONENTS[axis - 1] for axis in lost)
    return f"the model's results have no {named}" if lost else ""


def _refused(
    task: _Task, table: tuple[SensorRow, ...], notes: Iterable[str] = ()
) -> tuple[str, ...]:
    """What became of sensors without a node, a sentence a reason.

    Raises CampaignError with them, and what may be the cause, unless they may be left out and
    some remain.
    """
    reasons: dict[str, None] = {}
    for row in table:
        if row.verdict == "left out":
            turns = len(row.component) == 2
            name = f"{row.test_node}.{row.component}" if turns else f"{row.test_node}"
            reasons.setdefault(f"sensor {name}: {row.reason}")
    if not reasons:
        return ()
    count = "1 sensor is" if len(reasons) == 1 else f"{len(reasons)} sensors are"
    said = (
        f"{count} not seen by the model (tolerance "
        f"{task.node_mapping.length(task.node_mapping.tolerance)}): "
        + "; ".join([*reasons][:REASONS])
        + (f"; and {len(reasons) - REASONS} more" if len(reasons) > REASONS else "")
    )
    remain = any(row.verdict != "left out" for row in table)
    if task.settings.unmapped == "leave_out" and remain:
        return (f"left out: {said}",)
    raise CampaignError([f"{said}. {_remedy(task, remain)}", *notes])


def _remedy(task: _Task, remain: bool) -> str:
    ways = []
    if task.settings.by == "position" and task.modes.n_dof:
        fit = "`match` gives partners" if task.settings.fits else "`align: fit` finds rotation, "
        ways += [fit if task.settings.fits else f"{fit}scale and place", "`tolerance` allows more"]
    ways += ["`unmapped: leave_out` drops them"] if remain else ["none is left"]
    return f"In test.sensors: {', '.join(ways)}"


def _mapping(
    task: _Task,
    table: tuple[SensorRow, ...],
    directions: Floats,
    places: Floats,
    alignment: Alignment | None,
    notes: tuple[str, ...],
) -> Mapping:
    kept = np.array(
        [place for place, row in enumerate(table) if row.verdict != "left out"], dtype=np.int64
    )
    sensors = SensorMap(
        nodes=task.modes.nodes[kept],
        components=task.modes.components[kept],
        model_nodes=np.array([table[row].model_node for row in kept], dtype=np.int64),
        directions=directions[kept],
        turns=task.modes.components[kept] > 3,
        distances=np.array([table[row].distance for row in kept], dtype=np.float64),
    )
    return Mapping(
        sensors,
        kept,
        alignment,
        places,
        table,
        task.node_mapping.tolerance,
        task.node_mapping.unit,
        notes,
    )
