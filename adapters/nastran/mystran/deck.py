"""What MYSTRAN requires otherwise than Nastran, and what it cannot do at all."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from modetune.adapters.nastran.bulk import DEFAULTS, Bulk, filled, unused_properties
from modetune.adapters.nastran.case_control import members_of
from modetune.adapters.nastran.deck import NastranDeck
from modetune.adapters.nastran.fields import NastranCard, large_field
from modetune.adapters.nastran.harmless import HARMLESS
from modetune.adapters.nastran.mesh import output_frames
from modetune.adapters.nastran.mystran.beams import CARDS as BEAM_CARDS
from modetune.adapters.nastran.mystran.beams import BeamCards
from modetune.adapters.nastran.mystran.scalars import ALL, ELEMENTS, PROPERTIES, Card, Scalars
from modetune.adapters.nastran.mystran.shells import CARDS as SHELL_CARDS
from modetune.adapters.nastran.mystran.shells import ShellCards
from modetune.adapters.nastran.mystran.solids import CARDS as SOLID_CARDS
from modetune.adapters.nastran.mystran.solids import SolidCards
from modetune.core.errors import ModelError
from modetune.core.modes import Floats

#: Cards whose modes by MYSTRAN were compared with another solver's or a closed form. What is
#: neither here nor harmless is refused: MYSTRAN passes over some cards without a word.
COMPARED = frozenset({
    "GRID", "CORD1R", "CORD1C", "CORD1S", "CORD2R", "CORD2C", "CORD2S", "PARAM", "CQUAD4", "CTRIA3",
    "CHEXA", "CPENTA", "CTETRA", "CBAR", "CBEAM", "CROD", "CONROD", "CTUBE", "CBUSH", "CONM2",
    "PSHELL", "PCOMP", "PSOLID", "PBAR", "PBARL", "PBEAM", "PBEAML", "PROD", "PTUBE", "PBUSH",
    "MAT1", "MAT8", "RBE2", "RBE3", "RBAR", "RBAR1", "SPC", "SPC1", "SPCADD", "MPC", "MPCADD",
    "SPOINT", "MAT2", "CSHEAR", "PSHEAR", *ELEMENTS, *PROPERTIES,
})  # fmt: skip
#: Those of which large decks have most; what MYSTRAN reads depends on nothing else in the deck.
MOST = frozenset({"GRID", "CQUAD4", "CTRIA3", "CHEXA", "CPENTA", "CTETRA"})
#: Texts in large field by card and the card that fills its blanks.
Texts = dict[tuple[NastranCard, NastranCard | None], str]
#: Field of shells that says whether their thicknesses are relative.
TFLAGS = {"CQUAD4": 10, "CTRIA3": 10}
#: Fields of two lines in large field, as many as one in small field has.
PAIR_OF_LINES = 8
#: Cards of which MYSTRAN reads the last odd line past the places that it has for it.
COUNTED = ("MPC", "RBE3")
#: Real numbers by their exponent alone: MYSTRAN requires the point that Nastran does without.
POINTLESS = re.compile(r"^([+-]?\d+)((?:[ED][+-]?|[+-])\d+)$", re.IGNORECASE)
#: Difference of direction cosines by which output frames differ: the digits of a card.
SAME_FRAME = 1e-6


def mystran_cards(
    deck: NastranDeck,
    bulk: Callable[[], Bulk],
    left_out: Callable[[NastranCard], bool],
    n_modes: int,
    lumped: bool,
    known: Texts,
) -> list[str]:
    """The deck's cards as MYSTRAN reads them, all in large field, without those it does without.

    bulk: gives pyNastran's model of the same deck, for cards of beams, shells, solids and bodies.
    n_modes: how many it must be able to find. lumped: whether the deck asks for lumped masses.
    known: what earlier calls wrote for the same cards; new ones are added. Blank fields that a
    GRDSET or BAROR fills are filled. Raises ModelError for all unsupported cards, with their lines.
    """
    scalars, unused = Scalars(deck), unused_properties(deck)
    cards: list[Card | str] = list(scalars.grids())
    problems: dict[str, list[str]] = {}
    defaults = {name: card for card in deck.cards if (name := DEFAULTS.get(card.name))}
    beams = BeamCards(bulk, scalars.new_number)
    shells = ShellCards(bulk, scalars.new_number)
    solids = SolidCards(deck, bulk, scalars.new_number, lumped)
    writers: dict[str, BeamCards | ShellCards | SolidCards] = {
        **dict.fromkeys(BEAM_CARDS, beams),
        **dict.fromkeys(SHELL_CARDS, shells),
        **dict.fromkeys(SOLID_CARDS, solids),
    }
    frames = cache(lambda: output_frames(bulk()))
    grids: set[str] = set()
    for card in deck.cards:
        if card.name == "GRID":
            if card.text(1) in grids:  # the same point again, which stops MYSTRAN alone
                continue
            grids.add(card.text(1))
        key = card, defaults.get(card.name)
        if text := known.get(key):
            cards.append(text)
            continue
        if card.name in HARMLESS or card.name == "MDLPRM" or card in unused or left_out(card):
            continue
        reason = _obstacle(card)
        if not reason and card.name in (*ELEMENTS, "CBUSH"):
            reason = scalars.obstacle(card)
        if not reason and card.name == "RBE3":
            reason = _unlike_frames(bulk().rigid_elements[int(card.text(1))], frames())
        if card.name in writers:
            try:
                written = writers[card.name].cards(card)
            except ValueError as error:
                reason = f"{card.name} in MYSTRAN: {error}"
            else:
                if written is not None:
                    cards += written
                    continue
        if reason:
            problems.setdefault(reason, []).append(deck.where(card))
            continue
        fields = filled(*key)
        if card.name in ("SPCADD", "MPCADD"):  # a set that is absent stops MYSTRAN
            members = members_of(deck, card)
            if not members:
                continue
            fields = [card.text(1), *members]
        if card.name in MOST:
            cards.append(known.setdefault(key, _large(card.name, fields)))
            continue
        cards += _written(card, fields, scalars)
    cards += (*beams.rest(), *solids.rest())
    _refuse(problems)
    if n_modes:
        cards += scalars.spare(n_modes)
    return [card if isinstance(card, str) else _large(*card) for card in cards]


def _refuse(problems: dict[str, list[str]]) -> None:
    """Raise ModelError with each reason, its first card and the number of its cards, if any."""
    if problems:
        raise ModelError(
            "\n".join(
                f"{places[0]}: {reason}"
                + (f" ({len(places)} such cards)" if len(places) > 1 else "")
                for reason, places in problems.items()
            )
        )


def _large(name: str, fields: list[str]) -> str:
    """A card in large field. Raises ModelError where a field does not fit into it."""
    return large_field(name, _paired(name, [_pointed(text) for text in fields]))


def _pointed(text: str) -> str:
    """A field with the decimal point that MYSTRAN requires."""
    return text if "." in text or text.isdecimal() else POINTLESS.sub(r"\1.\2", text)


def _paired(name: str, fields: list[str]) -> list[str]:
    """The fields of a card, blank ones added where MYSTRAN counts in whole pairs of lines."""
    more = -len(fields) % PAIR_OF_LINES if name in COUNTED else 0
    return [*fields, *[""] * more]


def _written(card: NastranCard, fields: list[str], scalars: Scalars) -> list[Card]:
    """The cards that say to MYSTRAN what a card says; none for what others have in them."""
    if card.name in PROPERTIES or card.name == "SPOINT":
        return []
    if card.name in ELEMENTS:
        return scalars.spring(card) if card.name.startswith("CELAS") else scalars.mass(card)
    if card.name in ("RBAR", "RBAR1"):
        return _bar(card)
    if card.name in ("CBUSH", "PBUSH"):
        return scalars.bush(card, fields)
    if card.name in ("SPC", "SPC1", "MPC"):
        return scalars.constraint(card, fields)
    return [(card.name, fields)]


def _bar(card: NastranCard) -> list[Card]:
    """A RBAR of which one end leads, as a RBE2; none for another one."""
    first, second = card.text(2), card.text(3)
    if card.name == "RBAR1":
        return [("RBE2", [card.text(1), first, card.text(4) or ALL, second])]
    for lead, follow, own, other, chosen in ((first, second, 4, 5, 7), (second, first, 5, 4, 6)):
        if sorted(card.text(own)) == list(ALL) and not card.text(other).strip("0"):
            return [("RBE2", [card.text(1), lead, card.text(chosen).strip("0") or ALL, follow])]
    return []


def _turning(card: NastranCard) -> bool:
    """Whether rotations are among the independent components of a RBE3, which follow weights."""
    weights = (place for place in range(5, len(card.fields)) if "." in card.text(place))
    return any(set(card.text(place + 1)) & set("456") for place in weights)


def _unlike_frames(element: Any, frames: dict[int, Floats]) -> str:
    """Why MYSTRAN has a RBE3 wrong: it reads all components in one output frame; empty if not."""
    lead = int(element.refgrid)
    own = frames.get(lead, np.eye(3))
    for node in element.independent_nodes:
        if np.abs(frames.get(node, np.eye(3)) - own).max() > SAME_FRAME:
            return (
                f"MYSTRAN has RBE3 wrong whose points have unlike output frames (CD): those of "
                f"{lead} and {node}; give them one frame"
            )
    return ""


def _obstacle(card: NastranCard) -> str:
    """Why MYSTRAN cannot take a card, or takes it for another one; empty if it can."""
    if card.name not in COMPARED:
        return f"MYSTRAN has no {card.name}, or its modes with it were never compared"
    if card.name == "RBAR" and not _bar(card):
        return "MYSTRAN's RBAR is led by all six components of one end"
    if card.name == "RBE3" and any(card.text(field) == "UM" for field in range(len(card.fields))):
        return "MYSTRAN has no UM of RBE3"
    if card.name == "RBE3" and _turning(card):
        return "MYSTRAN has RBE3 wrong whose independent components are rotations (4, 5, 6)"
    if card.name in TFLAGS and card.text(TFLAGS[card.name]) not in ("", "0"):
        return f"MYSTRAN takes relative thicknesses (TFLAG 1) of {card.name} for thicknesses"
    return ""
