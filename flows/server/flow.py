"""An update as a Prefect flow, for pipelines of one's own.

    from modetune.flows.server.flow import update_flow

    @flow
    def nightly():
        update_flow("wing/campaign.yaml")

Every modal job, every sensitivity and every skip is a task of Prefect's own engine, with a name for
people, and ends in the state that tells what became of it: Completed, Cached (the store had the
result), Derived (no job was needed), Skipped (by e2), Failed. Keys and states go through Prefect,
results through the store. The flow depends on a server as every Prefect flow does; `modetune
update` does not, and shows the same on the pages of a server that is there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from prefect import Task, flow, task
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State
from prefect.states import Cancelled, Completed, Failed
from prefect.task_runners import ThreadPoolTaskRunner

from modetune.core.errors import ModetuneError, SolverCrashed
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.jobs.engine import JobEngine
from modetune.flows.jobs.work import Done, Work, solve_work
from modetune.flows.updating.prefect import became
from modetune.flows.updating.recording import summary
from modetune.flows.updating.starts import update_from_starts
from modetune.flows.updating.updating import Unwatched


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
    kind, name, message = became(piece.done)
    made = {"FAILED": Failed, "CANCELLED": Cancelled}.get(kind, Completed)
    return made(name=name, message=message)


@task(cache_policy=NO_CACHE, persist_result=False)
def skip(reason: str, state: str) -> State[Any]:
    """A piece that was not needed, or not tried."""
    made = Cancelled if state == "Not tried" else Completed
    return made(name=state, message=reason)


@dataclass(frozen=True, slots=True)
class TaskExecution:
    """Pieces of work as task runs of the flow around it, so many side by side."""

    engine: JobEngine
    parallel: int

    def run(self, iteration: str, work: Sequence[Work]) -> list[Done]:
        pieces = [Piece(self.engine, item) for item in work]
        self._tasks(iteration, [(solve, piece.work.name, {"piece": piece}) for piece in pieces])
        return [_outcome(piece) for piece in pieces]

    def skip(
        self, iteration: str, names: Sequence[str], reason: str, state: str = "Skipped"
    ) -> None:
        told = {"reason": reason, "state": state}
        self._tasks(iteration, [(skip, name, told) for name in names])

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


@flow(name="update", flow_run_name="{campaign}", persist_result=False)
def update_flow(campaign: str, settings: list[str] | None = None, runs: str = "runs") -> State[Any]:
    """Update a campaign's model; its state has the campaign's status, its result the summary.

    campaign: path of its file; settings: KEY.KEY=VALUE over it; runs: where run folders go.
    """
    try:
        loaded = load_campaign(Path(campaign), settings or [])
        folder = Path(runs) / loaded.name
        run = update_from_starts(loaded, folder, Unwatched(), executes=TaskExecution)
    except ModetuneError as error:
        return Failed(message=str(error))
    name = run.record.status.replace("_", " ").capitalize()
    return Completed(name=name, message=run.record.reason, data=summary(run.record, folder))
