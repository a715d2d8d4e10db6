"""Axes of a whole test that are exchanged or reversed, found by trying all of them.

The directions of all sensors may be wrong together: x plugged in for y, z counted downwards. There
are 48 ways, the signed permutations of three axes; a shape's sign is its own, so those that differ
by the sign of all axes are one, and 24 are left, the turns of a cube. Each is tried with a pairing
of its own, for a wrong one has no pairs to be judged by.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from modetune.core.assignment import least_cost
from modetune.core.correlation.correlation import Shapes
from modetune.core.correlation.pairing import mac_or_zero
from modetune.core.modes import Floats

#: A turn is named where its mean MAC is at least so much, and so much above that of none.
GOOD_MAC, LIFT = 0.7, 0.2
#: Turns whose mean MACs are this near to the best cannot be told from it.
ALIKE = 0.02
NAMES = "xyz"


@dataclass(frozen=True, slots=True)
class TurnedAxes:
    """Turns of the axes that would undo the mistake; several where they are told by nothing.

    matrices: each (3, 3), a direction of the test times it is where the sensor looks; mac: mean
    MAC of the pairs with the first; before: without a turn.
    """

    matrices: tuple[Floats, ...]
    mac: float
    before: float

    @property
    def told(self) -> tuple[str, ...]:
        """What each turn is, in words."""
        return tuple(turn_name(matrix) for matrix in self.matrices)


def turns() -> list[Floats]:
    """The 24 turns (3, 3) that take axes to axes, none first, then the fewest axes changed."""
    found = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        matrix = np.zeros((3, 3))
        matrix[range(3), order] = signs
        if np.linalg.det(matrix) > 0.0:
            found.append(matrix)
    return sorted(found, key=lambda matrix: -float(np.trace(matrix)))


def turned_axes(measured: Shapes, seen: Callable[[Floats], Shapes | None]) -> TurnedAxes | None:
    """The turn of all axes with which test and model agree, None where no turn is needed.

    measured: (n_sensors, n_modes). seen: computed shapes (n_sensors, n_computed) as sensors see
    them whose directions are turned by a matrix (3, 3); None where the model lacks a component.
    """
    scores: list[tuple[Floats, float]] = []
    for matrix in turns():
        shapes = seen(matrix)
        if shapes is not None:
            scores.append((matrix, _mean_mac(measured, shapes)))
    if not scores or not np.array_equal(scores[0][0], np.eye(3)):
        return None
    before, best = scores[0][1], max(score for _, score in scores)
    if best < max(GOOD_MAC, before + LIFT):
        return None
    alike = tuple(matrix for matrix, score in scores if score > best - ALIKE)
    return TurnedAxes(alike, best, before)


def turn_name(matrix: Floats) -> str:
    """A turn of the axes in words; both ways of saying it where the sign of all axes is free."""
    trace = round(float(np.trace(matrix)))
    (axis,) = np.flatnonzero(np.abs(np.diag(matrix)) > 0.5)[:1].tolist() or [0]
    if trace == 3:
        return "as they are"
    if trace == 1:
        other, third = (axis + 1) % 3, (axis + 2) % 3
        angle = 90 if matrix[third, other] > 0.0 else -90
        return f"turned by {angle} degrees about {NAMES[axis]}"
    if trace == 0:
        return f"exchanged in turn ({_exchange(matrix)})"
    kept = np.flatnonzero(np.diag(matrix) > 0.5)
    if kept.size:
        name = NAMES[int(kept[0])]
        return f"turned by 180 degrees about {name}, or {name} alone reversed"
    return f"exchanged and reversed ({_exchange(matrix)})"


def _exchange(matrix: Floats) -> str:
    """What each axis of the test is: x is -y."""
    said = []
    for column in range(3):
        row = int(np.argmax(np.abs(matrix[:, column])))
        said.append(f"{NAMES[column]} is {'-' if matrix[row, column] < 0.0 else ''}{NAMES[row]}")
    return ", ".join(said)


def _mean_mac(measured: Shapes, computed: Shapes) -> float:
    """Mean MAC of the best one-to-one pairing."""
    table = mac_or_zero(measured, computed)
    rows, columns = least_cost(-table)
    return float(table[rows, columns].sum() / measured.shape[1])
