"""The steps of a CalculiX deck: which one gives the modes, and what remains of the others.

A step of ccx keeps supports and loads of the steps before it. A step that gives modes or works with
modes changes no state otherwise, so one before the chosen step is left out, and its supports and
loads move into the step after it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from modetune.adapters.calculix.deck import KeywordCard, KeywordDeck
from modetune.adapters.solver import ModalCase
from modetune.core.errors import ModelError

#: Procedures that leave the structure as it is.
WITHOUT_STATE = (
    "*FREQUENCY", "*COMPLEX FREQUENCY", "*MODAL DYNAMIC", "*STEADY STATE DYNAMICS", "*GREEN",
    "*SELECT CYCLIC SYMMETRY MODES",
)  # fmt: skip
#: What a step of these may leave to the steps after it.
LASTING = ("*BOUNDARY", "*CLOAD", "*DLOAD", "*DSLOAD", "*TEMPERATURE", "*MODEL CHANGE")


@dataclass(frozen=True, slots=True)
class DeckStep:
    """A step with its cards, *STEP first, without *END STEP.

    number: as ccx counts them, from 1. stop: position of the line behind it.
    """

    number: int
    cards: tuple[KeywordCard, ...]
    stop: int

    def named(self, *keywords: str) -> list[KeywordCard]:
        return [card for card in self.cards if card.is_one_of(*keywords)]

    @property
    def start(self) -> int:
        """Position of its first line."""
        return self.cards[0].lines.start

    @property
    def has_state(self) -> bool:
        """Whether what follows may depend on it."""
        return not self.named(*WITHOUT_STATE)


def read_steps(deck: KeywordDeck) -> list[DeckStep]:
    """Return all steps of a deck, in order."""
    found: list[list[KeywordCard]] = []
    stops: list[int] = []
    for card in deck.cards:
        if card.is_one_of("*STEP"):
            found.append([card])
        elif len(found) == len(stops):
            continue
        elif card.is_one_of("*END STEP"):
            stops.append(card.lines.start)
        else:
            found[-1].append(card)
        while len(stops) < len(found) - 1:  # a step without an end
            stops.append(card.lines.start)
    stops += [len(deck.lines)] * (len(found) - len(stops))
    pairs = zip(found, stops, strict=True)
    return [DeckStep(number, tuple(cards), stop) for number, (cards, stop) in enumerate(pairs, 1)]


def lines_before(
    deck: KeywordDeck, steps: Sequence[DeckStep], modal: DeckStep
) -> tuple[list[int], list[int]]:
    """Return the positions of the lines before the modal step, and of those that move into it."""
    gone = [step for step in steps if step.number < modal.number and not step.has_state]
    kept, moved = list[int](), list[KeywordCard]()
    for card in deck.cards:
        start = card.lines.start
        if start >= modal.start:
            break
        begun = next((step for step in steps if step.start == start), None)
        if begun is not None:
            moved = _not_replaced(moved, begun.cards)
        if any(step.start <= start <= step.stop for step in gone):
            moved += [card] if card.is_one_of(*LASTING) else []
            continue
        kept += card.lines
        if begun is not None:
            kept += _lines(moved)
            moved = []
    return kept, _lines(_not_replaced(moved, modal.cards))


def _not_replaced(moved: list[KeywordCard], later: Sequence[KeywordCard]) -> list[KeywordCard]:
    """Return the cards that no later card of their keyword replaces, by OP=NEW.

    ccx follows OP=NEW on the first card of a keyword in a step alone, so replaced ones are left
    out and not written above it.
    """
    new = {card.keyword for card in later if card.option("OP") == "NEW"}
    return [card for card in moved if card.keyword not in new]


def _lines(cards: Sequence[KeywordCard]) -> list[int]:
    return [position for card in cards for position in card.lines]


def frequency_steps(deck: KeywordDeck) -> tuple[ModalCase, ...]:
    """Return the steps that give modes, in order."""
    modal = [step for step in read_steps(deck) if step.named("*FREQUENCY")]
    return tuple(
        ModalCase("step", step.number, _about(deck, step), default=step is modal[-1])
        for step in modal
    )


def choice_note(deck: KeywordDeck) -> list[str]:
    """Return which of several steps counts without a choice, a sentence; none where one does."""
    cases = () if deck.step else frequency_steps(deck)
    if len(cases) < 2:
        return []
    *others, last = cases
    where = deck.where(modal_step(deck, read_steps(deck)).cards[0])
    return [
        f"{where}: the modes are those of step {last.number}, the last with *FREQUENCY; "
        f"`model.step` (`--step` with a deck) chooses another: {', '.join(map(str, others))}"
    ]


def _about(deck: KeywordDeck, step: DeckStep) -> str:
    line = deck.where(step.cards[0]).rsplit(", ", 1)[-1]
    return f"{line}, PERTURBATION" if "PERTURBATION" in step.cards[0].options else line


def modal_step(deck: KeywordDeck, steps: Sequence[DeckStep]) -> DeckStep:
    """Return the step that the deck names, else the last with *FREQUENCY. Raises ModelError."""
    modal = [step for step in steps if step.named("*FREQUENCY")]
    if deck.step:
        named = [step for step in modal if step.number == deck.step]
        if not named:
            others = ", ".join(map(str, frequency_steps(deck))) or "none"
            raise ModelError(
                f"{deck.file}: step {deck.step} has no *FREQUENCY, or is not there; steps with "
                f"*FREQUENCY: {others}"
            )
        return named[0]
    if not modal:
        raise ModelError(
            f"{deck.where(steps[0].cards[0])}: the deck has a *STEP but none with *FREQUENCY; "
            "give it a frequency step, or no step at all"
        )
    return modal[-1]
