"""Modal damping ratios: z = zeta_m - zeta_c of each pair, zeta_c by the quadratic problem.

Values and exact derivatives are those of `core/algebra/damped_modes`, from the real modes of K and
M; a mode is the damped one that its real mode becomes (`DampedPairs`, with what changes them).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from modetune.core.algebra.damped_modes import (
    ALIKE,
    Complexes,
    DampedModes,
    DampedSystem,
    damped_modes,
    ratio_slope,
)
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


@dataclass(frozen=True, slots=True)
class DampingRatios:
    """Modal damping ratios of the pairs.

    weights: by number of the test's modes, 0 of those whose ratio is not above 0; deviation,
    tolerance: of the measured ratio. covariance: (n_modes, n_modes), of the test's mean ratios;
    (0, 0) where the deviation counts.
    """

    weights: Mapping[int, float]
    deviation: float
    tolerance: float
    pairs: DampedPairs
    covariance: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    kind: ClassVar[str] = "damping"
    needs: ClassVar[frozenset[Need]] = frozenset({"matrices", "losses"})

    def residual(self, state: ModelState) -> Residual:
        pairs = state.pairing.measured
        measured = state.test.modes.damping_ratios[pairs]
        return residual_of(
            self.kind,
            [f"damping of mode {number}" for number in state.numbers],
            None,
            measured - self.pairs.of(state).modes.damping_ratios,
            np.array([self.weights[number] for number in state.numbers]),
            self.covariance[np.ix_(pairs, pairs)]
            if self.covariance.size
            else (self.deviation * np.where(measured > 0.0, measured, 1.0)) ** 2,
            measured=measured,
        )

    def sensitivity(self, state: ModelState, derivatives: StateDerivatives) -> Floats:
        solved = self.pairs.of(state)
        roots, columns = solved.modes.roots, list(derivatives.columns)
        slopes = np.array(
            [
                [ratio_slope(root, change) for change in changes]
                for root, changes in zip(roots, solved.slopes[:, columns], strict=True)
            ]
        ).reshape(-1, len(columns))
        for root in roots:  # of repeated ones only the mean has derivatives of its own
            alike = np.abs(roots - root) <= ALIKE * abs(root)
            slopes[alike] = slopes[alike].mean(axis=0)
        return slopes

    def agrees(self, part: Residual) -> bool:
        within = np.abs(part.values) <= self.tolerance * part.blocks[0].measured
        return bool(within[part.weights > 0.0].all())


#: Modes beside those of the pairs that the first guess is made of.
MORE_MODES = 4


@dataclass(frozen=True, slots=True)
class SolvedPairs:
    """modes: of the pairs, in their order; changes: of the matrices, by parameter; slopes: of the
    roots, (n_pairs, n_parameters)."""

    modes: DampedModes
    system: DampedSystem
    changes: tuple[DampedSystem, ...]
    slopes: Complexes


@dataclass(frozen=True, slots=True)
class DampedPairs:
    """Solves for the damped modes of the pairs.

    The real modes are solved for once more at each set, since those of the pairs are known at the
    sensors alone. damping: what damps a model with matrices of these equations.
    """

    damping: Callable[[MatrixResult], DampingModel]
    #: Of the newest set, as values and derivatives are asked for one after the other.
    _newest: list[tuple[MatricesAt, Integers, SolvedPairs]] = field(
        default_factory=list, repr=False, compare=False
    )

    def of(self, state: ModelState) -> SolvedPairs:
        """Raises ModesError."""
        given, modal = state.matrices, state.modal
        if given is None or modal is None:
            raise ModesError("damping requires the matrices of the model")
        wanted = state.pairing.computed + modal.n_rigid
        for known, pairs, found in self._newest:
            if (
                known.model is given.model
                and np.array_equal(known.theta, given.theta)
                and np.array_equal(pairs, wanted)
            ):
                return found
        self._newest[:] = [(given, wanted, self._solved(state, given, wanted))]
        return self._newest[0][2]

    def _solved(self, state: ModelState, given: MatricesAt, wanted: Integers) -> SolvedPairs:
        here = given.here
        n_modes = min(int(wanted.max()) + 1 + MORE_MODES, here.nodes.size)
        real = ModeSolver().solve(here.upper_stiffness, here.upper_mass, n_modes)
        model = self.damping(given.model.base)
        system = model.system(given.model, given.theta, given.groups)
        test = state.test.modes.select(state.pairing.measured)
        ratios = np.clip(test.damping_ratios, 0.0, 1.0) if test.damping_ratios.size else 0.0
        like = 2.0 * np.pi * test.frequencies_hz * (1j * np.sqrt(1.0 - ratios**2) - ratios)
        modes = damped_modes(system, real.shapes, wanted, like)
        changes = tuple(
            model.change(given.model, given.theta, column, given.groups)
            for column in range(given.theta.size)
        )
        slopes = [
            [system.slope(root, modes.shapes[:, row], change) for change in changes]
            for row, root in enumerate(modes.roots)
        ]
        return SolvedPairs(modes, system, changes, np.array(slopes).reshape(-1, len(changes)))
