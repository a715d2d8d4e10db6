"""Values that functions of the user compute from the modes, compared with measured ones.

A function gets the frequencies (n_modes,) and shapes (n_dof, n_modes) of all modes of the test, at
its sensors, each shape scaled to the measured one: with phi_m measured and phi computed,

    phi (phi_m . phi) / (phi . phi).

With df and dphi the derivatives of the modes by a parameter, the derivative of its values is the
central difference along them,

    (v(f + h df, phi + h dphi) - v(f - h df, phi - h dphi)) / 2h.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from modetune.core.errors import ModesError
from modetune.core.modes import Floats, Integers, common_dofs
from modetune.core.updating.responses.response import (
    ModelState,
    Need,
    Residual,
    StateDerivatives,
    residual_of,
)

#: Values from frequencies (n_modes,) and scaled shapes (n_dof, n_modes).
ValuesOfModes = Callable[[Floats, Floats], Floats]
#: Change of a parameter's relative value in a difference: its square is the relative error.
STEP = 1e-4
#: Largest error that e1 accepts, in deviations.
WITHIN = 2.0


@dataclass(frozen=True, slots=True)
class OwnValues:
    """Measured values (n,) with names, deviations and weights, and what computes them.

    with_shapes: whether the test has shapes. values: raises ModesError where a function fails.
    """

    names: tuple[str, ...]
    measured: Floats
    deviations: Floats
    weights: Floats
    values: ValuesOfModes
    with_shapes: bool
    kind: ClassVar[str] = "own"

    @property
    def needs(self) -> frozenset[Need]:
        return frozenset({"shapes"}) if self.with_shapes else frozenset()

    def residual(self, state: ModelState) -> Residual:
        order, rows = _order(state), _rows(state)
        hz, shapes = _modes(state, order, rows)
        return residual_of(
            self.kind,
            self.names,
            None,
            self.measured - self._of(state, order, rows, hz, shapes),
            self.weights,
            self.deviations**2,
            measured=self.measured,
        )

    def sensitivity(self, state: ModelState, derivatives: StateDerivatives) -> Floats:
        order, rows = _order(state), _rows(state)
        hz, shapes = _modes(state, order, rows)
        slopes = np.zeros((len(self.names), len(derivatives.columns)))
        for column in range(len(derivatives.columns)):
            turned = derivatives.modes.eigenvalues[order, column] / (8.0 * np.pi**2 * hz)
            moved = np.zeros(shapes.shape)
            if shapes.size:
                moved = derivatives.modes.mode_shapes[rows][:, order, column]
            ends = [
                self._of(state, order, rows, hz + h * turned, shapes + h * moved)
                for h in (STEP, -STEP)
            ]
            slopes[:, column] = (ends[0] - ends[1]) / (2.0 * STEP)
        return slopes

    def agrees(self, part: Residual) -> bool:
        z = part.of_used(self.kind, part.values)
        deviations = np.sqrt(part.of_used(self.kind, part.noise))
        return bool((np.abs(z) <= WITHIN * deviations).all())

    def _of(
        self, state: ModelState, order: Integers, rows: Integers, hz: Floats, shapes: Floats
    ) -> Floats:
        """Return the values at modes whose shapes are not scaled yet."""
        there, _ = common_dofs(state.test.modes, state.seen)
        test = np.real(state.test.modes.mode_shapes[there][:, state.pairing.measured[order]])
        squares = np.sum(shapes**2, axis=0)
        scales = np.sum(test * shapes, axis=0) / np.where(squares > 0.0, squares, 1.0)
        return self.values(hz, shapes * scales)


def _order(state: ModelState) -> Integers:
    """Return the pairs in the order of the test's modes. Raises ModesError where one is lost."""
    lost = np.setdiff1d(np.arange(len(state.test.numbers)), state.pairing.measured)
    if lost.size:
        raise ModesError(
            f"mode {state.test.numbers[lost[0]]} of the test has no partner, so own responses "
            "cannot be computed; leave the mode out"
        )
    return np.argsort(state.pairing.measured)


def _rows(state: ModelState) -> Integers:
    return common_dofs(state.test.modes, state.seen)[1]


def _modes(state: ModelState, order: Integers, rows: Integers) -> tuple[Floats, Floats]:
    """Return frequencies and shapes of the partners, in the order of the test's modes."""
    computed = state.pairing.computed[order]
    return state.seen.frequencies_hz[computed], np.real(state.seen.mode_shapes[rows][:, computed])
