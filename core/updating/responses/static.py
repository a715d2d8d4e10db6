"""Static displacements and strains under load cases: z = y_m - y_c, by K(theta) u = f.

Values and exact derivatives come from `core/updating/static_model`. Under forces and pressure they
depend only on stiffness, so together with frequencies they separate stiffness from mass. Forces of
a deck that follow its masses are read from it at each point; they are sums of products of few of
its numbers (density, thickness), for which central differences are exact up to squares.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import ModesError
from modetune.core.mesh import Mesh
from modetune.core.modes import Floats
from modetune.core.updating.responses.response import (
    MatricesAt,
    ModelState,
    Need,
    Residual,
    StateDerivatives,
    residual_of,
)
from modetune.core.updating.rigid_motions import Observe
from modetune.core.updating.static_model import LoadCase, Reading, StaticModel

#: Relative step of the differences: their error is its square for a cubic, 1e-12 by rounding.
STEP = 1e-3


@dataclass(frozen=True, slots=True)
class Static:
    """The measured values under the load cases of a test.

    loads: returns the load cases at values of the case's parameters. observe: returns degrees of
    freedom in terms of the matrices' equations.
    """

    readings: tuple[Reading, ...]
    loads: Callable[[Floats], Sequence[LoadCase]]
    observe: Observe
    kind: ClassVar[str] = "static"
    needs: ClassVar[frozenset[Need]] = frozenset({"matrices"})
    #: The latest result, since values and derivatives are requested one after the other.
    _newest: list[tuple[MatricesAt, Floats, Floats]] = field(
        default_factory=list, repr=False, compare=False
    )
    #: Loads and readings in terms of these equations, where no load follows the parameters.
    _fixed: list[tuple[MatrixResult, StaticModel]] = field(
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
        model, changes = self._model(given, state.mesh)
        self._newest[:] = [(given, *model.values(given.model, given.theta, changes))]
        return self._newest[0][1:]

    def _model(self, given: MatricesAt, mesh: Mesh | None) -> tuple[StaticModel, dict[int, Floats]]:
        """The model at a set, and the derivatives of its forces by column."""
        base = given.model.base
        for known, model in self._fixed:
            if known is base:
                return model, {}
        loads = self.loads(given.theta)
        model = StaticModel.of(base, self.observe, loads, self.readings, mesh)
        if any(load.by_mass for load in loads):
            return model, self._changes(given)
        self._fixed[:] = [(base, model)]
        return model, {}

    def _changes(self, given: MatricesAt) -> dict[int, Floats]:
        """Derivatives of the forces (n_equations, n_loads) by each parameter that moves masses."""
        found = {}
        for column in range(given.theta.size):
            if given.change(column)[1].nnz:
                ends = []
                for sign in (1.0, -1.0):
                    theta = given.theta.copy()
                    theta[column] += sign * STEP * theta[column]
                    loads = self.loads(theta)
                    ends.append(
                        [load.on_equations(given.model.base, self.observe) for load in loads]
                    )
                forces = (np.column_stack(end) for end in ends)
                found[column] = (next(forces) - next(forces)) / (2.0 * STEP * given.theta[column])
        return found
