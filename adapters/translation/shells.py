"""Which nodes, directions and laws the shells of a Nastran model have.

A CQUAD4 or CTRIA3 gets a midside node on each edge, shared by the elements that share the edge: as
quadratic elements they are as good as Nastran's, which the linear elements of ccx are not.

Nastran measures a material angle from side G1-G2 (THETA) or projects the x axis of a coordinate
system (MCID).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from modetune.adapters.nastran.shell_laws import ShellLaw, law_of
from modetune.adapters.translation.calculix_text import CalculixText
from modetune.core.modes import Floats

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
        """Whether the edge is on the border of the shells."""
        return self.shells.get(edge, 0) == 1


def understand_shells(
    bulk: Any, builder: CalculixText, problems: list[str]
) -> tuple[list[Shell], Edges]:
    """All shells of the model; their midside nodes are added."""
    elements = [element for element in bulk.elements.values() if element.type in KINDS]
    edges = Edges(_given_middles(elements), {}, set())
    laws: dict[tuple[int, float | None], ShellLaw | None] = {}
    found = []
    for element in elements:
        nodes = _nodes(element, builder, edges, problems)
        thickness = own_thickness(element, problems)
        key = (element.pid, thickness)
        if key not in laws:
            laws[key] = _law(element.pid_ref, thickness, problems)
        law = laws[key]
        if law is None or not nodes:
            continue
        if element.zoffset:
            law = replace(law, offset=float(element.zoffset))
        axis, normal = material_axes(element, problems)
        found.append(Shell(element, nodes, law, axis, normal))
    return found, edges


def _law(card: Any, thickness: float | None, problems: list[str]) -> ShellLaw | None:
    try:
        return law_of(card, thickness)
    except ValueError as reason:
        problems.append(f"{card.type} {card.pid}: {reason}")
        return None


def own_thickness(element: Any, problems: list[str]) -> float | None:
    """The thickness that an element has of its own, None where it is its property's."""
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


def material_axes(element: Any, problems: list[str]) -> tuple[Floats, Floats]:
    """Material x direction and normal of a shell, unit vectors in basic coordinates."""
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
    return _turned(first / length, normal, angle), normal


def _turned(first: Floats, normal: Floats, angle: float) -> Floats:
    return np.asarray(np.cos(angle) * first + np.sin(angle) * np.cross(normal, first))
