"""Choosing sensors from many candidates, and how well a choice distinguishes modes.

A candidate is a place with one direction, or with three that count as one sensor. Functions take
shapes as rows (n_candidates, n_directions, n_modes); each mode is first brought to unit length over
all candidates, so that none counts more because of its scale. Ways to choose:

* effective independence: sensors whose readings determine the amplitudes of modes best
* auto-MAC: minimise the largest entry off the diagonal (after Carne and Dohrmann 1995)
* kinetic energy: the places that move most, m_j phi_jk^2 summed over modes (Salama, Rose and
  Garba 1987); shows where modes are seen, not whether they can be distinguished
* information: `parameter_information`, for the parameters of an update instead of for the modes

A choice is judged by its auto-MAC, by the condition of its shape matrix, and by the determinant of
its Fisher matrix, relative to that of all candidates.

**Effective independence.** With shapes Phi at the sensors and equal noise everywhere, amplitudes of
the modes are estimated with the Fisher information Q = Phi^T Phi. The diagonal of the projector

    E_D = diag(Phi Q^-1 Phi^T)

is the share of its reading that each sensor adds to the rank of Phi: sum(E_D) = n_modes, and
det(Q without sensor j) = (1 - E_Dj) det Q. Kammer (1991) removes the sensor with the smallest
until the wanted number is left. Where a place has several directions at once, rows Phi_j
(r, n_modes), the same holds with E_j = 1 - det(I - Phi_j Q^-1 Phi_j^T) (Kammer and Tinker 2004).
Removing a place changes Q by rank r, so by Woodbury's identity

    Q'^-1 = Q^-1 + Q^-1 Phi_j^T (I - Phi_j Q^-1 Phi_j^T)^-1 Phi_j Q^-1,

which costs O(n) a place instead of a new inverse. Rows may be weighted by the root of their mass;
then Q is near the modal mass and E_D near the share of kinetic energy.

**Exchange.** Each candidate j brings a matrix C_j, and a choice S is worth
score(C_0 + sum of C_j over S). With C_j = s_j^T s_j of a sensor's sensitivities and the determinant
as score this is D-optimal design; with C_j = phi_j^T phi_j the sum is the Gram matrix from which
the auto-MAC follows. Candidates are added one by one, the best each time. Then each is removed in
turn and replaced by the best of all, until no exchange raises the score (Fedorov 1972; Mitchell
1974). The end is an optimum among all choices that differ in one place, not always the global one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from modetune.core.errors import CampaignError, ModesError
from modetune.core.modes import Floats, Integers

Bools = NDArray[np.bool_]
#: Takes sums (n, k, k) of matrices and gives what each is worth, (n,).
Score = Callable[[Floats], Floats]
#: Rounds of exchange at most; two or three are usual.
ROUNDS = 20
#: A gain below this share of the score is rounding.
LEAST_GAIN = 1e-9
#: Number of candidates above which a share of them is removed at a time: they differ little.
ONE_BY_ONE = 6000
SHARE = 0.05
#: Number of updates after which the inverse is computed again, so that rounding does not add up.
REFRESH = 100
#: Values this near are equal: of the equals of a symmetric structure the last goes first.
EQUAL = 1e-9
#: A place whose loss leaves less than this share of the determinant cannot be spared.
SINGULAR = 1e-10
#: Prior information on modes, relative to that of all candidates: next to nothing.
FAINT = 1e-6
#: Two modes whose auto-MAC is above this look alike to the sensors.
ALIKE = 0.25
#: A candidate that moves less than this share of every mode's largest motion is lost in noise.
QUIET = 0.1


@dataclass(frozen=True, slots=True)
class Spacing:
    """Places of candidates, and how far apart those of different nodes must be.

    nodes: (n,), a node may occur once for each direction; coordinates: (n, 3);
    distance: the deck's length, 0 where anything goes. Directions at one node are never too near.
    """

    nodes: Integers
    coordinates: Floats
    distance: float = 0.0

    def blocked(self, chosen: Sequence[int]) -> Bools:
        """Which candidates (n,) are chosen already, or too near to one that is."""
        taken = np.zeros(self.nodes.size, dtype=np.bool_)
        for place in chosen:
            if self.distance > 0.0:
                apart = np.linalg.norm(self.coordinates - self.coordinates[place], axis=1)
                taken |= (apart < self.distance) & (self.nodes != self.nodes[place])
            taken[place] = True
        return taken

    def thinned(self, worth: Floats) -> Integers:
        """Candidates, ascending, that are far enough apart: the worthiest first, (n_kept,).

        worth: (n,).
        """
        if self.distance <= 0.0:
            return np.arange(self.nodes.size)
        # Rounding must not decide among the equals of a symmetric structure.
        order = np.lexsort((np.arange(worth.size), -np.round(worth, 9)))
        free = np.ones(self.nodes.size, dtype=np.bool_)
        tree, kept = scipy.spatial.KDTree(self.coordinates), []
        for place in order.tolist():
            if free[place]:
                kept.append(place)
                near = np.array(tree.query_ball_point(self.coordinates[place], self.distance))
                apart = np.linalg.norm(self.coordinates[near] - self.coordinates[place], axis=1)
                other = self.nodes[near] != self.nodes[place]
                free[near[other & (apart < self.distance)]] = False
        return np.sort(np.array(kept, dtype=np.int64))


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
    the first choice of candidates, which may be exchanged. Raises CampaignError if this number
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

    A mode without motion at all sensors is like all others: 1.
    """
    lengths = np.diagonal(sums, axis1=1, axis2=2)
    product = lengths[:, :, None] * lengths[:, None, :]
    table = np.divide(sums**2, product, out=np.ones_like(sums), where=product > 0.0)
    k = sums.shape[1]
    table[:, np.arange(k), np.arange(k)] = 0.0
    return np.asarray(np.minimum(table, 1.0))


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


def eliminate(rows: Floats, count: int) -> tuple[Integers, Integers]:
    """Take out the place with the least effective independence until `count` are left.

    rows: (n, n_directions, n_modes). Returns the positions that are left, ascending, and those
    that went, the first to go first. Raises ModesError where the shapes are not independent at all
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
    return left, np.concatenate([np.zeros(0, np.int64), *removed])


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
            f"modes are those of {rank} independent ones: no choice of them separates the modes; "
            "take more candidates, more directions or more sensors, or fewer modes"
        )
    return np.asarray(np.linalg.inv(flat.T @ flat))


@dataclass(frozen=True, slots=True)
class Quality:
    """How well a choice of sensors separates modes.

    auto_mac: (n_modes, n_modes). condition: of the shape matrix, modes of unit length over all
    candidates; infinite where modes are the same. determinant: of the Fisher matrix, relative to
    that of all candidates; efficiency: the same a sensor and mode, 1 is as good as the candidates
    are on the mean, more is better.
    """

    auto_mac: Floats
    condition: float
    determinant: float
    efficiency: float

    @property
    def largest(self) -> float:
        """The largest auto-MAC of two modes; 0 where there is one mode."""
        return float(self._off.max(initial=0.0))

    @property
    def pair(self) -> tuple[int, int]:
        """Positions of the two modes that look most alike."""
        row, column = divmod(int(self._off.argmax()), self.auto_mac.shape[0])
        return min(row, column), max(row, column)

    @property
    def _off(self) -> Floats:
        return np.asarray(self.auto_mac - np.diag(np.diag(self.auto_mac)))


def judge(rows: Floats, chosen: Integers) -> Quality:
    """Return how well the chosen candidates separate modes. rows: (n, n_directions, n_modes)."""
    whole = unit_modes(rows).reshape(-1, rows.shape[2])
    part = unit_modes(rows)[chosen].reshape(-1, rows.shape[2])
    n_modes = whole.shape[1]
    gram = part.T @ part
    table = off_diagonal_mac(gram[None])[0] + np.eye(n_modes)
    sizes = np.linalg.svd(part, compute_uv=False)
    least = float(sizes[-1]) if part.shape[0] >= n_modes else 0.0
    condition = float(sizes[0] / least) if least > 1e-12 * sizes[0] else np.inf
    ratio = log_determinant(gram[None])[0] - log_determinant((whole.T @ whole)[None])[0]
    share = float(np.exp(max(ratio, -700.0))) if np.isfinite(condition) else 0.0
    more = whole.shape[0] / max(part.shape[0], 1)
    return Quality(table, condition, share, float(share ** (1.0 / n_modes) * more))


def loud(rows: Floats) -> Bools:
    """Candidates (n,) that some mode moves by at least QUIET of its largest motion."""
    size = np.linalg.norm(rows, axis=1)
    largest = size.max(axis=0)
    return np.asarray((size >= QUIET * np.where(largest > 0.0, largest, np.inf)).any(axis=1))


def by_effective_independence(rows: Floats, count: int, spacing: Spacing) -> Integers:
    """Positions (count,) of the choice of Kammer 1991, the most useful first.

    Where a distance is asked for, candidates are first thinned to that distance, those of greater
    independence staying. Raises CampaignError, ModesError.
    """
    kept = spacing.thinned(independence(rows)) if spacing.distance > 0.0 else np.arange(len(rows))
    _enough(kept, count, spacing)
    found = kept[eliminate(rows[kept], count)[0]]
    return found[order_of_use(rows[found])]


def by_auto_mac(rows: Floats, count: int, spacing: Spacing) -> Integers:
    """Positions (count,) of a choice of least auto-MAC, the most useful first.

    Exchange ends in the nearest optimum, so it begins at several choices (the fewest sensors of
    effective independence and one by one from there, as many of them as are wanted, none at all)
    and the best end counts. Candidates that hardly move are left out. Raises CampaignError,
    ModesError.
    """
    usable = np.flatnonzero(loud(rows))
    part = unit_modes(rows)[usable]
    near = Spacing(spacing.nodes[usable], spacing.coordinates[usable], spacing.distance)
    least = min(-(-rows.shape[2] // rows.shape[1]), count)
    starts: list[list[int]] = [[]]
    for size in {least if rows.shape[1] == 1 else count, count}:
        starts.append(by_effective_independence(part, size, near).tolist())
    matrices = grams(part)
    base = np.zeros(matrices.shape[1:])
    ends = [choose_best(matrices, base, count, least_auto_mac, near, start) for start in starts]
    worth = least_auto_mac(np.stack([matrices[end].sum(axis=0) for end in ends]))
    found = ends[int(np.argmax(np.round(worth, 10)))]
    return np.asarray(usable[found[order_of_use(part[found])]])


def kinetic_energies(rows: Floats) -> Floats:
    """Share of each mode's kinetic energy at each candidate, (n, n_modes); columns add up to 1.

    rows: (n, n_directions, n_modes), weighted by the root of the mass where masses are known.
    Source: Salama, Rose and Garba 1987.
    """
    return np.asarray(np.sum(unit_modes(rows) ** 2, axis=1))


def by_kinetic_energy(rows: Floats, count: int, spacing: Spacing) -> Integers:
    """Positions (count,) of the candidates with most kinetic energy, the most useful first.

    Raises CampaignError.
    """
    worth = kinetic_energies(rows).sum(axis=1)
    kept = spacing.thinned(worth)
    _enough(kept, count, spacing)
    return np.asarray(kept[np.argsort(-np.round(worth[kept], 12), kind="stable")[:count]])


def parameter_information(sensitivity: Floats) -> Floats:
    """Return each candidate's information on the parameters, (n, n_parameters, n_parameters).

    sensitivity: (n, n_rows, n_parameters), derivatives of what is read there, each divided by
    the reading's standard deviation and multiplied by the parameter's beforehand.
    """
    return np.asarray(sensitivity.transpose(0, 2, 1) @ sensitivity)


def by_information(information: Floats, prior: Floats, count: int, spacing: Spacing) -> Integers:
    """Positions (count,) of a D-optimal choice for the parameters, in the order of choice.

    information: (n, n_parameters, n_parameters); prior: (n_parameters, n_parameters), what is
    known without any shape; not singular. Raises CampaignError. Source: Udwadia 1994.
    """
    return choose_best(information, prior, count, log_determinant, spacing)


def with_modes(information: Floats, prior: Floats, rows: Floats) -> tuple[Floats, Floats]:
    """Information on the parameters and on the amplitudes of all modes together, and without any.

    Shapes inform on parameters only if modes can be separated, which information on parameters
    alone does not require. information: (n, p, p), prior: (p, p), rows: (n, n_directions,
    n_modes). Returns (n, p + n_modes, p + n_modes) and its prior, next to nothing for amplitudes.
    """
    of_modes = grams(unit_modes(rows))
    p, size = prior.shape[0], prior.shape[0] + of_modes.shape[1]
    joint, base = np.zeros((information.shape[0], size, size)), FAINT * np.eye(size)
    joint[:, :p, :p], joint[:, p:, p:], base[:p, :p] = information, of_modes, prior
    return joint, base


def grams(rows: Floats) -> Floats:
    """phi_j^T phi_j of each candidate, (n, n_modes, n_modes)."""
    return np.asarray(rows.transpose(0, 2, 1) @ rows)


def order_of_use(rows: Floats) -> Integers:
    """Positions (n,) such that the first few are as good as few can be: greedily by determinant.

    A small multiple of the unit matrix represents the modes that the first few cannot separate yet.
    """
    matrices = grams(unit_modes(rows))
    return greedy_order(matrices, FAINT * np.eye(matrices.shape[1]))


def greedy_order(matrices: Floats, base: Floats) -> Integers:
    """Positions (n,), at each turn the one that raises the determinant of the sum most."""
    order: list[int] = []
    there = base
    while len(order) < matrices.shape[0]:
        worth = np.round(log_determinant(there + matrices), 9)
        worth[order] = -np.inf
        order.append(int(np.argmax(worth)))
        there = there + matrices[order[-1]]
    return np.array(order, dtype=np.int64)


def needed_sensors(rows: Floats, count: int, limit: float = ALIKE) -> int | None:
    """How many sensors of effective independence, `count` or more, keep all auto-MACs low.

    rows: (n, n_directions, n_modes), far enough apart; limit: largest auto-MAC of two modes. None
    where not even all of them do. Raises ModesError as `eliminate`.
    """
    kept, removed = eliminate(rows, count)
    matrices = grams(unit_modes(rows))
    there = matrices[kept].sum(axis=0)
    for more, place in enumerate([None, *removed[::-1].tolist()]):
        if place is not None:
            there = there + matrices[place]
        if off_diagonal_mac(there[None]).max() <= limit:
            return count + more
    return None


def _enough(kept: Sequence[int] | Integers, count: int, spacing: Spacing) -> None:
    if len(kept) < count:
        if spacing.distance > 0.0:
            raise CampaignError(
                f"taking the best first, {len(kept)} candidates are {spacing.distance:g} apart, "
                f"and {count} sensors are asked for; ask for fewer, or for a smaller distance"
            )
        raise CampaignError(
            f"there are {len(kept)} candidates, and {count} sensors are asked for; ask for fewer"
        )
