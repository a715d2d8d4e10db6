"""Damping in a CalculiX deck: *DASHPOT elements, and *DAMPING, STRUCTURAL= of materials.

A DASHPOTA acts along the line between its nodes, as the deck's coordinates have them. ALPHA and
BETA of *DAMPING are of explicit dynamics alone (ccx 2.20), and refused here.
"""

from __future__ import annotations

import numpy as np

from modetune.adapters.calculix.cards import rows_with
from modetune.adapters.calculix.places import fields_of, find_numbers, numbers_on
from modetune.adapters.calculix.structure import CalculixStructure
from modetune.adapters.damping import Coefficients, Dampers, Link, group, losses_of
from modetune.adapters.solver import Deck
from modetune.core.errors import ModelError
from modetune.core.parameters import Parameter


def damped_materials(structure: CalculixStructure) -> tuple[Parameter, ...]:
    """Materials of elements that have a loss factor. Raises ModelError."""
    found = []
    for card in structure.deck.named("*MATERIAL"):
        name = card.option("NAME")
        used = any(structure.members(user) for user in structure.users({name}))
        if used and fields_of(structure, "structural_damping", name, needed=False):
            found.append(group("material", name))
    return tuple(found)


def dampers(structure: CalculixStructure, deck: Deck, parameters: tuple[Parameter, ...]) -> Dampers:
    """All that damps the deck. Raises ModelError with file and line for what is not followed."""
    known = Coefficients(parameters, lambda item: find_numbers(structure, item))
    mesh, links = deck.mesh(), []
    place_of = {node: place for place, node in enumerate(mesh.nodes.tolist())}
    ends = {
        number: nodes
        for cells in mesh.cells
        for number, nodes in zip(cells.elements.tolist(), cells.nodes.tolist(), strict=True)
    }
    cards = [
        (row, c) for row in rows_with("viscous_damping") for c in structure.deck.named(row.name)
    ]
    for row, card in cards:
        members, where = structure.members(card), structure.deck.where(card)
        kinds = {structure.mesh.elements[number].kind for number in members}
        if kinds - {"DASHPOTA"}:
            raise ModelError(
                f"{where}: {row.name} of {min(kinds)} is not DASHPOTA, as ccx takes it"
            )
        (field,) = numbers_on(structure, row, "viscous_damping", card, card.option("ELSET"))
        number = known.of((field.line, field.place), field.value, where)
        for element in sorted(members):
            first, second = ends[element]
            span = mesh.coordinates[place_of[second]] - mesh.coordinates[place_of[first]]
            length = float(np.linalg.norm(span))
            if not length:
                raise ModelError(f"{where}: the nodes of dashpot {element} coincide")
            axis = (span / length).tolist()
            dofs = tuple((node, axis_of) for node in (first, second) for axis_of in (1, 2, 3))
            factors = (*(-value for value in axis), *axis)
            links.append(Link("viscous", dofs, factors, (number,), where))
    groups = damped_materials(structure)
    factors_of, places = [], []
    for item in groups:
        (field,) = fields_of(structure, "structural_damping", item.targets[0])
        places.append(structure.deck.lines[field.line].where)
        factors_of.append(known.of((field.line, field.place), field.value, places[-1]))
    return Dampers(tuple(links), losses_of(deck, parameters, groups, factors_of, places))
