"""Shapes at the common sensors: how far each pair's model shape is from the space of the test's.

Both shapes are brought to unit length (the modal scale factor of two unit shapes is the cosine
between them), and z = cos * u_m - u_c, in the measured sign. Its squared length is 1 - MAC,
whatever the scaling of either side. With d u_c = (I - u_c u_c^T) d phi / |phi| the exact
sensitivity of u_c - cos * u_m is (I - u_m u_m^T) d u_c.

Modes of a cluster are compared as one (`core/correlation/clusters`): u_m u_m^T becomes the
projector on the space of their measured shapes, u_c u_c^T that on the space of the model's, and a
unit shape one of the cluster's root mean square length; so no rotation inside it changes the
squared length of z.

A shape deviation s relative to the shape's root mean square is s / sqrt(n) for an entry of a unit
shape with n entries. The error of the linear model of the shape is added: it is of second order in
the shape's difference, whose square is 1 - MAC, so a shape far from the test (modes that mix) has
little weight until it is near:

    variance of an entry = (s^2 + (1 - MAC)^2) / n.

Where sensors have weights, both shapes are scaled by them first (`weighting`), and unit length and
MAC are those of the scaled shapes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from modetune.core.correlation.clusters import paired_clusters
from modetune.core.correlation.pairing import UNSEEN
from modetune.core.modes import CLOSE, Floats, Integers, close_labels, common_dofs
from modetune.core.updating.responses.response import (
    ModelState,
    Need,
    Residual,
    StateDerivatives,
    residual_of,
)


@dataclass(frozen=True, slots=True)
class Shapes:
    """Differences of paired shapes; tolerance: e1's minimum MAC."""

    tolerance: float = 0.0
    kind: ClassVar[str] = "shapes"
    needs: ClassVar[frozenset[Need]] = frozenset({"shapes"})

    def residual(self, state: ModelState) -> Residual:
        measured = state.pairing.measured
        own = state.weighting.modes(measured)
        sensors, _ = common_dofs(state.test.modes, state.seen)
        _, shares = state.weighting.sensor_scales(sensors)
        shapes = np.zeros((measured.size, sensors.size))
        spread = np.zeros_like(shapes)
        for cluster in clusters(state):
            away = cluster.away
            shapes[cluster.pairs] = -away.T
            spread[cluster.pairs] = (float(np.sum(away**2)) / cluster.pairs.size) ** 2 * shares
        return residual_of(
            self.kind,
            [f"shape of mode {number}" for number in state.numbers],
            np.full(measured.size, sensors.size),
            shapes.ravel(),
            np.outer(own.shape_weights, state.weighting.sensor_weights[sensors]).ravel(),
            np.outer(own.shape_deviations**2, shares).ravel(),
            unknown=spread.ravel(),
            scaled=True,
        )

    def sensitivity(self, state: ModelState, derivatives: StateDerivatives) -> Floats:
        _, sensors = common_dofs(state.test.modes, state.seen)
        changes = derivatives.modes.mode_shapes[sensors]
        rows = np.zeros((state.pairing.measured.size, sensors.size, changes.shape[2]))
        for cluster in clusters(state):
            rows[cluster.pairs] = cluster.change(changes).transpose(1, 0, 2)
        return rows.reshape(-1, changes.shape[2])

    def agrees(self, part: Residual) -> bool:
        shapes = np.split(part.values, np.cumsum(part.blocks[0].sizes)[:-1])
        mac = np.array([1.0 - float((shape**2).sum()) for shape in shapes])
        return bool((mac >= self.tolerance).all())


@dataclass(frozen=True, slots=True)
class PairedCluster:
    """Shapes of the pairs of one cluster at the common sensors, scaled by their weights.

    pairs: (n,), positions. test, space: (n_sensors, k), orthonormal bases of the measured shapes
    and of the model's shapes with their close neighbours. model: (n_sensors, n), the model's shapes
    in the measured sign, of unit root mean square length. scales: (n_sensors, n), the factors that
    give them this length.
    """

    pairs: Integers
    test: Floats
    space: Floats
    scales: Floats
    model: Floats

    @property
    def away(self) -> Floats:
        """The part of the model's shapes outside the space of the test's, (n_sensors, n)."""
        return np.asarray(self.model - self.test @ (self.test.T @ self.model))

    def change(self, changes: Floats) -> Floats:
        """Return derivatives of `away`, (n_sensors, n, k); changes: of all pairs' shapes."""
        change = changes[:, self.pairs] * self.scales[:, :, None]
        flat = change.reshape(change.shape[0], -1)
        for space in (self.space, self.test):
            flat = flat - space @ (space.T @ flat)
        return np.asarray(flat.reshape(change.shape))


def clusters(state: ModelState) -> list[PairedCluster]:
    """Return the clusters of the pairs."""
    pairing, weighting = state.pairing, state.weighting
    rows_m, rows_c = common_dofs(state.test.modes, state.seen)
    sensors = weighting.sensor_scales(rows_m)[0][:, None]
    test = sensors * np.real(state.test.modes.mode_shapes[rows_m])
    model = sensors * np.real(state.seen.mode_shapes[rows_c])
    labels, found = close_labels(state.seen.frequencies_hz, CLOSE), []
    for pairs in paired_clusters(
        state.test.modes, state.seen, pairing, weighting.frequency_deviations
    ):
        own, wanted = model[:, pairing.computed[pairs]], test[:, pairing.measured[pairs]]
        near = (labels[:, None] == labels[pairing.computed[pairs]]).any(axis=1)
        # The sign of a solver's shape is arbitrary.
        signs = np.where(np.sum(own * wanted, axis=0) < 0.0, -1.0, 1.0)
        factors = signs / np.sqrt(np.mean(np.sum(own**2, axis=0)))
        spaces = _space(wanted), _space(model[:, near])
        found.append(PairedCluster(pairs, *spaces, sensors * factors, factors * own))
    return found


def _space(shapes: Floats) -> Floats:
    """Return an orthonormal basis (n_sensors, k) of shapes of any scale."""
    lengths = np.linalg.norm(shapes, axis=0)
    if lengths.size == 1:  # most clusters are of one mode
        return shapes / lengths if lengths[0] > 0.0 else shapes[:, :0]
    left, values, _ = np.linalg.svd(
        shapes / np.where(lengths > 0.0, lengths, 1.0), full_matrices=False
    )
    return np.asarray(left[:, values > UNSEEN * values[0]])
