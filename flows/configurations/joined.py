"""Several configurations of one structure side by side: their parts of the campaign made one.

Each configuration (fuel, payload, boundary conditions) has a model and a test of its own and
shares parameters with the others. To the updating loop they are one model with one test: the modes
of all configurations stand side by side, shapes of one are zero at the sensors of the others, and
numbers are made unique (`core/numbering.py`). Here are the parts that are made so; `campaign.py`
puts the campaign together, `joint.py` evaluates it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from modetune.adapters.solver import (
    Analysis,
    Capabilities,
    Command,
    Footprint,
    ModelSummary,
    Solver,
)
from modetune.core.errors import CampaignError
from modetune.core.keys import Json
from modetune.core.mesh import Mesh
from modetune.core.modes import Integers, MeasuredModes, ModeSet, mode_set
from modetune.core.numbering import numbered
from modetune.core.observation import Observation, nothing_known
from modetune.core.parameters import Parameter, ParameterSet, Values
from modetune.core.results import MatrixResult, Result
from modetune.core.sensors import by_number
from modetune.core.surface import Surface
from modetune.flows.sensors.mapping import Mapping


@dataclass(frozen=True, slots=True)
class JointPart:
    """What of a configuration the solver of the whole is made from."""

    name: str
    solver: Solver
    parameters: ParameterSet


@dataclass(frozen=True, slots=True)
class JointSolver:
    """The solvers of all configurations as one, for what a campaign asks of the whole.

    It runs nothing: jobs go to the configurations' own solvers. Raises CampaignError where one
    model is wanted.
    """

    parts: tuple[JointPart, ...]

    @property
    def name(self) -> str:
        return "+".join(dict.fromkeys(part.solver.name for part in self.parts))

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(strain_energies=False, matrices=False)

    @property
    def model(self) -> ModelSummary:
        raise CampaignError(self._one_model())

    def mesh(self) -> Mesh:
        """No mesh: several models have no common place."""
        return Mesh(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), ())

    def version(self) -> str:
        return ", ".join(dict.fromkeys(part.solver.version() for part in self.parts))

    def problems(self, parameters: tuple[Parameter, ...]) -> list[str]:
        return []

    def deck_value(self, parameter: Parameter) -> float:
        """Of the first configuration that the parameter belongs to."""
        return self._first(parameter).solver.deck_value(parameter)

    def written(self, parameter: Parameter, value: float) -> float:
        return self._first(parameter).solver.written(parameter, value)

    def wave_speeds(self) -> dict[str, float]:
        return {}

    def energy_sets(self, parameter: Parameter) -> tuple[str, ...]:
        return ()

    def is_linear(self, parameter: Parameter) -> bool:
        return all(
            part.solver.is_linear(parameter)
            for part in self.parts if parameter.name in part.parameters.names
        )  # fmt: skip

    def footprint(self, parameter: Parameter) -> Footprint | None:
        return None

    def observation(
        self, matrices: MatrixResult, nodes: Integers, components: Integers
    ) -> Observation:
        return nothing_known(nodes.size, matrices.nodes.size)

    def content(self, values: Values, analysis: Analysis) -> Json:
        """The contents of all configurations by their names."""
        return {part.name: part.solver.content(_own(part, values), analysis) for part in self.parts}

    def write(self, values: Values, analysis: Analysis, folder: Path) -> None:
        raise CampaignError(self._one_model())

    def command(self, threads: int) -> Command:
        raise CampaignError(self._one_model())

    def read(self, values: Values, analysis: Analysis, folder: Path, return_code: int) -> Result:
        raise CampaignError(self._one_model())

    def write_updated(self, values: Values, folder: Path) -> Path:
        """The updated decks, each in a folder of its configuration's name; returns the folder."""
        for part in self.parts:
            part.solver.write_updated(_own(part, values), folder / part.name)
        return folder

    def _first(self, parameter: Parameter) -> JointPart:
        return next(part for part in self.parts if parameter.name in part.parameters.names)

    def _one_model(self) -> str:
        names = ", ".join(part.name for part in self.parts)
        return (
            f"this command works on one model, and the campaign has several configurations "
            f"({names}); give it a campaign file with one of them as `model` and `test`"
        )


def _own(part: JointPart, values: Values) -> dict[str, float]:
    return {name: value for name, value in values.items() if name in part.parameters.names}


def joint_test(tests: Sequence[tuple[int, MeasuredModes]]) -> MeasuredModes:
    """The modes of several tests side by side; of each its configuration's place comes first."""
    numbers = tuple(numbered(place, n) for place, test in tests for n in test.numbers)
    modes = [(place, test.modes) for place, test in tests]
    return MeasuredModes(numbers, side_by_side(modes, node_base([test for _, test in tests])))


def node_base(tests: Sequence[MeasuredModes]) -> int:
    """A round number above all test nodes, at least 1000, to tell configurations' nodes apart."""
    largest = max((int(test.modes.nodes.max(initial=0)) for test in tests), default=0)
    return int(10 ** max(3, len(str(largest))))


def side_by_side(sets: Sequence[tuple[int, ModeSet]], base: int) -> ModeSet:
    """Modes of several configurations in one set, shapes of each at its own sensors only.

    sets: of each its configuration's place; node n of that becomes base * place + n.
    """
    shapes = np.zeros((sum(m.n_dof for _, m in sets), sum(m.n_modes for _, m in sets)))
    row = column = 0
    for _, modes in sets:
        shapes[row : row + modes.n_dof, column : column + modes.n_modes] = np.real(
            modes.mode_shapes
        )
        row, column = row + modes.n_dof, column + modes.n_modes
    known = all(modes.damping_ratios.size for _, modes in sets)
    return mode_set(
        np.concatenate([modes.frequencies_hz for _, modes in sets]),
        shapes,
        np.concatenate([base * place + modes.nodes for place, modes in sets]),
        np.concatenate([modes.components for _, modes in sets]),
        np.concatenate([modes.damping_ratios for _, modes in sets]) if known else (),
    )


def no_sensors() -> Mapping:
    """The mapping of a campaign that has no one model for sensors to be on."""
    nothing = np.zeros(0, dtype=np.int64)
    return Mapping(by_number(nothing, nothing), nothing, None, np.zeros((0, 3)), (), 0.0)


def no_surface() -> Surface:
    """The surface of no one model."""
    nothing = np.zeros(0, dtype=np.int64)
    return Surface(nothing, np.zeros((0, 3)), nothing.reshape(0, 3), nothing.reshape(0, 2))
