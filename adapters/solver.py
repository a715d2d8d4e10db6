"""The seam between modetune and a finite element solver.

An adapter says how an analysis of a model is written, which command runs it and how its output
is read. It never starts a process (`process.py` does) and never decides what to run (the flows
do). To add a solver, write a folder with a class that meets `Solver` and name it in
`flows/solvers.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from modetune.core.keys import Json
from modetune.core.mesh import Mesh
from modetune.core.modes import Integers
from modetune.core.observation import Observation
from modetune.core.parameters import Parameter, Values
from modetune.core.results import MatrixResult, Result


@dataclass(frozen=True, slots=True)
class ModalAnalysis:
    """Normal modes: the lowest n_modes (rigid ones counted), shapes at these nodes.

    groups: strain energies wanted, a name and the element sets it sums.
    """

    n_modes: int
    nodes: tuple[int, ...]
    groups: tuple[tuple[str, tuple[str, ...]], ...] = ()


@dataclass(frozen=True, slots=True)
class MatrixAnalysis:
    """The assembled stiffness and mass matrices."""


@dataclass(frozen=True, slots=True)
class SensitivityAnalysis:
    """Derivatives of the lowest n_modes (rigid ones counted) by the solver itself.

    parameters: names, in the order of the result's columns. nodes: where derivatives of shapes
    are wanted, empty for eigenvalues alone; their degrees of freedom come in the order in which
    a modal analysis at the same nodes has them.
    """

    n_modes: int
    parameters: tuple[str, ...]
    nodes: tuple[int, ...] = ()


Analysis = ModalAnalysis | MatrixAnalysis | SensitivityAnalysis


@dataclass(frozen=True, slots=True)
class Capabilities:
    """What a solver can give besides modes.

    matrix_modes: whether modes of its stored matrices may stand for its own.
    """

    strain_energies: bool
    matrices: bool
    frequency_sensitivities: bool = False
    shape_sensitivities: bool = False
    matrix_modes: bool = False


@dataclass(frozen=True, slots=True)
class Command:
    """How a job is started: an argument list, and what the environment needs on top."""

    arguments: tuple[str, ...]
    environment: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class ModelSummary:
    """What an adapter knows of its model without running it.

    node_ids: every node that carries results; components: which of 1..6 it has there.
    solid_shapes: whether each unknown of a node is one equation of the stored matrices (solids
    without dependent nodes), so that they are matrices of the nodes. matrix_shapes: whether shapes
    at nodes follow from the stored matrices (`Solver.observation`), as those of shells do too.
    file: what the model was read from, None where it is from no file.
    """

    name: str
    node_ids: frozenset[int]
    components: frozenset[int]
    n_elements: int
    solid_shapes: bool
    matrix_shapes: bool = False
    file: Path | None = None


@dataclass(frozen=True, slots=True)
class Footprint:
    """What of the matrices a parameter moves, and in which powers of its relative value.

    elements: those of the solver's deck whose matrices it scales (parts of a model of matrices
    have numbers by their order). nodes: those of the model whose equations its part may touch,
    besides the unknowns inside of elements and knots there. stiffness, mass: which matrices it
    moves. powers: with theta the relative value, K = K_0 + sum over powers of theta^k K_k, and M
    alike, K_0 being what does not depend on it.
    """

    elements: frozenset[int]
    nodes: frozenset[int]
    stiffness: bool
    mass: bool
    powers: tuple[int, ...]


class Solver(Protocol):
    """A solver bound to one model."""

    @property
    def name(self) -> str: ...

    @property
    def capabilities(self) -> Capabilities: ...

    @property
    def model(self) -> ModelSummary: ...

    def mesh(self) -> Mesh:
        """Where the nodes that carry results lie, and the elements between them.

        Built when first asked for and kept. It holds every node of `model.node_ids`, but is empty
        for a model that has no geometry (matrices). Shapes stand in global axes except at nodes
        of `Mesh.frames`. Raises ModelError.
        """
        ...

    def version(self) -> str:
        """The program's version. Raises SolverMissing."""
        ...

    def problems(self, parameters: tuple[Parameter, ...]) -> list[str]:
        """Why these parameters cannot be applied to the model, a sentence each; empty if fine."""
        ...

    def deck_value(self, parameter: Parameter) -> float:
        """The value the deck gives the parameter's quantity (the first one if several)."""
        ...

    def written(self, parameter: Parameter, value: float) -> float:
        """The relative value that an edited deck really holds; fields may have few digits."""
        ...

    def wave_speeds(self) -> dict[str, float]:
        """Root of E over density of each material that has both, in the deck's units."""
        ...

    def energy_sets(self, parameter: Parameter) -> tuple[str, ...]:
        """Element sets whose strain energy is proportional to the parameter; empty if none."""
        ...

    def is_linear(self, parameter: Parameter) -> bool:
        """Whether the stiffness and mass matrices are linear in the parameter."""
        ...

    def footprint(self, parameter: Parameter) -> Footprint | None:
        """What of the matrices the parameter moves.

        None where they are no sum of powers of its value (Poisson's ratio), where the number of
        equations depends on it, or where the solver has no matrices. Of two parameters that scale
        the same thing (the material and the thickness of one shell) the matrices have products,
        of which this does not tell.
        """
        ...

    def observation(
        self, matrices: MatrixResult, nodes: Integers, components: Integers
    ) -> Observation:
        """Degrees of freedom (n_wanted,) in terms of the equations of stored matrices.

        They are those of a modal result: in the frames of `mesh`. All are unknown where the
        solver has no matrices.
        """
        ...

    def content(self, values: Values, analysis: Analysis) -> Json:
        """Everything of the model and the analysis that can change the numbers."""
        ...

    def write(self, values: Values, analysis: Analysis, folder: Path) -> None:
        """Write the job's input files into an empty folder."""
        ...

    def command(self, threads: int) -> Command:
        """The command that runs the job written into the folder it is started in."""
        ...

    def read(self, values: Values, analysis: Analysis, folder: Path, return_code: int) -> Result:
        """Read a finished job. Raises SolverRejected or SolverCrashed where there is no result."""
        ...

    def write_updated(self, values: Values, folder: Path) -> Path:
        """Write the user's deck with updated values, includes kept; returns the main file."""
        ...
