"""Mass, centre of gravity and inertia of both sides of a translation, and their comparison.

The Nastran side is taken from the cards, with the consistent mass of each element. The CalculiX
side is taken from the finished deck's own elements, sections and densities. What the two must agree
in is mass, centre and inertia, each within 0.1 %.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modetune.adapters.calculix.deck import KeywordDeck
from modetune.adapters.translation.calculix_text import CalculixText
from modetune.core.element_geometry import SHAPES, Points, integration_points
from modetune.core.errors import ModelError
from modetune.core.modes import Floats

#: Both sides integrate alike; what is left is rounding of the deck's numbers and the small boxes
#: that stand for point masses.
TOLERANCE = 1e-3
#: What the sets of scalar masses begin with, which have no place.
SCALAR_MASS = "SCALAR_"
#: End of the sets of bricks whose corners all move as their centre does.
POINT = "_POINT"
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
    """A body at a place; second: (3, 3), its own integral of place by place about its centre."""
    own = np.zeros((3, 3)) if second is None else second
    return Moments(mass, mass * place, mass * np.outer(place, place) + own)


def of_volume(points: Points, density: Floats) -> Moments:
    """Solids; density: (n_elements,)."""
    return _integrated(points.places, points.measures * density[:, None])


def of_surface(points: Points, density: Floats, offset: Floats) -> Moments:
    """Shells: density (of area) and offset of the mid-surface, (n_elements,) each."""
    weights = points.measures * density[:, None]
    return _integrated(points.places + points.normals * offset[:, None, None], weights)


def _integrated(places: Floats, weights: Floats) -> Moments:
    first = np.einsum("ep,epi->i", weights, places)
    second = np.einsum("ep,epi,epj->ij", weights, places, places)
    return Moments(float(weights.sum()), first, second)


def second_moment(inertia: Floats) -> Floats:
    """The integral of place by place of a body whose inertia tensor is given."""
    return np.asarray(0.5 * np.trace(inertia) * np.eye(3) - inertia)


def mass_properties(parts: Sequence[Moments]) -> MassProperties:
    """All parts together."""
    mass = sum(part.mass for part in parts)
    first = np.sum([part.first for part in parts], axis=0) if parts else np.zeros(3)
    second = np.sum([part.second for part in parts], axis=0) if parts else np.zeros((3, 3))
    centre = first / mass if mass else np.zeros(3)
    about = second - mass * np.outer(centre, centre)
    inertia = np.trace(about) * np.eye(3) - about
    return MassProperties(mass, centre, inertia, sum(part.slack for part in parts))


def check_masses(expected: MassProperties, found: MassProperties, size: float) -> str:
    """A sentence on how well both agree; size: of the model, for the centre of gravity.

    Raises ModelError with both sides where they differ by more than 0.1 %.
    """
    scale = float(np.trace(expected.inertia)) + expected.mass * (SMALL * size) ** 2
    apart = float(np.abs(found.inertia - expected.inertia).max()) - expected.slack
    differences = {
        "mass": abs(found.mass - expected.mass) / (abs(expected.mass) or 1.0),
        "centre": float(np.abs(found.centre - expected.centre).max()) / size,
        "inertia": max(apart, 0.0) / scale if scale > 0.0 else 0.0,
    }
    said = ", ".join(f"{name} {100.0 * value:.2g} %" for name, value in differences.items())
    if max(differences.values()) > TOLERANCE:
        raise ModelError(
            f"the translated model's masses are not the Nastran model's (they differ: {said}):\n"
            f"  Nastran:  {expected}\n  CalculiX: {found}"
        )
    return f"{expected}; CalculiX differs by: {said}"


def calculix_mass_properties(builder: CalculixText, deck: KeywordDeck) -> MassProperties:
    """Mass properties of the model by the sections and densities of its deck.

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
