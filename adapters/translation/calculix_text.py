"""The model part of a CalculiX deck as it grows: the one place that knows its syntax.

Grid points keep their numbers, elements get numbers of their own. One element may stand in several
named sets. The text comes in the order in which ccx needs what it refers to: nodes, elements,
sets, materials, other cards, sections, equations, fixed degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from modetune.adapters.calculix.deck import format_number
from modetune.core.modes import Floats

#: ccx reads at most this many entries of an element's or a set's line.
LINE_ENTRIES = 16
#: Terms of an equation on one line.
LINE_TERMS = 4


class CalculixText:
    """A mutable builder of nodes, elements, materials, sections and constraints."""

    def __init__(self) -> None:
        self._size = 0.0
        self._last = 0
        self.coordinates: dict[int, Floats] = {}
        #: Kind of element, ccx number, nodes.
        self.elements: list[tuple[str, int, tuple[int, ...]]] = []
        self.sets: dict[str, list[int]] = {}
        self._materials: dict[str, tuple[str, ...]] = {}
        self._cards: list[str] = []
        self._sections: list[str] = []
        self._equations: list[str] = []
        self._fixed: dict[tuple[int, int], None] = {}

    def node(self, number: int, xyz: Floats) -> None:
        """Add a node; xyz: (3,), basic coordinates. Raises ValueError where it is there."""
        if number in self.coordinates:
            raise ValueError(f"node {number} is there already")
        self.coordinates[number] = np.asarray(xyz, dtype=np.float64)
        self._last = max(self._last, number)

    def new_node(self, xyz: Floats) -> int:
        """Add a node numbered beyond all there are, and return its number."""
        self.node(self._last + 1, xyz)
        return self._last

    def new_element(self, kind: str, nodes: Sequence[int], sets: Sequence[str]) -> int:
        """Add an element of a ccx type to these sets, and return its ccx number."""
        number = len(self.elements) + 1
        self.elements.append((kind, number, tuple(nodes)))
        for name in dict.fromkeys(sets):
            self.sets.setdefault(name, []).append(number)
        return number

    def material(self, name: str, lines: Sequence[str]) -> None:
        """Add a material: its cards (*ELASTIC, *DENSITY) without *MATERIAL.

        Adding the same one again changes nothing; ValueError where it differs.
        """
        if self._materials.setdefault(name, tuple(lines)) != tuple(lines):
            raise ValueError(f"material {name} is there already, with other values")

    def can_be_material(self, name: str, lines: Sequence[str]) -> bool:
        """Whether the name is free, or stands for these very lines."""
        return self._materials.get(name, tuple(lines)) == tuple(lines)

    def section(self, lines: Sequence[str]) -> None:
        """Add a section: *SOLID SECTION, *SHELL SECTION, *MASS, *SPRING and so on."""
        self._sections += lines

    def equation(self, terms: Sequence[tuple[int, int, float]]) -> None:
        """Add sum(factor * u(node, component)) = 0; the first term is the dependent one."""
        words = [
            f"{node}, {component}, {format_number(factor)}" for node, component, factor in terms
        ]
        self._equations += [str(len(words)), *_lines(words, LINE_TERMS)]

    @property
    def size(self) -> float:
        """Extent of the nodes at the first asking; 1 where they are all in one place."""
        if not self._size:
            places = np.array(list(self.coordinates.values()))
            self._size = float(np.ptp(places, axis=0).max()) or 1.0
        return self._size

    def fixed(self, node: int, component: int) -> None:
        """Fix one component of a node; again does no harm."""
        self._fixed[(node, component)] = None

    def is_fixed(self, node: int, component: int) -> bool:
        return (node, component) in self._fixed

    def card(self, lines: Sequence[str]) -> None:
        """Add any other card: *ORIENTATION, *NSET, *RIGID BODY, *TRANSFORM."""
        self._cards += lines

    def text(self) -> str:
        """The model part of the deck: everything but a step."""
        lines = ["*NODE, NSET=NALL"]
        for number in sorted(self.coordinates):
            lines.append(f"{number}, {number_list(self.coordinates[number])}")
        lines += self._element_lines()
        for name, members in self.sets.items():
            lines += [f"*ELSET, ELSET={name}", *_lines(map(str, members), LINE_ENTRIES)]
        for name, cards in self._materials.items():
            lines += [f"*MATERIAL, NAME={name}", *cards]
        lines += [*self._cards, *self._sections]
        lines += ["*EQUATION", *self._equations] if self._equations else []
        if self._fixed:
            lines += ["*BOUNDARY", *(f"{node}, {c}, {c}" for node, c in self._fixed)]
        return "\n".join(lines) + "\n"

    def _element_lines(self) -> list[str]:
        lines: list[str] = []
        for kind in dict.fromkeys(kind for kind, _, _ in self.elements):
            lines.append(f"*ELEMENT, TYPE={kind}")
            for other, number, nodes in self.elements:
                if other == kind:
                    # A trailing comma says that the element's nodes go on on the next line.
                    rows = list(_lines(map(str, (number, *nodes)), LINE_ENTRIES))
                    lines += [*(f"{row}," for row in rows[:-1]), rows[-1]]
        return lines


def number_list(values: Iterable[float]) -> str:
    """Numbers as ccx reads them, with commas."""
    return ", ".join(format_number(float(value)) for value in values)


def _lines(words: Iterable[str], count: int) -> Iterable[str]:
    """Comma-separated words, so many a line."""
    entries = list(words)
    return [", ".join(entries[i : i + count]) for i in range(0, len(entries), count)]
