"""The model's own error in the errors of parameters, estimated from what updating leaves.

Measurement noise V says how far parameters move when the test is repeated. A model that cannot
reproduce the test leaves more than noise, and its parameters err by more. What the model may lack,
or have too much of, is represented at the points where its modes are known: a point mass, a spring
to ground, and a link to the point whose motion differs least. With mass-normalised modes phi, a
point mass m changes a mode by

    d lambda_i = -lambda_i b_ii,    d phi_i = -sum_j lambda_i b_ij / (lambda_i - lambda_j) phi_j,
    b_ij = m phi_i(x)^T phi_j(x),

and a spring by a_ii and a_ij / (lambda_i - lambda_j) likewise, which takes no solver run. Scaled so
that the errors of a kind together change the compared eigenvalues by one in the root mean square,
relative, these are the columns Q, and the residual's errors have the covariance

    C = V + tau^2 Q Q^T.

The size tau follows from the restricted likelihood, which is that of the residual outside the space
of the sensitivities S (Patterson and Thompson 1971), and a half-Cauchy prior of scale SIZE: where
few values are left, the data hardly bound the size, and the prior does. With the weights W of the
fit and a prior P, the parameters' covariance is A^-1 (S^T W C W S + P) A^-1, A = S^T W S + P.

A class of responses without modes (static, damping, FRFs, mass) has no columns. With the leverages
h_i = w_i s_i^T A^-1 s_i its variances are multiplied by the Birge ratio

    R^2 = max(1, sum_i r_i^2 / V_i / sum_i (1 - h_i))                        (Birge 1932).

Whether this covariance describes the error is checked by leaving out one mode at a time. The other
modes o change the parameters by -(S_o^T W_o S_o + P)^-1 S_g^T W_g r_g, and so predict the rows of
mode g, with a size of the model's error from the other modes. Combinations of rows from which only
the mode itself determines a parameter are left out: those with an eigenvalue of

    1 - W_g^(1/2) S_g (S^T W S + P)^-1 S_g^T W_g^(1/2)

below LOOSE. Where more than a fifth of the modes miss their own 95 % interval, and more than
chance explains, or where the size is beyond LARGEST, no standard error describes the parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.linalg import null_space

from modetune.core.modes import Floats, Integers
from modetune.core.updating.parameter_steps import RANK_TOLERANCE
from modetune.core.updating.responses.response import (
    ModelState,
    Residual,
    Response,
    StateDerivatives,
)
from modetune.core.updating.sensitivity import ModeDerivatives

#: Probability that such an interval contains the test.
INTERVAL = 0.95
#: Modes that are predicted from all others: each takes a decomposition of the others' sensitivity.
MOST_PREDICTED = 100
#: A prediction beyond it would amplify what is not linear a hundred times.
LOOSE = 0.01
#: Kinds of response that change with the modes alone.
OF_MODES = ("frequencies", "shapes", "mac")
#: What a model may lack or have too much of, at its points and between them.
KINDS = ("mass", "spring", "link")
#: Relative distance of eigenvalues below which modes mix no more: they do so wholly.
NEAR = 0.02
#: Points that represent the structure at most, and numbers that their columns may have.
POINTS, ENTRIES = 60, 2e7
#: Scale of the prior of the model's error, a relative change of eigenvalues: the noise of a good
#: test (0.2 % of a frequency), so that noise alone is hardly taken for an error of the model.
SIZE = 0.004
#: Size beyond which no standard error is given: a change of eigenvalues by so much is not linear.
LARGEST = 0.3
#: Sizes of the model's error over which the likelihood is averaged, relative.
SIZES = np.concatenate([[0.0], np.geomspace(1e-5, 0.5, 60)])


def model_error_columns(state: ModelState, responses: Sequence[Response]) -> Floats:
    """Return what unit errors of the model change of its responses, (n_residuals, n_errors).

    Rows of responses that do not follow from modes alone are zero. Without a normalisation to mass
    each shape counts with a root mean square of one.
    """
    modes, compared = state.seen, state.pairing.computed
    shapes = np.real(modes.mode_shapes)
    errors = _errors(state, _points(state))
    if not any(item.kind in OF_MODES and item.kind != "frequencies" for item in responses):
        shapes = shapes[:0]  # frequencies alone do not change with them
    slopes = np.zeros((compared.size, len(errors)))
    changes = np.zeros((shapes.shape[0], compared.size, len(errors)))
    for place, (slope, mixture) in enumerate(errors):
        slopes[:, place] = slope * modes.eigenvalues[compared]
        changes[:, :, place] = shapes @ mixture
    derivatives = StateDerivatives(ModeDerivatives(slopes, changes), ())
    return np.concatenate(
        [
            item.sensitivity(state, derivatives)
            if item.kind in OF_MODES
            else np.zeros((item.residual(state).values.size, len(errors)))
            for item in responses
        ]
    )


def _points(state: ModelState) -> list[Integers]:
    """Return the rows of translations (rotations where there are none) at each point."""
    modes = state.seen
    moves = modes.components <= 3
    rows = np.flatnonzero(moves if moves.any() else np.ones_like(moves))
    points = np.unique(modes.nodes[rows])
    entries = max(modes.n_dof * state.pairing.computed.size, 1)
    most = int(np.clip(ENTRIES / (len(KINDS) * entries), 1, POINTS))
    places = np.unique(np.linspace(0, points.size - 1, most).astype(np.int64))
    return [rows[modes.nodes[rows] == point] for point in points[places].tolist()]


def _errors(state: ModelState, points: Sequence[Integers]) -> list[tuple[Floats, Floats]]:
    """Return what each error changes: relative slopes of the compared eigenvalues (n_pairs,), and
    shapes as mixtures of all modes (n_modes, n_pairs)."""
    modes, compared = state.seen, state.pairing.computed
    shapes, own = np.real(modes.mode_shapes), np.arange(compared.size)
    if modes.normalisation != "mass":
        size = np.sqrt(np.mean(shapes**2, axis=0))
        shapes = shapes / np.where(size > 0.0, size, 1.0)
    lam = np.maximum(modes.eigenvalues, np.finfo(np.float64).tiny)
    gap = lam[compared] - lam[:, None]
    inverse = np.where(gap < 0.0, -1.0, 1.0) / np.maximum(np.abs(gap), NEAR * lam[compared])
    inverse[compared, own] = 0.0
    motions = [shapes[rows] for rows in points]
    links = _links(motions, [modes.components[rows] for rows in points], lam)
    errors = []
    for kind, parts in zip(KINDS, (motions, motions, links), strict=True):
        factor = -lam[compared] if kind == "mass" else np.ones(compared.size)
        found = []
        for part in parts:
            acting = factor * (part.T @ part[:, compared])
            found.append((acting[compared, own] / lam[compared], acting * inverse))
        total = np.sum([slope**2 for slope, _ in found], axis=0)
        scale = float(np.sqrt(np.mean(total)))
        if scale > 0.0:
            errors += [(slope / scale, mixture / scale) for slope, mixture in found]
    return errors


def _links(motions: Sequence[Floats], components: Sequence[Integers], lam: Floats) -> list[Floats]:
    """Return the motion between each point and the one whose motion differs least from its own.

    motions: (n_components, n_modes) of each point; only points with equal components are linked.
    lam: (n_modes,), eigenvalues: low modes count more, as they move more.
    """
    alike: dict[tuple[int, ...], list[Floats]] = {}
    for motion, own in zip(motions, components, strict=True):
        alike.setdefault(tuple(own.tolist()), []).append(motion)
    links = []
    for group in alike.values():
        if len(group) > 1:
            flat = np.array([(motion / np.sqrt(lam)).ravel() for motion in group])
            distances = scipy.spatial.distance.cdist(flat, flat)
            np.fill_diagonal(distances, np.inf)
            nearest = distances.argmin(axis=1).tolist()
            pairs = {(min(pair), max(pair)) for pair in enumerate(nearest)}
            links += [group[one] - group[other] for one, other in sorted(pairs)]
    return links


#: Fields of a fit that have an entry a row.
OF_ROWS = (
    "sensitivity", "left", "variances", "weights", "errors", "classes", "groups", "owners",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class LinearFit:
    """A linear least-squares fit at its minimum.

    sensitivity: (n_rows, n_free), of what bounds and limits leave free; left: (n_rows,), the
    residual there; variances, weights: (n_rows,), of the measurement and in the fit; known:
    (n_free, n_free), the prior's precision. errors: (n_rows, n_errors), what unit errors of the
    model change. classes: (n_rows,), class of response of each row; groups: (n_rows,), its mode, -1
    where it has none; owners: (n_rows,), the scaled item of each row, -1 where it has none; modes:
    names of the groups.
    """

    sensitivity: Floats
    left: Floats
    variances: Floats
    weights: Floats
    known: Floats
    errors: Floats
    classes: Integers
    groups: Integers
    owners: Integers
    modes: tuple[str, ...]

    def without(self, which: NDArray[np.bool_]) -> LinearFit:
        """Return the fit without these rows, at the same parameters."""
        return replace(self, **{name: getattr(self, name)[~which] for name in OF_ROWS})

    @property
    def inverse(self) -> Floats:
        """Pseudo-inverse of the information S^T W S + P, (n_free, n_free)."""
        weighted = self.weights[:, None] * self.sensitivity
        values, vectors = np.linalg.eigh(self.sensitivity.T @ weighted + self.known)
        used = values > RANK_TOLERANCE * max(float(values.max(initial=0.0)), 0.0)
        return np.asarray((vectors[:, used] / values[used]) @ vectors[:, used].T)


def linear_fit(
    found: Residual,
    rows: Floats,
    remaining: Floats,
    weights: Floats,
    errors: Floats,
    prior: Floats | None = None,
    held: Floats | None = None,
) -> LinearFit:
    """Return the fit at the minimum misfit.

    found: residual before it; rows: (n_rows, n_parameters), sensitivity in independent
    combinations; remaining: (n_parameters,), change to the minimum; errors: (n_rows, n_errors),
    as of `model_error_columns`, in independent combinations; weights, prior, held: as of
    `parameter_covariance`.
    """
    n = rows.shape[1]
    free = np.eye(n)
    if held is not None and held.size:
        free = null_space(held / np.linalg.norm(held, axis=1)[:, None])
    known = np.zeros((n, n)) if prior is None else np.diag(prior) if prior.ndim == 1 else prior
    kinds = np.repeat(
        [block.kind for block in found.blocks], [block.size for block in found.blocks]
    )
    modes = [label.partition(" of ")[2] for label in found.labels]
    numbers = {name: place for place, name in enumerate(dict.fromkeys(filter(None, modes)))}
    return LinearFit(
        rows @ free,
        found.independent(found.values) - rows @ remaining,
        found.variances,
        weights,
        free.T @ known @ free,
        errors,
        np.unique(kinds, return_inverse=True)[1],
        np.array([numbers.get(name, -1) for name in modes]),
        found.owners(scaled=True),
        tuple(numbers),
    )


def with_model_error(fit: LinearFit) -> tuple[LinearFit, float]:
    """Return the fit with its model's error, and the size tau of that.

    Columns are multiplied by tau, and in classes without columns variances by the Birge ratio.
    """
    used = fit.weights > 0.0
    alone = ~np.isin(fit.classes, np.unique(fit.classes[fit.errors.any(axis=1)]))
    ratios = np.ones(fit.left.size)
    if (alone & used).any():
        leverages = fit.weights * np.sum(fit.sensitivity @ fit.inverse * fit.sensitivity, axis=1)
        squares, freedom = fit.left**2 / fit.variances, 1.0 - leverages
        for name in np.unique(fit.classes[alone & used]).tolist():
            own = used & (fit.classes == name)
            left, degrees = float(squares[own].sum()), float(freedom[own].sum())
            degrees -= _n_scaled(fit, own)
            if degrees < 1.0:
                left = float(squares[used].sum())
                degrees = float(freedom[used].sum()) - _n_scaled(fit, used)
            if degrees > 0.0:
                ratios[own] = max(left / max(degrees - 2.0, 1.0), 1.0)
    fit = replace(fit, variances=ratios * fit.variances)
    size = _error_size(fit)
    return replace(fit, errors=size * fit.errors), size


def _error_size(fit: LinearFit) -> float:
    """Return the size of the model's error, the median by its likelihood and prior; 0 without
    columns."""
    used = (fit.weights > 0.0) & fit.errors.any(axis=1)
    if not used.any():
        return 0.0
    root = 1.0 / np.sqrt(fit.variances[used])
    rows, left, columns = (
        (root * item[used].T).T for item in (fit.sensitivity, fit.left, fit.errors)
    )
    # A direction counts as determined by the test where it outweighs the prior.
    scale = np.linalg.cholesky(fit.known) if fit.known.any() else None
    if scale is not None:
        rows = scipy.linalg.solve_triangular(scale, rows.T, lower=True).T
    basis = _span(rows, None if scale is None else 1.0)
    left, columns = left - basis @ (basis.T @ left), columns - basis @ (basis.T @ columns)
    axes, lengths, _ = np.linalg.svd(columns, full_matrices=False)
    along = (axes.T @ left) ** 2
    grown = 1.0 + np.outer(SIZES**2, lengths**2)
    misfit = np.sum(np.log(grown) + along / grown, axis=1)
    likelihood = np.exp(-0.5 * (misfit - misfit.min())) / (1.0 + (SIZES / SIZE) ** 2)
    below = np.cumsum(likelihood * np.gradient(SIZES))
    return float(np.interp(0.5 * below[-1], below, SIZES))


def _span(rows: Floats, least: float | None) -> Floats:
    """Return an orthonormal basis of the range of a matrix, (n_rows, rank).

    Directions count whose singular value is beyond `least`, by default beyond rounding. Where a
    triangular factor shows that all are, it takes a fifth of the time of singular values.
    """
    n_rows, n = rows.shape
    if n_rows >= n > 0:
        basis, triangle = np.linalg.qr(rows)
        share, _ = scipy.linalg.lapack.dtrcon(triangle)
        smallest = share * np.abs(triangle).sum(axis=0).max() / np.sqrt(n)
        # The share is an estimate, seldom three times too large.
        size = float(np.linalg.norm(triangle))
        if smallest > 10.0 * (RANK_TOLERANCE * size if least is None else least):
            return np.asarray(basis)
    basis, singular, _ = np.linalg.svd(rows, full_matrices=False)
    if least is None:
        least = RANK_TOLERANCE * float(singular.max(initial=0.0))
    return np.asarray(basis[:, singular > least])


def missed_modes(fit: LinearFit) -> tuple[tuple[str, ...], int]:
    """Return the names of the modes whose prediction from all others misses its interval, and how
    many modes were predicted: one that alone determines a parameter is not, and at most
    MOST_PREDICTED are.

    fit: without the size of the model's error, which the other modes give.
    """
    used, inverse = fit.weights > 0.0, fit.inverse
    inverse_root = _root(inverse)
    missed, n = [], 0
    modes = np.unique(fit.groups[used & (fit.groups >= 0)])
    if modes.size > MOST_PREDICTED:
        modes = modes[np.linspace(0, modes.size - 1, MOST_PREDICTED).round().astype(np.int64)]
    for mode in modes.tolist():
        own = used & (fit.groups == mode)
        rows, weights = fit.sensitivity[own], fit.weights[own]
        root = np.sqrt(weights)[:, None]
        axes, lengths, across = np.linalg.svd(root * (rows @ inverse_root), full_matrices=False)
        others_share = 1.0 - lengths**2
        tight = axes[:, others_share < LOOSE]
        degrees = weights.size - tight.shape[1] - _n_scaled(fit, own)
        if degrees <= 0:
            continue
        without = fit.without(own)
        if tight.size:
            others = without.inverse
        else:  # the inverse without these rows, by Woodbury's formula
            turned = inverse_root @ across.T
            others = inverse + (turned * (lengths**2 / others_share)) @ turned.T
        change = -others @ rows.T @ (weights * fit.left[own])
        without = replace(without, left=without.left - without.sensitivity @ change)
        known, size = with_model_error(without)
        weighted = without.weights[:, None] * without.sensitivity
        spread = rows @ others
        moved = size * (fit.errors[own] - spread @ (weighted.T @ without.errors))
        ratios = known.variances / without.variances
        by_class = dict(zip(without.classes.tolist(), ratios.tolist(), strict=True))
        scale = np.array([by_class.get(name, 1.0) for name in fit.classes[own].tolist()])
        deviations = np.sqrt(scale * fit.variances[own])
        statistic = _squares(
            (fit.left[own] - rows @ change) / deviations,
            np.hstack([_scatter(spread, weighted, known), moved]) / deviations[:, None],
            tight / (root * deviations[:, None]),
        )
        n += 1
        if scipy.special.chdtrc(degrees, statistic) < 1.0 - INTERVAL:
            missed.append(fit.modes[mode])
    return tuple(missed), n


def _scatter(spread: Floats, weighted: Floats, fit: LinearFit) -> Floats:
    """Return L with L L^T the covariance of predictions by the noise of what predicts them.

    spread: (n, n_free), what parameters change of them, by the others' inverse information;
    weighted: (n_rows, n_free), the others' sensitivity by their weights; fit: of the others.
    L: (n, n) or (n, n_free), the smaller.
    """
    if len(spread) >= len(fit.known):
        return spread @ _root(weighted.T @ (fit.variances[:, None] * weighted) + fit.known)
    moved = spread @ weighted.T
    return _root((moved * fit.variances) @ moved.T + spread @ fit.known @ spread.T)


def _root(matrix: Floats) -> Floats:
    """Return F with F F^T equal to a positive semidefinite matrix, both (n, n)."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _squares(error: Floats, columns: Floats, excluded: Floats) -> float:
    """Return the error's squared size by its covariance, outside the excluded directions.

    error: (n,), of covariance I + L L^T with the columns L (n, m); excluded: (n, k). No matrix is
    as large as (n, n).
    """
    basis = np.linalg.qr(excluded)[0]
    error = error - basis @ (basis.T @ error)
    columns = columns - basis @ (basis.T @ columns)
    axes, lengths, _ = np.linalg.svd(columns, full_matrices=False)
    return float(error @ error - np.sum((axes.T @ error) ** 2 * lengths**2 / (1.0 + lengths**2)))


def effective_number(fit: LinearFit, rows: Integers) -> float:
    """Return how many independent values of equal variance these rows count as.

    By the eigenvalues of their covariance C it is tr(C)^2 / tr(C^2). rows: (n,); fit: with the size
    of the model's error.
    """
    variances, columns = fit.variances[rows], fit.errors[rows]
    lengths = np.sum(columns**2, axis=1)
    trace = float(np.sum(variances + lengths))
    inner = columns.T @ columns
    square = float(np.sum(variances**2 + 2.0 * variances * lengths) + np.sum(inner**2))
    return trace**2 / square if square > 0.0 else 0.0


def _n_scaled(fit: LinearFit, rows: NDArray[np.bool_]) -> int:
    return int(np.unique(fit.owners[rows & (fit.owners >= 0)]).size)
