"""Nastran shells as CalculiX S8R and S6.

ccx's linear shells are poor (S4 locks in torsion, S4R is far off), so a CQUAD4 or CTRIA3 gets a
midside node on each edge, shared by the elements that share the edge. The stiffness is then that
of a finer element, which is the nearer to Nastran's.

Nastran measures a material angle from side G1-G2 (THETA) or projects the x axis of a coordinate
system (MCID); here each direction becomes an *ORIENTATION of its own, in basic coordinates.

A shell has no stiffness against rotation about its normal; Nastran gives it a little (K6ROT) or
takes it out (AUTOSPC). A mass, a beam or a rigid element on a shell node would turn freely. Here
that rotation is the mean rotation of the shell's surroundings: theta n = sum (n x r_i) u_i / sum |n
x r_i|^2 over the nodes of the adjacent elements, which is exact for rigid motion and stiffens
nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from modetune.adapters.translation.calculix_text import CalculixText, number_list
from modetune.adapters.translation.freedoms import Form, Freedoms, difference
from modetune.adapters.translation.materials import shell_material
from modetune.adapters.translation.plies import Laminate, laminate_of
from modetune.core.modes import Floats

LINEAR = {"CQUAD4": 4, "CQUADR": 4, "CTRIA3": 3, "CTRIAR": 3}
QUADRATIC = {"CQUAD8": 4, "CTRIA6": 3}
KINDS = (*LINEAR, *QUADRATIC)

SetsOf = Callable[[Any], Sequence[str]]
Corners = tuple[int, int]


@dataclass(slots=True)
class Edges:
    """Midside node of each edge (corners in ascending order), and how many shells meet there.

    made: midside nodes that the bulk data does not have. laminated: nodes of laminated shells, of
    which ccx 2.20 can make no rigid knots (it breaks off).
    """

    middles: dict[Corners, int]
    shells: dict[Corners, int]
    made: set[int]
    laminated: set[int]

    def is_side(self, edge: Corners) -> bool:
        """Whether the edge is on the border of the shells."""
        return self.shells.get(edge, 0) == 1


@dataclass(frozen=True, slots=True)
class ShellSection:
    """What elements of one *SHELL SECTION have in common.

    axis: material x direction in basic coordinates and normal, rounded; empty where none matters.
    """

    pid: int
    thickness: float
    offset: float
    axes: tuple[float, ...]


def translate_shells(
    bulk: Any, builder: CalculixText, problems: list[str], wtmass: float, sets_of: SetsOf
) -> Edges:
    """Add all shells of the model; returns the midside node of each edge."""
    shells = [element for element in bulk.elements.values() if element.type in KINDS]
    laminates = _laminates(shells, builder, wtmass, problems)
    edges = Edges(_given_middles(shells), {}, set(), set())
    names: dict[ShellSection, str] = {}
    for element in shells:
        laminate = laminates[element.pid]
        nodes = _nodes(element, builder, edges, problems)
        if laminate is None or not nodes:
            continue
        if laminate.is_composite:
            edges.laminated.update(nodes)
            if len(nodes) == 6:  # ccx 2.20 breaks off
                problems.append(
                    f"{element.type} {element.eid}: CalculiX has no laminated triangles"
                )
        section = _section(element, laminate, problems)
        name = names.setdefault(section, f"S{len(names) + 1}")
        kind = "S8R" if len(nodes) == 8 else "S6"
        builder.new_element(kind, nodes, (*sets_of(element), name))
    for section, name in names.items():
        laminate = laminates[section.pid]
        assert laminate is not None
        _write_section(builder, section, name, laminate)
    return edges


def _laminates(
    shells: list[Any], builder: CalculixText, wtmass: float, problems: list[str]
) -> dict[int, Laminate | None]:
    def material(card: Any, density: float) -> tuple[str, bool]:
        use = shell_material(builder, card, density, wtmass, problems)
        return use.name, use.oriented

    properties = {element.pid: element.pid_ref for element in shells}
    return {pid: laminate_of(card, material, problems) for pid, card in properties.items()}


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


def edge_of(first: int, second: int) -> Corners:
    return (first, second) if first < second else (second, first)


def edges_of(element: Any) -> list[Corners]:
    """The edges of a shell, as its nodes go round."""
    count = LINEAR.get(element.type) or QUADRATIC[element.type]
    corners = element.node_ids[:count]
    return [edge_of(corners[place], corners[(place + 1) % count]) for place in range(count)]


def _nodes(
    element: Any, builder: CalculixText, edges: Edges, problems: list[str]
) -> tuple[int, ...]:
    """Corner and midside nodes; missing midside nodes are made. Empty where a corner repeats."""
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


def _section(element: Any, laminate: Laminate, problems: list[str]) -> ShellSection:
    where = f"{element.type} {element.eid}"
    count = LINEAR.get(element.type) or QUADRATIC[element.type]
    given = [getattr(element, f"T{corner}", None) for corner in range(1, count + 1)]
    thickness = laminate.thickness
    if any(value is not None for value in given):
        factor = thickness if element.tflag else 1.0
        full = [thickness if value is None else value * factor for value in given]
        if max(full) - min(full) > 1e-6 * thickness or laminate.is_composite:
            problems.append(f"{where}: corner thicknesses {given} that differ are not translated")
        thickness = full[0]
    offset = laminate.offset
    if element.zoffset:
        offset = float(element.zoffset)
    axes: tuple[float, ...] = ()
    if laminate.oriented:
        first, normal = material_axes(element, problems)
        axes = tuple(round(float(value), 6) + 0.0 for value in (*first, *normal))
    return ShellSection(element.pid, thickness, offset, axes)


def material_axes(element: Any, problems: list[str]) -> tuple[Floats, Floats]:
    """Material x direction and normal of a shell, unit vectors in basic coordinates."""
    count = LINEAR.get(element.type) or QUADRATIC[element.type]
    corners = [np.asarray(node.get_position()) for node in element.nodes_ref[:count]]
    side = corners[1] - corners[0]
    across = corners[2] - corners[0]
    normal = np.cross(across, corners[3] - corners[1]) if count == 4 else np.cross(side, across)
    normal = normal / np.linalg.norm(normal)
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
    return _turned(first / length, normal, angle), normal


def _turned(first: Floats, normal: Floats, angle: float) -> Floats:
    return np.asarray(np.cos(angle) * first + np.sin(angle) * np.cross(normal, first))


def _write_section(
    builder: CalculixText, section: ShellSection, name: str, laminate: Laminate
) -> None:
    # ccx's OFFSET says where the nodes are seen from the mid-surface, as a fraction of the
    # thickness; ZOFFS says where the mid-surface is seen from the nodes, as a length.
    fraction = -section.offset / section.thickness
    shift = f", OFFSET={fraction:.10g}" if fraction else ""
    first, normal = np.array(section.axes[:3]), np.array(section.axes[3:])
    names = []
    for place, angle in enumerate(dict.fromkeys(ply.angle for ply in laminate.plies)):
        if section.axes:
            axis = _turned(first, normal, float(np.radians(angle)))
            second = np.cross(normal, axis)
            names.append((angle, f"O{name}_{place + 1}"))
            head = f"*ORIENTATION, NAME=O{name}_{place + 1}, SYSTEM=RECTANGULAR"
            builder.card([head, number_list((*axis, *second))])
    orientations = dict(names)
    if not laminate.is_composite:
        ply = laminate.plies[0]
        turn = f", ORIENTATION={orientations[ply.angle]}" if orientations else ""
        head = f"*SHELL SECTION, ELSET={name}, MATERIAL={ply.material}{turn}{shift}"
        builder.section([head, number_list((section.thickness,))])
        return
    rows = [
        f"{number_list((ply.thickness,))}, , {ply.material}"
        + (f", {orientations[ply.angle]}" if orientations else "")
        for ply in laminate.plies
    ]
    builder.section([f"*SHELL SECTION, COMPOSITE, ELSET={name}{shift}", *rows])


#: Shells whose normals are nearer than this (cosine, 5 degrees) hold no rotation about them.
FLAT = 0.9962
#: Lever arms below this share of the model's size hold nothing.
HELD = 1e-5


def hold_drilling(bulk: Any, freedoms: Freedoms, edges: Edges) -> None:
    """Tie the drilling rotation of all shell nodes that carry rotations; after all else."""
    around = _shells_around(bulk, freedoms.builder.knots, edges)
    for node, elements in around.items():
        normals = [_normal(element) for element in elements]
        rotations = freedoms.rotations(node)
        held = all(freedoms.is_dependent(f) or freedoms.builder.is_fixed(*f) for f in rotations)
        flat = all(abs(float(normal @ normals[0])) > FLAT for normal in normals)
        if not held and flat and not _is_held(freedoms, node, normals[0]):
            near = {n for element in elements for n in element.node_ids if n} - {node}
            form = _mean_rotation(freedoms, node, normals[0], near)
            own = freedoms.along(rotations, normals[0])
            freedoms.tie([difference(own, form)], rotations, f"rotation of {node} in its plane")


def _shells_around(bulk: Any, knots: set[int], edges: Edges) -> dict[int, list[Any]]:
    """The shells at each node; those of a midside node have both its corners."""
    around: dict[int, list[Any]] = {}
    for element in bulk.elements.values():
        if element.type in KINDS:
            # An element that was refused has left no middles.
            middles = [edges.middles[edge] for edge in edges_of(element) if edge in edges.middles]
            nodes = [*element.node_ids, *middles]
            for node in knots.intersection(nodes):
                around.setdefault(node, []).append(element)
    return around


def _normal(element: Any) -> Floats:
    return material_axes(element, [])[1]


def _is_held(freedoms: Freedoms, node: int, axis: Floats) -> bool:
    found = np.abs(freedoms.holds(node) @ axis)
    return bool((found > HELD * freedoms.builder.size).any())


def _mean_rotation(freedoms: Freedoms, node: int, normal: Floats, near: set[int]) -> Form:
    centre = freedoms.builder.coordinates[node]
    form: Form = {}
    total = 0.0
    for other in near:
        arm = np.cross(normal, freedoms.builder.coordinates[other] - centre)
        total += float(arm @ arm)
        places = (*freedoms.translations(other), *freedoms.translations(node))
        for (at, component), factor in zip(places, (*arm, *-arm), strict=True):
            form[(at, component)] = form.get((at, component), 0.0) + float(factor)
    return {freedom: factor / total for freedom, factor in form.items() if factor}


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
