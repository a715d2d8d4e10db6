"""What the sections of a CalculiX deck say of its masses, sizes and speeds of waves."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress

from modetune.adapters.calculix.cards import CARDS, first_value
from modetune.adapters.calculix.deck import KeywordCard, canonical_name, read_number
from modetune.adapters.calculix.model import CalculixModel
from modetune.adapters.calculix.places import fields_of
from modetune.adapters.solver import Target
from modetune.core.errors import ModelError
from modetune.core.parameters import TargetKind


def point_mass(model: CalculixModel, changed: dict[int, str]) -> float:
    """Sum of all *MASS elements, which ccx leaves out of its own total.

    NaN beside user elements, of which ccx prints no mass.
    """
    total = math.nan if model.deck.named("*USER SECTION") else 0.0
    for card in model.deck.named("*MASS"):
        field = first_value(model.deck, card, 0)
        text = changed.get(field.line, model.deck.lines[field.line].text)
        elements = model.mesh.element_sets.get(card.option("ELSET"), frozenset())
        total += read_number(text.split(",")[0]) * len(elements)
    return total


def least_thickness(model: CalculixModel) -> float:
    """The least thickness of shells and plies, and dimension of beams; infinite without."""
    shells, beams = model.deck.named("*SHELL SECTION"), model.deck.named("*BEAM SECTION")
    layered = [card for card in shells if "COMPOSITE" in card.options]
    fields = [model.deck.fields(position)[0] for card in layered for position in card.data]
    fields += [model.deck.fields(p)[0] for c in shells if c not in layered for p in c.data[:1]]
    fields += [text for c in beams for p in c.data[:1] for text in model.deck.fields(p)]
    found = [math.inf]
    for text in filter(None, fields):
        with suppress(ValueError):  # ccx says what is wrong with it
            found.append(read_number(text))
    return min(value for value in found if value > 0.0)


def elastic_constants(model: CalculixModel) -> dict[str, tuple[float, float]]:
    """E, the largest one, and density (0 without) of each material that elements use."""
    found = {}
    for card in model.deck.named("*MATERIAL"):
        name, density = card.option("NAME"), 0.0
        with suppress(ModelError):  # a material without density has stiffness alone
            density = fields_of(model, "density", name)[0].value
        with suppress(ModelError):  # not used, or no such card
            modulus = max(field.value for field in fields_of(model, "youngs_modulus", name))
            if modulus > 0.0:
                found[name] = modulus, max(density, 0.0)
    return found


#: Sections whose numbers parameters name by their element set.
BY_SET = tuple(row.name for row in CARDS.values() if row.owner == "elset" and row.numbers)


def targets(model: CalculixModel) -> tuple[Target, ...]:
    """Materials and sections with elements, each once."""
    found: dict[tuple[str, str], Target] = {}
    for card in model.deck.named("*MATERIAL", *BY_SET):
        by_set = card.is_one_of(*BY_SET)
        name = card.option("ELSET" if by_set else "NAME")
        sections = [card] if by_set else model.users({name})
        count = len(frozenset[int]().union(*map(model.members, sections)))
        if name and count:
            by: TargetKind = "elset" if by_set else "material"
            found.setdefault((by, name), Target(by, (name,), card.keyword, count))
    return tuple(found.values())


def material_masses(model: CalculixModel, sizes: Mapping[int, float]) -> dict[str, float]:
    """About the mass of each material; sizes: length, area or volume of each element."""
    found: dict[str, float] = {}
    for card in model.deck.named("*SOLID SECTION", "*SHELL SECTION", "*BEAM SECTION"):
        members = model.mesh.element_sets.get(card.option("ELSET"), frozenset())
        size = sum(sizes.get(number, 0.0) for number in members)
        rows = [model.deck.fields(position) for position in card.data]
        layers = [(card.option("MATERIAL"), _across(card, rows))]
        if "COMPOSITE" in card.options:
            layers = [(canonical_name(row[2]), _number(row[0])) for row in rows if len(row) > 2]
        for name, across in layers:
            with suppress(ModelError):  # a material that has no density
                mass = fields_of(model, "density", name)[0].value * across * size
                found[name] = found.get(name, 0.0) + mass
    return found


def _number(text: str) -> float:
    """A number of a section, 0 where it is none, of which ccx says what is wrong."""
    with suppress(ValueError):
        return read_number(text)
    return 0.0


def _across(card: KeywordCard, rows: list[list[str]]) -> float:
    """What a section's size is multiplied with: thickness, area of a beam or truss, or 1."""
    numbers = [_number(text) for text in rows[0]] if rows else []
    if card.is_one_of("*BEAM SECTION"):
        return math.prod(numbers[:2])
    return numbers[0] if numbers and numbers[0] > 0.0 else 1.0
