"""The environment's part of the parameters: slopes, their errors, and what has none."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import block_diag

from modetune.core.modes import Floats
from modetune.core.monitoring.environment import Environment, choose_quantities, fit_environment
from modetune.core.monitoring.night_noise import NoiseLaw
from modetune.core.monitoring.series import Series

RNG = np.random.default_rng(0)


def series(environment: Floats, values: Floats, covariances: Floats) -> Series:
    n, p = values.shape
    return Series(
        86400.0 * np.arange(n),
        tuple(f"k_{place}" for place in range(p)),
        values,
        covariances,
        environment,
        ("temperature", "fuel", "load")[: environment.shape[1]],
    )


def fitted(given: Series, whitening: Floats | None = None) -> Environment:
    rows = np.arange(given.times.size)
    columns, _ = choose_quantities(given, rows)
    return fit_environment(
        given, rows, columns, np.eye(rows.size) if whitening is None else whitening
    )


def noisy(n: int, scale: float = 1.0) -> tuple[Floats, Floats, Floats]:
    """Temperature (n, 1), values (n, 2) with slopes -0.001 and -0.004, covariances."""
    temperature = RNG.uniform(0.0, 20.0, (n, 1))
    covariances = np.tile(1e-4 * np.array([[1.0, 0.6], [0.6, 1.0]]), (n, 1, 1))
    noise = RNG.standard_normal((n, 2)) @ np.linalg.cholesky(covariances[0]).T
    return temperature, 1.0 + scale * noise + temperature * [-0.001, -0.004], covariances


def test_white_nights_of_one_covariance_are_ordinary_least_squares() -> None:
    temperature, values, covariances = noisy(40)
    found = fitted(series(temperature, values, covariances))
    away = temperature - temperature.mean()
    # The normal equations of a straight line.
    assert np.allclose(found.slopes, away.T @ values / np.sum(away**2), rtol=1e-9)
    assert np.allclose(found.reference, values.mean(axis=0), rtol=1e-12)
    error = found.scatter * 0.01 / np.sqrt(np.sum(away**2))
    assert np.allclose(found.slope_errors, error, rtol=1e-9)


def test_any_covariances_and_correlation_are_generalised_least_squares() -> None:
    temperature, values, covariances = noisy(12)
    sizes = RNG.uniform(0.5, 2.0, 12)
    covariances = covariances * (sizes**2)[:, None, None]
    law = NoiseLaw(0.7, 1.0, 1.0)
    whitening = law.whitening(np.arange(12.0))
    found = fitted(series(temperature, values, covariances), whitening)
    # The same by one dense covariance of all values.
    roots = [size * _root(1e-4 * np.array([[1.0, 0.6], [0.6, 1.0]])) for size in sizes]
    correlation = 0.7 ** np.abs(np.subtract.outer(np.arange(12), np.arange(12)))
    whole = block_diag(*roots) @ np.kron(correlation, np.eye(2)) @ block_diag(*roots)
    design = np.kron(np.column_stack([np.ones(12), temperature - temperature.mean()]), np.eye(2))
    information = design.T @ np.linalg.solve(whole, design)
    expected = np.linalg.solve(information, design.T @ np.linalg.solve(whole, values.ravel()))
    assert np.allclose(found.reference, expected[:2], rtol=1e-9)
    assert np.allclose(found.slopes[0], expected[2:], rtol=1e-7)
    errors = np.sqrt(np.diag(np.linalg.inv(information)))[2:]
    assert np.allclose(found.slope_errors[0], found.scatter * errors, rtol=1e-7)


def _root(matrix: Floats) -> Floats:
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.sqrt(values)) @ vectors.T)


def test_scatter_beyond_the_stated_one_widens_the_errors_and_less_does_not_narrow_them() -> None:
    wide = fitted(series(*noisy(200, 3.0)))
    # 400 values: 3.5 % of it; three of these.
    assert wide.scatter == pytest.approx(3.0, rel=0.11)
    assert fitted(series(*noisy(200, 0.3))).scatter == 1.0


def test_constant_collinear_and_unknown_quantities_are_reported_and_not_fitted() -> None:
    temperature, values, covariances = noisy(30)
    constant = np.full((30, 1), 7.0)
    copy = 1.8 * temperature + 32.0
    unknown = np.where(np.arange(30)[:, None] < 5, 1.0 + temperature, np.nan)
    for other, text in (
        (constant, "fuel did not change while learning; its slope is unknown"),
        (copy, "fuel follows from temperature; only their slopes are fitted"),
        (unknown, "fuel is known in 5 of 30 learning runs, too few for a slope"),
    ):
        given = series(np.hstack([temperature, other]), values, covariances)
        assert choose_quantities(given, np.arange(30)) == ((0,), (text,))


def test_prediction_covers_new_nights_and_widens_away_from_the_mean() -> None:
    found = fitted(series(*noisy(30)))
    values, covariance = found.predict(np.array([[5.0], [found.mean[0]], [40.0], [np.nan]]))
    errors = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    truth = 1.0 + np.outer([5.0, found.mean[0], 40.0], [-0.001, -0.004])
    assert (np.abs(values[:3] - truth) < 4.0 * errors[:3]).all()
    assert (errors[1] < errors[0]).all()
    # Beyond the range, the whole change of the line beyond it is uncertain.
    beyond = np.abs(found.slopes[0]) * (40.0 - found.highest[0])
    assert (errors[2] > beyond).all()
    # Unknown: the mean, uncertain by the standard deviation of the learned range.
    assert np.allclose(values[3], values[1])
    spread = np.abs(found.slopes[0]) * (found.highest[0] - found.lowest[0]) / np.sqrt(12.0)
    assert (errors[3] >= spread).all()


def test_extrapolation_and_unknown_values_are_reported() -> None:
    found = fitted(series(*noisy(30)))
    assert found.extrapolated(np.array([10.0])) == ()
    (text,) = found.extrapolated(np.array([40.0]))
    assert text.startswith("temperature 40 of the last run lies outside the ")
    assert found.extrapolated(np.array([np.nan])) == (
        "temperature of the last run is unknown; it widens the limits",
    )
