"""The evaluator: parameter sets and the cases of a campaign in, evaluations and sensitivities out.

Every case has a finder of its modes (`finders.py`) and shares parameters with the others. What a
set needs in all cases goes to the execution in one go, so that the jobs of all run side by side,
and is counted here. A lost mode widens the computed range of its case and pairs again; a finder
that cannot be believed is replaced; a column of the sensitivity that one case lacks is missing
altogether, since half a derivative is a wrong one.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from modetune.adapters.solver import ModalAnalysis
from modetune.core.correlation.held_out import HeldOut, join_held_out, judge_held_out, unfound
from modetune.core.correlation.matching import NotAmongComputed
from modetune.core.correlation.pairing import LostMode, Pairing
from modetune.core.errors import ModesError, ModetuneError, SolverError
from modetune.core.modes import Floats, ModeSet, mode_name
from modetune.core.storage.record import RunCounts
from modetune.core.updating.estimation import Step
from modetune.core.updating.residual import residual_sensitivity
from modetune.core.updating.results import ModalResult, ModeDerivatives
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.case import Case
from modetune.flows.jobs.engine import JobOutcome, Ledger
from modetune.flows.jobs.first_alone import FirstAlone
from modetune.flows.jobs.job import Job
from modetune.flows.jobs.work import Done, Execution, Work
from modetune.flows.updating.asked import Ahead, AskedModes, CaseState, ModeTrack, Piece
from modetune.flows.updating.evaluation import (
    CaseEvaluation,
    Evaluation,
    Matrix,
    Point,
    compare,
    judged,
    part_rows,
    whole_evaluation,
)
from modetune.flows.updating.finders import (
    CAMPAIGNS_OWN,
    REDUCED,
    UNFIT,
    Columns,
    unless_failed,
)

logger = logging.getLogger(__name__)

#: So many sets are worth a reduced model that holds for all of them.
MANY = 16


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
    """Many sets by reduced models that hold for all of them, where matrices are there."""

    @property
    def said(self) -> str:
        """How sets were evaluated so, and what confirmed it; empty where none was."""
        ...

    def points(
        self, title: str, thetas: Floats, known: Sequence[Evaluation], grows: bool
    ) -> list[Evaluation | ModetuneError] | None:
        """As `Evaluator.points`; None where a case has no such model, or it is not believed."""
        ...


class Evaluator:
    """Evaluates parameter sets in all cases of a campaign, and counts what it cost.

    foresight, ranges: of reduced models, where modes come from stored matrices.
    """

    def __init__(
        self,
        campaign: Campaign,
        states: Sequence[CaseState],
        execution: Execution,
        ledger: Ledger,
    ) -> None:
        self.campaign = campaign
        self.used = [state for state in states if not state.case.aside]
        self.aside = [state for state in states if state.case.aside]
        runs = all(state.engine.may_run for state in states)
        self.execution: Execution = FirstAlone(execution) if runs else execution
        self.ledger = ledger
        self.foresight: Foresight | None = None
        self.ranges: Ranges | None = None
        self._runs = RunCounts()

    @property
    def only(self) -> CaseState:
        """The state of the campaign's only case. Raises CampaignError where there are several."""
        case = self.campaign.case
        return next(state for state in self.used if state.case is case)

    @property
    def runs(self) -> RunCounts:
        """Solver runs so far, and what they cost."""
        return replace(self._runs, core_s=self.ledger.core_s, licence_s=self.ledger.licence_s)

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
        """
        believed = self.foresight is not None and REDUCED in evaluation.solved_by
        return self.sets_cost_little and not believed

    @property
    def steps_run(self) -> bool:
        """Whether each step runs the solver."""
        return any(state.finder.name == state.case.solver.program.name for state in self.used)

    def evaluate(
        self, number: int, theta: Floats, previous: Evaluation | None, alone: bool
    ) -> tuple[Evaluation, Matrix | None]:
        """A set's evaluation, and its sensitivity unless the modal jobs are to go alone.

        Raises SolverError, ModesError, StoreError.
        """
        foreseen = None if self.foresight is None else self.foresight.believed(theta, previous)
        if foreseen is not None:
            return foreseen, None
        title, ahead = f"iteration {number}", Ahead()
        asked = [AskedModes(0, state, state.own(theta), state.analysis) for state in self.used]
        beside = [] if alone else self._sensitivity_works(theta)
        track = ModeTrack(np.ones(theta.size), [previous] if previous else [], grows=False)
        (found,) = self._solve(title, theta[None], asked, track, ahead, beside)
        if isinstance(found, ModetuneError):
            raise found
        for item in asked:
            item.state.analysis = item.analysis
        if self.foresight:
            self.foresight.look_back(found, previous)
        return found, None if alone else self._matrix(title, found, ahead)

    def points(
        self, title: str, thetas: Floats, known: Sequence[Evaluation] = (), grows: bool = False
    ) -> list[Evaluation | ModetuneError]:
        """Evaluations of sets (n, n_parameters) side by side, or what keeps one from having any.

        known: evaluation points that modes are tracked from; grows: whether new ones join them.
        Raises what is not a set's own failure.
        """
        if self.ranges and known and len(thetas) >= MANY:
            found = self.ranges.points(title, thetas, known, grows)
            if found is not None:
                return found
        # Shapes of the whole surface, which a report shows, would fill the store for nothing.
        asked = [
            AskedModes(
                point, state, state.own(theta), ModalAnalysis(state.case.n_modes, state.case.nodes)
            )
            for point, theta in enumerate(thetas)
            for state in self.used
        ]
        parameters = self.campaign.parameters
        track = ModeTrack(parameters.upper - parameters.lower, list(known), grows)
        return self._solve(title, thetas, asked, track, Ahead(), [])

    def modes(self, theta: Floats, analysis: ModalAnalysis) -> ModalResult:
        """The modes of the only case at a set, as an analysis of one's own asks for them."""
        return self._modes("modes", self.only, theta, analysis)[1]

    def derivatives(self, point: Point, analysis: ModalAnalysis) -> ModeDerivatives:
        """Derivatives of the only case's modes at a point. Raises where a column fails."""
        while True:
            works = self.only.finder.sensitivity_works(point.theta, analysis)
            done = self._run("sensitivities", [(self.only, work) for work in works], Ahead())
            for item in done:
                unless_failed(item)
            try:
                return self.only.finder.columns(point, analysis, done).derivatives
            except UNFIT as error:
                self.only.finder = self.only.finder.instead(error)

    def matrix(self, number: int, evaluation: Evaluation) -> Matrix:
        """The sensitivity at an evaluation point."""
        return self._matrix(f"iteration {number}", evaluation, Ahead())

    def skip(self, number: int, slope: float) -> None:
        """Note that e2 makes this iteration do without a sensitivity of its own."""
        reason = f"e2: the residual changed by {slope:.3g} a parameter in the iteration before"
        names = [
            state.case.of(f"sensitivity {name}")
            for state in self.used
            for name in state.campaign.parameters.names
        ]
        self.execution.skip(f"iteration {number}", names, reason)

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
        return [
            state.named(
                Work("modal", (Job(state.campaign.parameters.values(own), state.analysis),))
            )
            for state in self.used
            if state.finder.name != state.case.solver.program.name
            for own in (state.own(theta),)
        ]

    def held_out(self, initial: Evaluation, updated: Evaluation) -> HeldOut | None:
        """Modes and whole cases that are only judged by, before and after.

        A case that is held out takes two modal runs.
        """
        found = [
            self._named(held, state)
            for state, before, after in zip(self.used, initial.parts, updated.parts, strict=True)
            if (held := judged(state.case, before, after)) is not None
        ]
        found += [self._judged_aside(state, initial.theta, updated.theta) for state in self.aside]
        return join_held_out(found)

    def refined(
        self, current: Evaluation, step: Step, region: tuple[Floats, Floats]
    ) -> Step | None:
        """What is foreseen as a better step than the linear one, None where nothing is."""
        return None if self.foresight is None else self.foresight.refined(current, step, region)

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
        done = self._run(title, [(of, work) for work in works], Ahead())
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
            done = iter(self._run(title, listed, ahead, beside))
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
                    for item in points.pop(point):
                        part = self._part(item, outcomes[id(item)], previous)
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
                    if track.grows:
                        track.known.append(whole)
        return [found[point] for point in range(len(thetas))]

    def _part(
        self, item: AskedModes, done: Sequence[Done], previous: Evaluation | None
    ) -> CaseEvaluation | None:
        """A case's evaluation; None where it is to be asked for again."""
        state = item.state
        try:
            key, modal = state.finder.modes(item.theta, item.analysis, done)
        except UNFIT as error:
            state.finder = state.finder.instead(error)
            return None
        before = previous.parts[self.used.index(state)] if previous else None
        try:
            part = self._compared(item, key, modal, before)
        except LostMode as error:
            if item.widen(error, modal.modes.n_modes):
                return None
            if isinstance(error, NotAmongComputed):
                raise
            if before is not None or not state.case.rules.drop:
                raise lost(error) from error
            part = self._compared(item, key, modal, before, drop=True)
        if before is None:
            tell_dropped(state.case, part.pairing)
        return part

    def _compared(
        self,
        item: AskedModes,
        key: str,
        modal: ModalResult,
        before: CaseEvaluation | None,
        drop: bool = False,
    ) -> CaseEvaluation:
        state = item.state
        return compare(state.case, item.theta, key, modal, before, state.finder.name, drop)

    def _modes(
        self, title: str, state: CaseState, theta: Floats, analysis: ModalAnalysis
    ) -> tuple[str, ModalResult]:
        """The key and the modes of one case at a set."""
        while True:
            works = [(state, work) for work in state.finder.works(theta, analysis)]
            done = self._run(title, works, Ahead())
            try:
                return state.finder.modes(theta, analysis, done)
            except UNFIT as error:
                state.finder = state.finder.instead(error)

    def whole(self, theta: Floats, parts: Sequence[CaseEvaluation]) -> Evaluation:
        """The evaluations of all cases as one."""
        return whole_evaluation([state.case for state in self.used], theta, parts)

    def _sensitivity_works(self, theta: Floats) -> list[Piece]:
        return [
            (state, work)
            for state in self.used
            for work in state.finder.sensitivity_works(state.own(theta), state.analysis)
        ]

    def _matrix(self, title: str, evaluation: Evaluation, ahead: Ahead) -> Matrix:
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
            done = iter(self._run(title, listed, ahead))
            again = []
            for place in waiting:
                state, own = self.used[place], [next(done) for _ in works[place]]
                try:
                    columns[place] = state.finder.columns(parts[place].point, state.analysis, own)
                except UNFIT as error:
                    state.finder = state.finder.instead(error)
                    again.append(place)
            waiting = again
        return self._stacked(parts, [columns[place] for place in range(len(parts))])

    def _suited(self, title: str, place: int, part: CaseEvaluation) -> CaseEvaluation:
        """An evaluated case with all that its finder's derivatives are made of."""
        state = self.used[place]
        if state.finder.suits(part, state.analysis):
            return part
        key, modal = self._modes(title, state, part.theta, state.analysis)
        return compare(state.case, part.theta, key, modal, part, state.finder.name)

    def _stacked(self, parts: Sequence[CaseEvaluation], columns: Sequence[Columns]) -> Matrix:
        """The sensitivities of all cases as one."""
        names, rows = self.campaign.parameters.names, part_rows(parts)
        values = np.zeros((sum(own.size for own in rows), len(names)))
        methods: list[dict[str, None]] = [{} for _ in names]
        missing: set[int] = set()
        for state, part, found, own in zip(self.used, parts, columns, rows, strict=True):
            there = [n for n in range(state.columns.size) if n not in found.missing]
            values[np.ix_(own, state.columns[there])] = residual_sensitivity(
                state.case.test.modes,
                part.seen,
                part.pairing,
                state.case.weighting,
                self._seen(state.case, part, found.derivatives),
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
        if not case.weighting.with_shapes:
            return derivatives
        modes = part.modal.modes
        observer = case.sensors.matrix(modes.nodes, modes.components)
        shapes = derivatives.mode_shapes
        seen = observer @ shapes.reshape(shapes.shape[0], -1)
        return replace(derivatives, mode_shapes=np.asarray(seen).reshape(-1, *shapes.shape[1:]))

    def _judged_aside(self, state: CaseState, initial: Floats, updated: Floats) -> HeldOut:
        states: list[tuple[ModeSet, Pairing]] = []
        before = None
        for theta in (initial, updated):
            try:
                before = self._aside_part(state, state.own(theta), before)
                states.append((before.seen, before.pairing))
            except (ModesError, SolverError) as error:
                if isinstance(error, CAMPAIGNS_OWN):
                    raise
                logger.warning("the held-out configuration %s: %s", state.case.name, error)
                states.append(unfound(state.case.test))
        deviations = state.case.weighting.frequency_deviations
        return self._named(judge_held_out(state.case.test, deviations, *states), state)

    def _aside_part(
        self, state: CaseState, theta: Floats, before: CaseEvaluation | None
    ) -> CaseEvaluation:
        item = AskedModes(0, state, theta, state.analysis)
        while True:
            key, modal = self._modes("held out", state, theta, item.analysis)
            try:
                return self._compared(item, key, modal, before)
            except LostMode as error:
                if not item.widen(error, modal.modes.n_modes):
                    raise

    def _named(self, held: HeldOut, state: CaseState) -> HeldOut:
        """With the name of the case, where there are several."""
        several = () if self.campaign.only else (state.case.name,) * held.numbers.size
        return replace(held, configurations=several)

    def _run(
        self,
        title: str,
        works: Sequence[Piece],
        ahead: Ahead,
        beside: Sequence[Piece] = (),
    ) -> list[Done]:
        """What became of each piece, in order, and counts the runs.

        Pieces that were carried out ahead are not run again; those beside are kept for later.
        """
        listed = {_identity(piece): piece for piece in (*works, *beside)}
        missing = {mark: piece for mark, piece in listed.items() if mark not in ahead}
        if missing:
            named = [state.named(work) for state, work in missing.values()]
            for mark, work, done in zip(
                missing, named, self.execution.run(title, named), strict=True
            ):
                ahead[mark] = done
                if not isinstance(done, ModetuneError):
                    self._runs = self._runs.plus(outcomes_count(work.name, done))
        return [ahead[_identity(piece)] for piece in works]


def _identity(piece: Piece) -> tuple[object, ...]:
    """What a piece of work is told from others by."""
    state, work = piece
    return id(state), work.name, *((*job.values.items(), job.analysis) for job in work.jobs)


def lost(error: LostMode) -> LostMode:
    """A lost mode with what the campaign can say of it."""
    return LostMode(
        f"{error}; `test.unmatched: drop` updates without it, and `test.pairs` names its partner "
        "by hand (see `modetune check`)"
    )


def tell_dropped(case: Case, pairing: Pairing) -> None:
    """Warn of the modes that are left out."""
    for row in np.setdiff1d(np.arange(case.test.modes.n_modes), pairing.measured).tolist():
        logger.warning(
            "%s at %.4g Hz has no partner among the computed modes and is left out "
            "(test.unmatched: drop): nothing is compared with it",
            mode_name(case.test.numbers[row], case.name),
            case.test.modes.frequencies_hz[row],
        )


def outcomes_count(name: str, outcomes: tuple[JobOutcome, ...]) -> RunCounts:
    """The runs of one piece of work by kind."""
    ran = sum(not outcome.reused for outcome in outcomes)
    modal = name.startswith("modal")
    return RunCounts(
        modal=ran if modal else 0,
        sensitivity=0 if modal else ran,
        reused=len(outcomes) - ran,
    )
