"""A model with a test: what a campaign's parameter sets are evaluated on.

A campaign has one case, or one for each of its configurations (fuel, payload, boundary
conditions). Where modes of several cases stand side by side, as in a record, shapes of one are zero
at the sensors of the others, and a mode is told by its configuration and its number there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import chain

import numpy as np

from modetune.adapters.solver import Solver
from modetune.core.correlation.held_out import together
from modetune.core.correlation.matching import PairRules
from modetune.core.measurement.measurement import Measurement
from modetune.core.measurement.sensors import SensorMap
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

#: Elastic modes computed beyond the measured ones, so that a mode that moves up stays in sight.
EXTRA_MODES = 4
RIGID_MODES = 6


@dataclass(frozen=True, slots=True)
class Case:
    """A model with a test.

    test: the modes that are used, weighting: of these; held_out: those that are only judged by,
    held_out_deviations: (n_held_out,), relative, of their frequencies. nodes: at which pairing and
    derivatives need shapes. name: of the configuration, empty where the campaign has one
    model; columns: positions of its parameters among the campaign's, all of them where None;
    accepted: doubts about the model that are known; weight: of its residuals; aside: whether it is
    only judged by; rules: which pairs are allowed; compared: what is compared beside frequencies
    and shapes; tolerances: e1's; gauged: nodes whose displacements make strains.
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
        """Whether factors are asked for in single precision or double; None: as memory has it."""
        return {"pardiso": False, "mixed_precision": True}.get(self.eigensolver)

    @property
    def responses(self) -> tuple[Response, ...]:
        """All that is compared, in the order of the residual's rows."""
        shapes = (Shapes(self.tolerances.mac),) if self.weighting.with_shapes else ()
        return (Frequencies(self.tolerances.frequency), *shapes, *self.compared)

    def needs(self, what: Need) -> bool:
        """Whether a response of the case needs it."""
        return any(what in item.needs for item in self.responses)

    @property
    def sensors(self) -> SensorMap:
        """How the test's sensors see the model."""
        return self.mapping.sensors

    @property
    def result_nodes(self) -> tuple[int, ...]:
        """Nodes at which the modes of the whole model are wanted: for pairing, to look at, and to
        choose among poses of the test that its places cannot tell apart."""
        poses = (item.sensors.model_nodes.tolist() for item in self.mapping.others)
        return tuple(sorted({*self.nodes, *self.surface.nodes.tolist(), *chain(*poses)}))

    @property
    def n_modes(self) -> int:
        """Modes asked of the solver: the measured ones, rigid ones and some to spare."""
        by_hand = self.solver.rigid_modes
        rigid = max(RIGID_MODES, 0 if by_hand is None else by_hand.number)
        return len(self.measured.numbers) + EXTRA_MODES + rigid

    @property
    def measured(self) -> MeasuredModes:
        """All measured modes that count: used ones, then those that are held out."""
        return self.test if self.held_out is None else together(self.test, self.held_out)

    def of(self, text: str) -> str:
        """A text of this case among others."""
        return f"{text} of {self.name}" if self.name else text


def whole_test(cases: Sequence[Case]) -> MeasuredModes:
    """The modes of all tests that are used side by side."""
    if len(cases) == 1:
        return cases[0].test
    tests = [item.test for item in cases if not item.aside]
    numbers = tuple(number for test in tests for number in test.numbers)
    return MeasuredModes(numbers, side_by_side([test.modes for test in tests], node_base(tests)))


def node_base(tests: Sequence[MeasuredModes]) -> int:
    """A round number above all test nodes, at least 1000, to tell configurations' nodes apart."""
    largest = max((int(test.modes.nodes.max(initial=0)) for test in tests), default=0)
    return int(10 ** max(3, len(str(largest))))


def side_by_side(sets: Sequence[ModeSet], base: int) -> ModeSet:
    """Modes of several cases in one set, shapes of each at its own sensors only.

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
