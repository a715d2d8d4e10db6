"""A Nastran deck with every edge of its beams, shells and solids cut in half.

What a mesh of half the size changes tells how far frequencies depend on the mesh at all: two right
element formulations may differ by as much. New grids lie in the middle of edges, faces and bricks,
on straight lines; on edges and faces they are held as all ends of these are. Rods stay whole (their
halves would be a mechanism), as do springs, masses and rigid elements, which keep their grids.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from pyNastran.bdf.bdf import BDF

from modetune.adapters.nastran.deck import NastranDeck, read_deck, with_added
from modetune.adapters.nastran.model import understand
from modetune.core.errors import ModelError

#: Elements that stay as they are.
WHOLE = frozenset(
    {"CROD", "CONROD", "CTUBE", "CELAS1", "CELAS2", "CELAS3", "CELAS4", "CBUSH", "CBUSH1D",
     "CDAMP1", "CDAMP2", "CDAMP3", "CDAMP4", "CVISC", "PLOTEL"}
)  # fmt: skip
#: Beams, and corners of shells and solids.
BEAMS = frozenset({"CBAR", "CBEAM"})
CORNERS = {"CTRIA3": 3, "CQUAD4": 4, "CTETRA": 4, "CPENTA": 6, "CHEXA": 8}
#: Corners at the places of a lattice of three points a direction, (0, 1, 2) each.
BRICK = ((0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0), (0, 0, 2), (2, 0, 2), (2, 2, 2), (0, 2, 2))
#: The four tetrahedra at the corners of one, and four that fill the octahedron between its edges.
TETRAHEDRA = (
    ((0,), (0, 1), (0, 2), (0, 3)), ((0, 1), (1,), (1, 2), (1, 3)),
    ((0, 2), (1, 2), (2,), (2, 3)), ((0, 3), (1, 3), (2, 3), (3,)),
    ((0, 1), (1, 2), (0, 2), (1, 3)), ((0, 2), (1, 2), (2, 3), (1, 3)),
    ((0, 2), (2, 3), (0, 3), (1, 3)), ((0, 1), (0, 2), (0, 3), (1, 3)),
)  # fmt: skip
TRIANGLES = (((0,), (0, 1), (0, 2)), ((0, 1), (1,), (1, 2)), ((0, 2), (1, 2), (2,)),
             ((1, 2), (0, 2), (0, 1)))  # fmt: skip


class HalvedDeck:
    """A deck while its elements are cut."""

    def __init__(self, deck: NastranDeck) -> None:
        self.bulk: Any = understand(deck).structure.bulk
        self.new: Any = BDF(debug=None)
        self.places = {n: np.asarray(grid.get_position()) for n, grid in self.bulk.nodes.items()}
        self.made: dict[frozenset[int], int] = {}
        self.gone: set[int] = set()
        self.next_grid = 1 + max(self.places)
        known = (self.bulk.elements, self.bulk.rigid_elements, self.bulk.masses)
        self.next_element = 1 + max(0, *(number for items in known for number in items))

    def middle(self, ends: Iterable[int]) -> int:
        """Return the grid in the middle of an edge, a face or a brick, or at one grid."""
        own = frozenset(ends)
        if len(own) == 1:
            return next(iter(own))
        if own not in self.made:
            grids = [self.bulk.nodes[n] for n in own]
            frames = {grid.Cd() for grid in grids}
            held = set.intersection(*(set(str(grid.ps)) for grid in grids)) & set("123456")
            place = np.mean([self.places[n] for n in own], axis=0)
            number, self.next_grid = self.next_grid, self.next_grid + 1
            self.new.add_grid(
                number, place, cp=0, cd=frames.pop() if len(frames) == 1 else 0,
                ps="".join(sorted(held)),
            )  # fmt: skip
            self.places[number], self.made[own] = place, number
        return self.made[own]

    def cut(self, element: Any) -> None:
        """Replace an element by those of half its size. Raises ModelError for an unknown one."""
        kind, nodes = element.type, list(element.node_ids)
        if kind in WHOLE:
            return
        if kind in BEAMS:
            self._cut_beam(element, nodes)
            return
        if kind not in CORNERS or None in nodes or len(nodes) != CORNERS[kind]:
            raise ModelError(f"{kind} {element.eid} is not cut in half")
        thicknesses = {getattr(element, f"T{n}", None) for n in range(1, 5)}
        if thicknesses != {None} and kind in ("CTRIA3", "CQUAD4"):
            raise ModelError(f"{kind} {element.eid} has thicknesses of its own")
        for own in self._parts(kind, nodes):
            self._add(element, own)
        self.gone.add(element.eid)

    def _parts(self, kind: str, nodes: Sequence[int]) -> Iterable[list[int]]:
        if kind in ("CTRIA3", "CTETRA"):
            for part in TRIANGLES if kind == "CTRIA3" else TETRAHEDRA:
                yield [self.middle(nodes[n] for n in ends) for ends in part]
        elif kind == "CPENTA":
            for low, high in ((0, 1), (1, 2)):
                for part in TRIANGLES:
                    yield [self._between(nodes, ends, level) for level in (low, high)
                           for ends in part]  # fmt: skip
        else:
            flat = kind == "CQUAD4"
            corners: dict[tuple[int, ...], int] = dict(zip(BRICK, nodes, strict=False))
            for k in (0,) if flat else (0, 1):
                for j in (0, 1):
                    for i in (0, 1):
                        yield [
                            self._at(corners, (i + a // 2, j + b // 2, k + c // 2))
                            for a, b, c in BRICK[: len(nodes)]
                        ]

    def _between(self, nodes: Sequence[int], ends: Sequence[int], level: int) -> int:
        """Return a grid of a wedge: of its lower (0) or upper (2) triangle, or between them."""
        low, high = [nodes[n] for n in ends], [nodes[n + 3] for n in ends]
        return self.middle({0: low, 1: [*low, *high], 2: high}[level])

    def _at(self, corners: dict[tuple[int, ...], int], place: tuple[int, ...]) -> int:
        """Return the grid at a place of the lattice: between all corners next to it."""
        return self.middle(
            node for corner, node in corners.items()
            if all(p in (1, c) for p, c in zip(place, corner, strict=True))
        )  # fmt: skip

    def _add(self, element: Any, nodes: list[int]) -> None:
        number, self.next_element = self.next_element, self.next_element + 1
        match element.type:
            case "CTRIA3" | "CQUAD4":
                add = getattr(self.new, f"add_{element.type.lower()}")
                add(number, element.pid, nodes, element.theta_mcid, element.zoffset)
            case _:
                getattr(self.new, f"add_{element.type.lower()}")(number, element.pid, nodes)

    def _cut_beam(self, element: Any, nodes: list[int]) -> None:
        x, g0 = (element.x, None) if element.g0 is None else (None, element.g0)
        first, last = np.asarray(element.wa), np.asarray(element.wb)
        if element.type == "CBEAM" and (element.sa or element.sb or element.bit is not None):
            raise ModelError(f"CBEAM {element.eid} has warping grids or BIT")
        middle = self.middle(nodes)
        ends = [(nodes[0], first), (middle, (first + last) / 2.0), (nodes[1], last)]
        pins = [(element.pa, 0), (0, element.pb)]
        self.gone.add(element.eid)
        add = self.new.add_cbar if element.type == "CBAR" else self.new.add_cbeam
        for (start, end), (pin_a, pin_b) in zip(pairwise(ends), pins, strict=True):
            number, self.next_element = self.next_element, self.next_element + 1
            add(
                number, element.pid, [start[0], end[0]], x, g0, offt=element.offt,
                pa=pin_a, pb=pin_b, wa=start[1], wb=end[1],
            )  # fmt: skip

    def hold(self) -> None:
        """Hold new grids on edges and faces as all their ends are held by SPC and SPC1."""
        for number, cards in self.bulk.spcs.items():
            held: dict[int, set[str]] = {}
            for card in cards:
                if card.type == "SPC1":
                    for node in card.nodes:
                        held.setdefault(node, set()).update(card.components)
                elif card.type == "SPC":
                    for node, components in zip(card.nodes, card.components, strict=True):
                        held.setdefault(node, set()).update(components)
            for ends, node in self.made.items():
                own = set.intersection(*(held.get(end, set()) for end in ends))
                if own:
                    self.new.add_spc1(number, "".join(sorted(own)), [node])


def halved_deck(path: Path, out: Path) -> None:
    """Write a deck with half the element size, with its includes in it.

    Raises ModelError where an element has no halves.
    """
    deck = read_deck(path)
    try:
        halves = HalvedDeck(deck)
        for element in halves.bulk.elements.values():
            halves.cut(element)
        halves.hold()
    except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:
        raise ModelError(f"the mesh is not cut in half: {error}") from error
    if not halves.gone:
        raise ModelError("no element of the deck has halves")
    changed = {
        line: "$"
        for card in deck.named(*BEAMS, *CORNERS)
        if deck.number(card, 1) in halves.gone
        for line in card.lines
    }
    new = halves.new
    cards = [*new.nodes.values(), *new.elements.values(), *chain(*new.spcs.values())]
    added = "".join(card.write_card(size=16) for card in cards).splitlines()
    whole = with_added(deck, changed, {deck.cards[-1].lines[-1]: added})
    out.write_text("".join(f"{line.text}\n" for line in whole.lines), encoding="utf-8")
