"""The surrogate on functions that are known everywhere."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial import Delaunay
from scipy.stats import qmc

from modetune.core.errors import CampaignError
from modetune.core.modes import Floats
from modetune.flows.studies.sample.checking import missed
from modetune.flows.studies.sample.surrogate import (
    Training,
    _kriged,
    fit_surrogate,
    reduce_responses,
)

LOWER, UPPER = np.array([0.5, 0.5]), np.array([2.0, 1.5])


def spread(n: int, seed: int = 1) -> Floats:
    unit = qmc.LatinHypercube(2, rng=np.random.default_rng(seed)).random(n)
    return np.asarray(LOWER + unit * (UPPER - LOWER))


def quadratic(points: Floats) -> Floats:
    x, y = points.T
    return np.stack([3.0 * x - y + 2.0, 5.0 * x * y - x**2], axis=1)


def waves(points: Floats) -> Floats:
    x, y = points.T
    return np.stack([20.0 * np.sin(4.0 * x) * np.cos(3.0 * y), 20.0 * np.sqrt(x + y * y)], axis=1)


def training(points: Floats, function: Callable[[Floats], Floats]) -> Training:
    return Training(points, function(points), np.array([0, 1]), ("first", "second"))


def test_a_quadratic_function_is_learned_exactly() -> None:
    surrogate = fit_surrogate(training(spread(14), quadratic), LOWER, UPPER)
    points = spread(50, seed=2)
    # misfit: the sum of squares, whatever turned into features
    np.testing.assert_allclose(
        surrogate.misfits(points), (quadratic(points) ** 2).sum(axis=1), rtol=1e-8
    )
    assert surrogate.errors(np.ones(14, dtype=bool)).max() < 1e-9


@pytest.mark.parametrize("n", [15, 25, 40])
def test_the_leave_one_out_error_is_the_error_at_points_never_seen(n: int) -> None:
    surrogate = fit_surrogate(training(spread(n), waves), LOWER, UPPER)
    told = surrogate.errors(np.ones(n, dtype=bool))
    points = spread(400, seed=9)
    among = Delaunay(spread(n)).find_simplex(points) >= 0  # not outside all runs
    truth = missed(surrogate, training(points[among], waves))
    # An estimate from n points; left out at the rim they are extrapolated to, so it errs upwards.
    assert np.all(told > 0.4 * truth)
    assert np.all(told < 10.0 * truth)


def test_leaving_out_in_closed_form_is_leaving_out_and_fitting_anew() -> None:
    rng = np.random.default_rng(4)
    x = np.sort(rng.uniform(-1.0, 1.0, 9))
    covariance = 2.0 * np.exp(-0.5 * ((x[:, None] - x) / 0.4) ** 2) + 1e-6 * np.eye(9)
    terms, y = np.stack([np.ones(9), x], axis=1), np.sin(3.0 * x)
    _, _, left_out = _kriged(covariance, terms, y)
    for place in range(9):
        rest = np.delete(np.arange(9), place)
        trend, pulls, _ = _kriged(covariance[np.ix_(rest, rest)], terms[rest], y[rest])
        foreseen = terms[place] @ trend + covariance[place, rest] @ pulls
        assert y[place] - foreseen == pytest.approx(left_out[place], rel=1e-6, abs=1e-9)


def test_more_runs_make_a_better_surrogate() -> None:
    truth = training(spread(200, seed=9), waves)
    few, many = (
        missed(fit_surrogate(training(spread(n), waves), LOWER, UPPER), truth) for n in (12, 40)
    )
    assert np.all(many < 0.2 * few)


def test_features_of_a_shape_keep_its_misfit_and_are_few() -> None:
    rng = np.random.default_rng(3)
    directions, still = rng.normal(size=(3, 60)), rng.normal(size=60)
    values = rng.normal(size=(20, 3)) @ directions + still
    shapes = Training(spread(20), values, np.zeros(60, dtype=np.int64), ("shape of mode 1",))
    reduction = reduce_responses(shapes)
    assert reduction.basis.shape[1] == 3  # as many as it moves in
    squares = (reduction.features(values) ** 2).sum(axis=1) + reduction.outside
    np.testing.assert_allclose(squares, (values**2).sum(axis=1), rtol=1e-10)


def test_a_shape_that_leaves_the_known_directions_counts_as_missed() -> None:
    rng = np.random.default_rng(3)
    points, direction = spread(12), rng.normal(size=30)
    values = points[:, :1] * direction
    known = Training(points, values, np.zeros(30, dtype=np.int64), ("shape of mode 1",))
    surrogate = fit_surrogate(known, LOWER, UPPER)
    aside = np.linalg.qr(np.stack([direction, rng.normal(size=30)], axis=1))[0][:, 1]
    moved = Training(points, values + 2.0 * aside, known.responses, known.names)
    assert missed(surrogate, known)[0] < 1e-8
    assert missed(surrogate, moved)[0] == pytest.approx(2.0)  # the length of what was added


def test_too_few_runs_are_refused() -> None:
    with pytest.raises(CampaignError, match="4 solver runs are too few to learn 2 parameters"):
        fit_surrogate(training(spread(4), waves), LOWER, UPPER)
