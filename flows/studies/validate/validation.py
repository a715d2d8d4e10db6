"""Validation of an updated model with data that updating did not use.

Leave-one-out cross-validation runs one update for each used mode, without that mode, and compares
the mode afterwards. If modes come from matrices, all updates share one reduced model that holds
between the bounds; the solver confirms it once at its worst point. Otherwise the updates run in
parallel and share a store, which has most of their jobs already because they differ little at
first. If the parameters of all updates agree, the result is sound; if they scatter, it depends on
single modes.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from modetune.core.brief import brief
from modetune.core.correlation.holdout import HeldOut, join_held_out, together
from modetune.core.errors import CampaignError, ModesError, SolverError
from modetune.core.modes import Floats, mode_name
from modetune.core.storage.campaign_record import CampaignRecord, RunCounts
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.schema import STORE_REMEDY
from modetune.flows.jobs.campaign_engine import solving_engine
from modetune.flows.jobs.engine import JobEngine
from modetune.flows.jobs.execution import on_threads
from modetune.flows.updating.evaluation import Evaluation
from modetune.flows.updating.evaluator import Evaluator, evaluator_of
from modetune.flows.updating.forecast import Progress
from modetune.flows.updating.mode_source import CAMPAIGNS_OWN, STEPS, UPDATING, Demand
from modetune.flows.updating.poses import settled
from modetune.flows.updating.update import Updating

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Fold:
    """An update and what was held out of it.

    number, configuration: of the mode that was left out; 0 where it is what the campaign itself
    holds out. updated: (n_parameters,), NaN where the update failed; held_out: None then.
    """

    number: int
    status: str
    reason: str
    iterations: int
    updated: Floats
    held_out: HeldOut | None
    configuration: str = ""

    @property
    def name(self) -> str:
        """What is done in it."""
        if not self.number:
            return "updating"
        return f"without {mode_name(self.number, self.configuration)}"


@dataclass(frozen=True, slots=True, repr=False)
class Validation:
    """What was held out, before and after; runs: what all updates took."""

    name: str
    parameters: tuple[str, ...]
    folds: tuple[Fold, ...]
    runs: RunCounts
    wall_s: float

    __repr__ = brief

    @property
    def held_out(self) -> HeldOut | None:
        """What was held out of all updates that came to an end."""
        return join_held_out([fold.held_out for fold in self.folds if fold.held_out is not None])

    @property
    def sentence(self) -> str:
        """What the status says."""
        return {
            "good": "nothing that was held out got worse",
            "worse": "what was held out got worse",
            "failed": "not every update came to an end",
        }[self.status]

    @property
    def failed(self) -> tuple[Fold, ...]:
        return tuple(fold for fold in self.folds if fold.held_out is None)

    @property
    def spread(self) -> tuple[Floats, Floats]:
        """Least and largest value of each parameter over the updates, (n_parameters,) each."""
        values = np.array([fold.updated for fold in self.folds if fold.held_out is not None])
        if values.size == 0:
            unknown = np.full(len(self.parameters), np.nan)
            return unknown, unknown
        return values.min(axis=0), values.max(axis=0)

    @property
    def status(self) -> str:
        """good, worse (something held out got worse) or failed (an update came to no end)."""
        if self.failed:
            return "failed"
        return "worse" if self.held_out is not None and self.held_out.any_worse else "good"


def leave_out(campaign: Campaign, number: int, configuration: str = "") -> Campaign:
    """The campaign without one of its used modes, which is held out instead.

    configuration: whose mode it is, where there are several; one is left out whole whose only used
    mode it is. What the campaign holds out by itself stays so. Raises CampaignError where nothing
    would be left.
    """
    names = [case.name for case in campaign.cases]
    case = campaign.cases[names.index(configuration)]
    rest = tuple(other for other in case.test.numbers if other != number)
    if not rest and len(campaign.used) == 1:
        raise CampaignError(
            f"{campaign.file}: mode {number} is the only one that is used, so it cannot be left "
            "out; leave-one-out needs two used modes or more"
        )
    if rest:
        left = case.test.use((number,))
        held = left if case.held_out is None else together(left, case.held_out)
        places = [case.test.numbers.index(other) for other in rest]
        own = case.weighting.frequency_deviations[case.test.numbers.index(number)]
        changed = replace(
            case,
            test=case.test.use(rest),
            weighting=case.weighting.modes(places),
            held_out=held,
            held_out_deviations=np.append(own, case.held_out_deviations),
        )
    else:
        changed = replace(case, aside=True)
    cases = tuple(changed if item is case else item for item in campaign.cases)
    # All updates begin where the campaign does, or their spread would include that of the starts.
    return replace(campaign, cases=cases, update=campaign.update.model_copy(update={"starts": 1}))


def leave_one_out(campaign: Campaign, working: Callable[[str], None]) -> Validation:
    """Update without each used mode in turn and judge it by that mode.

    The updates go side by side as far as the campaign's engine lets their jobs. One that fails is
    reported and does not stop the others. working: is called with what is being done.
    Raises CampaignError, SolverMissing, LicenceDenied, StoreError.
    """
    campaign = settled(campaign)
    modes = [(number, case.name) for case in campaign.used for number in case.test.numbers]
    campaigns = [leave_out(campaign, *mode) for mode in modes]
    return _validated(campaign, modes, campaigns, working)


def validate(campaign: Campaign, working: Callable[[str], None]) -> Validation:
    """Update and judge by what the campaign itself holds out; as `leave_one_out`.

    Raises CampaignError where it holds out nothing; SolverError, ModesError, StoreError.
    """
    if not any(case.aside or case.held_out is not None for case in campaign.cases):
        raise CampaignError(
            f"{campaign.file} holds out nothing to judge by: name modes with `test.hold_out`, or "
            "leave each mode out in turn with --leave-one-out"
        )
    campaign = settled(campaign)
    return _validated(campaign, [(0, "")], [campaign], working)


def _validated(
    campaign: Campaign,
    modes: Sequence[tuple[int, str]],
    campaigns: Sequence[Campaign],
    working: Callable[[str], None],
) -> Validation:
    started = time.monotonic()
    campaign.solver_version()  # report a missing solver before anything else starts
    campaign.store.check_usable(STORE_REMEDY)
    with solving_engine(campaign) as engine:
        several = len(campaigns) > 1
        demand = Demand(1, STEPS * len(campaigns)) if several else UPDATING
        whole = evaluator_of(campaign, engine, demand=demand)
        known = _on_range(campaign, whole) if several else None
        # What is found within one process goes one after another.
        workers = 1 if known else min(len(campaigns), campaign.parallel)
        folds = []
        for (number, configuration), one in zip(modes, campaigns, strict=True):
            unknown = np.full(len(campaign.parameters), np.nan)
            begun = Fold(number, "failed", "", 0, unknown, None, configuration)
            folds.append(partial(_fold, begun, one, engine, working, whole, known))
        done = on_threads(engine, folds, workers, "modetune-fold")
        runs = whole.runs
        for _, counted in done:
            runs = runs.plus(replace(counted, core_s=0.0, licence_s=0.0))
        runs = replace(runs, core_s=engine.costs.core_s, licence_s=engine.costs.licence_s)
    return Validation(
        campaign.name,
        campaign.parameters.names,
        tuple(fold for fold, _ in done),
        runs,
        time.monotonic() - started,
    )


def _on_range(campaign: Campaign, whole: Evaluator) -> Evaluation | None:
    """A set around which there are reduced models that hold between the bounds; None where there
    are none."""
    if not whole.reducible:
        return None
    try:
        known, _ = whole.evaluate("start", campaign.start, None, alone=True)
    except (SolverError, ModesError) as error:
        if isinstance(error, CAMPAIGNS_OWN):
            raise
        logger.info("each update runs separately: %s", error)
        return None
    return known if whole.within(campaign, known) else None


def _fold(
    fold: Fold,
    campaign: Campaign,
    engine: JobEngine,
    working: Callable[[str], None],
    whole: Evaluator,
    known: Evaluation | None,
) -> tuple[Fold, RunCounts]:
    """Run the update of one fold. If it fails, the fold has the reason instead of
    its end.

    whole: evaluates the campaign that nothing is left out of; known: a set of it, around which its
    reduced models are made, None where there are none.
    """
    engine = replace(engine, tasks=engine.tasks.of_part(fold.name if fold.number else ""))
    evaluator = whole.within(campaign, known) if known else None
    if evaluator is None:
        evaluator = evaluator_of(campaign, engine, like=whole.campaign)
    updating = Updating(
        campaign, evaluator, _NamedProgress(fold.name, working), lambda record: None
    )
    try:
        record = updating.run()
    except (SolverError, ModesError) as error:
        if isinstance(error, CAMPAIGNS_OWN) or fold.number == 0:
            raise
        logger.warning("%s: %s", fold.name, error)
        done = max(len(updating.iterations) - 1, 0)
        return replace(fold, reason=str(error), iterations=done), evaluator.runs
    return _judged(fold, record), record.runs


def _judged(fold: Fold, record: CampaignRecord) -> Fold:
    held = record.held_out
    assert held is not None
    if fold.number:
        left_out = mode_name(fold.number, fold.configuration)
        held = held.only(np.array([name == left_out for name in held.names]))
    return replace(
        fold,
        status=record.status,
        reason=record.reason,
        iterations=record.iterations[-1].number,
        updated=record.updated,
        held_out=held,
    )


@dataclass(frozen=True, slots=True)
class _NamedProgress(Progress):
    """Progress of one update among several: what it does now, under its name."""

    name: str
    tell: Callable[[str], None]

    def working(self, text: str) -> None:
        self.tell(f"{self.name}: {text}")
