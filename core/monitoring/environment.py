"""What temperature, fuel or load make of the parameters, learned over nights.

Over the learning nights the values v_k (p parameters) of the nights k follow the environment x_k:

    v_k = reference + slopes^T (x_k - mean x) + noise,
    cov(noise_k, noise_l) = s^2 rho(k, l) F_k F_l^T,   F_k F_k^T = C_k,

C_k the covariance of repeatability and rho the correlation of nights. Generalised least squares
(Aitken 1935) gives reference and slopes with their covariance; s^2, the scatter compared with the
stated one, comes from the residuals and is never taken below 1.

A quantity that did not change, or that follows from others, has no slope of its own. It is reported
and not fitted. Outside the range that was learned nothing shows that the law is still straight, so
the prediction there is as uncertain as the whole change of the line beyond the range.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modetune.core.brief import brief
from modetune.core.modes import Floats, Integers
from modetune.core.monitoring.series import Series

#: Least share of learning nights in which a quantity must be known, for a slope.
KNOWN = 0.5
#: Least nights per coefficient of the fit.
NIGHTS_EACH = 3
#: A quantity follows from others where less than this part of its variance is its own: its slope
#: has ten times the error that it would have alone.
OWN = 0.01
#: Part of the learned range, beyond its ends, within which a prediction is not called extrapolated:
#: the expected gap beyond the extremes of 20 nights.
BEYOND = 0.1


@dataclass(frozen=True, slots=True, repr=False)
class Environment:
    """The law of the environment.

    parameters: names of the p parameters; names: of the q quantities that have slopes; columns:
    theirs in the series. reference: (p,),
    values at the mean environment (q,). slopes: (q, p), per unit of the quantity; slope_errors:
    (q, p). lowest, highest: (q,), the learned range. covariance: (1 + q, 1 + q, p, p), of reference
    and slopes. scatter: s, the scatter of nights over that of repeatability, at least 1. notes: a
    sentence for each quantity that is not fitted.
    """

    parameters: tuple[str, ...]
    names: tuple[str, ...]
    columns: tuple[int, ...]
    mean: Floats
    lowest: Floats
    highest: Floats
    reference: Floats
    slopes: Floats
    slope_errors: Floats
    covariance: Floats
    scatter: float
    notes: tuple[str, ...]

    __repr__ = brief

    def design(self, environment: Floats) -> Floats:
        """Return 1 and the environment's distance from its mean, (n_runs, 1 + q), zero where
        unknown. environment: (n_runs, n_quantities) of a series."""
        away = environment[:, list(self.columns)] - self.mean
        return np.column_stack([np.ones(len(away)), np.where(np.isfinite(away), away, 0.0)])

    def doubt(self, environment: Floats) -> Floats:
        """Return what unknown and unlearned environments add to the covariance of each run,
        (n_runs, p, p)."""
        values = environment[:, list(self.columns)]
        spread = (self.highest - self.lowest) / np.sqrt(12.0)  # of a uniform distribution
        beyond = np.maximum(values - self.highest, self.lowest - values)
        size = np.where(np.isfinite(values), np.maximum(beyond, 0.0), spread)
        return np.asarray(np.einsum("kq,qi,qj->kij", size**2, self.slopes, self.slopes))

    def predict(self, environment: Floats) -> tuple[Floats, Floats]:
        """Return the expected values of runs (n_runs, p), and their covariance (n_runs, p, p)
        without the scatter of the run itself."""
        design = self.design(environment)
        covariance = np.einsum("ka,abij,kb->kij", design, self.covariance, design)
        values = design @ np.vstack([self.reference, self.slopes])
        return values, covariance + self.doubt(environment)

    def extrapolated(self, environment: Floats) -> tuple[str, ...]:
        """Return a sentence for each quantity of one run (n_quantities,) outside what was
        learned."""
        texts = []
        for place, (name, column) in enumerate(zip(self.names, self.columns, strict=True)):
            value, low, high = environment[column], self.lowest[place], self.highest[place]
            slack = BEYOND * (high - low)
            if not np.isfinite(value):
                texts.append(f"{name} of the last run is unknown; it widens the limits")
            elif not low - slack <= value <= high + slack:
                texts.append(
                    f"{name} {value:.4g} of the last run lies outside the {low:.4g} to {high:.4g} "
                    "that was learned; it widens the limits"
                )
        return tuple(texts)


def choose_quantities(series: Series, rows: Integers) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """Return the columns of the environment that have slopes of their own, and a sentence for each
    of the others. rows: indices of the learning runs."""
    columns: list[int] = []
    notes = []
    taken = np.ones((rows.size, 1))
    there = np.ones(rows.size, dtype=bool)
    for column, name in enumerate(series.quantities):
        values = series.environment[rows, column]
        finite = there & np.isfinite(values)
        known = values[finite]
        if finite.sum() < max(KNOWN * rows.size, NIGHTS_EACH * (len(columns) + 2)):
            notes.append(
                f"{name} is known in {np.isfinite(values).sum()} of {rows.size} learning runs, too "
                "few for a slope"
            )
            continue
        # Equal to a float's rounding, with room for a mean of many.
        if np.ptp(known) <= 1e-9 * np.abs(known).max():
            notes.append(f"{name} did not change while learning; its slope is unknown")
            continue
        others = taken[finite]
        own = known - others @ np.linalg.lstsq(others, known, rcond=None)[0]
        if own @ own < OWN * np.sum((known - known.mean()) ** 2):
            names = ", ".join(series.quantities[other] for other in columns)
            notes.append(f"{name} follows from {names}; only their slopes are fitted")
            continue
        columns.append(column)
        there = finite
        scaled = (values - known.mean()) / known.std()
        taken = np.column_stack([taken, np.where(np.isfinite(scaled), scaled, 0.0)])
    return tuple(columns), tuple(notes)


def fit_environment(
    series: Series, rows: Integers, columns: tuple[int, ...], whitening: Floats
) -> Environment:
    """Fit the law to learning runs. whitening: (n, n), of the correlation of the runs in rows.

    Runs in which one of the quantities is unknown count with the others' noise and the mean
    environment, so that rows should leave them out.
    """
    values = series.values[rows]
    found = series.environment[rows][:, list(columns)]
    n, p, m = rows.size, values.shape[1], 1 + len(columns)
    mean = found.mean(axis=0)
    design = np.column_stack([np.ones(n), found - mean])
    # Units that make the problem's numbers about 1: sizes of the noise, and of the quantities.
    sizes = np.sqrt(np.mean(np.diagonal(series.covariances[rows], axis1=1, axis2=2), axis=0))
    sizes = np.where(sizes > 0.0, sizes, 1.0)
    units = np.concatenate([[1.0], found.std(axis=0)])
    inverses = np.array(
        [_inverse_root(c / np.outer(sizes, sizes)) for c in series.covariances[rows]]
    )
    scaled = np.einsum("kij,kj->ki", inverses, values / sizes)
    blocks = np.einsum("ka,kij->kiaj", design / units, inverses)
    y = np.einsum("kl,li->ki", whitening, scaled).ravel()
    x = np.einsum("kl,liaj->kiaj", whitening, blocks).reshape(n * p, m * p)
    solution, _, rank, _ = np.linalg.lstsq(x, y, rcond=1e-10)
    left = y - x @ solution
    degrees = max(np.count_nonzero(np.abs(x).max(axis=1) > 0.0) - rank, 1)
    scatter = max(1.0, float(np.sqrt(left @ left / degrees)))
    scale = (sizes / units[:, None]).ravel()
    covariance = scatter**2 * np.linalg.pinv(x.T @ x, rcond=1e-10) * np.outer(scale, scale)
    coefficients = (solution * scale).reshape(m, p)
    blocked = covariance.reshape(m, p, m, p).transpose(0, 2, 1, 3)
    errors = np.sqrt(np.diag(covariance)).reshape(m, p)
    return Environment(
        series.names,
        tuple(series.quantities[column] for column in columns),
        columns,
        mean,
        found.min(axis=0, initial=np.inf),
        found.max(axis=0, initial=-np.inf),
        coefficients[0],
        coefficients[1:],
        errors[1:],
        blocked,
        scatter,
        (),
    )


def _inverse_root(covariance: Floats) -> Floats:
    """The symmetric inverse root of a covariance about 1, without the directions that have no
    noise."""
    values, vectors = np.linalg.eigh(covariance)
    there = values > 1e-10 * values[-1]
    roots = np.where(there, 1.0 / np.sqrt(np.where(there, values, 1.0)), 0.0)
    return np.asarray((vectors * roots) @ vectors.T)
