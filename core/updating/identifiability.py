"""Which parameters a test can determine, regardless of their updated values.

Everything follows from the weighted, prior-scaled sensitivity

    A = W^(1/2) S D,    D = diag(deviations),

whose entry is how many standard deviations of a measurement one standard deviation of a parameter
moves it. With its singular values s_i and right singular vectors v_i the test knows the
combination v_i of the parameters to 1 / s_i of what was known beforehand. So s_i = 1 is where test
and prior know as much: combinations below it are called unseen.

Shares. The answer that weighs the test against the prior (factor a on the parameters' weights P =
a D^-2, thesis (52)) moves from the prior towards the values that the test alone would give by

    R = (S^T W S + P)^-1 S^T W S = D V diag(s_i^2 / (s_i^2 + a)) V^T D^-1,

the resolution matrix (Menke 2018, ch. 4; Tarantola 2005, 3.3). Its diagonal is the share of each
parameter's answer that comes from the test: 1 is the test alone, 0 the prior alone, and of two
parameters with the same effect each has half. Its trace is the number of parameters that the test
determines.

Collinearity (Brun, Reichert and Kuensch 2001). With the columns of A brought to length one, the
index of a subset K is 1 / sqrt(smallest eigenvalue of A_K^T A_K): how much of a change of one
parameter the others of K can cancel. It ignores measurement accuracy, so it shows how strongly a
small error of the model moves the answer. 1 is orthogonal; authors draw the line at 5 to 20.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy import linalg

from modetune.core.errors import CampaignError
from modetune.core.modes import Floats, Integers
from modetune.core.updating.parameter_steps import RANK_TOLERANCE

#: A combination of which the test determines less than this share is unseen.
SEEN = 0.5
#: A parameter belongs to a combination where its part is at least this share of the largest.
MEMBER = 0.3
#: Smallest eigenvalue of a matrix of cosines that is more than rounding.
ROUNDING = 1e-14
#: Distance below which a parameter is on its bound.
STUCK = 1e-9
#: Number of parameters up to which subsets of three are examined (161,700); pairs always are.
MOST_FOR_TRIPLES = 100
#: Subsets that are kept, those with the largest index.
KEPT = 50


@dataclass(frozen=True, slots=True)
class Collinearity:
    """Collinearity indices; parameters that move nothing are in no subset.

    members: (n_kept, 3), positions of the subsets with the largest indices, -1 in place of the
    third of a pair; indices: (n_kept,), falling, infinite where one column is made of the others;
    whole: the index of all parameters together.
    """

    members: Integers
    indices: Floats
    whole: float

    def above(self, threshold: float) -> tuple[tuple[tuple[int, ...], float], ...]:
        """Subsets whose index reaches a threshold, without those that hold a smaller one."""
        found = [
            (tuple(place for place in row if place >= 0), index)
            for row, index in zip(self.members.tolist(), self.indices.tolist(), strict=True)
            if index >= threshold
        ]
        pairs = [set(subset) for subset, _ in found if len(subset) == 2]
        return tuple(
            (subset, index)
            for subset, index in found
            if len(subset) == 2 or not any(pair < set(subset) for pair in pairs)
        )


@dataclass(frozen=True, slots=True)
class UnseenCombination:
    """A change of one or several parameters to which the measured values are insensitive.

    members: positions, the one with the largest part first; changes: (n_members,), of each
    relative to its own value, the first being 1; seen: standard deviations by which the
    measurements move if the combination moves by one standard deviation.
    """

    members: tuple[int, ...]
    changes: Floats
    seen: float


@dataclass(frozen=True, slots=True)
class Identifiability:
    """How far the test determines the parameters.

    singular_values: (n_parameters,), falling, of A; vectors: (n_parameters, n_parameters), its
    right singular vectors as columns; resolution: (n_parameters, n_parameters), R.
    """

    singular_values: Floats
    vectors: Floats
    resolution: Floats
    collinearity: Collinearity
    unseen: tuple[UnseenCombination, ...]

    @property
    def condition(self) -> float:
        """Largest over smallest singular value."""
        first, last = self.singular_values[0], self.singular_values[-1]
        return float(first / last) if last > RANK_TOLERANCE * first else float("inf")

    @property
    def test_shares(self) -> Floats:
        """Share of each parameter's answer that comes from the test, (n_parameters,)."""
        return np.asarray(np.clip(np.diag(self.resolution), 0.0, 1.0))

    @property
    def moves(self) -> Floats:
        """Standard deviations of the test by which one deviation of each parameter moves the
        measured values, all together, (n_parameters,): the lengths of the columns of A."""
        return np.asarray(np.linalg.norm(self.vectors * self.singular_values, axis=1))

    @property
    def n_told(self) -> float:
        """The number of parameters that the test determines: the trace of the resolution."""
        return float(np.trace(self.resolution))


def scaled_sensitivity(sensitivity: Floats, weights: Floats, deviations: Floats) -> Floats:
    """A = W^(1/2) S D, without the rows that weigh nothing. Raises CampaignError.

    sensitivity: (n_residuals, n_parameters); weights: (n_residuals,); deviations: (n_parameters,).
    """
    if weights.shape != sensitivity.shape[:1] or deviations.shape != sensitivity.shape[1:]:
        raise CampaignError(
            f"a sensitivity of shape {sensitivity.shape} needs as many weights as rows and as many "
            f"deviations as columns, not {weights.shape} and {deviations.shape}"
        )
    used = weights > 0.0
    scaled = np.sqrt(weights[used])[:, None] * sensitivity[used] * deviations
    if not np.isfinite(scaled).all():
        raise CampaignError("sensitivity, weights and deviations must be finite")
    return np.asarray(scaled)


def identifiability(
    sensitivity: Floats,
    weights: Floats,
    deviations: Floats,
    values: Floats,
    factor: float = 1.0,
    precision: Floats | None = None,
    apart: Sequence[int] = (),
) -> Identifiability:
    """Return how far measurements determine parameters. Raises CampaignError.

    sensitivity: (n_residuals, n_parameters); weights: (n_residuals,), emphasis over variance;
    deviations, values: (n_parameters,), standard deviations of the prior and present values;
    factor: a, on the parameters' weights; precision: (n_parameters, n_parameters), these
    where they are not D^-2; apart: zones of fields, of which thousands of combinations are unseen,
    so that none is looked for.
    """
    scaled = scaled_sensitivity(sensitivity, weights, deviations)
    n = deviations.size
    _, found, rows = np.linalg.svd(np.vstack([scaled, np.zeros((n, n))]), full_matrices=False)
    vectors = rows.T
    squares = found**2
    nothing = found <= RANK_TOLERANCE * max(float(found[0]), 1e-300)
    told = np.where(nothing, 0.0, squares / np.where(nothing, 1.0, squares + factor))
    resolution = deviations[:, None] * ((vectors * told) @ vectors.T) / deviations
    if precision is not None:
        information = sensitivity.T @ (weights[:, None] * sensitivity)
        resolution = np.linalg.solve(information + factor * precision, information)
    plain = scaled.copy()
    plain[:, list(apart)] = 0.0
    return Identifiability(
        singular_values=found,
        vectors=vectors,
        resolution=resolution,
        collinearity=collinearity(plain),
        unseen=()
        if len(apart)
        else _unseen(scaled, vectors[:, told < SEEN], deviations / np.abs(values)),
    )


def remaining_step(
    sensitivity: Floats,
    residual: Floats,
    weights: Floats,
    deviations: Floats,
    lower: Floats,
    upper: Floats,
) -> Floats:
    """Return the linear change from the present parameters to the minimum misfit, (n_parameters,).

    residual: (n_residuals,), measured minus computed, at the parameters' values; lower, upper:
    (n_parameters,), bounds of the change; all else as for `identifiability`. Combinations that the
    test cannot see stay where they are, and so do parameters that a bound holds.
    """
    scaled = scaled_sensitivity(sensitivity, weights, deviations)
    target = np.sqrt(weights[weights > 0.0]) * residual[weights > 0.0]
    free = np.ones(deviations.size, dtype=np.bool_)
    while True:
        left, values, right = np.linalg.svd(scaled[:, free], full_matrices=False)
        known = values**2 / (values**2 + 1.0) >= SEEN
        step = np.zeros(deviations.size)
        step[free] = deviations[free] * (right[known].T @ (left.T[known] @ target / values[known]))
        stuck = free & ((step < 0.0) & (lower >= -STUCK) | (step > 0.0) & (upper <= STUCK))
        if not stuck.any():
            return np.asarray(np.clip(step, np.minimum(lower, 0.0), np.maximum(upper, 0.0)))
        free &= ~stuck


def _unseen(scaled: Floats, space: Floats, relative: Floats) -> tuple[UnseenCombination, ...]:
    """The space of what is unseen as combinations of few parameters each.

    space: (n_parameters, n_unseen), orthonormal; relative: deviations over values. Singular
    vectors of like singular values are mixed at will, so a basis is taken in which each of as
    many parameters as there are combinations occurs in one alone.
    """
    n_unseen = space.shape[1]
    if n_unseen == 0:
        return ()
    _, order = linalg.qr(space.T, mode="r", pivoting=True)
    basis = np.linalg.solve(space[order[:n_unseen]].T, space.T)
    found = []
    for row in basis:
        unit = row / np.linalg.norm(row)
        least = MEMBER * np.abs(unit).max()
        members = [
            int(place)
            for place in np.argsort(-np.abs(unit), kind="stable")
            if abs(unit[place]) >= least
        ]
        changes = (unit * relative)[members]
        seen = float(np.linalg.norm(scaled @ unit))
        found.append(UnseenCombination(tuple(members), changes / changes[0], seen))
    return tuple(found)


def collinearity(scaled: Floats) -> Collinearity:
    """Collinearity indices of all pairs, all subsets of three, and the whole.

    scaled: (n_residuals, n_parameters). Source: Brun, Reichert and Kuensch 2001, (6).
    """
    lengths = np.linalg.norm(scaled, axis=0)
    moving = np.flatnonzero(lengths > RANK_TOLERANCE * lengths.max(initial=0.0))
    units = scaled[:, moving] / lengths[moving]
    cosines = units.T @ units
    sizes = (2, 3) if moving.size <= MOST_FOR_TRIPLES else (2,)
    rows, found = [np.zeros((0, 3), dtype=np.int64)], [np.zeros(0)]
    for size in sizes:
        subsets = np.array(list(combinations(range(moving.size), size)), dtype=np.int64)
        if subsets.size:
            blocks = cosines[subsets[:, :, None], subsets[:, None, :]]
            found.append(_indices(np.linalg.eigvalsh(blocks)[:, 0]))
            names = np.full((len(subsets), 3), -1, dtype=np.int64)
            names[:, :size] = moving[subsets]
            rows.append(names)
    members, indices = np.concatenate(rows), np.concatenate(found)
    worst = np.argsort(-indices, kind="stable")[:KEPT]
    whole = _indices(np.linalg.eigvalsh(cosines)[:1])[0] if moving.size else 1.0
    return Collinearity(members[worst], indices[worst], float(whole))


def _indices(smallest: Floats) -> Floats:
    seen = smallest > ROUNDING
    return np.where(seen, 1.0 / np.sqrt(np.where(seen, smallest, 1.0)), np.inf)
