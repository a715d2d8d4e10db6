"""Choosing few of many so that a score of their sum is best: greedily, then by exchange.

Each candidate j brings a matrix C_j, and a choice S is worth score(C_0 + sum of C_j over S). With
C_j = s_j^T s_j of a sensor's sensitivities and the determinant as score this is D-optimal design;
with C_j = phi_j^T phi_j the sum is the Gram matrix from which the auto-MAC follows. Candidates are
taken one by one, the best at each turn. Then each is taken out in turn and the best of all is put
in its place, until no exchange raises the score (Fedorov 1972; Mitchell 1974). The end is an
optimum among all choices that differ in one place, not always the best of all.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from modetune.core.errors import CampaignError
from modetune.core.modes import Floats, Integers
from modetune.core.planning.spacing import Spacing

#: Takes sums (n, k, k) of matrices and gives what each is worth, (n,).
Score = Callable[[Floats], Floats]
#: Rounds of exchange at most; two or three are usual.
ROUNDS = 20
#: A gain below this share of the score is rounding.
LEAST_GAIN = 1e-9


def choose_best(
    matrices: Floats,
    base: Floats,
    count: int,
    score: Score,
    spacing: Spacing,
    start: Sequence[int] = (),
) -> Integers:
    """Positions (count,) of the chosen candidates, in the order in which they came in.

    matrices: (n, k, k), of the candidates; base: (k, k), what is there without any; start:
    candidates that are in at first, and may be exchanged. Raises CampaignError where so many
    cannot be placed that far apart. Source: Fedorov 1972.
    """
    chosen = list(start)
    while len(chosen) < count:
        worth = _worth(matrices, base, chosen, score, spacing)
        best = int(np.argmax(worth))
        if worth[best] == -np.inf:
            raise CampaignError(
                f"only {len(chosen)} sensors can be placed at least {spacing.distance:g} apart "
                f"by taking the best one by one, and {count} are asked for; ask for fewer, or for "
                "a smaller distance"
            )
        chosen.append(best)
    for _ in range(ROUNDS):
        if not _exchange(matrices, base, chosen, score, spacing):
            break
    return np.array(chosen, dtype=np.int64)


def _exchange(
    matrices: Floats, base: Floats, chosen: list[int], score: Score, spacing: Spacing
) -> bool:
    """One round over all that are chosen; whether any was exchanged."""
    changed = False
    for place in range(len(chosen)):
        others = chosen[:place] + chosen[place + 1 :]
        worth = _worth(matrices, base, others, score, spacing)
        best, present = int(np.argmax(worth)), float(worth[chosen[place]])
        if worth[best] > present + LEAST_GAIN * max(1.0, abs(present)):
            chosen[place] = best
            changed = True
    return changed


def _worth(
    matrices: Floats, base: Floats, chosen: Sequence[int], score: Score, spacing: Spacing
) -> Floats:
    """What the choice is worth with each candidate on top, (n,); -inf where it cannot be."""
    free = np.flatnonzero(~spacing.blocked(chosen))
    worth = np.full(matrices.shape[0], -np.inf)
    if free.size:
        there = base + matrices[list(chosen)].sum(axis=0)
        worth[free] = score(there + matrices[free])
    # Equals of a symmetric structure differ by rounding: the first of them is to be taken.
    return np.round(worth, 10)


def log_determinant(sums: Floats) -> Floats:
    """Score of D-optimal design: the logarithm of the determinant, (n,) of (n, k, k)."""
    sign, value = np.linalg.slogdet(sums)
    return np.asarray(np.where(sign > 0.0, value, -1e300))


def least_auto_mac(sums: Floats) -> Floats:
    """Score that falls with the largest auto-MAC between two modes, (n,) of Gram matrices.

    A small part of the mean square joins it, since several pairs may share the largest value.
    """
    off = off_diagonal_mac(sums)
    return -np.asarray(off.max(axis=(1, 2)) + 1e-3 * off.mean(axis=(1, 2)))


def off_diagonal_mac(sums: Floats) -> Floats:
    """Auto-MAC (n, k, k) of Gram matrices (n, k, k), with zeros on the diagonal.

    A mode that rests at all sensors is like all others: 1.
    """
    lengths = np.diagonal(sums, axis1=1, axis2=2)
    product = lengths[:, :, None] * lengths[:, None, :]
    table = np.divide(sums**2, product, out=np.ones_like(sums), where=product > 0.0)
    k = sums.shape[1]
    table[:, np.arange(k), np.arange(k)] = 0.0
    return np.asarray(np.minimum(table, 1.0))
