"""What the cards mean, by pyNastran, with file and line of every card it does not accept.

pyNastran gets the cards as this project's reader found them, one by one, so that the text of a
deck has one reader and each objection has a line.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from pyNastran.bdf.bdf import BDF

from modetune.adapters.nastran.deck import NastranCard, NastranDeck
from modetune.adapters.nastran.number import read_number
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
#: Cards whose columns are not plain fields: pyNastran splits their lines itself.
BY_LINES = frozenset((
    "DEQATN", "PBRSECT", "PBMSECT", "GMCURV", "GMSURF", "OUTPUT", "ADAPT", "MONDSP1", "MONPNT1",
    "MONPNT3", "MONSUMT", "AMLREG", "MICPNT",
))  # fmt: skip
#: Cards that say how to compute, in every Nastran's own way: no part of the model.
OF_THE_RUN = frozenset(("PARAM", "EIGR", "EIGRL", "EIGB", "EIGC", "EIGP"))
INTEGER = re.compile(r"[+-]?\d+")
#: Cards that hold several properties, and the fields in which their numbers stand.
SEVERAL = {"PELAS": (1, 5), "PVISC": (1, 5), "PDAMP": (1, 3, 5, 7)}
#: Coordinate systems given by three points.
BY_POINTS = ("CORD2R", "CORD2C", "CORD2S")
#: A deck in another language has an objection to each card; the first ones tell what is wrong.
MOST_PROBLEMS = 20

Cards = Mapping[int, tuple[NastranCard, ...]]


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


def read_bulk(deck: NastranDeck) -> tuple[Bulk, Owners, tuple[NastranCard, ...]]:
    """pyNastran's model of a deck, cross-referenced; cards by number; cards it does not know.

    Raises ModelError with the file and line of each card that it does not accept.
    """
    bulk = BDF(debug=None)
    bulk.log.level = "critical"
    owners = _owners(deck, bulk)
    # Before the cards are given to pyNastran, which would print both of a pair.
    _refuse(_repeated(deck, owners))
    problems, unknown = [], []
    for card in deck.cards:
        rejected = len(bulk.reject_cards)
        try:
            _add(bulk, deck, card)
        except ModelError as error:
            problems.append(str(error))
        except OBJECTIONS as error:
            if card.name in OF_THE_RUN:
                unknown.append(card)
            else:
                problems.append(f"{deck.where(card)}: {card.name}: {_sentence(error)}")
        if len(bulk.reject_cards) > rejected:
            unknown.append(card)
    _refuse(problems)
    _refuse(_missing(deck, bulk, owners))
    try:
        bulk.cross_reference(
            xref_loads=False,
            xref_constraints=False,
            xref_aero=False,
            xref_sets=False,
            xref_optimization=False,
        )
    except OBJECTIONS as error:
        raise ModelError(f"{deck.file}: {_sentence(error)}") from error
    return bulk, owners, tuple(unknown)


def _add(bulk: Bulk, deck: NastranDeck, card: NastranCard) -> None:
    if card.name in BY_POINTS:
        _check_axes(deck, card)
    # The lax way differs from the other in that it raises at once and prints nothing.
    if card.name in BY_LINES:
        texts = [deck.lines[line].text.partition("$")[0] for line in card.lines]
        bulk.add_card_lax(texts, card.name, is_list=False, has_none=False)
        return
    texts = [card.name, *(card.text(field) for field in range(1, len(card.fields)))]
    bulk.add_card_lax(texts, card.name, is_list=True, has_none=False)
    if card.name == "MAT8":
        # A blank G1Z or G2Z means no transverse shear; pyNastran puts 1e8 there, in any unit.
        material = bulk.materials[int(card.text(1))]
        material.g1z = material.g1z if card.text(6) else 0.0
        material.g2z = material.g2z if card.text(7) else 0.0


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
    said = str(error.args[0]) if error.args else type(error).__name__
    first = next((line.strip() for line in said.splitlines() if line.strip()), said)
    text = re.split(r"[.;]?\s+[Aa]llowed|\. ", first)[0].rstrip(".;: ")
    return f"it refers to {text}, which is not there" if text.isdigit() else text


def _refuse(problems: Iterable[str]) -> None:
    found = list(problems)
    if not found:
        return
    more = len(found) - MOST_PROBLEMS
    tail = [f"and {more} more like these"] if more > 0 else []
    raise ModelError("\n".join(found[:MOST_PROBLEMS] + tail))


def _owners(deck: NastranDeck, bulk: Bulk) -> Owners:
    families: dict[str, dict[int, tuple[NastranCard, ...]]] = {
        family.name: {} for family in fields(Owners)
    }
    slots = bulk.get_rslot_map()
    for card in deck.cards:
        found = families.get(slots.get(card.name, ""))
        if found is None:
            continue
        for field in SEVERAL.get(card.name, (1,)):
            if INTEGER.fullmatch(card.text(field)):
                number = int(card.text(field))
                found[number] = (*found.get(number, ()), card)
    return Owners(**families)


def _repeated(deck: NastranDeck, owners: Owners) -> Iterator[str]:
    """Numbers given twice to different nodes or elements; equal cards may stand twice."""
    for family in (getattr(owners, field.name) for field in fields(Owners)):
        for number, cards in family.items():
            texts = {tuple(field and field.text.upper() for field in card.fields) for card in cards}
            if len(texts) > 1:
                places = " and ".join(deck.where(card) for card in cards)
                yield f"{places}: {cards[1].name} {number} is there more than once"


def _missing(deck: NastranDeck, bulk: Bulk, owners: Owners) -> Iterator[str]:
    """Cards that refer to a card which is not there."""
    families = (
        (bulk.elements, owners.elements),
        (bulk.masses, owners.masses),
        (bulk.properties, owners.properties),
    )
    for items, cards in families:
        for number, item in items.items():
            try:
                item.cross_reference(bulk)
            except OBJECTIONS as error:
                where = deck.where(cards[number][0]) if number in cards else str(deck.file)
                yield f"{where}: {item.type} {number}: {_sentence(error)}"
    for number, node in bulk.nodes.items():
        for system in {node.Cp(), node.Cd()} - set(bulk.coords) - {-1}:
            cards_here = owners.nodes.get(number, ())
            where = deck.where(cards_here[0]) if cards_here else str(deck.file)
            yield f"{where}: GRID {number}: coordinate system {system} is not there"
