"""What of a Nastran deck jobs on another solver leave out, and what they cannot leave out."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator, Sequence

from modetune.adapters.nastran.bulk import Bulk, Objection, filled, has_mass, refuse
from modetune.adapters.nastran.case_control import OWN_PARAMETERS, CaseControl, read_case_control
from modetune.adapters.nastran.deck import NastranDeck
from modetune.adapters.nastran.harmless import (
    FOLLOWED_PARAMETERS,
    HARMLESS,
    LEFT_OUT,
    TEMPERATURE_DEPENDENT,
    changing_model_parameter,
    changing_parameter,
)
from modetune.core.errors import ModelError

logger = logging.getLogger(__name__)


def check_left_out(deck: NastranDeck, bulk: Bulk, objections: Sequence[Objection]) -> None:
    """Raise ModelError for all cards that count for modes and are not understood.

    For jobs on another solver than Nastran; what these leave out is told.
    """
    case = read_case_control(deck)
    refuse(
        [
            *(item.text for item in objections if item.name not in HARMLESS),
            *(f"{deck.file}: {text}" for text in case.lost),
            *_lost_parameters(deck),
            *_tied_bolts(deck),
            *_temperatures(deck, case),
        ]
    )
    if not any(has_mass(item) for item in (*bulk.masses.values(), *bulk.elements.values())):
        raise ModelError(
            f"{deck.file}: nothing in the model has mass, so it has no modes; give its "
            "materials a density (RHO of MAT1) or grid points a CONM2"
        )
    counts = Counter(card.name for card in deck.cards if card.name in LEFT_OUT)
    names = {name for name, _ in case.parameters}
    names |= {card.text(1) for card in deck.named("PARAM")}
    said = [f"{count} {name}" for name, count in sorted(counts.items())]
    said += [f"PARAM {name}" for name in sorted(names - OWN_PARAMETERS - FOLLOWED_PARAMETERS)]
    if said:
        logger.warning("%s: left out of jobs on this solver: %s", deck.file, ", ".join(said))


def _lost_parameters(deck: NastranDeck) -> Iterator[str]:
    """Parameters of the bulk data that change modes, a sentence each."""
    for card in deck.named("PARAM", "MDLPRM"):
        pairs = range(1, len(card.fields), 2) if card.name == "MDLPRM" else (1,)
        changing = changing_model_parameter if card.name == "MDLPRM" else changing_parameter
        for place in pairs:
            reason = changing(card.text(place), card.text(place + 1))
            if reason:
                yield f"{deck.where(card)}: {reason}"


def _tied_bolts(deck: NastranDeck) -> Iterator[str]:
    """Bolts that join two halves of a mesh; those that name elements alone are preloads."""
    for card in deck.named("BOLT"):
        if not all(text.isdecimal() or text == "THRU" for text in filled(card, None) if text):
            yield f"{deck.where(card)}: BOLT joins grid points, which is not translated"


def _temperatures(deck: NastranDeck, case: CaseControl) -> Iterator[str]:
    """Materials that depend on a temperature which the case control selects."""
    dependent = deck.named(*TEMPERATURE_DEPENDENT)
    if dependent and case.temperature:
        yield (
            f"{deck.where(dependent[0])}: {dependent[0].name} makes the material depend "
            f"on the temperature that `{case.temperature}` selects, which jobs on this solver "
            "do not follow; give the material its values at that temperature and take "
            f"{dependent[0].name} or the selection out"
        )
