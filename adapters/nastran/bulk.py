"""What the cards mean, by pyNastran, with file and line of every card it does not accept.

pyNastran gets the cards as this project's reader found them, one by one, so that the text of a
deck has one reader and each objection has a line. Nastran judges its own deck: a card that is not
accepted is left out of pyNastran's model, and matters to those alone who would use it.

For an edited deck only the cards whose lines change are read again: what differs is set on the
model's own objects, so that all that refers to them sees it, and is taken back at the end. What
cannot be edited in this way (cards that others copy, that now refer to other cards, or that
pyNastran rejects) needs a new reading of the whole deck.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from pyNastran.bdf.bdf import BDF
from pyNastran.bdf.bdf_interface.utils import fill_dmigs

from modetune.adapters.nastran.cards import CARDS, idents_of
from modetune.adapters.nastran.deck import NastranDeck, texts_at, with_lines
from modetune.adapters.nastran.fields import (
    LOST,
    NAME,
    NastranCard,
    has_copies,
    read_cards,
    read_number,
)
from modetune.adapters.nastran.harmless import HARMLESS, TEMPERATURE_DEPENDENT
from modetune.core.errors import ModelError

#: A pyNastran model; the package ships no types.
Bulk = Any
#: What pyNastran raises on cards it cannot take: it has no one class for them, and warns of some,
#: which is an exception where warnings are errors.
OBJECTIONS = (
    SyntaxError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    RuntimeError,
    AssertionError,
    AttributeError,
    ArithmeticError,
    UserWarning,
)
#: Fields of real numbers in which whole ones occur in decks that Nastran runs: MYSTRAN stops at
#: them, and pyNastran warns or takes an orientation vector for a grid point.
REALS: dict[str, tuple[int, ...]] = {
    "MAT1": tuple(range(2, 12)), "PSHELL": (3, 5, 7, 8, 9, 10), "CQUAD4": (8, 11, 12, 13, 14),
    "CTRIA3": (7, 11, 12, 13), "CBAR": (5, 6, 7), "CBEAM": (5, 6, 7), "GRID": (3, 4, 5),
    "CONM2": (4, 5, 6, 7, *range(9, 15)), "PBAR": (*range(3, 8), *range(9, 20)),
    "PROD": (3, 4, 5, 6), "CONROD": (5, 6, 7, 8), "PELAS": (2, 3, 4, 6, 7, 8), "CELAS2": (2, 7, 8),
}  # fmt: skip
REAL_PARAMETERS = frozenset(("WTMASS", "K6ROT", "MAXRATIO", "EPZERO"))
WHOLE = re.compile(r"[+-]?\d+")
#: Cards whose columns are not plain fields: pyNastran splits their lines itself.
BY_LINES = frozenset((
    "DEQATN", "PBRSECT", "PBMSECT", "GMCURV", "GMSURF", "OUTPUT", "ADAPT", "MONDSP1", "MONPNT1",
    "MONPNT3", "MONSUMT", "AMLREG", "MICPNT",
))  # fmt: skip
#: Cards that say how to compute, in every Nastran's own way: no part of the model.
OF_THE_RUN = frozenset(("PARAM", "EIGR", "EIGRL", "EIGB", "EIGC", "EIGP"))
INTEGER = re.compile(r"[+-]?\d+")
#: Nastran's integers have 32 bits.
LARGEST = 2**31 - 1
#: Digits before the point, and an exponent of three digits or more.
HUGE = re.compile(r"[+-]?(\d*)\.?\d*(?:[EeDd]\+?|\+)0*([1-9]\d{2,})")
#: Cards that fill blank fields of others, by the others' name.
DEFAULTS = {"GRDSET": "GRID", "BAROR": "CBAR", "BEAMOR": "CBEAM"}
#: Coordinate systems given by three points.
BY_POINTS = ("CORD2R", "CORD2C", "CORD2S")
#: A message shows the first objections of many.
SHOWN = 20
#: Elements whose ends are scalar points without a card, in every Nastran.
SCALAR = ("CELAS3", "CELAS4", "CMASS3", "CMASS4", "CDAMP3", "CDAMP4", "CDAMP5")

#: Scalar masses, and the fields of their two ends, each with a component.
ENDS_AT = {"CMASS1": (3, 5), "CMASS2": (3, 5)}
#: Elements that never have any.
NO_MASS = (
    *SCALAR, "CGAP", "GENEL",
    *(row.name for row in CARDS.values() if row.form in ("scalar", "line") or row.unfollowed),
)  # fmt: skip

Cards = Mapping[int, tuple[NastranCard, ...]]


@dataclass(frozen=True, slots=True)
class Objection:
    """What pyNastran does not accept: the name of the card, and a sentence with file and line."""

    name: str
    text: str


@dataclass(frozen=True, slots=True)
class Owners:
    """Cards by the number they are known by; several where the deck repeats a number.

    The names are pyNastran's for the families of cards.
    """

    nodes: Cards
    elements: Cards
    masses: Cards
    properties: Cards
    materials: Cards
    coords: Cards


def read_bulk(deck: NastranDeck) -> tuple[Bulk, Owners, tuple[Objection, ...]]:
    """pyNastran's model of a deck, cross-referenced; cards by number; what it does not accept.

    What an objection is about is not in the model, nor are cards that pyNastran does not know.
    Raises ModelError where most of the file is no Nastran deck.
    """
    bulk = BDF(debug=None)
    bulk.log.level = "critical"
    owners = _owners(deck, bulk)
    objections = _repeated(deck, owners)
    defaults = {name: card for card in deck.cards if (name := DEFAULTS.get(card.name))}
    strange, unused = [], unused_properties(deck)
    for card in deck.cards:
        if card in objections or card.name in (*DEFAULTS, *TEMPERATURE_DEPENDENT):
            continue
        try:
            if not NAME.fullmatch(card.name):
                strange.append(card)
                raise ModelError(f"{deck.where(card)}: {_no_card(card)}")
            _check_integers(deck, card)
            add_card(bulk, deck, card, defaults.get(card.name))
        except ModelError as error:
            objections[card] = str(error)
        except OBJECTIONS as error:
            if card.name not in OF_THE_RUN:
                objections[card] = f"{deck.where(card)}: {card.name}: {_sentence(error)}"
    if 2 * len(strange) > len(deck.cards):
        refuse(objections[card] for card in strange)
    found = [Objection(card.name, text) for card, text in objections.items() if card not in unused]
    points = scalar_points(deck) - set(bulk.nodes) - set(bulk.spoints) - set(bulk.epoints)
    if points:
        bulk.add_spoint(sorted(points))
    for number in [n for n, cards in owners.properties.items() if unused.issuperset(cards)]:
        bulk.properties.pop(number, None)
    while missing := list(_missing(deck, bulk, owners)):
        found += missing
    try:
        fill_dmigs(bulk)
    except OBJECTIONS as error:
        found.append(Objection("DMIG", f"{deck.file}: DMIG: {_sentence(error)}"))
    try:
        bulk.cross_reference(
            xref_loads=False,
            xref_constraints=False,
            xref_aero=False,
            xref_sets=False,
            xref_optimization=False,
        )
    except OBJECTIONS as error:
        found.append(Objection("", f"{deck.file}: {_sentence(error)}"))
    return bulk, owners, tuple(found)


def has_mass(item: Any) -> bool:
    """Whether an element or concentrated mass of pyNastran's model has mass or inertia."""
    if item.type == "CONM1" or (item.type == "CONM2" and any(item.I)):
        return True
    try:
        return bool(item.Mass())
    except (*OBJECTIONS, NotImplementedError):  # pyNastran has no mass of some kinds
        return item.type not in NO_MASS


def unused_properties(deck: NastranDeck) -> frozenset[NastranCard]:
    """Cards of properties that no element names."""
    used = {
        card.text(2) or card.text(1)
        for card in deck.cards
        if card.name.startswith("C") or card.name in DEFAULTS
    }
    return frozenset(
        card
        for card in deck.cards
        if card.name.startswith("P")
        and card.name not in HARMLESS
        and card.text(1).isdecimal()
        and not used & {card.text(place) for place in idents_of(card.name)}
    )


def refuse(objections: Iterable[str]) -> None:
    """Raise ModelError with the first objections, if there is any."""
    found = list(objections)
    if not found:
        return
    more = len(found) - SHOWN
    tail = [f"and {more} more like these"] if more > 0 else []
    raise ModelError("\n".join(found[:SHOWN] + tail))


def _no_card(card: NastranCard) -> str:
    if card.name == LOST:
        return "this line continues no card"
    return f"{card.name[:40]!r} is not the name of a card"


def scalar_points(deck: NastranDeck) -> set[int]:
    """A deck's scalar points: named by SPOINT, or by elements between such alone."""
    found = set[int]()
    for card in deck.named("SPOINT"):
        texts = [card.text(field) for field in range(1, len(card.fields))]
        numbers = [int(text) for text in texts if text.isdecimal()]
        found.update(range(numbers[0], numbers[-1] + 1) if "THRU" in texts else numbers)
    for card in deck.named(*SCALAR):
        found.update(int(card.text(end)) for end in (3, 4) if card.text(end).isdecimal())
    return found - {0}


def add_card(bulk: Bulk, deck: NastranDeck, card: NastranCard, default: NastranCard | None) -> None:
    """Add a card to a model as this project reads it; default: the card that fills its blanks.

    Raises OBJECTIONS, ModelError.
    """
    if card.name in BY_POINTS:
        _check_axes(deck, card)
    # The lax way differs from the other in that it raises at once and prints nothing.
    if card.name in BY_LINES:
        texts = [deck.lines[line].text.partition("$")[0] for line in card.lines]
        bulk.add_card_lax(texts, card.name, is_list=False, has_none=False)
        return
    texts = [card.name, *filled(card, default)]
    if card.name == "CMASS3":  # pyNastran 1.4.1 loses its way where one end is on the ground
        texts = ["CMASS1", *texts[1:4], "", card.text(4), ""]
    if texts[0] in ("CELAS1", "CMASS4"):
        texts[3:4] = [card.text(3) or "0"]
    if texts[0] in ENDS_AT:  # and where the ground is 0, or the first end
        ends = [texts[place : place + 2] for place in ENDS_AT[texts[0]] if len(texts) > place]
        ends = [[*end, ""][:2] for end in ends if end[0] not in ("", "0")]
        texts = [*texts[:3], *(text for end in ends for text in end), *texts[7:]]
    bulk.add_card_lax(texts, texts[0], is_list=True, has_none=False)
    if card.name == "MAT8":
        # A blank G1Z or G2Z means no transverse shear; pyNastran puts 1e8 there, in any unit.
        material = bulk.materials[int(card.text(1))]
        material.g1z = material.g1z if card.text(6) else 0.0
        material.g2z = material.g2z if card.text(7) else 0.0


def filled(card: NastranCard, default: NastranCard | None) -> list[str]:
    """The data fields of a card; blank ones are the default card's, a GRDSET's for a GRID.

    Whole numbers in fields of real ones have a point.
    """
    if default is None:
        texts = [field.text.upper() if field else "" for field in card.fields[1:]]
        return with_points(card.name, texts)
    count = max(len(card.fields), len(default.fields))
    texts = [card.text(field) or default.text(field) for field in range(1, count)]
    return with_points(card.name, texts)


def with_points(name: str, texts: list[str]) -> list[str]:
    """Return the data fields of a card with points behind whole numbers where real ones belong."""
    real = REALS.get(name, ())
    if name == "PARAM" and texts and texts[0].upper() in REAL_PARAMETERS:
        real = (2,)
    if name in ("CBAR", "CBEAM") and not any(texts[5:7]):  # a grid point gives the orientation
        real = ()
    return [
        f"{text}." if place in real and WHOLE.fullmatch(text) else text
        for place, text in enumerate(texts, 1)
    ]


def _check_axes(deck: NastranDeck, card: NastranCard) -> None:
    """Refuse a coordinate system whose points lie in a line: pyNastran would print its axes."""
    try:
        numbers = [read_number(card.text(field) or "0") for field in range(3, 12)]
    except ValueError as error:
        raise ModelError(f"{deck.where(card)}: {card.name}: {error}") from None
    origin, along, plane = np.array(numbers).reshape(3, 3)
    if not np.linalg.norm(np.cross(along - origin, plane - origin)) > 0.0:
        raise ModelError(f"{deck.where(card)}: {card.name}: the three points lie in one line")


def _sentence(error: Exception) -> str:
    """What pyNastran says, without the card and the long lists that it adds."""
    message = str(error.args[0]) if error.args else type(error).__name__
    first = next((line.strip() for line in message.splitlines() if line.strip()), message)
    text = re.split(r"[.;]?\s+[Aa]llowed|\. ", first)[0].rstrip(".;: ")
    return f"it refers to {text}, which is not there" if text.isdigit() else text


def _owners(deck: NastranDeck, bulk: Bulk) -> Owners:
    families: dict[str, dict[int, tuple[NastranCard, ...]]] = {
        family.name: {} for family in fields(Owners)
    }
    slots = bulk.get_rslot_map()
    for card in deck.cards:
        found = families.get(slots.get(card.name, ""))
        if found is None:
            continue
        for field in idents_of(card.name):
            if INTEGER.fullmatch(card.text(field)):
                number = int(card.text(field))
                found[number] = (*found.get(number, ()), card)
    return Owners(**families)


def _check_integers(deck: NastranDeck, card: NastranCard) -> None:
    """Refuse an integer that Nastran does not read, and a real number that no computer holds."""
    for field in card.fields:
        text = field.text if field else ""
        if (huge := HUGE.fullmatch(text)) and len(huge[1]) + float(huge[2][:9]) > 300.0:
            raise ModelError(f"{deck.where(card)}: {card.name}: {text[:30]} is no finite number")
        if len(text) < len(str(LARGEST)) or not INTEGER.fullmatch(text):
            continue
        if len(text) > 19 or abs(int(text)) > LARGEST:
            raise ModelError(
                f"{deck.where(card)}: {card.name}: {text[:30]} is larger than {LARGEST}, the "
                "largest integer of Nastran"
            )


def _repeated(deck: NastranDeck, owners: Owners) -> dict[NastranCard, str]:
    """Return cards that give a used number to something else; equal cards may occur twice."""
    found = {}
    for family in (getattr(owners, field.name) for field in fields(Owners)):
        for number, cards in family.items():
            texts = {tuple(field and field.text.upper() for field in card.fields) for card in cards}
            if len(texts) > 1:
                places = " and ".join(deck.where(card) for card in cards)
                text = f"{places}: {cards[1].name} {number} is there more than once"
                found.update(dict.fromkeys(cards[1:], text))
    return found


def _missing(deck: NastranDeck, bulk: Bulk, owners: Owners) -> Iterator[Objection]:
    """Cards that refer to a card which is not there; they are taken out of the model."""
    for number, node in list(bulk.nodes.items()):
        for system in {node.Cp(), node.Cd()} - set(bulk.coords) - {-1}:
            del bulk.nodes[number]
            where = _where(deck, owners.nodes, number)
            yield Objection(
                "GRID", f"{where}: GRID {number}: coordinate system {system} is not there"
            )
            break
    families = (
        (bulk.properties, owners.properties),
        (bulk.elements, owners.elements),
        (bulk.masses, owners.masses),
    )
    for items, cards in families:
        for number, item in list(items.items()):
            try:
                item.cross_reference(bulk)
            except OBJECTIONS as error:
                del items[number]
                where = _where(deck, cards, number)
                text = f"{where}: {item.type} {number}: {_sentence(error)}"
                yield Objection(item.type, text)


def _where(deck: NastranDeck, cards: Cards, number: int) -> str:
    return deck.where(cards[number][0]) if number in cards else str(deck.file)


#: Families of cards, by pyNastran's names, whose numbers may be edited in place.
FAMILIES = ("elements", "masses", "properties", "properties_mass", "materials")

#: An object of the model, and new values of its attributes.
Patch = tuple[Any, dict[str, Any]]


@contextmanager
def edited_bulk(deck: NastranDeck, bulk: Bulk, changed: Mapping[int, str]) -> Iterator[Bulk]:
    """The model of a deck with some lines changed, valid inside of the context alone.

    bulk: that of the unchanged deck, locked against other readers. Raises ModelError.
    """
    patches = _patches(deck, bulk, changed) if changed else []
    if patches is None:
        yield read_bulk(with_lines(deck, changed))[0]
        return
    kept = [(item.__dict__, dict(item.__dict__)) for item, _ in patches]
    try:
        for item, values in patches:
            item.__dict__.update(values)
        yield bulk
    finally:
        for own, values in reversed(kept):
            own.clear()
            own.update(values)


def _patches(deck: NastranDeck, bulk: Bulk, changed: Mapping[int, str]) -> list[Patch] | None:
    """What to set on which objects; None where the deck has to be read again."""
    if deck.parts:  # a card's own number may not be the model's
        return None
    if has_copies(deck.lines, deck.bulk):
        return None
    if any("\n" in text for text in changed.values()):  # cards are added
        return None
    cards = [card for card in deck.cards if not changed.keys().isdisjoint(card.lines)]
    if not set(changed) <= {line for card in cards for line in card.lines}:
        return None
    if any(card.name in BY_LINES or card.name in DEFAULTS for card in cards):
        return None
    now = texts_at(deck, changed)
    defaults = {name: card for card in deck.cards if (name := DEFAULTS.get(card.name))}
    patches: list[Patch] = []
    try:
        for card in cards:
            before, after = (
                _objects(deck, read_cards(texts, card.lines), defaults.get(card.name))
                for texts in (deck.lines, now)
            )
            if not before or before.keys() != after.keys():
                return None
            for place, old in before.items():
                item = getattr(bulk, place[0]).get(place[1])
                new = after[place]
                if type(item) is not type(old) or type(new) is not type(old):
                    return None
                patches.append((item, _differences(old, new)))
    except (*OBJECTIONS, ModelError):
        return None
    return patches


def _objects(
    deck: NastranDeck, cards: tuple[NastranCard, ...], default: NastranCard | None
) -> dict[tuple[str, int], Any]:
    """What pyNastran makes of one card, by family and number; nothing where it is none of these."""
    if len(cards) != 1:
        return {}
    scratch = BDF(debug=None)
    scratch.log.level = "critical"
    add_card(scratch, deck, cards[0], default)
    return {
        (family, number): item
        for family in FAMILIES
        for number, item in getattr(scratch, family).items()
    }


def _differences(old: Any, new: Any) -> dict[str, Any]:
    """The attributes of a card's object that an edit changed."""
    before, after = vars(old), vars(new)
    return {
        name: value
        for name, value in after.items()
        if name not in before or not _same(before[name], value)
    }


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        return np.array_equal(one, other)
    if isinstance(one, float) and isinstance(other, float) and one != one:
        return other != other  # neither is a number
    return type(one) is type(other) and bool(one == other)
