"""A Nastran model while it is translated."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from modetune.adapters.translation.calculix_text import CalculixText
from modetune.adapters.translation.freedoms import Freedoms


@dataclass(frozen=True, slots=True)
class Assembly:
    """What all cards are translated from and into.

    bulk: a cross-referenced pyNastran BDF. single: elements with a set `E<eid>` of their own.
    wtmass: the factor on all masses. lumped: whether masses are at the grid points alone, and of
    which properties of solids and shells they can be.
    """

    bulk: Any
    freedoms: Freedoms
    single: frozenset[int]
    wtmass: float
    lumped: bool
    lumped_properties: frozenset[int]

    @property
    def builder(self) -> CalculixText:
        return self.freedoms.builder

    @property
    def problems(self) -> list[str]:
        return self.freedoms.problems

    def elements(self, *kinds: str) -> Iterator[Any]:
        """Elements of these cards, in the order of the bulk data."""
        return (element for element in self.bulk.elements.values() if element.type in kinds)

    def sets_of(self, element: Any) -> Sequence[str]:
        """Names of the sets that an element stands in."""
        names = [f"P{element.pid}"] if getattr(element, "pid", None) else []
        return (*names, f"E{element.eid}") if element.eid in self.single else names

    def refuse(self, card: Any, reason: object) -> None:
        """Note why an element cannot be translated."""
        self.problems.append(f"{card.type} {card.eid}: {reason}")
