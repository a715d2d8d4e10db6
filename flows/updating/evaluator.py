"""The evaluator: from parameter values and a campaign's cases to evaluations and sensitivities.

Each case has a source of its modes (`mode_source.py`) and shares parameters with the others. The
solver work of all cases at a point is submitted together, so that their jobs run in parallel, and
is counted. If a mode is lost the computed range of its case is widened and the modes are paired
again; a source that turns out to be wrong is replaced.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Protocol

import numpy as np
import scipy

from modetune.adapters.solver import Analysis, MatrixAnalysis, ModalAnalysis
from modetune.core.algebra.factor_room import factor_room
from modetune.core.correlation.pairing import LostMode, NotAmongComputed, Pairing
from modetune.core.errors import ModesError, ModetuneError, SolverError
from modetune.core.modes import Floats, Integers, mode_name
from modetune.core.storage.campaign_record import RunCounts
from modetune.core.updating.job_results import ModalResult
from modetune.core.updating.parameter_steps import Step
from modetune.core.updating.reduced_model import RangeUse
from modetune.core.updating.residual import residual_sensitivity
from modetune.core.updating.responses.frequencies import Frequencies
from modetune.core.updating.responses.response import ModelState, StateDerivatives
from modetune.core.updating.sensitivity import ModeDerivatives
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.case import Case
from modetune.flows.jobs.engine import JobEngine, JobOutcome
from modetune.flows.jobs.execution import Done, Execution, Work
from modetune.flows.jobs.job import Job, analysis_kind
from modetune.flows.jobs.watching import doing
from modetune.flows.updating.evaluation import (
    CaseEvaluation,
    Evaluation,
    Matrix,
    Point,
    compare,
    model_state,
    part_rows,
    whole_evaluation,
)
from modetune.flows.updating.matrices import one_thread
from modetune.flows.updating.mode_source import (
    CAMPAIGNS_OWN,
    MANY,
    REDUCED,
    UNFIT,
    Columns,
    ModeFinder,
    by_solver,
    confirms_by_matrices,
    unless_failed,
)
from modetune.flows.updating.sensitivities import UnbalancedEnergies, by_energies

logger = logging.getLogger(__name__)

#: How often the computed range is widened in search of a lost mode.
WIDENINGS = 1
#: Sets that modes are tracked from at most: the nearest of so many is near, and they fill memory.
MOST_KNOWN = 400
#: What pieces are told under that are carried out once more, for a mode that was lost.
MORE = ", more modes"
#: Sets whose shapes are in memory at once.
TOGETHER = 256


@dataclass(slots=True, eq=False)
class CaseState:
    """A case under evaluation.

    campaign: the one that the case would make alone; columns: positions of its parameters among
    all; engine: of its model; analysis: what its modal runs are asked for by now.
    """

    case: Case
    campaign: Campaign
    columns: Integers
    engine: JobEngine
    finder: ModeFinder
    analysis: ModalAnalysis

    def own(self, theta: Floats) -> Floats:
        """The case's own parameters among all."""
        return theta[self.columns]

    def compared(
        self,
        theta: Floats,
        key: str,
        modal: ModalResult,
        before: CaseEvaluation | None,
        solved_by: str,
        drop: bool = False,
    ) -> CaseEvaluation:
        """Modes at the case's own parameters beside its test: `compare`."""
        matrices = self.finder.assembled(theta) if self.case.needs("matrices") else None
        with factor_room(self.engine.room):
            return compare(self.case, theta, key, modal, before, solved_by, drop, matrices)

    def named(self, work: Work) -> Work:
        """A piece of work under the case's name, for its engine."""
        return Work(self.case.of(work.name), work.jobs, work.engine or self.engine)


@dataclass(slots=True, eq=False)
class AskedModes:
    """A case at a parameter set, on its way to an evaluation; widened: how often so far."""

    point: int
    state: CaseState
    theta: Floats
    analysis: ModalAnalysis
    widened: int = 0

    def widen(self, error: LostMode, there: int) -> bool:
        """Ask for more modes; false where it is of no use.

        there: modes that were found; a model of a few unknowns has no more than it gave.
        """
        few = there < self.analysis.n_modes
        if self.widened == WIDENINGS or few or not error.above:
            return False
        self.widened += 1
        n_modes = self.analysis.n_modes + max(4, self.analysis.n_modes // 2)
        self.analysis = replace(self.analysis, n_modes=n_modes)
        logger.info("%s; widening the range to %d modes", error, n_modes)
        return True

    def answered(
        self, done: Sequence[Done], before: CaseEvaluation | None
    ) -> CaseEvaluation | None:
        """The case's evaluation, from what became of its work; None where it is to be asked again.

        before: that of the set that modes are tracked from.
        """
        state = self.state
        try:
            key, modal = state.finder.modes(self.theta, self.analysis, done)
        except UNFIT as error:
            state.finder = state.finder.instead(error)
            return None
        try:
            part = self.compared(key, modal, before)
        except LostMode as error:
            if self.widen(error, modal.modes.n_modes):
                return None
            if isinstance(error, NotAmongComputed):
                raise
            if before is not None or not state.case.rules.drop:
                raise _lost(error) from error
            part = self.compared(key, modal, before, drop=True)
        if before is None:
            _tell_dropped(state.case, part.pairing)
        return part

    def compared(
        self, key: str, modal: ModalResult, before: CaseEvaluation | None, drop: bool = False
    ) -> CaseEvaluation:
        """Modes that were found beside those of the test. Raises LostMode."""
        state = self.state
        return state.compared(self.theta, key, modal, before, state.finder.name, drop)


@dataclass(slots=True)
class ModeTrack:
    """Evaluation points that modes are tracked from, where the test has no shapes: the nearest one.

    width: (n_parameters,), what distances are measured by; grows: whether new sets join them, till
    there are MOST_KNOWN.
    """

    width: Floats
    known: list[Evaluation]
    grows: bool
    _places: Floats = field(default_factory=lambda: np.zeros((0, 0)))

    def next(self, thetas: Floats, waiting: Sequence[int]) -> int:
        """The waiting set that is nearest to one that is known, where the known grow by it."""
        if not (self.known and self.grows) or len(waiting) == 1:
            return waiting[0]
        return waiting[int(np.argmin(self._distances(thetas[list(waiting)]).min(axis=1)))]

    def nearest(self, theta: Floats) -> Evaluation | None:
        """The known set that is nearest to a set."""
        if len(self.known) < 2:
            return self.known[0] if self.known else None
        return self.known[int(np.argmin(self._distances(theta[None])))]

    def join(self, evaluation: Evaluation) -> None:
        """A new set, which others may be tracked from."""
        if self.grows and len(self.known) < MOST_KNOWN:
            self.known.append(evaluation)

    def _distances(self, thetas: Floats) -> Floats:
        if len(self._places) != len(self.known):
            self._places = np.stack([evaluation.theta for evaluation in self.known]) / self.width
        return np.asarray(
            scipy.spatial.distance.cdist(thetas / self.width, self._places, "sqeuclidean")
        )


#: A piece of work of a case.
Piece = tuple[CaseState, Work]


#: What became of pieces by what they are, for those that are asked for again.
Ahead = dict[tuple[object, ...], Done]


def _lost(error: LostMode) -> LostMode:
    """A lost mode with what the campaign can say of it."""
    return LostMode(
        f"{error}; `test.unmatched: drop` updates without it, and `test.pairs` names its partner "
        "by hand (see `modetune check`)"
    )


def _tell_dropped(case: Case, pairing: Pairing) -> None:
    """Warn of the modes that are left out."""
    for row in np.setdiff1d(np.arange(case.test.modes.n_modes), pairing.measured).tolist():
        logger.warning(
            "%s at %.4g Hz has no partner among the computed modes and is left out "
            "(test.unmatched: drop): nothing is compared with it",
            mode_name(case.test.numbers[row], case.name),
            case.test.modes.frequencies_hz[row],
        )


class Pieces:
    """Where pieces are carried out, and what they cost so far."""

    def __init__(self, execution: Execution) -> None:
        self.execution = execution
        self._runs = RunCounts()

    @property
    def runs(self) -> RunCounts:
        """Solver runs so far, and what they cost."""
        ledger = self.execution.engine.ledger
        return replace(self._runs, core_s=ledger.core_s, licence_s=ledger.licence_s)

    def run(
        self, title: str, works: Sequence[Piece], ahead: Ahead, beside: Sequence[Piece] = ()
    ) -> list[Done]:
        """What became of each piece, in order, and counts the runs.

        Pieces that were carried out ahead are not run again; those beside are kept for later.
        """
        listed = {_identity(piece): piece for piece in (*works, *beside)}
        missing = {mark: piece for mark, piece in listed.items() if mark not in ahead}
        if missing:
            named = _numbered([state.named(work) for state, work in missing.values()])
            for mark, work, done in zip(
                missing, named, self.execution.run(title, named), strict=True
            ):
                ahead[mark] = done
                if not isinstance(done, ModetuneError):
                    self._runs = self._runs.plus(outcomes_count(work.name, done))
        return [ahead[_identity(piece)] for piece in works]

    def modes(
        self, title: str, state: CaseState, theta: Floats, analysis: ModalAnalysis
    ) -> tuple[str, ModalResult]:
        """The key and the modes of one case at a set."""
        while True:
            works = [(state, work) for work in state.finder.works(theta, analysis)]
            done = self.run(title, works, Ahead())
            try:
                with doing(title):
                    return state.finder.modes(theta, analysis, done)
            except UNFIT as error:
                state.finder = state.finder.instead(error)


def _numbered(works: Sequence[Work]) -> list[Work]:
    """Pieces with a name each: those of one name, as of many sets, are numbered."""
    many, place = Counter(work.name for work in works), Counter[str]()
    told = []
    for work in works:
        place[work.name] += 1
        which = f" {place[work.name]} of {many[work.name]}" if many[work.name] > 1 else ""
        told.append(replace(work, name=work.name + which))
    return told


def _identity(piece: Piece) -> tuple[object, ...]:
    """What a piece of work is told from others by."""
    state, work = piece
    return id(state), work.name, *((*job.values.items(), job.analysis) for job in work.jobs)


def outcomes_count(name: str, outcomes: tuple[JobOutcome, ...]) -> RunCounts:
    """The runs of one piece of work by kind."""
    ran = sum(not outcome.reused for outcome in outcomes)
    modal = name.startswith("modal")
    return RunCounts(
        modal=ran if modal else 0, sensitivity=0 if modal else ran, reused=len(outcomes) - ran
    )


@dataclass(frozen=True, slots=True)
class Deriving:
    """Derives a campaign's residual in the cases that are used."""

    campaign: Campaign
    used: Sequence[CaseState]
    pieces: Pieces

    def works(self, theta: Floats) -> list[Piece]:
        """What has to be carried out before the sensitivity at a set is found."""
        return [
            (state, work)
            for state in self.used
            for work in state.finder.sensitivity_works(state.own(theta), state.analysis)
        ]

    def matrix(self, title: str, evaluation: Evaluation, ahead: Ahead) -> Matrix:
        """The sensitivity at a point; ahead: what was carried out before."""
        columns: dict[int, Columns] = {}
        parts = list(evaluation.parts)
        waiting = list(range(len(parts)))
        while waiting:
            for place in waiting:
                parts[place] = self._suited(title, place, parts[place])
            works = [
                state.finder.sensitivity_works(parts[place].theta, state.analysis)
                for place, state in enumerate(self.used)
            ]
            listed = [(self.used[place], work) for place in waiting for work in works[place]]
            done = iter(self.pieces.run(title, listed, ahead))
            again = []
            for place in waiting:
                state, own = self.used[place], [next(done) for _ in works[place]]
                try:
                    with doing(title):
                        point = parts[place].point
                        columns[place] = state.finder.columns(point, state.analysis, own)
                    self._tell(title, state, columns[place])
                except UNFIT as error:
                    state.finder = state.finder.instead(error)
                    again.append(place)
            waiting = again
        return self._stacked(parts, [columns[place] for place in range(len(parts))])

    def by_energies(self, evaluation: Evaluation) -> Floats:
        """What strain energies tell of the sensitivity at a point, without a job: rows of
        frequencies (n_frequencies, n_parameters), NaN where they tell nothing."""
        parameters, parts = self.campaign.parameters.names, evaluation.parts
        whole = evaluation.residual.rows("frequencies")
        found = np.full((whole.stop - whole.start, len(parameters)), np.nan)
        for state, part, rows in zip(self.used, parts, part_rows(parts), strict=True):
            with suppress(UnbalancedEnergies):
                slopes = by_energies(part.point, state.campaign.parameters.names)
                place = np.ix_(rows[part.residual.rows("frequencies")], state.columns)
                found[place] = Frequencies().slopes(_model_state(state.case, part), slopes)
        return found

    def _tell(self, title: str, state: CaseState, columns: Columns) -> None:
        """Tell of columns that no work stood for: those of a reduced model around a set."""
        if state.finder.name != REDUCED and set(columns.methods) == {REDUCED}:
            named = state.campaign.parameters.names
            names = [state.case.of(f"sensitivity {name}") for name in named]
            reason = "follows from the reduced model"
            self.pieces.execution.skip(title, names, "Derived", reason)

    def _suited(self, title: str, place: int, part: CaseEvaluation) -> CaseEvaluation:
        """An evaluated case with all that its finder's derivatives are made of."""
        state = self.used[place]
        if state.finder.suits(part, state.analysis):
            return part
        key, modal = self.pieces.modes(title, state, part.theta, state.analysis)
        return state.compared(part.theta, key, modal, part, state.finder.name)

    def _stacked(self, parts: Sequence[CaseEvaluation], columns: Sequence[Columns]) -> Matrix:
        """The sensitivities of all cases as one."""
        names, rows = self.campaign.parameters.names, part_rows(parts)
        values = np.zeros((sum(own.size for own in rows), len(names)))
        methods: list[dict[str, None]] = [{} for _ in names]
        missing: set[int] = set()
        for state, part, found, own in zip(self.used, parts, columns, rows, strict=True):
            there = [n for n in range(state.columns.size) if n not in found.missing]
            seen = self._seen(state.case, part, found.derivatives)
            with factor_room(state.engine.room):
                values[np.ix_(own, state.columns[there])] = residual_sensitivity(
                    part.responses,
                    _model_state(state.case, part),
                    StateDerivatives(seen, tuple(there), found.derivatives),
                )
            missing |= {int(state.columns[column]) for column in found.missing}
            for column, method in zip(state.columns.tolist(), found.methods, strict=True):
                methods[column][method] = None
        values[:, sorted(missing)] = 0.0
        return Matrix(
            values=values,
            methods=tuple("+".join(found) for found in methods),
            keys=tuple(key for found in columns for key in found.keys),
            age=0,
            missing=tuple(sorted(missing)),
        )

    def _seen(
        self, case: Case, part: CaseEvaluation, derivatives: ModeDerivatives
    ) -> ModeDerivatives:
        """Derivatives of shapes as the test's sensors see them."""
        if not case.needs("shapes"):
            return derivatives
        modes = part.modal.modes
        observer = case.sensors.matrix(modes.nodes, modes.components)
        shapes = derivatives.mode_shapes
        seen = observer @ shapes.reshape(shapes.shape[0], -1)
        return replace(derivatives, mode_shapes=np.asarray(seen).reshape(-1, *shapes.shape[1:]))


def _model_state(case: Case, part: CaseEvaluation) -> ModelState:
    """An evaluated case as its responses see it."""
    return model_state(case, part.seen, part.pairing, part.modal, part.matrices)


class Foresight(Protocol):
    """What is foreseen of sets that are not solved for, where reduced models are there."""

    @property
    def states(self) -> list[CaseState]:
        """The cases on the newest reduced models; none before the first step."""
        ...

    def believed(self, theta: Floats, previous: Evaluation | None) -> Evaluation | None:
        """What is foreseen at a set, if e1 holds there and it can be believed."""
        ...

    def look_back(self, evaluation: Evaluation, previous: Evaluation | None) -> None:
        """Keep how far what was foreseen was from what is found now."""
        ...

    def refined(
        self, current: Evaluation, step: Step, region: tuple[Floats, Floats]
    ) -> Step | None:
        """A better step than the linear one, to a set within a region (lower, upper).

        None where nothing better than the linear model is known.
        """
        ...

    def confirmed(self, title: str, evaluation: Evaluation) -> Evaluation | None:
        """A set evaluated by the solvers' own modes; None where it was so already."""
        ...

    def refuted(self, evaluation: Evaluation, apart: float) -> None:
        """The solvers' own frequencies at this set differ by apart, relative: what found others
        is to be believed no more."""
        ...


class Ranges(Protocol):
    """Many sets by reduced models that hold between the bounds, where matrices are there."""

    @property
    def use(self) -> RangeUse | None:
        """How sets were evaluated so, and what confirmed it; None where none was."""
        ...

    def within(
        self, campaign: Campaign, around: Evaluation, in_full: bool = True, ahead: bool = False
    ) -> Evaluator | None:
        """What evaluates sets of a campaign within the bounds, another test of the same models
        among them; None where a case has no such model, or the solver does not confirm it.

        ahead: sets may be evaluated meanwhile, and are to be believed if the model `stands`."""
        ...

    def stands(self) -> bool:
        """Whether the solver confirms the frequencies where they were worst; its run is awaited."""
        ...


class Evaluator:
    """Evaluates parameter sets in all cases of a campaign, and counts what it cost.

    foresight, ranges: of reduced models, where modes come from stored matrices. tell: hears how
    far these are, in words; idle: is done while the solver confirms an end.
    """

    def __init__(
        self, campaign: Campaign, states: Sequence[CaseState], execution: Execution
    ) -> None:
        self.campaign = campaign
        self.used = [state for state in states if not state.case.aside]
        self.aside = [state for state in states if state.case.aside]
        self.execution = execution
        self.foresight: Foresight | None = None
        self.ranges: Ranges | None = None
        self.tell: Callable[[str], None] = logger.info
        self.idle: Callable[[], None] = lambda: None
        self.pieces = Pieces(execution)
        self._deriving = Deriving(campaign, self.used, self.pieces)

    @property
    def only(self) -> CaseState:
        """The state of the campaign's only case. Raises CampaignError where there are several."""
        case = self.campaign.case
        return next(state for state in self.used if state.case is case)

    @property
    def runs(self) -> RunCounts:
        """Solver runs so far, and what they cost."""
        return self.pieces.runs

    @property
    def cheap(self) -> bool:
        """Whether sensitivities cost no job, so that there is nothing for e2 to save."""
        return all(state.finder.cheap for state in self.used)

    @property
    def sets_cost_little(self) -> bool:
        """Whether modes come from matrices or reduced models, so that some sets more are nothing
        beside what they tell: the least misfit itself, and what other starts lead to."""
        return all(
            state.finder.name != (solver := state.case.solver).program.name
            or solver.deck.summary.matrices is not None
            for state in self.used
        )

    def polishes(self, evaluation: Evaluation) -> bool:
        """Whether the least misfit is worth going on to from an evaluation that meets e1.

        Steps on reduced models end there, and what was believed of them needs no other solution.
        A field's answer is nothing else: one weak element is well within e1.
        """
        if self.campaign.fields:
            return True
        believed = self.foresight is not None and REDUCED in evaluation.solved_by
        return self.sets_cost_little and not believed

    @property
    def steps_run(self) -> bool:
        """Whether each step runs the solver."""
        return any(state.finder.name == state.case.solver.program.name for state in self.used)

    def evaluate(
        self, title: int | str, theta: Floats, previous: Evaluation | None, alone: bool
    ) -> tuple[Evaluation, Matrix | None]:
        """A set's evaluation, and its sensitivity unless the modal jobs are to go alone.

        title: of its pieces, or the number of the iteration. Raises SolverError, ModesError,
        StoreError.
        """
        title, ahead = title if isinstance(title, str) else f"iteration {title}", Ahead()
        with doing(title):
            foreseen = None if self.foresight is None else self.foresight.believed(theta, previous)
        if foreseen is not None:
            return foreseen, None
        asked = [AskedModes(0, state, state.own(theta), state.analysis) for state in self.used]
        beside = [] if alone else self._deriving.works(theta)
        track = ModeTrack(np.ones(theta.size), [previous] if previous else [], grows=False)
        (found,) = self._solve(title, theta[None], asked, track, ahead, beside)
        if isinstance(found, ModetuneError):
            raise found
        for item in asked:
            item.state.analysis = item.analysis
        for item, before, now in zip(
            asked, previous.parts if previous else (), found.parts, strict=False
        ):
            if before.modal.n_rigid != now.modal.n_rigid:
                logger.warning(
                    "%s: the number of rigid modes changes from %d to %d, so the order of "
                    "elastic modes shifts; look at the pairs, and start parameters inside their "
                    "bounds (see `modetune check`)",
                    item.state.case.of(title),
                    before.modal.n_rigid,
                    now.modal.n_rigid,
                )
        if self.foresight:
            self.foresight.look_back(found, previous)
        return found, None if alone else self._deriving.matrix(title, found, ahead)

    @property
    def range_use(self) -> RangeUse | None:
        """How reduced models served for many sets; None where they did not."""
        return None if self.ranges is None else self.ranges.use

    def points(
        self,
        title: str,
        thetas: Floats,
        known: Sequence[Evaluation] = (),
        grows: bool = False,
        in_full: bool = True,
    ) -> Iterator[Evaluation | ModetuneError]:
        """Evaluations of sets (n, n_parameters) in turn, or what keeps one from having any.

        They go side by side, so many at once that their shapes find room in memory. known:
        evaluation points that modes are tracked from; grows: whether new ones join them; in_full:
        as of `Ranges.within`. Raises what is not a set's own failure.
        """
        within = None
        if self.ranges and known and len(thetas) >= MANY:
            within = self.ranges.within(self.campaign, known[0], in_full, ahead=True)
        parameters = self.campaign.parameters
        track = ModeTrack(parameters.upper - parameters.lower, list(known), grows)
        whole = title
        for first in range(0, len(thetas), TOGETHER):
            some = thetas[first : first + TOGETHER]
            if len(thetas) > TOGETHER:  # pieces are numbered among those that go together
                title = f"{whole}, {first + 1} to {first + len(some)} of {len(thetas)}"
            if within is not None and self.ranges is not None:
                name = f"{len(some)} sets by the reduced model"  # one piece for whoever watches
                with doing(title), one_thread():
                    found = self.execution.engine.tasks.compute(
                        name, partial(_derived_points, within, title, some, track)
                    )
                if self.ranges.stands():
                    yield from found
                    continue
                within, track.known = None, list(known)
            yield from self._points(title, some, track)

    def _points(
        self, title: str, thetas: Floats, track: ModeTrack
    ) -> list[Evaluation | ModetuneError]:
        # Shapes of the whole surface, which a report shows, would fill the store for nothing.
        asked = [
            AskedModes(
                point, state, state.own(theta), ModalAnalysis(state.case.n_modes, state.case.nodes)
            )
            for point, theta in enumerate(thetas)
            for state in self.used
        ]
        return self._solve(title, thetas, asked, track, Ahead(), [])

    def tracked(self, item: Evaluation, known: Sequence[Evaluation]) -> Evaluation:
        """A set with its modes paired anew, tracked from the nearest of others. Raises LostMode."""
        bounds = self.campaign.parameters
        near = ModeTrack(bounds.upper - bounds.lower, list(known), False).nearest(item.theta)
        assert near is not None
        parts = [
            state.compared(part.theta, part.key, part.modal, before, part.solved_by)
            for state, part, before in zip(self.used, item.parts, near.parts, strict=True)
        ]
        return self.whole(item.theta, parts)

    def modes(self, theta: Floats, analysis: ModalAnalysis) -> ModalResult:
        """The modes of the only case at a set, as an analysis of one's own asks for them."""
        return self.pieces.modes("modes", self.only, theta, analysis)[1]

    def derivatives(self, point: Point, analysis: ModalAnalysis) -> ModeDerivatives:
        """Derivatives of the only case's modes at a point. Raises where a column fails."""
        while True:
            works = self.only.finder.sensitivity_works(point.theta, analysis)
            done = self.pieces.run("sensitivities", [(self.only, work) for work in works], Ahead())
            for item in done:
                unless_failed(item)
            try:
                with doing("sensitivities"):
                    return self.only.finder.columns(point, analysis, done).derivatives
            except UNFIT as error:
                self.only.finder = self.only.finder.instead(error)

    def matrix(self, number: int, evaluation: Evaluation) -> Matrix:
        """The sensitivity at an evaluation point."""
        return self._deriving.matrix(f"iteration {number}", evaluation, Ahead())

    def by_energies(self, evaluation: Evaluation) -> Floats:
        """Rows of frequencies (n_frequencies, n_parameters) that no job is needed for, else NaN."""
        return self._deriving.by_energies(evaluation)

    def skip(self, number: int, slope: float) -> None:
        """Note that e2 makes this iteration do without a sensitivity of its own."""
        reason = f"e2: slope {slope:.3g} a parameter, at most {self.campaign.update.e2:g}"
        names = [
            state.case.of(f"sensitivity {name}")
            for state in self.used
            for name in state.campaign.parameters.names
        ]
        self.execution.skip(f"iteration {number}", names, "Skipped", reason)

    def planned(self, theta: Floats, alone: bool = False) -> list[Work]:
        """The work of an iteration at a set, with sensitivities unless modes are wanted alone."""
        planned = []
        for state in self.used:
            own, finder = state.own(theta), state.finder
            works = finder.works(own, state.analysis)
            if not alone:
                more = finder.sensitivity_works(own, state.analysis)
                works += [work for work in more if work not in works]
            planned += [state.named(work) for work in works]
        return planned

    def confirming(self, theta: Floats) -> list[Work]:
        """The solvers' own runs at the end, of modes that were found otherwise till then."""
        found = []
        for state in self.used:
            if state.finder.name == state.case.solver.program.name:
                continue
            asked: Analysis = state.analysis
            if confirms_by_matrices(state.campaign, by_solver(state.campaign, state.engine)):
                asked = MatrixAnalysis()
            job = Job(state.campaign.parameters.values(state.own(theta)), asked)
            found.append(state.named(Work(analysis_kind(asked), (job,))))
        return found

    def refined(
        self, current: Evaluation, step: Step, region: tuple[Floats, Floats]
    ) -> Step | None:
        """What is foreseen as a better step than the linear one, None where nothing is."""
        return None if self.foresight is None else self.foresight.refined(current, step, region)

    def step(self, title: str, compute: Callable[[], tuple[Step, str]]) -> Step:
        """A step as a task of its own, unless all modes are a reduced model's.

        compute: gives the step, and a sentence about it.
        """
        if all(state.finder.name == REDUCED for state in self.used):
            return compute()[0]
        return self.execution.engine.tasks.step(title, compute)

    def confirmed(self, number: int, evaluation: Evaluation) -> Evaluation | None:
        """A set evaluated by the solver's own modes; None where it was so already."""
        if self.foresight is None:
            return None
        return self.foresight.confirmed(f"iteration {number}", evaluation)

    def refuted(self, evaluation: Evaluation, apart: float) -> None:
        """Believe no more what found others, by how far the solver's own frequencies are apart."""
        if self.foresight:
            self.foresight.refuted(evaluation, apart)

    def carry_out(
        self, title: str, works: Sequence[Work], state: CaseState | None = None
    ) -> list[tuple[JobOutcome, ...]]:
        """The outcomes of a case's work beyond what modes take, of the only case unless told.

        Raises what ended the first piece that has none.
        """
        of = state or self.only
        done = self.pieces.run(title, [(of, work) for work in works], Ahead())
        return [unless_failed(item) for item in done]

    def _solve(
        self,
        title: str,
        thetas: Floats,
        asked: Sequence[AskedModes],
        track: ModeTrack,
        ahead: Ahead,
        beside: Sequence[Piece],
    ) -> list[Evaluation | ModetuneError]:
        """Evaluations of all sets, round by round until no mode is lost any more."""
        parts: dict[tuple[int, int], CaseEvaluation] = {}
        found: dict[int, Evaluation | ModetuneError] = {}
        waiting = list(asked)
        while waiting:
            works = [item.state.finder.works(item.theta, item.analysis) for item in waiting]
            listed = [
                (item.state, work) for item, own in zip(waiting, works, strict=True) for work in own
            ]
            done = iter(self.pieces.run(title, listed, ahead, beside))
            beside = []
            outcomes = {
                id(item): [next(done) for _ in own]
                for item, own in zip(waiting, works, strict=True)
            }
            points = {
                point: [item for item in waiting if item.point == point]
                for point in dict.fromkeys(item.point for item in waiting)
            }
            waiting = []
            while points:
                point = track.next(thetas, list(points))
                previous = track.nearest(thetas[point])
                again = []
                try:
                    which = f", {point + 1} of {len(thetas)}" * (len(thetas) > 1)
                    for item in points.pop(point):
                        with doing(title + which):
                            part = item.answered(outcomes[id(item)], self._before(item, previous))
                        if part is None:
                            again.append(item)
                        else:
                            parts[point, id(item.state)] = part
                except (SolverError, ModesError) as error:
                    if isinstance(error, CAMPAIGNS_OWN):
                        raise
                    logger.debug("%s %d: %s", title, point, error)
                    found[point] = error
                    continue
                waiting += again
                if not again:
                    own = [parts[point, id(state)] for state in self.used]
                    whole = self.whole(thetas[point], own)
                    found[point] = whole
                    track.join(whole)
            title = title.removesuffix(MORE) + MORE
        return [found[point] for point in range(len(thetas))]

    def _before(self, item: AskedModes, previous: Evaluation | None) -> CaseEvaluation | None:
        """What is known of a case at the set that modes are tracked from."""
        return previous.parts[self.used.index(item.state)] if previous else None

    def whole(self, theta: Floats, parts: Sequence[CaseEvaluation]) -> Evaluation:
        """The evaluations of all cases as one."""
        return whole_evaluation([state.case for state in self.used], theta, parts)


def _derived_points(
    within: Evaluator, title: str, thetas: Floats, track: ModeTrack
) -> tuple[list[Evaluation | ModetuneError], tuple[()]]:
    """Evaluations by a reduced model, of which no job is shown."""
    return within._points(title, thetas, track), ()
