"""Results of jobs that the store keeps: modes, matrices, and what is computed from them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from modetune.core.algebra.eigen import SolvedModes
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.algebra.repeated_modes import canonical_rotation
from modetune.core.brief import brief
from modetune.core.errors import ModesError
from modetune.core.measurement.registration import Registration
from modetune.core.modes import Floats, Integers, ModeSet
from modetune.core.updating.minima import SearchEnds
from modetune.core.updating.parameter_matrices import ParameterMatrices
from modetune.core.updating.reduced_basis import ReducedModel, ReducedRange
from modetune.core.updating.sensitivity import ModeDerivatives


@dataclass(frozen=True, slots=True)
class ModesForecast:
    """Seconds either way is expected to take, and the solver runs behind them.

    jobs: for the matrices; runs: of the solver's own modes and their differences; run_s: of one of
    them; measured: whether the time is that of a run; else it follows from the model's size.
    """

    jobs: int
    matrices_s: float
    runs: int
    solver_s: float
    run_s: float
    measured: bool

    @property
    def by_matrices(self) -> bool:
        """Whether the matrices are expected to take less; they do where they are there."""
        return self.jobs == 0 or self.matrices_s < self.solver_s

    @property
    def sentence(self) -> str:
        """Both ways and why, in words."""
        by = "matrices" if self.by_matrices else "the solver's own runs"
        source = "as measured" if self.measured else "judged by the number of elements"
        return (
            f"by {by}: {self.jobs} matrix job{'' if self.jobs == 1 else 's'}, about "
            f"{self.matrices_s:.2g} s in all, against {self.runs} runs, about "
            f"{self.solver_s:.2g} s (a run {self.run_s:.2g} s, {source})"
        )


@dataclass(frozen=True, slots=True, repr=False)
class ModalResult:
    """The modes of one model state, rigid ones included, in the solver's order.

    eigenvalues: (n_modes,), (rad/s)^2, ascending, with the rounding of rigid modes as it came.
    modes: mass-normalised, at the requested nodes.
    groups: names of the element groups whose strain energies are known.
    strain_energies: (n_groups, n_modes) of the mass-normalised modes; total_strain_energy:
    (n_modes,) of the whole model. Both in the deck's units of (rad/s)^2 for unit modal mass.
    mass: total mass in the deck's unit, NaN if the solver does not print it. n_rigid: how many of
    the first modes are rigid (core/algebra/rigid_modes), which whoever read the modes has counted.
    """

    eigenvalues: Floats
    modes: ModeSet
    groups: tuple[str, ...]
    strain_energies: Floats
    total_strain_energy: Floats
    mass: float
    n_rigid: int = 0

    __repr__ = brief

    @classmethod
    def of_shapes(
        cls,
        eigenvalues: Floats,
        shapes: Floats,
        nodes: Integers,
        components: Integers,
        energies: Floats,
        n_rigid: int,
    ) -> ModalResult:
        """Modes that were solved for here. shapes: (n_dof, n_modes), mass-normalised, whose degrees
        of freedom have these nodes and components; energies: (n_modes,), of the whole model."""
        shapes = shapes @ canonical_rotation(eigenvalues, shapes)
        return cls(
            eigenvalues=eigenvalues,
            modes=ModeSet(
                np.sqrt(np.maximum(eigenvalues, 0.0)) / (2.0 * np.pi),
                shapes,
                nodes,
                components,
                np.zeros(0),
                "mass",
            ),
            groups=(),
            strain_energies=np.zeros((0, eigenvalues.size)),
            total_strain_energy=energies,
            mass=np.nan,
            n_rigid=n_rigid,
        )

    def __post_init__(self) -> None:
        n_modes = self.modes.n_modes
        if self.eigenvalues.shape != (n_modes,):
            raise ModesError(f"{self.eigenvalues.size} eigenvalues for {n_modes} modes")
        if not np.isfinite(self.eigenvalues).all():
            raise ModesError("an eigenvalue is not a finite number")
        if self.strain_energies.shape != (len(self.groups), n_modes):
            raise ModesError("the strain energies do not fit their groups and modes")

    def at(self, nodes: tuple[int, ...]) -> ModalResult:
        """The same modes with shapes at these nodes only."""
        rows = np.flatnonzero(np.isin(self.modes.nodes, np.array(nodes, dtype=np.int64)))
        return self if rows.size == self.modes.n_dof else replace(self, modes=self.modes.rows(rows))

    def turned(self, rotation: Floats) -> ModalResult:
        """The same modes with elastic shapes @ rotation, which mixes close modes only.

        rotation: (n_elastic, n_elastic), orthogonal. Eigenvalues are the Rayleigh quotients of the
        turned shapes. Of energies that mix only the modes' own are
        known, so those of a group are exact where its parts in the members do not couple.
        """
        whole = np.eye(self.eigenvalues.size)
        whole[self.n_rigid :, self.n_rigid :] = rotation
        shares = whole**2
        squares = self.modes.frequencies_hz**2 @ shares
        turned = replace(
            self.modes,
            frequencies_hz=np.where(
                shares.max(axis=0) < 1.0, np.sqrt(squares), self.modes.frequencies_hz
            ),
            mode_shapes=self.modes.mode_shapes @ whole,
        )
        return replace(
            self,
            eigenvalues=self.eigenvalues @ shares,
            modes=turned,
            strain_energies=self.strain_energies @ shares,
            total_strain_energy=self.total_strain_energy @ shares,
        )

    @property
    def elastic(self) -> ModeSet:
        """The modes that strain the structure, in ascending order."""
        return self.modes.select(np.arange(self.n_rigid, self.modes.n_modes))

    def elastic_energies(self, group: str) -> Floats:
        """Strain energy of one group in each elastic mode, (n_elastic,)."""
        return self.strain_energies[self.groups.index(group), self.n_rigid :]

    @property
    def energy_balance(self) -> Floats:
        """2 U / lambda of each elastic mode: 1 where the energies are complete (n_elastic,)."""
        elastic = slice(self.n_rigid, None)
        return 2.0 * self.total_strain_energy[elastic] / self.eigenvalues[elastic]


#: What a store keeps: what solvers give, and what is made of it at a cost.
Result = (
    ModalResult
    | MatrixResult
    | ModeDerivatives
    | ParameterMatrices
    | ReducedModel
    | ReducedRange
    | ModesForecast
    | Registration
    | SolvedModes
    | SearchEnds
)


def finite(result: Result) -> Result:
    """A result as it is, all of its numbers finite. Raises ModesError.

    Strain energies and mass are NaN if the solver does not print them.
    """
    if not all(np.isfinite(numbers).all() for numbers in _numbers(result)):
        raise ModesError("the result holds values that are not finite numbers")
    return result


def _numbers(result: Result) -> list[Floats | NDArray[np.complex128]]:
    """The arrays whose numbers must be finite."""
    match result:
        case MatrixResult():
            return [result.upper_stiffness.data, result.upper_mass.data]
        case ParameterMatrices():
            parts = [part.values for part in (*result.stiffness, *result.mass)]
            return [result.reference, *_numbers(result.base), *parts]
        case ReducedModel():
            parts = [part.values for part in (*result.stiffness, *result.mass)]
            return [result.reference, result.base_stiffness, result.base_mass, result.rows, *parts]
        case ReducedRange():
            return [*_numbers(result.whole), result.solved, result.errors]
        case ModalResult():
            return [result.modes.mode_shapes, result.eigenvalues]
        case ModeDerivatives():
            return [result.mode_shapes, result.eigenvalues]
        case SolvedModes():
            return [result.shapes, result.eigenvalues]
        case SearchEnds():
            return [result.starts[: result.n_starts]]
        case ModesForecast():
            return [np.array([result.matrices_s, result.solver_s, result.run_s])]
        case Registration():
            poses = (result.best, *result.others)
            return [np.array([result.slides, *(pose.scale for pose in poses)])]
