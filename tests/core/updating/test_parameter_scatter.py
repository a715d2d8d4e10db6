"""Means and covariances of parameters behind repeated tests, against closed forms and twins."""

from __future__ import annotations

import numpy as np
import pytest

from modetune.core.errors import CampaignError
from modetune.core.modes import Floats
from modetune.core.updating.parameter_scatter import (
    Beforehand,
    TestScatter,
    draw_scatter,
    lack_of_fit,
    match_scatter,
    noise_outside,
    normal_draws,
)

SLOPES = np.array([[1.0, 0.2, 0.0], [0.3, 1.5, -0.4], [0.0, 0.5, 0.8], [0.6, 0.6, 0.6]])
OFFSET = np.array([0.1, -0.2, 0.0, 0.3])
SIZES = np.array([0.04, 0.06, 0.05])
TRUTH = np.outer(SIZES, SIZES) * np.array([[1.0, 0.5, 0.0], [0.5, 1.0, -0.3], [0.0, -0.3, 1.0]])
MEAN = np.array([1.0, 1.1, 0.9])
REACH = np.full(3, 1e-3)


def linear(sets: Floats) -> Floats:
    return np.asarray(sets @ SLOPES.T + OFFSET)


def chain(sets: Floats) -> Floats:
    """Logarithms of the frequencies (n, 3) of three unit masses on springs (n, 3) from the wall."""
    stiffness = np.zeros((len(sets), 3, 3))
    for k in range(3):
        stiffness[:, k, k] += sets[:, k]
        if k:
            stiffness[:, k - 1, k - 1] += sets[:, k]
            stiffness[:, k, k - 1] -= sets[:, k]
            stiffness[:, k - 1, k] -= sets[:, k]
    return np.asarray(0.5 * np.log(np.linalg.eigvalsh(stiffness)))


def beforehand(n: int = 3, deviation: float = 1.0) -> Beforehand:
    return Beforehand(np.ones(n), np.full(n, deviation), np.arange(n))


def measured_by(values: Floats, noise: float = 0.0) -> TestScatter:
    covariance = np.cov(values.T)
    own = noise**2 * np.eye(len(covariance))
    return TestScatter(values, values.mean(axis=0), covariance, own, len(values))


@pytest.mark.parametrize("draws", [None, normal_draws(128, 3, 1)], ids=["perturbation", "sampling"])
def test_a_linear_model_has_a_closed_form(draws: Floats | None) -> None:
    noise = 0.01**2 * np.eye(4)
    measured = SLOPES @ TRUTH @ SLOPES.T + noise
    tests = TestScatter(np.zeros((2, 4)), linear(MEAN[None])[0], measured, noise, 500.0)
    found = match_scatter(tests, linear, REACH, beforehand(deviation=1e3), np.ones(3), draws)
    # The measured moments are those of the true parameters exactly, and draws are standardised.
    np.testing.assert_allclose(found.mean, MEAN, rtol=1e-6)
    np.testing.assert_allclose(found.covariance, TRUTH, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(found.predicted_covariance + noise, measured, rtol=1e-6, atol=1e-9)
    assert found.rounds
    assert found.cut < 1e-9


def test_what_was_known_before_pulls_the_mean_as_bayes_says() -> None:
    measured = SLOPES @ TRUTH @ SLOPES.T + 0.01**2 * np.eye(4)
    tests = TestScatter(np.zeros((2, 4)), linear(MEAN[None])[0], measured, 0 * measured, 3.0)
    before = beforehand(deviation=0.05)
    found = match_scatter(tests, linear, REACH, before, np.ones(3))
    information = 3.0 * SLOPES.T @ np.linalg.solve(measured, SLOPES)
    whole = information + np.eye(3) / 0.05**2
    expected = np.linalg.solve(whole, information @ MEAN + np.ones(3) / 0.05**2)
    np.testing.assert_allclose(found.mean, expected, rtol=1e-6)


def test_a_chain_of_springs_tells_its_covariance_in_five_hundred_tests() -> None:
    random = np.random.default_rng(0)
    sets = random.multivariate_normal(MEAN, TRUTH, 500)
    tests = measured_by(chain(sets))
    sampled = match_scatter(tests, chain, REACH, beforehand(), np.ones(3), normal_draws(128, 3, 1))
    bent = match_scatter(tests, chain, REACH, beforehand(), np.ones(3))
    for found, least in ((sampled, 0.02), (bent, 0.03)):
        # 500 sets tell deviations to 1 / sqrt(1000), 3 %; asked are 10 % of the truth.
        sizes = np.sqrt(np.diag(found.covariance))
        np.testing.assert_allclose(sizes, SIZES, rtol=0.1)
        np.testing.assert_allclose(found.covariance, TRUTH, atol=0.1 * np.outer(SIZES, SIZES).max())
        # Beside what these sets really have: second order of 5 % in a parameter.
        np.testing.assert_allclose(sizes, sets.std(axis=0, ddof=1), rtol=least)
    # Only sampling knows that the mean of logarithms is below the logarithm of the mean.
    off = [np.abs(found.mean - sets.mean(axis=0)).max() for found in (sampled, bent)]
    assert off[0] < 2e-4
    assert off[1] > 10 * off[0]


def test_intervals_cover_what_they_say() -> None:
    inside: list[Floats] = []
    draws = normal_draws(64, 3, 1)
    for seed in range(30):
        random = np.random.default_rng([7, seed])
        tests = measured_by(chain(random.multivariate_normal(MEAN, TRUTH, 500)))
        found = match_scatter(tests, chain, REACH, beforehand(), np.ones(3), draws)
        means, covariances, _ = draw_scatter(tests, found, beforehand(), random, 240)
        sizes = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
        for values, true in ((means, MEAN), (sizes, SIZES)):
            low, high = np.quantile(values, [0.025, 0.975], axis=0)
            inside.append((low <= true) & (true <= high))
    assert 0.90 <= np.mean(inside) <= 0.99  # of 180 intervals of 95 %


def test_one_parameter_has_the_posterior_of_a_closed_form() -> None:
    """sigma^-(n - 1) exp(-(n - 1) s^2 / (2 sigma^2)) times the half-t density of the prior."""
    n, s = 12, 0.3
    values = s * np.random.default_rng(2).standard_normal((n, 1))
    values = (values - values.mean()) * s / values.std(ddof=1)
    tests = TestScatter(values, np.zeros(1), np.array([[s**2]]), np.zeros((1, 1)), n)
    before = Beforehand(np.zeros(1), np.array([5.0]), np.arange(1))
    found = match_scatter(tests, lambda sets: sets, np.array([1e-3]), before, np.zeros(1))
    _, covariances, _ = draw_scatter(tests, found, before, np.random.default_rng(1), 4000)
    sigma = np.linspace(0.01, 3.0, 30_000)
    log = -(n - 1) * np.log(sigma) - (n - 1) * s**2 / (2 * sigma**2)
    log -= 1.5 * np.log1p((sigma / 5.0) ** 2 / 2.0)  # half-t of 2 degrees of freedom
    weight = np.cumsum(np.exp(log - log.max()))
    expected = np.interp([0.025, 0.5, 0.975], weight / weight[-1], sigma)
    got = np.quantile(np.sqrt(covariances[:, 0, 0]), [0.025, 0.5, 0.975])
    # 3,000 hardly correlated draws: quantiles at the ends to 2 %, three times that.
    np.testing.assert_allclose(got, expected, rtol=0.06)


def test_gaps_and_the_measurements_own_scatter_are_told_apart() -> None:
    random = np.random.default_rng(4)
    free = Beforehand(np.ones(3), np.ones(3), np.array([0, 2]))  # the second is alike in all tests
    sets = np.tile(MEAN, (500, 1))
    sets[:, [0, 2]] = random.multivariate_normal(MEAN[[0, 2]], TRUTH[np.ix_([0, 2], [0, 2])], 500)
    values = linear(sets) + 0.01 * random.standard_normal((500, 4))
    values[random.random(values.shape) < 0.1] = np.nan
    whole = values[np.isfinite(values).all(axis=1)]
    tests = TestScatter(values, np.nanmean(values, axis=0), np.cov(whole.T), np.zeros((4, 4)), 500)
    found = match_scatter(tests, linear, REACH, free, np.ones(3))
    noise = noise_outside(tests, found, free.free)
    assert np.sqrt(noise) == pytest.approx(0.01, rel=0.1)
    tests = TestScatter(values, tests.mean, tests.covariance, noise * np.eye(4), 500)
    found = match_scatter(tests, linear, REACH, free, np.ones(3))
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), SIZES[[0, 2]], rtol=0.1)
    means, _, variances = draw_scatter(tests, found, free, random, 600, noise_told=False)
    low, high = np.sqrt(np.quantile(variances, [0.005, 0.995]))
    assert low < 0.01 < high < 1.2 * low
    ends = np.quantile(means, [0.005, 0.995], axis=0)
    assert ((ends[0] < MEAN) & (MEAN < ends[1])).all()


def test_scatter_that_the_parameters_cannot_make_is_unlikely() -> None:
    random = np.random.default_rng(6)
    likely: list[float] = []
    unlikely: list[float] = []
    for _ in range(100):
        right = linear(random.multivariate_normal(MEAN, TRUTH, 200))
        right += 0.01 * random.standard_normal((200, 4))
        wrong = right + 0.02 * random.standard_normal((200, 1)) * [1.0, 0.0, 0.0, 0.0]
        for values, told in ((right, likely), (wrong, unlikely)):
            tests = measured_by(values, 0.01)
            found = match_scatter(tests, linear, REACH, beforehand(), np.ones(3))
            told.append(lack_of_fit(tests, found, 6))
    # A probability is spread evenly: below 0.1 10 of 100 times, more than 20 once in 1,000.
    assert np.sum(np.array(likely) < 0.1) <= 20
    assert np.median(unlikely) < 1e-4


def test_negative_variances_are_none_and_told() -> None:
    measured = SLOPES @ TRUTH @ SLOPES.T + 1e-6 * np.eye(4)
    tests = TestScatter(np.zeros((2, 4)), OFFSET, measured, 0.05**2 * np.eye(4), 50.0)
    found = match_scatter(tests, linear, REACH, beforehand(), np.ones(3))
    assert found.cut > 0.05
    assert np.linalg.eigvalsh(found.covariance).min() >= -1e-15


def test_more_parameters_than_values_are_refused() -> None:
    tests = measured_by(np.random.default_rng(1).standard_normal((20, 4)))
    before = beforehand(5)
    with pytest.raises(CampaignError, match="4 measured values do not determine"):
        match_scatter(tests, lambda sets: sets[:, :4], np.full(5, 1e-3), before, np.ones(5))
    twins = Beforehand(np.ones(2), np.ones(2), np.arange(2))
    with pytest.raises(CampaignError, match="do not determine"):
        match_scatter(
            tests,
            lambda sets: np.tile(sets.sum(axis=1)[:, None], (1, 4)),
            np.full(2, 1e-3),
            twins,
            np.ones(2),
        )


def test_draws_have_exactly_the_moments_of_a_normal_distribution() -> None:
    draws = normal_draws(128, 4, 3)
    np.testing.assert_allclose(draws.mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(draws.T @ draws / 128, np.eye(4), atol=1e-12)
