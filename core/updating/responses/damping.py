"""Modal damping ratios: z = zeta_m - zeta_c of each pair, zeta_c by the quadratic problem.

Values and exact derivatives are those of `core/algebra/damped_modes`, from the real modes of K and
M; a mode is the damped one that its real mode becomes. The real modes are solved for once more at
each set, since those of the pairs are known at the sensors alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from modetune.core.algebra.damped_modes import ALIKE, damped_modes, ratio_slope
from modetune.core.algebra.eigen import ModeSolver
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import ModesError
from modetune.core.modes import Floats, Integers
from modetune.core.updating.damping import DampingModel
from modetune.core.updating.responses.response import (
    MatricesAt,
    ModelState,
    Need,
    Residual,
    StateDerivatives,
    residual_of,
)

#: Modes beside those of the pairs that the first guess is made of.
MORE_MODES = 4


@dataclass(frozen=True, slots=True)
class DampingRatios:
    """Modal damping ratios of the pairs.

    weights: by number of the test's modes, 0 of those whose ratio is not above 0; deviation,
    tolerance: of the measured ratio. damping: what damps a model with matrices of these equations.
    """

    weights: Mapping[int, float]
    deviation: float
    tolerance: float
    damping: Callable[[MatrixResult], DampingModel]
    kind: ClassVar[str] = "damping"
    needs: ClassVar[frozenset[Need]] = frozenset({"matrices", "losses"})
    #: Of the newest set, as values and derivatives are asked for one after the other.
    _newest: list[tuple[MatricesAt, Integers, Floats, Floats]] = field(
        default_factory=list, repr=False, compare=False
    )

    def residual(self, state: ModelState) -> Residual:
        pairs = state.pairing.measured
        measured = state.test.modes.damping_ratios[pairs]
        numbers = [state.test.numbers[place] for place in pairs.tolist()]
        return residual_of(
            self.kind,
            [f"damping of mode {number}" for number in numbers],
            None,
            measured - self._solved(state)[0],
            np.array([self.weights[number] for number in numbers]),
            (self.deviation * np.where(measured > 0.0, measured, 1.0)) ** 2,
            measured=measured,
        )

    def sensitivity(self, state: ModelState, derivatives: StateDerivatives) -> Floats:
        return np.asarray(self._solved(state)[1][:, list(derivatives.columns)])

    def agrees(self, part: Residual) -> bool:
        within = np.abs(part.values) <= self.tolerance * part.blocks[0].measured
        return bool(within[part.weights > 0.0].all())

    def _solved(self, state: ModelState) -> tuple[Floats, Floats]:
        """Ratios (n_pairs,) and their derivatives (n_pairs, n_parameters)."""
        given, modal = state.matrices, state.modal
        if given is None or modal is None:
            raise ModesError("damping ratios require the matrices of the model")
        wanted = state.pairing.computed + modal.n_rigid
        for known, pairs, ratios, slopes in self._newest:
            if (
                known.model is given.model
                and np.array_equal(known.theta, given.theta)
                and np.array_equal(pairs, wanted)
            ):
                return ratios, slopes
        here = given.here
        n_modes = min(int(wanted.max()) + 1 + MORE_MODES, here.nodes.size)
        real = ModeSolver().solve(here.upper_stiffness, here.upper_mass, n_modes)
        model = self.damping(given.model.base)
        system = model.system(given.model, given.theta, given.groups)
        modes = state.test.modes.select(state.pairing.measured)
        ratios = np.clip(modes.damping_ratios, 0.0, 1.0)
        like = 2.0 * np.pi * modes.frequencies_hz * (1j * np.sqrt(1.0 - ratios**2) - ratios)
        found = damped_modes(system, real.shapes, wanted, like)
        slopes = np.zeros((wanted.size, given.theta.size))
        for column in range(given.theta.size):
            change = model.change(given.model, given.theta, column, given.groups)
            for row, root in enumerate(found.roots):
                moved = system.slope(root, found.shapes[:, row], change)
                slopes[row, column] = ratio_slope(root, moved)
        for root in found.roots:  # of repeated ones only the mean has derivatives of its own
            alike = np.abs(found.roots - root) <= ALIKE * abs(root)
            slopes[alike] = slopes[alike].mean(axis=0)
        self._newest[:] = [(given, wanted, found.damping_ratios, slopes)]
        return found.damping_ratios, slopes
