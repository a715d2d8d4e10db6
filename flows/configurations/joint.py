"""Evaluating a parameter set in all configurations of a structure at once.

Every configuration has an evaluator of its own. What an iteration needs of all of them goes to the
execution in one go, so that the jobs of all configurations run side by side; each evaluator then
finds its outcomes there. Their evaluations become one: modes, pairs, residuals and sensitivities
stacked, frequencies of all first and then shapes of all, as `core/residual.py` has them. A
parameter that a configuration does not have changes nothing there.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from modetune.core.errors import ModesError, ModetuneError, SolverError
from modetune.core.held_out import HeldOut, join_held_out, judge_held_out, unfound
from modetune.core.modes import Floats, Integers, ModeSet
from modetune.core.numbering import numbered
from modetune.core.pairing import Pairing
from modetune.core.record import RunCounts
from modetune.core.residual import Residual
from modetune.flows.campaign import Campaign, Configuration
from modetune.flows.configurations.joined import node_base, side_by_side
from modetune.flows.evaluating import Evaluating, Matrix
from modetune.flows.evaluation import Evaluation, judged, part_rows
from modetune.flows.evaluator import CAMPAIGNS_OWN, Evaluator
from modetune.flows.execution.engine import JobEngine
from modetune.flows.execution.limits import CORES, Limit
from modetune.flows.execution.slurm import SlurmSolver
from modetune.flows.execution.work import Done, Execution, Work

logger = logging.getLogger(__name__)


def engine_of(engine: JobEngine, configuration: Configuration) -> JobEngine:
    """The campaign's engine for one configuration's model."""
    campaign = configuration.campaign
    solver, name = campaign.solver, campaign.solver.name
    limits = [limit for limit in engine.limits if limit.name == CORES]
    if name in campaign.run.licences:
        limits.append(Limit(name, campaign.run.licences[name], 1))
    if isinstance(engine.solver, SlurmSolver):
        solver = replace(engine.solver, solver=solver)
    return replace(engine, solver=solver, limits=tuple(limits), ahead={})


@dataclass
class Share:
    """An execution for one configuration: its work under its name, by its engine.

    ahead: what was run already together with the other configurations' work.
    """

    name: str
    engine: JobEngine
    execution: Execution
    ahead: list[tuple[Work, Done]] = field(default_factory=list)

    def named(self, work: Work) -> Work:
        return Work(f"{work.name} of {self.name}", work.jobs, self.engine)

    def run(self, iteration: str, work: Sequence[Work]) -> list[Done]:
        """Outcomes in the order of the work, from those that are there already or run now."""
        there = [self._found(item) for item in work]
        missing = [item for item, done in zip(work, there, strict=True) if done is None]
        ran = iter(self.execution.run(iteration, [self.named(item) for item in missing])
                   if missing else [])  # fmt: skip
        return [next(ran) if done is None else done for done in there]

    def skip(self, iteration: str, names: Sequence[str], reason: str) -> None:
        self.execution.skip(iteration, [f"{name} of {self.name}" for name in names], reason)

    def _found(self, work: Work) -> Done | None:
        for place, (item, done) in enumerate(self.ahead):
            if item == work:
                del self.ahead[place]  # once: what is asked for again is run again
                return done
        return None


@dataclass(frozen=True, slots=True)
class Part:
    """A configuration with what evaluates it."""

    configuration: Configuration
    share: Share
    evaluator: Evaluator

    def own(self, theta: Floats) -> Floats:
        """The configuration's own parameters among all."""
        return theta[list(self.configuration.columns)]


class JointEvaluator(Evaluating):
    """Evaluates parameter sets in all configurations that are used, and counts what it cost."""

    def __init__(self, campaign: Campaign, engine: JobEngine, execution: Execution) -> None:
        self.campaign = campaign
        self.engine = engine
        self.execution = execution
        parts = [self._part(item) for item in campaign.configurations]
        self.parts = [part for part in parts if not part.configuration.hold_out]
        self.aside = [part for part in parts if part.configuration.hold_out]

    @property
    def runs(self) -> RunCounts:
        """Solver runs so far, and what they cost."""
        runs = RunCounts()
        for part in (*self.parts, *self.aside):
            runs = runs.plus(part.evaluator.runs)
        ledger = self.engine.ledger
        return replace(runs, core_s=ledger.core_s, licence_s=ledger.licence_s)

    @property
    def cheap(self) -> bool:
        return all(part.evaluator.cheap for part in self.parts)

    def evaluate(
        self, number: int, theta: Floats, previous: Evaluation | None, alone: bool
    ) -> tuple[Evaluation, Matrix | None]:
        """A set's evaluation in all configurations, and its sensitivity unless the modal jobs are
        to go alone. Raises SolverError, ModesError, StoreError."""
        self._together(number, theta, slice(0, 1) if alone else slice(None))
        found, failed = [], []
        for place, part in enumerate(self.parts):
            before = previous.parts[place] if previous else None
            try:
                found.append(part.evaluator.evaluate(number, part.own(theta), before, alone))
            except ModetuneError as error:  # the others' runs are counted all the same
                logger.debug("%s: %s", part.configuration.name, error)
                failed.append(error)
        if failed:
            raise failed[0]
        evaluation = self._joint(theta, [item for item, _ in found])
        matrices = [matrix for _, matrix in found if matrix is not None]
        return evaluation, None if alone else self._stacked(evaluation, matrices)

    def matrix(self, number: int, evaluation: Evaluation) -> Matrix:
        """The sensitivity at an evaluated set."""
        self._together(number, evaluation.theta, slice(1, None))
        matrices = [
            part.evaluator.matrix(number, own)
            for part, own in zip(self.parts, evaluation.parts, strict=True)
        ]
        return self._stacked(evaluation, matrices)

    def skip(self, number: int, slope: float) -> None:
        """Note that e2 makes this iteration do without a sensitivity of its own."""
        for part in self.parts:
            part.evaluator.skip(number, slope)

    def planned(self, theta: Floats) -> list[Work]:
        """The work of an iteration at a set, with sensitivities."""
        return [
            part.share.named(work)
            for part in self.parts for work in part.evaluator.planned(part.own(theta))
        ]  # fmt: skip

    def held_out(self, initial: Evaluation, updated: Evaluation) -> HeldOut | None:
        """Modes and whole configurations that are only judged by, before and after.

        A held-out configuration takes two modal runs.
        """
        found = [
            _renumbered(held, part.configuration)
            for part, before, after in zip(self.parts, initial.parts, updated.parts, strict=True)
            if (held := judged(part.configuration.campaign, before, after)) is not None
        ]
        found += [self._judged_aside(part, initial.theta, updated.theta) for part in self.aside]
        return join_held_out(found)

    def _part(self, configuration: Configuration) -> Part:
        engine = engine_of(self.engine, configuration)
        share = Share(configuration.name, engine, self.execution)
        return Part(configuration, share, Evaluator(configuration.campaign, engine, share))

    def _together(self, number: int, theta: Floats, which: slice) -> None:
        """Run this much of each configuration's planned work side by side."""
        planned = [
            (part, work)
            for part in self.parts for work in part.evaluator.planned(part.own(theta))[which]
        ]  # fmt: skip
        done = self.execution.run(
            f"iteration {number}", [part.share.named(work) for part, work in planned]
        )
        for part in self.parts:
            part.share.ahead.clear()
        for (part, work), outcome in zip(planned, done, strict=True):
            part.share.ahead.append((work, outcome))

    def _judged_aside(self, part: Part, initial: Floats, updated: Floats) -> HeldOut:
        campaign = part.configuration.campaign
        states: list[tuple[ModeSet, Pairing]] = []
        before = None
        for theta in (initial, updated):
            try:
                before, _ = part.evaluator.evaluate(0, part.own(theta), before, alone=True)
                states.append((before.seen, before.pairing))
            except (ModesError, SolverError) as error:
                if isinstance(error, CAMPAIGNS_OWN):
                    raise
                logger.warning("the held-out configuration %s: %s", part.configuration.name, error)
                states.append(unfound(campaign.test))
        deviation = campaign.weighting.frequency_deviation
        held = judge_held_out(campaign.test, deviation, states[0], states[1])
        return _renumbered(held, part.configuration)

    def _joint(self, theta: Floats, parts: Sequence[Evaluation]) -> Evaluation:
        """The evaluations of all configurations as one."""
        configurations = [part.configuration for part in self.parts]
        base = node_base([item.campaign.test for item in configurations])
        modes = [
            (item.place, part.seen if item.campaign.test.has_shapes else part.seen.rows([]))
            for item, part in zip(configurations, parts, strict=True)
        ]
        seen = side_by_side(modes, base)
        return Evaluation(
            theta=theta,
            key=" ".join(part.key for part in parts),
            modal=parts[0].modal,
            seen=seen,
            field=seen,  # several models have no common surface to be shown on
            pairing=_joint_pairing(configurations, parts),
            residual=self._residual(parts),
            errors=np.concatenate([part.errors for part in parts]),
            parts=tuple(parts),
            solved_by=self.campaign.solver.name,
        )

    def _residual(self, parts: Sequence[Evaluation]) -> Residual:
        rows = part_rows(parts)
        weighted = [
            part.configuration.weight * own.residual.weights
            for part, own in zip(self.parts, parts, strict=True)
        ]
        return Residual(
            values=_merged([own.residual.values for own in parts], rows),
            weights=_merged(weighted, rows),
            variances=_merged([own.residual.variances for own in parts], rows),
            n_frequencies=sum(own.residual.n_frequencies for own in parts),
        )

    def _stacked(self, evaluation: Evaluation, matrices: Sequence[Matrix]) -> Matrix:
        """The sensitivities of all configurations as one; a column that one of them lacks is
        missing altogether, since half a derivative is a wrong one."""
        names = self.campaign.parameters.names
        values = np.zeros((evaluation.residual.values.size, len(names)))
        methods: list[dict[str, None]] = [{} for _ in names]
        missing: set[int] = set()
        rows = part_rows(evaluation.parts)
        for part, matrix, own in zip(self.parts, matrices, rows, strict=True):
            columns = np.array(part.configuration.columns, dtype=np.int64)
            values[np.ix_(own, columns)] = matrix.values
            missing |= {int(columns[column]) for column in matrix.missing}
            for column, method in zip(columns.tolist(), matrix.methods, strict=True):
                methods[column][method] = None
        values[:, sorted(missing)] = 0.0
        return Matrix(
            values=values,
            methods=tuple("+".join(found) for found in methods),
            keys=tuple(key for matrix in matrices for key in matrix.keys),
            age=0,
            missing=tuple(sorted(missing)),
        )


def _merged(values: Sequence[Floats], rows: Sequence[Integers]) -> Floats:
    merged = np.zeros(sum(item.size for item in values))
    for own, place in zip(values, rows, strict=True):
        merged[place] = own
    return merged


def _joint_pairing(configurations: Sequence[Configuration], parts: Sequence[Evaluation]) -> Pairing:
    """The pairs of all configurations, positions counted through both sides."""
    measured, computed, reasons = [], [], []
    n_measured = n_computed = 0
    for configuration, part in zip(configurations, parts, strict=True):
        measured.append(part.pairing.measured + n_measured)
        computed.append(part.pairing.computed + n_computed)
        reasons += [f"{reason} ({configuration.name})" for reason in part.pairing.reasons]
        n_measured += part.pairing.measured.size
        n_computed += part.seen.n_modes
    return Pairing(
        np.concatenate(measured),
        np.concatenate(computed),
        np.concatenate([part.pairing.mac for part in parts]),
        np.concatenate([part.pairing.subspace_mac for part in parts]),
        tuple(reasons),
    )


def _renumbered(held: HeldOut, configuration: Configuration) -> HeldOut:
    return replace(held, numbers=numbered(configuration.place, 0) + held.numbers)
