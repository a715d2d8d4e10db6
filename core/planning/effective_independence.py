"""Effective independence: sensors whose readings tell the amplitudes of modes best.

With shapes Phi at the sensors and noise alike everywhere, amplitudes of the modes are estimated
with the Fisher information Q = Phi^T Phi. The diagonal of the projector

    E_D = diag(Phi Q^-1 Phi^T)

is the share of its reading that each sensor adds to the rank of Phi: sum(E_D) = n_modes, and
det(Q without sensor j) = (1 - E_Dj) det Q. Kammer (1991) takes out the sensor with the smallest
until as many are left as are wanted. Where a place carries several directions at once, rows Phi_j
(r, n_modes), the same holds with E_j = 1 - det(I - Phi_j Q^-1 Phi_j^T) (Kammer and Tinker 2004).

Taking a place out changes Q by rank r, so by Woodbury's identity

    Q'^-1 = Q^-1 + Q^-1 Phi_j^T (I - Phi_j Q^-1 Phi_j^T)^-1 Phi_j Q^-1,

which costs O(n) a place instead of a new inverse. Rows may be weighted by the root of their mass;
then Q is near the modal mass and E_D near the share of kinetic energy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modetune.core.errors import ModesError
from modetune.core.modes import Floats, Integers

#: Above so many candidates they go a share at a time: the least of very many differ little.
ONE_BY_ONE = 6000
SHARE = 0.05
#: Updates after which the inverse is computed anew, so that rounding does not add up.
REFRESH = 100
#: Values this near are equal: of the equals of a symmetric structure the last goes first.
EQUAL = 1e-9
#: A place whose loss leaves less than this share of the determinant cannot be spared.
SINGULAR = 1e-10


@dataclass(frozen=True, slots=True)
class Elimination:
    """Candidates that are left, and those that went before.

    kept: (count,), positions, ascending. removed: (n - count,), positions, the first to go first.
    """

    kept: Integers
    removed: Integers


def unit_modes(rows: Floats) -> Floats:
    """The same shapes with each mode of unit length over all candidates; zero stays zero."""
    lengths = np.sqrt(np.sum(rows**2, axis=(0, 1)))
    return np.asarray(rows / np.where(lengths > 0.0, lengths, 1.0))


def independence(rows: Floats) -> Floats:
    """Share of the determinant of the Fisher matrix that is lost without each place, (n,).

    rows: (n, n_directions, n_modes), shapes at each place. Raises ModesError where the shapes are
    not independent at these places. Source: Kammer 1991; Kammer and Tinker 2004.
    """
    rows = unit_modes(rows)  # no result depends on the scale of a mode, but its rounding does
    return _lost(_projector(rows, _inverse(rows)))


def eliminate(rows: Floats, count: int) -> Elimination:
    """Take out the place with the least effective independence until `count` are left.

    rows: (n, n_directions, n_modes). Raises ModesError where the shapes are not independent at all
    places together, or so few cannot keep them so. Source: Kammer 1991.
    """
    rows, left = unit_modes(rows), np.arange(rows.shape[0])
    removed: list[Integers] = []
    while left.size > max(count, ONE_BY_ONE):
        number = min(int(SHARE * left.size) + 1, left.size - max(count, ONE_BY_ONE))
        worst = np.argsort(independence(rows[left]), kind="stable")[:number]
        removed.append(left[worst])
        left = np.delete(left, worst)
    while left.size > count:
        gone = _spared(rows[left], min(REFRESH, left.size - count))
        removed.append(left[gone])
        left = np.delete(left, gone)
    return Elimination(left, np.concatenate([np.zeros(0, np.int64), *removed]))


def _spared(rows: Floats, number: int) -> Integers:
    """The places (number,) that go, one by one."""
    inverse = _inverse(rows)
    inner = _projector(rows, inverse)
    unit, lost = np.eye(rows.shape[1]), _lost(inner)
    gone: list[int] = []
    for _ in range(number):
        lost[gone] = np.inf
        worst = int(np.flatnonzero(lost <= lost.min() + EQUAL)[-1])
        if lost[worst] > 1.0 - SINGULAR:
            raise ModesError(
                f"{rows.shape[0] - len(gone)} sensors are the fewest that keep the modes apart: "
                "without any of them two modes look the same; ask for more sensors"
            )
        gone.append(worst)
        middle = np.linalg.inv(unit - inner[worst])
        seen = rows[worst] @ inverse
        across = rows @ seen.T
        inner = inner + across @ middle @ across.transpose(0, 2, 1)
        inverse = inverse + seen.T @ middle @ seen
        lost = _lost(inner)
    return np.array(gone, dtype=np.int64)


def _lost(inner: Floats) -> Floats:
    if inner.shape[1] == 1:  # a determinant of one number
        return inner[:, 0, 0].copy()
    return np.asarray(1.0 - np.linalg.det(np.eye(inner.shape[1]) - inner))


def _projector(rows: Floats, inverse: Floats) -> Floats:
    """Phi_j Q^-1 Phi_j^T of each place, (n, n_directions, n_directions)."""
    return np.asarray((rows @ inverse) @ rows.transpose(0, 2, 1))


def _inverse(rows: Floats) -> Floats:
    flat = rows.reshape(-1, rows.shape[2])
    sizes = np.linalg.svd(flat, compute_uv=False)
    rank = int(np.sum(sizes > 1e-7 * sizes.max(initial=0.0)))
    if rank < flat.shape[1]:
        raise ModesError(
            f"at these {rows.shape[0]} places and directions the shapes of the {flat.shape[1]} "
            f"modes are those of {rank} independent ones: no choice of them tells the modes apart; "
            "take more candidates, more directions or more sensors, or fewer modes"
        )
    return np.asarray(np.linalg.inv(flat.T @ flat))
