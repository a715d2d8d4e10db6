"""The deck of one CalculiX job: the user's model, and one *FREQUENCY step with our requests.

Everything up to the user's frequency step stays (preload steps included), without its requests
for output. The frequency step keeps what belongs to the model, such as *BOUNDARY, and gets our
number of modes and our output. A deck without steps gets a plain one. A small model gets spare
unknowns before all else (`spare_unknowns.py`).
"""

from __future__ import annotations

from collections.abc import Iterable

from modetune.adapters.calculix.model import CalculixModel
from modetune.adapters.calculix.spare_unknowns import modes_at_most, spare_unknowns
from modetune.adapters.solver import Analysis, ModalAnalysis
from modetune.core.errors import ModelError

NODES = "MODETUNE_NODES"
ALL = "MODETUNE_ALL"
OUTPUT = (
    "*NODE FILE", "*NODE PRINT", "*NODE OUTPUT", "*EL FILE", "*EL PRINT", "*ELEMENT OUTPUT",
    "*CONTACT FILE", "*CONTACT PRINT", "*CONTACT OUTPUT", "*SECTION PRINT", "*OUTPUT",
)  # fmt: skip


def job_text(model: CalculixModel, changed: dict[int, str], analysis: Analysis) -> str:
    """The text of a job's deck, comments left out. Raises ModelError."""
    before, step = _split(model)
    deck = model.deck
    parts = [changed.get(p, deck.lines[p].text) for p in before]
    parts += _sets(model, analysis)
    frequency = "*FREQUENCY"
    if isinstance(analysis, ModalAnalysis):
        n_modes = modes_at_most(model, analysis.n_modes)
        parts = [*spare_unknowns(model, n_modes), *parts]
        step = [*step, frequency, str(n_modes), *_requests(analysis)]
    else:
        step = [*step, f"{frequency}, SOLVER=MATRIXSTORAGE", "1"]
    kept = [line for line in [*parts, *step, "*END STEP"] if not line.lstrip().startswith("**")]
    return "\n".join(kept) + "\n"


def requested_sets(analysis: ModalAnalysis) -> tuple[str, ...]:
    """All element sets whose strain energy is printed, each once."""
    return tuple(dict.fromkeys(name for _, sets in analysis.groups for name in sets))


def _sets(model: CalculixModel, analysis: Analysis) -> list[str]:
    if not isinstance(analysis, ModalAnalysis):
        return []
    everything = [name for name in model.section_sets() if model.mesh.element_sets.get(name)]
    return [
        f"*NSET, NSET={NODES}",
        *_wrapped(str(node) for node in analysis.nodes),
        f"*ELSET, ELSET={ALL}",
        *everything,
    ]


def _requests(analysis: ModalAnalysis) -> list[str]:
    lines = [f"*NODE PRINT, NSET={NODES}, GLOBAL=YES", "U"]
    for name in (ALL, *requested_sets(analysis)):
        lines += [f"*EL PRINT, ELSET={name}, TOTALS=ONLY", "ELSE"]
    return [*lines, f"*EL PRINT, ELSET={ALL}, TOTALS=ONLY", "EMAS"]


def _wrapped(words: Iterable[str]) -> list[str]:
    """Comma-separated words in lines of at most sixteen entries, as ccx requires them."""
    entries = list(words)
    return [", ".join(entries[i : i + 16]) for i in range(0, len(entries), 16)]


def _split(model: CalculixModel) -> tuple[list[int], list[str]]:
    """Positions of the lines before the frequency step, and the lines of it that stay."""
    deck = model.deck
    steps = deck.named("*STEP")
    if not steps:
        return list(range(len(deck.lines))), ["*STEP"]
    frequency = deck.named("*FREQUENCY")
    if not frequency:
        raise ModelError(
            f"{deck.where(steps[0])}: the deck has a *STEP but none with *FREQUENCY; give it a "
            "frequency step, or no step at all"
        )
    first = frequency[0].lines.start
    above = [step.lines.start for step in steps if step.lines.start < first]
    if not above:
        raise ModelError(f"{deck.where(frequency[0])}: *FREQUENCY stands outside a *STEP")
    start = above[-1]
    ends = [card.lines.start for card in deck.named("*END STEP") if card.lines.start > first]
    stop = ends[0] if ends else len(deck.lines)
    before = [
        position
        for card in deck.cards
        if card.lines.start < start and not card.is_one_of(*OUTPUT)
        for position in card.lines
    ]
    inside = [card for card in deck.cards if start <= card.lines.start < stop]
    kept = [card for card in inside if not card.is_one_of(*OUTPUT, "*FREQUENCY")]
    return before, [deck.lines[position].text for card in kept for position in card.lines]
