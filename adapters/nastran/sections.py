"""Numbers of property cards: thicknesses, cross-sections and spring constants, field by field.

An entry is (item, field, symbol): the item by which a parameter picks it (0 where there is no
choice, -1 where it goes with all only), its field on the card and its name in DVPREL1 cards.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from modetune.adapters.nastran.deck import NastranCard
from modetune.adapters.nastran.structure import Structure
from modetune.core.errors import ModelError

Entry = tuple[int, int, str]

#: Numbers that stand at one place of a card.
FIELDS: dict[tuple[str, str], tuple[Entry, ...]] = {
    ("thickness", "PSHELL"): ((0, 3, "T"),),
    ("thickness", "PSHEAR"): ((0, 3, "T"),),
    ("area", "PBAR"): ((0, 3, "A"),),
    ("area", "PROD"): ((0, 3, "A"),),
    ("inertia_1", "PBAR"): ((0, 4, "I1"),),
    ("inertia_2", "PBAR"): ((0, 5, "I2"),),
    ("torsion_constant", "PBAR"): ((0, 6, "J"),),
    ("torsion_constant", "PROD"): ((0, 4, "J"),),
}
#: Fields of the properties at one station of a PBEAM, after its first field.
STATION = {"area": (2, "A"), "inertia_1": (3, "I1"), "inertia_2": (4, "I2"),
           "torsion_constant": (6, "J")}  # fmt: skip
#: What a row of a PBEAM or PBEAML starts with where it begins a station (stress output there).
STATION_MARKS = ("YES", "YESA", "NO")
#: Cards that give the cross-section by its dimensions.
BY_DIMENSIONS = ("PBARL", "PBEAML")


def section_entries(
    structure: Structure, quantity: str, card: NastranCard, ident: int
) -> list[Entry]:
    """Where a property card holds a quantity. Raises ModelError with the reason why it does not."""
    if (quantity, card.name) in FIELDS:
        return list(FIELDS[quantity, card.name])
    where = structure.deck.where(card)
    finder = _FINDERS.get((quantity, card.name))
    if finder is not None:
        return list(finder(structure, card, ident))
    if card.name in BY_DIMENSIONS and quantity in STATION:
        raise ModelError(
            f"{where}: {card.name} {ident} gives dimensions: update `dimension` with an item"
        )
    raise ModelError(f"{where}: {card.name} {ident} has no {quantity} that can be updated")


def _plies(structure: Structure, card: NastranCard, ident: int) -> Iterator[Entry]:
    """Thicknesses of PCOMP and PCOMPG plies; a blank one is that of the ply before."""
    stride, first = (4, 10) if card.name == "PCOMP" else (8, 11)
    count = -(-(len(card.fields) - 9) // stride)
    given = [bool(card.text(first + stride * ply)) for ply in range(count)]
    if card.name == "PCOMP" and not all(given):
        blank = given.index(False) + 1
        line = structure.deck.where(card)
        raise ModelError(
            f"{line}: ply {blank} of PCOMP {ident} has a blank thickness, which follows the ply "
            "before it: write it out"
        )
    for ply in range(count):
        if given[ply]:
            yield ply + 1, first + stride * ply, f"T{ply + 1}"


def _beam(quantity: str) -> Callable[[Structure, NastranCard, int], Iterator[Entry]]:
    """Numbers of all stations of a PBEAM: end A, then each row that starts with a mark.

    Blank ones follow end A, or the ends between which they lie, and scale with those.
    """
    offset, symbol = STATION[quantity]

    def entries(structure: Structure, card: NastranCard, ident: int) -> Iterator[Entry]:
        yield 0, 1 + offset, f"{symbol}(A)"
        if not card.text(1 + offset):
            raise ModelError(
                f"{structure.deck.where(card)}: {symbol} of PBEAM {ident} is blank at end A"
            )
        marks = [row for row in range(9, len(card.fields), 8) if card.text(row) in STATION_MARKS]
        for station, row in enumerate(marks, start=1):
            if card.text(row + offset):
                end = structure.number(card, row + 1) == 1.0
                yield 0, row + offset, f"{symbol}({'B' if end else station})"

    return entries


def _dimensions(structure: Structure, card: NastranCard, ident: int) -> Iterator[Entry]:
    """Dimensions of a PBARL, or of all stations of a PBEAML (blank ones follow end A)."""
    kinds = structure.bulk.properties[ident].valid_types
    count = int(kinds[card.text(4) or "TUBE"])
    if card.name == "PBARL":
        for item in range(1, count + 1):
            yield item, 8 + item, f"DIM{item}"
        return
    row, station = 9, 0
    while row < len(card.fields):
        for item in range(1, count + 1):
            if station == 0:
                yield item, row + item - 1, f"DIM{item}(A)"
            elif card.text(row + item - 1):
                end = structure.number(card, row - 1) == 1.0
                yield item, row + item - 1, f"DIM{item}({'B' if end else station})"
        row, station = row + count + 3, station + 1


def _spring(structure: Structure, card: NastranCard, ident: int) -> Iterator[Entry]:
    """PELAS: a card may hold two of them."""
    yield (0, 2, "K1") if card.text(1) == str(ident) else (0, 6, "K1")


def _bush(structure: Structure, card: NastranCard, ident: int) -> Iterator[Entry]:
    for row in range(2, len(card.fields), 8):
        if card.text(row) != "K":
            continue
        for item in range(1, 7):
            if card.text(row + item):
                yield item, row + item, f"K{item}"


_FINDERS: dict[tuple[str, str], Callable[[Structure, NastranCard, int], Iterator[Entry]]] = {
    ("thickness", "PCOMP"): _plies,
    ("thickness", "PCOMPG"): _plies,
    **{(quantity, "PBEAM"): _beam(quantity) for quantity in STATION},
    ("dimension", "PBARL"): _dimensions,
    ("dimension", "PBEAML"): _dimensions,
    ("spring_stiffness", "PELAS"): _spring,
    ("spring_stiffness", "PBUSH"): _bush,
}
