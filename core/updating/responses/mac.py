"""MAC as a response: one number per pair, where the entries of shapes are too many.

With q = 1 - MAC of a pair at the common sensors (of a cluster of close modes the mean over its
pairs of what lies outside the space of the test's shapes, which no rotation changes):

* `root`: z = -sqrt(q), the sine of the angle between both shapes. It is about linear in parameters,
  so Gauss-Newton steps converge; the derivative, a^T da / |a| with a the part of the model's shape
  outside the test's, has no limit at a = 0, where it is taken to be zero.
* `one_minus_mac`: z = -q, derivative 2 a^T da.

A shape whose entries have the deviation s relative to its root mean square has by noise alone
sqrt(q) of about s and q of about s^2; these are the default deviations. As for shapes, a sine far
from zero is not linear in parameters, with an error of second order: q^2 is added to its variance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from modetune.core.modes import Floats, common_dofs
from modetune.core.updating.responses.response import (
    ModelState,
    Need,
    Residual,
    StateDerivatives,
    residual_of,
)
from modetune.core.updating.responses.shapes import clusters

MacQuantity = Literal["root", "one_minus_mac"]
#: An angle below which its direction is rounding of the shapes.
NO_ANGLE = 1e-9


@dataclass(frozen=True, slots=True)
class Mac:
    """MAC of the pairs.

    weights, deviations: by the number of the test's mode; without a deviation that of the shape is
    used. tolerance: e1's minimum MAC.
    """

    weights: Mapping[int, float]
    deviations: Mapping[int, float]
    quantity: MacQuantity = "root"
    tolerance: float = 0.0
    kind: ClassVar[str] = "mac"
    needs: ClassVar[frozenset[Need]] = frozenset({"shapes"})

    def residual(self, state: ModelState) -> Residual:
        measured = state.pairing.measured
        q = np.zeros(measured.size)
        for cluster in clusters(state):
            q[cluster.pairs] = np.sum(cluster.away**2) / cluster.pairs.size
        by_shape = state.weighting.shape_deviations[measured]
        if self.quantity == "one_minus_mac":
            by_shape = by_shape**2
        given = np.array([self.deviations.get(number, np.nan) for number in state.numbers])
        root = self.quantity == "root"
        return residual_of(
            self.kind,
            [f"MAC of mode {number}" for number in state.numbers],
            None,
            -np.sqrt(q) if root else -q,
            np.array([self.weights.get(number, 0.0) for number in state.numbers]),
            np.asarray(np.where(np.isfinite(given), given, by_shape) ** 2, dtype=np.float64),
            unknown=q**2 if root else None,
        )

    def sensitivity(self, state: ModelState, derivatives: StateDerivatives) -> Floats:
        _, sensors = common_dofs(state.test.modes, state.seen)
        changes = derivatives.modes.mode_shapes[sensors]
        found = np.zeros((state.pairing.measured.size, changes.shape[2]))
        for cluster in clusters(state):
            away = cluster.away
            slope = 2.0 * np.einsum("sm,smp->p", away, cluster.change(changes))
            slope /= cluster.pairs.size
            if self.quantity == "root":
                sine = float(np.sqrt(np.sum(away**2) / cluster.pairs.size))
                slope = slope / (2.0 * sine) if sine > NO_ANGLE else 0.0 * slope
            found[cluster.pairs] = slope
        return found

    def agrees(self, part: Residual) -> bool:
        used = part.of_used(self.kind, part.values)
        q = used**2 if self.quantity == "root" else -used
        return bool((1.0 - q >= self.tolerance).all())
