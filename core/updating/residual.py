"""The residual of an updating problem: how the test differs from the model, and its derivative.

For each pair of a measured mode m and a computed mode c:

* frequency: z = (lambda_m - lambda_c) / lambda_m, with sensitivity (d lambda_c/d theta) / lambda_m;
* shape, at the common sensors: both shapes are brought to unit length (the modal scale factor of
  two unit shapes is the cosine between them), and z = cos * u_m - u_c, in the measured sign. Its
  squared length is 1 - MAC, whatever the scaling of either side. With
  d u_c = (I - u_c u_c^T) d phi / |phi| the exact sensitivity of u_c - cos * u_m is
  (I - u_m u_m^T) d u_c.

Modes of a cluster are compared as one (`core/correlation/clusters`): u_m u_m^T becomes the
projector on the space of their measured shapes, u_c u_c^T that on the space of the model's, and a
unit shape one of the cluster's root mean square length; so no rotation inside it changes the
squared length of z. Where neither side splits frequencies, derivatives of their mean are compared.

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

from modetune.core.correlation.clusters import paired_clusters, with_neighbours
from modetune.core.correlation.pairing import UNSEEN, Pairing
from modetune.core.modes import REPEATED, Floats, Integers, ModeSet, close_sets, common_dofs
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
        shapes = np.zeros((lam_m.size, common_dofs(measured, computed)[0].size))
        spread = np.zeros_like(shapes)
        for cluster in _clusters(measured, computed, pairing, weighting):
            away = cluster.model - cluster.test @ (cluster.test.T @ cluster.model)
            shapes[cluster.pairs] = -away.T
            far = float(np.sum(away**2)) / cluster.pairs.size
            spread[cluster.pairs] = (weighting.shape_deviation**2 + far**2) / shapes.shape[1]
        values.append(shapes.ravel())
        variances.append(spread.ravel())
        emphasis.append(np.full(shapes.size, weighting.shape_weight))
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
    slopes = derivatives.eigenvalues / lam_m[:, None]
    for alike in _unsplit(measured, computed, pairing, weighting):
        slopes[alike] = slopes[alike].mean(axis=0)
    if weighting.shape_weight == 0.0:
        return slopes
    _, sensors = common_dofs(measured, computed)
    changes = derivatives.mode_shapes[sensors]
    rows = np.zeros((lam_m.size, sensors.size, slopes.shape[1]))
    for cluster in _clusters(measured, computed, pairing, weighting):
        change = changes[:, cluster.pairs] * cluster.scales[:, None]
        for space in (cluster.space, cluster.test):
            change = change - np.tensordot(space, np.tensordot(space.T, change, axes=1), axes=1)
        rows[cluster.pairs] = change.transpose(1, 0, 2)
    return np.concatenate([slopes, rows.reshape(-1, slopes.shape[1])])


@dataclass(frozen=True, slots=True)
class _Cluster:
    """Shapes of the pairs of one cluster at the common sensors.

    pairs: (n,), positions; test, space: (n_sensors, k), orthonormal, of the measured shapes and of
    the model's with all that are close to them; scales: (n,), what brings the model's shapes
    model, (n_sensors, n), to unit root mean square length and the measured sign.
    """

    pairs: Integers
    test: Floats
    space: Floats
    scales: Floats
    model: Floats


def _clusters(
    measured: ModeSet, computed: ModeSet, pairing: Pairing, weighting: Weighting
) -> list[_Cluster]:
    rows_m, rows_c = common_dofs(measured, computed)
    test, model = np.real(measured.mode_shapes[rows_m]), np.real(computed.mode_shapes[rows_c])
    found = []
    for pairs in paired_clusters(measured, computed, pairing, weighting.frequency_deviation):
        own, wanted = model[:, pairing.computed[pairs]], test[:, pairing.measured[pairs]]
        near = with_neighbours(computed.frequencies_hz, pairing.computed[pairs])
        # A solver's sign means nothing.
        signs = np.where(np.sum(own * wanted, axis=0) < 0.0, -1.0, 1.0)
        scales = signs / np.sqrt(np.mean(np.sum(own**2, axis=0)))
        found.append(_Cluster(pairs, _space(wanted), _space(model[:, near]), scales, scales * own))
    return found


def _space(shapes: Floats) -> Floats:
    """An orthonormal basis (n_sensors, k) of the space of shapes of any scale."""
    lengths = np.linalg.norm(shapes, axis=0)
    left, values, _ = np.linalg.svd(
        shapes / np.where(lengths > 0.0, lengths, 1.0), full_matrices=False
    )
    return np.asarray(left[:, values > UNSEEN * values[0]])


def _unsplit(
    measured: ModeSet, computed: ModeSet, pairing: Pairing, weighting: Weighting
) -> list[Integers]:
    """Pairs whose frequencies neither side splits: only their mean has a slope."""
    test_hz = measured.frequencies_hz[pairing.measured]
    model_hz = computed.frequencies_hz[pairing.computed]
    return [
        alike[members]
        for alike in close_sets(test_hz, weighting.frequency_deviation)
        for members in close_sets(model_hz[alike], 0.5 * REPEATED)
        if members.size > 1
    ]
