"""Static displacements and strains under load cases: z = y_m - y_c, by K(theta) u = f.

Values and exact derivatives are those of `core/updating/static`. Stiffness alone decides them, so
beside frequencies they tell stiffness from mass.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import ModesError
from modetune.core.modes import Floats, Integers
from modetune.core.updating.observation import Observation
from modetune.core.updating.responses.response import (
    MatricesAt,
    ModelState,
    Need,
    Residual,
    StateDerivatives,
    residual_of,
)
from modetune.core.updating.static import LoadCase, Reading, StaticModel


@dataclass(frozen=True, slots=True)
class Static:
    """What was measured under the load cases of a test.

    observe: degrees of freedom in terms of the matrices' equations.
    """

    readings: tuple[Reading, ...]
    loads: tuple[LoadCase, ...]
    observe: Callable[[MatrixResult, Integers, Integers], Observation]
    kind: ClassVar[str] = "static"
    needs: ClassVar[frozenset[Need]] = frozenset({"matrices"})
    #: Of the newest set, as values and derivatives are asked for one after the other.
    _newest: list[tuple[MatricesAt, Floats, Floats]] = field(
        default_factory=list, repr=False, compare=False
    )

    def residual(self, state: ModelState) -> Residual:
        measured: Floats = np.array([item.value for item in self.readings])
        deviations: Floats = np.array([item.deviation for item in self.readings])
        weights: Floats = np.array([item.weight for item in self.readings])
        values = measured - self._solved(state)[0]
        names = [item.name for item in self.readings]
        return residual_of(
            self.kind, names, None, values, weights, deviations**2, measured=measured
        )

    def sensitivity(self, state: ModelState, derivatives: StateDerivatives) -> Floats:
        return np.asarray(self._solved(state)[1][:, list(derivatives.columns)])

    def agrees(self, part: Residual) -> bool:
        tolerances = np.array([item.tolerance for item in self.readings])
        used = part.weights > 0.0
        return bool((np.abs(part.values) <= tolerances)[used].all())

    def _solved(self, state: ModelState) -> tuple[Floats, Floats]:
        given = state.matrices
        if given is None:
            raise ModesError("static displacements need stiffness matrices")
        for known, values, slopes in self._newest:
            if known.model is given.model and np.array_equal(known.theta, given.theta):
                return values, slopes
        model = StaticModel.of(given.model.base, self.observe, self.loads, self.readings)
        self._newest[:] = [(given, *model.values(given.model, given.theta))]
        return self._newest[0][1:]
