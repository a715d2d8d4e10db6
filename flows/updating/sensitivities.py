"""Sensitivity methods: the jobs that a column needs, and the column from their results.

All methods have one interface: `shared` and `plan` list the jobs, the execution runs them together,
and `assemble` makes derivatives of the paired modes from the results. `auto` selects for each
parameter the cheapest method that is exact for the compared responses:

1. strain_energy, no job at all: stiffness-linear parameters, frequencies only. The energies of
   the modal run must balance (2 U / lambda = 1); if they do not (reduced elements do not print
   their hourglass energy), the column uses the next method.
2. semi_analytic, a few matrix jobs for all parameters: frequencies, and shapes where the matrices'
   unknowns include the sensors.
3. solver, one job for all columns: the solver's own derivatives (Nastran's SOL 200).
4. finite_difference, one modal job a parameter: anything.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from modetune.adapters.solver import ModalAnalysis, SensitivityAnalysis, Solver
from modetune.core.algebra.eigen import solve_modes
from modetune.core.algebra.matrices import MatrixResult, eigenvalue_rounding, symmetric
from modetune.core.algebra.pencil import shift_below
from modetune.core.correlation.clusters import rotation_onto, with_neighbours
from modetune.core.correlation.pairing import alone, pair_by_tracking
from modetune.core.errors import ModelError, ModesError
from modetune.core.modes import CLOSE, Floats, Integers, close_sets
from modetune.core.parameters import Parameter, ParameterSet
from modetune.core.storage.keys import Json
from modetune.core.updating.job_results import ModalResult
from modetune.core.updating.parameter_matrices import ParameterMatrices
from modetune.core.updating.sensitivity import (
    ModeDerivatives,
    fox_kapoor,
    nelson,
    stack_derivatives,
    strain_energy_derivative,
)
from modetune.flows.campaign.schema import SensitivitySection
from modetune.flows.jobs.engine import JobEngine
from modetune.flows.jobs.execution import Work
from modetune.flows.jobs.job import Job
from modetune.flows.updating.evaluation import Point
from modetune.flows.updating.matrices import MatrixSource

#: Permitted relative difference of eigenvalues of the stored matrices from the solver's: it prints
#: seven digits.
EIGENVALUE_TOLERANCE = 1e-4
#: Permitted relative difference between derivatives from two pairs of matrices, one twice as wide.
PAIR_TOLERANCE = 0.01
#: Increase this number when the same matrices give other derivatives.
DERIVATIVES_VERSION = 3
Exact = Literal["strain_energy", "semi_analytic", "solver", "finite_difference"]
#: Printed energies have seven digits; a larger imbalance means that some energy is missing.
BALANCE_TOLERANCE = 1e-4


class UnlikeMatrices(ModesError):
    """The stored matrices are not those of the modes (preload, parts that matrices lack)."""


@dataclass(frozen=True, slots=True)
class SemiAnalytic:
    """The semi-analytic method, bound to a model's matrices and its modal analysis."""

    source: MatrixSource
    with_shapes: bool
    modal: ModalAnalysis

    def derivatives(self, point: Point, columns: Sequence[int]) -> ModeDerivatives:
        """Return derivatives of the paired modes with respect to these columns, in their order.

        They take an eigensolution and a factorisation per mode, so the store keeps them. Raises
        UnlikeMatrices.
        """
        source, engine = self.source, self.source.engine
        asked: Json = {
            "derivatives": DERIVATIVES_VERSION,
            "matrices": source.key(point.theta, columns),
            "modal": engine.key(Job(source.parameters.values(point.theta), self.modal)),
            "columns": list(columns),
            "n_modes": point.modal.modes.n_modes,
            "pairs": point.pairing.computed.tolist(),
            "shapes": self.with_shapes,
            "turned": _turned(point),
        }
        return engine.derived(
            asked,
            lambda: self._computed(point, columns),
            ModeDerivatives,
            "sensitivities from matrices",
        )

    def _computed(self, point: Point, columns: Sequence[int]) -> ModeDerivatives:
        theta, source = self.source.written(point.theta), self.source
        try:
            model = source.matrices(point.theta, columns)
        except ModelError as error:
            raise UnlikeMatrices(str(error)) from error
        here = model.at(theta)
        stiffness, mass = here.stiffness, here.mass
        eigenvalues, shapes = self._modes(point, stiffness, mass)
        eigenvalues, shapes = _as_compared(here, point, eigenvalues, shapes)
        _refuse_others(point, here, eigenvalues, shapes)
        modes = point.pairing.computed + point.modal.n_rigid
        self._check_pairs(point, columns, model, eigenvalues[modes], shapes[:, modes])
        changes = [_change(model, theta, column) for column in columns]
        if not self.with_shapes:
            slopes = [fox_kapoor(eigenvalues[modes], shapes[:, modes], *item) for item in changes]
            return ModeDerivatives(
                np.stack(slopes, axis=1), np.zeros((0, modes.size, len(changes)))
            )
        elastic = point.modal.elastic
        rows, held = _sensor_rows(here, elastic.nodes, elastic.components)
        found = nelson(
            stiffness, mass, eigenvalues, shapes, changes, modes.tolist(), rows, 2.0 * CLOSE
        )
        full = np.zeros((elastic.n_dof, modes.size, len(changes)))
        full[~held] = found.mode_shapes
        return ModeDerivatives(found.eigenvalues, full)

    def _modes(
        self, point: Point, stiffness: sparse.csr_array, mass: sparse.csr_array
    ) -> tuple[Floats, Floats]:
        """Return as many modes of the matrices as the modal run has. Raises UnlikeMatrices."""
        elastic = point.modal.elastic
        try:
            return solve_modes(
                stiffness,
                mass,
                point.modal.modes.n_modes,
                shift=shift_below(float(elastic.eigenvalues[0])),
            )
        except ModelError as error:
            raise UnlikeMatrices(
                f"the stored matrices cannot be solved, as happens with very thin shells that are "
                f"expanded to solids ({error})"
            ) from error

    def _check_pairs(
        self,
        point: Point,
        columns: Sequence[int],
        model: ParameterMatrices,
        eigenvalues: Floats,
        shapes: Floats,
    ) -> None:
        """Raise UnlikeMatrices if two pairs of matrices give different derivatives."""
        columns = self.source.without_powers(columns)
        if not columns:
            return
        theta = self.source.written(point.theta)
        wide = self.source.matrices(point.theta, columns, wide=True)
        for column in columns:
            near, far = (
                fox_kapoor(eigenvalues, shapes, *_change(item, theta, column))
                for item in (model, wide)
            )
            apart = np.abs(near - far).max() / np.abs(near).max()
            if apart > PAIR_TOLERANCE:
                raise UnlikeMatrices(
                    f"the derivatives with respect to {self.source.parameters.names[column]} from "
                    f"two pairs of stored matrices differ by {100 * apart:.2g} %, as where shells "
                    "of another thickness meet; use `auto` or finite_difference"
                )


def _refuse_others(point: Point, here: MatrixResult, eigenvalues: Floats, shapes: Floats) -> None:
    """Raise UnlikeMatrices if modes of the matrices are not the point's.

    eigenvalues: (n_modes,). shapes: (n, n_modes). Rounding of stored entries is permitted.
    """
    elastic, n_rigid = point.modal.elastic, point.modal.n_rigid
    own = elastic.eigenvalues[point.pairing.computed]
    modes = point.pairing.computed + n_rigid
    differences = np.abs(eigenvalues[modes] - own)
    # Eigenvalues of rigid modes should be zero: theirs show the effect of rounding in the text.
    rounding = np.abs(eigenvalues[:n_rigid]).max(initial=0.0)
    rounding = rounding + eigenvalue_rounding(here, eigenvalues[modes], shapes[:, modes])
    unlike = differences > EIGENVALUE_TOLERANCE * own + rounding
    if unlike.any():
        raise UnlikeMatrices(
            f"the stored matrices have other eigenvalues than the modal run (they differ by "
            f"{(differences / own)[unlike].max():.2g}): the model has parts that matrices do not "
            "hold; use finite_difference"
        )


def _as_compared(
    here: MatrixResult, point: Point, eigenvalues: Floats, shapes: Floats
) -> tuple[Floats, Floats]:
    """Return eigenvalues (n_modes,) and shapes (n, n_modes) of the matrices.

    Signs of shapes and rotations of close modes are those of the point.
    """
    elastic, n_rigid = point.modal.elastic, point.modal.n_rigid
    rows, held = _sensor_rows(here, elastic.nodes, elastic.components)
    rotation = np.eye(eigenvalues.size)
    rotation[n_rigid:, n_rigid:] = rotation_onto(
        shapes[rows][:, n_rigid:],
        np.real(elastic.mode_shapes[~held]),
        np.sqrt(np.abs(eigenvalues[n_rigid:])),
    )
    return eigenvalues @ rotation**2, shapes @ rotation


def _turned(point: Point) -> str:
    """Return the rotations of close modes towards the test's, for keys; empty if none is close."""
    elastic = point.modal.elastic
    sets = [item for item in close_sets(elastic.frequencies_hz, CLOSE) if item.size > 1]
    if not any(np.isin(point.pairing.computed, item).any() for item in sets):
        return ""
    return hashlib.sha256(np.ascontiguousarray(elastic.mode_shapes).tobytes()).hexdigest()


def _change(
    model: ParameterMatrices, theta: Floats, column: int
) -> tuple[sparse.csr_array, sparse.csr_array]:
    """Return dK/dp and dM/dp, both triangles."""
    stiffness, mass = model.change(theta, column)
    return symmetric(stiffness), symmetric(mass)


def _sensor_rows(
    base: MatrixResult, nodes: Integers, components: Integers
) -> tuple[Integers, NDArray[np.bool_]]:
    """Return the equation of each sensor degree of freedom that has one, and which are fixed."""
    equation: dict[tuple[int, int], int] = {}
    names = zip(base.nodes.tolist(), base.components.tolist(), strict=True)
    for row, name in enumerate(names):
        equation.setdefault(name, row)
    wanted = zip(nodes.tolist(), components.tolist(), strict=True)
    rows = np.array([equation.get(dof, -1) for dof in wanted], dtype=np.int64)
    return rows[rows >= 0], rows < 0


class UnbalancedEnergies(ModesError):
    """The strain energies of the groups are not those of the modes."""


@dataclass(frozen=True, slots=True)
class Sensitivities:
    """The sensitivity methods of a campaign and model; `columns` are positions of parameters."""

    source: MatrixSource
    settings: SensitivitySection
    with_shapes: bool
    modal: ModalAnalysis

    @property
    def engine(self) -> JobEngine:
        return self.source.engine

    @property
    def parameters(self) -> ParameterSet:
        return self.source.parameters

    def method(self, parameter: Parameter) -> Exact:
        """Return the method of a parameter's column."""
        if self.settings.method != "auto":
            return self.settings.method
        if not self.with_shapes and self._has_energies(parameter):
            return "strain_energy"
        return self.without_energies(parameter)

    def without_energies(self, parameter: Parameter) -> Exact:
        """Return the cheapest method that needs no strain energies.

        Matrices are used if they are linear in the parameter: they are then exact for all values.
        Otherwise two runs for matrices cost more than one for modes, and a thickness moves the
        unknowns of shells (see `SemiAnalytic`).
        """
        solver = self.engine.solver
        shapes_found = solver.deck.summary.solid_shapes or not self.with_shapes
        linear = solver.deck.is_linear(parameter)
        if solver.offers.matrices and shapes_found and linear:
            return "semi_analytic"
        return "solver" if self._by_solver else "finite_difference"

    @property
    def _by_solver(self) -> bool:
        has = self.engine.solver.offers
        return has.shape_sensitivities if self.with_shapes else has.frequency_sensitivities

    def _has_energies(self, parameter: Parameter) -> bool:
        solver = self.engine.solver
        return solver.program.capabilities.strain_energies and bool(
            solver.deck.energy_sets(parameter)
        )

    def methods(self) -> tuple[Exact, ...]:
        """Return the method of each column."""
        return tuple(self.method(parameter) for parameter in self.parameters.parameters)

    def plan(self, theta: Floats, column: int, method: Exact) -> tuple[Job, ...]:
        """Return the jobs of a single column, in addition to the modal run."""
        if method != "finite_difference":
            return ()
        return tuple(Job(values, self.modal) for values in self._perturbed(theta, column))

    def shared(self, theta: Floats, methods: Sequence[Exact]) -> list[Work]:
        """Return the jobs that columns share: the solver's sensitivities, the model's matrices."""
        works = []
        if "solver" in methods:
            job = self._solver_job(theta, methods)
            works.append(Work("sensitivities of the solver", (job,)))
        columns = _columns(methods, "semi_analytic")
        return [*works, *self.source.works(theta, columns)] if columns else works

    def assemble(
        self, point: Point, methods: Sequence[Exact], columns: Sequence[int]
    ) -> ModeDerivatives:
        """Return derivatives of the paired modes for these columns, in their order.

        Raises UnbalancedEnergies, UnlikeMatrices if a method is not valid for this model.
        """
        own = self._of_solver(point, methods) if "solver" in methods else {}
        own |= self._of_matrices(point, [c for c in columns if methods[c] == "semi_analytic"])
        own |= self._of_energies(point, [c for c in columns if methods[c] == "strain_energy"])
        return stack_derivatives(
            [
                own[column] if column in own else self._finite_difference(point, column)
                for column in columns
            ]
        )

    def _of_matrices(self, point: Point, columns: Sequence[int]) -> dict[int, ModeDerivatives]:
        if not columns:
            return {}
        method = SemiAnalytic(self.source, self.with_shapes, self.modal)
        found = method.derivatives(point, columns)
        return {column: found.column(place) for place, column in enumerate(columns)}

    # strain energies

    def _of_energies(self, point: Point, columns: Sequence[int]) -> dict[int, ModeDerivatives]:
        if not columns:
            return {}
        values = by_energies(point, self.parameters.names)
        none = np.zeros((0, len(values), 1))
        return {column: ModeDerivatives(values[:, [column]], none) for column in columns}

    # the solver's own

    def _solver_job(self, theta: Floats, methods: Sequence[Exact]) -> Job:
        names = [
            name
            for name, method in zip(self.parameters.names, methods, strict=True)
            if method == "solver"
        ]
        nodes = self.modal.nodes if self.with_shapes else ()
        return Job(
            self.parameters.values(theta),
            SensitivityAnalysis(self.modal.n_modes, tuple(names), nodes),
        )

    def _of_solver(self, point: Point, methods: Sequence[Exact]) -> dict[int, ModeDerivatives]:
        """Return columns of the paired modes from the solver's derivatives of all modes."""
        job = self._solver_job(point.theta, methods)
        result = self.engine.solve(job).result(ModeDerivatives)
        modes = point.pairing.computed + point.modal.n_rigid
        columns = _columns(methods, "solver")
        return {
            column: ModeDerivatives(result.eigenvalues[modes], result.mode_shapes[:, modes]).column(
                place
            )
            for place, column in enumerate(columns)
        }

    # finite differences

    def _perturbed(self, theta: Floats, column: int) -> list[Mapping[str, float]]:
        step = self.settings.step
        return [
            self.parameters.values(_scaled(theta, column, 1.0 + sign * step))
            for sign in self._signs
        ]

    @property
    def _signs(self) -> tuple[float, ...]:
        return (1.0, -1.0) if self.settings.difference == "central" else (1.0,)

    def _written(self, column: int, value: float) -> float:
        return self.engine.solver.deck.written(self.parameters.parameters[column], value)

    def _finite_difference(self, point: Point, column: int) -> ModeDerivatives:
        base = point.modal.elastic
        ends = [self._at(point, values) for values in self._perturbed(point.theta, column)]
        paired = base.select(point.pairing.computed)
        here = (paired.eigenvalues, np.real(paired.mode_shapes))
        low = here if len(ends) == 1 else ends[1]
        factors = [1.0 + sign * self.settings.step for sign in self._signs]
        moved = [self._written(column, factor * float(point.theta[column])) for factor in factors]
        here_value = self._written(column, float(point.theta[column]))
        width = moved[0] - (moved[1] if len(ends) > 1 else here_value)
        shapes = (ends[0][1] - low[1]) / width
        return ModeDerivatives(
            ((ends[0][0] - low[0]) / width)[:, None],
            shapes[:, :, None] if self.with_shapes else np.zeros((0, shapes.shape[1], 1)),
        )

    def _at(self, point: Point, values: Mapping[str, float]) -> tuple[Floats, Floats]:
        """Return eigenvalues and shapes of the paired modes in a perturbed model, signs matched."""
        result = self.engine.solve(Job(values, self.modal)).result(ModalResult)
        base, moved = point.modal.elastic, result.elastic
        paired = point.pairing.computed
        # With all members of clusters, even if the test has only one.
        members = with_neighbours(base.frequencies_hz, paired)
        again = pair_by_tracking(alone(members), base, moved)
        before, after = base.select(members), moved.select(again.computed)
        rotation = rotation_onto(
            np.real(after.mode_shapes), np.real(before.mode_shapes), before.frequencies_hz
        )
        places = np.searchsorted(members, paired)
        # Rotate close modes, whose shapes the step mixes, back to those before it.
        eigenvalues = after.eigenvalues @ rotation**2
        return eigenvalues[places], (np.real(after.mode_shapes) @ rotation)[:, places]


def by_energies(point: Point, names: Sequence[str]) -> Floats:
    """Return derivatives of the paired modes' eigenvalues from strain energies, (n_pairs, n_names).

    names: of the point's parameters; NaN for one without requested energies, because the stiffness
    is not proportional to it. Raises UnbalancedEnergies.
    """
    balance = point.modal.energy_balance[point.pairing.computed]
    if not (np.abs(balance - 1.0) <= BALANCE_TOLERANCE).all():
        raise UnbalancedEnergies(
            f"strain energies are {balance.min():.4g} to {balance.max():.4g} of what the "
            "eigenvalues say: the solver leaves some out (reduced elements); use `auto`, "
            "semi_analytic or finite_difference"
        )
    found = np.full((point.pairing.computed.size, len(names)), np.nan)
    for column, name in enumerate(names):
        if name in point.modal.groups:
            energies = point.modal.elastic_energies(name)[point.pairing.computed]
            found[:, column] = strain_energy_derivative(energies, float(point.theta[column]))
    return found


def not_linear(solver: Solver) -> str:
    """Return why a model is linear in no parameter, and the consequence; empty if it may be."""
    why = solver.deck.preload()
    return why and (
        f"{why}: the stiffness depends on the state there, so it is linear in no parameter, and "
        "sensitivities are differences of modal runs"
    )


def _columns(methods: Sequence[Exact], method: Exact) -> list[int]:
    return [column for column, item in enumerate(methods) if item == method]


def _scaled(theta: Floats, column: int, factor: float) -> Floats:
    """Return the parameter values with one of them multiplied."""
    moved = theta.copy()
    moved[column] *= factor
    return moved
