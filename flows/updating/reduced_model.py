"""Modes from stored matrices and reduced models, without a solver run at a point.

    matrix jobs, once      K(p), M(p) for all values             `matrices.py`
    each point             modes of K(theta), M(theta)           `solutions.py`: a factorisation
    with them              a reduced model around the point      `core/updating/reduced_model`
    each step              the whole problem on reduced models   milliseconds
    at the end             the solver's own modes or matrices    one job a case

Sensitivities follow from the reduced model that the step needs, so e2 has none to skip.

A reduced model gives the modes around a point for all parameter values, so the updating loop runs
on it to its own end, with the campaign's step form, bounds and criteria, within the region in which
the step may end. Its end is one step of the real campaign, which the full model then confirms or
not. A step that is short compared with one whose end was predicted well is not solved with the
matrices: where the reduced models predict that e1 holds there, the solver's own modes are next.

For many points a reduced model grows until its worst point within the bounds agrees with the full
solution (`core/updating/reduced_model`); a point with too large an error estimate is solved in
full. One solver run at the worst point confirms the model for all later use within the bounds.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace

import numpy as np

from modetune.adapters.solver import MatrixAnalysis, ModalAnalysis
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.correlation.pairing import LostMode, close_modes
from modetune.core.errors import ModelError, ModesError, ModetuneError, NoResult
from modetune.core.modes import Floats, Integers
from modetune.core.updating.job_results import ModalResult
from modetune.core.updating.parameter_steps import Step
from modetune.core.updating.reduced_model import RangeUse, ReducedModel, ReducedRange, range_sets
from modetune.core.updating.responses.response import MatricesAt
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.engine import JobEngine, JobOutcome
from modetune.flows.jobs.execution import Done, Work
from modetune.flows.jobs.job import Job
from modetune.flows.jobs.watching import doing
from modetune.flows.jobs.work import meanwhile
from modetune.flows.updating.evaluation import CaseEvaluation, Evaluation, Point
from modetune.flows.updating.evaluator import CaseState, Evaluator
from modetune.flows.updating.loop import CONFIRMED, Loop, Watcher
from modetune.flows.updating.matrices import MatrixSource
from modetune.flows.updating.mode_source import (
    REDUCED,
    BySolver,
    Columns,
    ModeFinder,
    assembled,
    confirms_by_matrices,
    unless_failed,
)
from modetune.flows.updating.sensitivities import UnlikeMatrices
from modetune.flows.updating.solutions import MatrixModes

logger = logging.getLogger(__name__)

#: Who finds modes, in records.
MATRICES = "stored matrices"
#: Share of e1's frequency tolerance, and of what tells models apart, that a reduced model may be
#: off where it is believed.
BELIEVED = 0.1
#: Steps on the reduced models at most; they cost next to nothing.
ITERATIONS = 100


@dataclass(slots=True)
class ByMatrices(ModeFinder):
    """Modes by the stored matrices of all values, derivatives by a reduced model around a set.

    solver: what takes over where the matrices turn out not to be the model's (parts that they do
    not hold, sensors whose motion does not follow from them).
    """

    campaign: Campaign
    engine: JobEngine
    source: MatrixSource
    solver: BySolver
    cheap: bool = True
    _modes: MatrixModes | None = field(default=None, init=False)

    @property
    def name(self) -> str:
        held = "" if self._modes is None else self._modes.held
        return f"{MATRICES}, factors{held}" if held else MATRICES

    def works(self, theta: Floats, analysis: ModalAnalysis) -> list[Work]:
        if self._modes is not None:
            return []
        return self.source.works(self.campaign.start, range(len(self.campaign.parameters)))

    def modes(
        self, theta: Floats, analysis: ModalAnalysis, done: Sequence[Done]
    ) -> tuple[str, ModalResult]:
        return self.stored(done).modal(theta, analysis)

    def assembled(self, theta: Floats) -> MatricesAt:
        return assembled(self.source, theta)

    def sensitivity_works(self, theta: Floats, analysis: ModalAnalysis) -> list[Work]:
        return self.works(theta, analysis)

    def columns(self, point: Point, analysis: ModalAnalysis, done: Sequence[Done]) -> Columns:
        stored = self.stored(done)
        reduced = stored.reduced(point, analysis)
        exact = stored.derivatives(point, analysis)
        if exact is None:
            return reduced_columns(reduced, point)
        return Columns(exact, ("semi_analytic",) * point.theta.size, (point.key,))

    def instead(self, error: ModetuneError) -> BySolver:
        logger.warning("%s: modes are the solver's own from now on", error)
        self.release()
        return self.solver

    def release(self) -> None:
        """Leave the factors' memory to others."""
        if self._modes is not None:
            self._modes.release()
        self._modes = None

    def stored(self, done: Sequence[Done] = ()) -> MatrixModes:
        """Modes and reduced models by the matrices of all values, once their jobs are done.

        Raises UnlikeMatrices, ModelError; so does what it is asked for.
        """
        for item in done:
            if isinstance(item, NoResult):
                raise UnlikeMatrices(str(item)) from item
            unless_failed(item)
        found = self._modes or MatrixModes(self.campaign, self.engine, self.source)
        self._modes = found  # who confirms may release it meanwhile
        return found


@dataclass(frozen=True, slots=True)
class ByReduced(ModeFinder):
    """Modes by a reduced model around a set that was evaluated in full."""

    reduced: ReducedModel
    around: CaseEvaluation
    name: str = REDUCED
    cheap: bool = True

    def modes(
        self, theta: Floats, analysis: ModalAnalysis, done: Sequence[Done]
    ) -> tuple[str, ModalResult]:
        known, n_rigid = self.around.modal.modes, self.around.modal.n_rigid
        modal = reduced_modal(
            self.reduced, theta, known.n_modes, n_rigid, known.nodes, known.components
        )
        return self.around.key, modal

    def assembled(self, theta: Floats) -> MatricesAt:
        assert self.around.matrices is not None
        return replace(self.around.matrices, theta=theta, around=self.around.theta)

    def columns(self, point: Point, analysis: ModalAnalysis, done: Sequence[Done]) -> Columns:
        return reduced_columns(self.reduced, point)


def reduced_modal(
    reduced: ReducedModel,
    theta: Floats,
    n_modes: int,
    n_rigid: int,
    nodes: Integers,
    components: Integers,
) -> ModalResult:
    """The lowest modes of a reduced model at its rows, whose degrees of freedom these are.

    n_rigid: how many of them are rigid, as in the model that was reduced. Raises ModesError where
    it has no such modes.
    """
    eigenvalues, shapes = reduced.modes(theta, n_modes)
    return ModalResult.of_shapes(eigenvalues, shapes, nodes, components, 0.5 * eigenvalues, n_rigid)


def reduced_columns(reduced: ReducedModel, point: Point) -> Columns:
    """The derivatives at a point, exact within a reduced model around it."""
    modal = point.modal
    paired = point.pairing.computed + modal.n_rigid
    shapes = np.real(modal.modes.mode_shapes[:, paired])
    found = reduced.derivatives(point.theta, paired, shapes)
    return Columns(found, (REDUCED,) * point.theta.size, (point.key,))


@dataclass(frozen=True, slots=True)
class Miss:
    """How far frequencies were from what was foreseen, relative, and after how long a step."""

    error: float
    length: float

    def after(self, length: float) -> float:
        """What to expect after another step: reduced models' errors grow at least as its square."""
        return self.error * (length / self.length) ** 2


class ReducedForesight:
    """What the reduced models of an evaluator's cases foresee, and whether it is believed."""

    def __init__(self, evaluator: Evaluator) -> None:
        self.evaluator = evaluator
        self.campaign = evaluator.campaign
        self._foreseen: Evaluation | None = None
        self._miss: Miss | None = None
        self._foresees = True
        #: The cases on the newest reduced models; none before the first step.
        self.states: list[CaseState] = []

    def refined(
        self, current: Evaluation, step: Step, region: tuple[Floats, Floats]
    ) -> Step | None:
        """The step to where updating ends on reduced models around the current set.

        step: the linear one, whose regularisation and condition it keeps; region: lower and upper
        values. None where there is not a reduced model in every case, or it cannot be updated.
        """
        states = []
        for state, part in zip(self.evaluator.used, current.parts, strict=True):
            if not isinstance(state.finder, ByMatrices):
                return None
            try:
                reduced = ByReduced(state.finder.stored().reduced(part.point, state.analysis), part)
            except (UnlikeMatrices, ModelError) as error:
                state.finder = state.finder.instead(error)
                return None
            case = replace(state.case, held_out=None)
            states.append(replace(state, case=case, finder=reduced))
        inner = replace(
            self.campaign,
            cases=tuple(state.case for state in states),
            begin=tuple(current.theta.tolist()),
            update=self.campaign.update.model_copy(update={"max_iterations": ITERATIONS}),
        )
        self.states = states
        evaluator = Evaluator(inner, states, self.evaluator.execution)
        try:
            end = Loop(inner, evaluator, Unnoted(), region, current).run()
        except ModesError as error:
            logger.debug("no reduced step: %s", error)
            return None
        self._foreseen = end.last
        change = end.last.theta - current.theta
        return replace(step, change=change, predicted=end.last.residual.values)

    def believed(self, theta: Floats, previous: Evaluation | None) -> Evaluation | None:
        """What the reduced models foresee at a set, if e1 holds there and they can be believed."""
        foreseen = self._foreseen_at(theta)
        if foreseen is None or previous is None or self._miss is None or not self._foresees:
            return None
        tolerances, length = self.campaign.tolerances, _length(theta, previous)
        doubt = self._miss.after(length)
        least = BELIEVED * min(tolerances.frequency, CONFIRMED)
        if doubt > least or not foreseen.agrees(tolerances):
            return None
        parts = []
        try:
            for state, before in zip(self.evaluator.used, previous.parts, strict=True):
                if not isinstance(state.finder, ByMatrices):
                    return None
                own = state.own(theta)
                key, modal = state.finder.stored().foreseen(own, state.analysis)
                parts.append(state.compared(own, key, modal, before, REDUCED))
        except ModesError as error:
            logger.debug("nothing is foreseen: %s", error)
            return None
        found = self.evaluator.whole(theta, parts)
        return found if found.agrees(tolerances) else None

    def look_back(self, evaluation: Evaluation, previous: Evaluation | None) -> None:
        """Keep how far the reduced models' frequencies were from those found now."""
        foreseen = self._foreseen_at(evaluation.theta)
        if foreseen is not None and previous is not None:
            error = float(np.max(np.abs(foreseen.errors - evaluation.errors)))
            self._miss = Miss(error, _length(evaluation.theta, previous))

    def confirmed(self, title: str, evaluation: Evaluation) -> Evaluation | None:
        """A set evaluated by the solvers' own modes; None where it was so already."""
        pairs = list(zip(self.evaluator.used, evaluation.parts, strict=True))
        if all(part.solved_by == state.case.solver.program.name for state, part in pairs):
            return None
        for state, _ in pairs:
            finder = state.finder
            if isinstance(finder, ByMatrices) and not confirms_by_matrices(
                state.campaign, finder.solver
            ):
                finder.release()  # the factors' memory is the solver's now
        parts = [
            part
            if part.solved_by == state.case.solver.program.name
            else self._confirmed(title, state, part)
            for state, part in pairs
        ]
        return self.evaluator.whole(evaluation.theta, parts)

    def refuted(self, evaluation: Evaluation, apart: float) -> None:
        """The solver's own frequencies at this set differ by apart, relative."""
        foreseen = any(part.solved_by == REDUCED for part in evaluation.parts)
        if foreseen and apart <= CONFIRMED:  # e1 is just not met
            logger.info("the reduced model's frequencies differ by %.1e from the solver's", apart)
            self._foresees = False
            return
        error = UnlikeMatrices(f"the solver's own frequencies differ by {apart:.1e}")
        for state in self.evaluator.used:
            if isinstance(state.finder, ByMatrices):
                state.finder = state.finder.instead(error)

    def _confirmed(self, title: str, state: CaseState, part: CaseEvaluation) -> CaseEvaluation:
        wanted = [part.pairing.computed]
        if part.held_out is not None:
            wanted.append(part.held_out.computed)
        # Each mode and all energies cost the solver time: only what is compared is asked for, with
        # the modes next to it, in whose space it is judged.
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
            found = self._by_assembled(title, state, finder, part, analysis)
            if found is not None:
                return found
            finder.release()
        job = Job(state.campaign.parameters.values(part.theta), analysis)
        name = state.case.solver.program.name
        work = Work(f"modal confirmation by {name}", (job,), state.engine)
        outcome = self._begun(title, work, state)()
        modal = outcome.result(ModalResult)
        return state.compared(part.theta, outcome.key, modal, part, name)

    def _by_assembled(
        self,
        title: str,
        state: CaseState,
        finder: ByMatrices,
        part: CaseEvaluation,
        analysis: ModalAnalysis,
    ) -> CaseEvaluation | None:
        """By the matrices that the solver assembles at the set; None where they do not agree."""
        name = state.case.solver.program.name
        job = Job(state.campaign.parameters.values(part.theta), MatrixAnalysis())

        def begun() -> Callable[[], MatrixResult]:
            wait = self._begun(title, Work(f"matrices by {name}", (job,), state.engine), state)
            return lambda: wait().result(MatrixResult)

        try:
            own = state.engine.key(job)
            with doing(title):
                key, modal, counted = finder.stored().assembled(part.theta, analysis, own, begun)
        except (ModelError, UnlikeMatrices) as error:
            logger.warning("%s: its own modes are looked at", error)
            return None
        said = "counted" if counted else "not counted"
        said = f"{name}'s matrices, {modal.eigenvalues.size} modes {said}"
        found = state.compared(part.theta, key, modal, part, said)
        apart = float(np.max(np.abs(found.errors - part.errors)))
        if apart > CONFIRMED:
            logger.warning(
                "frequencies by %s's matrices differ by %.1e: its own modes are looked at",
                name,
                apart,
            )
            return None
        return found

    def _begun(self, title: str, work: Work, state: CaseState) -> Callable[[], JobOutcome]:
        """What waits for the end of a job that begins, and does what there is to do meanwhile."""
        job = meanwhile("confirm", lambda: self.evaluator.carry_out(title, [work], state))

        def wait() -> JobOutcome:
            if not job.done():
                self.evaluator.idle()
            ((outcome,),) = job.result()
            return outcome

        return wait

    def _foreseen_at(self, theta: Floats) -> Evaluation | None:
        """The end of the last step on reduced models, if it is this set."""
        foreseen = self._foreseen
        if foreseen is None or not np.allclose(foreseen.theta, theta, rtol=0.0, atol=1e-12):
            return None
        return foreseen


def _length(theta: Floats, previous: Evaluation) -> float:
    """How far a set is from another one; never zero."""
    return max(float(np.max(np.abs(theta - previous.theta))), float(np.finfo(np.float64).eps))


class Unnoted(Watcher):
    """A loop that nobody watches."""


@dataclass(slots=True)
class Tally:
    """Sets that a range was asked for, those that were solved in full, and the largest estimate
    of the others."""

    sets: int = 0
    in_full: int = 0
    estimate: float = 0.0


@dataclass(frozen=True, slots=True)
class ByRange(ModeFinder):
    """Modes by a reduced model for a range of values, and by the matrices where it may be off.

    key: of the range; around: an evaluated set, whose degrees of freedom the range has. worst:
    (n_parameters,), the last set of the range that was solved in full. in_full: whether the
    matrices, whose jobs went before the range, stand in where it may be off; else its estimate
    alone tells so.
    """

    key: str
    range: ReducedRange
    around: CaseEvaluation
    matrices: ByMatrices
    worst: Floats
    in_full: bool = True
    name: str = REDUCED
    cheap: bool = True
    tally: Tally = field(default_factory=Tally)

    def modes(
        self, theta: Floats, analysis: ModalAnalysis, done: Sequence[Done]
    ) -> tuple[str, ModalResult]:
        found = self._reduced(theta, analysis.n_modes)
        self.tally.sets += 1
        self.tally.in_full += found is None
        return found or self.matrices.modes(theta, analysis, done)

    def assembled(self, theta: Floats) -> MatricesAt:
        return self.matrices.assembled(theta)

    def columns(self, point: Point, analysis: ModalAnalysis, done: Sequence[Done]) -> Columns:
        return reduced_columns(self.range.model, point)

    def _reduced(self, theta: Floats, n_modes: int) -> tuple[str, ModalResult] | None:
        """By the range; None where it may be off by more than what confirms a set."""
        known = self.around.modal
        if not self.in_full:
            n_modes = min(n_modes, known.modes.n_modes)
        if n_modes > known.modes.n_modes:
            return None
        try:
            eigenvalues, shapes, off = self.range.modes(
                self.matrices.source.written(theta), n_modes
            )
        except ModesError as error:
            if not self.in_full:
                raise
            logger.debug("not by the range: %s", error)
            return None
        if off > CONFIRMED and self.in_full:
            return None
        self.tally.estimate = max(self.tally.estimate, off)
        modes = known.modes
        return self.key, ModalResult.of_shapes(
            eigenvalues, shapes, modes.nodes, modes.components, 0.5 * eigenvalues, known.n_rigid
        )


class ReducedRanges:
    """Reduced models that hold between the bounds, one a case, made when first asked for."""

    def __init__(self, evaluator: Evaluator) -> None:
        self.evaluator = evaluator
        self._finders: list[ByRange] = []
        self._confirming: tuple[Evaluation, Future[Evaluation | None]] | None = None
        self._confirmed: tuple[str, float, str] | None = None
        self._refused = False

    @property
    def asked(self) -> float:
        """What frequencies may be off by, relative."""
        return BELIEVED * min(self.evaluator.campaign.tolerances.frequency, CONFIRMED)

    @property
    def use(self) -> RangeUse | None:
        """How sets were evaluated so, and what confirmed it; None where none was."""
        if self._confirmed is None:
            return None
        ranges = [finder.range for finder in self._finders]
        tallies = [finder.tally for finder in self._finders]
        return RangeUse(
            sets=max(tally.sets for tally in tallies),
            vectors=max(own.size for own in ranges),
            solutions=sum(1 + len(own.solved) for own in ranges),
            asked=self.asked,
            error=max(float(own.errors[-1]) for own in ranges),
            estimate=max(tally.estimate for tally in tallies),
            in_full=sum(tally.in_full for tally in tallies),
            solver=self._confirmed[0],
            apart=self._confirmed[1],
            where=self._confirmed[2],
        )

    def within(
        self, campaign: Campaign, around: Evaluation, in_full: bool = True, ahead: bool = False
    ) -> Evaluator | None:
        """What evaluates sets of a campaign within the bounds, another test of the same models
        among them; None where a case has no such model, or the solver does not confirm it.

        around: an evaluated set of the evaluator's own campaign; in_full: whether sets at which
        the reduced model may be off are solved in full; ahead: sets may be evaluated while the
        solver confirms the model, and are to be believed if it `stands`.
        """
        if not self._finders and not self._refused:
            self._finders = self._made(around)
            self._refused = not self._finders or not self._asked(around)
        if not ahead:
            self.stands()
        return None if self._refused else self._evaluator(campaign, in_full)

    def stands(self) -> bool:
        """Whether the solver confirms the frequencies where they were worst; its run is awaited."""
        if self._confirming is not None:
            (there, run), self._confirming = self._confirming, None
            self._refused = not self._agrees(there, run.result())
        return not self._refused

    def _evaluator(self, campaign: Campaign, in_full: bool = True) -> Evaluator:
        """The evaluator's cases on the ranges, as this campaign compares them or judges by them."""
        pairs = zip(self.evaluator.used, self._finders, strict=True)
        named = {pair[0].case.name: pair for pair in pairs}
        states = [*self.evaluator.aside]
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
        return Evaluator(campaign, states, self.evaluator.execution)

    def _asked(self, around: Evaluation) -> bool:
        """Whether the solver can be asked about the frequencies where they were worst; it is."""
        place = max(range(len(self._finders)), key=lambda n: self._finders[n].range.errors[-1])
        finder, state = self._finders[place], self.evaluator.used[place]
        theta = around.theta.copy()
        theta[state.columns] = finder.worst
        (there,) = self._evaluator(self.evaluator.campaign).points("range", theta[None], [around])
        for item in self._finders:
            item.tally.sets = item.tally.in_full = 0
        if not isinstance(there, Evaluation):
            logger.info("the reduced model cannot be confirmed: %s", there)
            return False
        self._confirming = there, meanwhile("confirm", lambda: self.evaluator.confirmed(0, there))
        return True

    def _agrees(self, there: Evaluation, confirmed: Evaluation | None) -> bool:
        """Whether the solver's frequencies are those of the reduced model."""
        assert confirmed is not None
        apart = float(np.max(np.abs(confirmed.errors - there.errors)))
        if apart > CONFIRMED:
            self.evaluator.refuted(there, apart)
            return False
        names = self.evaluator.campaign.parameters.names
        where = ", ".join(
            f"{n} {value:.4g}" for n, value in zip(names, there.theta.tolist(), strict=True)
        )
        self._confirmed = confirmed.solved_by, apart, where
        return True

    def _made(self, known: Evaluation) -> list[ByRange]:
        """A reduced model between the bounds in each case; none where a case has none."""
        found: list[ByRange] = []
        bounds = self.evaluator.campaign.parameters
        thetas = range_sets(bounds.lower, bounds.upper)
        for state, part in zip(self.evaluator.used, known.parts, strict=True):
            if not isinstance(state.finder, ByMatrices):
                return []
            own = np.array([state.own(theta) for theta in thetas])
            analysis = ModalAnalysis(state.case.n_modes, state.case.nodes)
            self.evaluator.carry_out("range", state.finder.works(part.theta, analysis), state)
            try:
                with doing("range"):
                    modes = state.finder.stored()
                    made = modes.over(part.point, own, analysis, self.asked, self._told)
            except (UnlikeMatrices, ModelError) as error:
                state.finder = state.finder.instead(error)
                return []
            except ModesError as error:
                logger.info("no reduced model between the bounds: %s", error)
                return []
            written = np.array([state.finder.source.written(theta) for theta in own])
            apart = np.abs(written - made[1].solved[-1]).sum(axis=1)
            found.append(ByRange(*made, part, state.finder, own[int(np.argmin(apart))]))
        return found

    def _told(self, solutions: int, error: float) -> None:
        self.evaluator.tell(
            f"reduced model: {solutions} full solutions, error {error:.0e}, asked {self.asked:.0e}"
        )
