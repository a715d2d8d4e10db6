"""The cards of a CalculiX deck whose numbers parameters scale: one row for each card.

A row names the owner of the numbers (the material above the card, or an element set), the matrices
that they move, and for each quantity their fields, the powers in which the matrices follow
them, and whether they alone make the strain energy of their elements. Everything else follows from
the row: which cards are sections, what a parameter moves, and what damps the model.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from modetune.adapters.calculix.deck import (
    COMMENTS,
    KeywordCard,
    KeywordDeck,
    canonical_name,
    read_number,
)
from modetune.core.errors import ModelError
from modetune.core.parameters import Quantity

#: Powers of a shell's thickness and of a beam's dimension, besides the constant: both are expanded
#: to solids.
ACROSS = (-1, 1, 2, 3)
_D = ("1111", "1122", "2222", "1133", "2233", "3333")
#: Constants of *ELASTIC, in the order in which ccx reads them, by what TYPE begins with. Those of
#: D-matrices are named by their indices.
TYPES: dict[str, tuple[str, ...]] = {
    "ISO": ("E", "NU"),
    "ENGINEERINGCONSTANTS": ("E1", "E2", "E3", "NU12", "NU13", "NU23", "G12", "G13", "G23"),
    "ORTHO": tuple(f"D{indices}" for indices in (*_D, "1212", "1313", "2323")),
    "ANISO": tuple(
        f"D{indices}"
        for indices in (
            *_D, "1112", "2212", "3312", "1212", "1113", "2213", "3313", "1213", "1313", "1123",
            "2223", "3323", "1223", "1323", "2323",
        )
    ),
}  # fmt: skip
#: Letters of the constants that a quantity scales. All moduli go with Young's, so that the
#: stiffness is proportional.
LETTERS: dict[Quantity, str] = {
    "youngs_modulus": "EDG", "shear_modulus": "G", "poissons_ratio": "NU",
}  # fmt: skip
IN_A_LINE = 8


@dataclass(frozen=True, slots=True)
class KeywordField:
    """One number of the deck that a parameter scales: a field of a data line.

    item: by which a parameter picks it; 0 where there is no choice, -1 where it goes with all only.
    """

    line: int
    place: int
    value: float
    item: int = 0


#: Finds the numbers on a card, by the name of their owner and the types of its elements.
Kinds = Callable[[], frozenset[str]]
Finder = Callable[[KeywordDeck, KeywordCard, str, Kinds], list[KeywordField]]


@dataclass(frozen=True, slots=True)
class KeywordNumbers:
    """The numbers of a card that one quantity is.

    powers: the matrices are a sum of these powers of their relative value and a constant; empty
    where they are no such sum. energy: whether the strain energy of the elements is proportional to
    them. absent: what a message says of an owner without such numbers. once: whether an owner has
    one such card.
    """

    find: Finder
    powers: tuple[int, ...] = ()
    energy: bool = False
    absent: str = ""
    once: bool = False


@dataclass(frozen=True, slots=True)
class Keyword:
    """A keyword, the owner of its numbers and the matrices that these move.

    moves: empty for a card whose lines are not numbers of K and M alone. massless: whether its
    elements have no mass.
    """

    name: str
    owner: Literal["material", "elset"]
    moves: Literal["", "K", "M", "KM"] = ""
    numbers: Mapping[Quantity, KeywordNumbers] = field(default_factory=dict)
    massless: bool = False

    @property
    def powers(self) -> tuple[int, ...]:
        """Powers of its numbers, of those that the matrices are a sum of powers of."""
        return next((each.powers for each in self.numbers.values() if each.powers), ())


def constant_places(card: KeywordCard, quantity: Quantity) -> list[tuple[int, int, int]]:
    """Return item, line and place in it of a quantity's constants, at each temperature.

    An item is the number in a constant's name, 0 without one; -1 goes with all only. Empty where
    a material of this type has no such quantity.
    """
    kind = card.option("TYPE") or "ISO"
    names = next((names for start, names in TYPES.items() if kind.startswith(start)), ())
    lines = -(-len(names) // IN_A_LINE)
    found = []
    for first in range(0, len(card.data) - lines + 1, lines or 1):
        for place, name in enumerate(names):
            letters = name.rstrip("0123456789")
            if letters in LETTERS[quantity]:
                alone = quantity != "youngs_modulus" or letters != "G"
                item = int(name.removeprefix(letters) or 0) if alone else -1
                row, at = divmod(place, IN_A_LINE)
                found.append((item, card.data[first + row], at))
    return found


def orientations(deck: KeywordDeck, card: KeywordCard) -> set[str]:
    """Return the orientations that a section and its layers name."""
    rows = [deck.fields(line) for line in card.data if "COMPOSITE" in card.options]
    return {card.option("ORIENTATION"), *(canonical_name(r[3]) for r in rows if len(r) > 3)}


def first_value(deck: KeywordDeck, card: KeywordCard, row: int) -> KeywordField:
    """Return the first number of one of a card's data lines. Raises ModelError."""
    if len(card.data) <= row:
        raise ModelError(f"{deck.where(card)}: the card has no value")
    return KeywordField(card.data[row], 0, deck.number(card.data[row], 0))


def _first(deck: KeywordDeck, card: KeywordCard, name: str, kinds: Kinds) -> list[KeywordField]:
    return [first_value(deck, card, 0)]


def _each_line(deck: KeywordDeck, card: KeywordCard, name: str, kinds: Kinds) -> list[KeywordField]:
    return [KeywordField(line, 0, deck.number(line, 0)) for line in card.data]


def _constants(quantity: Quantity) -> Finder:
    def found(deck: KeywordDeck, card: KeywordCard, name: str, kinds: Kinds) -> list[KeywordField]:
        places = constant_places(card, quantity)
        if not places:
            kind = f" of TYPE={card.option('TYPE')}" if card.option("TYPE") else ""
            raise ModelError(f"{deck.where(card)}: an *ELASTIC card{kind} has no {quantity}")
        return [KeywordField(at, p, deck.number(at, p), item) for item, at, p in places]

    return found


def _thickness(deck: KeywordDeck, card: KeywordCard, name: str, kinds: Kinds) -> list[KeywordField]:
    if "NODALTHICKNESS" in card.options:
        raise ModelError(
            f"{deck.where(card)}: the section of {name} is NODALTHICKNESS, so it has no one "
            "thickness to update"
        )
    if "COMPOSITE" not in card.options:
        return [first_value(deck, card, 0)]
    layers = enumerate(card.data, start=1)
    return [KeywordField(line, 0, deck.number(line, 0), layer) for layer, line in layers]


def _ply_angle(deck: KeywordDeck, card: KeywordCard, name: str, kinds: Kinds) -> list[KeywordField]:
    """Angles of the orientations that a laminate's layers name, by which they are turned."""
    found = []
    rows = [deck.fields(line) for line in card.data] if "COMPOSITE" in card.options else []
    names = [canonical_name(row[3]) if len(row) > 3 else "" for row in rows]
    for layer, own in enumerate(names or [card.option("ORIENTATION")], start=1):
        for turned in deck.named("*ORIENTATION"):
            if own and turned.option("NAME") == own and len(turned.data) > 1:
                line = turned.data[1]
                found.append(KeywordField(line, 1, deck.number(line, 1), layer))
    shared = {own for own in names if own and names.count(own) > 1}
    others = [other for other in deck.named(*SECTIONS) if other is not card]
    shared |= {own for own in names for other in others if own in orientations(deck, other)}
    if shared:
        raise ModelError(
            f"{deck.where(card)}: orientation {min(shared)} is that of several layers or "
            "sections, which turn together: give each its own *ORIENTATION"
        )
    return found


def _dimension(deck: KeywordDeck, card: KeywordCard, name: str, kinds: Kinds) -> list[KeywordField]:
    """Dimensions of cross-sections, on the first line; the second one is their direction."""
    return [
        KeywordField(line, place, deck.number(line, place), place + 1)
        for line in card.data[:1]
        for place, text in enumerate(deck.fields(line))
        if text
    ]


def _spring(deck: KeywordDeck, card: KeywordCard, name: str, kinds: Kinds) -> list[KeywordField]:
    """Return the constants, one a line (for each temperature) after the line of directions."""
    _check_linear(deck, card, "spring has no one stiffness")
    first = 0 if kinds() == {"SPRINGA"} else 1
    if first == 0:
        _check_blank(deck, card, "SPRINGA")
    return [first_value(deck, card, row) for row in range(first, max(len(card.data), first + 1))]


def _dashpot(deck: KeywordDeck, card: KeywordCard, name: str, kinds: Kinds) -> list[KeywordField]:
    _check_linear(deck, card, "dashpot no constant")
    _check_blank(deck, card, "DASHPOTA")
    if len(card.data) > 1:
        raise ModelError(f"{deck.where(card)}: a dashpot by temperature has no one constant")
    return [first_value(deck, card, 0)]


def _check_linear(deck: KeywordDeck, card: KeywordCard, what: str) -> None:
    if "NONLINEAR" in card.options:
        raise ModelError(f"{deck.where(card)}: a nonlinear {what} to update")


def _check_blank(deck: KeywordDeck, card: KeywordCard, kind: str) -> None:
    """SPRINGA and DASHPOTA have no directions, but ccx skips the line after the keyword."""
    texts = [deck.lines[position].text.strip() for position in card.lines[1:]]
    texts = [text for text in texts if not text.startswith(COMMENTS)]
    if card.data and texts[0]:
        raise ModelError(
            f"{deck.where(card)}: ccx requires a blank line before the constant of a {kind}"
        )


def _loss(deck: KeywordDeck, card: KeywordCard, name: str, kinds: Kinds) -> list[KeywordField]:
    """The loss factor of a material, an option of its card."""
    where, line = deck.where(card), card.lines.start
    others = sorted(card.options.keys() - {"STRUCTURAL"})
    if others:
        raise ModelError(
            f"{where}: {others[0]} of *DAMPING is of explicit dynamics and damps no mode here: "
            "give STRUCTURAL, the loss factor, or take the card out"
        )
    fields = [canonical_name(text) for text in deck.fields(line)]
    (place,) = (at for at, text in enumerate(fields) if text.startswith("STRUCTURAL="))
    try:
        return [KeywordField(line, place, read_number(card.option("STRUCTURAL")))]
    except ValueError:
        raise ModelError(f"{where}: STRUCTURAL of *DAMPING is not a number") from None


_ROWS = (
    Keyword("*ELASTIC", "material", "K", {
        "youngs_modulus": KeywordNumbers(_constants("youngs_modulus"), (1,), energy=True),
        "shear_modulus": KeywordNumbers(_constants("shear_modulus"), (1,)),
        "poissons_ratio": KeywordNumbers(_constants("poissons_ratio")),
    }),
    Keyword("*DENSITY", "material", "M", {"density": KeywordNumbers(_each_line, (1,))}),
    Keyword("*DAMPING", "material", numbers={
        "structural_damping": KeywordNumbers(
            _loss, (1,), once=True,
            absent="material {name} has no loss factor: write *DAMPING, STRUCTURAL=value below its "
            "*MATERIAL",
        ),
    }),
    Keyword("*SOLID SECTION", "elset", "KM"),
    Keyword("*SHELL SECTION", "elset", "KM", {
        "thickness": KeywordNumbers(_thickness, ACROSS),
        "ply_angle": KeywordNumbers(
            _ply_angle,
            absent="no layer of {name} has an *ORIENTATION with an angle (its second line: axis, "
            "angle)",
        ),
    }),
    Keyword("*BEAM SECTION", "elset", "KM", {"dimension": KeywordNumbers(_dimension, ACROSS)}),
    Keyword("*MEMBRANE SECTION", "elset"),
    Keyword("*SPRING", "elset", "K", {
        "spring_stiffness": KeywordNumbers(_spring, (1,), energy=True),
    }, massless=True),
    Keyword("*MASS", "elset", "M", {"mass": KeywordNumbers(_first, (1,))}),
    Keyword("*DASHPOT", "elset", numbers={
        "viscous_damping": KeywordNumbers(_dashpot, (1,)),
    }, massless=True),
    Keyword("*GAP", "elset", massless=True),
    Keyword("*USER SECTION", "elset"),
)  # fmt: skip
#: Rows by their keyword as a deck's cards have it.
CARDS = {canonical_name(row.name): row for row in _ROWS}
SECTIONS = tuple(row.name for row in _ROWS if row.owner == "elset")
#: Keywords that belong to the *MATERIAL above them.
OF_MATERIAL = (
    *(row.name for row in _ROWS if row.owner == "material"),
    "*EXPANSION", "*CONDUCTIVITY", "*SPECIFIC HEAT", "*PLASTIC", "*CYCLIC HARDENING", "*CREEP",
    "*HYPERELASTIC", "*HYPERFOAM", "*DEPVAR", "*USER MATERIAL", "*FLUID CONSTANTS",
    "*SPECIFIC GAS CONSTANT", "*VISCO", "*DEFORMATION PLASTICITY", "*MOHR COULOMB",
    "*MOHR COULOMB HARDENING", "*ELECTRICAL CONDUCTIVITY", "*MAGNETIC PERMEABILITY",
)  # fmt: skip


def rows_with(quantity: Quantity) -> list[Keyword]:
    """Return the cards that have a quantity."""
    return [row for row in _ROWS if quantity in row.numbers]


def powers_of(quantity: Quantity) -> tuple[int, ...]:
    """Return the powers of a quantity in the matrices, none where they are no sum of powers."""
    powers = {row.numbers[quantity].powers for row in rows_with(quantity)}
    return powers.pop() if len(powers) == 1 else ()
