"""What damps the model of a deck, from the numbers of its cards.

Dampers and springs act on sums of degrees of freedom, r^T u, and add numbers times r r^T; the loss
factor of a material adds its share of the material's stiffness, which a matrix job at twice the
modulus gives (`GROUP`, one job for all that share no node). Parameters of damping move neither
stiffness nor mass, so no job knows of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse

from modetune.adapters.deck_numbers import Number
from modetune.adapters.solver import AffectedElements, Deck
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import ModelError
from modetune.core.modes import dof_name
from modetune.core.parameters import DAMPING, Parameter, TargetKind, driven_by
from modetune.core.updating.damping_model import Damper, DampingKind, DampingModel, Linear, Loss

#: What moves nothing of stiffness and mass.
NOTHING = AffectedElements(frozenset(), frozenset(), False, False, (1,), False)
#: Bounds of the factor on a group's stiffness, of which no campaign knows.
LEAST, MOST = 0.1, 10.0


@dataclass(frozen=True, slots=True)
class Link:
    """A damper or spring on the sum of factors times degrees of freedom, (n_terms,).

    numbers: whose product it has. where: of its card, for messages.
    """

    kind: DampingKind
    dofs: tuple[tuple[int, int], ...]
    factors: tuple[float, ...]
    numbers: tuple[Linear, ...]
    where: str


@dataclass(frozen=True, slots=True)
class Dampers:
    """All that damps a deck; uniform: loss factor of all its stiffness."""

    links: tuple[Link, ...]
    losses: tuple[Loss, ...]
    uniform: float = 0.0

    def model(self, deck: Deck, base: MatrixResult) -> DampingModel:
        """Return damping in the equations of stored matrices. Raises ModelError for motions that
        they do not contain."""
        found = []
        for link in self.links:
            nodes, components = np.array(link.dofs).T
            seen = deck.observation(base, nodes, components)
            for place in np.flatnonzero(seen.unknown)[:1].tolist():
                raise ModelError(
                    f"{link.where}: {dof_name(link.dofs[place])} does not follow from the "
                    "matrices' unknowns"
                )
            row = sparse.csr_array(np.array([link.factors]) @ seen.matrix)
            found.append(Damper(link.kind, sparse.csr_array(row.T @ row), link.numbers))
        return DampingModel(tuple(found), self.losses, self.uniform)


def damps_only(parameter: Parameter, parameters: Iterable[Parameter]) -> bool:
    """Whether a parameter, and what follows from it, moves no stiffness and no mass."""
    moved = {item.quantity for item in (parameter, *driven_by(parameter, parameters))}
    return moved <= DAMPING | {"variable"}


def group(by: TargetKind, target: str) -> Parameter:
    """The factor on the stiffness of a material or property with a loss factor.

    Its name is none that a campaign can give.
    """
    return Parameter(f"stiffness of {by} {target}", "youngs_modulus", by, (target,),
                     LEAST, MOST, 1.0)  # fmt: skip


class Coefficients:
    """Numbers of a deck as parameters have them."""

    def __init__(self, parameters: Sequence[Parameter],
                 numbers_of: Callable[[Parameter], list[Number]]) -> None:  # fmt: skip
        free = [item for item in parameters if not item.expression]
        self._known: dict[Any, Linear] = {}
        self._driven = set[Any]()
        for item in parameters:
            if item.quantity not in (*DAMPING, "spring_stiffness"):
                continue
            for number in numbers_of(item):
                if item.expression:
                    self._driven.add(number.place)
                    continue
                start = item.number(number.value, 0.0)
                slope = item.number(number.value, 1.0) - start
                self._known[number.place] = Linear(start, slope, free.index(item))

    def of(self, place: Any, value: float, where: str) -> Linear:
        """The number at a place. Raises ModelError where an expression gives it."""
        if place in self._driven:
            raise ModelError(
                f"{where}: an expression gives this number of damping, which is unavailable: "
                "make it a separate parameter"
            )
        return self._known.get(place, Linear(value))


def losses_of(
    deck: Deck, parameters: Sequence[Parameter], groups: Sequence[Parameter],
    factors: Sequence[Linear], places: Sequence[str],
) -> tuple[Loss, ...]:  # fmt: skip
    """The groups' loss factors with the parameters that move their stiffness.

    places: of each factor, for messages. Raises ModelError for what cannot be followed.
    """
    free = [item for item in parameters if not item.expression]
    moved = [
        (column, item, deck.affected_elements(item))
        for column, item in enumerate(free)
        if groups and not damps_only(item, parameters)
    ]
    found = []
    for number, (own, factor, where) in enumerate(zip(groups, factors, places, strict=True)):
        whole = deck.affected_elements(own)
        if whole is None:
            raise ModelError(
                f"{where}: the part of {own.by} {own.targets[0]} in the stiffness does not follow "
                "from the matrices of this solver: its loss factor is unavailable there"
            )
        if not whole.proportional:
            raise ModelError(
                f"{where}: the loss factor of {own.by} {own.targets[0]} is followed where the "
                "stiffness of its elements is all of that material's modulus: give laminates a "
                "factor (GE of PCOMP), and others a separate material"
            )
        scaled, within = list[int](), list[int]()
        for column, item, affected in moved:
            if affected is not None and not affected.stiffness:
                continue
            if affected is not None and affected.elements.isdisjoint(whole.elements):
                continue
            simple = affected is not None and not affected.related
            if simple and affected is not None and affected.elements <= whole.elements:
                every = affected.proportional and affected.elements == whole.elements
                (scaled if every else within).append(column)
            elif (simple and affected is not None and affected.elements >= whole.elements
                  and affected.proportional and item.values == "relative"):  # fmt: skip
                scaled.append(column)
            else:
                raise ModelError(
                    f"{where}: parameter {item.name} moves the stiffness that this loss factor is "
                    "of in a way that is not followed: name its elements, or its material, alone"
                )
        found.append(Loss(factor, number, tuple(scaled), tuple(within)))
    return tuple(found)
