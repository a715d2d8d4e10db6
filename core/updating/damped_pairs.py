"""The damped modes of a model that the pairs' real modes become, with what changes them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from modetune.core.algebra.damped_modes import Complexes, DampedModes, DampedSystem, damped_modes
from modetune.core.algebra.eigen import ModeSolver
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import ModesError
from modetune.core.modes import Integers
from modetune.core.updating.damping_model import DampingModel
from modetune.core.updating.responses.response import MatricesAt, ModelState

#: Number of modes in the first guess, in addition to those of the pairs.
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
