"""Sensors that were mounted upside down or plugged in crosswise, found from paired shapes.

Such a mistake changes the sign of one row of all measured shapes, or exchanges two rows. To undo
it in numbers costs nothing, so every sensor is turned round, and the worst few are exchanged pair
by pair; what lifts the agreement clearly, and clearly more than any other change, is suspected.

A measured shape a is judged by the share of it that lies in the space of the close computed modes
that answer it, with orthonormal q (n_sensors, n_close): |q^H a|^2 / a^H a, the MAC where one mode
answers. A change of rows changes c = q^H a by little:

    sensor i turned round    c - 2 a_i conj(q_i)
    sensors i, j exchanged   c + (a_j - a_i) (conj(q_i) - conj(q_j))

and leaves a^H a as it is. The worst sensors are those with the largest part of the shapes outside
the spaces, |a - q c|_i. What is found is undone, and the search goes on for the next.

Where two changes explain a fault as well as each other (at two sensors, to turn one or the other),
none is named: a second change that lifts nearly as much, and nothing more once the first is made,
is such a rival.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from modetune.core.correlation.correlation import Shapes
from modetune.core.modes import Floats

#: A change that lifts the mean MAC by this, or the least one by LEAST_LIFT, is clear.
MEAN_LIFT = 0.02
LEAST_LIFT = 0.05
#: A change that lowers the MAC of any mode by more than this undoes no mistake.
MOST_LOSS = 0.02
#: Share of the best change's lift from which another one rivals it.
NEARLY = 0.9
#: Sensors that are exchanged with each other: the worst ones.
WORST = 6
#: With fewer sensors than this a changed row is not a mistake among others that are right.
FEWEST_SENSORS = 6


@dataclass(frozen=True, slots=True)
class SensorError:
    """One sensor turned round, or two exchanged: the change that would undo it.

    rows: of the shapes, one or two; before, after: MAC of each mode, (n_modes,), without and with
    the change.
    """

    rows: tuple[int, ...]
    before: Floats
    after: Floats

    @property
    def lift(self) -> float:
        """Of the mean MAC."""
        return float(np.mean(self.after - self.before))

    @property
    def is_clear(self) -> bool:
        """Whether the agreement is so much better that it is not by chance."""
        least = float(self.after.min() - self.before.min())
        lifts = self.lift >= MEAN_LIFT or (least >= LEAST_LIFT and self.lift > 0.0)
        return lifts and float((self.after - self.before).min()) >= -MOST_LOSS


def sensor_errors(
    measured: Shapes, computed: Sequence[Shapes], most: int = 4
) -> tuple[SensorError, ...]:
    """Sensors that seem turned round or exchanged, the clearest first, at most so many.

    measured: (n_sensors, n_modes), no shape zero; computed: for each of these modes the shapes
    that answer it, (n_sensors, n_close), as the same sensors see them. before and after of each
    error count those found before as undone.
    """
    shapes = np.array(measured / np.linalg.norm(measured, axis=0))
    if shapes.shape[0] < FEWEST_SENSORS or shapes.shape[1] == 0:
        return ()
    spaces = [_orthonormal(space) for space in computed]
    found: list[SensorError] = []
    while len(found) < most:
        clear = [change for change in _changes(shapes, spaces) if change.is_clear]
        if not clear:
            break
        best = max(clear, key=lambda change: change.lift)
        undone = _undone(shapes, best.rows)
        after = {change.rows: change.lift for change in _changes(undone, spaces)}
        rivals = [
            change
            for change in clear
            if change.rows != best.rows
            and change.lift > NEARLY * best.lift
            and after.get(change.rows, 0.0) < (1.0 - NEARLY) * best.lift
        ]
        if rivals:
            break
        found.append(best)
        shapes = undone
    return tuple(found)


def _changes(shapes: Shapes, spaces: Sequence[Shapes]) -> Iterator[SensorError]:
    """Every sensor turned round, every two of the worst exchanged. shapes: of length one."""
    n_sensors = shapes.shape[0]
    outside = np.zeros(n_sensors)
    for shape, q in zip(shapes.T, spaces, strict=True):
        outside += np.abs(shape - q @ (q.conj().T @ shape)) ** 2
    worst = np.sort(np.argsort(-outside, kind="stable")[:WORST]).tolist()
    changes: list[tuple[int, ...]] = [(row,) for row in range(n_sensors)]
    changes += list(combinations(worst, 2))
    first = np.array([rows[0] for rows in changes])
    second = np.array([rows[-1] for rows in changes])
    turned = first == second
    before = np.empty(shapes.shape[1])
    after = np.empty((len(changes), shapes.shape[1]))
    for mode, (shape, q) in enumerate(zip(shapes.T, spaces, strict=True)):
        inside = q.conj().T @ shape
        steps = np.where(turned, -2.0 * shape[first], shape[second] - shape[first])
        away = q[first].conj() - np.where(turned[:, None], 0.0, q[second].conj())
        before[mode] = np.sum(np.abs(inside) ** 2)
        after[:, mode] = np.sum(np.abs(inside + steps[:, None] * away) ** 2, axis=1)
    for rows, values in zip(changes, after, strict=True):
        yield SensorError(rows, before, values)


def _undone(shapes: Shapes, rows: tuple[int, ...]) -> Shapes:
    """The shapes with one row turned round, or two exchanged."""
    changed = shapes.copy()
    changed[list(rows)] = -shapes[rows[0]] if len(rows) == 1 else shapes[list(rows[::-1])]
    return changed


def _orthonormal(space: Shapes) -> Shapes:
    """A basis of the space of these columns; those that are of the others' space add nothing."""
    directions, sizes, _ = np.linalg.svd(space / np.abs(space).max(axis=0), full_matrices=False)
    return np.asarray(directions[:, sizes > 1e-10 * sizes[0]])
