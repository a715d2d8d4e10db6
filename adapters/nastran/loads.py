"""The load cases of a Nastran deck: forces and moments of a load set, FORCE, MOMENT and LOAD."""

from __future__ import annotations

import numpy as np

from modetune.adapters.nastran.deck import NastranCard
from modetune.adapters.nastran.geometry import local_axes
from modetune.adapters.nastran.structure import Structure
from modetune.core.errors import ModelError
from modetune.core.updating.static import LoadCase

#: Cards whose second field is a load set and which no forces at grid points stand for here.
OTHER_LOADS = (
    "FORCE1", "FORCE2", "MOMENT1", "MOMENT2", "PLOAD", "PLOAD1", "PLOAD2", "PLOAD4", "PLOADX1",
    "GRAV", "ACCEL", "ACCEL1", "RFORCE", "SLOAD", "SPCD", "TEMP", "TEMPD", "DEFORM",
)  # fmt: skip
#: First component of each.
FIRST = {"FORCE": 1, "MOMENT": 4}
LOAD_PAIRS = 3


def load_case(structure: Structure, number: int) -> LoadCase:
    """The forces of a load set. Raises ModelError where the deck has none, or other loads."""
    forces = _forces(structure, str(number), 1.0, ())
    return LoadCase.of_forces(forces)


def _forces(
    structure: Structure, number: str, factor: float, above: tuple[str, ...]
) -> list[tuple[int, int, float, str]]:
    deck = structure.deck
    for card in deck.named(*OTHER_LOADS):
        if card.text(1) == number:
            raise ModelError(
                f"{deck.where(card)}: {card.name} of load set {number}; load cases here are FORCE, "
                "MOMENT and LOAD"
            )
    found = []
    for card in deck.named("LOAD"):
        if card.text(1) == number and number not in above:
            whole = structure.number(card, 2) or 1.0
            for place in range(LOAD_PAIRS, len(card.fields), 2):
                if card.text(place + 1):
                    share = factor * whole * (structure.number(card, place) or 0.0)
                    found += _forces(structure, card.text(place + 1), share, (*above, number))
    for card in deck.named(*FIRST):
        if card.text(1) == number:
            found += _of_card(structure, card, factor)
    if not found:
        sets = {card.text(1) for card in deck.named(*FIRST, "LOAD")}
        has = ", ".join(sorted(sets)) or "none"
        raise ModelError(f"{deck.file}: the deck has no load set {number}; it has {has}")
    return found


def _of_card(
    structure: Structure, card: NastranCard, factor: float
) -> list[tuple[int, int, float, str]]:
    """What a FORCE or MOMENT is along the axes that results have at its grid point (CD)."""
    bulk, where = structure.bulk, structure.deck.where(card)
    grid, frame = (int(t) if (t := card.text(k) or "0").isdecimal() else -1 for k in (2, 3))
    if grid not in bulk.nodes or frame not in bulk.coords:
        raise ModelError(f"{where}: {card.name} names a grid point or system that is not there")
    point = bulk.nodes[grid]
    place = np.asarray(point.get_position(), dtype=np.float64)
    vector = np.array([structure.number(card, k) or 0.0 for k in (5, 6, 7)])
    size = factor * (structure.number(card, 4) or 0.0)
    values = local_axes(point.cd_ref, place) @ (
        local_axes(bulk.coords[frame], place).T @ (size * vector)
    )
    return [
        (grid, FIRST[card.name] + axis, value, where)
        for axis, value in enumerate(values.tolist())
        if value
    ]
