"""Mass, centre of gravity and inertia on both sides of a translation, and their comparison.

The Nastran side comes from the cards, element by element, with consistent masses. The CalculiX side
comes from the elements, sections and densities of the finished deck. Mass, centre and inertia must
each agree within 0.1 %.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from modetune.adapters.calculix.deck import KeywordDeck
from modetune.adapters.nastran.masses import PointMass
from modetune.adapters.translation.assembly import Assembly, Freedoms
from modetune.adapters.translation.beams import KINDS as BARS
from modetune.adapters.translation.beams import RODS, beam_of
from modetune.adapters.translation.calculix_text import CalculixText
from modetune.adapters.translation.concentrated_masses import POINT, SCALAR_MASS
from modetune.adapters.translation.shells import Shell
from modetune.adapters.translation.solids import KINDS as SOLIDS
from modetune.adapters.translation.solids import PYRAMIDS
from modetune.core.element_geometry import SHAPES, Points, integration_points
from modetune.core.errors import ModelError
from modetune.core.modes import Floats

#: Both sides integrate alike; the difference is rounding of the deck's numbers and the small boxes
#: in place of point masses.
TOLERANCE = 1e-3
#: Radius of gyration, as a share of the model's size, below which the boxes' own inertia counts for
#: nothing: one heavy body and little else. They are a thousandth of the size wide.
SMALL = 0.02


@dataclass(frozen=True, slots=True)
class MassProperties:
    """mass; centre: (3,), of gravity; inertia: (3, 3), tensor about the centre. Basic axes.

    slack: of the inertia, what the cards' side leaves out (rotary inertia of beams).
    """

    mass: float
    centre: Floats
    inertia: Floats
    slack: float = 0.0

    def __str__(self) -> str:
        moments = ", ".join(f"{value:.6g}" for value in self.inertia.diagonal())
        centre = ", ".join(f"{value:.6g}" for value in self.centre)
        return f"mass {self.mass:.6g}, centre ({centre}), moments of inertia ({moments})"


@dataclass(frozen=True, slots=True)
class Moments:
    """Integrals over mass: of 1, of the place (3,), of place by place (3, 3), about the origin."""

    mass: float
    first: Floats
    second: Floats
    slack: float = 0.0


def of_point(mass: float, place: Floats, second: Floats | None = None) -> Moments:
    """Return a body at a place.

    second: (3, 3), its own integral of place by place about its centre.
    """
    own = np.zeros((3, 3)) if second is None else second
    return Moments(mass, mass * place, mass * np.outer(place, place) + own)


def of_volume(points: Points, density: Floats) -> Moments:
    """Return the moments of solids; density: (n_elements,)."""
    return _integrated(points.places, points.measures * density[:, None])


def of_surface(points: Points, density: Floats, offset: Floats) -> Moments:
    """Return the moments of shells; density (of area), offset of the mid-surface: (n_elements,)."""
    weights = points.measures * density[:, None]
    return _integrated(points.places + points.normals * offset[:, None, None], weights)


def _integrated(places: Floats, weights: Floats) -> Moments:
    first = np.einsum("ep,epi->i", weights, places)
    second = np.einsum("ep,epi,epj->ij", weights, places, places)
    return Moments(float(weights.sum()), first, second)


def second_moment(inertia: Floats) -> Floats:
    """Return the integral of place by place of a body whose inertia tensor is given."""
    return np.asarray(0.5 * np.trace(inertia) * np.eye(3) - inertia)


def mass_properties(parts: Sequence[Moments]) -> MassProperties:
    """Return the mass properties of all parts together."""
    mass = sum(part.mass for part in parts)
    first = np.sum([part.first for part in parts], axis=0) if parts else np.zeros(3)
    second = np.sum([part.second for part in parts], axis=0) if parts else np.zeros((3, 3))
    centre = first / mass if mass else np.zeros(3)
    about = second - mass * np.outer(centre, centre)
    inertia = np.trace(about) * np.eye(3) - about
    return MassProperties(mass, centre, inertia, sum(part.slack for part in parts))


def check_masses(expected: MassProperties, found: MassProperties, size: float) -> str:
    """Return a sentence on how well both agree; size: of the model, for the centre of gravity.

    Raises ModelError with both sides where they differ by more than 0.1 %.
    """
    scale = float(np.trace(expected.inertia)) + expected.mass * (SMALL * size) ** 2
    apart = float(np.abs(found.inertia - expected.inertia).max()) - expected.slack
    differences = {
        "mass": abs(found.mass - expected.mass) / (abs(expected.mass) or 1.0),
        "centre": float(np.abs(found.centre - expected.centre).max()) / size,
        "inertia": max(apart, 0.0) / scale if scale > 0.0 else 0.0,
    }
    text = ", ".join(f"{name} {100.0 * value:.2g} %" for name, value in differences.items())
    if max(differences.values()) > TOLERANCE:
        raise ModelError(
            f"the translated model's masses are not the Nastran model's (they differ: {text}):\n"
            f"  Nastran:  {expected}\n  CalculiX: {found}"
        )
    return f"{expected}; CalculiX differs by: {text}"


def calculix_mass_properties(builder: CalculixText, deck: KeywordDeck) -> MassProperties:
    """Return mass properties of the model by the sections and densities of its deck.

    Springs have no mass; scalar masses are left out, as they are on the other side.
    """
    densities = _densities(deck)
    groups: dict[tuple[str, bool], list[tuple[float, tuple[int, ...]]]] = {}
    parts: list[Moments] = []
    for card in deck.named("*MASS", "*SOLID SECTION"):
        name = card.option("ELSET")
        if name.startswith(SCALAR_MASS):
            continue
        density = densities.get(card.option("MATERIAL"), 0.0)
        if not (density or card.is_one_of("*MASS")):
            continue
        for number in builder.sets.get(name, []):
            kind, _, nodes = builder.elements[number - 1]
            if card.is_one_of("*MASS"):
                mass = float(deck.fields(card.data[0])[0])
                parts.append(of_point(mass, builder.coordinates[nodes[0]]))
            else:
                group = groups.setdefault((kind.rstrip("IR"), name.endswith(POINT)), [])
                group.append((density, nodes))
    for (kind, is_point), group in groups.items():
        places = np.array([builder.coordinates[node] for _, nodes in group for node in nodes])
        places = places.reshape(len(group), -1, 3)
        points = integration_points(SHAPES[kind], places)
        of_each = np.array([density for density, _ in group])
        if is_point:
            masses = of_each * points.measures.sum(axis=1)
            parts += map(of_point, masses.tolist(), places.mean(axis=1))
        else:
            parts.append(of_volume(points, of_each))
    return mass_properties(parts)


def _densities(deck: KeywordDeck) -> dict[str, float]:
    found, name = dict[str, float](), ""
    for card in deck.cards:
        if card.is_one_of("*MATERIAL"):
            name = card.option("NAME")
        elif card.is_one_of("*DENSITY"):
            found[name] = float(deck.fields(card.data[0])[0])
    return found


def nastran_mass_properties(
    model: Assembly, plates: Sequence[Shell], masses: list[PointMass]
) -> MassProperties:
    """Return mass properties of a model that can be translated; WTMASS is in them."""
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
            if not model.lumped and element.type not in RODS:
                body = of_point(mass * share, beam.place(place, centre))
                yield replace(body, slack=slack)
                continue
            for end, part in ((0.0, 1.0 - place), (1.0, place)):
                body = of_point(mass * share * part, beam.place(end, beam.section.mass(end)[1]))
                yield replace(body, slack=part * slack)
