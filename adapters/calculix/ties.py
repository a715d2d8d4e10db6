"""What *TIE makes of the nodes of its slave surface: sums over the nodes of a master face.

As ccx does, a slave node moves with the nearest point of the master surface, by the shape functions
of the face there. Followed are ties between solids whose slave nodes lie on the master surface or
within the stated POSITION TOLERANCE; ccx's own tolerance, where none is stated, is not known here,
so a gap without one is not followed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import scipy

from modetune.adapters.calculix.deck import KeywordCard, canonical_name, read_number
from modetune.adapters.calculix.mesh import read_places
from modetune.adapters.calculix.structure import CalculixStructure
from modetune.core.element_geometry import FACES, ElementShape, face_nodes, nearest_on_faces
from modetune.core.errors import ModelError
from modetune.core.mesh import CellKind
from modetune.core.modes import Floats

#: A node this near to the surface lies on it, as a share of the face's size.
ON_SURFACE = 1e-3
#: A distance this far from the tolerance, as a share of it, is surely within or beyond.
SURE = 0.05
#: More faces are asked for the nearest point, against rounding.
NEAR = 1e-9
#: Weights below this are rounding.
NOTHING = 1e-12
#: Solids by their number of nodes, and their corners.
SOLIDS: dict[int, tuple[CellKind, int]] = {
    4: ("tetra", 4), 10: ("tetra10", 4), 6: ("wedge", 6), 15: ("wedge15", 6),
    8: ("hexahedron", 8), 20: ("hexahedron20", 8),
}  # fmt: skip

#: Coordinates of nodes.
Places = Mapping[int, tuple[float, float, float]]
#: Nodes of a face, and its shape.
Face = tuple[tuple[int, ...], ElementShape]


def tie_terms(
    structure: CalculixStructure, sets: dict[str, set[int]]
) -> dict[int, dict[int, float]] | None:
    """Return the factors of master nodes for each tied node, the same in all directions.

    sets: nodes of each set. None where a tie is not followed.
    """
    found: dict[int, dict[int, float]] = {}
    cards = structure.deck.named("*TIE")
    places = read_places(structure.deck) if cards else {}
    for card in cards:
        terms = card_terms(structure, card, sets, places)
        if terms is None:
            return None
        found = terms | found
    return found


def card_terms(
    structure: CalculixStructure, card: KeywordCard, sets: dict[str, set[int]], places: Places
) -> dict[int, dict[int, float]] | None:
    """Return the same of one *TIE; places: of all nodes."""
    try:
        return _terms(structure, card, sets, places)
    except (IndexError, KeyError, ValueError, ModelError):
        return None


def _terms(
    structure: CalculixStructure, card: KeywordCard, sets: dict[str, set[int]], places: Places
) -> dict[int, dict[int, float]] | None:
    slave, master = structure.deck.fields(card.data[0])[:2]
    if {"CYCLICSYMMETRY", "MULTISTAGE"} & set(card.options):
        return None
    nodes, (_, faces) = _surface(structure, slave, sets)[0], _surface(structure, master, sets)
    tolerance = read_number(card.option("POSITIONTOLERANCE") or "0.")
    kept = sorted(node for node in nodes if node in places)
    if not kept or not faces:
        return None
    points = np.array([places[node] for node in kept])
    weights, distances, owners = _nearest(points, faces, places)
    found = {}
    for node, values, distance, owner in zip(kept, weights, distances, owners, strict=True):
        own = faces[owner][0]
        size = math.dist(places[own[0]], places[own[1]])
        if distance > ON_SURFACE * size and abs(distance - tolerance) <= SURE * tolerance:
            return None
        if distance > max(ON_SURFACE * size, tolerance):
            if not tolerance:
                return None
            continue  # too far: ccx leaves it free
        if node in own:
            continue
        found[node] = {n: float(v) for n, v in zip(own, values, strict=True) if abs(v) > NOTHING}
    return found


def _surface(
    structure: CalculixStructure, name: str, sets: dict[str, set[int]]
) -> tuple[set[int], list[Face]]:
    """Return the nodes of a surface, and its faces. Raises ValueError for other than solids."""
    nodes, faces = set[int](), list[Face]()
    for card in structure.deck.named("*SURFACE"):
        if card.option("NAME") != canonical_name(name):
            continue
        for position in card.data:
            fields = [field for field in structure.deck.fields(position) if field]
            if card.option("TYPE") == "NODE":
                nodes |= {int(f) for f in fields if f.isdecimal()}
                nodes |= set().union(
                    *(sets[canonical_name(f)] for f in fields if not f.isdecimal())
                )
                continue
            for number in sorted(structure.mesh.named(fields[0])):
                faces.append(_face(structure, number, fields[1]))
                nodes |= set(faces[-1][0])
    return nodes, faces


def _face(structure: CalculixStructure, number: int, label: str) -> Face:
    element = structure.mesh.elements[number]
    if not element.kind.startswith("C3D") or not label.upper().startswith("S"):
        raise ValueError(f"{label} of element {number} is no face of a solid")
    kind, corners = SOLIDS[len(element.nodes)]
    places, shape = face_nodes(kind, FACES[corners][int(label[1:]) - 1])
    return tuple(element.nodes[place] for place in places), shape


def _nearest(
    points: Floats, faces: list[Face], places: Places
) -> tuple[list[Floats], Floats, list[int]]:
    """Return the shape functions, the distance and the face of the nearest point of each point.

    The nearest face has its middle no farther than the nearest middle and the largest face's
    radius.
    """
    corners = [np.array([places[node] for node in nodes]) for nodes, _ in faces]
    middles = np.array([own.mean(axis=0) for own in corners])
    radius = max(
        float(np.linalg.norm(own - middle, axis=1).max())
        for own, middle in zip(corners, middles, strict=True)
    )
    tree = scipy.spatial.KDTree(middles)
    near = tree.query_ball_point(points, (1.0 + NEAR) * (tree.query(points)[0] + radius))
    pairs: dict[int, list[tuple[int, int]]] = {}
    for row, own in enumerate(near):
        for place in own:
            pairs.setdefault(len(corners[place]), []).append((row, place))
    best = np.full(len(points), np.inf)
    weights, owners = [np.zeros(0)] * len(points), [0] * len(points)
    for some in pairs.values():
        rows, asked = map(list, zip(*some, strict=True))
        shape = faces[asked[0]][1]
        there = np.array([corners[place] for place in asked])
        values, distances = nearest_on_faces(shape, there, points[rows])
        for row, place, value, distance in zip(rows, asked, values, distances, strict=True):
            if distance < best[row]:
                best[row], weights[row], owners[row] = distance, value, place
    return weights, best, owners
