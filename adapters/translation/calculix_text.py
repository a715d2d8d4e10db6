"""The model part of a CalculiX deck as it grows: the one place that knows its syntax.

Grid points keep their numbers, elements get new ones. One element may belong to several named sets.
The order of the text is that of references in ccx: nodes, elements, sets, materials, other cards,
sections, equations, fixed degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from operator import itemgetter

import numpy as np

from modetune.adapters.calculix.deck import format_number
from modetune.core.modes import Floats, Integers

#: ccx reads at most this many entries of an element's or a set's line.
LINE_ENTRIES = 16
#: Terms of an equation on one line.
LINE_TERMS = 4
#: Corners of a C3D8 in ccx's order, as signs of half its sides; the axes are right-handed.
BRICK_CORNERS = np.array(
    [(-1, -1, -1), (1, -1, -1), (1, 1, -1), (-1, 1, -1),
     (-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1)], dtype=np.float64,
)  # fmt: skip
#: Factors below this are nothing.
NO_FACTOR = 1e-14


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

    def new_nodes(self, places: Floats) -> Integers:
        """Add nodes at places (n, 3), numbered beyond all there are; returns their numbers."""
        numbers = np.arange(len(places)) + self._last + 1
        self.coordinates.update(zip(numbers.tolist(), places, strict=True))
        self._last += len(places)
        return numbers

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
        """Return whether the name is free, or has exactly these lines."""
        return self._materials.get(name, tuple(lines)) == tuple(lines)

    def section(self, lines: Sequence[str]) -> None:
        """Add a section: *SOLID SECTION, *SHELL SECTION, *MASS, *SPRING and so on."""
        self._sections += lines

    def equation(self, terms: Sequence[tuple[int, int, float]]) -> None:
        """Add sum(factor * u(node, component)) = 0; the first term is the dependent one."""
        words = [f"{node},{component},{_factor(factor)}" for node, component, factor in terms]
        self._equations.append(_equation(words))

    def equations(self, owners: Integers, factors: Floats) -> None:
        """Tie the displacements of nodes 1..3 to three of each of others, in bulk.

        owners: (n, 1 + m), the dependent node and m / 3 others, each thrice; factors: (n, 3, 1 +
        m), of the dependent component, then of components 1, 2, 3 of each of the others. What
        depends on nothing is fixed.
        """
        alive = np.abs(factors) > NO_FACTOR
        counts = alive.sum(axis=2)
        alive &= counts[:, :, None] > 1
        for row, axis in zip(*map(np.ndarray.tolist, np.nonzero(counts == 1)), strict=True):
            self.fixed(int(owners[row, 0]), axis + 1)
        rows, axes, places = np.nonzero(alive)
        which = np.where(places == 0, axes, (places - 1) % 3) + 1
        values, same = np.unique(factors[alive], return_inverse=True)
        texts = [_factor(value) for value in values.tolist()]
        columns = (owners[rows, places].tolist(), which.tolist(), same.tolist())
        words = [f"{n},{c},{texts[place]}" for n, c, place in zip(*columns, strict=True)]
        stop = 0
        for count in counts[counts > 1].tolist():
            start, stop = stop, stop + count
            self._equations.append(_equation(words[start:stop]))

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
        """Return the model part of the deck: everything but a step."""
        lines = ["*NODE, NSET=NALL"]
        for number, place in sorted(self.coordinates.items(), key=itemgetter(0)):
            lines.append(f"{number}, {number_list(place.tolist())}")
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
                    # A trailing comma continues the nodes of the element on the next line.
                    rows = list(_lines(map(str, (number, *nodes)), LINE_ENTRIES))
                    lines += [*(f"{row}," for row in rows[:-1]), rows[-1]]
        return lines


def _equation(words: Sequence[str]) -> str:
    """Return the lines of an equation; words: its terms."""
    if len(words) <= LINE_TERMS:
        return f"{len(words)}\n{','.join(words)}"
    rows = [words[i : i + LINE_TERMS] for i in range(0, len(words), LINE_TERMS)]
    return "\n".join([str(len(words)), *map(",".join, rows)])


def _factor(value: float) -> str:
    """Return a factor of an equation, with the digits that always fit the field of ccx."""
    return f"{value:.14g}"


def number_list(values: Iterable[float]) -> str:
    """Return numbers as ccx reads them, with commas."""
    return ", ".join(format_number(float(value)) for value in values)


def _lines(words: Iterable[str], count: int) -> Iterable[str]:
    """Return comma-separated words, at most `count` on a line."""
    entries = list(words)
    return [", ".join(entries[i : i + count]) for i in range(0, len(entries), count)]
