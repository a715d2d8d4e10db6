"""The model's own error in the errors of parameters, estimated from what updating leaves.

Measurement noise V says how far parameters move when the test is repeated. A model that cannot
reproduce the test leaves more than noise, and its parameters err by more. With W the weights of the
fit, S the sensitivity and P the prior, the fit follows its data with the leverages

    h_i = w_i s_i^T (S^T W S + P)^-1 s_i,

and a class of responses with variances V expects the sum of squares sum_i (1 - h_i) of its
standardised residuals, less one for each scaled shape. The Birge ratio of the class,

    R^2 = max(1, sum_i r_i^2 / V_i / expected),

multiplies its variances (Birge 1932). A class with fewer than one degree of freedom takes the ratio
of all classes together. The prior is not scaled.

Whether these variances describe the error is checked by leaving out one mode at a time. The other
modes o change the parameters by -(S_o^T W_o S_o + P)^-1 S_g^T W_g r_g, and so predict the rows of
mode g with an error e and a covariance V_g + S_g C S_g^T, in which the ratios of V_g and of the
parameters' covariance C come from the other modes. Combinations of rows from which only the mode
itself determines a parameter are left out: those with an eigenvalue of

    1 - W_g^(1/2) S_g (S^T W S + P)^-1 S_g^T W_g^(1/2)

below LOOSE. Where more than a fifth of the modes miss their own 95 % interval, and more than
chance explains, no standard error describes the parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.linalg import null_space

from modetune.core.modes import Floats, Integers
from modetune.core.updating.parameter_steps import RANK_TOLERANCE
from modetune.core.updating.responses.response import Residual

#: Probability that such an interval contains the test.
INTERVAL = 0.95
#: A prediction beyond it would amplify what is not linear a hundred times.
LOOSE = 0.01


@dataclass(frozen=True, slots=True)
class LinearFit:
    """A linear least-squares fit at its minimum.

    sensitivity: (n_rows, n_free), of what bounds and limits leave free; left: (n_rows,), the
    residual there; variances, weights: (n_rows,), of the measurement and in the fit; known:
    (n_free, n_free), the prior's precision. classes: (n_rows,), class of response of each row;
    groups: (n_rows,), its mode, -1 where it has none; owners: (n_rows,), the scaled item of each
    row, -1 where it has none; modes: names of the groups.
    """

    sensitivity: Floats
    left: Floats
    variances: Floats
    weights: Floats
    known: Floats
    classes: Integers
    groups: Integers
    owners: Integers
    modes: tuple[str, ...]

    def without(self, which: NDArray[np.bool_]) -> LinearFit:
        """Return the fit without these rows, at the same parameters."""
        rows = ("sensitivity", "left", "variances", "weights", "classes", "groups", "owners")
        return replace(self, **{name: getattr(self, name)[~which] for name in rows})

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
    prior: Floats | None = None,
    held: Floats | None = None,
) -> LinearFit:
    """Return the fit at the minimum misfit.

    found: residual before it; rows: (n_rows, n_parameters), sensitivity in independent
    combinations; remaining: (n_parameters,), change to the minimum; weights, prior, held: as of
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
        np.unique(kinds, return_inverse=True)[1],
        np.array([numbers.get(name, -1) for name in modes]),
        found.owners(scaled=True),
        tuple(numbers),
    )


def birge_ratios(fit: LinearFit) -> Floats:
    """Return the ratio R of the class of each row, (n_rows,), at least 1."""
    used = fit.weights > 0.0
    leverages = fit.weights * np.sum(fit.sensitivity @ fit.inverse * fit.sensitivity, axis=1)
    squares, freedom = fit.left**2 / fit.variances, 1.0 - leverages
    classes = [used & (fit.classes == name) for name in np.unique(fit.classes[used])]
    sums = [float(squares[own].sum()) for own in classes]
    expected = [float(freedom[own].sum()) - _n_scaled(fit, own) for own in classes]
    ratios = np.ones(fit.left.size)
    for own, left, degrees in zip(classes, sums, expected, strict=True):
        if degrees < 1.0:
            left, degrees = sum(sums), sum(expected)
        if degrees > 0.0:
            ratios[own] = np.sqrt(max(left / max(degrees - 2.0, 1.0), 1.0))
    return ratios


def missed_modes(fit: LinearFit) -> tuple[tuple[str, ...], int]:
    """Return the names of the modes whose prediction from all others misses its interval, and how
    many modes were predicted: one that alone determines a parameter is not."""
    used, inverse = fit.weights > 0.0, fit.inverse
    missed, n = [], 0
    for mode in np.unique(fit.groups[used & (fit.groups >= 0)]).tolist():
        own = used & (fit.groups == mode)
        rows, weights = fit.sensitivity[own], fit.weights[own]
        root = np.sqrt(weights)
        loose, axes = np.linalg.eigh(
            np.eye(weights.size) - (root[:, None] * rows) @ inverse @ (root[:, None] * rows).T
        )
        axes = axes[:, loose >= LOOSE]
        degrees = axes.shape[1] - _n_scaled(fit, own)
        if degrees <= 0:
            continue
        without = fit.without(own)
        others = without.inverse
        change = -others @ rows.T @ (weights * fit.left[own])
        ratios = birge_ratios(replace(without, left=without.left - without.sensitivity @ change))
        by_class = dict(zip(without.classes.tolist(), ratios.tolist(), strict=True))
        weighted = without.weights[:, None] * without.sensitivity
        noise = weighted.T @ ((without.variances * ratios**2)[:, None] * weighted) + fit.known
        spread = rows @ others
        scale = np.array([by_class.get(name, 1.0) for name in fit.classes[own].tolist()])
        covariance = spread @ noise @ spread.T + np.diag(fit.variances[own] * scale**2)
        error = axes.T @ (root * (fit.left[own] - rows @ change))
        covariance = axes.T @ (root[:, None] * covariance * root) @ axes
        statistic = float(error @ np.linalg.solve(covariance, error))
        n += 1
        if scipy.special.chdtrc(degrees, statistic) < 1.0 - INTERVAL:
            missed.append(fit.modes[mode])
    return tuple(missed), n


def _n_scaled(fit: LinearFit, rows: NDArray[np.bool_]) -> int:
    return int(np.unique(fit.owners[rows & (fit.owners >= 0)]).size)
