"""Which elements of a section or a material parameters take for themselves.

A parameter may name properties, element sets or elements whose section or material others share.
Then the members are divided into cells, in each of which the same parameters act. One cell keeps
the section or material as it is; the others get copies of it, which differ in their name alone, so
that the model stays what it was until a parameter moves.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from modetune.core.parameters import QUANTITIES, Quantity

T = TypeVar("T", bound=Hashable)

#: Quantities of materials; others are of sections and elements.
OF_MATERIALS: frozenset[Quantity] = frozenset(
    quantity for quantity, facts in QUANTITIES.items() if "material" in facts.targets
)


@dataclass(frozen=True, slots=True)
class Selection:
    """The elements that a parameter names.

    material: whether it moves a number of their material.
    """

    parameter: str
    elements: frozenset[int]
    material: bool


def cells_of(members: Mapping[T, Iterable[str]]) -> list[tuple[tuple[str, ...], list[T]]]:
    """Members by the parameters that act on them, the cell that keeps what they share first.

    That is the one on which none acts, else the largest.
    """
    found: dict[tuple[str, ...], list[T]] = {}
    for member, names in members.items():
        found.setdefault(tuple(sorted(names)), []).append(member)
    return sorted(found.items(), key=lambda item: (bool(item[0]), -len(item[1]), item[0]))


def acting(selections: Sequence[Selection], elements: frozenset[int]) -> list[str]:
    """Parameters that name some of these elements."""
    return [item.parameter for item in selections if not item.elements.isdisjoint(elements)]


def cut(
    selections: Sequence[Selection], elements: frozenset[int]
) -> list[tuple[tuple[str, ...], list[int]]]:
    """Cells of the elements of a section, the one that keeps it first; one where none cuts it."""
    cutting = [
        item
        for item in selections
        if not elements <= item.elements and not elements.isdisjoint(item.elements)
    ]
    if not cutting:
        return [((), sorted(elements))]
    return cells_of({number: acting(cutting, frozenset({number})) for number in sorted(elements)})


def elements_named(numbers: Sequence[int]) -> str:
    """Elements in words."""
    if len(numbers) == 1:
        return f"element {numbers[0]}"
    return f"{len(numbers)} elements from {numbers[0]} to {numbers[-1]}"
