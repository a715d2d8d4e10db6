"""Mass properties that the Nastran cards say, element by element."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from modetune.adapters.translation.beams import KINDS as BARS
from modetune.adapters.translation.beams import beam_of
from modetune.adapters.translation.element_geometry import SHAPES, Points, integration_points
from modetune.adapters.translation.freedoms import Freedoms
from modetune.adapters.translation.mass_properties import (
    MassProperties,
    Moments,
    mass_properties,
    of_point,
    of_surface,
    of_volume,
    second_moment,
)
from modetune.adapters.translation.masses import PointMass
from modetune.adapters.translation.shells import KINDS as SHELLS
from modetune.adapters.translation.solids import KINDS as SOLIDS
from modetune.core.modes import Floats

CORNERS = {"CQUAD4": 4, "CQUADR": 4, "CQUAD8": 4}


def nastran_mass_properties(
    bulk: Any, masses: list[PointMass], freedoms: Freedoms, wtmass: float
) -> MassProperties:
    """Mass properties of a model that can be translated; WTMASS is in them."""
    solids: dict[str, list[tuple[Floats, float]]] = {}
    shells: dict[str, list[tuple[Floats, float, float, float]]] = {}
    parts = [_point(body, freedoms, wtmass) for body in masses]
    for element in bulk.elements.values():
        if element.type in SOLIDS:
            corners = _places(element, freedoms)
            density = element.pid_ref.mid_ref.rho * wtmass
            solids.setdefault(f"{element.type}{len(corners)}", []).append((corners, density))
        elif element.type in SHELLS:
            corners = _places(element, freedoms)
            kind = "QUAD" if element.type in CORNERS else "TRIA"
            count = 4 if kind == "QUAD" else 3
            if len(corners) not in (count, 2 * count):
                corners = corners[:count]
            shells.setdefault(f"{kind}{len(corners)}", []).append(
                (corners, *_shell(element, wtmass))
            )
        elif element.type in BARS:
            parts += _bar(element, freedoms, wtmass)
    for kind, rows in solids.items():
        parts.append(of_volume(_points(kind, [row[0] for row in rows]), _column(rows, 1)))
    for kind, plates in shells.items():
        columns = [_column(plates, place) for place in (1, 2, 3)]
        parts.append(of_surface(_points(kind, [row[0] for row in plates]), *columns))
    return mass_properties(parts)


def _points(kind: str, corners: list[Floats]) -> Points:
    return integration_points(SHAPES[kind], np.array(corners))


def _column(rows: list[Any], place: int) -> Floats:
    return np.array([row[place] for row in rows], dtype=np.float64)


def _places(element: Any, freedoms: Freedoms) -> Floats:
    return np.array([freedoms.builder.coordinates[node] for node in element.node_ids if node])


def _point(body: PointMass, freedoms: Freedoms, wtmass: float) -> Moments:
    if not freedoms.turns(body.node):
        return of_point(body.mass * wtmass, freedoms.builder.coordinates[body.node])
    own = second_moment(body.inertia) * wtmass
    return of_point(body.mass * wtmass, body.centre, own)


def _shell(element: Any, wtmass: float) -> tuple[float, float, float]:
    """Density, thickness and offset of the mid-surface."""
    card = element.pid_ref
    offset = float(element.zoffset or 0.0)
    if card.type == "PSHELL":
        given = [value for value in (element.T1, element.T2, element.T3) if value is not None]
        thickness = card.t
        if given:
            thickness = given[0] * (card.t if element.tflag else 1.0)
        # Non-structural mass is a density of the property's own thickness, and goes with it.
        return (card.mid1_ref.rho + (card.nsm or 0.0) / card.t) * wtmass, thickness, offset
    times = 2.0 if (card.lam or "").upper() == "SYM" else 1.0
    rows = list(zip(card.mids_ref, card.thicknesses, strict=True))
    thickness = times * sum(value for _, value in rows)
    area = times * sum(material.rho * value for material, value in rows) + (card.nsm or 0.0)
    bottom = -thickness / 2.0 if card.z0 is None else card.z0
    if not element.zoffset:
        offset = bottom + thickness / 2.0
    return area / thickness * wtmass, thickness, offset


def _bar(element: Any, freedoms: Freedoms, wtmass: float) -> Iterator[Moments]:
    """Simpson's rule between stations: exact for linear mass and centre; slack: rotary inertia."""
    beam = beam_of(element, freedoms)
    for start, stop in beam.section.stretches:
        length = (stop - start) * beam.length * wtmass
        for place, weight in ((start, 1.0), (0.5 * (start + stop), 4.0), (stop, 1.0)):
            mass, centre, second = beam.section.mass(place)
            share = weight / 6.0 * length
            body = of_point(mass * share, beam.place(place, centre))
            yield replace(body, slack=float(np.trace(second)) * share)
