"""The evaluation of a point: in each case the modes, their pairs in the test, and the differences.

For the step, the results of all cases are combined: residuals and sensitivities are stacked by type
of response, and within a type by case.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy

from modetune.core.correlation.clusters import rotation_to_test
from modetune.core.correlation.holdout import HeldOut, judge_held_out, pair_held_out, track_held_out
from modetune.core.correlation.pairing import (
    Pairing,
    PairRules,
    UncertainPairs,
    first_pairing,
    next_pairing,
    uncertain_pairs,
)
from modetune.core.errors import ModesError
from modetune.core.modes import Floats, Integers, MeasuredModes, ModeSet
from modetune.core.updating.criteria import Tolerances, agrees, frequency_errors
from modetune.core.updating.job_results import ModalResult
from modetune.core.updating.parameter_steps import Step, breach
from modetune.core.updating.residual import residual, responses_agree
from modetune.core.updating.responses.response import (
    MatricesAt,
    ModelState,
    Residual,
    Response,
    block_parts,
    stacked,
    stacked_rows,
    with_values,
)
from modetune.core.updating.sensitivity import ModeDerivatives
from modetune.flows.campaign.case import Case, node_base, side_by_side
from modetune.flows.diagnosis.causes import cause_sentences
from modetune.flows.diagnosis.missing_modes import order_findings
from modetune.flows.diagnosis.pairing import factor_findings

#: Maximum number of points from which modes are tracked: the nearest of so many is close enough,
#: and each takes memory.
MOST_KNOWN = 400
#: Response types whose e1 is checked on the pairs, even if the residual leaves them out.
BY_MODES = ("frequencies", "shapes", "mac")
#: Those of them that predict a MAC.
BY_SHAPES = ("shapes", "mac")


@dataclass(frozen=True, slots=True)
class Point:
    """The point of derivatives: parameter values, the modes there, and the paired ones.

    key: of the modes' result.
    """

    theta: Floats
    key: str
    modal: ModalResult
    pairing: Pairing


@dataclass(frozen=True, slots=True)
class CaseEvaluation:
    """A model state compared with the test of its case.

    theta: the case's own parameters. modal: modes at the nodes that pairing and derivatives need.
    seen: its elastic modes at the test's sensors. whole: the modes at every requested node.
    held_out: positions of the test's held-out modes among them. solved_by: the program that
    computed the modes. responses: the compared responses. matrices: if a response needs them.
    """

    theta: Floats
    key: str
    modal: ModalResult
    seen: ModeSet
    whole: ModalResult
    pairing: Pairing
    residual: Residual
    errors: Floats
    held_out: Pairing | None
    solved_by: str
    responses: tuple[Response, ...]
    matrices: MatricesAt | None = None

    @property
    def point(self) -> Point:
        return Point(self.theta, self.key, self.modal, self.pairing)


@dataclass(frozen=True, slots=True)
class Evaluation:
    """A point compared with the tests of all cases.

    parts: of each case, in the campaign's order. seen, pairing, residual, errors: of all cases
    together.
    """

    theta: Floats
    parts: tuple[CaseEvaluation, ...]
    seen: ModeSet
    pairing: Pairing
    residual: Residual
    errors: Floats

    @property
    def key(self) -> str:
        """Return the keys of the modes' results."""
        return " ".join(part.key for part in self.parts)

    @property
    def solved_by(self) -> str:
        """Return the programs that computed the modes."""
        return "+".join(dict.fromkeys(part.solved_by for part in self.parts))

    def agrees(self, tolerances: Tolerances) -> bool:
        """Return whether e1 holds; members of a cluster of close modes are judged by its space."""
        return agrees(self.used_errors, self.pairing.judged_mac, tolerances) and not self.unmet

    @property
    def unmet(self) -> tuple[str, ...]:
        """Return the limits and response types that disagree, besides frequencies and shapes."""
        kinds = [
            item.kind.replace("_", " ")
            for part in self.parts
            for item in part.responses
            if item.kind not in BY_MODES and not responses_agree([item], part.residual)
        ]
        broken = breach(self.residual.values, self.residual.limits) > 0.0
        limits = [f"the limit of {self.residual.labels[row]}" for row in np.flatnonzero(broken)]
        return tuple(dict.fromkeys([*kinds, *limits]))

    @property
    def used_errors(self) -> Floats:
        """Return the errors of the compared frequencies."""
        return self.residual.of_used("frequencies", self.errors)


@dataclass(frozen=True, slots=True)
class Matrix:
    """A sensitivity matrix.

    values: (n_residuals, n_parameters). methods: the method of each column. keys: of its jobs.
    age: in iterations. missing: positions of unavailable columns, which are zero in values.
    """

    values: Floats
    methods: tuple[str, ...]
    keys: tuple[str, ...]
    age: int
    missing: tuple[int, ...] = ()

    @property
    def methods_had(self) -> tuple[str, ...]:
        """Return the method of each column, `missing` if it is unavailable."""
        return tuple(
            "missing" if column in self.missing else method
            for column, method in enumerate(self.methods)
        )


def compare(
    case: Case,
    theta: Floats,
    key: str,
    result: ModalResult,
    previous: CaseEvaluation | None,
    solved_by: str,
    drop: bool = False,
    matrices: MatricesAt | None = None,
) -> CaseEvaluation:
    """Pair the modes of a model state with the test of its case. Raises LostMode, ModesError.

    solved_by: the program that computed the modes. drop: leave out modes without a partner if
    nothing was paired before. matrices: if a response needs them. Measured shapes decide the pairs.
    Without them the pairs of `previous` are tracked; at the first point the order of frequencies
    decides. If shapes are compared, close modes are rotated within their space to match the test.
    """
    modal = result.at(case.nodes)
    elastic = modal.elastic
    seen, pairing = _paired(case, elastic, previous, drop)
    test = case.test
    if test.has_shapes and case.needs("shapes"):
        rotation = rotation_to_test(test.modes, seen, pairing, case.weighting.frequency_deviations)
        if rotation is not None:
            result = result.turned(rotation)
            modal = result.at(case.nodes)
            elastic = modal.elastic
            seen, pairing = _paired(case, elastic, previous, drop)
    state = model_state(case, seen, pairing, modal, matrices)
    return CaseEvaluation(
        theta=theta,
        key=key,
        modal=modal,
        seen=seen,
        whole=result,
        pairing=pairing,
        residual=residual(case.responses, state),
        errors=frequency_errors(test.modes, seen, pairing),
        held_out=_held_out(case, seen, pairing, previous),
        solved_by=solved_by,
        responses=case.responses,
        matrices=matrices,
    )


def model_state(
    case: Case, seen: ModeSet, pairing: Pairing, modal: ModalResult, matrices: MatricesAt | None
) -> ModelState:
    """Return the state of the model for the responses of a case."""
    mesh = None if matrices is None else case.solver.deck.mesh()
    return ModelState(case.test, case.weighting, seen, pairing, modal, matrices, mesh)


def _paired(
    case: Case, elastic: ModeSet, previous: CaseEvaluation | None, drop: bool
) -> tuple[ModeSet, Pairing]:
    """Return the elastic modes at the test's sensors, and their pairs."""
    test, rules, resolution = case.test, case.rules, case.weighting.frequency_deviations
    seen = case.sensors.observe(elastic) if test.has_shapes else elastic
    if previous is not None:
        # Without shapes `seen` is the elastic modes themselves.
        known = previous.modal.elastic if test.has_shapes else previous.seen
        before = previous.pairing, known
        return seen, next_pairing(test, seen, elastic, before, rules, resolution)
    others = np.zeros(0) if case.held_out is None else case.held_out.modes.frequencies_hz
    drop = drop or (rules.drop and not test.has_shapes)  # more modes would not change the order
    pairing = first_pairing(test, seen, rules, resolution, others, drop)
    if test.modes.n_modes and not pairing.measured.size and not case.compared:
        raise ModesError(
            "no measured mode has a partner among the computed modes, and `test.unmatched: drop` "
            "leaves out all of them: check the sensors' nodes and directions, and the units"
        )
    refuse_uncertain(test, seen, pairing, rules)
    return seen, pairing


def refuse_uncertain(
    test: MeasuredModes, computed: ModeSet, pairing: Pairing, rules: PairRules
) -> None:
    """Raise UncertainPairs if there are any."""
    found = uncertain_pairs(test, computed, pairing, rules)
    if not found:
        return
    factor = tuple(factor_findings(test, computed, rules))
    if any(item.level == "wrong" for item in factor):
        raise UncertainPairs(f"{factor[0].text} (no shapes were measured, only the order pairs)")
    reasons = cause_sentences((*factor, *order_findings(test, computed, rules)))
    text = "; ".join(f"mode {number}: {reason}" for number, reason in found.items())
    confirm = _remedy(test, pairing, list(found))
    raise UncertainPairs(
        "no shapes were measured, and by the order of frequencies alone these pairs are not "
        + ". ".join((f"certain: {text}", confirm, *reasons)).rstrip(".")
    )


def _remedy(test: MeasuredModes, pairing: Pairing, numbers: Sequence[int]) -> str:
    """Return a sentence about how to confirm pairs. numbers: of the test's modes."""
    own = {
        test.numbers[row]: column + 1
        for row, column in zip(pairing.measured.tolist(), pairing.computed.tolist(), strict=True)
    }
    pairs = ", ".join(f"{number}: {own[number]}" for number in numbers if number in own)
    return (
        f"`test.pairs: {{{pairs}}}` confirms them; other numbers pair test modes with other "
        "elastic modes, and `test.use` leaves out a mode that the model lacks"
    )


def _held_out(
    case: Case, seen: ModeSet, pairing: Pairing, previous: CaseEvaluation | None
) -> Pairing | None:
    """Return the positions of held-out modes; a lost one is not an error."""
    held = case.held_out
    if held is None:
        return None
    if held.has_shapes or previous is None or previous.held_out is None:
        return pair_held_out(held, case.test, seen, pairing)
    return track_held_out(previous.held_out, previous.seen, seen, pairing)


def judged(case: Case, initial: CaseEvaluation, updated: CaseEvaluation) -> HeldOut | None:
    """Return the held-out modes before and after updating; None if there are none."""
    if case.held_out is None or initial.held_out is None or updated.held_out is None:
        return None
    return judge_held_out(
        case.held_out,
        case.held_out_deviations,
        (initial.seen, initial.held_out),
        (updated.seen, updated.held_out),
    )


def whole_evaluation(
    cases: Sequence[Case], theta: Floats, parts: Sequence[CaseEvaluation]
) -> Evaluation:
    """Combine the evaluations of all cases, each with the weight of its case."""
    return Evaluation(
        theta=theta,
        parts=tuple(parts),
        seen=_all_seen(cases, parts),
        pairing=_all_pairs(cases, parts),
        residual=stacked([_in_whole(*both) for both in zip(cases, parts, strict=True)]),
        errors=np.concatenate([part.errors for part in parts]),
    )


def _in_whole(case: Case, part: CaseEvaluation) -> list[Residual]:
    """Return the blocks of a case with its weight and name."""
    return [
        replace(
            own,
            weights=case.weight * own.weights,
            blocks=tuple(replace(b, names=tuple(map(case.of, b.names))) for b in own.blocks),
        )
        for own in block_parts(part.residual)
    ]


def part_rows(parts: Sequence[CaseEvaluation]) -> list[Integers]:
    """Return the rows of each case in the whole residual."""
    return stacked_rows([part.residual for part in parts])


def _all_seen(cases: Sequence[Case], parts: Sequence[CaseEvaluation]) -> ModeSet:
    """Return the modes of all cases, each at its own sensors."""
    if len(parts) == 1:
        return parts[0].seen
    seen = [
        part.seen if case.test.has_shapes else part.seen.rows([])
        for case, part in zip(cases, parts, strict=True)
    ]
    return side_by_side(seen, node_base([case.test for case in cases]))


def _all_pairs(cases: Sequence[Case], parts: Sequence[CaseEvaluation]) -> Pairing:
    """Return the pairs of all cases, with positions numbered over all cases."""
    if len(parts) == 1:
        return parts[0].pairing
    measured, computed, reasons = [], [], []
    n_measured = n_computed = 0
    for case, part in zip(cases, parts, strict=True):
        measured.append(part.pairing.measured + n_measured)
        computed.append(part.pairing.computed + n_computed)
        reasons += [f"{reason} ({case.name})" for reason in part.pairing.reasons]
        n_measured += case.test.modes.n_modes
        n_computed += part.seen.n_modes
    return Pairing(
        np.concatenate(measured),
        np.concatenate(computed),
        np.concatenate([part.pairing.mac for part in parts]),
        np.concatenate([part.pairing.subspace_mac for part in parts]),
        tuple(reasons),
    )


def expects_agreement(step: Step, evaluation: Evaluation, tolerances: Tolerances) -> bool:
    """Return whether the linear model predicts that e1 holds after a step.

    Then the modal job runs alone, since sensitivities would probably not be used.
    """
    rows = part_rows(evaluation.parts)
    return all(
        _expects(step.predicted[own], part, tolerances)
        for part, own in zip(evaluation.parts, rows, strict=True)
    )


def _expects(predicted: Floats, part: CaseEvaluation, tolerances: Tolerances) -> bool:
    foreseen = with_values(part.residual, predicted)
    if not any(foreseen.has(kind) for kind in BY_SHAPES) and not agrees(
        np.zeros(0), part.pairing.judged_mac, tolerances
    ):
        return False
    return responses_agree(part.responses, foreseen)


def at_sensors(case: Case, part: CaseEvaluation, derivatives: ModeDerivatives) -> ModeDerivatives:
    """Return derivatives with those of shapes at the test's sensors."""
    if not case.needs("shapes"):
        return derivatives
    modes = part.modal.modes
    observer = case.sensors.matrix(modes.nodes, modes.components)
    shapes = derivatives.mode_shapes
    seen = observer @ shapes.reshape(shapes.shape[0], -1)
    return replace(
        derivatives, mode_shapes=np.asarray(seen).reshape(seen.shape[0], *shapes.shape[1:])
    )


@dataclass(slots=True)
class ModeTrack:
    """Evaluated points. If the test has no shapes, modes are tracked from the nearest of them.

    width: (n_parameters,), the unit of distances; extend: whether new points join, up to
    MOST_KNOWN.
    """

    width: Floats
    known: list[Evaluation]
    extend: bool
    _places: Floats = field(default_factory=lambda: np.zeros((0, 0)))

    def next(self, thetas: Floats, waiting: Sequence[int]) -> int:
        """Return the waiting point that is nearest to a known one."""
        if not (self.known and self.extend) or len(waiting) == 1:
            return waiting[0]
        return waiting[int(np.argmin(self._distances(thetas[list(waiting)]).min(axis=1)))]

    def nearest(self, theta: Floats) -> Evaluation | None:
        """Return the known point nearest to a point."""
        if len(self.known) < 2:
            return self.known[0] if self.known else None
        return self.known[int(np.argmin(self._distances(theta[None])))]

    def join(self, evaluation: Evaluation) -> None:
        """Add a new point, if points may join."""
        if self.extend and len(self.known) < MOST_KNOWN:
            self.known.append(evaluation)

    def _distances(self, thetas: Floats) -> Floats:
        if len(self._places) != len(self.known):
            self._places = np.stack([evaluation.theta for evaluation in self.known]) / self.width
        return np.asarray(
            scipy.spatial.distance.cdist(thetas / self.width, self._places, "sqeuclidean")
        )
