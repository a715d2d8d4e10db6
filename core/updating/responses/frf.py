"""Response functions as measured: z = log(H_m / H_c) at chosen frequencies, (real, imaginary).

The real part is the logarithm of the ratio of amplitudes, the imaginary one the difference of
phases in (-pi, pi]. Values and exact derivatives, d log H_c = dH_c / H_c, are those of
`core/updating/superposition`. Modes have the damping of the test's that they are paired with.

Of each part the variance is that of log H by the measurement (`core/measurement/frf_lines`) with
the square of `deviation`, for what the model's damping lacks. A line that a resonance of the model
still has to pass errs by a bounded z, as logarithms do, and keeps its variance: were it to count
less, moving a resonance away from it would pay.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from scipy import sparse

from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import ModesError
from modetune.core.measurement.frf import Complexes, frac
from modetune.core.modes import Floats, Integers
from modetune.core.updating.responses.response import (
    MatricesAt,
    ModelState,
    Need,
    Residual,
    StateDerivatives,
    residual_of,
)
from modetune.core.updating.superposition import FrfModes


@dataclass(frozen=True, slots=True)
class FrfCurve:
    """A response function at its chosen frequencies.

    name: what people call it; output, force: rows of the degrees of freedom; frequencies_hz:
    (n_lines,); receptances: (n_lines,), in the deck's units; variances: (n_lines,), of log H by the
    measurement, of amplitude and of phase each.
    """

    name: str
    output: int
    force: int
    frequencies_hz: Floats
    receptances: Complexes
    variances: Floats


@dataclass(frozen=True, slots=True)
class Frf:
    """Response functions of a test.

    observe: degrees of freedom in terms of the matrices' equations, (n_dofs, n_equations).
    damping: ratio of all modes; NaN where those of the test count, and of others their median.
    frac: the least that e1 allows.
    """

    curves: tuple[FrfCurve, ...]
    observe: Callable[[MatrixResult], sparse.csr_array]
    damping: float
    deviation: float
    weight: float
    frac: float
    kind: ClassVar[str] = "frf"
    needs: ClassVar[frozenset[Need]] = frozenset({"matrices"})
    #: Of the newest set, as values and derivatives are asked for one after the other.
    _newest: list[tuple[MatricesAt, Integers, FrfModes]] = field(
        default_factory=list, repr=False, compare=False
    )

    def residual(self, state: ModelState) -> Residual:
        modes = self._modes(state)
        ratios = [np.log(c.receptances / _computed(modes, c)) for c in self.curves]
        sizes = np.array([2 * ratio.size for ratio in ratios])
        noise = [np.tile(c.variances + self.deviation**2, 2) for c in self.curves]
        return residual_of(
            self.kind,
            [curve.name for curve in self.curves],
            sizes,
            np.concatenate([_parts(ratio) for ratio in ratios]),
            np.full(int(sizes.sum()), self.weight),
            np.concatenate(noise),
        )

    def sensitivity(self, state: ModelState, derivatives: StateDerivatives) -> Floats:
        modes, given = self._modes(state), state.matrices
        assert given is not None
        rows = np.zeros((sum(2 * c.variances.size for c in self.curves), len(derivatives.columns)))
        computed = [_computed(modes, curve) for curve in self.curves]
        for place, column in enumerate(derivatives.columns):
            change = modes.change(*given.change(column))
            rows[:, place] = np.concatenate(
                [
                    _parts(modes.slope(_omega(c), c.output, c.force, change) / own)
                    for c, own in zip(self.curves, computed, strict=True)
                ]
            )
        return rows

    def agrees(self, part: Residual) -> bool:
        return bool((self.fracs(part) >= self.frac).all()) or not part.weights.any()

    def fracs(self, part: Residual) -> Floats:
        """FRAC of each function at its chosen frequencies, (n_curves,)."""
        found = np.zeros(len(self.curves))
        split = np.split(part.values, np.cumsum(part.blocks[0].sizes)[:-1])
        for row, (curve, values) in enumerate(zip(self.curves, split, strict=True)):
            real, imaginary = np.split(values, 2)
            computed = curve.receptances * np.exp(-real - 1j * imaginary)
            found[row] = frac(curve.receptances[:, None, None], computed[:, None, None]).item()
        return found

    def _modes(self, state: ModelState) -> FrfModes:
        given = state.matrices
        if given is None:
            raise ModesError("response functions need the matrices of the model")
        n_rigid = 0 if state.modal is None else state.modal.n_rigid
        paired = state.pairing.computed + n_rigid
        for known, pairs, modes in self._newest:
            if (
                known.model is given.model
                and np.array_equal(known.theta, given.theta)
                and np.array_equal(pairs, paired)
            ):
                return modes
        here = given.here
        highest = max(float(curve.frequencies_hz.max()) for curve in self.curves)
        modes = FrfModes.of(here, self.observe(here), highest, int(paired.max(initial=-1)) + 1)
        if np.isnan(self.damping):
            measured = state.test.modes.damping_ratios
            ratios = np.full(modes.tau.size, np.median(measured))
            ratios[paired] = measured[state.pairing.measured]
        else:
            ratios = np.full(modes.tau.size, self.damping)
        self._newest[:] = [(given, paired, modes.damped(ratios))]
        return self._newest[0][2]


def _omega(curve: FrfCurve) -> Floats:
    return 2.0 * np.pi * curve.frequencies_hz


def _computed(modes: FrfModes, curve: FrfCurve) -> Complexes:
    """H of a curve. Raises ModesError where the model does not answer."""
    values = modes.receptance(_omega(curve), curve.output, curve.force)
    if not (np.abs(values) > 0.0).all():
        raise ModesError(f"{curve.name}: the model does not answer to this force there")
    return values


def _parts(values: Complexes) -> Floats:
    return np.concatenate([values.real, values.imag])
