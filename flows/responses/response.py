"""Interface of response types: what the file of a type defines, and the test and model it receives.

A type's section has its campaign keys. From the test and the model it makes the Response of
`core/updating/responses`, and it requests what the solver must deliver: shapes at further nodes,
derivatives of shapes, the test's response functions on the model.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np
from pydantic import Field
from scipy import sparse

from modetune.adapters.solver import Deck
from modetune.adapters.yaml_file import Place
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import ModelError
from modetune.core.measurement.measurement import MeasuredFrfs, RepeatedTests
from modetune.core.measurement.response_functions import Complexes
from modetune.core.measurement.sensor_map import SensorMap
from modetune.core.modes import MeasuredModes, dof_name
from modetune.core.parameters import ParameterSet, ValueKind
from modetune.core.updating.criteria import Tolerances
from modetune.core.updating.observation import sensor_observation
from modetune.core.updating.responses.response import Residual, Response
from modetune.flows.responses.section import OTHERS, Section, Weights

#: `variable` parameters by name: what their values are, and their bounds.
Variables = Mapping[str, tuple[ValueKind, tuple[float, float]]]


@dataclass(frozen=True, slots=True)
class TestedModel:
    """The modes of a test that the campaign uses, and a model.

    kilograms, metres: the model's units of mass and length. frfs: the test's response functions,
    where a type compares them; seen: their sensors and forces on the model. notes: remarks of the
    readers of the test's files. sensors: sensors of the shapes on the model. complex_shapes:
    (n_sensors, n_modes) as measured, None where they are real. repeats: the tests whose mean the
    test is.
    """

    __test__ = False  # not a test of pytest's

    test: MeasuredModes
    deck: Deck
    e1: Tolerances
    parameters: ParameterSet
    kilograms: float
    metres: float
    frfs: MeasuredFrfs | None = None
    seen: SensorMap | None = None
    notes: tuple[str, ...] = ()
    sensors: SensorMap | None = None
    complex_shapes: Complexes | None = None
    repeats: RepeatedTests | None = None


class ResponseSection(Section):
    """A response type: its measured values, deviations and weights."""

    mode_keys: ClassVar[tuple[str, ...]] = ()
    """Its keys whose values go by mode."""
    shape_changes: ClassVar[bool] = False
    """Whether it needs derivatives of shapes, whatever its weights."""
    functions: ClassVar[bool] = False
    """Whether it compares the test's response functions."""

    @property
    def shape_weights(self) -> Mapping[str, float]:
        """Its weights by mode, where it compares measured shapes."""
        return {}

    @property
    @abstractmethod
    def counts(self) -> bool:
        """Whether any of its weights is above zero."""

    @abstractmethod
    def response(self, given: TestedModel) -> Response:
        """Return the response of a test and a model, without the parts that have problems."""

    def problems(self, given: TestedModel) -> Iterable[tuple[Place, str]]:
        """Return why parts of it cannot be compared, each with its place below the section."""
        return ()

    def warnings(self, given: TestedModel) -> Iterable[str]:
        """Return the parts of the test that are not compared, and why."""
        return ()

    def nodes(self, deck: Deck) -> Iterable[int]:
        """Return the nodes where it needs shapes besides those of the sensors."""
        return ()

    @property
    def variables(self) -> set[str]:
        """Names of the `variable` parameters that it refers to."""
        return set()

    def check_variables(self, variables: Variables) -> None:
        """Raise ValueError where `variables` lacks one that it refers to, or has an unfit one."""

    @staticmethod
    def scores(part: Residual) -> Iterable[tuple[str, float, float]] | None:
        """Return the report's rows of a block where they are not its values as measured.

        A row has a label, the value of a perfect model and the value of this model.
        """
        return None


class ModewiseSection(ResponseSection):
    """A type with one response per mode."""

    mode_keys: ClassVar[tuple[str, ...]] = ("weight",)

    weight: Weights = Field(default=1.0, validate_default=True)
    """Weight, one for all modes or by mode; 0 leaves a mode out."""

    @property
    def counts(self) -> bool:
        return any(self.weight.values())

    def weights(self, numbers: Iterable[int]) -> dict[int, float]:
        """Return the weights of the modes with these numbers, 1 where no key gives one."""
        return of_modes({OTHERS: 1.0} | self.weight, numbers)


def of_modes(given: Mapping[str, float], numbers: Iterable[int]) -> dict[int, float]:
    """Return the values of a key by mode for the modes that it covers."""
    found = ((n, given.get(str(n), given.get(OTHERS))) for n in numbers)
    return {n: value for n, value in found if value is not None}


@dataclass(frozen=True, slots=True)
class SensorObserver:
    """Gives the rows of sensors, (n_sensors, n_equations), for matrices of a deck.

    what: is compared there, for messages.
    """

    what: str
    seen: SensorMap
    deck: Deck

    def __call__(self, here: MatrixResult) -> sparse.csr_array:
        """Return the rows. Raises ModelError."""
        observed = sensor_observation(self.seen, partial(self.deck.observation, here))
        for row in np.flatnonzero(observed.unknown)[:1].tolist():
            dof = dof_name((int(self.seen.nodes[row]), int(self.seen.components[row])))
            raise ModelError(f"{self.what}: {dof} does not follow from the matrices' unknowns")
        return observed.matrix


def nothing_seen(here: MatrixResult) -> sparse.csr_array:
    """Return the rows of no sensors."""
    return sparse.csr_array((0, here.nodes.size))
