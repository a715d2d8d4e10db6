"""The surrogate on functions that are known everywhere."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial import Delaunay
from scipy.stats import qmc

from modetune.core.errors import CampaignError
from modetune.core.modes import Floats
from modetune.flows.studies.sample.surrogate import (
    ORDERS,
    Surrogate,
    Training,
    _fit,
    density_error,
    fit_surrogate,
    scaled,
)

LOWER, UPPER = np.array([0.5, 0.5]), np.array([2.0, 1.5])
#: A point in the middle and others within a two-hundredth of the range around it, as runs stand at
#: a posterior.
NARROW = 0.005


def spread(n: int, seed: int = 1) -> Floats:
    unit = qmc.LatinHypercube(2, rng=np.random.default_rng(seed)).random(n)
    return np.asarray(LOWER + unit * (UPPER - LOWER))


def close(n: int, seed: int = 1) -> Floats:
    return np.asarray(1.0 + NARROW * (spread(n, seed) - 1.0))


def quadratic(points: Floats) -> Floats:
    x, y = points.T
    return np.stack([3.0 * x - y + 2.0, 5.0 * x * y - x**2], axis=1)


def waves(points: Floats) -> Floats:
    x, y = points.T
    return np.stack([20.0 * np.sin(4.0 * x) * np.cos(3.0 * y), 20.0 * np.sqrt(x + y * y)], axis=1)


def training(points: Floats, function: Callable[[Floats], Floats]) -> Training:
    return Training(points, function(points), np.array([0, 1]), ("first", "second"))


def missed(surrogate: Surrogate, truth: Training) -> Floats:
    return truth.sizes(truth.values - surrogate.residuals(truth.points))


def test_a_quadratic_function_is_learned_exactly() -> None:
    surrogate = fit_surrogate(training(spread(14), quadratic), LOWER, UPPER)
    points = spread(50, seed=2)
    # misfit: the sum of squares, whatever turned into features
    np.testing.assert_allclose(
        (surrogate.features(points) ** 2).sum(axis=1),
        (quadratic(points) ** 2).sum(axis=1),
        rtol=1e-8,
    )
    assert np.abs(surrogate.left_out).max() < 1e-9


@pytest.mark.parametrize("n", [15, 25, 40])
def test_the_leave_one_out_error_is_the_error_at_points_never_seen(n: int) -> None:
    known = training(spread(n), waves)
    surrogate = fit_surrogate(known, LOWER, UPPER)
    told = known.sizes(surrogate.left_out)
    points = spread(400, seed=9)
    among = Delaunay(spread(n)).find_simplex(points) >= 0  # not outside all runs
    truth = missed(surrogate, training(points[among], waves))
    # An estimate from n points; left out at the rim they are extrapolated to, so it errs upwards.
    assert np.all(told > 0.4 * truth)
    assert np.all(told < 20.0 * truth)


@pytest.mark.parametrize("order", ORDERS)
def test_leaving_out_in_closed_form_is_leaving_out_and_fitting_anew(order: int) -> None:
    known = training(spread(24), waves)
    inputs = scaled(known.points, LOWER, UPPER)
    _, left_out = _fit(inputs, known.values, order)
    for place in range(0, 24, 5):
        rest = np.delete(np.arange(24), place)
        factors, _ = _fit(inputs[rest], known.values[rest], order)
        none = np.zeros_like(known.values[rest])
        without = Surrogate(LOWER, UPPER, inputs[rest], order, factors, np.eye(2), none)
        error = known.values[place] - without.features(known.points[[place]])[0]
        np.testing.assert_allclose(error, left_out[place], rtol=1e-6, atol=1e-8)


def test_points_close_together_are_as_exact_as_they_are_close() -> None:
    def residual(points: Floats) -> Floats:  # no misfit where the points are close together
        return waves(points) - waves(np.ones((1, 2)))

    truth, falls = training(close(200, seed=9), residual), []
    for seed in range(1, 8):
        far, near = (
            missed(fit_surrogate(training(points, residual), LOWER, UPPER), truth)
            for points in (spread(40, seed), np.vstack([spread(20, seed), close(20, seed)]))
        )
        falls.append(near / far)
    # Half the points lie 200 times as close: what splines miss falls with a power of that above 2.
    # Where orders fit nearly alike the last digits choose one: the median of the draws counts.
    assert np.all(np.median(falls, axis=0) < NARROW**2)


@pytest.mark.parametrize("n", [1, 3, 5])
def test_any_number_of_parameters_has_a_surrogate(n: int) -> None:
    """Eigenvalue-like: a rational function of n stiffnesses, of one too."""
    rng = np.random.default_rng(n)
    points = rng.uniform(0.7, 1.4, (20 * n, n))

    def flexible(at: Floats) -> Floats:
        return np.stack([n / (1.0 / at).sum(axis=1), (at**2).sum(axis=1)], axis=1)

    known = training(points, flexible)
    surrogate = fit_surrogate(known, np.full(n, 0.7), np.full(n, 1.4))
    inside = rng.uniform(0.8, 1.3, (200, n))
    moves = flexible(inside).std(axis=0)
    assert np.all(missed(surrogate, training(inside, flexible)) < 0.02 * moves)


def test_of_a_shape_the_length_of_what_is_missed_counts() -> None:
    rng = np.random.default_rng(3)
    points, directions = spread(20), rng.normal(size=(2, 60))
    shapes = Training(points, points @ directions, np.zeros(60, dtype=int), ("shape of mode 1",))
    surrogate = fit_surrogate(shapes, LOWER, UPPER)
    assert surrogate.basis.shape[1] == 2  # as many directions as it moves in
    assert missed(surrogate, shapes)[0] < 1e-8
    aside = np.linalg.qr(np.vstack([directions, rng.normal(size=60)]).T)[0][:, 2]
    moved = Training(points, shapes.values + 2.0 * aside, shapes.responses, shapes.names)
    assert missed(surrogate, moved)[0] == pytest.approx(2.0)  # the length of what was added


def test_an_offset_of_the_log_density_is_no_error_of_it() -> None:
    values = np.random.default_rng(1).normal(size=(50, 3))
    assert density_error(values, np.zeros_like(values)) == 0.0
    # |w|^2 / 2 grows by e w for small errors e of an entry w
    off = density_error(values, np.array([0.01, 0.0, 0.0]))
    spread_of = np.quantile(np.abs(values[:, 0] - np.median(values[:, 0])), 0.95)
    assert off == pytest.approx(0.01 * spread_of, rel=1e-6)
    alike = np.ones((50, 3))
    assert density_error(alike, 0.01 * alike) == pytest.approx(0.0, abs=1e-15)


def test_too_few_runs_are_refused() -> None:
    with pytest.raises(CampaignError, match="4 solver runs are too few to learn 2 parameters"):
        fit_surrogate(training(spread(4), waves), LOWER, UPPER)


def test_points_that_are_one_are_refused() -> None:
    points = np.tile(spread(1), (8, 1))
    with pytest.raises(CampaignError, match="two training points are all but the same"):
        fit_surrogate(training(points, waves), LOWER, UPPER)
