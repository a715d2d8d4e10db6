"""Which of many possible sensors are worth having, and how well a choice tells modes apart.

A candidate is a place with one direction, or with three that count as one sensor. All functions
take shapes as rows (n_candidates, n_directions, n_modes); each mode is first brought to unit
length over all candidates, so that none counts more because of its scale. Ways to choose:

* effective independence: module `effective_independence`
* auto-MAC: the largest entry off the diagonal as small as may be (after Carne and Dohrmann 1995)
* kinetic energy: the places that move most, m_j phi_jk^2 summed over modes (Salama, Rose and
  Garba 1987); shows where modes are seen, not whether they are told apart
* information: `parameter_information`, for the parameters of an update instead of for the modes

A choice is judged by its auto-MAC, by the condition of its shape matrix, and by the determinant of
its Fisher matrix, relative to that of all candidates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modetune.core.errors import CampaignError
from modetune.core.modes import Floats, Integers
from modetune.core.planning.effective_independence import eliminate, independence, unit_modes
from modetune.core.planning.exchange import (
    choose_best,
    least_auto_mac,
    log_determinant,
    off_diagonal_mac,
)
from modetune.core.planning.spacing import Bools, Spacing

#: What is known of modes before any sensor, beside what all candidates tell: next to nothing.
FAINT = 1e-6
#: Two modes whose auto-MAC is above this look alike to the sensors.
ALIKE = 0.25
#: A candidate that moves less than this share of every mode's largest motion is lost in noise.
QUIET = 0.1


@dataclass(frozen=True, slots=True)
class Quality:
    """How well a choice of sensors tells modes apart.

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
    """How well the chosen candidates tell the modes apart. rows: (n, n_directions, n_modes)."""
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
    found = kept[eliminate(rows[kept], count).kept]
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
    """What each candidate tells of the parameters, (n, n_parameters, n_parameters).

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

    Shapes tell of parameters only where modes can be told apart, which information on parameters
    alone does not ask for. information: (n, p, p), prior: (p, p), rows: (n, n_directions,
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

    A little of the unit matrix stands in for the modes that the first few cannot tell yet.
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
    went = eliminate(rows, count)
    matrices = grams(unit_modes(rows))
    there = matrices[went.kept].sum(axis=0)
    for more, place in enumerate([None, *went.removed[::-1].tolist()]):
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
