"""Damping in a Nastran deck: dampers, and loss factors (GE) of materials, laminates and springs.

GE of a material damps all its elements except laminates, which take that of their property; a
PSHELL takes that of MID1. GE1 of a PBUSH without others holds for all its directions. PARAM,G is an
additional loss factor of all stiffness (MSC's Quick Reference Guide, PBUSH, PCOMP, PSHELL). W3, W4
are of transient solutions and change nothing here.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from modetune.adapters.damping import Coefficients, Dampers, Link, group, losses_of
from modetune.adapters.nastran.cards import CARDS, fields_of, holds
from modetune.adapters.nastran.fields import NastranCard
from modetune.adapters.nastran.mesh import bush_axes, bush_place, output_frames
from modetune.adapters.nastran.structure import Structure
from modetune.adapters.solver import Deck
from modetune.core.errors import ModelError
from modetune.core.modes import Floats
from modetune.core.parameters import Parameter, Quantity
from modetune.core.updating.damping_model import DampingKind, Linear

#: Forms of elements that act along axes in space.
LINES = ("line", "bush")
#: Items of a card: its one number, and of a PVISC along the line, and about it.
WHOLE, ALONG, ABOUT = 0, 1, 2

#: Degrees of freedom with their factors.
Form = list[tuple[tuple[int, int], float]]


def damped_groups(structure: Structure) -> tuple[Parameter, ...]:
    """Materials and laminates of elements whose card has a GE, zero or not."""
    found = []
    used = set(structure.rods_of)
    for number, materials in structure.materials_of.items():
        (card,) = structure.owners.properties[number][:1]
        if card.name not in CARDS or not CARDS[card.name].plies:
            used |= materials
        elif structure.deck.number(card, _loss_field(structure, card)) is not None:
            found.append(group("property", str(number)))
    for number in sorted(used & structure.owners.materials.keys()):
        card = structure.owners.materials[number][0]
        known = holds("structural_damping", card.name)
        if known and structure.deck.number(card, _loss_field(structure, card)) is not None:
            found.append(group("material", str(number)))
    return tuple(found)


def _loss_field(structure: Structure, card: NastranCard) -> int:
    ((_, field, _),) = fields_of(structure.deck, "structural_damping", card, int(card.text(1)))
    return field


def dampers(
    structure: Structure, deck: Deck, parameters: Sequence[Parameter], uniform: float
) -> Dampers:
    """All that damps the deck; uniform: PARAM,G. Raises ModelError for what is not followed."""
    known = Coefficients(parameters, deck.numbers)
    groups, factors, places = damped_groups(structure), list[Linear](), list[str]()
    for item in groups:
        family = (
            structure.owners.properties if item.by == "property" else structure.owners.materials
        )
        card = family[int(item.targets[0])][0]
        number = _loss_field(structure, card)
        place = structure.field(card, number)
        value = structure.deck.number(card, number) or 0.0
        places.append(structure.deck.where(card))
        factors.append(known.of(place, value, places[-1]))
        shared = deck.affected_elements(item)
        own = structure.elements_of.get(int(item.targets[0]))
        if item.by == "property" and shared is not None and own != shared.elements:
            raise ModelError(
                f"{places[-1]}: GE of {card.name} {card.text(1)}: other properties use its "
                "materials, which is not supported: give it separate materials"
            )
    links = tuple(_Links(structure, known).all())
    return Dampers(links, losses_of(deck, parameters, groups, factors, places), uniform)


class _Links:
    """What dampers and springs with loss factors act on."""

    def __init__(self, structure: Structure, known: Coefficients) -> None:
        self._structure, self._known, self._bulk = structure, known, structure.bulk
        self._rows = {
            number: CARDS[item.type]
            for number, item in sorted(self._bulk.elements.items())
            if item.type in CARDS
        }
        lines = [self._bulk.elements[n] for n, row in self._rows.items() if row.form in LINES]
        ends = {n for item in lines for n in (*item.node_ids, getattr(item, "g0", None)) if n}
        self._places = {n: np.asarray(self._bulk.nodes[n].get_position()) for n in ends}
        self._frames = output_frames(self._bulk) if lines else {}

    def all(self) -> Iterator[Link]:
        for number, row in self._rows.items():
            element = self._bulk.elements[number]
            where = self._structure.deck.where(self._structure.owners.elements[number][0])
            if row.unfollowed and getattr(element.pid_ref, row.unfollowed, None):
                raise ModelError(f"{where}: damping of {element.type} is not followed: use CBUSH")
            if not row.form:
                continue
            try:
                for kind, form, numbers in self._of(element):
                    dofs, factors = zip(*form, strict=True)
                    yield Link(kind, dofs, factors, numbers, where)
            except ValueError as error:
                raise ModelError(f"{where}: {element.type} {number}: {error}") from None

    def _of(self, element: Any) -> Iterator[tuple[DampingKind, Form, tuple[Linear, ...]]]:
        form = CARDS[element.type].form
        if form == "bush":
            yield from self._bush(element)
            return
        for item in (WHOLE, ALONG, ABOUT):
            viscous = self._number("viscous_damping", element, item)
            loss = self._number("structural_damping", element, item)
            stiffness = self._number("spring_stiffness", element, item)
            if viscous is None and (loss is None or stiffness is None):
                continue
            terms = _scalar(element) if form == "scalar" else self._line(element, item)
            if viscous is not None:
                yield "viscous", terms, (viscous,)
            if loss is not None and stiffness is not None:
                yield "structural", terms, (loss, stiffness)

    def _line(self, element: Any, item: int) -> Form:
        """The second end less the first one, along the line between them or about it."""
        first, second = element.node_ids
        span = self._places[second] - self._places[first]
        axis, start = span / np.linalg.norm(span), 4 if item == ABOUT else 1
        ends = ((second, 1.0), (first, -1.0))
        return [term for node, sign in ends for term in self._along(node, sign * axis, start)]

    def _bush(self, element: Any) -> Iterator[tuple[DampingKind, Form, tuple[Linear, ...]]]:
        names: tuple[Quantity, ...] = ("viscous_damping", "structural_damping", "spring_stiffness")
        if element.pid_ref.type != "PBUSH":
            return
        viscous, loss, stiffness = (
            [self._number(name, element, item) for item in range(1, 7)] for name in names
        )
        if loss[0] is not None and not any(loss[1:]):
            loss = loss[:1] * 6
        pairs = [(a, b) if a and b else None for a, b in zip(loss, stiffness, strict=True)]
        damped = [float(bool(v or pair)) for v, pair in zip(viscous, pairs, strict=True)]
        if not any(damped):
            return
        place, span = bush_place(element, self._places)
        axes = bush_axes(element, span, self._places, self._frames, damped)
        first, second = [*element.node_ids, None][:2]
        for item, (number, pair) in enumerate(zip(viscous, pairs, strict=True)):
            axis, form = axes[item % 3], Form()
            for node, sign in ((second, 1.0), (first, -1.0)):
                if node and item < 3:
                    arm = place - self._places[node]
                    form += self._along(node, sign * axis, 1)
                    form += self._along(node, sign * np.cross(arm, axis), 4)
                elif node:
                    form += self._along(node, sign * axis, 4)
            if number is not None:
                yield "viscous", form, (number,)
            if pair is not None:
                yield "structural", form, pair

    def _along(self, node: int, vector: Floats, first: int) -> Form:
        """A basic vector times the motion of a grid point, in the axes that results have there."""
        own = self._frames.get(node, np.eye(3)) @ vector
        return [((node, first + k), value) for k, value in enumerate(own.tolist()) if value]

    def _number(self, quantity: Quantity, element: Any, item: int = 0) -> Linear | None:
        """A number of an element or its property, None where its field is blank."""
        structure = self._structure
        card, ident = structure.owners.elements[element.eid][0], element.eid
        pid = getattr(element, "pid", None)
        if not holds(quantity, card.name) and pid in structure.elements_of:
            card, ident = structure.property_card(str(pid)), pid
        if not holds(quantity, card.name):
            return None
        fields = fields_of(structure.deck, quantity, card, ident)
        for field in (at for own, at, _ in fields if own == item):
            value = structure.deck.number(card, field)
            if value is not None:
                return self._known.of(
                    structure.field(card, field), value, structure.deck.where(card)
                )
        return None


def _scalar(element: Any) -> Form:
    """The first end less the second one, ground left out. Raises ValueError where both are."""
    found: Form = []
    for place, node in enumerate(element.node_ids):
        if node:
            component = int(getattr(element, f"c{place + 1}", 0) or 0) or 1
            found.append(((node, component), -1.0 if place else 1.0))
    if not found:
        raise ValueError("both its ends are grounded")
    return found
