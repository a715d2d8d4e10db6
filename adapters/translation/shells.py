"""Nastran shells as CalculiX bricks: any membrane, bending, coupling and shear stiffness.

A CQUAD4 or CTRIA3 gets a midside node on each edge, which the elements of that edge share. As
quadratic elements they are as good as Nastran's; the linear elements of ccx are not. Nastran
measures a material angle from side G1-G2 (THETA), or projects the x axis of a coordinate system
(MCID).

ccx expands its own shells to solids of one material and the thickness of the shell. It has no
laminates in a deck with masses or springs, and no shell whose bending differs from its membrane. So
the translation writes the solids, and ties the motion of their nodes to displacement u and rotation
theta of the shell's nodes (Ahmad, Irons and Zienkiewicz 1970). With n the normal of the element and
z along it,

    membrane brick: u + c theta x n            (the same for all z, strains e + c k)
    bending brick:  n (n . u) + z theta x n    (strains z k, transverse shear g)

of height h, with in-plane laws A / h and 12 D / h^3 and shear H / h. Their energies are those of a
unit of area of the shell, whatever h is. Coupling takes two membrane bricks, at c and -c, of
A / 2 + B / 2 c and A / 2 - B / 2 c, and c^2 A less in bending. c includes the offset. The bricks
are C3D20R and C3D15, which ccx uses for S8R and S6.

Each brick lies on the mean plane of its element, and nodes off that plane carry it on arms: rigid
motion is exact for warped elements too. The mass moves with a membrane brick, so it has no inertia
against rotation, as in Nastran's shells.

A shell has no stiffness against rotation about its normal. Nastran gives it a little (K6ROT) or
removes the freedom (AUTOSPC); otherwise a mass, a beam or a rigid element on a shell node would
turn freely. Here that rotation follows the shell around the node: theta n = sum (J^-1 n x r_i) u_i,
J = sum (r_i^2 I - r_i r_i) over the nodes of the adjacent elements. This is the rotation that fits
their displacements best; it is exact for rigid motion and stiffens nothing.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from modetune.adapters.nastran.masses import LumpedElement, mass_of
from modetune.adapters.nastran.shell_laws import ShellLaw, law_of
from modetune.adapters.translation.assembly import (
    Assembly,
    Form,
    Freedoms,
    difference,
    total,
    trimmed,
)
from modetune.adapters.translation.calculix_text import CalculixText, number_list
from modetune.adapters.translation.concentrated_masses import Shares, group_lines
from modetune.core.modes import Floats, Integers

LINEAR = {"CQUAD4": 4, "CQUADR": 4, "CTRIA3": 3, "CTRIAR": 3}
QUADRATIC = {"CQUAD8": 4, "CTRIA6": 3}
KINDS = (*LINEAR, *QUADRATIC)

Corners = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Shell:
    """A shell to be written: corner and midside nodes as they go round, and its law.

    axis, normal: (3,) unit vectors, the material's x direction and the side it is measured on.
    """

    element: Any
    nodes: tuple[int, ...]
    law: ShellLaw
    axis: Floats
    normal: Floats


@dataclass(slots=True)
class Edges:
    """Midside node of each edge (corners in ascending order), and how many shells meet there.

    made: midside nodes that the bulk data does not have.
    """

    middles: dict[Corners, int]
    shells: dict[Corners, int]
    made: set[int]

    def is_side(self, edge: Corners) -> bool:
        """Return whether the edge is on the border of the shells."""
        return self.shells.get(edge, 0) == 1


def understand_shells(
    bulk: Any, builder: CalculixText, problems: list[str]
) -> tuple[list[Shell], Edges]:
    """Return all shells of the model; their midside nodes are added."""
    elements = [element for element in bulk.elements.values() if element.type in KINDS]
    edges = Edges(_given_middles(elements), {}, set())
    laws: dict[tuple[int, float | None], ShellLaw | None] = {}
    found = []
    for element in elements:
        nodes = _nodes(element, builder, edges, problems)
        thickness = own_thickness(element, problems)
        key = (element.pid, thickness)
        if key not in laws:
            try:
                laws[key] = law_of(element.pid_ref, thickness)
            except ValueError as reason:
                problems.append(f"{element.pid_ref.type} {element.pid}: {reason}")
                laws[key] = None
        law = laws[key]
        if law is None or not nodes:
            continue
        if element.zoffset:
            law = replace(law, offset=float(element.zoffset))
        axis, normal = material_axes(element, problems)
        found.append(Shell(element, nodes, law, axis, normal))
    return found, edges


def own_thickness(element: Any, problems: list[str]) -> float | None:
    """Return the thickness of an element, None where its property gives it."""
    count = LINEAR.get(element.type) or QUADRATIC[element.type]
    given = [getattr(element, f"T{corner}", None) for corner in range(1, count + 1)]
    card = element.pid_ref
    if card.type != "PSHELL" or not card.t or all(value is None for value in given):
        return None
    factor = card.t if element.tflag else 1.0
    full = [card.t if value is None else value * factor for value in given]
    if max(full) - min(full) > 1e-6 * card.t:
        problems.append(
            f"{element.type} {element.eid}: corner thicknesses {given} that differ are not "
            "translated"
        )
    return float(full[0])


def _given_middles(shells: list[Any]) -> dict[Corners, int]:
    edges: dict[Corners, int] = {}
    for element in shells:
        if element.type in QUADRATIC:
            middles = element.node_ids[QUADRATIC[element.type] :]
            # A quadratic shell may lack some; the list may then be shorter, too.
            for edge, middle in zip(edges_of(element), middles, strict=False):
                if middle:
                    edges[edge] = middle
    return edges


def edges_of(element: Any) -> list[Corners]:
    """Return the edges of a shell, as its nodes go round."""
    count = LINEAR.get(element.type) or QUADRATIC[element.type]
    corners = element.node_ids[:count]
    ends = zip(corners, (*corners[1:], corners[0]), strict=True)
    return [(a, b) if a < b else (b, a) for a, b in ends]


def _nodes(
    element: Any, builder: CalculixText, edges: Edges, problems: list[str]
) -> tuple[int, ...]:
    """Return corner and midside nodes.

    Missing midside nodes are made. Empty where a corner repeats.
    """
    count = LINEAR.get(element.type) or QUADRATIC[element.type]
    corners = element.node_ids[:count]
    if None in corners or len(set(corners)) < count:
        problems.append(
            f"{element.type} {element.eid}: its corners {corners} are not all different"
        )
        return ()
    middles = []
    for edge in edges_of(element):
        edges.shells[edge] = edges.shells.get(edge, 0) + 1
        if edge not in edges.middles:
            centre = (builder.coordinates[edge[0]] + builder.coordinates[edge[1]]) / 2.0
            edges.middles[edge] = builder.new_node(centre)
            edges.made.add(edges.middles[edge])
        middles.append(edges.middles[edge])
    return (*corners, *middles)


def material_axes(element: Any, problems: list[str]) -> tuple[Floats, Floats]:
    """Return material x direction and normal of a shell, unit vectors in basic coordinates."""
    count = LINEAR.get(element.type) or QUADRATIC[element.type]
    corners = [np.asarray(node.get_position()) for node in element.nodes_ref[:count]]
    side = corners[1] - corners[0]
    across = corners[2] - corners[0]
    normal = np.cross(across, corners[3] - corners[1]) if count == 4 else np.cross(side, across)
    area = float(np.linalg.norm(normal))
    if not side.any() or not area > 1e-12 * float(np.linalg.norm(side) * np.linalg.norm(across)):
        problems.append(f"{element.type} {element.eid}: its corners span no area")
        return np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    normal = normal / area
    angle = 0.0
    if isinstance(element.theta_mcid, float):
        angle = float(np.radians(element.theta_mcid))
    elif isinstance(element.theta_mcid, int):
        if element.theta_mcid_ref is not None and element.theta_mcid_ref.type[-1] != "R":
            problems.append(
                f"{element.type} {element.eid}: MCID {element.theta_mcid} is not a "
                "rectangular system"
            )
        frame = element.theta_mcid_ref
        side = np.array([1.0, 0.0, 0.0]) if frame is None else np.asarray(frame.beta()[0])
    first = side - (side @ normal) * normal
    length = float(np.linalg.norm(first))
    if length < 1e-6 * float(np.linalg.norm(side)):
        problems.append(f"{element.type} {element.eid}: its material x axis is along its normal")
        first, length = corners[1] - corners[0], float(np.linalg.norm(corners[1] - corners[0]))
    first = first / length
    return np.cos(angle) * first + np.sin(angle) * np.cross(normal, first), normal


@dataclass(frozen=True, slots=True)
class Brick:
    """One brick of a shell. lever: c, or None of a bending brick, whose levers are z.

    plane: (3, 3), shear: (2, 2), laws of the material; density: of volume, without WTMASS.
    """

    lever: float | None
    plane: Floats
    shear: Floats
    density: float


def bricks_of(shell: Shell, height: float, lumped: bool) -> list[Brick]:
    """Return the bricks that together have the stiffness and the mass of a shell."""
    law, none = shell.law, np.zeros((2, 2))
    density = 0.0 if lumped else law.mass / height
    middle, bending = law.offset, law.bending
    found = []
    if law.coupling.any():
        arm = law.thickness / 4.0
        half, more = law.membrane / 2.0, law.coupling / (2.0 * arm)
        found.append(Brick(middle + arm, (half + more) / height, none, density / 2.0))
        found.append(Brick(middle - arm, (half - more) / height, none, density / 2.0))
        bending = bending - arm**2 * law.membrane
    elif law.membrane.any() or density:
        found.append(Brick(middle, law.membrane / height, none, density))
    if law.bends or law.coupling.any():
        found.append(Brick(None, bending * 12.0 / height**3, law.shear / height, 0.0))
    return found


def material_lines(brick: Brick, wtmass: float) -> tuple[str, ...]:
    """Return the cards of a brick's material."""
    plane, shear = brick.plane, brick.shear
    numbers = np.zeros(21)
    numbers[[0, 1, 2, 6, 7, 9]] = plane[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]
    numbers[[14, 19, 20]] = shear[[0, 0, 1], [0, 1, 1]]
    lines = ["*ELASTIC, TYPE=ANISO"]
    lines += [number_list(numbers[start : start + 8]) for start in (0, 8, 16)]
    if brick.density:
        lines += ["*DENSITY", number_list((brick.density * wtmass,))]
    return tuple(lines)


def law_key(element: Any) -> Hashable:
    """Return the key of a shell's law, which also identifies the source of its density."""
    return (element.pid, own_thickness(element, []), element.tflag, element.zoffset)


def shell_densities(shells: Sequence[Shell]) -> dict[Hashable, float]:
    """Return the mass per unit of area of each law, without WTMASS."""
    return {law_key(shell.element): shell.law.mass for shell in shells}


def lumped_shells(
    shells: Sequence[Shell], builder: CalculixText, properties: frozenset[int]
) -> list[LumpedElement]:
    """Return shells of these properties, whose masses are lumped."""
    found = []
    for shell in shells:
        if shell.element.pid in properties:
            nodes = shell.nodes[: len(shell.nodes) // 2]
            corners = np.array([builder.coordinates[node] for node in nodes])
            kind = "S4" if len(nodes) == 4 else "S3"
            offset = shell.law.offset * shell.normal
            found.append(LumpedElement(law_key(shell.element), kind, nodes, corners, offset))
    return found


@dataclass(frozen=True, slots=True)
class WrittenShells:
    """What the laws of a model's shells became.

    laws: of each law that shells have a shell, the names of its bricks' materials, and what of it
    decides on more than their numbers. lumped: properties whose masses are in groups, by the
    densities of their sources.
    """

    height: float
    size: float
    wtmass: float
    lumped: frozenset[int]
    laws: dict[Hashable, tuple[Shell, tuple[str, ...], tuple[object, ...]]]
    groups: dict[str, Shares]
    densities: dict[Hashable, float]

    def edited(self, bulk: Any) -> dict[str, tuple[str, ...]] | None:
        """Return the numbers of all materials and masses of the shells, by their names.

        bulk: the model whose properties have other numbers now. None where more than these follow
        from the numbers: other bricks, or a law for some of those elements alone that had one in
        common.
        """
        found: dict[str, tuple[str, ...]] = {}
        owners: set[tuple[int, str]] = set()
        densities = dict(self.densities)
        for key, (shell, names, shape) in self.laws.items():
            element = bulk.elements[shell.element.eid]
            try:
                law = law_of(element.pid_ref, own_thickness(element, []))
            except ValueError:
                return None
            law = replace(law, offset=shell.law.offset) if element.zoffset else law
            now = replace(shell, law=law)
            bricks = bricks_of(now, self.height, element.pid in self.lumped)
            if shape_of(now, bricks) != shape:
                return None
            densities[key] = law.mass
            for name, brick in zip(names, bricks, strict=True):
                owners.add((element.pid, name))
                lines = material_lines(brick, self.wtmass)
                if found.setdefault(name, lines) != lines:
                    return None
        # Two materials of a property that are one now would have one name.
        if len({(pid, found[name]) for pid, name in owners}) != len(owners):
            return None
        for name, shares in self.groups.items():
            found |= group_lines(name, mass_of(shares, densities) * self.wtmass, self.size)
        return found


def shape_of(shell: Shell, bricks: Sequence[Brick]) -> tuple[object, ...]:
    """Return the properties of a shell's law that decide on more than numbers of materials."""
    levers = [(brick.lever, bool(brick.density)) for brick in bricks]
    return (shell.law.bends, shell.law.stretches, shell.law.offset, bool(shell.law.mass), *levers)


#: Height of the bricks as a share of the usual edge: what the comparison of masses sees of it, in
#: the inertia of a single element, is its square.
HEIGHT = 0.01
#: Digits by which normals, levers and directions differ.
DIGITS = 9


def write_shells(
    model: Assembly,
    shells: Sequence[Shell],
    edges: Edges,
    held: set[int],
    groups: dict[str, Shares],
    densities: dict[Hashable, float],
) -> WrittenShells:
    """Add all shells of the model; after all else that is tied to their nodes.

    held: grid points that something besides shells holds. groups: of lumped masses, with densities
    of their sources.
    """
    height = HEIGHT * _usual_edge(shells, model.builder) if shells else 0.0
    size, lumped = model.builder.size, model.lumped_properties
    written = WrittenShells(height, size, model.wtmass, lumped, {}, groups, densities)
    if not shells:
        return written
    turned = frozenset(model.freedoms.turn_nodes)
    writer = BrickWriter(model.builder, height, model.wtmass)
    bricks: dict[Hashable, list[Brick]] = {}
    for shell in shells:
        key, pid = law_key(shell.element), shell.element.pid
        if key not in bricks:
            parts = bricks[key] = bricks_of(shell, height, pid in lumped)
            names = tuple(writer.material(pid, brick) for brick in parts)
            written.laws[key] = (shell, names, shape_of(shell, parts))
        for brick, name in zip(bricks[key], written.laws[key][1], strict=True):
            writer.add(shell, brick, name, model.sets_of(shell.element))
    writer.write(model.freedoms)
    hold_rest(shells, edges, model.freedoms, turned, held)
    return written


def _usual_edge(shells: Sequence[Shell], builder: CalculixText) -> float:
    edges = [builder.coordinates[s.nodes[1]] - builder.coordinates[s.nodes[0]] for s in shells]
    return float(np.median(np.linalg.norm(edges, axis=1)))


class BrickWriter:
    """Writes bricks; those of one plane share nodes, those of one law and direction a section."""

    def __init__(self, builder: CalculixText, height: float, wtmass: float) -> None:
        self._builder = builder
        self.height = height
        self._wtmass = wtmass
        self._bricks: list[tuple[Shell, float, str, Sequence[str]]] = []
        self._materials: dict[tuple[int, tuple[str, ...]], str] = {}
        self._sections: dict[tuple[object, ...], str] = {}

    def material(self, pid: int, brick: Brick) -> str:
        """Return the name of a brick's material.

        Of each property its own, whose numbers may change.
        """
        lines = material_lines(brick, self._wtmass)
        key = (pid, lines)
        if key not in self._materials:
            self._materials[key] = f"L{len(self._materials) + 1}"
            self._builder.material(self._materials[key], lines)
        return self._materials[key]

    def add(self, shell: Shell, brick: Brick, material: str, sets: Sequence[str]) -> None:
        """Note one brick of a shell, of these sets."""
        lever = np.nan if brick.lever is None else brick.lever
        self._bricks.append((shell, lever, material, sets))

    def write(self, freedoms: Freedoms) -> None:
        """Write all bricks, and the equations of their nodes."""
        by_corners = [[b for b in self._bricks if len(b[0].nodes) == 2 * n] for n in (4, 3)]
        there = [bricks for bricks in by_corners if bricks]
        parts = [self._corners(bricks) for bricks in there]
        corners = BrickPoints(*map(np.concatenate, zip(*parts, strict=True)))
        numbers = self._numbers(corners, freedoms)
        stop = 0
        for bricks in there:
            kind, count = ("C3D20R", 20) if len(bricks[0][0].nodes) == 8 else ("C3D15", 15)
            start, stop = stop, stop + count * len(bricks)
            sections = self._named_sections(bricks)
            nodes = numbers[start:stop].reshape(-1, count).tolist()
            for brick, row, section in zip(bricks, nodes, sections, strict=True):
                self._builder.new_element(kind, row, (*brick[3], section))

    def _corners(self, bricks: Sequence[tuple[Shell, float, str, Sequence[str]]]) -> BrickPoints:
        """Return the corners and edge points of bricks on shells of equally many nodes."""
        nodes = np.array([shell.nodes for shell, *_ in bricks])
        count = nodes.shape[1] // 2
        normals = np.array([shell.normal for shell, *_ in bricks])
        beside = np.array([[self._builder.coordinates[n] for n in row] for row in nodes.tolist()])
        beside -= beside[:, :count].mean(axis=1, keepdims=True)
        down = -np.einsum("snx,sx->sn", beside, normals)
        down[np.abs(down) < 1e-9 * self._builder.size] = 0.0
        low, high = -self.height / 2.0, self.height / 2.0
        rows = [(low, 0), (high, 0), (low, 1), (high, 1), (0.0, 0)]
        places = [p for _, m in rows for p in range(m * count, (m + 1) * count)]
        heights = np.repeat([z for z, _ in rows], count)
        levers = np.array([lever for _, lever, *_ in bricks])
        return BrickPoints(
            nodes[:, places].ravel(),
            np.repeat(np.round(normals, DIGITS) + 0.0, len(places), axis=0),
            np.round(down, 12)[:, places].ravel() + 0.0,
            np.tile(heights, len(bricks)),
            np.repeat(levers, len(places)),
        )

    def _numbers(self, corners: BrickPoints, freedoms: Freedoms) -> Integers:
        """Make and tie the bricks' nodes, one for all corners that are alike; returns theirs."""
        first, same = corners.alike()
        corners = BrickPoints._make(column[first] for column in corners)
        coordinates = self._builder.coordinates
        places = np.array([coordinates[node] for node in corners.nodes.tolist()])
        away = corners.down + corners.heights + np.nan_to_num(corners.levers)
        arms = corners.arms
        turning = np.zeros(len(places), dtype=np.int64)
        for row in np.flatnonzero(arms).tolist():
            rotations = freedoms.rotations(int(corners.nodes[row]))
            turning[row] = rotations[0][0] if rotations else 0
        numbers = self._builder.new_nodes(places + away[:, None] * corners.normals)
        # Factors of the node itself, then of displacements and rotations: (nodes, axes, 7).
        factors = np.zeros((len(places), 3, 7))
        factors[:, :, 0] = 1.0
        bends = np.isnan(corners.levers)
        whole = np.einsum("ni,nj->nij", corners.normals, corners.normals)
        factors[:, :, 1:4] = -np.where(bends[:, None, None], whole, np.eye(3))
        # Displacement along each basic axis: of theta x n it is theta . (n x axis).
        x, y, z = (arms * (turning > 0))[None, :] * corners.normals.T
        factors[:, 0, 5], factors[:, 0, 6] = -z, y
        factors[:, 1, 4], factors[:, 1, 6] = z, -x
        factors[:, 2, 4], factors[:, 2, 5] = -y, x
        owners = np.stack([numbers, *3 * [corners.nodes], *3 * [turning]], axis=1)
        self._builder.equations(owners, factors)
        return numbers[same]

    def _named_sections(
        self, bricks: Sequence[tuple[Shell, float, str, Sequence[str]]]
    ) -> list[str]:
        """Return the sections of bricks, by material and direction.

        Those that are new are written.
        """
        first = np.array([shell.axis for shell, *_ in bricks])
        normals = np.round([shell.normal for shell, *_ in bricks], DIGITS) + 0.0
        axes = np.round(np.hstack([first, np.cross(normals, first)]), DIGITS) + 0.0
        keys = [(brick[2], *row) for brick, row in zip(bricks, axes.tolist(), strict=True)]
        for key in keys:
            if key not in self._sections:
                name = self._sections[key] = f"S{len(self._sections) + 1}"
                head = f"*ORIENTATION, NAME=O{name}, SYSTEM=RECTANGULAR"
                self._builder.card([head, number_list(key[1:])])
                self._builder.section(
                    [f"*SOLID SECTION, ELSET={name}, MATERIAL={key[0]}, ORIENTATION=O{name}"]
                )
        return [self._sections[key] for key in keys]


class BrickPoints(NamedTuple):
    """Corners and edge points of bricks, (n,) each, normals (n, 3).

    down: from the shell's node to the mean plane; heights: over it; levers: NaN of bending bricks.
    """

    nodes: Integers
    normals: Floats
    down: Floats
    heights: Floats
    levers: Floats

    @property
    def arms(self) -> Floats:
        """What rotations are multiplied with."""
        bends = np.isnan(self.levers)
        return np.where(bends, self.heights, np.round(self.down + self.levers, 12)) + 0.0

    def alike(self) -> tuple[Integers, Integers]:
        """Return the first rows of equal ones, ascending, and the place there of each row."""
        bends = np.isnan(self.levers)
        key = np.zeros(len(self.nodes), dtype=np.int64)
        for column in (self.nodes, *self.normals.T, self.down, self.heights, self.arms, bends):
            values, ids = np.unique(column, return_inverse=True)
            key = np.unique(key * len(values) + ids, return_inverse=True)[1]
        _, first, same = np.unique(key, return_index=True, return_inverse=True)
        order = np.argsort(first)
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        return first[order], rank[same]


#: Shells whose normals are nearer than this (cosine, 5 degrees) hold no rotation about them.
FLAT = 0.9962
#: Normals nearer than this are those of one plane.
SAME_PLANE = 1.0 - 1e-10
#: Lever arms below this share of the model's size hold nothing.
HELD = 1e-5


def hold_rest(
    shells: Sequence[Shell],
    edges: Edges,
    freedoms: Freedoms,
    turned: frozenset[int],
    held: set[int],
) -> None:
    """Hold what the shells leave free; turned: nodes where anything but shells has rotations."""
    around: dict[int, list[int]] = {}
    for place, shell in enumerate(shells):
        for node in shell.nodes:
            around.setdefault(node, []).append(place)
    middles = {middle: edge for edge, middle in edges.middles.items() if middle in edges.made}
    normals = np.array([shell.normal for shell in shells])
    near = np.concatenate([np.array(places) for places in around.values()])
    starts = np.cumsum([0, *(len(places) for places in around.values())])[:-1]
    firsts = np.repeat(near[starts], np.diff([*starts, len(near)]))
    cosines = np.abs(np.einsum("ni,ni->n", normals[near], normals[firsts]))
    least = dict(zip(around, np.minimum.reduceat(cosines, starts).tolist(), strict=True))
    axes: dict[int, Floats] = {}
    for node, places in around.items():
        if least[node] > FLAT and any(shells[place].law.bends for place in places):
            axis = shells[places[0]].normal
            own = freedoms.along(freedoms.rotations(node), axis)
            lever = np.abs(freedoms.holds(node) @ axis).max(initial=0.0)
            if _is_loose(freedoms, own) and lever <= HELD * freedoms.builder.size:
                axes[node] = axis
    mean = [node for node in axes if node in turned or least[node] <= SAME_PLANE]
    others = {node: {n for p in around[node] for n in shells[p].nodes} - {node} for node in mean}
    forms = _mean_rotations(freedoms, others, axes)
    for node, places in around.items():
        if node in axes:
            rotations = freedoms.rotations(node)
            row = difference(freedoms.along(rotations, axes[node]), forms.get(node, {}))
            freedoms.tie([row], rotations, f"rotation of {node} in its plane")
        if node not in held and least[node] > FLAT:
            _hold_loose(freedoms, node, [shells[p] for p in places], middles.get(node, ()))


def _hold_loose(
    freedoms: Freedoms, node: int, near: Sequence[Shell], ends: tuple[int, ...]
) -> None:
    """Hold the directions in which shells of one plane have no stiffness, as AUTOSPC does.

    ends: the corners next to a midside node, which moves as their mean.
    """
    axes = []
    if not any(shell.law.stretches for shell in near):
        axes += [near[0].axis, np.cross(near[0].normal, near[0].axis)]
    if not any(shell.law.bends for shell in near):
        axes += [near[0].normal]
    for axis in axes:
        own = freedoms.along(freedoms.translations(node), axis)
        if _is_loose(freedoms, own):
            mean = [freedoms.along(freedoms.translations(end), 0.5 * axis) for end in ends]
            form = difference(own, total(mean))
            freedoms.tie([form], list(own), f"displacement of {node} across its shells")


def _is_loose(freedoms: Freedoms, form: Form) -> bool:
    """Return whether some freedom of the form is neither fixed nor dependent."""
    return any(not freedoms.is_dependent(f) and not freedoms.builder.is_fixed(*f) for f in form)


def _mean_rotations(
    freedoms: Freedoms, near: dict[int, set[int]], axes: dict[int, Floats]
) -> dict[int, Form]:
    """Return the rotations of nodes about axes that best fit the displacements near them."""
    if not near:
        return {}
    coordinates = freedoms.builder.coordinates
    others = [sorted(nodes) for nodes in near.values()]
    counts = np.array([len(nodes) for nodes in others])
    starts = np.cumsum(counts) - counts
    arms = np.array([coordinates[node] for nodes in others for node in nodes])
    arms -= np.repeat([coordinates[node] for node in near], counts, axis=0)
    outer = np.add.reduceat(np.einsum("ni,nj->nij", arms, arms), starts)
    spread = np.trace(outer, axis1=1, axis2=2)[:, None, None] * np.eye(3) - outer
    turning = np.linalg.solve(spread, np.array([axes[node] for node in near])[:, :, None])
    factors = np.cross(np.repeat(turning[:, :, 0], counts, axis=0), arms)
    own = -np.add.reduceat(factors, starts)
    forms = {}
    for node, nodes, start, last in zip(near, others, starts.tolist(), own.tolist(), strict=True):
        rows = factors[start : start + len(nodes)].ravel().tolist()
        freedoms_near = [(other, c) for other in (*nodes, node) for c in (1, 2, 3)]
        forms[node] = trimmed(dict(zip(freedoms_near, (*rows, *last), strict=True)))
    return forms


def hold_leaders(freedoms: Freedoms, leaders: set[int]) -> None:
    """Fix what no element hinders of the rotations of rigid elements' independent points.

    As AUTOSPC does; leaders: those without shells and without beams or springs on rotations.
    """
    for node in leaders:
        rotations = freedoms.rotations(node)
        if all(freedoms.is_dependent(f) or freedoms.builder.is_fixed(*f) for f in rotations):
            continue
        holds = freedoms.holds(node)
        _, sizes, axes = np.linalg.svd(np.vstack([holds, np.zeros((3, 3))]))
        free = axes[sizes < HELD * freedoms.builder.size]
        rows = [freedoms.along(rotations, axis) for axis in free]
        freedoms.tie(rows, rotations, f"rotation of {node}")
