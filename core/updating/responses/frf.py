"""Response functions as measured: z = log(H_m / H_c) at chosen frequencies, (real, imaginary).

The real part is the logarithm of the ratio of amplitudes, the imaginary one the difference of
phases in (-pi, pi]. Values and exact derivatives, d log H_c = dH_c / H_c, are those of
`core/updating/frf_modes`. Dampers and loss factors of the model damp its modes; without them a
mode has the damping ratio of the test mode that it is paired with. Given ratios, which may be
parameters, replace those of the test, or are added to the dampers.

Each part has the variance of the measured log H (`core/measurement/response_functions`) and the
square of `deviation`, for the error of the model's damping. A line that a resonance of the model
still has to pass has a bounded z, as logarithms do, and keeps its variance: with a lower weight,
moving a resonance away from it would reduce the misfit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from operator import methodcaller
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from modetune.core.algebra.damped_modes import DampedSystem
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import ModesError
from modetune.core.measurement.response_functions import Complexes, frac
from modetune.core.modes import Floats, Integers
from modetune.core.updating.damping_model import DampingModel, Linear
from modetune.core.updating.frf_modes import REACH, FrfLines, FrfModes, near
from modetune.core.updating.responses.response import (
    MatricesAt,
    ModelState,
    Need,
    Residual,
    StateDerivatives,
    residual_of,
)

#: Returns the damping of a model with matrices of these equations.
Dampers = Callable[[MatrixResult], DampingModel]


@dataclass(frozen=True, slots=True)
class FrfCurve:
    """A response function at its chosen frequencies.

    name: for people. output, force: rows of the degrees of freedom. frequencies_hz: (n_lines,).
    receptances: (n_lines,), in the deck's units. variances: (n_lines,), of log H by the
    measurement, both of amplitude and of phase.
    """

    name: str
    output: int
    force: int
    frequencies_hz: Floats
    receptances: Complexes
    variances: Floats


@dataclass(frozen=True, slots=True)
class DampedMatrices:
    """The matrices at parameter values, and the damping of their model, None where it has none."""

    given: MatricesAt
    dampers: DampingModel | None

    @property
    def system(self) -> DampedSystem | None:
        """All of them; None without dampers."""
        at = self.given
        return self.dampers.system(at.model, at.theta, at.groups) if self.dampers else None

    def changes(
        self, column: int
    ) -> tuple[sparse.csr_array, sparse.csr_array, DampedSystem | None]:
        """Upper triangles of dK and dM of a parameter, and the change of dampers."""
        at, dampers = self.given, self.dampers
        damped = dampers.change(at.model, at.theta, column, at.groups) if dampers else None
        return *at.change(column), damped

    def near(self, modes: FrfModes, highest_hz: float) -> tuple[DampedMatrices, Floats]:
        """As `superposition.near`."""
        model, vectors = near(self.given.model, self.given.theta, modes, highest_hz)
        groups = self.given.groups.on(vectors) if self.given.groups else None
        dampers = self.dampers.on(vectors) if self.dampers else None
        return DampedMatrices(replace(self.given, model=model, groups=groups), dampers), vectors


@dataclass(slots=True)
class KnownFrfModes:
    """The latest results, since values and derivatives are requested one after the other.

    full: modes of the latest point that was solved in full. few: near such a point, a model of few
    unknowns and the rows of sensors and forces on them.
    """

    full: tuple[DampedMatrices, FrfModes] | None = None
    few: tuple[MatricesAt, DampedMatrices, Floats] | None = None

    def at(
        self,
        given: MatricesAt,
        observe: Callable[[MatrixResult], sparse.csr_array],
        dampers: Dampers | None,
        highest_hz: float,
        n_least: int,
    ) -> tuple[FrfModes, DampedMatrices]:
        """Return modes without damping ratios, and their matrices."""
        around = given if given.around is None else replace(given, theta=given.around, around=None)
        if self.full is None or not self.full[0].given.same(around):
            like = self.full[1] if self.full and self.full[0].given.model is given.model else None
            here = around.here
            whole = DampedMatrices(around, dampers(around.model.base) if dampers else None)
            found = FrfModes.of(here, observe(here), highest_hz, n_least, like, whole.system)
            self.full = whole, found
        whole, modes = self.full
        if given.around is None:
            return modes, whole
        if self.few is None or not self.few[0].same(around):
            small, vectors = whole.near(modes, highest_hz)
            self.few = around, small, np.asarray(observe(around.model.base) @ vectors)
        _, small, dofs = self.few
        own = replace(small, given=replace(small.given, theta=given.theta))
        stiffness, mass = (a.toarray() for a in (own.given.here.stiffness, own.given.here.mass))
        return FrfModes.whole(stiffness, mass, dofs, modes.shift).among(own.system), own


@dataclass(frozen=True, slots=True)
class Frf:
    """Response functions of a test.

    observe: returns the degrees of freedom in terms of the matrices' equations, (n_dofs,
    n_equations). damping: ratios by the number of the test's mode. others: ratio of all other
    modes; where None those of the test, and their median for modes without a partner. frac: the
    minimum that e1 allows. dampers: None where the model has none; with dampers the ratios of the
    test have no effect.
    """

    curves: tuple[FrfCurve, ...]
    observe: Callable[[MatrixResult], sparse.csr_array]
    damping: Mapping[int, Linear]
    others: Linear | None
    deviation: float
    weight: float
    frac: float
    dampers: Dampers | None = None
    kind: ClassVar[str] = "frf"
    _known: KnownFrfModes = field(default_factory=KnownFrfModes, repr=False, compare=False)

    @property
    def needs(self) -> frozenset[Need]:
        return frozenset({"matrices"} if self.dampers is None else {"matrices", "losses"})

    def residual(self, state: ModelState) -> Residual:
        lines = self._modes(state)[0].lines(*self._lines)
        ratios = np.log(self._each("receptances") / self._computed(lines))
        variances = self._each("variances") + self.deviation**2
        values = self._parts(ratios)
        return residual_of(
            self.kind,
            [curve.name for curve in self.curves],
            np.array([2 * curve.receptances.size for curve in self.curves]),
            values,
            np.full(values.size, self.weight),
            self._parts(variances + 1j * variances),
            measured=self._parts(np.log(self._each("receptances"))),
        )

    def sensitivity(self, state: ModelState, derivatives: StateDerivatives) -> Floats:
        modes, matrices = self._modes(state)
        lines = modes.lines(*self._lines)
        computed = self._computed(lines)
        rows = []
        for column in derivatives.columns:
            change = modes.change(*matrices.changes(column))
            slope = lines.slope(change)
            slopes = methodcaller("change", matrices.given.theta, column)
            damping = self._of_modes(state, modes, slopes, 0.0)
            if damping.any():
                slope += lines.slope_by_damping(damping)
            rows.append(self._parts(slope / computed))
        return np.reshape(rows, (len(rows), -1)).T

    @property
    def _lines(self) -> tuple[Floats, Integers, Integers]:
        """Circular frequency, sensor and force of each line of all functions, (n_lines,)."""
        sizes = [curve.frequencies_hz.size for curve in self.curves]
        outputs, forces = (
            np.repeat([getattr(curve, name) for curve in self.curves], sizes)
            for name in ("output", "force")
        )
        return 2.0 * np.pi * self._each("frequencies_hz"), outputs, forces

    def _each(self, name: str) -> NDArray[Any]:
        return np.concatenate([getattr(curve, name) for curve in self.curves])

    def _computed(self, lines: FrfLines) -> Complexes:
        """Return H at all lines. Raises ModesError where the model does not respond."""
        values = lines.receptance
        still = np.flatnonzero(values == 0.0)
        if still.size:
            place = np.cumsum([curve.frequencies_hz.size for curve in self.curves])
            name = self.curves[int(np.searchsorted(place, still[0], side="right"))].name
            raise ModesError(f"{name}: the model does not answer to this force there")
        return values

    def _parts(self, values: Complexes) -> Floats:
        """Return for each function the real parts, then the imaginary ones."""
        ends = np.cumsum([curve.frequencies_hz.size for curve in self.curves])[:-1]
        parts = [part for own in np.split(values, ends) for part in (own.real, own.imag)]
        return np.concatenate(parts)

    def agrees(self, part: Residual) -> bool:
        return bool((fracs(part) >= self.frac).all()) or not part.weights.any()

    def _modes(self, state: ModelState) -> tuple[FrfModes, DampedMatrices]:
        """Return modes with their damping, and their matrices."""
        given = state.matrices
        if given is None:
            raise ModesError("response functions need the matrices of the model")
        n_rigid = 0 if state.modal is None else state.modal.n_rigid
        paired = state.pairing.computed + n_rigid
        highest = max(float(curve.frequencies_hz.max()) for curve in self.curves)
        asked = int(paired.max(initial=-1)) + 1
        if state.modal is not None:  # as many as reach beyond the band
            beyond = (2.0 * np.pi * REACH * highest) ** 2
            asked = max(asked, int(np.searchsorted(state.modal.eigenvalues, beyond)) + 1)
        modes, matrices = self._known.at(given, self.observe, self.dampers, highest, asked)
        measured = state.test.modes.damping_ratios
        told = measured if measured.size and self.dampers is None else 0.0
        ratios = self._of_modes(state, modes, methodcaller("at", given.theta), told)
        return modes.damped(ratios), matrices

    def _of_modes(
        self,
        state: ModelState,
        modes: FrfModes,
        number: Callable[[Linear], float],
        told: Floats | float,
    ) -> Floats:
        """Return a number for the damping ratio of each mode, (n_modes,).

        number: of a given ratio; told: of the ratios of the test."""
        of_test = np.full(len(state.test.numbers), told)
        rest = float(np.median(of_test))
        if self.others is not None:
            of_test[:] = rest = number(self.others)
        for place, mode in enumerate(state.test.numbers):
            if mode in self.damping:
                of_test[place] = number(self.damping[mode])
        found = np.full(modes.tau.size, rest)
        n_rigid = 0 if state.modal is None else state.modal.n_rigid
        found[state.pairing.computed + n_rigid] = of_test[state.pairing.measured]
        return found


def fracs(part: Residual) -> Floats:
    """Return the FRAC of each function at its chosen lines, (n_curves,); part: one block."""
    (block,) = part.blocks
    found = np.zeros(block.sizes.size)
    ends = np.cumsum(block.sizes)[:-1]
    split = zip(np.split(block.measured, ends), np.split(part.values, ends), strict=True)
    for row, (measured, values) in enumerate(split):
        one, other = (
            np.exp(real + 1j * imaginary)[:, None, None]
            for real, imaginary in (np.split(measured, 2), np.split(measured - values, 2))
        )
        found[row] = frac(one, other).item()
    return found
