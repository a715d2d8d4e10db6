"""Samples of densities whose moments are known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import truncnorm

from modetune.core.errors import CampaignError
from modetune.core.modes import Floats
from modetune.flows.studies.sample.chains import Chains, check_walkers, sample, split_r_hat
from modetune.flows.studies.sample.density import Posterior, find_peaks
from modetune.flows.studies.sample.surrogate import UNIT, ResponseLimits


def chains_of(posterior: Posterior, steps: int = 3000, walkers: int = 32, seed: int = 3) -> Chains:
    rng = np.random.default_rng(seed)
    return sample(posterior, find_peaks(posterior, rng), walkers, steps, rng)


def test_samples_of_a_linear_problem_have_the_moments_of_the_closed_form(linear: Any) -> None:
    posterior, mean, covariance = linear
    chains = chains_of(posterior)
    assert chains.are_enough
    deviation, size = np.sqrt(np.diag(covariance)), chains.effective_sizes
    # A mean of n independent samples errs by sigma / sqrt(n), a variance by sqrt(2 / n) of itself
    # and a correlation by at most 1 / sqrt(n); four times that is never met by chance.
    assert np.all(np.abs(chains.flat.mean(axis=0) - mean) < 4.0 * deviation / np.sqrt(size))
    variance = chains.flat.var(axis=0)
    np.testing.assert_array_less(np.abs(variance / deviation**2 - 1.0), 4.0 * np.sqrt(2.0 / size))
    correlation = np.corrcoef(chains.flat, rowvar=False)
    wanted = covariance / np.outer(deviation, deviation)
    assert np.abs(correlation - wanted).max() < 4.0 / np.sqrt(size.min())


def test_samples_are_those_of_the_density_whatever_foresees_it(linear: Any) -> None:
    posterior, mean, covariance = linear
    surrogate, deviation = posterior.surrogate, np.sqrt(np.diag(covariance))
    # Foreseen a fifth of a deviation beside in each principal direction and a tenth too wide.
    beside = np.linalg.cholesky(covariance) @ np.full(3, 0.2)
    off = replace(
        surrogate,
        slopes=surrogate.slopes / 1.1,
        offset=(surrogate.offset - surrogate.slopes @ beside) / 1.1,
    )
    foreseen, rng = replace(posterior, surrogate=off), np.random.default_rng(3)
    chains = sample(posterior, find_peaks(posterior, rng), 32, 1000, rng, foreseen=foreseen)
    usual = chains_of(posterior).autocorrelation_times
    assert chains.autocorrelation_times.max() < 0.6 * usual.max()
    # As in the test above: four Monte Carlo errors.
    size = chains.effective_sizes
    assert np.all(np.abs(chains.flat.mean(axis=0) - mean) < 4.0 * deviation / np.sqrt(size))
    variance = chains.flat.var(axis=0)
    np.testing.assert_array_less(np.abs(variance / deviation**2 - 1.0), 4.0 * np.sqrt(2.0 / size))


def test_the_peak_of_a_linear_problem_has_the_closed_form_exactly(linear: Any) -> None:
    posterior, mean, covariance = linear
    peaks = find_peaks(posterior, np.random.default_rng(0))
    assert peaks.n_peaks == 1
    np.testing.assert_allclose(peaks.points[0], mean, atol=1e-7)
    np.testing.assert_allclose(peaks.covariances[0], covariance, rtol=1e-6, atol=1e-12)


def test_the_same_seed_gives_the_same_samples_and_another_one_others(linear: Any) -> None:
    first, again, other = (chains_of(linear[0], 200, seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.samples, again.samples)
    assert not np.array_equal(first.samples[:2], other.samples[:2])


def test_both_of_two_equal_peaks_are_found_and_sampled(two_peaked: Posterior) -> None:
    peaks = find_peaks(two_peaked, np.random.default_rng(1))
    assert peaks.n_peaks == 2
    # (t^2 - 1) / 0.1 is zero at -1 and 1; the prior pulls by 1e-4 of that at most
    np.testing.assert_allclose(np.sort(peaks.points[:, 0]), [-1.0, 1.0], atol=1e-3)
    np.testing.assert_allclose(peaks.shares, 0.5, atol=1e-3)  # by symmetry
    chains = chains_of(two_peaked)
    share = (chains.flat[:, 0] > 0.0).mean()
    assert 0.35 < share < 0.65
    which = peaks.nearest(chains.flat)
    assert np.array_equal(
        chains.flat[which == 0, 0] > 0.0, np.full((which == 0).sum(), peaks.points[0, 0] > 0.0)
    )


def test_no_sample_leaves_the_range(linear: Any) -> None:
    posterior, mean, _ = linear
    # The upper end is put at the mean, so that half of the free posterior is cut away.
    cut = Posterior(
        posterior.surrogate, posterior.prior_mean, posterior.prior_deviation, posterior.lower, mean
    )
    assert (chains_of(cut, 500).flat <= mean).all()


@dataclass(frozen=True)
class Row:
    """One value that is limited, linear in the parameters."""

    slopes: Floats

    def residuals(self, points: Floats) -> Floats:
        return np.asarray(points @ self.slopes[:, None])


@pytest.mark.parametrize("share", [-0.5, 0.4, 2.0])
def test_samples_keep_a_limit_and_are_a_truncated_normal_distribution(
    linear: Any, share: float
) -> None:
    """The limited value s = a t is normal; s >= m + share sigma cuts 31, 66 and 98 % of it away."""
    posterior, mean, covariance = linear
    slopes = np.array([2.0, -1.0, 0.5])
    middle, deviation = float(slopes @ mean), float(np.sqrt(slopes @ covariance @ slopes))
    ends = np.array([[middle + share * deviation, np.inf]]) / UNIT
    row: Any = Row(slopes / UNIT)
    cut = replace(posterior, limits=ResponseLimits(row, ends, ("mass",)))
    peak = find_peaks(cut, np.random.default_rng(0)).points[0]
    # Where the density is greatest: the mean, or the nearest to it that keeps the limit.
    nearest = mean + max(share, 0.0) * covariance @ slopes / deviation
    np.testing.assert_allclose(peak, nearest, atol=1e-4)
    chains = chains_of(cut)
    found = (chains.flat @ slopes - middle) / deviation
    assert found.min() >= share
    expected, size = truncnorm(share, np.inf), chains.effective_sizes.min()
    assert abs(found.mean() - expected.mean()) < 4.0 * expected.std() / np.sqrt(size)
    assert found.std() == pytest.approx(expected.std(), rel=4.0 * np.sqrt(2.0 / size))


def test_a_limit_that_no_set_keeps_is_told_by_name(linear: Any) -> None:
    ends = np.array([[1e4, np.inf]]) / UNIT
    row: Any = Row(np.ones(3) / UNIT)
    cut = replace(linear[0], limits=ResponseLimits(row, ends, ("mass",)))
    with pytest.raises(CampaignError, match=r"keeps all limits \(mass\): widen them"):
        find_peaks(cut, np.random.default_rng(0))


def test_too_few_steps_are_judged_too_short_after_ten_times_as_many(linear: Any) -> None:
    chains = chains_of(linear[0], steps=10)
    assert chains.steps == 100  # ten times: 50 autocorrelation times are more
    assert not chains.are_enough


def test_sampling_goes_on_by_itself_until_the_chains_are_long_enough(linear: Any) -> None:
    chains = chains_of(linear[0], steps=300)
    assert chains.are_enough
    assert 300 < chains.steps <= 3000
    assert chains.samples.shape[0] == chains.steps - chains.burned


@pytest.mark.parametrize("walkers", [4, 7, 10])
def test_too_few_or_an_odd_number_of_walkers_is_refused(walkers: int) -> None:
    with pytest.raises(CampaignError, match="even number of at least 12 for 6 parameters"):
        check_walkers(walkers, 6)


def test_r_hat_is_one_for_independent_samples_and_large_for_walkers_that_stay_apart() -> None:
    rng = np.random.default_rng(2)
    alike = rng.normal(size=(2000, 8, 1))
    # With n independent samples a half chain R-hat - 1 is of order 1 / n.
    assert abs(split_r_hat(alike)[0] - 1.0) < 5e-3
    apart = alike + 3.0 * np.arange(8)[None, :, None]
    # Means 0, 3 .. 21 each twice have the variance 9 * 5.25 * 16 / 15 = 50.4; within it is 1.
    assert split_r_hat(apart)[0] == pytest.approx(np.sqrt(1.0 + 50.4), rel=0.02)


def test_r_hat_sees_a_drift_that_all_walkers_share() -> None:
    rng = np.random.default_rng(2)
    drift = np.linspace(0.0, 10.0, 1000)[:, None, None] + rng.normal(size=(1000, 8, 1))
    assert split_r_hat(drift)[0] > 1.5
