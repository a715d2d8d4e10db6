"""Mass properties of the elements that a CalculiX deck holds, from the deck's own text."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from modetune.adapters.calculix.deck import Card, Deck, parse_deck
from modetune.adapters.translation.calculix_text import CalculixText
from modetune.adapters.translation.element_geometry import SHAPES, integration_points
from modetune.adapters.translation.mass_properties import (
    MassProperties,
    Moments,
    mass_properties,
    of_point,
    of_surface,
    of_volume,
)
from modetune.core.modes import Floats


def calculix_mass_properties(builder: CalculixText, text: str) -> MassProperties:
    """Mass properties of the model; text: of the deck, whose sections and densities count.

    Springs and the stubs of knots have no mass to speak of.
    """
    deck = parse_deck(Path("translation"), text)
    densities = _densities(deck)
    kinds = {number: (kind, nodes) for kind, number, nodes in builder.elements}
    parts: list[Moments] = []
    for card in deck.named("*MASS", "*SOLID SECTION", "*SHELL SECTION"):
        groups: dict[str, list[Floats]] = {}
        for number in builder.sets.get(card.option("ELSET"), []):
            kind, nodes = kinds[number]
            places = np.array([builder.coordinates[node] for node in nodes])
            groups.setdefault(kind.removesuffix("I"), []).append(places)
        for kind, places_of in groups.items():
            parts += _group(deck, card, densities, kind, np.array(places_of))
    return mass_properties(parts)


def _group(
    deck: Deck, card: Card, densities: dict[str, float], kind: str, places: Floats
) -> list[Moments]:
    rows = [deck.fields(position) for position in card.data]
    if card.is_one_of("*MASS"):
        return [of_point(float(rows[0][0]), place[0]) for place in places]
    points = integration_points(SHAPES[kind], places)
    many = np.ones(len(places))
    if card.is_one_of("*SOLID SECTION"):
        return [of_volume(points, densities.get(card.option("MATERIAL"), 0.0) * many)]
    if "COMPOSITE" in card.options:
        plies = [(float(row[0]), densities.get(row[2].upper(), 0.0)) for row in rows]
    else:
        plies = [(float(rows[0][0]), densities.get(card.option("MATERIAL"), 0.0))]
    thickness = sum(ply for ply, _ in plies)
    density = sum(ply * rho for ply, rho in plies) / thickness
    offset = -float(card.option("OFFSET") or 0.0) * thickness
    return [of_surface(points, density * many, thickness * many, offset * many)]


def _densities(deck: Deck) -> dict[str, float]:
    found, name = dict[str, float](), ""
    for card in deck.cards:
        if card.is_one_of("*MATERIAL"):
            name = card.option("NAME")
        elif card.is_one_of("*DENSITY"):
            found[name] = float(deck.fields(card.data[0])[0])
    return found
