"""Features with a closed form in place of a surrogate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from modetune.core.modes import Floats
from modetune.flows.studies.sample.density import Posterior


@dataclass(frozen=True)
class LinearFeatures:
    """A residual that is linear in the parameters."""

    slopes: Floats
    offset: Floats

    def features(self, points: Floats) -> Floats:
        return np.asarray(points @ self.slopes.T + self.offset)


@dataclass(frozen=True)
class TwoFeatures:
    """The square of the first parameter was measured, so its sign is open."""

    def features(self, points: Floats) -> Floats:
        return np.stack([(points[:, 0] ** 2 - 1.0) / 0.1, points[:, 1] / 0.5], axis=1)


@pytest.fixture
def linear() -> tuple[Posterior, Floats, Floats]:
    """A linear-Gaussian posterior far inside its range, with its mean and covariance.

    With w = A t + b and a prior N(t0, P^-1) it is N(m, C), C = (A^T A + P)^-1 and
    m = C (P t0 - A^T b): Bayes' rule for normal distributions.
    """
    rng = np.random.default_rng(5)
    slopes, offset = 10.0 * rng.normal(size=(4, 3)), rng.normal(size=4)
    mean, deviation = np.array([1.0, 0.9, 1.1]), np.array([0.2, 0.1, 0.3])
    covariance = np.linalg.inv(slopes.T @ slopes + np.diag(deviation**-2))
    centre = covariance @ (mean / deviation**2 - slopes.T @ offset)
    wide = np.full(3, 20.0)
    posterior = Posterior(LinearFeatures(slopes, offset), mean, deviation, -wide, wide)
    return posterior, centre, covariance


@pytest.fixture
def two_peaked() -> Posterior:
    """Equal peaks at -1 and 1 of the first parameter; the prior, N(0, 10), knows no sign."""
    three = np.full(2, 3.0)
    return Posterior(TwoFeatures(), np.zeros(2), np.full(2, 10.0), -three, three)
