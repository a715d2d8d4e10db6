"""Numbers of property cards: thicknesses, cross-sections, springs, damping, field by field.

An entry is (item, field, symbol): the item by which a parameter picks it (0 where there is no
choice, -1 where it goes with all only), its field on the card and its name in DVPREL1 cards (the
position of its field where a name would begin with a digit).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from modetune.adapters.nastran.fields import NastranCard
from modetune.adapters.nastran.structure import Structure
from modetune.core.errors import ModelError

Entry = tuple[int, int, str]

#: Numbers that stand at one place of a card.
FIELDS: dict[tuple[str, str], tuple[Entry, ...]] = {
    ("thickness", "PSHELL"): ((0, 3, "T"),),
    ("thickness", "PSHEAR"): ((0, 3, "T"),),
    ("bending_inertia_ratio", "PSHELL"): ((0, 5, "6"),),
    ("shear_thickness_ratio", "PSHELL"): ((0, 7, "TS/T"),),
    ("nonstructural_mass", "PSHELL"): ((0, 8, "NSM"),),
    ("nonstructural_mass", "PSHEAR"): ((0, 4, "NSM"),),
    ("nonstructural_mass", "PCOMP"): ((0, 3, "NSM"),),
    ("nonstructural_mass", "PCOMPG"): ((0, 3, "NSM"),),
    ("nonstructural_mass", "PBAR"): ((0, 7, "NSM"),),
    ("nonstructural_mass", "PROD"): ((0, 6, "NSM"),),
    ("nonstructural_mass", "PTUBE"): ((0, 5, "NSM"),),
    ("offset", "PCOMP"): ((0, 2, "Z0"),),
    ("offset", "PCOMPG"): ((0, 2, "Z0"),),
    ("structural_damping", "PCOMP"): ((0, 7, "GE"),),
    ("structural_damping", "PCOMPG"): ((0, 7, "GE"),),
    ("area", "PBAR"): ((0, 3, "A"),),
    ("area", "PROD"): ((0, 3, "A"),),
    ("inertia_1", "PBAR"): ((0, 4, "I1"),),
    ("inertia_2", "PBAR"): ((0, 5, "I2"),),
    ("inertia_12", "PBAR"): ((0, 19, "I12"),),
    ("shear_factor", "PBAR"): ((1, 17, "K1"), (2, 18, "K2")),
    ("torsion_constant", "PBAR"): ((0, 6, "J"),),
    ("torsion_constant", "PROD"): ((0, 4, "J"),),
}
#: Fields of the properties at one station of a PBEAM, after its first field.
STATION = {"area": (2, "A"), "inertia_1": (3, "I1"), "inertia_2": (4, "I2"),
           "inertia_12": (5, "I12"), "torsion_constant": (6, "J"),
           "nonstructural_mass": (7, "NSM")}  # fmt: skip
#: What a blank number of a property card, by its name in DVPREL1 cards, is; others are zero.
DEFAULTS = {
    ("PSHELL", "6"): 1.0, ("PSHELL", "TS/T"): 0.833333, ("PBEAM", "K1"): 1.0, ("PBEAM", "K2"): 1.0,
}  # fmt: skip
#: Materials of a PSHELL without which a number of it has no effect: their field and name.
ACTS_WITH = {"bending_inertia_ratio": (4, "MID2"), "shear_thickness_ratio": (6, "MID3")}
#: What a row of a PBEAM or PBEAML starts with where it begins a station (stress output there).
STATION_MARKS = ("YES", "YESA", "NO")
#: Cards that give the cross-section by its dimensions.
BY_DIMENSIONS = ("PBARL", "PBEAML")


def holds(quantity: str, name: str) -> bool:
    """Whether a property card has a quantity of its own, which then counts before materials'."""
    return (quantity, name) in FIELDS or (quantity, name) in _FINDERS


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
    if card.name in BY_DIMENSIONS and quantity in STATION and quantity != "nonstructural_mass":
        raise ModelError(
            f"{where}: {card.name} {ident} gives dimensions: update `dimension` with an item"
        )
    raise ModelError(f"{where}: {card.name} {ident} has no {quantity} that can be updated")


def _angles(structure: Structure, card: NastranCard, ident: int) -> Iterator[Entry]:
    """Angles of PCOMP and PCOMPG plies."""
    for ply, field in enumerate(_ply_fields(card), start=1):
        if card.text(field) or card.text(field + 1):
            yield ply, field + 1, f"THETA{ply}"


def _ply_fields(card: NastranCard) -> range:
    """Fields of the plies' thicknesses."""
    stride, first = (4, 10) if card.name == "PCOMP" else (8, 11)
    return range(first, first + stride * -(-(len(card.fields) - 9) // stride), stride)


def _plies(structure: Structure, card: NastranCard, ident: int) -> Iterator[Entry]:
    """Thicknesses of PCOMP and PCOMPG plies; a blank one is that of the ply before."""
    fields = _ply_fields(card)
    given = [bool(card.text(field)) for field in fields]
    if card.name == "PCOMP" and not all(given):
        blank = given.index(False) + 1
        line = structure.deck.where(card)
        raise ModelError(
            f"{line}: ply {blank} of PCOMP {ident} has a blank thickness, which follows the ply "
            "before it: write it out"
        )
    for ply, field in enumerate(fields, start=1):
        if card.text(field):
            yield ply, field, f"T{ply}"


def _beam(quantity: str) -> Callable[[Structure, NastranCard, int], Iterator[Entry]]:
    """Numbers of all stations of a PBEAM: end A, then each row that starts with a mark.

    An item counts the stations as the card has them. Blank ones follow end A, or the ends between
    which they lie, and scale with those.
    """
    offset, symbol = STATION[quantity]

    def entries(structure: Structure, card: NastranCard, ident: int) -> Iterator[Entry]:
        yield 1, 1 + offset, f"{symbol}(A)"
        if not card.text(1 + offset):
            raise ModelError(
                f"{structure.deck.where(card)}: {symbol} of PBEAM {ident} is blank at end A"
            )
        for station, row in enumerate(station_rows(card), start=1):
            if card.text(row + offset):
                end = structure.number(card, row + 1) == 1.0
                yield station + 1, row + offset, f"{symbol}({'B' if end else station})"

    return entries


def station_rows(card: NastranCard) -> list[int]:
    """First fields of the stations of a PBEAM after end A."""
    return [row for row in range(9, len(card.fields), 8) if card.text(row) in STATION_MARKS]


def check_end(
    structure: Structure, card: NastranCard, ident: int, entries: Sequence[Entry]
) -> None:
    """Refuse a change of end A alone that end B would follow. Raises ModelError."""
    rows = station_rows(card)
    if rows and entries[-1][1] < rows[-1]:
        raise ModelError(
            f"{structure.deck.where(card)}: end B of PBEAM {ident} is blank, so that it follows "
            "end A: write it out"
        )


def _beam_end(*entries: Entry) -> Callable[[Structure, NastranCard, int], Iterator[Entry]]:
    """Numbers of a PBEAM that stand once, in the rows after its last station.

    entries: their fields counted from the first of these rows. A row that begins a station with
    YES is followed by one of stress points, as end A is where it has stations or nothing else.
    """

    def found(structure: Structure, card: NastranCard, ident: int) -> Iterator[Entry]:
        marks = station_rows(card)
        first = marks[-1] + (16 if card.text(marks[-1]) == "YES" else 8) if marks else 17
        for item, field, symbol in entries:
            yield item, first + field, symbol

    return found


def _section_mass(structure: Structure, card: NastranCard, ident: int) -> Iterator[Entry]:
    """NSM of a PBARL, after its dimensions."""
    kinds = structure.bulk.properties[ident].valid_types
    yield 0, 9 + int(kinds[card.text(4) or "TUBE"]), "NSM"


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


def _spring_loss(structure: Structure, card: NastranCard, ident: int) -> Iterator[Entry]:
    yield (0, 3, "GE1") if card.text(1) == str(ident) else (0, 7, "GE1")


def _damper(structure: Structure, card: NastranCard, ident: int) -> Iterator[Entry]:
    """PDAMP: a card may hold four of them."""
    places = (place for place in (1, 3, 5, 7) if card.text(place) == str(ident))
    yield from ((0, place + 1, "B1") for place in places)


def _line_damper(structure: Structure, card: NastranCard, ident: int) -> Iterator[Entry]:
    """PVISC, two to a card: along the line (item 1) and about it (item 2)."""
    first = 2 if card.text(1) == str(ident) else 6
    yield from ((1, first, "CE1"), (2, first + 1, "CR1"))


def _bush(kind: str) -> Callable[[Structure, NastranCard, int], Iterator[Entry]]:
    """Numbers of the row of a PBUSH that begins with K, B or GE."""

    def entries(structure: Structure, card: NastranCard, ident: int) -> Iterator[Entry]:
        for row in range(2, len(card.fields), 8):
            if card.text(row) != kind:
                continue
            for item in range(1, 7):
                if card.text(row + item):
                    yield item, row + item, f"{kind}{item}"

    return entries


_FINDERS: dict[tuple[str, str], Callable[[Structure, NastranCard, int], Iterator[Entry]]] = {
    ("thickness", "PCOMP"): _plies,
    ("thickness", "PCOMPG"): _plies,
    ("ply_angle", "PCOMP"): _angles,
    ("ply_angle", "PCOMPG"): _angles,
    ("nonstructural_mass", "PBARL"): _section_mass,
    ("shear_factor", "PBEAM"): _beam_end((1, 0, "K1"), (2, 1, "K2")),
    ("offset", "PBEAM"): _beam_end(
        (1, 12, "N1(A)"), (2, 13, "N2(A)"), (3, 14, "N1(B)"), (4, 15, "N2(B)")
    ),
    **{(quantity, "PBEAM"): _beam(quantity) for quantity in STATION},
    ("dimension", "PBARL"): _dimensions,
    ("dimension", "PBEAML"): _dimensions,
    ("spring_stiffness", "PELAS"): _spring,
    ("spring_stiffness", "PBUSH"): _bush("K"),
    ("viscous_damping", "PBUSH"): _bush("B"),
    ("viscous_damping", "PDAMP"): _damper,
    ("viscous_damping", "PVISC"): _line_damper,
    ("structural_damping", "PBUSH"): _bush("GE"),
    ("structural_damping", "PELAS"): _spring_loss,
}
