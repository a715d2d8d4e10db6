"""Updating as a Prefect flow: every piece of an iteration is a task run, named for people.

Import this only after `server.use_server()`: Prefect reads its settings when it is imported.
What a piece gave travels beside Prefect, not through it; states tell what became of it: Cached
(the store had the result), Skipped (e2), Derived (no job was needed), Failed. Inside a flow run,
such as a scheduled one, the tasks are that run's; elsewhere a flow run is made for them.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from prefect import Task, flow, task
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State
from prefect.context import FlowRunContext
from prefect.events.clients import PrefectEventsClient
from prefect.events.worker import EventsWorker
from prefect.states import Completed, Failed
from prefect.task_runners import ThreadPoolTaskRunner

from modetune.core.errors import ModetuneError, SolverCrashed
from modetune.core.record import CampaignRecord
from modetune.flows.execution.engine import JobEngine
from modetune.flows.execution.work import Done, Work, solve_work
from modetune.flows.server.artifacts import ArtifactPost
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
    """Pieces of work as task runs of the flow around it, so many side by side."""

    engine: JobEngine
    parallel: int

    def run(self, iteration: str, work: Sequence[Work]) -> list[Done]:
        pieces = [Piece(self.engine, item) for item in work]
        try:
            self._tasks(iteration, [(solve, piece.work.name, {"piece": piece}) for piece in pieces])
        except BaseException:
            self.engine.cancelled.set()
            raise
        return [_outcome(piece) for piece in pieces]

    def skip(self, iteration: str, names: Sequence[str], reason: str) -> None:
        self._tasks(iteration, [(skip, name, {"reason": reason}) for name in names])

    def _tasks(
        self, iteration: str, asked: Sequence[tuple[Task[..., Any], str, dict[str, Any]]]
    ) -> None:
        """Run tasks, each a function, its name for people and its arguments, to their end."""
        runner: ThreadPoolTaskRunner[Any] = ThreadPoolTaskRunner(max_workers=self.parallel)
        with runner:
            futures = [
                runner.submit(
                    function.with_options(
                        name=name.split()[0], task_run_name=f"{iteration} / {name}"
                    ),
                    arguments,
                )
                for function, name, arguments in asked
            ]
            try:
                for future in futures:
                    future.wait()
            except BaseException:
                self.engine.cancelled.set()  # before the runner waits for its threads
                raise


def _outcome(piece: Piece) -> Done:
    if piece.fault is not None:
        raise piece.fault
    if piece.done is None:
        raise SolverCrashed(f"Prefect did not run the task {piece.work.name}")
    return piece.done


def run_as_flow(updating: Updating, folder: Path) -> CampaignRecord:
    """Carry an updating campaign to its end as a flow run, or in the one around.

    folder: the run folder, for the pages. Raises what the campaign raises.
    """
    if FlowRunContext.get() is not None:
        return _run_shown(updating, folder)
    # A server that is gone must not hold the campaign's end up: ten attempts an event are 7 s.
    EventsWorker.set_client_override(PrefectEventsClient, reconnection_attempts=1)
    logging.getLogger("EventsWorker").setLevel(logging.CRITICAL)
    ended: list[CampaignRecord] = []

    @flow(
        name="update",
        flow_run_name=updating.campaign.name,
        persist_result=False,
        validate_parameters=False,
    )
    def update() -> State[Any]:
        ended.append(_run_shown(updating, folder))
        return ended_state(ended[0])

    try:
        update(return_state=True).result()
    except Exception as error:
        if not ended:
            raise
        # The campaign is complete; only its display could not be told.
        logger.warning("Prefect's server could not be told of the end: %s", error)
    return ended[0]


def ended_state(record: CampaignRecord) -> State[Any]:
    """The state of a flow run whose campaign ended so."""
    return Completed(name=record.status.replace("_", " ").capitalize(), message=record.reason)


def _run_shown(updating: Updating, folder: Path) -> CampaignRecord:
    """Run within the flow run around, with artifacts on its page."""
    context = FlowRunContext.get()
    assert context is not None
    assert context.flow_run is not None
    campaign = updating.campaign
    post = ArtifactPost(updating.progress, campaign.tolerances, campaign.name, context.flow_run.id)
    updating.progress = post
    try:
        record = updating.run()
        post.result(record, folder)
    finally:
        post.close()
    return record
