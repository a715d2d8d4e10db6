"""Sensitivity methods: which jobs a column needs, and how the column follows from their results.

One interface for all: `plan` names the jobs of each column, the execution runs them all at once,
`assemble` makes derivatives of the paired modes from the results. `auto` gives each parameter the
cheapest method that is exact for what the residual compares:

1. strain_energy, no job at all: stiffness-linear parameters, frequencies only. The energies of
   the modal run must balance (2 U / lambda = 1); where they do not (reduced elements keep their
   hourglass energy to themselves) the column goes to the next method.
2. semi_analytic, one matrix job a parameter: frequencies, and shapes where the matrices' unknowns
   are found at the sensors.
3. finite_difference, one modal job a parameter: anything.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from modetune.adapters.solver import MatrixAnalysis, ModalAnalysis
from modetune.core.eigen import solve_modes
from modetune.core.errors import ModesError
from modetune.core.keys import Json
from modetune.core.modes import Floats, Integers
from modetune.core.pairing import Pairing, pair_by_tracking
from modetune.core.parameters import LINEAR, STIFFNESS_LINEAR, Parameter, ParameterSet
from modetune.core.results import MatrixResult, ModalResult, ModeDerivatives
from modetune.core.sensitivity import (
    fox_kapoor,
    nelson,
    stack_derivatives,
    strain_energy_derivative,
)
from modetune.flows.engine import Job, JobEngine
from modetune.flows.schema import SensitivitySection

Exact = Literal["strain_energy", "semi_analytic", "finite_difference"]

#: Printed energies have seven digits; a balance worse than this is a missing energy.
BALANCE_TOLERANCE = 1e-4
#: Eigenvalues of the stored matrices and of the solver's own run agree to its seven digits.
EIGENVALUE_TOLERANCE = 1e-4


#: Raised by hand when the same matrices give other derivatives.
DERIVATIVES_VERSION = 1


class UnbalancedEnergies(ModesError):
    """The strain energies of the groups are not those of the modes."""


class UnlikeMatrices(ModesError):
    """The stored matrices are not those of the modes (preload, parts that matrices do not hold)."""


@dataclass(frozen=True, slots=True)
class Point:
    """Where derivatives are taken: parameter values, the modes there, and which are paired."""

    theta: Floats
    modal: ModalResult
    pairing: Pairing


@dataclass(frozen=True, slots=True)
class Sensitivities:
    """The methods of a campaign bound to its model; `columns` are positions of parameters."""

    engine: JobEngine
    parameters: ParameterSet
    settings: SensitivitySection
    with_shapes: bool
    modal: ModalAnalysis

    def method(self, parameter: Parameter) -> Exact:
        """The method of a parameter's column."""
        if self.settings.method != "auto":
            return self.settings.method
        if not self.with_shapes and self._has_energies(parameter):
            return "strain_energy"
        return self.without_energies()

    def without_energies(self) -> Exact:
        """The cheapest method that needs no strain energies."""
        solver = self.engine.solver
        shapes_found = solver.model.solid_shapes or not self.with_shapes
        if solver.capabilities.matrices and shapes_found:
            return "semi_analytic"
        return "finite_difference"

    def _has_energies(self, parameter: Parameter) -> bool:
        solver = self.engine.solver
        return (
            parameter.quantity in STIFFNESS_LINEAR
            and solver.capabilities.strain_energies
            and bool(solver.energy_sets(parameter))
        )

    def methods(self) -> tuple[Exact, ...]:
        """The method of each column."""
        return tuple(self.method(parameter) for parameter in self.parameters.parameters)

    def plan(self, theta: Floats, column: int, method: Exact) -> tuple[Job, ...]:
        """The jobs that a column needs beyond the modal run."""
        if method == "strain_energy":
            return ()
        if method == "semi_analytic":
            return self._matrix_jobs(theta, column)
        return tuple(Job(values, self.modal) for values in self._perturbed(theta, column))

    def shared(self, theta: Floats, methods: Sequence[Exact]) -> tuple[Job, ...]:
        """Jobs that several columns need: the matrices of the unperturbed model."""
        if "semi_analytic" not in methods:
            return ()
        jobs = [self._base_job(theta)]
        if self.constant_matrices:  # K and M at theta are put together from all moved columns
            for column in np.flatnonzero(theta != self.parameters.initial).tolist():
                if methods[column] != "semi_analytic":
                    jobs += self._matrix_jobs(theta, column)
        return tuple(jobs)

    def assemble(
        self, point: Point, methods: Sequence[Exact], columns: Sequence[int]
    ) -> ModeDerivatives:
        """Derivatives of the paired modes for these columns, in their order.

        Raises UnbalancedEnergies where strain energies cannot be believed.
        """
        by_matrices = [c for c in columns if methods[c] == "semi_analytic"]
        matrices = self._semi_analytic(point, by_matrices) if by_matrices else {}
        derivatives = []
        for column in columns:
            if methods[column] == "semi_analytic":
                derivatives.append(matrices[column])
            elif methods[column] == "strain_energy":
                derivatives.append(self._strain_energy(point, column))
            else:
                derivatives.append(self._finite_difference(point, column))
        return stack_derivatives(derivatives)

    @property
    def constant_matrices(self) -> bool:
        """Whether dK/dp and dM/dp are the same for all parameter values.

        So where K and M are linear in each parameter and no two parameters scale the same thing.
        """
        parameters = self.parameters.parameters
        scaled = [(item.quantity, target.upper()) for item in parameters for target in item.targets]
        return len(set(scaled)) == len(scaled) and all(p.quantity in LINEAR for p in parameters)

    # strain energies

    def _strain_energy(self, point: Point, column: int) -> ModeDerivatives:
        balance = point.modal.energy_balance[point.pairing.computed]
        if (np.abs(balance - 1.0) > BALANCE_TOLERANCE).any():
            raise UnbalancedEnergies(
                f"strain energies are {balance.min():.4g} to {balance.max():.4g} of what the "
                "eigenvalues say: the solver leaves some out (reduced elements); use `auto`, "
                "semi_analytic or finite_difference"
            )
        energies = point.modal.elastic_energies(self.parameters.names[column])
        values = strain_energy_derivative(
            energies[point.pairing.computed], float(point.theta[column])
        )
        return ModeDerivatives(values[:, None], np.zeros((0, values.size, 1)))

    # finite differences

    def _perturbed(self, theta: Floats, column: int) -> list[Mapping[str, float]]:
        signs = (1.0, -1.0) if self.settings.difference == "central" else (1.0,)
        step = self.settings.step
        return [self.parameters.values(_scaled(theta, column, 1.0 + sign * step)) for sign in signs]

    def _finite_difference(self, point: Point, column: int) -> ModeDerivatives:
        base = point.modal.elastic
        ends = [self._at(point, values) for values in self._perturbed(point.theta, column)]
        paired = base.select(point.pairing.computed)
        here = (paired.eigenvalues, np.real(paired.mode_shapes))
        low = here if len(ends) == 1 else ends[1]
        width = len(ends) * self.settings.step * float(point.theta[column])
        shapes = (ends[0][1] - low[1]) / width
        return ModeDerivatives(
            ((ends[0][0] - low[0]) / width)[:, None],
            shapes[:, :, None] if self.with_shapes else np.zeros((0, shapes.shape[1], 1)),
        )

    def _at(self, point: Point, values: Mapping[str, float]) -> tuple[Floats, Floats]:
        """Eigenvalues and shapes of the paired modes in a perturbed model, re-paired and signed."""
        result = self.engine.result(Job(values, self.modal))
        assert isinstance(result, ModalResult)
        base, moved = point.modal.elastic, result.elastic
        again = pair_by_tracking(point.pairing, base, moved)
        shapes = moved.mode_shapes[:, again.computed]
        before = base.mode_shapes[:, point.pairing.computed]
        signs = np.where(np.sum(shapes * before, axis=0) < 0.0, -1.0, 1.0)
        return moved.eigenvalues[again.computed], np.real(shapes * signs)

    # semi-analytic

    def _factors(self, column: int) -> tuple[float, ...]:
        """Factors on the parameter at which matrices are stored, besides the model's own.

        One is exact where matrices are linear. Of a shell's thickness t they are A t + B + C / t
        (stiffness in the plane and across it, on the unknowns of both faces), whose derivative
        the pair 1 + s, 1 / (1 + s) gives exactly; a plain central difference would be drowned by
        the stiffness across the thickness, however small its step.
        """
        upper = 1.0 + self.settings.step
        linear = self.parameters.parameters[column].quantity in LINEAR
        return (upper,) if linear else (upper, 1.0 / upper)

    def _matrix_jobs(self, theta: Floats, column: int) -> tuple[Job, ...]:
        base = self.parameters.initial if self.constant_matrices else theta
        return tuple(
            Job(self.parameters.values(_scaled(base, column, factor)), MatrixAnalysis())
            for factor in self._factors(column)
        )

    def _base_job(self, theta: Floats) -> Job:
        base = self.parameters.initial if self.constant_matrices else theta
        return Job(self.parameters.values(base), MatrixAnalysis())

    def _matrices(self, job: Job) -> MatrixResult:
        result = self.engine.result(job)
        assert isinstance(result, MatrixResult)
        return result

    def _semi_analytic(self, point: Point, columns: Sequence[int]) -> dict[int, ModeDerivatives]:
        """Columns from matrices. They cost an eigensolution and a factorisation a mode, so the
        store keeps them beside the jobs' results."""
        at_theta = Job(self.parameters.values(point.theta), self.modal)
        jobs = [self._base_job(point.theta), at_theta]
        for column in columns:
            jobs += self._matrix_jobs(point.theta, column)
        asked: Json = {
            "derivatives": DERIVATIVES_VERSION,
            "jobs": [self.engine.key(job) for job in jobs],
            "theta": point.theta.tolist(),
            "step": self.settings.step,
            "pairs": point.pairing.computed.tolist(),
            "shapes": self.with_shapes,
        }
        stacked = self.engine.derived(asked, lambda: stack_derivatives(
            list(self._from_matrices(point, columns).values())
        ))  # fmt: skip
        return {
            column: ModeDerivatives(
                stacked.eigenvalues[:, [place]], stacked.mode_shapes[:, :, [place]]
            )
            for place, column in enumerate(columns)
        }

    def _from_matrices(self, point: Point, columns: Sequence[int]) -> dict[int, ModeDerivatives]:
        base = self._matrices(self._base_job(point.theta))
        changes = {column: self._change(point.theta, column, base) for column in columns}
        stiffness, mass = base.stiffness, base.mass
        if self.constant_matrices:
            # K and M at theta follow from the reference model's, so no further job is needed.
            for column, parameter in enumerate(self.parameters.parameters):
                move = float(point.theta[column] - parameter.initial)
                if move == 0.0:
                    continue
                dk, dm = changes.get(column) or self._change(point.theta, column, base)
                stiffness, mass = stiffness + move * dk, mass + move * dm
        base = MatrixResult(
            sparse.csr_array(stiffness), sparse.csr_array(mass), base.nodes, base.components
        )
        return self._derivatives(point, base, changes)

    def _change(
        self, theta: Floats, column: int, base: MatrixResult
    ) -> tuple[sparse.csr_array, sparse.csr_array]:
        """dK/dp and dM/dp by differences of stored matrices; exact where they are linear in p."""
        ends = [self._matrices(job) for job in self._matrix_jobs(theta, column)]
        low = base if len(ends) == 1 else ends[1]
        reference = self.parameters.initial if self.constant_matrices else theta
        factors = (*self._factors(column), 1.0)[:2]
        width = (factors[0] - factors[1]) * float(reference[column])
        return (
            sparse.csr_array((ends[0].stiffness - low.stiffness) / width),
            sparse.csr_array((ends[0].mass - low.mass) / width),
        )

    def _derivatives(
        self,
        point: Point,
        base: MatrixResult,
        changes: Mapping[int, tuple[sparse.csr_array, sparse.csr_array]],
    ) -> dict[int, ModeDerivatives]:
        elastic, paired = point.modal.elastic, point.pairing.computed
        n_modes = point.modal.modes.n_modes
        eigenvalues, shapes = solve_modes(
            base.stiffness, base.mass, n_modes, shift=-0.1 * float(elastic.eigenvalues[0])
        )
        modes = paired + point.modal.n_rigid
        apart = np.abs(eigenvalues[modes] / elastic.eigenvalues[paired] - 1.0)
        if (apart > EIGENVALUE_TOLERANCE).any():
            raise UnlikeMatrices(
                f"the stored matrices have other eigenvalues than the modal run (they differ by "
                f"{apart.max():.2g}): the model has parts that matrices do not hold; use "
                "finite_difference"
            )
        if not self.with_shapes:
            return {
                column: ModeDerivatives(
                    fox_kapoor(eigenvalues[modes], shapes[:, modes], *change)[:, None],
                    np.zeros((0, modes.size, 1)),
                )
                for column, change in changes.items()
            }
        rows, held = _sensor_rows(base, elastic.nodes, elastic.components)
        found = nelson(base.stiffness, base.mass, eigenvalues, shapes, list(changes.values()),
                       modes.tolist(), rows)  # fmt: skip
        at_sensors = shapes[rows][:, modes]
        signs = np.where(
            np.sum(at_sensors * elastic.mode_shapes[~held][:, paired], axis=0) < 0.0, -1.0, 1.0
        )
        full = np.zeros((elastic.n_dof, modes.size, len(changes)))
        full[~held] = found.mode_shapes * signs[None, :, None]
        return {
            column: ModeDerivatives(found.eigenvalues[:, [place]], full[:, :, [place]])
            for place, column in enumerate(changes)
        }


def _scaled(theta: Floats, column: int, factor: float) -> Floats:
    scaled = theta.copy()
    scaled[column] *= factor
    return scaled


def _sensor_rows(
    base: MatrixResult, nodes: Integers, components: Integers
) -> tuple[Integers, NDArray[np.bool_]]:
    """Equation of each sensor degree of freedom that has one, and which are held in place."""
    equation: dict[tuple[int, int], int] = {}
    names = zip(base.nodes.tolist(), base.components.tolist(), strict=True)
    for row, name in enumerate(names):
        equation.setdefault(name, row)
    wanted = zip(nodes.tolist(), components.tolist(), strict=True)
    rows = np.array([equation.get(dof, -1) for dof in wanted], dtype=np.int64)
    return rows[rows >= 0], rows < 0
