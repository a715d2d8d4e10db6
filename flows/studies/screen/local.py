"""Sensitivities at the deck's values, from the sensitivity matrix of the updating problem.

The residual's rows hold all that is wanted. Of a frequency they are (d lambda / dp) / lambda_m, so

    (df/f) / (dp/p) = p / 2 (lambda_m / lambda) (row).

Of a shape they are v = (I - u_m u_m^T) du, and the residual is z = (u_m . u) u_m - u. Since
MAC = 1 - |z|^2 and dz = -v,

    dMAC / (dp/p) = 2 p z . v.
"""

from __future__ import annotations

import numpy as np

from modetune.core.modes import Floats, Integers
from modetune.core.updating.responses.response import Residual
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.studies.screen.record import LocalSensitivity
from modetune.flows.updating.evaluation import Evaluation, Matrix, part_rows


def local_sensitivity(campaign: Campaign, nominal: Evaluation, matrix: Matrix) -> LocalSensitivity:
    """Normalised and weighted sensitivities at an evaluation point."""
    residual, theta, pairing = nominal.residual, nominal.theta, nominal.pairing
    n = residual.rows("frequencies").stop
    measured = campaign.test.modes.eigenvalues[pairing.measured]
    ratio = measured / nominal.seen.eigenvalues[pairing.computed]
    root, rows = np.sqrt(residual.weights), residual.independent(matrix.values)
    others = other_rows(residual)
    return LocalSensitivity(
        frequencies=0.5 * ratio[:, None] * matrix.values[:n] * theta,
        mac=_mac(nominal, matrix.values),
        others=rows[others] / np.sqrt(residual.noise[others])[:, None],
        weighted=root[:, None] * rows * campaign.parameters.standard_deviations,
        weighted_residual=root * residual.independent(residual.values),
        methods=matrix.methods_had,
        missing=tuple(
            "its job failed, the warning says why" if column in matrix.missing else ""
            for column in range(theta.size)
        ),
    )


def other_rows(found: Residual) -> Integers:
    """Rows that are compared beside frequencies and shapes."""
    beside = np.ones(found.values.size, dtype=bool)
    for kind in ("frequencies", "shapes"):
        beside[found.rows(kind)] = False
    return np.flatnonzero(beside & (found.weights > 0.0))


def _mac(nominal: Evaluation, sensitivity: Floats) -> Floats:
    """dMAC / (dp/p), (n_modes, n_parameters); without rows where shapes are not compared, zero for
    modes of a test without shapes beside one that has some."""
    theta, found = nominal.theta, nominal.residual
    if not found.has("shapes"):
        return np.zeros((0, theta.size))
    slopes = []
    for part, rows in zip(nominal.parts, part_rows(nominal.parts), strict=True):
        n_modes, own = part.pairing.measured.size, rows[part.residual.rows("shapes")]
        shapes = found.values[own].reshape(n_modes, -1)
        changes = sensitivity[own].reshape(n_modes, -1, theta.size)
        slopes.append(np.einsum("ms,msp->mp", shapes, changes))
    return np.asarray(2.0 * np.concatenate(slopes) * theta)
