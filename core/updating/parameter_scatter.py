"""The scatter of parameters behind the scatter of repeated tests: stochastic model updating.

Test k of n measures y_k = f(theta_k) + e_k: the structure itself differs from test to test,
theta_k ~ N(mu, Sigma), and what is measured errs besides, e_k ~ N(0, R). Mean y and covariance C of
the tests are to be those of the model,

    E f(theta) = y,      Cov f(theta) + R = C.

With S = df/dtheta at mu and T = (S^T C^-1 S)^-1 S^T C^-1, repeated until nothing moves,

    mu    <- mu + (n S^T C^-1 S + P)^-1 (n S^T C^-1 (y - E f) + P (mu_0 - mu)),
    Sigma <- Sigma + T (C - R - Cov f) T^T,

P the reciprocal variances of what was known before. Moments of the model are by perturbation, f(mu)
and S Sigma S^T, where one step from Sigma = 0 gives the answer, T (C - R) T^T (Khodaparast,
Mottershead and Friswell 2008, eq. 20, correlations of parameters with measurements left out; Govers
and Link 2010, eqs. 12-17), or by sampling f, which knows how it bends. What becomes negative in
Sigma is taken as none. Parameters that are the same in all tests have a mean alone.

How sure that is. With f linear around mu, the conditional distributions are all known, and are
drawn in turn (Gibbs):

    mu | Sigma, R           normal, of all tests, with V = S Sigma S^T + R
    theta_k | mu, Sigma, R  normal, of test k's values that are there
    Sigma | theta           inverse Wishart, n + 1 + p degrees of freedom,
                            sum (theta_k - mu)(theta_k - mu)^T + 4 diag(1 / a)
    1 / a_i | Sigma         gamma, (2 + p) / 2 and 2 (Sigma^-1)_ii + 1 / A_i^2
    R | theta               one variance for all values, inverse gamma, where it is not given

The two last but one are the prior of Huang and Wand (2013): deviations half-t of 2 degrees of
freedom and scale A_i, correlations uniform; with n tests the answer hardly depends on it. The
tests determine R only if there are more values than parameters that scatter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.stats import chi2, invwishart, norm, qmc

from modetune.core.errors import CampaignError
from modetune.core.modes import Floats, Integers

#: Rounds, and the change of deviations, relative, that ends them.
ROUNDS, SAME = 30, 1e-4
#: Variance of an exact measurement, relative to that of the measured values.
EXACT = 1e-6
#: Share of the largest singular value of S below which the tests do not determine a direction.
RANK = 1e-6

Model = Callable[[Floats], Floats]


@dataclass(frozen=True, slots=True)
class TestScatter:
    """What n repeated tests measured.

    values: (n_tests, m), NaN where missing; mean: (m,), covariance: (m, m), of one test; noise:
    (m, m), the part of it that is the measurement's own. n: independent tests that they are worth.
    """

    __test__ = False

    values: Floats
    mean: Floats
    covariance: Floats
    noise: Floats
    n: float


@dataclass(frozen=True, slots=True)
class Beforehand:
    """What is known of parameters before: mean, deviation (n_parameters,); free: positions of those
    that differ from test to test, all others being the same in all."""

    mean: Floats
    deviation: Floats
    free: Integers


@dataclass(frozen=True, slots=True)
class ParameterScatter:
    """Mean (n_parameters,) of the parameters, covariance (n_free, n_free) of those that scatter.

    slopes: (m, n_parameters), df/dtheta there; predicted: (m,) and predicted_covariance (m, m), of
    the model, without the measurement's own. cut: how much of the covariance had to be left out as
    negative, in its trace; rounds: until nothing moved, 0 where that was not reached.
    """

    mean: Floats
    covariance: Floats
    slopes: Floats
    predicted: Floats
    predicted_covariance: Floats
    cut: float
    rounds: int


def normal_draws(count: int, n: int, seed: int) -> Floats:
    """Draws (count, n) of independent standard normal variables with exactly their mean and
    covariance, spread evenly (Sobol)."""
    unit = qmc.Sobol(n, seed=seed).random(count)
    draws = norm.ppf(np.clip(unit, 1e-9, 1.0 - 1e-9))
    draws -= draws.mean(axis=0)
    root = np.linalg.cholesky(np.atleast_2d(draws.T @ draws / count))
    return np.asarray(np.linalg.solve(root, draws.T).T)


def match_scatter(
    tests: TestScatter,
    model: Model,
    reach: Floats,
    before: Beforehand,
    start: Floats,
    draws: Floats | None = None,
) -> ParameterScatter:
    """Mean and covariance of parameters with which the model scatters as the tests do.

    model: values (n, m) at sets (n, n_parameters); reach: (n_parameters,), of differences for its
    slopes; start: (n_parameters,); draws: (count, n_free), by which the model is sampled, by
    perturbation without. Raises CampaignError if the tests cannot determine so many parameters.
    """
    mu, free = start.copy(), before.free
    sigma = np.zeros((free.size, free.size))
    weights = np.asarray(cho_solve(cho_factor(tests.covariance), np.eye(len(tests.covariance))))
    prior = np.diag(before.deviation**-2)
    rounds, cut, last = 0, 0.0, np.zeros(free.size)
    for count in range(1, ROUNDS + 1):
        slopes = slopes_of(model, mu, reach)
        own = slopes[:, free]
        to_values = np.linalg.cholesky(tests.covariance)
        seen = np.linalg.svd(
            np.linalg.solve(to_values, own * before.deviation[free]), compute_uv=False
        )
        if free.size > own.shape[0] or seen[-1] < RANK * seen[0]:
            raise CampaignError(
                f"{own.shape[0]} measured values do not determine the covariance of {free.size} "
                "parameters that differ from test to test"
            )
        mean, covariance = _moments(model, mu, sigma, own, free, draws)
        transfer = np.linalg.solve(own.T @ weights @ own, own.T @ weights)
        sigma, cut = _not_negative(
            sigma + transfer @ (tests.covariance - tests.noise - covariance) @ transfer.T
        )
        pull = tests.n * slopes.T @ weights @ (tests.mean - mean) + prior @ (before.mean - mu)
        step = np.linalg.solve(tests.n * slopes.T @ weights @ slopes + prior, pull)
        mu = mu + step
        sizes = np.sqrt(np.diag(sigma))
        unit = np.maximum(sizes, SAME * before.deviation[free])
        moved = max(np.abs(sizes - last).max() / unit.max(), np.abs(step / before.deviation).max())
        last = sizes
        if moved < SAME and count > 1:
            rounds = count
            break
    slopes = slopes_of(model, mu, reach)
    mean, covariance = _moments(model, mu, sigma, slopes[:, free], free, draws)
    return ParameterScatter(mu, sigma, slopes, mean, covariance, cut, rounds)


def slopes_of(model: Model, point: Floats, reach: Floats) -> Floats:
    """Derivatives of the model (m, n_parameters), by central differences over reach."""
    n = point.size
    found = model(np.vstack([point + np.diag(reach), point - np.diag(reach)]))
    return np.asarray((found[:n] - found[n:]).T / (2.0 * reach))


def _moments(
    model: Model, mu: Floats, sigma: Floats, slopes: Floats, free: Integers, draws: Floats | None
) -> tuple[Floats, Floats]:
    """Mean (m,) and covariance (m, m) of the model where parameters scatter so."""
    if draws is None or not sigma.any():
        return np.asarray(model(mu[None])[0]), np.asarray(slopes @ sigma @ slopes.T)
    values, vectors = np.linalg.eigh(sigma)
    sets = np.tile(mu, (len(draws), 1))
    sets[:, free] += draws @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
    found = model(sets)
    mean = found.mean(axis=0)
    return np.asarray(mean), np.asarray((found - mean).T @ (found - mean) / len(draws))


def _not_negative(sigma: Floats) -> tuple[Floats, float]:
    """The nearest covariance without negative variances, and what it leaves out of the trace."""
    values, vectors = np.linalg.eigh(0.5 * (sigma + sigma.T))
    kept = np.maximum(values, 0.0)
    cut = float(np.sum(kept - values) / max(np.sum(np.abs(values)), np.finfo(float).tiny))
    return np.asarray((vectors * kept) @ vectors.T), cut


def noise_outside(tests: TestScatter, found: ParameterScatter, free: Integers) -> float:
    """The variance that the tests have where no parameter that scatters moves them: of the
    measurement, if that is one for all values. free: as of Beforehand; fewer than values."""
    own = found.slopes[:, free]
    outside = np.linalg.svd(own)[0][:, free.size :]
    return float(np.trace(outside.T @ tests.covariance @ outside) / outside.shape[1])


def lack_of_fit(tests: TestScatter, found: ParameterScatter, n_told: int) -> float:
    """How likely the tests scatter so, or less likely, where the model's prediction is right.

    The likelihood ratio against any covariance: chi-squared of the values that it has more than
    the n_told that parameters were fitted to; 1 where it has none. Source: Anderson 2003, 10.8.
    """
    m = tests.mean.size
    freedom = m * (m + 1) // 2 - n_told
    if freedom <= 0:
        return 1.0
    inside = found.predicted_covariance + tests.noise
    ratio = np.linalg.solve(inside, tests.covariance)
    left = (tests.n - 1.0) * (np.trace(ratio) - np.linalg.slogdet(ratio)[1] - m)
    return float(chi2.sf(left, freedom))


def draw_scatter(
    tests: TestScatter,
    found: ParameterScatter,
    before: Beforehand,
    rng: np.random.Generator,
    count: int = 2000,
    noise_told: bool = True,
) -> tuple[Floats, Floats, Floats]:
    """Draws from the posterior, the model being linear around what was found.

    Means (n, n_parameters), covariances (n, n_free, n_free) of the parameters that scatter, and
    the variance of the measurement itself (n,).
    noise_told: whether the measurement's own scatter is given with the tests; else it is found as
    one variance of all values. The first quarter of count is thrown away.
    """
    free, slopes = before.free, found.slopes
    own, p, m = slopes[:, free], free.size, tests.mean.size
    off = tests.values - found.predicted
    seen = np.isfinite(off)
    patterns, which = np.unique(seen, axis=0, return_inverse=True)
    groups = [
        (there, np.where(seen, off, 0.0)[which.ravel() == number])
        for number, there in enumerate(patterns)
        if there.any()
    ]
    told = sum(len(rows) for _, rows in groups)
    share = tests.n / told  # of an independent test that each is worth
    floor = EXACT * float(np.diag(tests.covariance).min())
    fixed = tests.noise + floor * np.eye(m)
    variance = max(float(np.trace(tests.noise)) / m, floor)
    sigma = found.covariance + EXACT * np.diag(before.deviation[free] ** 2)
    shift = found.mean - before.mean  # of the prior, as seen from the mean that was found
    wide = before.deviation[free] ** 2
    inverse_a = 1.0 / wide
    kept: list[tuple[Floats, Floats, float]] = []
    for turn in range(count):
        noise = fixed if noise_told else variance * np.eye(m)
        mean = _draw_mean(groups, slopes, own, sigma, noise, share, before.deviation, shift, rng)
        deviations, left, values = _draw_tests(groups, slopes, own, sigma, noise, mean, rng)
        spread = share * deviations.T @ deviations + 4.0 * np.diag(inverse_a)
        sigma = np.atleast_2d(invwishart.rvs(share * told + p + 1, spread, random_state=rng))
        rates = 2.0 * np.diag(np.linalg.inv(sigma)) + 1.0 / wide
        inverse_a = rng.gamma((2.0 + p) / 2.0, 1.0 / rates)
        if not noise_told:
            variance = share * left / 2.0 / rng.gamma(share * values / 2.0)
        if turn >= count // 4:
            kept.append((found.mean + mean, sigma, variance))
    means, covariances, variances = zip(*kept, strict=True)
    return np.array(means), np.array(covariances), np.array(variances)


Groups = list[tuple[Floats, Floats]]


def _draw_mean(
    groups: Groups,
    slopes: Floats,
    own: Floats,
    sigma: Floats,
    noise: Floats,
    share: float,
    deviation: Floats,
    shift: Floats,
    rng: np.random.Generator,
) -> Floats:
    """A draw of the parameters' mean, as a change (n_parameters,) of the one that was found."""
    whole = own @ sigma @ own.T + noise
    precision, pull = np.diag(deviation**-2), -shift / deviation**2
    for there, rows in groups:
        weighed = np.linalg.solve(whole[np.ix_(there, there)], slopes[there]).T
        precision = precision + share * len(rows) * weighed @ slopes[there]
        pull = pull + share * weighed @ rows[:, there].sum(axis=0)
    return _normal(precision, pull[:, None], rng)[:, 0]


def _draw_tests(
    groups: Groups,
    slopes: Floats,
    own: Floats,
    sigma: Floats,
    noise: Floats,
    mean: Floats,
    rng: np.random.Generator,
) -> tuple[Floats, float, int]:
    """Draws of each test's parameters less their mean, (n_tests, n_free); the squares that are left
    of the values then, and how many of these there are."""
    inverse, drawn, left, values = np.linalg.inv(sigma), [], 0.0, 0
    for there, rows in groups:
        off = rows[:, there] - slopes[there] @ mean
        weighed = np.linalg.solve(noise[np.ix_(there, there)], own[there]).T
        changes = _normal(inverse + weighed @ own[there], weighed @ off.T, rng)
        left += float(np.sum((off - changes.T @ own[there].T) ** 2))
        values += off.size
        drawn.append(changes.T)
    return np.vstack(drawn), left, values


def _normal(precision: Floats, pulls: Floats, rng: np.random.Generator) -> Floats:
    """Draws (p, n) of normal variables with this precision (p, p), their means times which are
    pulls (p, n)."""
    root = np.linalg.cholesky(precision)
    means = cho_solve((root, True), pulls)
    return np.asarray(means + np.linalg.solve(root.T, rng.standard_normal(pulls.shape)))
