"""The evaluator: from parameter values and a campaign's cases to evaluations and sensitivities.

Each case has a source of modes (`mode_source.py`) and shares parameters with the others. The solver
work of all cases at a point is submitted together, so that the jobs run in parallel, and is
counted. If a mode is lost, the computed range of its case is widened and the modes are paired
again. A source that turns out to be wrong for the model is replaced. If a case has no column of the
sensitivity for a parameter that it shares, the whole column is missing, since a partial derivative
would be wrong.

If modes come from stored matrices (`reduced_model.py`), many points within the bounds are evaluated
by a reduced model, which one solver run at its worst point confirms for all later use. The solver's
own modes or matrices confirm the point where updating ends.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np

from modetune.adapters.solver import Analysis, MatrixAnalysis, ModalAnalysis
from modetune.core.algebra.factor_room import factor_room
from modetune.core.correlation.pairing import LostMode, close_modes
from modetune.core.errors import ModelError, ModesError, ModetuneError, SolverError
from modetune.core.modes import Floats
from modetune.core.storage.campaign_record import RunCounts
from modetune.core.updating.job_results import ModalResult
from modetune.core.updating.parameter_steps import Step
from modetune.core.updating.reduced_basis import RangeUse, range_sets
from modetune.core.updating.residual import residual_sensitivity
from modetune.core.updating.responses.frequencies import Frequencies
from modetune.core.updating.responses.response import ModelState, StateDerivatives
from modetune.core.updating.sensitivity import ModeDerivatives
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.case import Case
from modetune.flows.jobs.campaign_engine import engine_of
from modetune.flows.jobs.engine import JobEngine, JobOutcome
from modetune.flows.jobs.execution import Done, Execution, Work
from modetune.flows.jobs.job import Job, analysis_kind
from modetune.flows.jobs.progress import doing
from modetune.flows.jobs.runner import in_background
from modetune.flows.updating.evaluation import (
    CaseEvaluation,
    Evaluation,
    Matrix,
    ModeTrack,
    Point,
    at_sensors,
    model_state,
    part_rows,
    whole_evaluation,
)
from modetune.flows.updating.mode_source import (
    CAMPAIGNS_OWN,
    MANY,
    REDUCED,
    UNFIT,
    UPDATING,
    CaseState,
    Columns,
    Demand,
    ModeRequest,
    by_solver,
    campaign_analysis,
    confirms_by_matrices,
    unless_failed,
)
from modetune.flows.updating.reduced_model import (
    ACCURATE,
    CONFIRMED,
    ByMatrices,
    ReducedModes,
    finder_of,
)
from modetune.flows.updating.sensitivities import UnbalancedEnergies, UnlikeMatrices, by_energies

logger = logging.getLogger(__name__)

#: Suffix of the title of work that is repeated for a lost mode.
MORE = ", more modes"
#: Maximum number of points whose shapes are in memory at the same time.
TOGETHER = 256
#: Work of a case.
CaseWork = tuple[CaseState, Work]
#: Results of case work by its identity, for work that is requested again.
Results = dict[tuple[object, ...], Done]


def evaluator_of(
    campaign: Campaign,
    engine: JobEngine,
    demand: Demand = UPDATING,
    like: Campaign | None = None,
    execution: Execution | None = None,
) -> Evaluator:
    """Return the evaluator of a campaign, with an engine and a source of modes for each case.

    demand: number of points. like: a campaign with the same model, parameters and cases that
    determines the source, by default this one. execution: of the work, by default by the engine's
    tasks.
    """
    states: list[CaseState] = []
    for case in campaign.cases:
        own = campaign.alone(case)
        at = engine_of(engine, campaign, case)
        every = range(len(campaign.parameters))
        columns = np.array(every if case.columns is None else case.columns, dtype=np.int64)
        alike = own if like is None else like.alone(like.cases[len(states)])
        finder = by_solver(own, at) if case.aside else finder_of(own, at, demand, alike)
        states.append(CaseState(case, own, columns, at, finder, campaign_analysis(own)))
    by_matrices = any(state.finder.name != state.case.solver.program.name for state in states)
    # A reduced model has directions for each parameter: with a field it would not be smaller.
    reducible = by_matrices and not campaign.fields
    return Evaluator(campaign, states, execution or Execution(engine), reducible)


class Evaluator:
    """Evaluates parameter values in all cases of a campaign, and counts the solver runs.

    reducible: modes come from stored matrices, from which reduced models are made. tell: is called
    with a sentence about the error of a reduced model. idle: is called while the solver confirms an
    end.
    """

    def __init__(
        self,
        campaign: Campaign,
        states: Sequence[CaseState],
        execution: Execution,
        reducible: bool = False,
    ) -> None:
        self.campaign = campaign
        self.used = [state for state in states if not state.case.aside]
        self.aside = [state for state in states if state.case.aside]
        self.execution = execution
        self.reducible = reducible
        self.tell: Callable[[str], None] = logger.info
        self.idle: Callable[[], None] = lambda: None
        self._runs = RunCounts()
        # Reduced models within the bounds, by case, each made and confirmed once.
        self._ranges: list[ReducedModes] = []
        self._refused = not reducible
        self._confirming: tuple[Evaluation, Future[Evaluation | None]] | None = None
        self._range_confirmed: tuple[str, float, str] | None = None

    @property
    def only(self) -> CaseState:
        """Return the state of the only case. Raises CampaignError if there are several."""
        case = self.campaign.case
        return next(state for state in self.used if state.case is case)

    @property
    def runs(self) -> RunCounts:
        """Return the solver runs so far and their cost."""
        costs = self.execution.engine.costs
        return replace(self._runs, core_s=costs.core_s, licence_s=costs.licence_s)

    @property
    def cheap(self) -> bool:
        """Return whether sensitivities take no job, so that e2 has none to skip."""
        return all(state.finder.cheap for state in self.used)

    @property
    def sets_cost_little(self) -> bool:
        """Return whether modes come from matrices or reduced models.

        Further points are then cheap: updating continues to the minimum misfit and tries other
        starts.
        """
        return all(
            state.finder.name != (solver := state.case.solver).program.name
            or solver.deck.summary.matrices is not None
            for state in self.used
        )

    def polishes(self, evaluation: Evaluation) -> bool:
        """Return whether updating continues to the minimum misfit after e1 is met.

        Steps on reduced models end there anyway, and their predictions need no other solution. A
        field is always updated to the minimum, since one weak element hardly affects e1.
        """
        if self.campaign.fields:
            return True
        predicted = self.reducible and REDUCED in evaluation.solved_by
        return self.sets_cost_little and not predicted

    @property
    def steps_run(self) -> bool:
        """Return whether each step runs the solver."""
        return any(state.finder.name == state.case.solver.program.name for state in self.used)

    # work of the cases

    def run(
        self, title: str, works: Sequence[CaseWork], done: Results, more: Sequence[CaseWork] = ()
    ) -> list[Done]:
        """Run the works in parallel and count their jobs; return the result of each, in order.

        done: earlier results, which are not computed again; new ones are added. more: works whose
        results are only added to `done`.
        """
        listed = {_identity(item): item for item in (*works, *more)}
        missing = {mark: item for mark, item in listed.items() if mark not in done}
        if missing:
            named = _numbered([state.named(work) for state, work in missing.values()])
            results = self.execution.run(title, named)
            for mark, work, result in zip(missing, named, results, strict=True):
                done[mark] = result
                if not isinstance(result, ModetuneError):
                    self._runs = self._runs.plus(work.counts(result))
        return [done[_identity(item)] for item in works]

    def carry_out(
        self, title: str, works: Sequence[Work], state: CaseState | None = None
    ) -> list[tuple[JobOutcome, ...]]:
        """Run works of a case, by default the only one, and return their outcomes.

        Raises the error of the first work without any.
        """
        done = self.run(title, [(state or self.only, work) for work in works], {})
        return [unless_failed(item) for item in done]

    def planned(self, theta: Floats, alone: bool = False) -> list[Work]:
        """Return the work of an iteration at a point; alone: without that of sensitivities."""
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
        """Return the solvers' own runs that confirm modes from other sources at the end."""
        found: list[Work] = []
        for state in self.used if self.campaign.update.confirm != "later" else ():
            if state.finder.name == state.case.solver.program.name:
                continue
            asked: Analysis = state.analysis
            if confirms_by_matrices(state.campaign, by_solver(state.campaign, state.engine)):
                asked = MatrixAnalysis()
            job = Job(state.campaign.parameters.values(state.own(theta)), asked)
            found.append(state.named(Work(analysis_kind(asked), (job,))))
        return found

    def skip(self, number: int, slope: float) -> None:
        """Report that e2 skips the sensitivity of this iteration."""
        reason = f"e2: slope {slope:.3g} a parameter, at most {self.campaign.update.e2:g}"
        names = [
            state.case.of(f"sensitivity {name}")
            for state in self.used
            for name in state.campaign.parameters.names
        ]
        self.execution.skip(f"iteration {number}", names, "Skipped", reason)

    def step(self, title: str, compute: Callable[[], tuple[Step, str]]) -> Step:
        """Compute a step as its own task, unless all modes are a reduced model's.

        compute: returns the step and a sentence about it.
        """
        if all(state.finder.name == REDUCED for state in self.used):
            return compute()[0]
        return self.execution.engine.tasks.step(title, compute)

    # evaluations

    def evaluate(
        self, title: int | str, theta: Floats, previous: Evaluation | None, alone: bool
    ) -> tuple[Evaluation, Matrix | None]:
        """Return the evaluation of a point and its sensitivity.

        title: of its work, or the number of the iteration; alone: without the sensitivity. Raises
        SolverError, ModesError, StoreError.
        """
        title, done = title if isinstance(title, str) else f"iteration {title}", Results()
        requests = [ModeRequest(0, state, state.own(theta), state.analysis) for state in self.used]
        more = [] if alone else self._sensitivity_works(theta)
        track = ModeTrack(np.ones(theta.size), [previous] if previous else [], extend=False)
        (found,) = self._solve(title, theta[None], requests, track, done, more)
        if isinstance(found, ModetuneError):
            raise found
        for item in requests:
            item.state.analysis = item.analysis
        for item, before, now in zip(
            requests, previous.parts if previous else (), found.parts, strict=False
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
        return found, None if alone else self._matrix(title, found, done)

    def points(
        self,
        title: str,
        thetas: Floats,
        known: Sequence[Evaluation] = (),
        grows: bool = False,
        in_full: bool = True,
    ) -> Iterator[Evaluation | ModetuneError]:
        """Yield the evaluations of points (n, n_parameters), or the error of a point without one.

        Memory for shapes limits the number solved in parallel. known: evaluations from which modes
        are tracked; grows: add new ones to them; in_full: as in `within`. Raises errors that
        concern all points.
        """
        within = None
        if known and len(thetas) >= MANY:
            within = self.within(self.campaign, known[0], in_full, ahead=True)
        parameters = self.campaign.parameters
        track = ModeTrack(parameters.upper - parameters.lower, list(known), grows)
        whole = title
        for first in range(0, len(thetas), TOGETHER):
            some = thetas[first : first + TOGETHER]
            if len(thetas) > TOGETHER:  # work is numbered within such a group
                title = f"{whole}, {first + 1} to {first + len(some)} of {len(thetas)}"
            if within is not None:
                name = f"{len(some)} sets by the reduced model"  # one task on displays
                with doing(title):
                    found = self.execution.engine.tasks.compute(
                        name, partial(_derived_points, within, title, some, track)
                    )
                if self._range_stands():
                    yield from found
                    continue
                within, track.known = None, list(known)
            yield from self._points(title, some, track)

    def _points(
        self, title: str, thetas: Floats, track: ModeTrack
    ) -> list[Evaluation | ModetuneError]:
        # Only a report shows shapes of the whole surface, which would fill the store.
        requests = [
            ModeRequest(
                point, state, state.own(theta), ModalAnalysis(state.case.n_modes, state.case.nodes)
            )
            for point, theta in enumerate(thetas)
            for state in self.used
        ]
        return self._solve(title, thetas, requests, track, {}, [])

    def _solve(
        self,
        title: str,
        thetas: Floats,
        requests: Sequence[ModeRequest],
        track: ModeTrack,
        done: Results,
        more: Sequence[CaseWork],
    ) -> list[Evaluation | ModetuneError]:
        """Return the evaluations of all points, in rounds until no mode is lost."""
        parts: dict[tuple[int, int], CaseEvaluation] = {}
        found: dict[int, Evaluation | ModetuneError] = {}
        waiting = list(requests)
        while waiting:
            works = [item.state.finder.works(item.theta, item.analysis) for item in waiting]
            listed = [
                (item.state, work) for item, own in zip(waiting, works, strict=True) for work in own
            ]
            results = iter(self.run(title, listed, done, more))
            more = []
            outcomes = {
                id(item): [next(results) for _ in own]
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
                        place = self.used.index(item.state)
                        before = previous.parts[place] if previous else None
                        with doing(title + which):
                            part = item.evaluated(outcomes[id(item)], before)
                        if part is None:
                            again.append(item)
                        else:
                            parts[point, place] = part
                except (SolverError, ModesError) as error:
                    if isinstance(error, CAMPAIGNS_OWN):
                        raise
                    logger.debug("%s %d: %s", title, point, error)
                    found[point] = error
                    continue
                waiting += again
                if not again:
                    own = [parts[point, place] for place in range(len(self.used))]
                    whole = self.whole(thetas[point], own)
                    found[point] = whole
                    track.join(whole)
            title = title.removesuffix(MORE) + MORE
        return [found[point] for point in range(len(thetas))]

    def whole(self, theta: Floats, parts: Sequence[CaseEvaluation]) -> Evaluation:
        """Return the evaluations of all cases as one."""
        return whole_evaluation([state.case for state in self.used], theta, parts)

    def tracked(self, item: Evaluation, known: Sequence[Evaluation]) -> Evaluation:
        """Pair a point's modes again, tracked from the nearest known point. Raises LostMode."""
        bounds = self.campaign.parameters
        near = ModeTrack(bounds.upper - bounds.lower, list(known), False).nearest(item.theta)
        assert near is not None
        parts = [
            state.compared(part.theta, part.key, part.modal, before, part.solved_by)
            for state, part, before in zip(self.used, item.parts, near.parts, strict=True)
        ]
        return self.whole(item.theta, parts)

    def modes(self, theta: Floats, analysis: ModalAnalysis) -> ModalResult:
        """Return the modes of the only case at a point, as an analysis requests them."""
        return self.case_modes("modes", self.only, theta, analysis)[1]

    def case_modes(
        self, title: str, state: CaseState, theta: Floats, analysis: ModalAnalysis
    ) -> tuple[str, ModalResult]:
        """Return the key and the modes of a case at its own parameters."""
        while True:
            works = [(state, work) for work in state.finder.works(theta, analysis)]
            done = self.run(title, works, {})
            try:
                with doing(title):
                    return state.finder.modes(theta, analysis, done)
            except UNFIT as error:
                state.finder = state.finder.instead(error)

    # sensitivities

    def derivatives(self, point: Point, analysis: ModalAnalysis) -> ModeDerivatives:
        """Return derivatives of the only case's modes at a point. Raises where a column fails."""
        while True:
            works = self.only.finder.sensitivity_works(point.theta, analysis)
            done = self.run("sensitivities", [(self.only, work) for work in works], {})
            for item in done:
                unless_failed(item)
            try:
                with doing("sensitivities"):
                    return self.only.finder.columns(point, analysis, done).derivatives
            except UNFIT as error:
                self.only.finder = self.only.finder.instead(error)

    def matrix(self, title: str, evaluation: Evaluation) -> Matrix:
        """Return the sensitivity at an evaluated point."""
        return self._matrix(title, evaluation, {})

    def by_energies(self, evaluation: Evaluation) -> Floats:
        """Return rows of frequencies (n_frequencies, n_parameters) from strain energies, without a
        job; NaN where energies do not determine them."""
        parameters, parts = self.campaign.parameters.names, evaluation.parts
        whole = evaluation.residual.rows("frequencies")
        found = np.full((whole.stop - whole.start, len(parameters)), np.nan)
        for state, part, rows in zip(self.used, parts, part_rows(parts), strict=True):
            with suppress(UnbalancedEnergies):
                slopes = by_energies(part.point, state.campaign.parameters.names)
                place = np.ix_(rows[part.residual.rows("frequencies")], state.columns)
                found[place] = Frequencies().slopes(_model_state(state.case, part), slopes)
        return found

    def _sensitivity_works(self, theta: Floats) -> list[CaseWork]:
        return [
            (state, work)
            for state in self.used
            for work in state.finder.sensitivity_works(state.own(theta), state.analysis)
        ]

    def _matrix(self, title: str, evaluation: Evaluation, done: Results) -> Matrix:
        """Return the sensitivity at a point; done: results of work so far."""
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
            results = iter(self.run(title, listed, done))
            again = []
            for place in waiting:
                state, own = self.used[place], [next(results) for _ in works[place]]
                try:
                    with doing(title):
                        point = parts[place].point
                        columns[place] = state.finder.columns(point, state.analysis, own)
                    self._report_reduced(title, state, columns[place])
                except UNFIT as error:
                    state.finder = state.finder.instead(error)
                    again.append(place)
            waiting = again
        return self._stacked(parts, [columns[place] for place in range(len(parts))])

    def _report_reduced(self, title: str, state: CaseState, columns: Columns) -> None:
        """Report columns from a reduced model, which need no work."""
        if state.finder.name != REDUCED and set(columns.methods) == {REDUCED}:
            named = state.campaign.parameters.names
            names = [state.case.of(f"sensitivity {name}") for name in named]
            reason = "follows from the reduced model"
            self.execution.skip(title, names, "Derived", reason)

    def _suited(self, title: str, place: int, part: CaseEvaluation) -> CaseEvaluation:
        """Return an evaluated case with the modes that its source needs for derivatives."""
        state = self.used[place]
        if state.finder.suits(part, state.analysis):
            return part
        key, modal = self.case_modes(title, state, part.theta, state.analysis)
        return state.compared(part.theta, key, modal, part, state.finder.name)

    def _stacked(self, parts: Sequence[CaseEvaluation], columns: Sequence[Columns]) -> Matrix:
        """Return the sensitivities of all cases as one."""
        names, rows = self.campaign.parameters.names, part_rows(parts)
        values = np.zeros((sum(own.size for own in rows), len(names)))
        methods: list[dict[str, None]] = [{} for _ in names]
        missing: set[int] = set()
        for state, part, found, own in zip(self.used, parts, columns, rows, strict=True):
            there = [n for n in range(state.columns.size) if n not in found.missing]
            seen = at_sensors(state.case, part, found.derivatives)
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

    # reduced models within the bounds

    @property
    def range_use(self) -> RangeUse | None:
        """Return the use of a reduced model for many points; None if there was none."""
        if self._range_confirmed is None:
            return None
        models = [item.range for item in self._ranges]
        tallies = [item.tally for item in self._ranges]
        return RangeUse(
            sets=max(tally.points for tally in tallies),
            vectors=max(model.size for model in models),
            solutions=sum(1 + len(model.solved) for model in models),
            asked=self._accuracy,
            error=max(float(model.errors[-1]) for model in models),
            estimate=max(tally.error for tally in tallies),
            in_full=sum(tally.in_full for tally in tallies),
            solver=self._range_confirmed[0],
            apart=self._range_confirmed[1],
            where=self._range_confirmed[2],
        )

    def within(
        self, campaign: Campaign, around: Evaluation, in_full: bool = True, ahead: bool = False
    ) -> Evaluator | None:
        """Return the evaluator on reduced models within the bounds; None where a case has none, or
        the solver does not confirm it.

        campaign: this one, or one with another test of the same models. around: an evaluated point
        of this one. in_full: solve points with too large an error in full. ahead: return before the
        solver has confirmed the models (`_range_stands` waits for it).
        """
        if not self._ranges and not self._refused:
            self._ranges = self._made_ranges(around)
            self._refused = not self._ranges or not self._confirmation_begun(around)
        if not ahead:
            self._range_stands()
        return None if self._refused else self._on_ranges(campaign, in_full)

    def _range_stands(self) -> bool:
        """Wait for the solver's run at the worst point; return whether it confirms the models."""
        if self._confirming is not None:
            (there, run), self._confirming = self._confirming, None
            self._refused = not self._range_agrees(there, run.result())
        return not self._refused

    @property
    def _accuracy(self) -> float:
        """Return the permitted relative error of a reduced model's frequencies."""
        return ACCURATE * min(self.campaign.tolerances.frequency, CONFIRMED)

    def _made_ranges(self, known: Evaluation) -> list[ReducedModes]:
        """Return a reduced model within the bounds for each case; empty if a case has none."""
        found: list[ReducedModes] = []
        for state, part in zip(self.used, known.parts, strict=True):
            if not isinstance(state.finder, ByMatrices):
                return []
            analysis = ModalAnalysis(state.case.n_modes, state.case.nodes)
            self.carry_out("range", state.finder.works(part.theta, analysis), state)
            try:
                with doing("range"):
                    found.append(
                        state.finder.within(
                            part, self._range_points(state), analysis, self._accuracy, self._told
                        )
                    )
            except (UnlikeMatrices, ModelError) as error:
                state.finder = state.finder.instead(error)
                return []
            except ModesError as error:
                logger.info("no reduced model between the bounds: %s", error)
                return []
        return found

    def _range_points(self, state: CaseState) -> Floats:
        """Return the points (n_points, n_parameters) among which to find a case's worst one."""
        bounds = self.campaign.parameters
        return np.array([state.own(theta) for theta in range_sets(bounds.lower, bounds.upper)])

    def _told(self, solutions: int, error: float) -> None:
        self.tell(
            f"reduced model: {solutions} full solutions, error {error:.0e}, "
            f"permitted {self._accuracy:.0e}"
        )

    def _on_ranges(self, campaign: Campaign, in_full: bool = True) -> Evaluator:
        """Return the cases on their reduced models, with the tests of a campaign."""
        pairs = zip(self.used, self._ranges, strict=True)
        named = {pair[0].case.name: pair for pair in pairs}
        states = [*self.aside]
        states += [
            replace(
                state,
                case=case,
                campaign=campaign.alone(case),
                finder=replace(finder, in_full=in_full),
                analysis=ModalAnalysis(state.case.n_modes, state.case.nodes),
            )
            for case in campaign.cases
            if case.name in named
            for state, finder in [named[case.name]]
        ]
        return Evaluator(campaign, states, self.execution)

    def _confirmation_begun(self, around: Evaluation) -> bool:
        """Begin the solver's run at the worst point; return whether there is one."""
        place = max(range(len(self._ranges)), key=lambda n: self._ranges[n].range.errors[-1])
        state, finder = self.used[place], self._ranges[place]
        theta = around.theta.copy()
        theta[state.columns] = min(self._range_points(state), key=finder.from_worst)
        (there,) = self._on_ranges(self.campaign).points("range", theta[None], [around])
        for item in self._ranges:
            item.tally.points = item.tally.in_full = 0
        if not isinstance(there, Evaluation):
            logger.info("the reduced model cannot be confirmed: %s", there)
            return False
        self._confirming = there, in_background("confirm", lambda: self.confirmed(0, there))
        return True

    def _range_agrees(self, there: Evaluation, confirmed: Evaluation | None) -> bool:
        """Return whether the solver's frequencies agree with those of the reduced model."""
        assert confirmed is not None
        apart = float(np.max(np.abs(confirmed.errors - there.errors)))
        if apart > CONFIRMED:
            self.refute_matrices(apart)
            return False
        names = self.campaign.parameters.names
        where = ", ".join(
            f"{n} {value:.4g}" for n, value in zip(names, there.theta.tolist(), strict=True)
        )
        self._range_confirmed = confirmed.solved_by, apart, where
        return True

    # confirmation by the solver

    def is_solvers(self, evaluation: Evaluation) -> bool:
        """Return whether the solvers themselves found the modes of an evaluation."""
        pairs = zip(self.used, evaluation.parts, strict=True)
        return not self.reducible or all(
            part.solved_by == state.case.solver.program.name for state, part in pairs
        )

    def confirmed(self, number: int, evaluation: Evaluation) -> Evaluation | None:
        """Return a point evaluated with the solvers' own modes; None if it already was."""
        if self.is_solvers(evaluation):
            return None
        title = f"iteration {number}"
        pairs = list(zip(self.used, evaluation.parts, strict=True))
        for state, _ in pairs:
            finder = state.finder
            if isinstance(finder, ByMatrices) and not confirms_by_matrices(
                state.campaign, finder.solver
            ):
                finder.release()  # the solver needs the factors' memory
        parts = [
            part
            if part.solved_by == state.case.solver.program.name
            else self._confirmed(title, state, part)
            for state, part in pairs
        ]
        return self.whole(evaluation.theta, parts)

    def refute_matrices(self, apart: float) -> None:
        """Stop using stored matrices: the solver's frequencies differ by `apart`, relative."""
        error = UnlikeMatrices(f"the solver's own frequencies differ by {apart:.1e}")
        for state in self.used:
            if isinstance(state.finder, ByMatrices):
                state.finder = state.finder.instead(error)

    def _confirmed(self, title: str, state: CaseState, part: CaseEvaluation) -> CaseEvaluation:
        wanted = [part.pairing.computed]
        if part.held_out is not None:
            wanted.append(part.held_out.computed)
        # Each mode and all energies take the solver time: request only modes that are compared and
        # their close neighbours, in whose space they are judged.
        compared = int(np.max(np.concatenate(wanted)))
        last = part.modal.n_rigid + int(close_modes(part.seen.frequencies_hz, compared).max()) + 1
        every = replace(state.analysis, groups=())
        try:
            return self._by_solver(title, state, part, replace(every, n_modes=last))
        except LostMode:
            return self._by_solver(title, state, part, every)

    def _by_solver(
        self, title: str, state: CaseState, part: CaseEvaluation, analysis: ModalAnalysis
    ) -> CaseEvaluation:
        finder = state.finder
        if isinstance(finder, ByMatrices) and confirms_by_matrices(state.campaign, finder.solver):
            found = finder.confirmed(title, state, part, analysis, self._begun)
            if found is not None:
                return found
            finder.release()
        job = Job(state.campaign.parameters.values(part.theta), analysis)
        name = state.case.solver.program.name
        work = Work(f"modal confirmation by {name}", (job,), state.engine)
        outcome = self._begun(title, work, state)()
        modal = outcome.result(ModalResult)
        return state.compared(part.theta, outcome.key, modal, part, name)

    def _begun(self, title: str, work: Work, state: CaseState) -> Callable[[], JobOutcome]:
        """Begin a job; return a function that waits for its end and calls `idle` meanwhile."""
        engine = work.engine or state.engine
        stored = all(engine.key(item) in engine.store for item in work.jobs)
        job = in_background("confirm", lambda: self.carry_out(title, [work], state))

        def wait() -> JobOutcome:
            if not stored and not job.done():
                self.idle()
            ((outcome,),) = job.result()
            return outcome

        return wait


def _numbered(works: Sequence[Work]) -> list[Work]:
    """Return works with unique names: equal names, as of many points, get numbers."""
    many, place = Counter(work.name for work in works), Counter[str]()
    named = []
    for work in works:
        place[work.name] += 1
        which = f" {place[work.name]} of {many[work.name]}" if many[work.name] > 1 else ""
        named.append(replace(work, name=work.name + which))
    return named


def _identity(item: CaseWork) -> tuple[object, ...]:
    """Return what distinguishes a piece of work from others."""
    state, work = item
    return id(state), work.name, *((*job.values.items(), job.analysis) for job in work.jobs)


def _derived_points(
    within: Evaluator, title: str, thetas: Floats, track: ModeTrack
) -> tuple[list[Evaluation | ModetuneError], tuple[()]]:
    """Return evaluations by a reduced model, with no job to show."""
    return within._points(title, thetas, track), ()


def _model_state(case: Case, part: CaseEvaluation) -> ModelState:
    """Return the model state of an evaluated case for its responses."""
    return model_state(case, part.seen, part.pairing, part.modal, part.matrices)
