"""How well models explain a test, each by its evidence: the likelihood averaged over its prior.

With the chi-square misfit F(x) of parameters x and a prior that is uniform within widths w, the
logarithm of the evidence is, but for a constant of the test (MacKay 2003, chapter 28),

    ln Z = -F(x^)/2 + sum_i ln(l_i / w_i),

where x^ is the best point and the product of the l_i the volume that the data leave: by Laplace's
approximation (2 pi)^(n/2) / sqrt(det H), H = half of the Hessian of F. A parameter that the data do
not determine has the width of its prior, so it neither helps nor costs. Where the distances to the
bounds are given, the Gaussian is integrated within them: with the half slopes g of F at x^,

    integral exp(-(F + 2 g.d + d.H d) / 2) = exp((m.H m - F) / 2) (2 pi)^(n/2) / sqrt(det H) P,

m = -H^-1 g its mean and P its probability between the bounds (Geweke 1991, Hajivassiliou and
Keane), which counts a best point on a bound right.

A test whose residuals are larger than its noise alone explains (Birge 1932) distinguishes models
less: F is divided by the ratio s^2 = F / freedom of the best model where that exceeds 1.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import log_ndtr, logsumexp, ndtri_exp
from scipy.stats import qmc

from modetune.core.modes import Floats

#: Curvature, in units of the widths, that stands in for none: a millionth of one deviation.
FLAT = 1e-6
#: Quasi-random points as a power of two: ln P is right to about 0.01.
POINTS = 10


def log_evidence(
    misfit: float,
    hessian: Floats,
    widths: Floats,
    scale: float = 1.0,
    gradient: Floats | None = None,
    box: Floats | None = None,
) -> float:
    """Return ln Z of a model, up to a constant of the test.

    misfit: the chi-square at the best point. hessian: (n, n), half of the misfit's second
    derivatives there, positive semi-definite. widths: (n,), of the uniform priors. scale: s^2, by
    which the misfit is divided. gradient: (n,), half of the misfit's slopes there, zero where None.
    box: (n, 2), from the best point to the bounds; the volume is then that within them.
    """
    if not widths.size:
        return -0.5 * misfit / scale
    if box is not None:
        slope = np.zeros(widths.size) if gradient is None else gradient
        return _within_box(misfit / scale, slope / scale, hessian / scale, widths, box)
    # In units of the widths a direction that the data leave free has a curvature near zero.
    values = np.linalg.eigvalsh(widths[:, None] * hessian * widths / scale)
    volumes = np.minimum(np.sqrt(2.0 * np.pi / np.maximum(values, 1e-300)), 1.0)
    return float(-0.5 * misfit / scale + np.log(volumes).sum())


def probabilities(log_evidences: Sequence[float], prior: Floats | None = None) -> Floats:
    """Return the probability of each model, (n,); prior: (n,), equal where None."""
    logs = np.asarray(log_evidences, dtype=np.float64)
    if prior is not None:
        logs = logs + np.log(prior)
    return np.asarray(np.exp(logs - logsumexp(logs)))


def _within_box(
    misfit: float, gradient: Floats, hessian: Floats, widths: Floats, box: Floats
) -> float:
    """Return ln Z of a Gaussian likelihood within bounds, in units of the widths."""
    n = widths.size
    scaled = widths[:, None] * hessian * widths + FLAT * np.eye(n)
    mean = -np.linalg.solve(scaled, widths * gradient)
    covariance = np.linalg.inv(scaled)
    bounds = box / widths[:, None] - mean[:, None]
    top = 0.5 * (float(mean @ scaled @ mean) - misfit)
    volume = 0.5 * (n * np.log(2.0 * np.pi) - np.linalg.slogdet(scaled)[1])
    return float(top + volume + _log_probability(0.5 * (covariance + covariance.T), bounds))


def _log_probability(covariance: Floats, bounds: Floats) -> float:
    """Return ln P that a Gaussian of mean zero is within bounds (n, 2), from quasi-random points.

    The unknowns follow one another, the most limited first, each cut at its bounds.
    """
    order = np.argsort((bounds[:, 1] - bounds[:, 0]) / np.sqrt(np.diag(covariance)), kind="stable")
    factor = np.linalg.cholesky(covariance[np.ix_(order, order)])
    limits = bounds[order]
    n = limits.shape[0]
    draws = qmc.Sobol(max(n - 1, 1), rng=np.random.default_rng(0)).random_base2(POINTS)
    found, logs = np.zeros((draws.shape[0], n)), np.zeros(draws.shape[0])
    for place in range(n):
        known = found[:, :place] @ factor[place, :place]
        low, high = ((limits[place, side] - known) / factor[place, place] for side in (0, 1))
        # Tails are counted from their own side, where they keep their digits.
        turned = low > 0.0
        low, high = np.where(turned, -high, low), np.where(turned, -low, high)
        below, above = log_ndtr(low), log_ndtr(high)
        inside = above + np.log1p(-np.exp(np.minimum(below - above, -1e-300)))
        logs += inside
        if place < n - 1:
            share = np.log(draws[:, place])
            there = ndtri_exp(np.logaddexp(below, inside + share))
            found[:, place] = np.where(turned, -there, there)
    return float(logsumexp(logs) - np.log(logs.size))


def gaussian_log_evidence(
    misfit: float, hessian: Floats, precision: Floats, offset: Floats, scale: float = 1.0
) -> float:
    """Return ln Z of a model whose prior is a Gaussian, up to a constant of the test.

    precision: (n, n), of the prior; offset: (n,), from its mean to the best point; the others as in
    `log_evidence`.
    """
    pull = float(offset @ precision @ offset)
    grown = np.linalg.slogdet(hessian / scale + precision)[1] - np.linalg.slogdet(precision)[1]
    return float(-0.5 * (misfit / scale + pull + grown))
