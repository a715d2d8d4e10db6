"""Masses at grid points: CONM2 bodies, and the lumped masses of solids and shells.

A corner has what its linear shape function takes of the element's volume or area: mass and centre
of gravity are the element's. With midside nodes such shares are below zero at the corners and the
manuals do not say what Nastran takes instead, so properties of such elements are left as they are.
"""

from __future__ import annotations

from collections.abc import Container, Hashable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from modetune.adapters.nastran.mesh import local_axes
from modetune.core.element_geometry import SHAPES, nodal_measures
from modetune.core.modes import Floats

#: Corners of elements that may have midside nodes, and of solids their shape by four corners up.
CORNERS = {"CHEXA": 8, "CPENTA": 6, "CTETRA": 4, "CPYRAM": 5, "CQUAD8": 4, "CTRIA6": 3}
SOLIDS = {"CHEXA": "CHEXA8", "CPENTA": "CPENTA6", "CTETRA": "CTETRA4", "CPYRAM": "C3D8"}
#: A pyramid is a brick whose upper face is one point.
PYRAMID = (0, 1, 2, 3, 4, 4, 4, 4)
#: Digits of an offset, relative to the largest, by which places differ.
DIGITS = 9


@dataclass(frozen=True, slots=True)
class LumpedElement:
    """An element whose mass is lumped.

    source: of its density; kind: of its shape; nodes, corners (n, 3): where its mass goes;
    offset: (3,), from there to where it moves.
    """

    source: Hashable
    kind: str
    nodes: tuple[int, ...]
    corners: Floats
    offset: Floats


@dataclass(frozen=True, slots=True)
class Lump:
    """Mass at a place (3,) that is carried by a grid point: densities by source, times shares."""

    node: int
    place: Floats
    shares: tuple[tuple[Hashable, float], ...]

    def mass(self, densities: Mapping[Hashable, float]) -> float:
        """Raises KeyError where a source's density is not there."""
        return mass_of(self.shares, densities)


def mass_of(shares: Iterable[tuple[Hashable, float]], densities: Mapping[Hashable, float]) -> float:
    """The mass of volumes or areas by the sources of their densities."""
    return float(sum(densities[source] * measure for source, measure in shares))


def lumped_properties(bulk: Any) -> frozenset[int]:
    """Properties whose elements have no midside nodes."""
    return frozenset(bulk.properties) - {
        element.pid
        for element in bulk.elements.values()
        if any(element.node_ids[CORNERS.get(element.type, len(element.node_ids)) :])
    }


def lumped_solids(bulk: Any, properties: Container[int]) -> list[LumpedElement]:
    """Solids of these properties; the source of a density is the property's number."""
    found = []
    for element in bulk.elements.values():
        if element.type in SOLIDS and element.pid in properties:
            places = PYRAMID if element.type == "CPYRAM" else range(CORNERS[element.type])
            nodes = tuple(element.node_ids[place] for place in places)
            if None in nodes:  # refused elsewhere
                continue
            corners = np.array([element.nodes_ref[place].get_position() for place in places])
            found.append(
                LumpedElement(element.pid, SOLIDS[element.type], nodes, corners, np.zeros(3))
            )
    return found


def solid_densities(bulk: Any, properties: frozenset[int]) -> dict[Any, float]:
    """Of these properties those of solids that have mass, with density; without WTMASS."""
    cards = [bulk.properties[number] for number in sorted(properties)]
    solids = {card.pid: card.mid_ref for card in cards if card.type == "PSOLID"}
    isotropic = {n: each for n, each in solids.items() if each is not None and each.type == "MAT1"}
    return {number: float(each.rho) for number, each in isotropic.items() if each.rho}


def lumps(pieces: Iterable[LumpedElement]) -> list[Lump]:
    """The masses at grid points, one for each place that they carry."""
    by_kind: dict[str, list[LumpedElement]] = {}
    for piece in pieces:
        by_kind.setdefault(piece.kind, []).append(piece)
    places: dict[tuple[int, tuple[float, ...]], Floats] = {}
    shares: dict[tuple[int, tuple[float, ...]], dict[Hashable, float]] = {}
    for kind, members in by_kind.items():
        measures = nodal_measures(SHAPES[kind], np.array([piece.corners for piece in members]))
        for piece, row in zip(members, measures.tolist(), strict=True):
            scale = float(np.abs(piece.offset).max()) or 1.0
            arm = tuple((np.round(piece.offset / scale, DIGITS) * scale + 0.0).tolist())
            for node, corner, measure in zip(piece.nodes, piece.corners, row, strict=True):
                places.setdefault((node, arm), corner + piece.offset)
                own = shares.setdefault((node, arm), {})
                own[piece.source] = own.get(piece.source, 0.0) + measure
    return [Lump(key[0], places[key], tuple(own.items())) for key, own in shares.items()]


@dataclass(frozen=True, slots=True)
class PointMass:
    """A rigid body at a grid point, in basic coordinates and the deck's own unit (no WTMASS).

    centre: (3,), of gravity; inertia: (3, 3), about the centre, as a tensor. eid: of its element,
    0 where it is of several. group: of masses that are always alike.
    """

    eid: int
    node: int
    mass: float
    centre: Floats
    inertia: Floats
    group: str = ""

    @property
    def name(self) -> str:
        """Of its set and material in CalculiX: that of its group, or its own."""
        return self.group or f"CONM2_{self.eid}_{self.node}"


def point_mass(element: Any) -> PointMass:
    """The body of a cross-referenced CONM2."""
    node = element.nid_ref
    place = np.asarray(node.get_position(), dtype=np.float64)
    offset = np.asarray(element.X, dtype=np.float64)
    xx, xy, yy, xz, yz, zz = element.I
    # The card has the products of inertia as positive integrals; the tensor has them negative.
    inertia = np.array([[xx, -xy, -xz], [-xy, yy, -yz], [-xz, -yz, zz]])
    if element.cid == -1:
        return PointMass(element.eid, element.Nid(), element.mass, offset, inertia)
    axes = local_axes(element.cid_ref, place)
    centre = place + offset @ axes
    return PointMass(element.eid, element.Nid(), element.mass, centre, axes.T @ inertia @ axes)
