"""What the section of a kind of response is read beside: a test, a model, the tolerances of e1."""

from __future__ import annotations

from dataclasses import dataclass

from modetune.adapters.solver import Deck
from modetune.core.measurement.frf import Complexes
from modetune.core.measurement.measurement import MeasuredFrfs, RepeatedTests
from modetune.core.measurement.sensors import SensorMap
from modetune.core.modes import MeasuredModes
from modetune.core.parameters import ParameterSet
from modetune.core.updating.criteria import Tolerances


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
