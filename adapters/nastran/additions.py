"""Masses and springs added to a Nastran deck, at the end of its bulk data."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modetune.adapters.deck_files import text_with
from modetune.adapters.nastran.bulk import Bulk
from modetune.adapters.nastran.constraints import constraint_cards, held_by
from modetune.adapters.nastran.deck import NastranDeck
from modetune.adapters.solver import AddedCards, Addition
from modetune.core.errors import ModelError
from modetune.core.mesh import Mesh
from modetune.core.parameters import Quantity, TargetKind


def with_addition(
    deck: NastranDeck, mesh: Mesh, wtmass: float, addition: Addition, bulk: Bulk, spc: int
) -> AddedCards:
    """Return the main file with an addition. Raises ModelError.

    wtmass: the deck's factor on all mass, by which masses are divided. spc: the selected set of
    supports.
    """
    if len(deck.parts) > 1:
        raise ModelError(f"{deck.file}: cards are not added to a deck of superelements")
    end = deck.lines[deck.bulk.stop - 1] if deck.bulk.stop else None
    last = deck.lines[-1]
    before = last.number if last.text.strip().upper().startswith("ENDDATA") else 0
    if end is None or (before and last.file != deck.file):
        raise ModelError(
            f"{last.where}: the bulk data end in an include, and cards are added to the main file "
            "alone"
        )
    number = 1 + max((_number(card.text(1)) for card in deck.cards), default=0)
    lines, parts = ["$ added by modetune localise"], list[tuple[Quantity, TargetKind, str, float]]()
    nodes, component = addition.nodes, addition.component
    if addition.kind in ("support", "link"):
        more, comments = (
            _support(deck, bulk, spc, addition, number)
            if addition.kind == "support"
            else _joint(deck, mesh, bulk, addition, number)
        )
        lines += more
        text = text_with(deck.file, before, lines, "$ ", comments)
        names, value = (str(number),), addition.values[0]
        return AddedCards(text, tuple(lines), (("spring_stiffness", "property", names, value),))
    if addition.kind == "absorber":
        x, y, z = mesh.coordinates[mesh.rows(np.array([nodes[0]]))[0]].tolist()
        frame = "0" if nodes[0] not in mesh.frames else ""
        if not frame:
            raise ModelError(
                f"{deck.file}: grid {nodes[0]} has its own axes (CD), in which no absorber is added"
            )
        others = "".join(str(axis) for axis in range(1, 7) if axis != component)
        lines += _wide("GRID", number, 0, x, y, z, 0, others)
        nodes, number = (nodes[0], number), number + 1
    if addition.kind != "spring":
        value, inertia = addition.values[0] / wtmass, addition.kind == "inertia"
        about = (0.0, 0.0, 0.0, 0.0, "", value, 0.0, value, 0.0, 0.0, value)
        quantity: Quantity = "rotary_inertia" if inertia else "mass"
        for node in nodes[1:] if addition.kind == "absorber" else nodes:
            lines += _wide("CONM2", number, node, 0, *(about if inertia else (value,)))
            parts.append((quantity, "element", str(number), value))
            number += 1
    if addition.kind not in ("mass", "inertia"):
        ends = [part for node in nodes for part in (node, component)]
        lines += _wide("CELAS1", number, number, *ends)
        lines += _wide("PELAS", number, addition.values[-1])
        parts.append(("spring_stiffness", "property", str(number), addition.values[-1]))
    text = text_with(deck.file, before, lines)
    together: dict[tuple[Quantity, TargetKind, float], list[str]] = {}
    for what, by, name, size in parts:
        together.setdefault((what, by, size), []).append(name)
    numbers = tuple((what, by, tuple(own), size) for (what, by, size), own in together.items())
    return AddedCards(text, tuple(lines), numbers)


def _support(
    deck: NastranDeck, bulk: Bulk, spc: int, addition: Addition, number: int
) -> tuple[list[str], list[int]]:
    """Return springs in place of what holds some grids, and lines to comment out."""
    kept, comments, held = _kept_holds(deck, bulk, spc, set(addition.nodes), addition.component)
    return [*kept, *_springs(number, addition.values[0], held)], comments


def _springs(number: int, value: float, ends: Sequence[tuple[int, ...]]) -> list[str]:
    """Return springs of one property; ends: grid and component of each, or those of both ends."""
    lines = _wide("PELAS", number, value)
    for place, own in enumerate(ends, start=1):
        lines += _wide("CELAS1", number + place, number, *own)
    return lines


def _joint(
    deck: NastranDeck, mesh: Mesh, bulk: Bulk, addition: Addition, number: int
) -> tuple[list[str], list[int]]:
    """Return a rigid element on grids of its own with springs, and lines to comment out.

    What does not yield stays in the element with its number.
    """
    wanted = set(addition.nodes)
    cards = [
        card
        for card in deck.named("RBE2")
        if (element := bulk.rigid_elements.get(_number(card.text(1)))) is not None
        and set(map(int, element.Gmi)) == wanted
    ]
    if len(cards) != 1:
        raise ModelError(
            f"{deck.file}: a link that yields is replaced where one RBE2 has exactly its grids "
            f"({len(cards)} have them)"
        )
    own = [deck.lines[position] for position in cards[0].lines]
    if any(line.file != deck.file for line in own):
        raise ModelError(f"{own[0].where}: links are replaced in the main file alone")
    element = bulk.rigid_elements[_number(cards[0].text(1))]
    nodes, tied = sorted(wanted), [int(axis) for axis in sorted(element.cm)]
    yields = [axis for axis in tied if addition.component in (0, axis)]
    if not yields:
        raise ModelError(f"{own[0].where}: the element does not tie component {addition.component}")
    lines, twins = list[str](), dict[int, int]()
    for place, node in enumerate(nodes):
        x, y, z = mesh.coordinates[mesh.rows(np.array([node]))[0]].tolist()
        twins[node] = number + place
        lines += _wide("GRID", twins[node], 0, x, y, z, bulk.nodes[node].Cd())
    rest = "".join(str(axis) for axis in tied if axis not in yields)
    if rest:
        lines += _wide("RBE2", element.eid, element.gn, rest, *nodes)
    lines += _wide("RBE2", number, element.gn, "123456", *twins.values())
    ties = [(twins[node], axis, node, axis) for node in nodes for axis in yields]
    lines += _springs(number, addition.values[0], ties)
    return lines, [line.number for line in own]


def _kept_holds(
    deck: NastranDeck, bulk: Bulk, spc: int, nodes: set[int], component: int
) -> tuple[list[str], list[int], list[tuple[int, int]]]:
    """Return what stays held of the cards that hold some freedoms, their lines, and the freedoms.

    component: 0 for all.
    """

    def freed(node: int, axis: int) -> bool:
        return node in nodes and component in (0, axis)

    sets = {card.conid for card in constraint_cards(bulk, "spc", spc)}
    kept, comments, found = list[str](), list[int](), set[tuple[int, int]]()
    for card in deck.named("SPC", "SPC1"):
        if _number(card.text(1)) not in sets:
            continue
        held = held_by(card, bulk)
        own = {dof for dof in held if freed(*dof)}
        if not own:
            continue
        lines = [deck.lines[position] for position in card.lines]
        if any(line.file != deck.file for line in lines):
            raise ModelError(f"{lines[0].where}: supports are replaced in the main file alone")
        found |= own
        comments += [line.number for line in lines]
        rest: dict[int, str] = {}
        for node, axis in sorted(held - own):
            rest[node] = rest.get(node, "") + str(axis)
        for node, axes in rest.items():
            kept += _wide("SPC1", _number(card.text(1)), axes, node)
    by_grid = [n for n in sorted(nodes) if n in bulk.nodes and bulk.nodes[n].ps]
    if by_grid or not found:
        what = f"grid {by_grid[0]} is held by its own PS field" if by_grid else "no SPC holds these"
        raise ModelError(f"{deck.file}: {what}: supports of SPC and SPC1 cards are replaced")
    return kept, comments, sorted(found)


def _number(text: str) -> int:
    return int(text) if text.isdigit() else 0


def _wide(name: str, *values: float | str) -> list[str]:
    """Return a card in fields of 16 characters, four a line."""
    words = [value if isinstance(value, str) else _text(value) for value in values]
    rows = [words[at : at + 4] for at in range(0, len(words), 4)]
    heads = [f"{name}*", *["*"] * (len(rows) - 1)]
    lines = [
        f"{head:8}" + "".join(f"{word:>16}" for word in row)
        for head, row in zip(heads, rows, strict=True)
    ]
    return lines if len(rows) > 1 else [*lines, "*"]


def _text(value: float) -> str:
    if isinstance(value, int):
        return str(value)
    text = f"{value:.9g}"
    return text if set(text) & set(".e") else f"{text}."
