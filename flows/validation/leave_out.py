"""Does an updated model hold on what it was not updated with?

Leave-one-out cross-validation: as many updates as there are used modes, each without one of them
and judged on it. The updates share a store and differ little at first, so most of what they ask
for is there already. That the parameters of all these updates agree is a second sign of a sound
answer; where they scatter, single modes decide it.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from modetune.core.errors import CampaignError, ModesError, SolverError
from modetune.core.held_out import HeldOut, join_held_out, together
from modetune.core.modes import Floats
from modetune.core.numbering import CONFIGURATION, mode_name
from modetune.core.record import CampaignRecord, IterationRecord, RunCounts
from modetune.core.store import check_writable
from modetune.flows.campaign import Campaign, joined
from modetune.flows.evaluator import CAMPAIGNS_OWN
from modetune.flows.evaluators import evaluator_of
from modetune.flows.execution.engine import JobEngine
from modetune.flows.execution.work import ThreadExecution
from modetune.flows.running import solving_engine
from modetune.flows.schema import STORE_REMEDY
from modetune.flows.updating import Updating

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Fold:
    """An update and what was held out of it.

    number: of the mode that was left out, 0 where it is what the campaign itself holds out;
    updated: (n_parameters,), NaN where the update failed; held_out: None then.
    """

    number: int
    status: str
    reason: str
    iterations: int
    updated: Floats
    held_out: HeldOut | None


@dataclass(frozen=True, slots=True)
class Validation:
    """What was held out, before and after; runs: what all updates took."""

    name: str
    parameters: tuple[str, ...]
    configurations: tuple[str, ...]
    folds: tuple[Fold, ...]
    runs: RunCounts
    wall_s: float

    @property
    def held_out(self) -> HeldOut | None:
        """What was held out of all updates that came to an end."""
        return join_held_out([fold.held_out for fold in self.folds if fold.held_out is not None])

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


def leave_out(campaign: Campaign, number: int) -> Campaign:
    """The campaign without one of its used modes, which is held out instead.

    What it holds out by itself stays so. Of several configurations the one is left out whole
    whose only used mode it is. Raises CampaignError where nothing would be left.
    """
    if campaign.configurations:
        return _leave_out_joint(campaign, number)
    rest = tuple(other for other in campaign.test.numbers if other != number)
    if not rest:
        raise CampaignError(
            f"{campaign.file}: mode {number} is the only one that is used, so it cannot be left "
            "out; leave-one-out needs two used modes or more"
        )
    left = campaign.test.use((number,))
    held = left if campaign.held_out is None else together(left, campaign.held_out)
    return replace(campaign, test=campaign.test.use(rest), held_out=held)


def _leave_out_joint(campaign: Campaign, number: int) -> Campaign:
    place, own = divmod(number, CONFIGURATION)
    used = [item for item in campaign.configurations if not item.hold_out]
    changed = []
    for item in campaign.configurations:
        if item.place == place and len(item.campaign.test.numbers) > 1:
            item = replace(item, campaign=leave_out(item.campaign, own))
        elif item.place == place:
            if len(used) == 1:
                leave_out(item.campaign, own)  # raises, in its words
            item = replace(item, hold_out=True)
        changed.append(item)
    return replace(joined(tuple(changed), campaign.parameters), name=campaign.name)


def leave_one_out(campaign: Campaign, working: Callable[[str], None]) -> Validation:
    """Update without each used mode in turn and judge it by that mode.

    The updates go side by side as far as the campaign's engine lets their jobs. One that fails is
    told of and keeps the others from nothing. working: hears what is being done.
    Raises CampaignError, SolverMissing, LicenceDenied, StoreError.
    """
    numbers = campaign.test.numbers
    campaigns = [leave_out(campaign, number) for number in numbers]
    return _validated(campaign, numbers, campaigns, working)


def validate(campaign: Campaign, working: Callable[[str], None]) -> Validation:
    """Update and judge by what the campaign itself holds out.

    Raises CampaignError where it holds out nothing; SolverError, ModesError, StoreError.
    """
    aside = [item for item in campaign.configurations
             if item.hold_out or item.campaign.held_out is not None]  # fmt: skip
    if campaign.held_out is None and not aside:
        raise CampaignError(
            f"{campaign.file} holds out nothing to judge by: name modes with `test.hold_out`, or "
            "leave each mode out in turn with --leave-one-out"
        )
    return _validated(campaign, (0,), [campaign], working)


def _validated(
    campaign: Campaign,
    numbers: Sequence[int],
    campaigns: Sequence[Campaign],
    working: Callable[[str], None],
) -> Validation:
    started = time.monotonic()
    campaign.solver.version()  # a missing solver is told before anything else starts
    check_writable(campaign.store.folder, STORE_REMEDY)
    names = tuple(item.name for item in campaign.configurations)
    with solving_engine(campaign) as engine:
        workers = min(len(campaigns), campaign.parallel)
        with ThreadPoolExecutor(workers, thread_name_prefix="modetune-fold") as pool:
            futures = []
            for number, one in zip(numbers, campaigns, strict=True):
                said = f"without {mode_name(names, number)}" if number else "updating"
                futures.append(pool.submit(_fold, number, one, engine, said, working))
            try:
                done = [future.result() for future in futures]
            except BaseException:
                engine.cancelled.set()
                for future in futures:
                    future.cancel()
                raise
        runs = RunCounts()
        for _, counted in done:
            runs = runs.plus(replace(counted, core_s=0.0, licence_s=0.0))
        runs = replace(runs, core_s=engine.ledger.core_s, licence_s=engine.ledger.licence_s)
    return Validation(
        campaign.name, campaign.parameters.names, names, tuple(fold for fold, _ in done), runs,
        time.monotonic() - started,
    )  # fmt: skip


def _fold(
    number: int, campaign: Campaign, engine: JobEngine, said: str, working: Callable[[str], None]
) -> tuple[Fold, RunCounts]:
    """One update. Where it fails, the reason stands in place of its end."""
    evaluator = evaluator_of(campaign, engine, ThreadExecution(engine, campaign.parallel))
    updating = Updating(campaign, evaluator, _Told(said, working), lambda record: None)
    try:
        record = updating.run()
    except (SolverError, ModesError) as error:
        if isinstance(error, CAMPAIGNS_OWN) or number == 0:
            raise
        logger.warning("%s: %s", said, error)
        unknown = np.full(len(campaign.parameters), np.nan)
        fold = Fold(
            number, "failed", str(error), max(len(updating.iterations) - 1, 0), unknown, None
        )
        return fold, evaluator.runs
    return _judged(number, record), record.runs


def _judged(number: int, record: CampaignRecord) -> Fold:
    held = record.held_out
    assert held is not None
    return Fold(
        number, record.status, record.reason, record.iterations[-1].number, record.updated,
        held if number == 0 else held.only(held.numbers == number),
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Told:
    """Progress of one update among several: what it does now, under its name."""

    name: str
    tell: Callable[[str], None]

    def working(self, text: str) -> None:
        self.tell(f"{self.name}: {text}")

    def iteration(self, record: IterationRecord) -> None:
        pass
