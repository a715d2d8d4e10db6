"""The residual of an updating problem: how the test differs from the model, and its derivative.

For each pair of a measured mode m and a computed mode c:

* frequency: z = (lambda_m - lambda_c) / lambda_m, with sensitivity (d lambda_c/d theta) / lambda_m;
* shape, at the common sensors: both shapes are brought to unit length (the modal scale factor of
  two unit shapes is the cosine between them), and z = cos * u_m - u_c, in the measured sign. Its
  squared length is 1 - MAC, whatever the scaling of either side. With
  d u_c = (I - u_c u_c^T) d phi / |phi| the exact sensitivity of u_c - cos * u_m is
  (I - u_m u_m^T) d u_c.

Weights are reciprocals of measurement variances times the campaign's emphasis (thesis (40)). A
relative frequency deviation s is 2 s of the eigenvalue; a shape deviation s relative to the
shape's root mean square is s / sqrt(n) of an entry of a unit shape with n entries. To it comes
what the linear model of the shape cannot know: its error is of second order in the shape's
difference, whose square is 1 - MAC, so a shape far from the test (modes that mix) counts little
until it has come near:

    variance of an entry = (s^2 + (1 - MAC)^2) / n.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modetune.core.correlation.pairing import Pairing
from modetune.core.modes import Floats, ModeSet, common_dofs
from modetune.core.updating.results import ModeDerivatives


@dataclass(frozen=True, slots=True)
class Weighting:
    """How far the measured values are trusted.

    frequency_deviation: relative standard deviation of measured frequencies.
    shape_deviation: standard deviation of a shape entry relative to the shape's rms.
    frequency_weight, shape_weight: emphasis, dimensionless; 0 leaves that kind out.
    """

    frequency_deviation: float
    shape_deviation: float
    frequency_weight: float
    shape_weight: float


@dataclass(frozen=True, slots=True)
class Residual:
    """Measured minus computed.

    values: (n_residuals,), frequencies of all pairs first, then shapes pair by pair.
    weights: (n_residuals,), emphasis over variance; variances: (n_residuals,), of the values.
    n_frequencies: how many of the values are of frequencies.
    """

    values: Floats
    weights: Floats
    variances: Floats
    n_frequencies: int

    @property
    def misfit(self) -> float:
        """The weighted sum of squares that updating brings down (thesis (40))."""
        return float(self.values @ (self.weights * self.values))

    @property
    def n_independent(self) -> int:
        """Values that count: of each shape one less than its entries, which scaling takes."""
        used = self.weights > 0.0
        shapes = np.array_split(used[self.n_frequencies :], max(self.n_frequencies, 1))
        return int(used.sum()) - sum(bool(shape.any()) for shape in shapes)


def residual(
    measured: ModeSet, computed: ModeSet, pairing: Pairing, weighting: Weighting
) -> Residual:
    """The residual of paired modes; shapes take part where their weight is above zero."""
    lam_m = measured.eigenvalues[pairing.measured]
    values = [(lam_m - computed.eigenvalues[pairing.computed]) / lam_m]
    variances = [np.full(lam_m.size, (2.0 * weighting.frequency_deviation) ** 2)]
    emphasis = [np.full(lam_m.size, weighting.frequency_weight)]
    if weighting.shape_weight > 0.0:
        for test, model, _ in _unit_shapes(measured, computed, pairing):
            values.append((test @ model) * test - model)
            far = 1.0 - float(test @ model) ** 2
            variance = (weighting.shape_deviation**2 + far**2) / test.size
            variances.append(np.full(test.size, variance))
            emphasis.append(np.full(test.size, weighting.shape_weight))
    all_variances = np.concatenate(variances)
    return Residual(
        values=np.concatenate(values),
        weights=np.concatenate(emphasis) / all_variances,
        variances=all_variances,
        n_frequencies=lam_m.size,
    )


def residual_sensitivity(
    measured: ModeSet,
    computed: ModeSet,
    pairing: Pairing,
    weighting: Weighting,
    derivatives: ModeDerivatives,
) -> Floats:
    """Derivative of the computed side of the residual, (n_residuals, n_parameters).

    derivatives: of the paired computed modes, in the order of the pairs, at the rows of
    `computed`.
    """
    lam_m = measured.eigenvalues[pairing.measured]
    rows = [derivatives.eigenvalues / lam_m[:, None]]
    if weighting.shape_weight > 0.0:
        _, sensors = common_dofs(measured, computed)
        for pair, (test, model, scale) in enumerate(_unit_shapes(measured, computed, pairing)):
            change = scale * derivatives.mode_shapes[sensors, pair]
            change = change - np.outer(model, model @ change)
            rows.append(change - np.outer(test, test @ change))
    return np.concatenate(rows)


def _unit_shapes(
    measured: ModeSet, computed: ModeSet, pairing: Pairing
) -> list[tuple[Floats, Floats, float]]:
    """Of each pair: the measured and computed unit shapes, and the computed one's scale factor."""
    rows_m, rows_c = common_dofs(measured, computed)
    units = []
    for m, c in zip(pairing.measured.tolist(), pairing.computed.tolist(), strict=True):
        test = np.real(measured.mode_shapes[rows_m, m])
        model = np.real(computed.mode_shapes[rows_c, c])
        sign = -1.0 if test @ model < 0.0 else 1.0  # a solver's sign means nothing
        scale = sign / float(np.linalg.norm(model))
        units.append((test / np.linalg.norm(test), scale * model, scale))
    return units
