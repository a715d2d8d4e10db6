"""Where the nodes of a CalculiX deck lie, and what its elements look like.

ccx numbers the nodes of an element in a deck as VTK does (corners, then midside nodes round one
face, round the other, and between the two), but for beams and trusses of three nodes, whose middle
one stands second. Its .frd files have yet another order, which does not matter here.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from modetune.adapters.calculix.deck import KeywordDeck
from modetune.adapters.calculix.mesh import CalculixMesh
from modetune.adapters.calculix.model import read_number
from modetune.core.errors import ModelError
from modetune.core.mesh import NODES, CellKind, Cells, Mesh

#: Element families by what they are drawn as, with their nodes that count; first match wins.
SOLIDS: dict[str, CellKind] = {
    "4": "tetra", "6": "wedge", "8": "hexahedron", "10": "tetra10", "15": "wedge15",
    "20": "hexahedron20",
}  # fmt: skip
SURFACES: dict[str, CellKind] = {"3": "triangle", "4": "quad", "6": "triangle6", "8": "quad8"}
LINES: dict[str, CellKind] = {"1": "line", "2": "line3"}
TRUSSES: dict[str, CellKind] = {"2": "line", "3": "line3"}
#: US3 and S3 alike are shells; plane and axisymmetric elements lie in their plane as shells do.
FAMILIES: tuple[tuple[re.Pattern[str], Mapping[str, CellKind]], ...] = (
    (re.compile(r"C3D(\d+)"), SOLIDS),
    (re.compile(r"(?:U?S|M3D|CPS|CPE|CAX)(\d+)"), SURFACES),
    (re.compile(r"B[23](\d)"), LINES),
    (re.compile(r"T[23]D(\d)"), TRUSSES),
)
OTHERS: dict[str, CellKind] = {
    "SPRINGA": "line", "SPRING2": "line", "DASHPOTA": "line", "GAPUNI": "line",
    "SPRING1": "vertex", "MASS": "vertex", "DCOUP3D": "vertex",
}  # fmt: skip
#: The middle node of these stands second in a deck, third in VTK.
MIDDLE_SECOND: tuple[CellKind, ...] = ("line3",)


def cell_kind(element_type: str) -> CellKind | None:
    """What an element type (upper case) is drawn as; None for those that have no shape here."""
    if element_type in OTHERS:
        return OTHERS[element_type]
    for family, kinds in FAMILIES:
        if found := family.match(element_type):
            return kinds.get(found.group(1))
    return None


def read_geometry(deck: KeywordDeck, mesh: CalculixMesh, result_nodes: frozenset[int]) -> Mesh:
    """Nodes that belong to elements or carry results, and the elements between them.

    Elements of types without a shape (fluid networks, user elements) are left out, their nodes
    stay. No node has axes of its own: results are printed in global axes (GLOBAL=YES), whatever
    *TRANSFORM says. Raises ModelError with file and line.
    """
    places = read_places(deck)
    kinds = {name: cell_kind(name) for name in {item.kind for item in mesh.elements.values()}}
    blocks: dict[CellKind, list[tuple[int, ...]]] = {}
    used = set(result_nodes)
    for number, element in mesh.elements.items():
        there = [node for node in element.nodes if node in places]
        used.update(there)
        kind = kinds[element.kind]
        if kind and len(there) == len(element.nodes) == NODES[kind]:
            blocks.setdefault(kind, []).append((number, *element.nodes))
    numbers = np.array(sorted(used), dtype=np.int64)
    return Mesh(
        nodes=numbers,
        coordinates=np.array([places[node] for node in numbers.tolist()]).reshape(-1, 3),
        cells=tuple(_cells(kind, blocks[kind]) for kind in sorted(blocks)),
    )


def _cells(kind: CellKind, rows: list[tuple[int, ...]]) -> Cells:
    table = np.array(rows, dtype=np.int64)
    nodes = table[:, 1:]
    if kind in MIDDLE_SECOND:
        nodes = nodes[:, [0, 2, 1]]
    return Cells(kind, table[:, 0], nodes)


def read_places(deck: KeywordDeck) -> dict[int, tuple[float, float, float]]:
    """Coordinates of all nodes.

    ccx knows one way to give them, x, y, z in global axes: other programs' SYSTEM option it skips
    with a warning, and so does this. A blank coordinate is zero.
    """
    places = {}
    for card in deck.named("*NODE"):
        for position in card.data:
            number, x, y, z = [*deck.lines[position].text.split(","), "", "", ""][:4]
            try:
                places[int(number)] = _number(x), _number(y), _number(z)
            except ValueError:
                line = deck.lines[position]
                raise ModelError(
                    f"{line.where}: a node's number and coordinates expected, found {line.text!r}"
                ) from None
    return places


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return read_number(text) if text.strip() else 0.0
