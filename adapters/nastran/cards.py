"""The cards of a Nastran deck whose numbers parameters scale: one row for each card.

A row names the owner of the numbers (a material, a property, an element or a mass) and gives, for
each quantity, the fields, the matrices that they move, the powers in which, and whether they alone
make the strain energy of their elements. Everything else follows from the row: the
fields that a parameter scales, what it moves, which cards are copied for it, and what damps the
model.

A field is (item, field, symbol): the item by which a parameter picks it (0 where there is no
choice, -1 where it only goes with all others), its field on the card, and its name in the cards of
SOL 200 (the number of the field where a name would begin with a digit). Fields that depend on the
card (a ply, a station of a tapered beam, a dimension of a cross-section, the K row of a bush) are
found by the functions below.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal

from pyNastran.bdf.bdf import PBARL, PBEAML

from modetune.adapters.nastran.deck import NastranDeck
from modetune.adapters.nastran.fields import NastranCard
from modetune.core.errors import ModelError
from modetune.core.parameters import Quantity

Field = tuple[int, int, str]
#: Finds the fields on a card of a deck, whose number is the last argument.
Finder = Callable[[NastranDeck, NastranCard, int], Iterable[Field]]

#: Powers of the thickness of a plate. MYSTRAN's elements have t in the plane, t^3 in bending, and
#: of shear t^3 / (t^2 + c), with c by the element's size: no polynomial, but one of six powers
#: through six thicknesses between half and double is off by 3e-6 of the stiffness and of the
#: eigenvalues at most.
PLATE = (1, 2, 3, 4, 5, 6)
#: Fields of the properties at one station of a PBEAM, after its first field.
STATION: dict[Quantity, tuple[int, str]] = {
    "area": (2, "A"), "inertia_1": (3, "I1"), "inertia_2": (4, "I2"), "inertia_12": (5, "I12"),
    "torsion_constant": (6, "J"), "nonstructural_mass": (7, "NSM"),
}  # fmt: skip
#: What a row of a PBEAM or PBEAML starts with where it begins a station (stress output there).
STATION_MARKS = ("YES", "YESA", "NO")
#: Shapes of cross-sections with the number of their dimensions.
DIMENSIONS = {"PBARL": PBARL.valid_types, "PBEAML": PBEAML.valid_types}


@dataclass(frozen=True, slots=True)
class CardNumbers:
    """The numbers of a card that one quantity is.

    moves: which of K and M they move. powers: K and M are a sum of these powers of their relative
    value and a constant; empty where they are no such sum. energy: whether the strain energy of the
    elements is proportional to all these numbers together. blank: what a blank field means, None
    where it means that there is no number. needs: field and name of another material without which
    they have no effect. series: fields by which something acts in series with them, so that K is
    linear only where these are zero. stations: whether they are one quantity along a beam.
    """

    fields: tuple[Field | Finder, ...]
    moves: Literal["", "K", "M", "KM"] = "KM"
    powers: tuple[int, ...] = ()
    energy: bool = False
    blank: float | None = None
    needs: tuple[int, str] | None = None
    series: tuple[int, ...] = ()
    stations: bool = False


@dataclass(frozen=True, slots=True)
class CardKind:
    """A kind of card.

    numbers: by quantity. idents: fields of the numbers by which others name it, several on a card
    that holds several properties, whose fields follow each other alike. materials: fields that name
    materials. plies: the field of the first ply's material, and how far the next one's is. form:
    what a spring or damper acts on: one component of its ends, the line between them, or six
    directions in its axes. unfollowed: pyNastran's name of damping that is not followed.
    """

    name: str
    owner: Literal["material", "property", "element", "mass"]
    numbers: Mapping[Quantity, CardNumbers] = field(default_factory=dict)
    idents: tuple[int, ...] = (1,)
    materials: tuple[int, ...] = (2,)
    plies: tuple[int, int] | None = None
    form: Literal["", "scalar", "line", "bush"] = ""
    unfollowed: str = ""


def holds(quantity: Quantity, name: str) -> bool:
    """Return whether cards of this name hold a quantity themselves."""
    return name in CARDS and quantity in CARDS[name].numbers


def fields_of(deck: NastranDeck, quantity: Quantity, card: NastranCard, ident: int) -> list[Field]:
    """Return the fields of a quantity on a card. Raises ModelError where it has none."""
    where = deck.where(card)
    if not holds(quantity, card.name):
        if card.name in DIMENSIONS and quantity in STATION and quantity != "nonstructural_mass":
            raise ModelError(
                f"{where}: {card.name} {ident} gives dimensions: update `dimension` with an item"
            )
        raise ModelError(f"{where}: {card.name} {ident} has no {quantity} that can be updated")
    row = CARDS[card.name]
    first = next((at for at in row.idents if card.text(at) == str(ident)), row.idents[-1])
    found: list[Field] = []
    for each in row.numbers[quantity].fields:
        found += each(deck, card, ident) if callable(each) else [each]
    return [(item, at + first - row.idents[0], symbol) for item, at, symbol in found]


def idents_of(name: str) -> tuple[int, ...]:
    """Return the fields of the numbers by which other cards name this one."""
    return CARDS[name].idents if name in CARDS else (1,)


def materials_named(card: NastranCard) -> Iterable[int]:
    """Return the fields in which a property or a rod names materials."""
    row = CARDS.get(card.name)
    if row is None:
        return (2,)
    return range(row.plies[0], len(card.fields), row.plies[1]) if row.plies else row.materials


def station_rows(card: NastranCard) -> list[int]:
    """Return the first fields of the stations of a PBEAM after end A."""
    return [row for row in range(9, len(card.fields), 8) if card.text(row) in STATION_MARKS]


def _ply_fields(card: NastranCard) -> range:
    """Fields of the plies' thicknesses."""
    plies = CARDS[card.name].plies
    assert plies
    first, stride = plies[0] + 1, plies[1]
    return range(first, first + stride * -(-(len(card.fields) - 9) // stride), stride)


def _ply_thicknesses(deck: NastranDeck, card: NastranCard, ident: int) -> Iterator[Field]:
    """Of PCOMP and PCOMPG; a blank one is that of the ply before."""
    fields = _ply_fields(card)
    given = [bool(card.text(at)) for at in fields]
    if card.name == "PCOMP" and not all(given):
        blank = given.index(False) + 1
        raise ModelError(
            f"{deck.where(card)}: ply {blank} of PCOMP {ident} has a blank thickness, which "
            "follows the ply before it: write it out"
        )
    for ply, at in enumerate(fields, start=1):
        if card.text(at):
            yield ply, at, f"T{ply}"


def _ply_angles(deck: NastranDeck, card: NastranCard, ident: int) -> Iterator[Field]:
    for ply, at in enumerate(_ply_fields(card), start=1):
        if card.text(at) or card.text(at + 1):
            yield ply, at + 1, f"THETA{ply}"


def _stations(quantity: Quantity) -> Finder:
    """Numbers of all stations of a PBEAM: end A, then each row that starts with a mark.

    An item counts the stations as the card has them. Blank ones follow end A, or the ends between
    which they lie, and scale with those.
    """
    offset, symbol = STATION[quantity]

    def found(deck: NastranDeck, card: NastranCard, ident: int) -> Iterator[Field]:
        yield 1, 1 + offset, f"{symbol}(A)"
        if not card.text(1 + offset):
            raise ModelError(f"{deck.where(card)}: {symbol} of PBEAM {ident} is blank at end A")
        for station, row in enumerate(station_rows(card), start=1):
            if card.text(row + offset):
                end = deck.number(card, row + 1) == 1.0
                yield station + 1, row + offset, f"{symbol}({'B' if end else station})"

    return found


def _after_stations(*fields: Field) -> Finder:
    """Return a finder of numbers that a PBEAM has once, in the rows after its last station.

    fields: counted from the first of these rows. A row that begins a station with YES is followed
    by one of stress points, as end A is where it has stations or nothing else.
    """

    def found(deck: NastranDeck, card: NastranCard, ident: int) -> Iterator[Field]:
        marks = station_rows(card)
        first = marks[-1] + (16 if card.text(marks[-1]) == "YES" else 8) if marks else 17
        for item, at, symbol in fields:
            yield item, first + at, symbol

    return found


def _section_mass(deck: NastranDeck, card: NastranCard, ident: int) -> Iterator[Field]:
    """NSM of a PBARL, after its dimensions."""
    yield 0, 9 + int(DIMENSIONS[card.name][card.text(4) or "TUBE"]), "NSM"


def _dimensions(deck: NastranDeck, card: NastranCard, ident: int) -> Iterator[Field]:
    """Dimensions of a PBARL, or of all stations of a PBEAML (blank ones follow end A)."""
    count = int(DIMENSIONS[card.name][card.text(4) or "TUBE"])
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
                end = deck.number(card, row - 1) == 1.0
                yield item, row + item - 1, f"DIM{item}({'B' if end else station})"
        row, station = row + count + 3, station + 1


def _bush(kind: str) -> Finder:
    """Numbers of the row of a PBUSH that begins with K, B or GE."""

    def found(deck: NastranDeck, card: NastranCard, ident: int) -> Iterator[Field]:
        for row in range(2, len(card.fields), 8):
            if card.text(row) != kind:
                continue
            for item in range(1, 7):
                if card.text(row + item):
                    yield item, row + item, f"{kind}{item}"

    return found


def _stiffness(*fields: Field | Finder) -> CardNumbers:
    return CardNumbers(fields, "K", (1,), energy=True)


def _mass(*fields: Field) -> CardNumbers:
    return CardNumbers(fields, "M", (1,))


def _linear(*fields: Field | Finder, series: tuple[int, ...] = ()) -> CardNumbers:
    return CardNumbers(fields, powers=(1,), series=series)


def _damping(*fields: Field | Finder) -> CardNumbers:
    return CardNumbers(fields, "", (1,))


def _other(*fields: Field | Finder) -> CardNumbers:
    return CardNumbers(fields)


def _beam(quantity: Quantity) -> CardNumbers:
    """K is linear in J and NSM of a PBEAM; its A and I act in series with shear (blank K is 1)."""
    linear = quantity in ("torsion_constant", "nonstructural_mass")
    return CardNumbers((_stations(quantity),), powers=(1,) if linear else (), stations=True)


_MAT9 = ("11", "12", "13", "14", "15", "16", "22", "23", "24", "25", "26", "33", "34", "35",
         "36", "44", "45", "46", "55", "56", "66")  # fmt: skip
#: K1 and K2 of a PBAR: shear acts in series with bending where they are given,
#: K = 12 EI / (L^3 (1 + phi)), phi = 12 EI / (K1 A G L^2).
_SHEAR = (17, 18)
#: Offsets of both ends of a bar or beam, their fields after the pin flags.
_ENDS = tuple((place, 10 + place, f"W{place - 3 * (place > 3)}{'AB'[place > 3]}")
              for place in range(1, 7))  # fmt: skip
_INERTIA = ((11, 9, "I11"), (21, 10, "I21"), (22, 11, "I22"), (31, 12, "I31"), (32, 13, "I32"),
            (33, 14, "I33"))  # fmt: skip
_LAMINATE: dict[Quantity, CardNumbers] = {
    "thickness": _other(_ply_thicknesses),
    "ply_angle": _other(_ply_angles),
    "nonstructural_mass": _linear((0, 3, "NSM")),
    "offset": _other((0, 2, "Z0")),
    "structural_damping": _damping((0, 7, "GE")),
}
_ROWS = (
    CardKind("MAT1", "material", {
        # G goes along with E, so that Poisson's ratio stays and the stiffness is proportional.
        "youngs_modulus": _stiffness((0, 2, "E"), (-1, 3, "G")),
        "shear_modulus": _other((0, 3, "G")),
        "poissons_ratio": _other((0, 4, "NU")),
        "density": _mass((0, 5, "RHO")),
        "structural_damping": _damping((0, 8, "GE")),
    }),
    CardKind("MAT2", "material", {
        "youngs_modulus": _stiffness((11, 2, "G11"), (12, 3, "G12"), (13, 4, "G13"),
                                     (22, 5, "G22"), (23, 6, "G23"), (33, 7, "G33")),
        "density": _mass((0, 8, "RHO")),
        "structural_damping": _damping((0, 12, "GE")),
    }),
    CardKind("MAT3", "material", {"density": _mass((0, 8, "RHO"))}),
    CardKind("MAT8", "material", {
        "youngs_modulus": _stiffness((1, 2, "E1"), (2, 3, "E2"), (-1, 5, "G12"), (-1, 6, "G1Z"),
                                     (-1, 7, "G2Z")),
        "shear_modulus": _other((12, 5, "G12"), (13, 6, "G1Z"), (23, 7, "G2Z")),
        "poissons_ratio": _other((0, 4, "NU12")),
        "density": _mass((0, 8, "RHO")),
        "structural_damping": _damping((0, 17, "GE")),
    }),
    CardKind("MAT9", "material", {
        "youngs_modulus": _stiffness(*((int(pair), at, f"G{pair}")
                                       for at, pair in enumerate(_MAT9, start=2))),
        "density": _mass((0, 23, "RHO")),
        "structural_damping": _damping((0, 31, "GE")),
    }),
    CardKind("MAT10", "material", {"density": _mass((0, 3, "RHO"))}),
    CardKind("MAT11", "material", {"density": _mass((0, 11, "RHO"))}),
    CardKind("PSHELL", "property", {
        "thickness": CardNumbers(((0, 3, "T"),), powers=PLATE),
        "bending_inertia_ratio": CardNumbers(((0, 5, "6"),), blank=1.0, needs=(4, "MID2")),
        "shear_thickness_ratio": CardNumbers(((0, 7, "TS/T"),), blank=0.833333, needs=(6, "MID3")),
        "nonstructural_mass": _linear((0, 8, "NSM")),
    }, materials=(2, 4, 6, 11)),
    CardKind("PSHEAR", "property", {
        "thickness": _other((0, 3, "T")),
        "nonstructural_mass": _linear((0, 4, "NSM")),
    }),
    CardKind("PCOMP", "property", _LAMINATE, plies=(9, 4)),
    CardKind("PCOMPG", "property", _LAMINATE, plies=(10, 8)),
    CardKind("PBAR", "property", {
        "area": _linear((0, 3, "A"), series=_SHEAR),
        "inertia_1": _linear((0, 4, "I1"), series=_SHEAR),
        "inertia_2": _linear((0, 5, "I2"), series=_SHEAR),
        "inertia_12": _other((0, 19, "I12")),
        "torsion_constant": _linear((0, 6, "J")),
        "shear_factor": _other((1, 17, "K1"), (2, 18, "K2")),
        "nonstructural_mass": _linear((0, 7, "NSM")),
    }),
    CardKind("PBARL", "property", {
        "dimension": _other(_dimensions),
        "nonstructural_mass": _linear(_section_mass),
    }),
    CardKind("PBEAM", "property", {
        **{quantity: _beam(quantity) for quantity in STATION},
        "shear_factor": CardNumbers((_after_stations((1, 0, "K1"), (2, 1, "K2")),), blank=1.0),
        "offset": _other(_after_stations((1, 12, "N1(A)"), (2, 13, "N2(A)"), (3, 14, "N1(B)"),
                                         (4, 15, "N2(B)"))),
    }),
    CardKind("PBEAML", "property", {"dimension": _other(_dimensions)}),
    CardKind("PROD", "property", {
        "area": _linear((0, 3, "A")),
        "torsion_constant": _linear((0, 4, "J")),
        "nonstructural_mass": _linear((0, 6, "NSM")),
    }),
    CardKind("PTUBE", "property", {"nonstructural_mass": _linear((0, 5, "NSM"))}),
    CardKind("PELAS", "property", {
        "spring_stiffness": _stiffness((0, 2, "K1")),
        "structural_damping": _damping((0, 3, "GE1")),
    }, idents=(1, 5)),
    CardKind("PBUSH", "property", {
        "spring_stiffness": _stiffness(_bush("K")),
        "viscous_damping": _damping(_bush("B")),
        "structural_damping": _damping(_bush("GE")),
    }),
    CardKind("PDAMP", "property", {"viscous_damping": _damping((0, 2, "B1"))}, idents=(1, 3, 5, 7)),
    # Along the line (item 1) and about it (item 2).
    CardKind("PVISC", "property", {"viscous_damping": _damping((1, 2, "CE1"), (2, 3, "CR1"))},
         idents=(1, 5)),
    CardKind("CONROD", "element", {
        "area": _linear((0, 5, "A")),
        "torsion_constant": _linear((0, 6, "J")),
        "nonstructural_mass": _linear((0, 8, "NSM")),
    }, materials=(4,)),
    CardKind("CBAR", "element", {"offset": _other(*_ENDS)}),
    CardKind("CBEAM", "element", {"offset": _other(*_ENDS)}),
    *(
        CardKind(name, "element", {"offset": _other((0, 8, "ZOFFS"))})
        for name in ("CQUAD4", "CQUADR")
    ),
    *(
        CardKind(name, "element", {"offset": _other((0, 7, "ZOFFS"))})
        for name in ("CTRIA3", "CTRIAR")
    ),
    CardKind("CELAS1", "element", form="scalar"),
    CardKind("CELAS2", "element", {
        "spring_stiffness": _stiffness((0, 2, "K")),
        "structural_damping": _damping((0, 7, "GE")),
    }, form="scalar"),
    CardKind("CELAS3", "element", form="scalar"),
    CardKind("CELAS4", "element", {"spring_stiffness": _stiffness((0, 2, "K"))}, form="scalar"),
    CardKind("CDAMP1", "element", form="scalar"),
    CardKind("CDAMP2", "element", {"viscous_damping": _damping((0, 2, "B"))}, form="scalar"),
    CardKind("CDAMP3", "element", form="scalar"),
    CardKind("CDAMP4", "element", {"viscous_damping": _damping((0, 2, "B"))}, form="scalar"),
    CardKind("CVISC", "element", form="line"),
    CardKind("CBUSH", "element", form="bush"),
    CardKind("CBUSH1D", "element", unfollowed="c"),
    CardKind("CBUSH2D", "element", unfollowed="b1"),
    CardKind("CMASS2", "mass", {"mass": _mass((0, 2, "M"))}),
    CardKind("CMASS4", "mass", {"mass": _mass((0, 2, "M"))}),
    CardKind("CONM2", "mass", {
        # The inertia goes along with the mass: the body keeps its shape.
        "mass": _mass((0, 4, "M"), *((-1, at, symbol) for _, at, symbol in _INERTIA)),
        "rotary_inertia": _linear(*_INERTIA),
        "offset": _other((1, 5, "X1"), (2, 6, "X2"), (3, 7, "X3")),
    }),
)  # fmt: skip
CARDS = {row.name: row for row in _ROWS}
