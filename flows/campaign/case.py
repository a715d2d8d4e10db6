"""A model with a test, on which a campaign evaluates parameter values.

A campaign has one case, or one for each of its configurations (fuel, payload, boundary
conditions). Where a record has modes of several cases, shapes of one case are zero at the sensors
of the others, and a mode is identified by its configuration and its number there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import chain

import numpy as np

from modetune.adapters.solver import Solver
from modetune.core.correlation.holdout import together
from modetune.core.correlation.pairing import PairRules
from modetune.core.measurement.measurement import Measurement
from modetune.core.measurement.sensor_map import SensorMap
from modetune.core.modes import Floats, MeasuredModes, ModeSet, mode_set
from modetune.core.surface import Surface
from modetune.core.updating.criteria import Tolerances
from modetune.core.updating.responses.frequencies import Frequencies
from modetune.core.updating.responses.response import Need, Response
from modetune.core.updating.responses.shapes import Shapes
from modetune.core.updating.weighting import Weighting
from modetune.flows.campaign.mapping import Mapping
from modetune.flows.campaign.schema import Eigensolver, ModelCheck
from modetune.flows.campaign.units import Units

#: Elastic modes computed beyond the measured ones, for measured modes whose number rises.
EXTRA_MODES = 4
RIGID_MODES = 6


@dataclass(frozen=True, slots=True)
class Case:
    """A model with a test.

    test: the modes that are used; weighting: their deviations and weights. held_out: modes for
    judging only; held_out_deviations: (n_held_out,), relative, of their frequencies. nodes: nodes
    where pairing and derivatives need shapes. name: of the configuration, empty where the campaign
    has one model. columns: positions of its parameters among the campaign's, None for all.
    accepted: doubts about the model that the user accepts. weight: of its residuals. aside: whether
    it is for judging only. rules: which pairs are allowed. compared: responses besides frequencies
    and shapes. tolerances: those of e1. gauged: nodes whose displacements make strains.
    """

    solver: Solver
    units: Units
    measurement: Measurement
    test: MeasuredModes
    mapping: Mapping
    surface: Surface
    nodes: tuple[int, ...]
    weighting: Weighting
    held_out: MeasuredModes | None = None
    held_out_deviations: Floats = field(default_factory=lambda: np.zeros(0))
    eigensolver: Eigensolver = "solver"
    accepted: tuple[ModelCheck, ...] = ()
    name: str = ""
    columns: tuple[int, ...] | None = None
    weight: float = 1.0
    aside: bool = False
    rules: PairRules = field(default_factory=PairRules)
    compared: tuple[Response, ...] = ()
    tolerances: Tolerances = field(default_factory=Tolerances)
    gauged: tuple[int, ...] = ()

    @property
    def single_factors(self) -> bool | None:
        """Whether the campaign requires factors in single precision; None: as memory allows."""
        return {"pardiso": False, "mixed_precision": True}.get(self.eigensolver)

    @property
    def responses(self) -> tuple[Response, ...]:
        """All responses, in the order of the residual's rows."""
        shapes = (Shapes(self.tolerances.mac),) if self.weighting.with_shapes else ()
        return (Frequencies(self.tolerances.frequency), *shapes, *self.compared)

    def needs(self, what: Need) -> bool:
        """Return whether a response of the case needs this."""
        return any(what in item.needs for item in self.responses)

    @property
    def sensors(self) -> SensorMap:
        """The test's sensors on the model."""
        return self.mapping.sensors

    @property
    def result_nodes(self) -> tuple[int, ...]:
        """Nodes where the modes of the whole model are needed: for pairing, for pictures, and to
        choose among poses of the test that fit equally well."""
        poses = (item.sensors.seen_nodes.tolist() for item in self.mapping.others)
        return tuple(sorted({*self.nodes, *self.surface.nodes.tolist(), *chain(*poses)}))

    @property
    def rotation_nodes(self) -> tuple[int, ...]:
        """Nodes whose rotations are needed: of sensors of rotations and of those off an axis."""
        seen = [item.sensors.seen_components() for item in (self.mapping, *self.mapping.others)]
        return tuple(sorted({int(n) for nodes, axes in seen for n in nodes[axes > 3]}))

    @property
    def n_modes(self) -> int:
        """Modes requested from the solver: the measured ones, rigid ones and some in reserve."""
        by_hand = self.solver.rigid_modes
        rigid = max(RIGID_MODES, 0 if by_hand is None else by_hand.number)
        return len(self.measured.numbers) + EXTRA_MODES + rigid

    @property
    def measured(self) -> MeasuredModes:
        """All measured modes of the case: used ones, then held-out ones."""
        return self.test if self.held_out is None else together(self.test, self.held_out)

    def of(self, text: str) -> str:
        """Return a text with the name of the case, where it has one."""
        return f"{text} of {self.name}" if self.name else text


def whole_test(cases: Sequence[Case]) -> MeasuredModes:
    """Return the used modes of all tests in one set."""
    if len(cases) == 1:
        return cases[0].test
    tests = [item.test for item in cases if not item.aside]
    numbers = tuple(number for test in tests for number in test.numbers)
    return MeasuredModes(numbers, side_by_side([test.modes for test in tests], node_base(tests)))


def node_base(tests: Sequence[MeasuredModes]) -> int:
    """Return a round number above all test nodes, at least 1000."""
    largest = max((int(test.modes.nodes.max(initial=0)) for test in tests), default=0)
    return int(10 ** max(3, len(str(largest))))


def side_by_side(sets: Sequence[ModeSet], base: int) -> ModeSet:
    """Return the modes of several cases in one set, shapes of each only at its own sensors.

    Node n of the k-th (from 1) becomes base * k + n.
    """
    shapes = np.zeros((sum(modes.n_dof for modes in sets), sum(modes.n_modes for modes in sets)))
    row = column = 0
    for modes in sets:
        shapes[row : row + modes.n_dof, column : column + modes.n_modes] = np.real(
            modes.mode_shapes
        )
        row, column = row + modes.n_dof, column + modes.n_modes
    known = all(modes.damping_ratios.size for modes in sets)
    return mode_set(
        np.concatenate([modes.frequencies_hz for modes in sets]),
        shapes,
        np.concatenate([base * place + modes.nodes for place, modes in enumerate(sets, start=1)]),
        np.concatenate([modes.components for modes in sets]),
        np.concatenate([modes.damping_ratios for modes in sets]) if known else (),
    )
