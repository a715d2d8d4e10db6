"""Derivatives from the solver's stored matrices: Fox and Kapoor's, and Nelson's for shapes.

dK/dp and dM/dp come from differences of stored matrices, one job a parameter besides the model's
own, two where they are not linear in p. Where all parameters are linear the differences are the
same for all values: they are taken once, at the initial model, and K and M anywhere else follow
from them without a job. Modes are those of the matrices (the solver's have lost digits in print,
and the unknowns that it keeps to itself), checked against the solver's eigenvalues.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from modetune.adapters.solver import MatrixAnalysis, ModalAnalysis
from modetune.core.eigen import solve_modes
from modetune.core.errors import ModelError, ModesError
from modetune.core.keys import Json
from modetune.core.matrices import symmetric, upper_triangle
from modetune.core.modes import Floats, Integers
from modetune.core.parameters import ParameterSet
from modetune.core.results import MatrixResult, ModeDerivatives
from modetune.core.sensitivity import fox_kapoor, nelson, stack_derivatives
from modetune.flows.evaluation import Point
from modetune.flows.execution.engine import Job, JobEngine

#: Eigenvalues of the stored matrices and of the solver's own run agree to its seven digits.
EIGENVALUE_TOLERANCE = 1e-4

#: Factor on a parameter in which matrices are linear, where they are stored a second time.
LINEAR_FACTOR = 2.0
#: Derivatives from two pairs of matrices, one twice as wide, that differ more are not believed.
PAIR_TOLERANCE = 0.01
#: Raised by hand when the same matrices give other derivatives.
DERIVATIVES_VERSION = 1


#: dK/dp and dM/dp.
Change = tuple[sparse.csr_array, sparse.csr_array]


class UnlikeMatrices(ModesError):
    """The stored matrices are not those of the modes (preload, parts that matrices do not hold)."""


@dataclass(frozen=True, slots=True)
class SemiAnalytic:
    """The method bound to a model; step: relative change of a parameter between matrices."""

    engine: JobEngine
    parameters: ParameterSet
    step: float
    with_shapes: bool
    modal: ModalAnalysis

    @property
    def constant(self) -> bool:
        """Whether dK/dp and dM/dp are the same for all parameter values.

        So where K and M are linear in each parameter and no two parameters scale the same thing.
        """
        parameters, solver = self.parameters.parameters, self.engine.solver
        scaled = [
            (item.quantity, item.by, item.item, target.upper())
            for item in parameters
            for target in item.targets
        ]
        return len(set(scaled)) == len(scaled) and all(map(solver.is_linear, parameters))

    def _factors(self, column: int) -> tuple[float, ...]:
        """Factors on the parameter at which matrices are stored, besides the model's own.

        One is exact where matrices are linear, and as the matrices are text of some digits, a
        far one is the most exact. Else a pair 1 + s, 1 / (1 + s): of a flat shell's thickness t the
        matrices are A t + B + C / t (stiffness in the plane and across it, on the unknowns of both
        faces), whose derivative it gives exactly. Where shells meet they are not, and then what
        the stiffness across the thickness adds drowns the bending; a second pair tells.
        """
        if self.engine.solver.is_linear(self.parameters.parameters[column]):
            return (LINEAR_FACTOR,)
        return (*_pair(1.0 + self.step), *_pair(1.0 + 2.0 * self.step))

    def jobs(self, theta: Floats, column: int) -> tuple[Job, ...]:
        """The matrix jobs of a column."""
        base = self.parameters.initial if self.constant else theta
        return tuple(
            Job(self.parameters.values(scaled(base, column, factor)), MatrixAnalysis())
            for factor in self._factors(column)
        )

    def base_job(self, theta: Floats) -> Job:
        """The matrix job of the model from which columns differ."""
        base = self.parameters.initial if self.constant else theta
        return Job(self.parameters.values(base), MatrixAnalysis())

    def _matrices(self, job: Job) -> MatrixResult:
        result = self.engine.result(job)
        assert isinstance(result, MatrixResult)
        return result

    def derivatives(self, point: Point, columns: Sequence[int]) -> dict[int, ModeDerivatives]:
        """Derivatives of the paired modes by column.

        They cost an eigensolution and a factorisation a mode, so the store keeps them beside the
        jobs' results. Raises UnlikeMatrices.
        """
        at_theta = Job(self.parameters.values(point.theta), self.modal)
        used = [self.base_job(point.theta), at_theta]
        for column in columns:
            used += self.jobs(point.theta, column)
        asked: Json = {
            "derivatives": DERIVATIVES_VERSION,
            "jobs": [self.engine.key(job) for job in used],
            "theta": point.theta.tolist(),
            "step": self.step,
            "pairs": point.pairing.computed.tolist(),
            "shapes": self.with_shapes,
        }
        stacked = self.engine.derived(asked, lambda: stack_derivatives(
            list(self._from_matrices(point, columns).values())
        ), ModeDerivatives)  # fmt: skip
        return {column: stacked.column(place) for place, column in enumerate(columns)}

    def _from_matrices(self, point: Point, columns: Sequence[int]) -> dict[int, ModeDerivatives]:
        base, changes = self.matrices(point.theta, columns)
        return self._of_modes(point, base, changes)

    def matrices(
        self, theta: Floats, columns: Sequence[int]
    ) -> tuple[MatrixResult, dict[int, Change]]:
        """K and M at these values, and dK/dp and dM/dp of these columns."""
        base = self._matrices(self.base_job(theta))
        changes = {column: self._change(theta, column, base) for column in columns}
        stiffness, mass = base.upper_stiffness, base.upper_mass
        if self.constant:
            # K and M at theta follow from the reference model's, so no further job is needed.
            for column, parameter in enumerate(self.parameters.parameters):
                move = float(theta[column] - parameter.initial)
                if move == 0.0:
                    continue
                dk, dm = changes.get(column) or self._change(theta, column, base)
                stiffness = stiffness + move * upper_triangle(dk)
                mass = mass + move * upper_triangle(dm)
        moved = replace(
            base, upper_stiffness=sparse.csr_array(stiffness), upper_mass=sparse.csr_array(mass)
        )
        return moved, changes

    def _change(self, theta: Floats, column: int, base: MatrixResult, pair: int = 0) -> Change:
        """dK/dp and dM/dp by differences of stored matrices; exact where they are linear in p."""
        factors = self._factors(column)
        ends = [self._matrices(job) for job in self.jobs(theta, column)][2 * pair :][:2]
        low = base if len(ends) == 1 else ends[1]
        reference = self.parameters.initial if self.constant else theta
        upper, lower = (*factors[2 * pair :], 1.0)[:2]
        parameter, solver = self.parameters.parameters[column], self.engine.solver
        high, below = (solver.written(parameter, factor * float(reference[column]))
                       for factor in (upper, lower))  # fmt: skip
        width = high - below
        return (
            symmetric(sparse.csr_array((ends[0].upper_stiffness - low.upper_stiffness) / width)),
            symmetric(sparse.csr_array((ends[0].upper_mass - low.upper_mass) / width)),
        )

    def _check_pairs(
        self, point: Point, column: int, base: MatrixResult, eigenvalues: Floats, shapes: Floats
    ) -> None:
        """Raise UnlikeMatrices where the derivatives by two pairs of matrices are not the same."""
        if len(self._factors(column)) < 4:
            return
        near, far = (
            fox_kapoor(eigenvalues, shapes, *self._change(point.theta, column, base, pair))
            for pair in (0, 1)
        )
        apart = np.abs(near - far).max() / np.abs(near).max()
        if apart > PAIR_TOLERANCE:
            raise UnlikeMatrices(
                f"the derivatives with respect to {self.parameters.names[column]} from two pairs "
                f"of stored matrices differ by {100 * apart:.2g} %, as where shells of another "
                "thickness meet; use `auto` or finite_difference"
            )

    def _of_modes(
        self,
        point: Point,
        base: MatrixResult,
        changes: Mapping[int, Change],
    ) -> dict[int, ModeDerivatives]:
        elastic, paired = point.modal.elastic, point.pairing.computed
        n_modes = point.modal.modes.n_modes
        stiffness, mass = base.stiffness, base.mass
        try:
            eigenvalues, shapes = solve_modes(
                stiffness, mass, n_modes, shift=-0.1 * float(elastic.eigenvalues[0])
            )
        except ModelError as error:
            raise UnlikeMatrices(
                f"the stored matrices cannot be solved, as happens with very thin shells that are "
                f"expanded to solids ({error})"
            ) from error
        modes = paired + point.modal.n_rigid
        apart = np.abs(eigenvalues[modes] / elastic.eigenvalues[paired] - 1.0)
        # Rigid modes, which should have none, show what the rounding of the matrices' text adds.
        rounding = np.abs(eigenvalues[: point.modal.n_rigid]).max(initial=0.0)
        if (apart > EIGENVALUE_TOLERANCE + rounding / elastic.eigenvalues[paired]).any():
            raise UnlikeMatrices(
                f"the stored matrices have other eigenvalues than the modal run (they differ by "
                f"{apart.max():.2g}): the model has parts that matrices do not hold; use "
                "finite_difference"
            )
        for column in changes:
            self._check_pairs(point, column, base, eigenvalues[modes], shapes[:, modes])
        if not self.with_shapes:
            return {
                column: ModeDerivatives(
                    fox_kapoor(eigenvalues[modes], shapes[:, modes], *change)[:, None],
                    np.zeros((0, modes.size, 1)),
                )
                for column, change in changes.items()
            }
        rows, held = _sensor_rows(base, elastic.nodes, elastic.components)
        found = nelson(stiffness, mass, eigenvalues, shapes, list(changes.values()),
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


def _pair(upper: float) -> tuple[float, float]:
    return upper, 1.0 / upper


def scaled(theta: Floats, column: int, factor: float) -> Floats:
    """Parameter values with one of them multiplied."""
    moved = theta.copy()
    moved[column] *= factor
    return moved


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
