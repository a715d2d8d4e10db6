"""Where a parameter stands in a Nastran deck: the fields of cards that hold its numbers.

The tables give, for each quantity and card, the fields as the manuals number them. What no table
can tell (a ply, a station of a tapered beam, a dimension of a cross-section, the K row of a bush)
is found by the functions after them.

Stiffness is linear in moduli of whole elements, springs and constants of bars without shear, mass
in densities and masses (`NastranModel.is_linear`). What constraints and rigid elements eliminate
moves to the grid points that it depends on.

Of the thickness t of a plate MYSTRAN's elements have t in the plane, t^3 in bending, and of shear
t^3 / (t^2 + c), with c by the element's size: no polynomial, but one of six powers through six
thicknesses between half and double is off by 3e-6 of the stiffness and of the eigenvalues at most.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from modetune.adapters.deck_numbers import FROM_ZERO, check_moved, check_one
from modetune.adapters.nastran.bulk import Cards
from modetune.adapters.nastran.fields import NastranCard
from modetune.adapters.nastran.sections import (
    ACTS_WITH,
    DEFAULTS,
    STATION,
    Entry,
    check_end,
    holds,
    section_entries,
)
from modetune.adapters.nastran.structure import Structure
from modetune.adapters.solver import AffectedElements, Target
from modetune.adapters.splitting import OF_MATERIALS
from modetune.core.errors import ModelError
from modetune.core.parameters import Parameter, TargetKind
from modetune.core.updating.matrix_samples import with_tied


@dataclass(frozen=True, slots=True)
class ValuePlace:
    """One number of the deck that a parameter scales.

    field: index in card.fields. ident: number of the material, property or element. symbol: its
    name in DVMREL1, DVPREL1 or DVCREL1 cards. along: whether it only keeps its ratio to the number
    before it.
    """

    card: NastranCard
    field: int
    value: float
    ident: int
    symbol: str
    along: bool = False


_MAT8_SHEAR = ((12, 5, "G12"), (13, 6, "G1Z"), (23, 7, "G2Z"))
_MAT9 = ("11", "12", "13", "14", "15", "16", "22", "23", "24", "25", "26", "33", "34", "35",
         "36", "44", "45", "46", "55", "56", "66")  # fmt: skip
#: Numbers of materials by quantity and card.
MATERIAL_ENTRIES: dict[tuple[str, str], tuple[Entry, ...]] = {
    # G goes along with E, so that Poisson's ratio stays and the stiffness is proportional.
    ("youngs_modulus", "MAT1"): ((0, 2, "E"), (-1, 3, "G")),
    ("youngs_modulus", "MAT2"): (
        (11, 2, "G11"), (12, 3, "G12"), (13, 4, "G13"), (22, 5, "G22"), (23, 6, "G23"),
        (33, 7, "G33"),
    ),
    ("youngs_modulus", "MAT8"): (
        (1, 2, "E1"), (2, 3, "E2"), (-1, 5, "G12"), (-1, 6, "G1Z"), (-1, 7, "G2Z"),
    ),
    ("youngs_modulus", "MAT9"): tuple(
        (int(pair), field, f"G{pair}") for field, pair in enumerate(_MAT9, start=2)
    ),
    ("shear_modulus", "MAT1"): ((0, 3, "G"),),
    ("shear_modulus", "MAT8"): _MAT8_SHEAR,
    ("poissons_ratio", "MAT1"): ((0, 4, "NU"),),
    ("poissons_ratio", "MAT8"): ((0, 4, "NU12"),),
    ("density", "MAT1"): ((0, 5, "RHO"),),
    ("density", "MAT2"): ((0, 8, "RHO"),),
    ("density", "MAT3"): ((0, 8, "RHO"),),
    ("density", "MAT8"): ((0, 8, "RHO"),),
    ("density", "MAT9"): ((0, 23, "RHO"),),
    ("density", "MAT10"): ((0, 3, "RHO"),),
    ("density", "MAT11"): ((0, 11, "RHO"),),
    ("structural_damping", "MAT1"): ((0, 8, "GE"),),
    ("structural_damping", "MAT2"): ((0, 12, "GE"),),
    ("structural_damping", "MAT8"): ((0, 17, "GE"),),
    ("structural_damping", "MAT9"): ((0, 31, "GE"),),
}  # fmt: skip
#: Offsets of both ends of a bar or beam, their fields after the pin flags.
_ENDS = tuple((place, 10 + place, f"W{place - 3 * (place > 3)}{'AB'[place > 3]}")
              for place in range(1, 7))  # fmt: skip
_INERTIA = ((11, 9, "I11"), (21, 10, "I21"), (22, 11, "I22"), (31, 12, "I31"), (32, 13, "I32"),
            (33, 14, "I33"))  # fmt: skip
_PLATES = ("CQUAD4", "CQUADR", "CTRIA3", "CTRIAR")
#: Numbers that stand on the element itself, by quantity and card.
ELEMENT_ENTRIES: dict[tuple[str, str], tuple[Entry, ...]] = {
    ("area", "CONROD"): ((0, 5, "A"),),
    ("torsion_constant", "CONROD"): ((0, 6, "J"),),
    ("spring_stiffness", "CELAS2"): ((0, 2, "K"),),
    ("spring_stiffness", "CELAS4"): ((0, 2, "K"),),
    ("structural_damping", "CELAS2"): ((0, 7, "GE"),),
    ("viscous_damping", "CDAMP2"): ((0, 2, "B"),),
    ("viscous_damping", "CDAMP4"): ((0, 2, "B"),),
    ("nonstructural_mass", "CONROD"): ((0, 8, "NSM"),),
    ("offset", "CBAR"): _ENDS,
    ("offset", "CBEAM"): _ENDS,
    **{("offset", plate): ((0, 8 if plate[1] == "Q" else 7, "ZOFFS"),) for plate in _PLATES},
    ("offset", "CONM2"): ((1, 5, "X1"), (2, 6, "X2"), (3, 7, "X3")),
    ("rotary_inertia", "CONM2"): _INERTIA,
    ("mass", "CMASS2"): ((0, 2, "M"),),
    ("mass", "CMASS4"): ((0, 2, "M"),),
    # The inertia goes along with the mass: the body keeps its shape.
    ("mass", "CONM2"): ((0, 4, "M"), *((-1, field, symbol) for _, field, symbol in _INERTIA)),
}  # fmt: skip
#: Thicknesses that stand on an element beside its property's: first and last field, and the flag
#: that makes them fractions of the property's (1) instead.
OWN_THICKNESS = {
    "CQUAD4": (11, 14, 10), "CQUADR": (11, 14, 10), "CQUAD8": (11, 14, 17),
    "CTRIA3": (11, 13, 10), "CTRIAR": (11, 13, 10), "CTRIA6": (11, 13, 14),
}  # fmt: skip
#: Quantities of point masses.
OF_MASSES = ("mass", "rotary_inertia", "offset")
REMEDY = {
    "elset": "a Nastran deck has no element sets: name a property or elements instead",
    "part": "a Nastran deck has no matrix parts: name a material, a property or elements instead",
}


def find_places(structure: Structure, parameter: Parameter) -> list[ValuePlace]:
    """Where a parameter stands. Raises ModelError with the first reason why it does not."""
    if parameter.by in REMEDY:
        raise ModelError(REMEDY[parameter.by])
    if parameter.quantity == "variable":
        return []
    found: list[ValuePlace] = []
    if parameter.by == "material":
        for target in parameter.targets:
            for _, card in structure.materials(target):
                found += _of_material(structure, parameter, card)
    elif parameter.by == "property":
        named = [item for target in parameter.targets for item in structure.properties(target)]
        found = _of_properties(structure, parameter, [ident for ident, _ in named])
    else:
        found = _of_elements(structure, parameter)
    if len({(place.card.lines, place.field) for place in found}) < len(found):
        raise ModelError(f"{', '.join(parameter.targets)}: one of the targets is named twice")
    return found


def _of_properties(
    structure: Structure, parameter: Parameter, idents: Iterable[int]
) -> list[ValuePlace]:
    """Numbers of property cards, or of the materials that they name. Raises ModelError."""
    found: list[ValuePlace] = []
    materials: dict[int, None] = {}
    for ident in idents:
        card = structure.property_card(str(ident))
        by_material = parameter.quantity in OF_MATERIALS and not holds(
            parameter.quantity, card.name
        )
        named = structure.materials_of[ident] if by_material else ()
        materials.update(dict.fromkeys(sorted(named)))
        if not named:
            found += _of_property(structure, parameter, card, ident)
    for ident in materials:
        found += _of_material(structure, parameter, structure.material(str(ident)))
    return found


def _of_material(structure: Structure, parameter: Parameter, card: NastranCard) -> list[ValuePlace]:
    where, quantity = structure.deck.where(card), parameter.quantity
    ident = int(card.text(1))
    entries = MATERIAL_ENTRIES.get((quantity, card.name))
    if entries is None:
        raise ModelError(f"{where}: {card.name} {ident} has no {quantity} that can be updated")
    if card.name == "MAT1":
        _check_isotropic(structure, card, where, quantity)
    return select(structure, parameter, card, ident, entries)


def _check_isotropic(structure: Structure, card: NastranCard, where: str, quantity: str) -> None:
    """Of E, G and NU two are free; the third follows, or is half ignored."""
    young, shear, poisson = (structure.number(card, field) for field in (2, 3, 4))
    number = card.text(1)
    if quantity == "youngs_modulus" and young is None:
        raise ModelError(
            f"{where}: E of MAT1 {number} is blank: it follows from G and NU; update shear_modulus"
        )
    if quantity == "shear_modulus" and shear is None:
        raise ModelError(
            f"{where}: G of MAT1 {number} is blank: it follows from E and NU; update one of those"
        )
    if quantity == "poissons_ratio" and poisson is None:
        raise ModelError(f"{where}: NU of MAT1 {number} is blank: it follows from E and G")
    if quantity == "poissons_ratio" and young is not None and shear is not None:
        raise ModelError(
            f"{where}: MAT1 {number} gives E, G and NU; bars take G and ignore NU, so that NU is "
            "no one quantity: leave G blank"
        )


def _of_property(
    structure: Structure, parameter: Parameter, card: NastranCard, ident: int
) -> list[ValuePlace]:
    entries = section_entries(structure, parameter.quantity, card, ident)
    if parameter.quantity == "dimension" and parameter.item == 0:
        raise ModelError(
            f"{structure.deck.where(card)}: {card.name} {ident} has several dimensions: give the "
            "parameter an item"
        )
    if parameter.quantity == "thickness" and card.name == "PSHELL":
        _check_own_thickness(structure, card, ident)
    if card.name == "PBEAM" and parameter.quantity in STATION and parameter.item == 1:
        check_end(structure, card, ident, entries)
    if card.name == "PBAR" and parameter.quantity == "shear_factor" and structure.number(card, 19):
        raise ModelError(
            f"{structure.deck.where(card)}: PBAR {ident} has I12, beside which K1 and K2 have no "
            "effect"
        )
    field, name = ACTS_WITH.get(parameter.quantity, (0, ""))
    if name and card.text(field) in ("", "0", "-1"):
        raise ModelError(
            f"{structure.deck.where(card)}: {card.name} {ident} has no {name}, without which "
            f"{parameter.quantity} has no effect"
        )
    return select(structure, parameter, card, ident, entries)


def _check_own_thickness(structure: Structure, card: NastranCard, ident: int) -> None:
    for number in sorted(structure.elements_of[ident]):
        element = structure.owners.elements[number][0]
        first, last, flag = OWN_THICKNESS.get(element.name, (0, -1, 0))
        given = any(element.text(field) for field in range(first, last + 1))
        if given and element.text(flag) != "1":
            raise ModelError(
                f"{structure.deck.where(element)}: {element.name} {number} gives its own "
                f"thickness, which that of {card.name} {ident} does not change"
            )


def _of_elements(structure: Structure, parameter: Parameter) -> list[ValuePlace]:
    quantity = parameter.quantity
    owners = structure.owners
    family = owners.elements
    if quantity in OF_MASSES:
        family = owners.masses if quantity != "offset" else {**owners.elements, **owners.masses}
    numbers = structure.element_numbers(family, parameter.targets)
    found: list[ValuePlace] = []
    by_property: list[int] = []
    materials: dict[int, None] = {}
    for number in numbers:
        card = structure.element(family, number)
        entries = ELEMENT_ENTRIES.get((quantity, card.name))
        if entries is not None:
            found += select(structure, parameter, card, number, entries)
        elif quantity in OF_MASSES and number in owners.masses:
            if quantity != "mass":
                raise ModelError(
                    f"{structure.deck.where(card)}: {card.name} {number} has no {quantity} that "
                    "can be updated"
                )
            raise ModelError(
                f"{structure.deck.where(card)}: {card.name} {number} has no mass of its own to "
                "update; CONM2, CMASS2 and CMASS4 have"
            )
        elif card.name == "CONROD" and quantity in OF_MATERIALS:
            materials[structure.bulk.elements[number].mid] = None
        else:
            by_property.append(number)
    for ident in materials:
        found += _of_material(structure, parameter, structure.material(str(ident)))
    return found + _of_properties(structure, parameter, structure.properties_of(by_property))


def select(
    structure: Structure,
    parameter: Parameter,
    card: NastranCard,
    ident: int,
    entries: Iterable[Entry],
) -> list[ValuePlace]:
    """The entries that a parameter's item picks and that hold a number. Raises ModelError."""
    where = f"{structure.deck.where(card)}: {card.name} {ident}"
    known = list(entries)
    item = parameter.item
    if item == 0:
        picked = known
    else:
        picked = [entry for entry in known if entry[0] == item]
        items = sorted({entry[0] for entry in known if entry[0] > 0})
        if not picked:
            choice = ", ".join(map(str, items)) or "one alone, so leave the item out"
            raise ModelError(f"{where}: no item {item} of {parameter.quantity}; it has {choice}")
    numbers = [
        (entry, DEFAULTS.get((card.name, entry[2])) if number is None else number)
        for entry in picked
        for number in [structure.number(card, entry[1])]
    ]
    symbols = ", ".join(symbol for _, _, symbol in picked)
    if all(value is None for _, value in numbers):
        raise ModelError(
            f"{where}: {symbols} is blank, so there is no {parameter.quantity}; write it "
            f"out (0. for none, and {FROM_ZERO})"
        )
    relative = parameter.values == "relative"
    if parameter.quantity not in STATION:  # all stations of a beam are of one number
        check_one(parameter, where, [entry[0] for entry, value in numbers if value is not None])
    given = [value for _, value in numbers if value is not None]
    check_moved(parameter, f"{where}: {symbols}", given)
    # A factor does not change a zero.
    return [
        ValuePlace(card, field, value, ident, symbol, at < 0)
        for (at, field, symbol), value in numbers
        if value or (value is not None and not relative and at >= 0)
    ]


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


#: Quantities that move one of the two matrices; the others may move both.
STIFFNESS_ALONE = frozenset(("youngs_modulus", "spring_stiffness"))
MASS_ALONE = frozenset(("density", "mass"))


#: Powers of a plate's thickness, and between which relative values they hold.
THICKNESS, HALF, DOUBLE = (1, 2, 3, 4, 5, 6), 0.5, 2.0


def powers_of(parameter: Parameter, places: Iterable[ValuePlace], linear: bool) -> tuple[int, ...]:
    """The powers of a parameter that the matrices are made of, none where they are not."""
    if linear:
        return (1,)
    plates = parameter.quantity == "thickness" and {p.card.name for p in places} == {"PSHELL"}
    within = parameter.lower >= HALF and parameter.upper <= DOUBLE
    return THICKNESS if plates and within else ()


def affected_elements_of(
    structure: Structure,
    parameters: Sequence[Parameter],
    places: Iterable[ValuePlace],
    powers: tuple[int, ...],
    whole: bool,
) -> AffectedElements:
    """What a parameter and those that follow it by expressions move in these powers.

    places: where they stand; whole: whether all stiffness of its elements is proportional to it.
    """
    moved = {item.quantity for item in parameters} - {"variable"}
    elements = frozenset[int]().union(*(_elements_with(structure, place) for place in places))
    known = structure.bulk.elements | structure.bulk.masses
    nodes = {node for number in elements for node in known[number].node_ids if node}
    return AffectedElements(
        elements=elements,
        nodes=frozenset(with_tied(nodes, _ties(structure))),
        stiffness=not moved <= MASS_ALONE,
        mass=not moved <= STIFFNESS_ALONE,
        powers=powers,
        proportional=whole and moved <= STIFFNESS_ALONE,
        related=len(parameters) > 1,
    )


def _elements_with(structure: Structure, place: ValuePlace) -> frozenset[int]:
    """Elements that have a number, or a property or material with it."""
    if place.card in structure.owners.materials.get(place.ident, ()):
        users = (n for n, used in structure.materials_of.items() if place.ident in used)
        rods = structure.rods_of.get(place.ident, frozenset())
        return rods.union(*(structure.elements_of[number] for number in users))
    if place.card in structure.owners.properties.get(place.ident, ()):
        return structure.elements_of[place.ident]
    return frozenset({place.ident})


def _ties(structure: Structure) -> Iterable[tuple[set[int], set[int]]]:
    """Grid points of each rigid element and multi-point constraint, and those they depend on."""
    for element in structure.bulk.rigid_elements.values():
        dependent = set(element.dependent_nodes)
        every = dependent.union(element.independent_nodes)
        # Of others components of any grid point may be dependent.
        one_way = element.type == "RBE2" or (element.type == "RBE3" and not element.Gmi)
        yield (dependent if one_way else every), every
    for constraints in structure.bulk.mpcs.values():
        for item in constraints:
            yield set(item.node_ids[:1]), set(item.node_ids)


#: More elements of one card than this are one target.
ALONE = 12
#: Quantities for which elements are named one by one.
OF_ELEMENTS = ("area", "spring_stiffness", "mass")
#: What preprocessors write before a name in the comment above a card.
TITLE = re.compile(r"^\$[\s*$-]*(?:(?:femap|hm|patran)?\s*(?:material|property|name|mat|prop)\b"
                   r"[^:\"]*[:\"])?\s*(.*?)[\s\"*$-]*$", re.IGNORECASE)  # fmt: skip


def targets(structure: Structure) -> tuple[Target, ...]:
    """Materials and properties that elements use, then elements with numbers of their own."""
    owners = structure.owners
    used = {number: set(rods) for number, rods in structure.rods_of.items()}
    for number, materials in structure.materials_of.items():
        for material in materials:
            used.setdefault(material, set()).update(structure.elements_of[number])
    sizes = {number: len(found) for number, found in used.items()}
    by_property = {number: len(found) for number, found in structure.elements_of.items()}
    return (
        *_numbered(structure, "material", owners.materials, sizes),
        *_numbered(structure, "property", owners.properties, by_property),
        *_element_targets(structure, owners.elements),
        *_element_targets(structure, owners.masses),
    )


def _numbered(
    structure: Structure, by: TargetKind, family: Cards, sizes: dict[int, int]
) -> Iterator[Target]:
    for number in sorted(family.keys() & sizes.keys()):
        card = family[number][0]
        yield Target(by, (str(number),), card.name, sizes[number], _title(structure, card))


def _element_targets(structure: Structure, family: Cards) -> Iterator[Target]:
    named = {card for quantity, card in ELEMENT_ENTRIES if quantity in OF_ELEMENTS}
    found: dict[str, list[int]] = {}
    for number, cards in sorted(family.items()):
        if cards[0].name in named:
            found.setdefault(cards[0].name, []).append(number)
    for kind, numbers in found.items():
        if len(numbers) > ALONE:
            yield Target("element", tuple(map(str, numbers)), kind, len(numbers))
            continue
        for number in numbers:
            title = _title(structure, family[number][0])
            yield Target("element", (str(number),), kind, 1, title)


def _title(structure: Structure, card: NastranCard) -> str:
    """What the comment above a card calls it; empty where it has no words."""
    first = card.lines[0]
    above = structure.deck.lines[first - 1].text.strip() if first else ""
    match = TITLE.match(above)
    title = match.group(1).strip() if match else ""
    words = re.search(r"[^\W\d_]{2}", title) and "|" not in title and len(title) <= 40
    return title if words else ""
