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

Where sensors have weights of their own, both shapes are scaled by them first (`weighting`), and
unit length and MAC are those of the scaled shapes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modetune.core.correlation.clusters import paired_clusters, with_neighbours
from modetune.core.correlation.pairing import FINE, UNSEEN, Pairing
from modetune.core.modes import REPEATED, Floats, Integers, ModeSet, close_sets, common_dofs
from modetune.core.updating.results import ModeDerivatives
from modetune.core.updating.weighting import Weighting


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

    def of_used_frequencies(self, values: Floats) -> Floats:
        """What is there of the frequencies that have a weight; values: (n_frequencies,)."""
        return values[self.weights[: self.n_frequencies] > 0.0]


def residual(
    measured: ModeSet, computed: ModeSet, pairing: Pairing, weighting: Weighting
) -> Residual:
    """The residual of paired modes; shapes take part where one of them has a weight above zero."""
    own = weighting.modes(pairing.measured)
    lam_m = measured.eigenvalues[pairing.measured]
    values = [(lam_m - computed.eigenvalues[pairing.computed]) / lam_m]
    emphasis, unknown = [own.frequency_weights], [np.zeros(lam_m.size)]
    if weighting.with_shapes:
        sensors, _ = common_dofs(measured, computed)
        _, shares = weighting.sensor_scales(sensors)
        shapes = np.zeros((lam_m.size, sensors.size))
        spread = np.zeros_like(shapes)
        for cluster in _clusters(measured, computed, pairing, weighting):
            away = cluster.model - cluster.test @ (cluster.test.T @ cluster.model)
            shapes[cluster.pairs] = -away.T
            spread[cluster.pairs] = (float(np.sum(away**2)) / cluster.pairs.size) ** 2 * shares
        values.append(shapes.ravel())
        unknown.append(spread.ravel())
        emphasis.append(np.outer(own.shape_weights, weighting.sensor_weights[sensors]).ravel())
    known = measurement_variances(measured, computed, pairing, weighting)
    variances = known + np.concatenate(unknown)
    return Residual(
        values=np.concatenate(values),
        weights=np.concatenate(emphasis) / variances,
        variances=variances,
        n_frequencies=lam_m.size,
    )


def measurement_variances(
    measured: ModeSet, computed: ModeSet, pairing: Pairing, weighting: Weighting
) -> Floats:
    """Variances of the residual's values by the measurement alone, (n_residuals,)."""
    own = weighting.modes(pairing.measured)
    frequencies = (2.0 * own.frequency_deviations) ** 2
    if not weighting.with_shapes:
        return frequencies
    _, shares = weighting.sensor_scales(common_dofs(measured, computed)[0])
    return np.concatenate([frequencies, np.outer(own.shape_deviations**2, shares).ravel()])


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
    slopes = frequency_sensitivity(measured, computed, pairing, weighting, derivatives.eigenvalues)
    if not weighting.with_shapes:
        return slopes
    _, sensors = common_dofs(measured, computed)
    changes = derivatives.mode_shapes[sensors]
    rows = np.zeros((len(slopes), sensors.size, slopes.shape[1]))
    for cluster in _clusters(measured, computed, pairing, weighting):
        change = changes[:, cluster.pairs] * cluster.scales[:, :, None]
        for space in (cluster.space, cluster.test):
            change = change - np.tensordot(space, np.tensordot(space.T, change, axes=1), axes=1)
        rows[cluster.pairs] = change.transpose(1, 0, 2)
    return np.concatenate([slopes, rows.reshape(-1, slopes.shape[1])])


def frequency_sensitivity(
    measured: ModeSet,
    computed: ModeSet,
    pairing: Pairing,
    weighting: Weighting,
    eigenvalues: Floats,
) -> Floats:
    """The rows of frequencies alone, (n_pairs, n_parameters); eigenvalues: their derivatives."""
    slopes = eigenvalues / measured.eigenvalues[pairing.measured][:, None]
    for alike in _unsplit(measured, computed, pairing, weighting):
        slopes[alike] = slopes[alike].mean(axis=0)
    return np.asarray(slopes)


@dataclass(frozen=True, slots=True)
class _Cluster:
    """Shapes of the pairs of one cluster at the common sensors, scaled by their weights.

    pairs: (n,), positions; test, space: (n_sensors, k), orthonormal, of the measured shapes and of
    the model's with all that are close to them; model: (n_sensors, n), the model's shapes in the
    measured sign, of unit root mean square length; scales: (n_sensors, n), what they were
    multiplied by for that.
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
    sensors = weighting.sensor_scales(rows_m)[0][:, None]
    test = sensors * np.real(measured.mode_shapes[rows_m])
    model = sensors * np.real(computed.mode_shapes[rows_c])
    found = []
    for pairs in paired_clusters(measured, computed, pairing, weighting.frequency_deviations):
        own, wanted = model[:, pairing.computed[pairs]], test[:, pairing.measured[pairs]]
        near = with_neighbours(computed.frequencies_hz, pairing.computed[pairs])
        # A solver's sign means nothing.
        signs = np.where(np.sum(own * wanted, axis=0) < 0.0, -1.0, 1.0)
        factors = signs / np.sqrt(np.mean(np.sum(own**2, axis=0)))
        spaces = _space(wanted), _space(model[:, near])
        found.append(_Cluster(pairs, *spaces, sensors * factors, factors * own))
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
        for alike in close_sets(test_hz, FINE * weighting.frequency_deviations[pairing.measured])
        for members in close_sets(model_hz[alike], 0.5 * REPEATED)
        if members.size > 1
    ]
