"""The deck of one CalculiX job: the user's model, and one *FREQUENCY step with our requests.

Everything up to the user's frequency step stays (preload steps included), without its requests
for output and without other steps that give modes (`steps.py`). The frequency step keeps what
belongs to the model, such as *BOUNDARY, before and after *FREQUENCY unchanged, and the options of
*FREQUENCY; it gets our number of modes and our output.
A deck without steps gets a plain one. A small model gets spare unknowns before all else.

ARPACK as ccx calls it takes five vectors for a mode, and refuses more vectors than unknowns: of a
chain of nine masses ccx finds one mode. So a small model gets additional masses on springs, tied to
nothing, far above its modes, and ccx finds all modes of the model. No more are asked for than its
nodes have translations that are free; if ties leave it fewer, modes of spare unknowns follow, and
are taken off again.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from itertools import product

from modetune.adapters.calculix.constraints import Dof, read_constraints
from modetune.adapters.calculix.cyclic_symmetry import read_cyclic_symmetry
from modetune.adapters.calculix.deck import COMMENTS, KeywordCard
from modetune.adapters.calculix.steps import (
    choice_note,
    frequency_steps,
    lines_before,
    modal_step,
    read_steps,
)
from modetune.adapters.calculix.structure import CalculixStructure
from modetune.adapters.cross_checks import SPARE_EIGENVALUE
from modetune.adapters.solver import Analysis, ModalAnalysis
from modetune.core.errors import ModelError

NODES = "MODETUNE_NODES"
ALL = "MODETUNE_ALL"
OUTPUT = (
    "*NODE FILE", "*NODE PRINT", "*NODE OUTPUT", "*EL FILE", "*EL PRINT", "*ELEMENT OUTPUT",
    "*CONTACT FILE", "*CONTACT PRINT", "*CONTACT OUTPUT", "*SECTION PRINT", "*OUTPUT",
)  # fmt: skip
#: Options of *FREQUENCY with which ccx computes no modes, or stores other matrices.
NO_MODES = (("SOLVER", "MATRIXSTORAGE"), ("GLOBAL", "NO"), ("CYCMPC", "INACTIVE"))


def job_text(structure: CalculixStructure, changed: dict[int, str], analysis: Analysis) -> str:
    """The text of a job's deck, comments left out. Raises ModelError."""
    before, above, frequency, below = _split(structure)
    deck = structure.deck
    parts = [changed.get(p, deck.lines[p].text) for p in before]
    parts += _sets(structure, analysis)
    options = dict(frequency.options) if frequency else {}
    if isinstance(analysis, ModalAnalysis):
        n_modes = modes_at_most(structure, analysis.n_modes)
        cyclic = read_cyclic_symmetry(structure)
        if cyclic is None:
            parts = [*spare_unknowns(structure, n_modes), *parts]
        else:
            n_modes = cyclic.rows(n_modes)
        data, below = str(n_modes), [*below, *_requests(analysis)]
    elif structure.deck.named("*CYCLIC SYMMETRY MODEL"):
        raise ModelError(
            f"{deck.file}: ccx stores the matrices of a sector for no nodal diameter; use strain "
            "energies or finite differences (`sensitivity.method`)"
        )
    else:
        data, options["SOLVER"] = "1", "MATRIXSTORAGE"
    header = ", ".join(["*FREQUENCY", *(f"{name}={value}" for name, value in options.items())])
    lines = [*parts, *above, header, data, *below, "*END STEP"]
    kept = [line for line in lines if "**" not in line or not line.lstrip().startswith(COMMENTS)]
    return "\n".join([*kept, ""])


def check_frequency_step(structure: CalculixStructure) -> list[str]:
    """What of the user's *FREQUENCY a campaign cannot keep, a sentence each.

    Raises ModelError for what would give no modes.
    """
    deck = structure.deck
    notes = choice_note(deck)
    read_cyclic_symmetry(structure)
    wanted = deck.step or frequency_steps(deck)
    modal = modal_step(deck, read_steps(deck)) if wanted else None
    for card in modal.named("*FREQUENCY")[:1] if modal is not None else ():
        where = structure.deck.where(card)
        for option, value in NO_MODES:
            if card.option(option) == value:
                raise ModelError(
                    f"{where}: *FREQUENCY, {option}={value} is of stored matrices, not of modes: "
                    "leave the option out"
                )
        for line in card.data[:1]:
            given = [place for place, text in enumerate(structure.deck.fields(line)) if text]
            if 1 in given and structure.deck.number(line, 1) > 0.0:
                notes.append(
                    f"{structure.deck.lines[line].where}: the lower frequency "
                    f"{structure.deck.number(line, 1):g} of *FREQUENCY is left out: modes are "
                    "counted from the lowest one, as ccx does"
                )
            if 2 in given:
                notes.append(
                    f"{structure.deck.lines[line].where}: the upper frequency "
                    f"{structure.deck.number(line, 2):g} of *FREQUENCY is left out: as many modes "
                    "are computed as the campaign needs"
                )
    return notes


def requested_sets(analysis: ModalAnalysis) -> tuple[str, ...]:
    """All element sets whose strain energy is printed, each once."""
    return tuple(dict.fromkeys(name for _, sets in analysis.groups for name in sets))


def _sets(structure: CalculixStructure, analysis: Analysis) -> list[str]:
    if not isinstance(analysis, ModalAnalysis):
        return []
    everything = [
        name for name in structure.section_sets() if structure.mesh.element_sets.get(name)
    ]
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


def _split(
    structure: CalculixStructure,
) -> tuple[list[int], list[str], KeywordCard | None, list[str]]:
    """Positions of the lines before the frequency step; its *FREQUENCY, and around it what stays.

    Raises ModelError.
    """
    deck = structure.deck
    steps = read_steps(deck)
    if not steps:
        return list(range(len(deck.lines))), ["*STEP"], None, []
    for card in deck.named("*FREQUENCY")[:1]:
        if card.lines.start < steps[0].start:
            where = deck.where(card)
            raise ModelError(f"{where}: *FREQUENCY is outside a *STEP; move it into one")
    modal = modal_step(deck, steps)
    frequency = modal.named("*FREQUENCY")[0]
    first = frequency.lines.start
    output = {p for card in deck.named(*OUTPUT) for p in card.lines}
    before, moved = (
        [position for position in found if position not in output]
        for found in lines_before(deck, steps, modal)
    )
    kept = [card for card in modal.cards if not card.is_one_of(*OUTPUT, "*FREQUENCY")]
    # The first card is *STEP; the lines that move into the step are above it in the deck.
    places = [*kept[0].lines, *moved, *(p for card in kept[1:] for p in card.lines)]
    lines_above = [deck.lines[position].text for position in places if position < first]
    lines_below = [deck.lines[position].text for position in places if position > first]
    return before, lines_above, frequency, lines_below


#: Unknowns that ccx wants for each mode.
FOR_A_MODE = 5
#: Stiffness and mass of a spare unknown.
STIFFNESS, MASS = 1e-8 * SPARE_EIGENVALUE, 1e-8
#: Elements that bring no mass.
MASSLESS = ("SPRING", "DASHPOT", "GAP", "DCOUP")
#: Relative distance of the eigenvalues of spare unknowns. Free hinges and small frames, 63 requests
#: in all, had all of their modes with 0.1 and 0.2, and not all with 0.03 and less.
APART = 0.1
#: Models with more nodes have unknowns enough.
MOST_NODES = 20_000


def spare_unknowns(structure: CalculixStructure, n_modes: int) -> list[str]:
    """Return lines for a model that may have too few unknowns for `n_modes` modes, else none."""
    wanted, free = FOR_A_MODE * n_modes, _free(structure)
    if any("COMPOSITE" in card.options for card in structure.sections):
        return []  # ccx 2.20 accepts no masses and springs together with composite shells
    massive = {
        node
        for element in structure.mesh.elements.values()
        if not element.kind.startswith(MASSLESS)
        for node in element.nodes
    }
    if not free or len(massive.intersection(node for node, _ in free)) >= wanted:
        return []
    first = max(structure.mesh.nodes, default=0) + 1
    element = max(structure.mesh.elements, default=0) + 1
    count = -(-wanted // 3)
    node = next(card.data[0] for card in structure.deck.named("*NODE") if card.data)
    place = ", ".join(structure.deck.fields(node)[1:4])
    spare = range(first, first + count)
    lines = ["*NODE", *(f"{node}, {place}" for node in spare)]
    lines += ["*ELEMENT, TYPE=MASS, ELSET=MODETUNE_SPARE"]
    lines += [f"{element + at}, {node}" for at, node in enumerate(spare)]
    lines += ["*MASS, ELSET=MODETUNE_SPARE", f"{MASS:.1E}"]
    # ARPACK needs more vectors than a small model has modes, and its start vector holds one of
    # equal eigenvalues: with equal spare ones it ends with an error, or corrupts its memory.
    for at, (node, component) in enumerate(product(spare, (1, 2, 3))):
        name = f"MODETUNE_SPARE{at}"
        lines += [f"*ELEMENT, TYPE=SPRING1, ELSET={name}", f"{element + count + at}, {node}"]
        stiffness = STIFFNESS * (1.0 + APART * at)
        lines += [f"*SPRING, ELSET={name}", f"{component}", f"{stiffness:.6E}"]
    return lines


@lru_cache(maxsize=4)
def _free(structure: CalculixStructure) -> frozenset[Dof]:
    """Return translations that are not held, dependent or a rigid body's, and independent ones.

    Empty for large models, and where ties cannot be read, of which ccx says what is wrong.
    """
    if len(structure.mesh.element_nodes) > MOST_NODES:
        return frozenset()
    try:
        ties = read_constraints(structure)
    except ModelError:
        return frozenset()
    nodes = structure.mesh.element_nodes - set(ties.bodies)
    for body in ties.bodies.values():
        nodes |= {body.reference, body.rotation or -body.reference}
    found = {(node, component) for node in nodes for component in (1, 2, 3)}
    return frozenset(found | ties.terms) - ties.held - set(ties.dependent)


def modes_at_most(structure: CalculixStructure, n_modes: int) -> int:
    """Return `n_modes`, or the number that the model has freedoms for (unknown from one sector)."""
    if structure.deck.named("*CYCLIC SYMMETRY MODEL"):
        return n_modes
    return min(n_modes, len(_free(structure)) or n_modes)
