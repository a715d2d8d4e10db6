"""What ties nodes of a CalculiX deck: *BOUNDARY, *EQUATION, *RIGID BODY, *TRANSFORM, and others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

from modetune.adapters.calculix.deck import KeywordCard, canonical_name, read_number
from modetune.adapters.calculix.mesh import generated
from modetune.adapters.calculix.steps import modal_step, read_steps
from modetune.adapters.calculix.structure import NOT_FOLLOWED, CalculixStructure
from modetune.adapters.calculix.ties import tie_terms
from modetune.core.errors import ModelError
from modetune.core.mesh import Fixed

#: A node and a component, 1..3 translations, 4..6 rotations.
Dof = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Body:
    """A rigid body: its reference node, and the node whose translations are its rotations."""

    reference: int
    rotation: int


@dataclass(frozen=True, slots=True)
class Constraints:
    """held: degrees of freedom of *BOUNDARY, in the node's own axes where it is turned.

    dependent: of each dependent one of *EQUATION and *TIE its terms, u = sum of factor times
    u_term. terms: all terms of these. tied: slave nodes of *TIE. bodies: rigid bodies of their
    nodes; a rotation of 0 is not known. turned: nodes of *TRANSFORM. followed: whether the deck has
    no other ties.
    """

    held: frozenset[Dof]
    dependent: dict[Dof, dict[Dof, float]]
    terms: frozenset[Dof]
    tied: frozenset[int]
    bodies: dict[int, Body]
    turned: frozenset[int]
    followed: bool


@lru_cache(maxsize=1)  # nearest points of a large surface take long
def read_constraints(structure: CalculixStructure) -> Constraints:
    """All ties of the deck. Raises ModelError where a number is none."""
    sets = node_sets(structure)
    equations = _equations(structure)
    bodies = _bodies(structure, sets)
    tied = tie_terms(structure, sets)
    followed = (
        not structure.deck.named(*NOT_FOLLOWED) and equations is not None and tied is not None
    )
    held = frozenset(_held(structure, sets))
    dependent = {
        (node, axis): {(other, axis): factor for other, factor in terms.items()}
        for node, terms in (tied or {}).items()
        for axis in (1, 2, 3)
        if (node, axis) not in held
    } | (equations or {})
    return Constraints(
        held=held,
        dependent=dependent,
        terms=frozenset(dependent).union(*dependent.values()) if dependent else frozenset(),
        tied=frozenset(tied or ()),
        bodies=bodies,
        turned=frozenset(
            node
            for card in structure.deck.named("*TRANSFORM")
            for node in sets.get(card.option("NSET"), ())
        ),
        followed=followed,
    )


def fixed_components(structure: CalculixStructure) -> Fixed:
    """Return the components that *BOUNDARY holds, by node, in global axes.

    Of a turned node only all three translations together count. Empty where a number is none.
    """
    try:
        ties = read_constraints(structure)
    except ModelError:
        return {}
    found: dict[int, set[int]] = {}
    for node, component in ties.held:
        found.setdefault(node, set()).add(component)
    return {
        node: frozenset(components)
        for node, components in found.items()
        if node not in ties.turned or components >= {1, 2, 3}
    }


def node_sets(structure: CalculixStructure) -> dict[str, set[int]]:
    deck = structure.deck
    sets: dict[str, set[int]] = {}
    for card in deck.named("*NODE"):
        if card.option("NSET"):
            members = sets.setdefault(card.option("NSET"), set())
            members.update(_whole(deck.fields(position)[0]) for position in card.data)
    for card in deck.named("*NSET"):
        members = sets.setdefault(card.option("NSET"), set())
        for position in card.data:
            fields = [field for field in deck.fields(position) if field]
            if "GENERATE" in card.options:
                members.update(generated(deck, position, fields, structure.mesh.nodes))
            else:
                for field in fields:
                    members |= set_members(field, sets)
    return sets


def set_members(field: str, sets: dict[str, set[int]]) -> set[int]:
    """The node of a number, or the nodes of a set."""
    return {int(field)} if field.isdecimal() else sets.get(canonical_name(field), set())


def _whole(text: str) -> int:
    return int(text) if text.isdecimal() else 0


def _held(structure: CalculixStructure, sets: dict[str, set[int]]) -> set[Dof]:
    """Return what *BOUNDARY constrains in the step of the modes, those of steps before included."""
    deck, held, renewed = structure.deck, set[Dof](), set[int]()
    steps = read_steps(deck)
    modal = any(step.named("*FREQUENCY") for step in steps)
    stop = modal_step(deck, steps).stop if modal else len(deck.lines)
    for card in deck.named("*BOUNDARY"):
        if card.lines.start >= stop:
            break
        number = next((s.number for s in steps if s.start < card.lines.start < s.stop), 0)
        if card.option("OP") == "NEW" and number not in renewed:
            renewed.add(number)
            held.clear()
        for position in card.data:
            held |= held_by(structure.deck.fields(position), sets)
    return held


def held_by(fields: Sequence[str], sets: dict[str, set[int]]) -> set[Dof]:
    """Return what a data line of *BOUNDARY holds."""
    name, start, stop = [*fields, "", "", ""][:3]
    first = _whole(start)
    last = _whole(stop) or first
    components = range(first, min(last, 6) + 1)
    return {(node, c) for node in set_members(name, sets) for c in components}


def _equations(structure: CalculixStructure) -> dict[Dof, dict[Dof, float]] | None:
    """Terms of each dependent degree of freedom; None where a card is not plain numbers."""
    found: dict[Dof, dict[Dof, float]] = {}
    for card in structure.deck.named("*EQUATION"):
        try:
            found |= _card_equations(structure, card)
        except (ValueError, IndexError, ZeroDivisionError, ModelError):
            return None
    return found


def _card_equations(structure: CalculixStructure, card: KeywordCard) -> dict[Dof, dict[Dof, float]]:
    found: dict[Dof, dict[Dof, float]] = {}
    words: list[str] = []
    count = 0
    for position in card.data:
        fields = [field for field in structure.deck.fields(position) if field]
        if not count:
            count, words = int(fields[0]), []
            continue
        words += fields
        if len(words) >= 3 * count:
            rows = [words[place : place + 3] for place in range(0, 3 * count, 3)]
            (node, component, own), *others = rows
            factor = -1.0 / read_number(own)
            terms: dict[Dof, float] = {}
            for other, direction, value in others:
                dof = int(other), int(direction)
                terms[dof] = terms.get(dof, 0.0) + factor * read_number(value)
            found[int(node), int(component)] = terms
            count = 0
    return found


def _bodies(structure: CalculixStructure, sets: dict[str, set[int]]) -> dict[int, Body]:
    """Rigid bodies of their dependent nodes.

    Where the deck gives no ROT NODE, ccx makes one: of the first card it is the first number
    above all nodes, as long as no other card before makes nodes (*BOUNDARY in turned axes does).
    """
    cards = structure.deck.named("*RIGID BODY")
    alone = len(cards) == 1 and not structure.deck.named("*TRANSFORM", "*TIE", *NOT_FOLLOWED)
    made = max(structure.mesh.nodes) + 1 if alone else 0
    found = {}
    for card in cards:
        body = Body(_whole(card.option("REFNODE")), _whole(card.option("ROTNODE")) or made)
        for node in sets.get(card.option("NSET"), ()):
            found[node] = body
    return found
