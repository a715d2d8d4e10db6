"""What of a model's matrices is linear in a parameter's numbers, and which groups of elements have
strain energy in proportion to them: `P12` is all elements of property 12, `E7` element 7."""

from __future__ import annotations

from collections.abc import Iterable

from modetune.adapters.nastran.deck import NastranCard
from modetune.adapters.nastran.places import ValuePlace, find_places
from modetune.adapters.nastran.structure import Structure
from modetune.core.errors import ModelError
from modetune.core.parameters import Parameter

#: Quantities in which stiffness and mass matrices are linear whatever the card.
LINEAR = (
    "density", "mass", "rotary_inertia", "nonstructural_mass", "spring_stiffness",
    "torsion_constant", "structural_damping", "viscous_damping",
)  # fmt: skip
#: K1 and K2, the shear stiffness factors of a PBAR.
SHEAR_FACTORS = (17, 18)


def energy_sets(structure: Structure, parameter: Parameter) -> tuple[str, ...]:
    """Groups of elements whose strain energy is proportional to the parameter's numbers.

    Empty where it is not theirs alone: other materials share a property, or only some of its
    constants scale.
    """
    try:
        places = find_places(structure, parameter)
    except ModelError:
        return ()
    if parameter.quantity == "youngs_modulus" and parameter.item == 0:
        return _users(structure, {place.ident for place in places})
    if parameter.quantity != "spring_stiffness":
        return ()
    names: dict[str, None] = {}
    for place in places:
        if place.card.name == "PBUSH" and not _whole_bush(structure, place, places):
            return ()
        kind = "E" if place.card.name.startswith("CELAS") else "P"
        names[f"{kind}{place.ident}"] = None
    return tuple(names)


def _users(structure: Structure, materials: set[int]) -> tuple[str, ...]:
    """Groups that these materials alone make stiff, all that use them; else none."""
    names = []
    for number, used in sorted(structure.materials_of.items()):
        if used & materials:
            # Two of the parameter's own materials in one property still scale together.
            if not used <= materials:
                return ()
            names.append(f"P{number}")
    for material in sorted(materials):
        rods = structure.rods_of.get(material, frozenset())
        names += [f"E{number}" for number in sorted(rods)]
    return tuple(names)


def _whole_bush(structure: Structure, place: ValuePlace, places: Iterable[ValuePlace]) -> bool:
    """Whether all stiffness of a PBUSH scales: every K of it that is given and not zero."""
    scaled = {other.field for other in places if other.card == place.card}
    rows = (row for row in range(2, len(place.card.fields), 8) if place.card.text(row) == "K")
    fields = {row + item for row in rows for item in range(1, 7)}
    return {field for field in fields if structure.number(place.card, field)} == scaled


def is_linear(structure: Structure, parameter: Parameter) -> bool:
    """Whether stiffness and mass matrices are linear in the numbers of a parameter."""
    if parameter.quantity in (*LINEAR, "variable"):
        return True
    if parameter.quantity == "youngs_modulus":
        # Single constants, and one of several materials of a laminate, act in series with
        # others (Poisson coupling, transverse shear, condensed bubbles): not linear.
        return bool(energy_sets(structure, parameter))
    if parameter.quantity not in ("area", "inertia_1", "inertia_2"):
        return False
    try:
        return all(
            _without_shear(structure, place.card) for place in find_places(structure, parameter)
        )
    except ModelError:
        return False


def _without_shear(structure: Structure, card: NastranCard) -> bool:
    """Whether a bar bends without shear, so that its stiffness is linear in A and I.

    Shear acts in series with bending: K = 12 EI / (L^3 (1 + phi)), phi = 12 EI / (K1 A G L^2).
    A PBEAM has it unless K1 and K2 are zero (blank is 1), a PBAR where K1 or K2 is given.
    """
    if card.name == "PBAR":
        return not any(structure.number(card, field) for field in SHEAR_FACTORS)
    return card.name in ("PROD", "CONROD")
