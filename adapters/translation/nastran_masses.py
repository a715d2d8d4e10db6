"""Mass properties that the Nastran cards say, element by element."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from modetune.adapters.nastran.bodies import PointMass
from modetune.adapters.translation.assembly import Assembly
from modetune.adapters.translation.beams import KINDS as BARS
from modetune.adapters.translation.beams import beam_of
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
from modetune.adapters.translation.shells import Shell
from modetune.adapters.translation.solids import KINDS as SOLIDS
from modetune.adapters.translation.solids import PYRAMIDS
from modetune.core.element_geometry import SHAPES, Points, integration_points
from modetune.core.modes import Floats


def nastran_mass_properties(
    model: Assembly, plates: Sequence[Shell], masses: list[PointMass]
) -> MassProperties:
    """Mass properties of a model that can be translated; WTMASS is in them."""
    freedoms, wtmass = model.freedoms, model.wtmass
    solids: dict[str, list[tuple[Floats, float]]] = {}
    shells: dict[str, list[tuple[Floats, float, float]]] = {}
    parts = [_point(body, freedoms, wtmass) for body in masses]
    for element in model.bulk.elements.values():
        if element.type in SOLIDS and element.pid not in model.lumped_properties:
            at = freedoms.builder.coordinates
            corners = np.array([at[node] for node in element.node_ids if node])
            density = element.pid_ref.mid_ref.rho * wtmass
            kind = f"{element.type}{len(corners)}"
            if element.type == "CPYRAM":
                corners = corners[list(PYRAMIDS[len(corners)])]
                kind = f"C3D{len(corners)}"
            solids.setdefault(kind, []).append((corners, density))
        elif element.type in BARS:
            parts += _bar(model, element)
    for plate in plates:
        if plate.element.pid in model.lumped_properties:
            continue
        corners = np.array([freedoms.builder.coordinates[node] for node in plate.nodes])
        row = (corners, plate.law.mass * wtmass, plate.law.offset)
        shells.setdefault("S8R" if len(corners) == 8 else "S6", []).append(row)
    for kind, rows in solids.items():
        parts.append(of_volume(_points(kind, [row[0] for row in rows]), _column(rows, 1)))
    for kind, places in shells.items():
        points = _points(kind, [row[0] for row in places])
        parts.append(of_surface(points, _column(places, 1), _column(places, 2)))
    return mass_properties(parts)


def _points(kind: str, corners: list[Floats]) -> Points:
    return integration_points(SHAPES[kind], np.array(corners))


def _column(rows: list[Any], place: int) -> Floats:
    return np.array([row[place] for row in rows], dtype=np.float64)


def _point(body: PointMass, freedoms: Freedoms, wtmass: float) -> Moments:
    if not freedoms.turns(body.node):
        return of_point(body.mass * wtmass, freedoms.builder.coordinates[body.node])
    own = second_moment(body.inertia) * wtmass
    return of_point(body.mass * wtmass, body.centre, own)


def _bar(model: Assembly, element: Any) -> Iterator[Moments]:
    """Simpson's rule between stations: exact for linear mass and centre; slack: rotary inertia."""
    beam = beam_of(element, model.freedoms)
    for start, stop in beam.section.stretches:
        length = (stop - start) * beam.length * model.wtmass
        for place, weight in ((start, 1.0), (0.5 * (start + stop), 4.0), (stop, 1.0)):
            mass, centre, second = beam.section.mass(place)
            share = weight / 6.0 * length
            slack = float(np.trace(second)) * share
            if not model.lumped:
                body = of_point(mass * share, beam.place(place, centre))
                yield replace(body, slack=slack)
                continue
            for end, part in ((0.0, 1.0 - place), (1.0, place)):
                body = of_point(mass * share * part, beam.place(end, beam.section.mass(end)[1]))
                yield replace(body, slack=part * slack)
