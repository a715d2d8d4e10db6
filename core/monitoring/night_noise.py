"""How the scatter of nights is correlated in time: laws, and what each makes of a change.

The scatter of one night, in units of its size, is taken as a part w that decays as it is carried on
to the next night, and a part 1 - w that every night has for itself (ARMA(1, 1)):

    corr(night k, night l) = w rho^|t_k - t_l|,   k != l,

t counted in nights. rho and w are not known: a grid of them is weighed by the restricted
likelihood of the nights (Harville 1974), and whatever follows is averaged over the grid. So the
bias of a lag correlation from few nights (Kendall 1954, about -(1 + 4 rho) / n where the mean is
estimated too) does not arise, and what 30 nights leave open about rho widens the limits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from modetune.core.modes import Floats, Integers

#: Correlations from one night to the next, and shares of the scatter that have it. The steps are
#: about a quarter of the error of an estimate from 75 nights, so that sums replace integrals.
CORRELATIONS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.75, 0.8, 0.85, 0.9, 0.93, 0.96, 0.98)
SHARES = (1.0, 0.75, 0.5, 0.25)


@dataclass(frozen=True, slots=True)
class NoiseLaw:
    """Correlation from night to night, the share of the scatter that has it, and the prior
    probability of the law."""

    correlation: float
    share: float
    prior: float

    @property
    def lag_correlation(self) -> float:
        """The correlation of two successive nights."""
        return self.correlation * self.share

    def whitening(self, positions: Floats) -> Floats:
        """Return the lower triangular (n, n) that makes the nights' scatter independent."""
        n = positions.size
        if not self.correlation:
            return np.eye(n)
        gaps = np.abs(positions[:, None] - positions)
        matrix = self.share * self.correlation**gaps
        matrix[np.diag_indices(n)] = 1.0
        root = np.linalg.cholesky(matrix)
        return np.asarray(solve_triangular(root, np.eye(n), lower=True))


def noise_laws() -> tuple[NoiseLaw, ...]:
    """Return the grid. Correlations from 0 to 1 and shares are equally likely before the nights."""
    edges = np.concatenate([[0.05], np.diff(CORRELATIONS) / 2.0 + CORRELATIONS[:-1], [1.0]])
    widths = np.diff(edges) / len(SHARES)
    return (
        NoiseLaw(0.0, 1.0, 0.05),
        *(
            NoiseLaw(correlation, share, float(width))
            for correlation, width in zip(CORRELATIONS, widths, strict=True)
            for share in SHARES
        ),
    )


def night_positions(times: Floats) -> Floats:
    """Return the places of runs on the scale of nights, (n,): one step is the median interval.

    Runs that are closer than that, such as two tests of one night, are a step apart: how tests of
    one night resemble each other is not known from nights.
    """
    gaps = np.diff(times)
    if not gaps.size or not gaps.max() > 0.0:
        return np.arange(times.size, dtype=float)
    usual = float(np.median(gaps[gaps > 0.0]))
    return np.concatenate([[0.0], np.cumsum(np.maximum(gaps / usual, 1.0))])


@dataclass(frozen=True, slots=True)
class Contrast:
    """The change over one window before each of N nights, under one law, given the nights so far.

    change: (N, r), in the units of the values. information: (N,), of a change, for noise of size
    1. noise: (N, n), what each whitened night adds to the variance of a change for noise of size 1.
    """

    change: Floats
    information: Floats
    noise: Floats


@dataclass(frozen=True, slots=True)
class Whitened:
    """Nights under one law, whitened: steps (n, n + 1) and ramps (n, n + 1), sums of the whitening
    over the nights before each and over these times their number; values (n, r); design (n, m).
    Up to each of N nights: information (N, m, m) of the design, penalty (N,), half the log
    determinants of law and design, and the residual squares without a change, (N, r, r)."""

    steps: Floats
    ramps: Floats
    values: Floats
    design: Floats
    information: Floats
    penalty: Floats
    squares: Floats


def whiten_nights(
    law: NoiseLaw,
    positions: Floats,
    sizes: Floats,
    values: Floats,
    design: Floats,
    nights: Integers,
) -> Whitened:
    """Return values (n, r) and design (n, m) whitened. sizes: (n,), of the noise of each night."""
    matrix = law.whitening(positions) / sizes
    u, x = matrix @ values, matrix @ design
    gram = np.cumsum(x[:, :, None] * x[:, None, :], axis=0)[nights]
    cross = np.cumsum(x[:, :, None] * u[:, None, :], axis=0)[nights]
    squares = np.cumsum(u[:, :, None] * u[:, None, :], axis=0)[nights]
    squares = squares - cross.transpose(0, 2, 1) @ np.linalg.solve(gram, cross)
    logs = np.cumsum(np.log(np.diag(matrix)))[nights]
    penalty = logs - 0.5 * np.linalg.slogdet(gram)[1]
    steps, ramps = (
        np.pad(np.cumsum(columns, axis=1), ((0, 0), (1, 0)))
        for columns in (matrix, matrix * np.arange(len(matrix)))
    )
    return Whitened(steps, ramps, u, x, gram, penalty, squares)


def fit_changes(whitened: Whitened, starts: Integers, nights: Integers, ramp: bool) -> Contrast:
    """Fit a change together with the design to the nights up to each of N nights.

    starts: (N,), the first night of the change; nights: (N,), the last. ramp: the change grows by
    one unit a night from there, and reaches 1 on the last; else it is a step of 1.
    """
    seen = np.arange(len(whitened.steps))[:, None] <= nights
    d = whitened.steps[:, nights + 1] - whitened.steps[:, starts]
    if ramp:
        grown = whitened.ramps[:, nights + 1] - whitened.ramps[:, starts] - (starts - 1) * d
        d = grown / (nights + 1 - starts)
    d = np.where(seen, d, 0.0)
    along = np.linalg.solve(whitened.information, (whitened.design.T @ d).T[:, :, None])[:, :, 0]
    d = np.where(seen, d - whitened.design @ along.T, 0.0)
    information = np.sum(d**2, axis=0)
    change = (d.T @ whitened.values) / information[:, None]
    return Contrast(change, information, np.asarray(np.square(d).T))
