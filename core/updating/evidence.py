"""How well models explain a test, each by its evidence: the likelihood averaged over its prior.

With the chi-square misfit F(x) of parameters x and a prior that is uniform within widths w, the
logarithm of the evidence is, but for a constant of the test (MacKay 2003, chapter 28),

    ln Z = -F(x^)/2 + sum_i ln(l_i / w_i),

where x^ is the best point and the product of the l_i the volume that the data leave: by Laplace's
approximation (2 pi)^(n/2) / sqrt(det H), H = half of the Hessian of F. A parameter that the data do
not determine has the width of its prior, so it neither helps nor costs.

A test whose residuals are larger than its noise alone explains (Birge 1932) distinguishes models
less: F is divided by the ratio s^2 = F / freedom of the best model where that exceeds 1.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import logsumexp

from modetune.core.modes import Floats


def log_evidence(misfit: float, hessian: Floats, widths: Floats, scale: float = 1.0) -> float:
    """Return ln Z of a model, up to a constant of the test.

    misfit: the chi-square at the best point. hessian: (n, n), half of the misfit's second
    derivatives there, positive semi-definite. widths: (n,), of the uniform priors. scale: s^2, by
    which the misfit is divided.
    """
    if not widths.size:
        return -0.5 * misfit / scale
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
