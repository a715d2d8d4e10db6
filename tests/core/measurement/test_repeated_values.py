"""Mean and covariance of repeated measurements, some missing, some wrong."""

from __future__ import annotations

import numpy as np
import pytest

from modetune.core.errors import ModesError
from modetune.core.measurement.repeated_tests import scatter_of
from modetune.core.modes import Floats

ROOT = np.array([[1.0, 0.0, 0.0, 0.0], [0.9, 0.3, 0.0, 0.0], [0.2, 0.9, 0.5, 0.0], [1, 0, 1, 1.0]])
MEAN = np.array([3.0, -1.0, 0.0, 100.0])


def drawn(n: int, seed: int) -> Floats:
    return np.asarray(MEAN + np.random.default_rng(seed).standard_normal((n, 4)) @ ROOT.T)


def test_without_gaps_they_are_the_usual_ones() -> None:
    for n in (3, 8, 40):  # of 3 four values are more than the repetitions tell
        x = drawn(n, 2)
        found = scatter_of(x)
        np.testing.assert_allclose(found.mean, x.mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(found.covariance, np.cov(x.T), rtol=1e-9, atol=1e-12)
        assert found.used.all()


def test_with_gaps_the_likelihood_is_greatest() -> None:
    """Two values, the second missing sometimes: the closed form of Anderson (1957)."""
    x = drawn(40, 4)[:, :2]
    x[25:, 1] = np.nan
    found = scatter_of(x)
    whole, n, r = x[:25], 40, 25
    slope = np.cov(whole.T, ddof=0)[0, 1] / np.var(whole[:, 0])
    mean = np.array([x[:, 0].mean(), 0.0])
    mean[1] = whole[:, 1].mean() + slope * (mean[0] - whole[:, 0].mean())
    left = np.var(whole[:, 1]) - slope**2 * np.var(whole[:, 0])
    v = np.var(x[:, 0])
    expected = np.array([[v, slope * v], [slope * v, left + slope**2 * v]]) * n / (n - 1)
    np.testing.assert_allclose(found.mean, mean, rtol=1e-6)
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-6)
    assert r == found.used[:, 1].sum()


def test_good_repetitions_are_hardly_ever_called_wrong() -> None:
    wrong = [not scatter_of(drawn(40, seed)).used.all() for seed in range(60)]
    assert sum(wrong) <= 4  # one in a hundred by definition: more than 4 of 60 once in 2,600 times


def test_wrong_values_are_found_among_gaps_and_move_nothing() -> None:
    found = lost = 0
    errors = []
    for seed in range(30):
        random = np.random.default_rng(seed)
        x = drawn(60, 100 + seed)
        true = x.copy()
        rows, columns = random.choice(60, 5, replace=False), random.integers(0, 4, 5)
        x[rows, columns] += 6.0 * np.sqrt(np.diag(ROOT @ ROOT.T))[columns]
        gaps = random.random(x.shape) < 0.05
        gaps[rows, columns] = False
        x[gaps] = np.nan
        scatter = scatter_of(x)
        lost += int(scatter.used[rows, columns].sum())
        found += int((~scatter.used & ~gaps).sum())
        errors.append(scatter.deviations / true.std(axis=0, ddof=1))
    assert lost == 0  # 6 deviations off, more beside the others
    assert found <= 150 + 4  # of 150, and four more of 1,700 repetitions
    np.testing.assert_allclose(np.median(errors, axis=0), 1.0, atol=0.03)


def test_a_repetition_that_is_wrong_in_all_is_left_out_whole() -> None:
    x = drawn(40, 6)
    x[11] += 30.0 * np.array([1.0, -1.0, 1.0, -1.0])
    assert np.flatnonzero(~scatter_of(x).used.all(axis=1)).tolist() == [11]
    assert not scatter_of(x).used[11].any()


def test_units_mean_nothing() -> None:
    x = drawn(30, 8)
    x[3, 1] += 9.0
    factors = np.array([1e-6, 1.0, 50.0, 1e7])
    one, two = scatter_of(x), scatter_of(factors * x)
    np.testing.assert_array_equal(one.used, two.used)
    np.testing.assert_allclose(two.mean, factors * one.mean)
    np.testing.assert_allclose(two.covariance, np.outer(factors, factors) * one.covariance)


def test_what_does_not_scatter_or_was_measured_once_is_refused() -> None:
    with pytest.raises(ModesError, match="identical"):
        scatter_of(np.ones((4, 2)))
    x = drawn(5, 1)
    x[1:, 2] = np.nan
    with pytest.raises(ModesError, match="column 3 was measured 1 times"):
        scatter_of(x)
