"""Numbers of a deck edited in pyNastran's model of it, without reading the deck again.

Only the cards whose lines change are read, as they were and as they are now; what differs between
the two is set on the model's own objects, so that all that refers to them sees it, and is taken
back at the end. What cannot be edited so (cards that are copied by others, that refer elsewhere
now, or that pyNastran objects to) is read with the whole deck.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
from pyNastran.bdf.bdf import BDF

from modetune.adapters.nastran.bulk import BY_LINES, DEFAULTS, OBJECTIONS, Bulk, add_card, read_bulk
from modetune.adapters.nastran.cards import read_cards
from modetune.adapters.nastran.deck import NastranCard, NastranDeck, texts_at, with_lines
from modetune.core.errors import ModelError

#: Families of cards, by pyNastran's names, whose numbers may be edited in place.
FAMILIES = ("elements", "masses", "properties", "properties_mass", "materials")
#: How a line begins that copies a card above it.
COPIES = ("=", "*(")

#: An object of the model, and new values of its attributes.
Patch = tuple[Any, dict[str, Any]]


@contextmanager
def edited_bulk(deck: NastranDeck, bulk: Bulk, changed: Mapping[int, str]) -> Iterator[Bulk]:
    """The model of a deck with some lines changed, valid inside of the context alone.

    bulk: that of the deck as it is; nobody else may look at it meanwhile. Raises ModelError.
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
    if any(deck.lines[position].text.lstrip().startswith(COPIES) for position in deck.bulk):
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
