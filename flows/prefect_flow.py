"""Updating as a Prefect flow: every piece of an iteration is a task run, named for people.

Import this only after `server.use_server()`: Prefect reads its settings when it is imported.
What a piece gave travels beside Prefect, not through it; states tell what became of it: Cached
(the store had the result), Skipped (e2), Derived (no job was needed), Failed.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from prefect import flow, task
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State
from prefect.states import Completed, Failed
from prefect.task_runners import ThreadPoolTaskRunner

from modetune.core.errors import ModetuneError, SolverCrashed
from modetune.core.record import CampaignRecord
from modetune.flows.engine import JobEngine
from modetune.flows.execution import Done, Work, solve_work
from modetune.flows.updating import Updating

logger = logging.getLogger(__name__)


class Piece:
    """A piece of work on its way through a task, and what became of it.

    A plain object: Prefect looks into collections and dataclasses that it is given.
    """

    def __init__(self, engine: JobEngine, work: Work) -> None:
        self.engine = engine
        self.work = work
        self.done: Done | None = None
        self.fault: BaseException | None = None


@task(cache_policy=NO_CACHE, persist_result=False)
def solve(piece: Piece) -> State[Any]:
    """Solve one piece of an iteration."""
    try:
        piece.done = solve_work(piece.engine, piece.work)
    except BaseException as fault:
        piece.fault = fault  # raised where the loop waits
        raise
    if isinstance(piece.done, ModetuneError):
        return Failed(message=str(piece.done))
    if not piece.done:
        return Completed(name="Derived", message="follows from the modal job")
    keys = ", ".join(outcome.key[:12] for outcome in piece.done)
    if all(outcome.reused for outcome in piece.done):
        return Completed(name="Cached", message=keys)
    return Completed(message=f"{keys} in {sum(item.wall_s for item in piece.done):.1f} s")


@task(cache_policy=NO_CACHE, persist_result=False)
def skip(reason: str) -> State[Any]:
    """A sensitivity that e2 made unnecessary."""
    return Completed(name="Skipped", message=reason)


@dataclass(frozen=True, slots=True)
class PrefectExecution:
    """Pieces of work as task runs of the flow around it."""

    engine: JobEngine

    def run(self, iteration: str, work: Sequence[Work]) -> list[Done]:
        pieces = [Piece(self.engine, item) for item in work]
        futures = [
            solve.with_options(
                name=piece.work.name.split()[0], task_run_name=f"{iteration} / {piece.work.name}"
            ).submit(piece)
            for piece in pieces
        ]
        try:
            for future in futures:
                future.wait()
        except BaseException:
            self.engine.cancelled.set()
            raise
        return [_outcome(piece) for piece in pieces]

    def skip(self, iteration: str, names: Sequence[str], reason: str) -> None:
        futures = [
            skip.with_options(name=name.split()[0], task_run_name=f"{iteration} / {name}").submit(
                reason
            )
            for name in names
        ]
        for future in futures:
            future.wait()


def _outcome(piece: Piece) -> Done:
    if piece.fault is not None:
        raise piece.fault
    if piece.done is None:
        raise SolverCrashed(f"Prefect did not run the task {piece.work.name}")
    return piece.done


def run_as_flow(updating: Updating, parallel: int) -> CampaignRecord:
    """Carry an updating campaign to its end as a flow run. Raises what the campaign raises."""
    ended: list[CampaignRecord] = []

    runner: ThreadPoolTaskRunner[Any] = ThreadPoolTaskRunner(max_workers=parallel)

    @flow(
        name="update",
        flow_run_name=updating.campaign.name,
        task_runner=runner,  # type: ignore[arg-type]  # its futures are PrefectFuture by contract
        persist_result=False,
        validate_parameters=False,
    )
    def update() -> State[Any]:
        record = updating.run()
        ended.append(record)
        return Completed(name=record.status.replace("_", " ").capitalize(), message=record.reason)

    try:
        update(return_state=True).result()
    except Exception as error:
        if not ended:
            raise
        # The campaign is complete; only its display could not be told.
        logger.warning("Prefect's server could not be told of the end: %s", error)
    return ended[0]
