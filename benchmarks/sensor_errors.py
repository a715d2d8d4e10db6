"""Reversed or exchanged sensors: how many are named, and how many correct ones.

Structures of beams in space (an aircraft of sticks, a portal frame with a boom, a grid that is a
plate) and chains of masses, for none of which any threshold was made. The model is the one that was
tested (clean), or its parts have other stiffnesses and masses (erroneous: frequencies some 5 to
10 % off, MAC about 0.9). Every measured shape has noise of 3 % of its root mean square.

    python benchmarks/sensor_errors.py [TESTS]
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg import eigh
from scipy.optimize import linear_sum_assignment

from modetune.core.correlation.correlation import mac
from modetune.core.correlation.sensor_errors import sensor_errors
from modetune.core.modes import Floats

NOISE = 0.03
#: Pairs of a lower MAC are not judged by, as the pre-check has it.
BELIEVED = 0.2
Groups = dict[int, float]


@dataclass(frozen=True, slots=True)
class Beams:
    """Nodes (n, 3) and beams between them: (first, second, group), with EI = GJ = 1 of each.

    springs: of a chain in one direction instead of beams; held: nodes that do not move.
    """

    nodes: Floats
    beams: tuple[tuple[int, int, int], ...]
    held: tuple[int, ...] = ()
    springs: bool = False

    @property
    def n_groups(self) -> int:
        return 1 + max(group for _, _, group in self.beams)


def stiffness(length: float) -> Floats:
    """Of a beam along x with EA = 1000, GJ = 0.7, EI = 1 (12, 12), after Bernoulli."""
    k = np.zeros((12, 12))
    for at, value in ((0, 1000.0 / length), (3, 0.7 / length)):
        k[np.ix_([at, at + 6], [at, at + 6])] += value * np.array([[1, -1], [-1, 1]])
    length2 = length * length
    bend = np.array(
        [[12, 6 * length, -12, 6 * length], [6 * length, 4 * length2, -6 * length, 2 * length2],
         [-12, -6 * length, 12, -6 * length], [6 * length, 2 * length2, -6 * length, 4 * length2]]
    ) / length**3  # fmt: skip
    k[np.ix_([1, 5, 7, 11], [1, 5, 7, 11])] += bend
    sign = np.array([1, -1, 1, -1])
    k[np.ix_([2, 4, 8, 10], [2, 4, 8, 10])] += bend * np.outer(sign, sign)
    return k


def modes(made: Beams, stiff: Floats, heavy: Floats, count: int) -> tuple[Floats, Floats]:
    """Frequencies (count,) and shapes (n_nodes, 3, count) of the lowest elastic modes."""
    n, width = len(made.nodes), 1 if made.springs else 6
    k, m = np.zeros((width * n, width * n)), np.zeros(width * n)
    for first, second, group in made.beams:
        span = made.nodes[second] - made.nodes[first]
        length = float(np.linalg.norm(span))
        if made.springs:
            local = np.array([[1.0, -1.0], [-1.0, 1.0]])
        else:
            axis = span / length
            side = np.cross(axis, [0.3, 0.5, 0.8])
            side /= np.linalg.norm(side)
            turn = np.kron(np.eye(4), np.stack([axis, side, np.cross(axis, side)]))
            local = turn.T @ stiffness(length) @ turn
        rows = np.r_[width * first : width * first + width, width * second : width * second + width]
        k[np.ix_(rows, rows)] += stiff[group] * local
        for node in (first, second):
            m[width * node : width * node + width] += heavy[group] * length / 2.0
    if not made.springs:
        turning = np.arange(6 * n) % 6 > 2
        m[turning] *= 1e-3
    free = np.setdiff1d(
        np.arange(width * n), [width * node + c for node in made.held for c in range(width)]
    )
    values, vectors = eigh(k[np.ix_(free, free)], np.diag(m[free]))
    elastic = (
        np.flatnonzero(values > 1e-7 * values[-1])[:count]
        if width == 1
        else np.flatnonzero(values > 1e-6 * np.median(values[: 6 * 3 + 2]))[:count]
    )
    shapes = np.zeros((width * n, elastic.size))
    shapes[free] = vectors[:, elastic]
    moved = shapes.reshape(n, width, -1)[:, : min(width, 3)]
    return np.sqrt(values[elastic]), moved


def chain(count: int) -> Beams:
    nodes = np.zeros((count + 1, 3))
    nodes[:, 0] = np.arange(count + 1)
    return Beams(nodes, tuple((n, n + 1, n) for n in range(count)), (0,), springs=True)


def sticks(parts: list[tuple[tuple[float, ...], tuple[float, ...], int]], held: bool) -> Beams:
    """Straight members (from, to, number of beams), joined where their ends are one place."""
    places: list[tuple[float, ...]] = []
    beams = []

    def node(place: Floats) -> int:
        key = tuple(np.round(place, 6))
        if key not in places:
            places.append(key)
        return places.index(key)

    for group, (start, end, count) in enumerate(parts):
        ends = np.array(start), np.array(end)
        row = [node(ends[0] + (ends[1] - ends[0]) * t / count) for t in range(count + 1)]
        beams += [(one, other, group) for one, other in pairwise(row)]
    return Beams(np.array(places), tuple(beams), (0,) if held else ())


def aircraft() -> Beams:
    return sticks(
        [((0, 0, 0), (0.6, 0, 0), 4), ((0.6, 0, 0), (1.5, 0, 0), 5),
         ((0.6, 0, 0), (0.6, 1, 0), 6), ((0.6, 0, 0), (0.6, -1, 0), 6),
         ((1.5, 0, 0), (1.5, 0, 0.3), 3), ((1.5, 0, 0.3), (1.5, 0.2, 0.3), 2),
         ((1.5, 0, 0.3), (1.5, -0.2, 0.3), 2)],
        False,
    )  # fmt: skip


def portal() -> Beams:
    return sticks(
        [((0, 0, 0), (0, 0, 1), 5), ((0, 0, 1), (0.8, 0.1, 1.1), 5),
         ((0.8, 0.1, 1.1), (0.8, 0.1, 0.3), 4), ((0.4, 0.05, 1.05), (0.4, 0.7, 1.2), 5)],
        True,
    )  # fmt: skip


def grid(across: int, along: int) -> Beams:
    nodes = np.array([(x * 1.0, y * 0.83, 0.0) for y in range(along) for x in range(across)])
    beams = [
        (across * y + x, across * y + x + 1, 4 * y // along)
        for y in range(along)
        for x in range(across - 1)
    ]
    beams += [
        (across * y + x, across * (y + 1) + x, 4 + 4 * x // across)
        for y in range(along - 1)
        for x in range(across)
    ]
    return Beams(nodes / across, tuple(beams))


@dataclass(frozen=True, slots=True)
class Case:
    """A structure with its numbers of sensors and measured modes, and sensor directions."""

    name: str
    made: Callable[[], Beams]
    sensors: int
    axes: tuple[int, ...]
    modes: int


CASES = (
    Case("chain of 6 masses", lambda: chain(6), 6, (0,), 5),
    Case("chain of 12 masses", lambda: chain(12), 12, (0,), 6),
    Case("aircraft of sticks", aircraft, 24, (0, 1, 2), 8),
    Case("aircraft of sticks", aircraft, 60, (0, 1, 2), 10),
    Case("portal frame with boom", portal, 14, (0, 1, 2), 5),
    Case("portal frame with boom", portal, 40, (0, 1, 2), 8),
    Case("plate", lambda: grid(9, 8), 10, (2,), 5),
    Case("plate", lambda: grid(9, 8), 30, (2,), 8),
    Case("plate", lambda: grid(12, 10), 100, (2,), 10),
    Case("plate", lambda: grid(15, 14), 200, (2,), 12),
)


@dataclass(frozen=True, slots=True)
class Twin:
    """Measured shapes (n, m), the computed ones (n, c), which answers, and how alike they are."""

    measured: Floats
    computed: Floats
    pairs: tuple[int, ...]
    macs: Floats
    errors: Floats


def twins(case: Case, error: float, count: int, seed: int) -> Iterator[Twin]:
    """Return tests with models; error: standard deviation of the log stiffness of each part."""
    rng = np.random.default_rng(seed)
    made = case.made()
    for _ in range(count):
        parts = np.exp(rng.normal(0.0, 0.3, (2, made.n_groups)))
        true_hz, true = modes(made, parts[0], parts[1], case.modes)
        changed = parts * np.exp(rng.normal(0.0, error, parts.shape) * [[1.0], [0.3]])
        hz, shapes = modes(made, changed[0], changed[1], case.modes + 3)
        nodes = [n for n in range(len(made.nodes)) if n not in made.held]
        dofs = [(node, axis) for node in nodes for axis in case.axes]
        chosen = rng.choice(len(dofs), case.sensors, replace=False)
        rows = tuple(np.array([dofs[place] for place in chosen]).T)
        measured, computed = true[rows], shapes[rows]
        rms = np.sqrt(np.mean(measured**2, axis=0))
        measured = measured + NOISE * rms * rng.standard_normal(measured.shape)
        table = mac(measured, computed)
        one, other = linear_sum_assignment(-table)
        yield Twin(measured, computed, tuple(other.tolist()), table[one, other],
                   hz[other] / true_hz[one] - 1.0)  # fmt: skip


def named(twin: Twin, measured: Floats) -> list[tuple[int, ...]]:
    """What is found, with the pairs that the pre-check would believe."""
    table = mac(measured, twin.computed)
    one, other = linear_sum_assignment(-table)
    believed = [(a, b) for a, b in zip(one, other, strict=True) if table[a, b] >= BELIEVED]
    if not believed:
        return []
    columns = [a for a, _ in believed]
    spaces = [twin.computed[:, [b]] for _, b in believed]
    return [found.rows for found in sensor_errors(measured[:, columns], spaces, twin.computed)]


def counted(case: Case, error: float, count: int, seed: int) -> dict[str, float]:
    """Shares of tests: false alarms, and reversed and exchanged sensors that are named."""
    rng = np.random.default_rng(seed + 1)
    told = dict.fromkeys(("false", "reversed", "exchanged", "wrong"), 0)
    macs, errors = [], []
    for twin in twins(case, error, count, seed):
        macs.append(twin.macs.mean())
        errors.append(np.abs(twin.errors).mean())
        told["false"] += bool(named(twin, twin.measured))
        motion = np.sqrt(np.mean((twin.measured / np.abs(twin.measured).max(axis=0)) ** 2, axis=1))
        moving = np.flatnonzero(motion > 0.5 * np.median(motion))
        one, other = rng.choice(moving, 2, replace=False).tolist()
        turned = twin.measured.copy()
        turned[one] *= -1.0
        found = named(twin, turned)
        told["reversed"] += (one,) in found
        told["wrong"] += any(rows != (one,) for rows in found)
        crossed = twin.measured.copy()
        crossed[[one, other]] = crossed[[other, one]]
        found = named(twin, crossed)
        told["exchanged"] += tuple(sorted((one, other))) in found
        told["wrong"] += any(rows != tuple(sorted((one, other))) for rows in found)
    shares = {name: 100.0 * value / count for name, value in told.items()}
    return {**shares, "mac": float(np.mean(macs)), "error": 100.0 * float(np.mean(errors))}


def main(count: int) -> None:
    heads = (
        "structure | sensors | model | frequency error, % | MAC | false alarms, % | "
        "reversed named, % | exchanged named, % | others named, %"
    )
    sys.stdout.write(f"| {heads} |\n{'| --- ' * 9}|\n")
    for case in CASES:
        for name, error in (("clean", 0.0), ("erroneous", 0.3)):
            told = counted(case, error, count, 1)
            sys.stdout.write(
                f"| {case.name} | {case.sensors} | {name} | {told['error']:.1f} | "
                f"{told['mac']:.2f} | {told['false']:.1f} | {told['reversed']:.0f} | "
                f"{told['exchanged']:.0f} | {told['wrong'] / 2:.1f} |\n"
            )
            sys.stdout.flush()


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
