"""What the section of each kind of response tells, and the test and model it is read beside."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping
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
from modetune.core.measurement.frf import Complexes
from modetune.core.measurement.measurement import MeasuredFrfs, RepeatedTests
from modetune.core.measurement.sensors import SensorMap
from modetune.core.modes import MeasuredModes, dof_name
from modetune.core.parameters import ParameterSet
from modetune.core.updating.criteria import Tolerances
from modetune.core.updating.observation import sensor_observation
from modetune.core.updating.responses.response import Response
from modetune.flows.responses.section import OTHERS, Section, Weights


@dataclass(frozen=True, slots=True)
class TestedModel:
    """A test, of the modes that are used, and a model.

    frfs: response functions of the test, where they are asked for; seen: where their sensors and
    forces are on the model. kilograms, metres: the model's units of mass and length. notes: what
    readers said of the test. sensors: of the test's shapes on the model; complex_shapes:
    (n_sensors, n_modes), as measured, where they are not real. repeats: the tests that the test is
    the mean of.
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
    """A kind of response: what is measured of it, how exactly, and how much it counts."""

    mode_keys: ClassVar[tuple[str, ...]] = ()
    """Its keys whose values go by mode."""

    @property
    def shape_weights(self) -> Mapping[str, float]:
        """Its weights by mode, where it compares shapes."""
        return {}

    @property
    @abstractmethod
    def counts(self) -> bool:
        """Whether any of its weights is above zero."""

    @abstractmethod
    def response(self, given: TestedModel) -> Response:
        """The kind as a test and a model have it, without what `problems` tells of."""

    def problems(self, given: TestedModel) -> Iterable[tuple[Place, str]]:
        """Why some of it cannot be compared, each with its place below the section."""
        return ()


class ModewiseSection(ResponseSection):
    """A kind with a response of each mode."""

    mode_keys: ClassVar[tuple[str, ...]] = ("weight",)

    weight: Weights = Field(default=1.0, validate_default=True)
    """Emphasis, of all modes or by mode; 0 leaves them out."""

    @property
    def counts(self) -> bool:
        return any(self.weight.values())

    def weights(self, numbers: Iterable[int]) -> dict[int, float]:
        """Of the modes of these numbers; 1 of those that no key names."""
        return of_modes({OTHERS: 1.0} | self.weight, numbers)


def of_modes(given: Mapping[str, float], numbers: Iterable[int]) -> dict[int, float]:
    """What a key by mode says of the modes of these numbers; without those it does not tell."""
    told = ((n, given.get(str(n), given.get(OTHERS))) for n in numbers)
    return {n: value for n, value in told if value is not None}


def observer(what: str, seen: SensorMap, deck: Deck) -> Callable[[MatrixResult], sparse.csr_array]:
    """Gives the sensors' rows (n_sensors, n_equations) for matrices; what: is compared there."""

    def observe(here: MatrixResult) -> sparse.csr_array:
        observed = sensor_observation(seen, partial(deck.observation, here))
        for row in np.flatnonzero(observed.unknown)[:1].tolist():
            dof = dof_name((int(seen.nodes[row]), int(seen.components[row])))
            raise ModelError(f"{what}: {dof} does not follow from the matrices' unknowns")
        return observed.matrix

    return observe


def nothing_seen(here: MatrixResult) -> sparse.csr_array:
    """No sensors."""
    return sparse.csr_array((0, here.nodes.size))
