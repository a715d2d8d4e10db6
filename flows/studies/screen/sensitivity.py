"""Sensitivities of a screening at the deck's values, and how much the test sees of a parameter.

The residual's rows give all sensitivities. Of a frequency they are (d lambda / dp) / lambda_m, so

    (df/f) / (dp/p) = p / 2 (lambda_m / lambda) (row).

Of a shape they are v = (I - u_m u_m^T) du, and the residual is z = (u_m . u) u_m - u. Since
MAC = 1 - |z|^2 and dz = -v,

    dMAC / (dp/p) = 2 p z . v.

A parameter moves each response by so much over its bounds (`Indices.moves`; without a design the
slope at the deck's values times the width of the bounds). Divided by the standard deviation of the
measured response, this is the number of standard deviations that the test sees. All responses in
the residual, of every kind, count together as the root of the sum of squares. A shape that changes
by the relative size d has a MAC of 1 - d^2 with the earlier shape, so a MAC that moves by m counts
as a shape that moves by the root of m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modetune.core.modes import Floats, Integers
from modetune.core.updating.responses.response import Residual
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.studies.screen.design import Design
from modetune.flows.studies.screen.indices import Indices
from modetune.flows.updating.evaluation import Evaluation, Matrix, part_rows


@dataclass(frozen=True, slots=True)
class LocalSensitivity:
    """Sensitivities at the deck's values.

    frequencies: (n_modes, n_parameters), (df/f) / (dp/p). mac: likewise dMAC / (dp/p), without
    rows where shapes are not compared. others: (n_others, n_parameters), of other
    responses, in standard deviations of the test, for a change by the deck's value. weighted,
    weighted_residual: as `core/updating/subset` requires them. methods: how each column was
    computed; missing: why a column was unavailable, or empty.
    """

    frequencies: Floats
    mac: Floats
    others: Floats
    weighted: Floats
    weighted_residual: Floats
    methods: tuple[str, ...]
    missing: tuple[str, ...]


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
    """Return the rows other than frequencies and shapes that are compared."""
    beside = np.ones(found.values.size, dtype=bool)
    for kind in ("frequencies", "shapes"):
        beside[found.rows(kind)] = False
    return np.flatnonzero(beside & (found.weights > 0.0))


def _mac(nominal: Evaluation, sensitivity: Floats) -> Floats:
    """Return dMAC / (dp/p), (n_modes, n_parameters), without rows if shapes are not compared.

    Rows are zero for modes of a test without shapes.
    """
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


def most_moved(moves: Floats, modes: Sequence[str], others: Sequence[str]) -> tuple[str, ...]:
    """Return the name of the response that each parameter moves most.

    moves: as `seen_moves` returns them. modes: names of the paired modes. others: names of
    responses other than frequencies and shapes.
    """
    names = [f"{what} of {name}" for what in ("frequency", "MAC") for name in modes]
    names[len(moves) - len(others) :] = others
    return tuple(names[row] for row in moves.argmax(axis=0).tolist())


def seen_moves(
    campaign: Campaign, design: Design, local: LocalSensitivity, found: Indices | None
) -> Floats:
    """Return the change of each response over the bounds, in standard deviations of the test.

    (n_responses, n_parameters), zero for responses that are not compared.
    """
    weighting, n = campaign.weighting, local.frequencies.shape[0]
    if found is None:
        width, initial = design.upper - design.lower, campaign.parameters.initial
        moded = np.vstack([local.frequencies, local.mac]) / initial
        moves = np.abs(np.vstack([moded, local.others])) * width
    else:
        moves = found.moves
    seen, macs = np.zeros(moves.shape), moves.shape[0] - local.others.shape[0]
    seen[macs:] = moves[macs:]
    used = weighting.frequencies_used
    seen[:n][used] = moves[:n][used] / weighting.frequency_deviations[used, None]
    if weighting.with_shapes:
        used = weighting.shapes_used
        seen[n:macs][used] = np.sqrt(moves[n:macs][used]) / weighting.shape_deviations[used, None]
    return seen
