"""Matrices behind the solver seam: SciPy's eigensolvers as a program of their own."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy

from modetune.adapters.matrices.deck import MatrixDeck, read_deck, write_updated
from modetune.adapters.matrices.job import write_job
from modetune.adapters.matrices.results import read_result
from modetune.adapters.solver import (
    Analysis,
    Capabilities,
    Command,
    Footprint,
    ModalAnalysis,
    ModelSummary,
)
from modetune.core.errors import ModelError
from modetune.core.keys import Json
from modetune.core.mesh import Mesh
from modetune.core.modes import Integers
from modetune.core.observation import Observation, observe
from modetune.core.parameters import Parameter, Values
from modetune.core.results import MatrixResult, Result


@dataclass(frozen=True)
class MatricesSolver:
    """The embedded solver bound to one model and the parameters that scale its parts."""

    deck: MatrixDeck
    parameters: tuple[Parameter, ...]

    name = "matrices"
    #: Raised by hand when the same job gives other numbers.
    reader_version = 1
    capabilities = Capabilities(strain_energies=True, matrices=True)

    @property
    def model(self) -> ModelSummary:
        model = self.deck.model
        return ModelSummary(
            name=model.name,
            node_ids=frozenset(model.nodes.tolist()),
            components=frozenset(model.components.tolist()),
            n_elements=len(model.parts),
            matrix_shapes=True,
            solid_shapes=True,  # every unknown is one of a node, under one name
            file=self.deck.file.path,
        )

    def mesh(self) -> Mesh:
        """Empty: matrices have unknowns, but no places."""
        return Mesh(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), ())

    def version(self) -> str:
        """SciPy's: its solvers are what gives the numbers."""
        return scipy.__version__

    def problems(self, parameters: tuple[Parameter, ...]) -> list[str]:
        found = []
        owners: dict[str, str] = {}
        for parameter in parameters:
            try:
                self.deck.model.targets(parameter)
            except ModelError as error:
                found.append(f"parameter {parameter.name}: {error}")
                continue
            for target in dict.fromkeys(parameter.targets):
                first = owners.setdefault(target, parameter.name)
                if first != parameter.name:
                    found.append(f"both {first} and {parameter.name} scale part {target}")
        return found

    def deck_value(self, parameter: Parameter) -> float:
        return self.deck.model.targets(parameter)[0].value

    def written(self, parameter: Parameter, value: float) -> float:
        return value

    def wave_speeds(self) -> dict[str, float]:
        return {}

    def energy_sets(self, parameter: Parameter) -> tuple[str, ...]:
        parts = self.deck.model.targets(parameter)
        return parameter.targets if all(part.mass is None for part in parts) else ()

    def is_linear(self, parameter: Parameter) -> bool:
        return True

    def footprint(self, parameter: Parameter) -> Footprint | None:
        parts = self.deck.model.targets(parameter)
        matrices = [matrix for part in parts for matrix in (part.stiffness, part.mass)
                    if matrix is not None]  # fmt: skip
        touched = [np.unique(matrix.nonzero()[0]) for matrix in matrices]
        rows = np.concatenate([*touched, np.zeros(0, dtype=np.int64)]).astype(np.int64)
        numbers = {name: number for number, name in enumerate(self.deck.model.parts, start=1)}
        return Footprint(
            elements=frozenset(numbers[target] for target in parameter.targets),
            nodes=frozenset(self.deck.model.nodes[rows].tolist()),
            stiffness=any(part.stiffness is not None for part in parts),
            mass=any(part.mass is not None for part in parts),
            powers=(1,),
        )

    def observation(
        self, matrices: MatrixResult, nodes: Integers, components: Integers
    ) -> Observation:
        return observe(matrices.nodes, matrices.components, nodes, components)

    def content(self, values: Values, analysis: Analysis) -> Json:
        modal = analysis if isinstance(analysis, ModalAnalysis) else ModalAnalysis(0, ())
        factors = self._factors(values)
        return {
            "solver": self.name,
            "version": self.version(),
            "reader": self.reader_version,
            "model": self.deck.model.digest,
            "factors": {name: value for name, value in factors.items() if value != 1.0},
            "n_modes": modal.n_modes,
            "nodes": list(modal.nodes),
            "groups": [[name, list(parts)] for name, parts in modal.groups],
        }

    def write(self, values: Values, analysis: Analysis, folder: Path) -> None:
        write_job(self.deck.model, self._factors(values), analysis, folder)

    def command(self, threads: int) -> Command:
        count = str(threads)
        names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
        # -P: what lies in the job's folder is data, never a module to import.
        arguments = (sys.executable, "-P", "-m", "modetune.adapters.matrices")
        return Command(arguments, tuple((name, count) for name in names))

    def read(self, values: Values, analysis: Analysis, folder: Path, return_code: int) -> Result:
        factors = self._factors(values)
        return read_result(self.deck.model, factors, analysis, folder, return_code)

    def write_updated(self, values: Values, folder: Path) -> Path:
        return write_updated(self.deck, self._factors(values), folder)

    def _factors(self, values: Values) -> dict[str, float]:
        return {
            target: values[parameter.name]
            for parameter in self.parameters
            if parameter.name in values
            for target in parameter.targets
        }


def matrices_solver(deck: Path, parameters: tuple[Parameter, ...]) -> MatricesSolver:
    """The embedded solver for a model file. Raises ModelError where it cannot be understood."""
    return MatricesSolver(read_deck(deck), parameters)
