"""Where to excite and where to hang a structure, from its computed shapes.

The residue of the driving-point mobility of a mode of unit modal mass is phi_d^2 at an exciter d:
a mode is seen as far as it moves there. Modes must be seen all at once, so exciters are chosen for
the mode that is driven worst: with p_kd = |phi_kd| / max_d |phi_kd|, the share of a mode's largest
motion, a set of exciters is worth min over modes of max over its exciters of p (after the optimum
driving points of Imamovic 1998; the best of several exciters counts, as each is used by itself).

A free structure is best held where its elastic modes move least: nodes of least
max_k |u_k| / max |u_k| over the modes.
"""

from __future__ import annotations

from itertools import combinations
from math import comb

import numpy as np

from modetune.core.modes import Floats, Integers
from modetune.core.planning.sensor_placement import Spacing

#: Sets of exciters up to this number are all looked at.
EXHAUSTIVE = 20_000
#: The mean over all modes decides among sets that drive the worst mode alike.
MEAN_WEIGHT = 1e-3


def participation(shapes: Floats) -> Floats:
    """Share of each mode's largest motion, (n, n_modes) in [0, 1].

    shapes: (n, n_modes), at the candidates; a mode without motion there has shares of zero.
    """
    largest = np.abs(shapes).max(axis=0)
    return np.asarray(np.abs(shapes) / np.where(largest > 0.0, largest, 1.0))


def choose_exciters(shapes: Floats, count: int) -> Integers:
    """Positions (count,) of the exciters that drive the worst driven mode best.

    shapes: (n, n_modes); count: at most n. All sets are compared where they are few; else the best
    is taken one by one, and each is exchanged until nothing gains.
    """
    shares = participation(shapes)
    if comb(shares.shape[0], count) <= EXHAUSTIVE:
        sets = np.array(list(combinations(range(shares.shape[0]), count)))
        best = sets[int(np.argmax(_worth(shares[sets].max(axis=1))))]
        return np.asarray(best[np.argsort(-_worth(shares[best]), kind="stable")])
    chosen: list[int] = []
    for place in [*range(count), *(list(range(count)) * 10)]:
        others = chosen[:place] + chosen[place + 1 :]
        there = shares[others].max(axis=0, initial=0.0)
        worth = _worth(np.maximum(shares, there))
        worth[others] = -1.0
        best_one = int(np.argmax(worth))
        if place == len(chosen):
            chosen.append(best_one)
        elif worth[best_one] > worth[chosen[place]] + 1e-9:
            chosen[place] = best_one
    return np.array(chosen, dtype=np.int64)


def _worth(shares: Floats) -> Floats:
    """Worth (n,) of sets that give the modes these shares (n, n_modes)."""
    return np.asarray(np.round(shares.min(axis=1) + MEAN_WEIGHT * shares.mean(axis=1), 10))


def rigid_mass(rigid: Floats) -> Floats:
    """The mass that a force feels as long as the structure moves as a rigid body, (n,).

    rigid: (n, n_rigid), mass-normalised rigid modes along the candidates' directions. Of a mass m
    pushed through its centre it is m; infinite where no rigid mode moves.
    """
    squared = np.sum(rigid**2, axis=1)
    return np.asarray(
        np.divide(1.0, squared, out=np.full(squared.size, np.inf), where=squared > 0.0)
    )


def choose_suspension(motion: Floats, count: int, spacing: Spacing) -> tuple[Integers, Floats]:
    """Nodes where the modes move least, and the largest share of a mode's motion at each.

    motion: (n, n_modes), length of the displacement at each node; spacing: of these nodes.
    Returns up to `count` positions, the quietest first, and their shares.
    """
    worst = np.round(participation(motion).max(axis=1), 10)
    chosen: list[int] = []
    while len(chosen) < count:
        free = np.flatnonzero(~spacing.blocked(chosen))
        if free.size == 0:
            break
        chosen.append(int(free[np.argmin(worst[free])]))
    places = np.array(chosen, dtype=np.int64)
    return places, worst[places]
