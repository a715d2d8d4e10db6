"""How laws of noise are weighed: the learning nights' scatter, and tests averaged over the laws.

A law (night_noise.py) says how the noise of nights is correlated in time. Its weight is its prior
times the restricted likelihood of the nights so far; drift.py says what is tested.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from modetune.core.modes import Floats, Integers
from modetune.core.monitoring.night_noise import Contrast, NoiseLaw, Whitened

#: Bayes factor that is substantial evidence (Jeffreys 1961; Kass and Raftery 1995).
SUBSTANTIAL = 3.0
#: A law of noise is left out where it is less likely than the best by this.
NEGLIGIBLE = 1e-6


@dataclass(frozen=True, slots=True)
class LearnedScatter:
    """Scatter of the learning nights in units of the stated errors: covariance (r, r), how many
    degrees of freedom it is known by, and how much in-sample scatter along a direction that was
    chosen by it is too small."""

    covariance: Floats
    freedom: float
    widened: float


def learned_scatter(
    laws: tuple[NoiseLaw, ...], whitened: list[Whitened], degrees: int, learning: bool
) -> LearnedScatter:
    """Return the mean of the posterior over laws, and over how closely the scatter follows the
    stated covariance: the prior is worth nu_0 nights."""
    squares = np.array([white.squares[0] for white in whitened])
    r = squares.shape[-1]
    base = np.log([law.prior for law in laws]) + r * np.array([w.penalty[0] for w in whitened])
    variance = np.trace(squares, axis1=1, axis2=2) / (degrees * r)
    logs, covariances, totals = [], [], []
    # From hardly any trust in the stated covariance to a known multiple of it.
    for nu in [1e4] if learning or r == 1 else [r + 3, 2 * r + 6, 4 * r + 12, 8 * r + 24, 1e4]:
        prior = (nu - r - 1) * variance
        both = squares + prior[:, None, None] * np.eye(r)
        logs.append(
            base
            + 0.5 * nu * r * np.log(prior)
            - 0.5 * (nu + degrees) * np.linalg.slogdet(both)[1]
            + scipy.special.multigammaln(0.5 * (nu + degrees), r)
            - scipy.special.multigammaln(0.5 * nu, r)
        )
        covariances.append(both / (nu + degrees - r - 1))
        totals.append(nu + degrees)
    weights = np.exp(np.array(logs) - scipy.special.logsumexp(logs))
    covariance = np.einsum("al,alij->ij", weights, np.array(covariances))
    each, total = weights.sum(axis=1), np.array(totals)
    return LearnedScatter(
        covariance,
        float(1.0 / (each @ (1.0 / (total - r + 1)))),
        float(each @ (total / (total - r + 1))),
    )


def without_learning(white: Whitened) -> Whitened:
    """The nights without the look at the learning ones."""
    return replace(
        white,
        information=white.information[1:],
        penalty=white.penalty[1:],
        squares=white.squares[1:],
    )


def plausible_laws(
    laws: tuple[NoiseLaw, ...], whitened: list[Whitened], to_axes: Floats, looks: Integers
) -> list[int]:
    """Return the laws that weigh anything at any look, in all axes together or in one."""
    squares = np.array([np.einsum("ai,kij,aj->ka", to_axes, w.squares, to_axes) for w in whitened])
    degrees = (looks + 1 - whitened[0].design.shape[1])[:, None]
    tiny = np.finfo(float).tiny
    logs = np.array([w.penalty for w in whitened])[:, :, None] - 0.5 * degrees * np.log(
        np.maximum(squares, tiny)
    )
    logs = np.concatenate([logs, logs.sum(axis=2, keepdims=True)], axis=2)
    # A change that is fitted may move the likelihood of a law: room for a factor of 100.
    near = (logs > logs.max(axis=0) + np.log(NEGLIGIBLE)).any(axis=(1, 2))
    return [int(place) for place in np.flatnonzero(near)]


@dataclass(frozen=True, slots=True)
class LawFit:
    """What one law makes of each night: logs of the marginal likelihood of each direction (N, t),
    and of those across it (N, t); probabilities of the directions (N, t) and of T^2 (N,); the
    change along the axes (N, r) with its variance."""

    own: Floats
    rest: Floats
    single: Floats
    joint: Floats
    change: Floats
    variance: Floats


def fit_law(
    white: Whitened,
    contrast: Contrast,
    to_axes: Floats,
    directions: Floats,
    noise: Floats,
    learned: LearnedScatter,
    looks: Integers,
) -> LawFit:
    """Test each look (N,) for a change under one law.

    contrast: the changes fitted under it. to_axes: (r, r). directions: (r, t), noise: (n, t), the
    variance of each night along them.
    """
    white = without_learning(white)
    r = len(to_axes)
    degrees = looks + 1.0 - white.design.shape[1]  # of the residual without a change
    g = contrast.information[:, None]
    change = contrast.change @ to_axes.T
    squares = to_axes @ white.squares @ to_axes.T
    along = np.einsum("it,kij,jt->kt", directions, squares, directions)
    across = np.maximum(np.trace(squares, axis1=1, axis2=2)[:, None] - along, 0.0)
    turned = change @ directions
    floor = np.finfo(float).tiny
    left = np.maximum(along - g * turned**2, floor)
    nu = (degrees - 1.0)[:, None]
    penalty = white.penalty[:, None]
    own = penalty - 0.5 * np.log(g) - 0.5 * nu * np.log(left)
    rest = (r - 1) * (penalty - 0.5 * degrees[:, None] * np.log(np.maximum(across, floor)))
    error = (contrast.noise @ noise) / g**2
    size = np.sqrt(left / nu * learned.widened * error)
    single = 2.0 * scipy.special.stdtr(nu, -np.abs(turned) / size)
    total = np.maximum(
        np.trace(squares, axis1=1, axis2=2)[:, None] - g * np.sum(change**2, axis=1, keepdims=True),
        floor,
    )
    variance = (total / (nu * r)) * error[:, -r:]
    freedom = 1.0 / (1.0 / learned.freedom + 1.0 / (nu[:, 0] * r))
    joint = scipy.special.fdtrc(r, freedom, np.sum(change**2 / variance, axis=1) / r)
    return LawFit(own, rest if r > 1 else 0.0 * own, single, joint, change, variance)


def averaged(fits: list[LawFit], priors: Floats, p: int) -> tuple[Floats, Floats]:
    """Return probabilities (N, p + 1) of p parameters and T^2, over the laws that all directions
    share, and over those that the direction has alone; and the weights (laws, N) of the former."""
    own = np.array([fit.own for fit in fits]) + priors[:, None, None]
    rest = np.array([fit.rest for fit in fits])
    single = np.array([fit.single for fit in fits])
    shared, apart = _normalised(own + rest), _normalised(own)
    alone = scipy.special.logsumexp(own, axis=0) + scipy.special.logsumexp(
        rest + priors[:, None, None], axis=0
    )
    alike = _probability_shared(scipy.special.logsumexp(own + rest, axis=0) - alone)
    if own.shape[2] == p + 1:  # one direction, which shares its law with none
        alike = np.zeros_like(alike)
    found = alike * np.sum(shared * single, axis=0) + (1.0 - alike) * np.sum(apart * single, axis=0)
    r = own.shape[2] - p
    sums = np.sum(own[:, :, p:] - priors[:, None, None], axis=2) + priors[:, None]
    weights = _normalised(sums)
    alike_all = _probability_shared(
        scipy.special.logsumexp(sums, axis=0)
        - scipy.special.logsumexp(own[:, :, p:], axis=0).sum(axis=1)
    )
    joint = np.sum(weights * np.array([fit.joint for fit in fits]), axis=0)
    # Where each axis has its law, the least of their probabilities, times their number.
    least = np.minimum(r * np.min(np.sum(apart * single, axis=0)[:, p:], axis=1), 1.0)
    both = alike_all * joint + (1.0 - alike_all) * least
    return np.column_stack([found[:, :p], both]), weights


def _probability_shared(evidence: Floats) -> Floats:
    """The probability that directions share a law, given the log Bayes factor for it. It is 1 where
    the evidence is substantial: averaging would leave a floor under all probabilities."""
    probability = 1.0 / (1.0 + np.exp(np.clip(-evidence, -700.0, 700.0)))
    return np.asarray(np.where(evidence > np.log(SUBSTANTIAL), 1.0, probability))


def _normalised(logs: Floats) -> Floats:
    return np.asarray(np.exp(logs - scipy.special.logsumexp(logs, axis=0)))
