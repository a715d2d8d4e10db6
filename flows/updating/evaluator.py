"""The evaluator: parameter sets and the cases of a campaign in, evaluations and sensitivities out.

Every case has a finder of its modes (`finders.py`) and shares parameters with the others. What a
set needs in all cases goes to the execution in one go, so that the jobs of all run side by side,
and is counted (`pieces.py`). A lost mode widens the computed range of its case and pairs again; a
finder that cannot be believed is replaced (`asked.py`). Sensitivities are put together in
`deriving.py`, what is only judged by in `holding_out.py`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Protocol

import numpy as np

from modetune.adapters.solver import Analysis, MatrixAnalysis, ModalAnalysis
from modetune.core.correlation.held_out import HeldOut
from modetune.core.errors import ModesError, ModetuneError, SolverError
from modetune.core.modes import Floats
from modetune.core.storage.record import RunCounts
from modetune.core.updating.estimation import Step
from modetune.core.updating.reduced_range import RangeUse
from modetune.core.updating.results import ModalResult, ModeDerivatives
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.engine import JobOutcome
from modetune.flows.jobs.execution import Execution, Work
from modetune.flows.jobs.job import Job, analysis_kind
from modetune.flows.jobs.watching import doing
from modetune.flows.updating.asked import Ahead, AskedModes, CaseState, ModeTrack, Piece
from modetune.flows.updating.deriving import Deriving
from modetune.flows.updating.evaluation import (
    CaseEvaluation,
    Evaluation,
    Matrix,
    Point,
    whole_evaluation,
)
from modetune.flows.updating.finders import CAMPAIGNS_OWN, REDUCED, UNFIT, by_solver, unless_failed
from modetune.flows.updating.holding_out import HoldingOut
from modetune.flows.updating.modes_choice import MANY, confirms_by_matrices
from modetune.flows.updating.pieces import Pieces
from modetune.flows.updating.small_matrices import one_thread

logger = logging.getLogger(__name__)

#: What pieces are told under that are carried out once more, for a mode that was lost.
MORE = ", more modes"
#: Sets whose shapes are in memory at once.
TOGETHER = 256


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

    def held_out(self, initial: Evaluation, updated: Evaluation) -> HeldOut | None:
        """Modes and whole cases that are only judged by, before and after.

        A case that is held out takes two modal runs.
        """
        holding = HoldingOut(self.campaign, self.used, self.aside, self.pieces)
        return holding.before_and_after(initial, updated)

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
