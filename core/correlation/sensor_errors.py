"""Sensors that were mounted upside down or plugged in crosswise, one by one and all together.

**Single sensors.** Such a mistake changes the sign of one row of all measured shapes, or exchanges
two rows. Undoing it numerically costs nothing, so every sensor is reversed, and the worst few are
exchanged pair by pair. What counts is not how much the agreement rises, which falls with the number
of sensors, but how far the sensor exceeds the scatter of the others.

A measured shape a of length one is fitted by the computed modes that are paired with it and those
it contains a part of (model error mixes modes), with orthonormal q (n_sensors, n_modes): the sum of
squares outside is S = 1 - |q^H a|^2. A change of rows changes c = q^H a by little:

    sensor i reversed        c - 2 a_i conj(q_i)
    sensors i, j exchanged   c + (a_j - a_i) (conj(q_i) - conj(q_j))

With s^2 the variance of the other sensors about the fit to them alone (the worst tenth left out),
the score of a change is the root of its log-likelihood ratio

    z^2 = sum over modes (S_before - S_after) / s^2

so noise of the test and error of the model, which are in s, lower it alike, and a sensor that
hardly moves has none. A change is named where its score is high, where it explains nearly all that
leaving the sensor out would, r_I^H (1 - q_I q_I^H)^-1 r_I with the residual r, and where no other
change explains the fault as well: with two sensors, reversing one or the other. What is found is
undone, and the search continues with the next.

**All sensors.** The directions of all sensors may be wrong together: x plugged in for y, z counted
downwards. There are 48 ways, the signed permutations of three axes; a shape's sign is arbitrary, so
those that differ by the sign of all axes are one, and the 24 rotations of a cube are left. Each is
tried with its own pairing, for a wrong one has no pairs to judge it by.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations, product

import numpy as np

from modetune.core.assignment import least_cost
from modetune.core.correlation.correlation import Shapes, mac
from modetune.core.correlation.pairing import mac_or_zero
from modetune.core.modes import Floats

#: Score from which a change is named. Noise alone exceeds 4 at one of 200 sensors once in 150
#: tests; what is above that is room for errors of models, which are not Gaussian.
CLEAR = 6.0
#: Share of what leaving the sensor out explains that the change must explain.
EXPLAINED = 0.75
#: A change whose squared score comes this near to the best one's rivals it, absolute (a likelihood
#: ratio of e^8) and as a share.
NEAR, NEARLY = 16.0, 0.9
#: No test measures shapes better than this share of their root mean square.
LEAST_SCATTER = 0.03
#: The share of sensors that scatter worst, which do not count for the scatter.
WORST_SHARE = 0.1
#: MAC from which a computed mode other than the paired ones takes part in a measured shape.
PART = 0.02
#: Modes of a fit are at most this share of the sensors.
FIT_SHARE = 0.2
#: Number of changes that are examined closely, and of sensors that are exchanged.
CANDIDATES, WORST = 40, 8
#: With fewer sensors than this a changed row is not a mistake among others that are right.
FEWEST_SENSORS = 6
Rows = tuple[int, ...]
#: A turn is named where its mean MAC is at least so much, and so much above that of none.
GOOD_MAC, LIFT = 0.7, 0.2
#: Distance of mean MACs within which turns are equally good.
ALIKE = 0.02
NAMES = "xyz"


@dataclass(frozen=True, slots=True)
class SensorError:
    """One sensor turned round, or two exchanged: the change that would undo it.

    rows: of the shapes, one or two; before, after: MAC of each mode, (n_modes,), without and with
    the change; score: its misfit in standard deviations of the other sensors.
    """

    rows: Rows
    before: Floats
    after: Floats
    score: float


def sensor_errors(
    measured: Shapes, computed: Sequence[Shapes], others: Shapes | None = None, most: int = 4
) -> tuple[SensorError, ...]:
    """Return sensors that seem reversed or exchanged, the clearest first.

    measured: (n_sensors, n_modes), no shape zero; computed: for each of these modes the shapes
    that answer it, (n_sensors, n_close), as the same sensors see them; others: all computed shapes
    (n_sensors, n_computed). before and after of each error count those found before as undone.
    """
    shapes = np.array(measured / np.linalg.norm(measured, axis=0))
    if shapes.shape[0] < FEWEST_SENSORS or shapes.shape[1] == 0:
        return ()
    answering = [_orthonormal(space) for space in computed]
    fits = [
        _fit_space(shape, space, others) for shape, space in zip(shapes.T, computed, strict=True)
    ]
    found: list[SensorError] = []
    while len(found) < most:
        rows, score = _clearest(shapes, fits)
        if not rows:
            break
        undone = _undone(shapes, rows)
        before, after = (_inside(there, answering) for there in (shapes, undone))
        found.append(SensorError(rows, before, after, score))
        shapes = undone
    return tuple(found)


def _clearest(shapes: Shapes, fits: Sequence[Shapes]) -> tuple[Rows, float]:
    """The change that explains the fault best, and its score; no rows where none is clear."""
    changes = _likely(shapes, fits)
    drops = _drops(shapes, fits, changes)
    best: Rows = ()
    score = CLEAR
    for place, rows in enumerate(changes):
        whole, scatter = _left_out(shapes, fits, rows)
        z = float(np.sqrt(max(np.sum(drops[place] / scatter), 0.0)))
        if z > score and z**2 > EXPLAINED * np.sum(whole / scatter):
            best, score = rows, z
    if not best:
        return (), 0.0
    _, scatter = _left_out(shapes, fits, best)
    squares = dict(zip(changes, np.sum(drops / scatter, axis=1).tolist(), strict=True))
    later = np.sum(_drops(_undone(shapes, best), fits, changes) / scatter, axis=1)
    limit = min(score**2 - NEAR, NEARLY * score**2)
    for rows, after in zip(changes, later.tolist(), strict=True):
        # A second mistake still explains as much when the first is undone; a rival does not.
        if rows != best and squares[rows] > limit and after < 0.5 * squares[rows]:
            return (), 0.0
    return best, score


def _likely(shapes: Shapes, fits: Sequence[Shapes]) -> list[Rows]:
    """The changes that lower the sums of squares most: turned sensors, and pairs of the worst."""
    residual = _residual(shapes, fits)
    squares = np.abs(residual) ** 2
    weights = 1.0 / np.maximum(squares.sum(axis=0), LEAST_SCATTER**2)
    turned: list[Rows] = [(row,) for row in range(shapes.shape[0])]
    lifts = _drops(shapes, fits, turned) @ weights
    order = np.argsort(-lifts, kind="stable")[:CANDIDATES]
    worst = np.sort(np.argsort(-(squares @ weights), kind="stable")[:WORST]).tolist()
    return [turned[row] for row in order if lifts[row] > 0.0] + list(combinations(worst, 2))


def _drops(shapes: Shapes, fits: Sequence[Shapes], changes: Sequence[Rows]) -> Floats:
    """By how much each change lowers the sum of squares of each mode, (n_changes, n_modes)."""
    first = np.array([rows[0] for rows in changes], dtype=np.int64)
    second = np.array([rows[-1] for rows in changes], dtype=np.int64)
    turned = first == second
    drops = np.empty((len(changes), shapes.shape[1]))
    for mode, (shape, q) in enumerate(zip(shapes.T, fits, strict=True)):
        inside = q.conj().T @ shape
        steps = np.where(turned, -2.0 * shape[first], shape[second] - shape[first])
        away = q[first].conj() - np.where(turned[:, None], 0.0, q[second].conj())
        after = np.sum(np.abs(inside + steps[:, None] * away) ** 2, axis=1)
        drops[:, mode] = after - np.sum(np.abs(inside) ** 2)
    return drops


def _left_out(shapes: Shapes, fits: Sequence[Shapes], rows: Rows) -> tuple[Floats, Floats]:
    """What leaving these sensors out of the fit lowers the sums of squares by, and what is left.

    Both (n_modes,): the second is the variance of those other sensors that agree.
    """
    index, n_sensors = list(rows), shapes.shape[0]
    drops = np.empty(shapes.shape[1])
    residual = _residual(shapes, fits)
    squares = np.empty((n_sensors - len(rows), shapes.shape[1]))
    for mode, q in enumerate(fits):
        rest = np.eye(len(index)) - q[index] @ q[index].conj().T
        solved = np.linalg.lstsq(rest, residual[index, mode], rcond=1e-9)[0]
        drops[mode] = float(np.real(residual[index, mode].conj() @ solved))
        without = residual[:, mode] + q @ (q[index].conj().T @ solved)
        squares[:, mode] = np.delete(np.abs(without) ** 2, index)
    total = np.sum(squares / np.maximum(squares.mean(axis=0), 1e-30), axis=1)
    kept = np.argsort(total, kind="stable")[: squares.shape[0] - int(WORST_SHARE * n_sensors)]
    freedom = np.array([1.0 - q.shape[1] / n_sensors for q in fits])
    scatter = squares[kept].mean(axis=0) / freedom
    return drops, np.maximum(scatter, LEAST_SCATTER**2 / n_sensors)


def _residual(shapes: Shapes, fits: Sequence[Shapes]) -> Shapes:
    """What of each shape the fit leaves, (n_sensors, n_modes)."""
    columns = [shape - q @ (q.conj().T @ shape) for shape, q in zip(shapes.T, fits, strict=True)]
    return np.asarray(np.stack(columns, axis=1))


def _inside(shapes: Shapes, spaces: Sequence[Shapes]) -> Floats:
    """MAC of each shape of length one with its space, (n_modes,)."""
    squares = [np.abs(q.conj().T @ shape) ** 2 for shape, q in zip(shapes.T, spaces, strict=True)]
    return np.array([float(np.sum(item)) for item in squares])


def _fit_space(shape: Shapes, answering: Shapes, others: Shapes | None) -> Shapes:
    """A basis of the answering modes and of those that the shape has a part of, few for sensors."""
    if others is None or not others.size:
        return _orthonormal(answering)
    moving = others[:, np.abs(others).max(axis=0) > 0.0]
    parts = mac(shape[:, None], moving)[0]
    room = max(int(FIT_SHARE * shape.size) - answering.shape[1], 0)
    taken = [place for place in np.argsort(-parts, kind="stable") if parts[place] > PART]
    # The paired modes add no direction, and take no room.
    new = [place for place in taken if not (mac(moving[:, [place]], answering) > 1.0 - 1e-9).any()]
    return _orthonormal(np.hstack([answering, moving[:, new[:room]]]))


def _undone(shapes: Shapes, rows: Rows) -> Shapes:
    """The shapes with one row turned round, or two exchanged."""
    changed = shapes.copy()
    changed[list(rows)] = -shapes[rows[0]] if len(rows) == 1 else shapes[list(rows[::-1])]
    return changed


def _orthonormal(space: Shapes) -> Shapes:
    """A basis of the space of these columns; those that are of the others' space add nothing."""
    directions, sizes, _ = np.linalg.svd(space / np.abs(space).max(axis=0), full_matrices=False)
    return np.asarray(directions[:, sizes > 1e-10 * sizes[0]])


@dataclass(frozen=True, slots=True)
class TurnedAxes:
    """Turns of the axes that would undo the mistake; several if they are equally good.

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
    texts = []
    for column in range(3):
        row = int(np.argmax(np.abs(matrix[:, column])))
        texts.append(f"{NAMES[column]} is {'-' if matrix[row, column] < 0.0 else ''}{NAMES[row]}")
    return ", ".join(texts)


def _mean_mac(measured: Shapes, computed: Shapes) -> float:
    """Mean MAC of the best one-to-one pairing."""
    table = mac_or_zero(measured, computed)
    rows, columns = least_cost(-table)
    return float(table[rows, columns].sum() / measured.shape[1])
