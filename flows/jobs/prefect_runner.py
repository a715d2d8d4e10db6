"""Runners on Prefect's engine: every piece of work is a task run of the flow around it.

Tasks get plain objects (a piece, a computation), which Prefect does not look into; results stay in
the store. The edges of a run's graph are given as dependencies, which Prefect draws and does not
wait for: what a task needs it takes from the store, so a failed column stops no other.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from threading import Lock
from typing import Any
from uuid import UUID, uuid4

from prefect import Task as PrefectTask
from prefect import task
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import RunInput, State, TaskRun, TaskRunResult
from prefect.context import get_settings_context
from prefect.events.clients import PrefectEventsClient
from prefect.events.worker import EventsWorker
from prefect.futures import PrefectFuture
from prefect.states import Cancelled, Completed
from prefect.task_engine import run_task_sync
from prefect.task_runners import TaskRunner, ThreadPoolTaskRunner

from modetune.core.errors import ModetuneError, SolverCancelled
from modetune.flows.campaign.site import DaskSection
from modetune.flows.jobs.dask_cluster import (
    CONNECT_S,
    DaskRunner,
    cluster,
    connected,
    dask_result,
    end_runs,
    workers_apart,
)
from modetune.flows.jobs.work import Answer, Computation, Piece, Task, TaskEnd, task_end, tried

logger = logging.getLogger(__name__)

#: Of all our tasks: results are the store's, not Prefect's.
OPTIONS: dict[str, Any] = {"cache_policy": NO_CACHE, "persist_result": False}


def may_be_tried_again(of: PrefectTask[..., Any], run: TaskRun, state: State[Any]) -> bool:
    """Whether a failed task runs once more: its error says so.

    A plain function: Prefect ignores methods here.
    """
    return bool(getattr(state.data, "again", False))


@task(**OPTIONS, retry_condition_fn=may_be_tried_again)
def solve(piece: Piece, after: object = None) -> State[Any]:
    """One try of a piece of solver work; its state has the answer."""
    try:
        answer = piece.attempt()
    except SolverCancelled as error:
        return Cancelled(message=str(error))
    end = task_end(answer.jobs)
    return Completed(name=end.name, message=end.message, data=answer)


@task(**OPTIONS)
def compute(work: Computation[Any], after: object = None) -> State[Any]:
    """A solution, a reduced model or a step, computed in the flow's process."""
    try:
        end = work.run()
    except SolverCancelled as error:
        return Cancelled(message=str(error))
    return Completed(name=end.name, message=end.message)


@task(**OPTIONS)
def note(end: TaskEnd, after: object = None) -> State[Any]:
    """A piece of work that did not have to run, or was not tried."""
    made = Cancelled if end.kind == "CANCELLED" else Completed
    return made(name=end.name, message=end.message)


class PrefectTaskRun:
    """A task run of Prefect's engine; id: its identity, for edges of the graph."""

    def __init__(self, run: UUID, future: PrefectFuture[Any] | None, piece: Piece | None) -> None:
        self.id = run
        self._future = future
        self._piece = piece

    def done(self) -> bool:
        return self._future is None or self._future.wrapped_future.done()  # type: ignore[attr-defined]

    def wait(self, seconds: float) -> None:
        if self._future is not None:
            self._future.wait(seconds)

    def result(self) -> Answer:
        assert self._piece is not None
        if self._future is None:
            return self._piece.attempt()
        try:
            self._future.wait()
            state = self._future.state
            if state.is_cancelled():
                raise SolverCancelled(state.message or "the task was cancelled")
            answer = self._future.result()
        except ModetuneError:
            raise
        except Exception as error:
            # What Prefect's engine itself stumbles over keeps no job from being solved.
            if self._piece.fault is not None or not self._piece.stays:
                raise
            logger.warning("Prefect did not run a task (%s: %s)", type(error).__name__, error)
            return tried(self._piece.attempt)
        assert isinstance(answer, Answer)
        return answer

    def cancel(self) -> None:
        if self._future is not None:
            self._future.wrapped_future.cancel()  # type: ignore[attr-defined]

    def on_end(self, call: Callable[[], None]) -> None:
        if self._future is None:
            call()
        else:
            self._future.add_done_callback(lambda _: call())


class PrefectRunner:
    """Pieces on one of Prefect's task runners, computations in the thread that asks for them."""

    remote = False

    def __init__(self, runner: TaskRunner[Any], parallel: int) -> None:
        self.parallel = parallel
        self._runner = runner
        self._lock = Lock()

    def submit(self, name: str, piece: Piece, after: Sequence[Task]) -> Task:
        of = solve.with_options(**_named(name), retries=piece.tries - 1)
        with self._lock:  # updates in parallel share the runner
            future = self._runner.submit(
                of, {"piece": piece, "after": None}, dependencies=_edges(after)
            )
        return self._run(future, piece)

    def compute(self, name: str, work: Computation[Any], after: Sequence[Task]) -> Task:
        run = self._here(compute.with_options(**_named(name)), {"work": work}, after)
        if not work.has_run:
            work.run()
        return run

    def note(self, name: str, end: TaskEnd, after: Sequence[Task]) -> None:
        self._here(note.with_options(**_named(name)), {"end": end}, after)

    def _run(self, future: PrefectFuture[Any], piece: Piece) -> Task:
        return PrefectTaskRun(future.task_run_id, future, piece)

    def _here(
        self,
        of: PrefectTask[..., Any],
        parameters: dict[str, Any],
        after: Sequence[Task],
        piece: Piece | None = None,
    ) -> PrefectTaskRun:
        run = uuid4()
        run_task_sync(
            of,
            task_run_id=run,
            parameters={**parameters, "after": None},
            return_type="state",
            dependencies=_edges(after),
        )
        return PrefectTaskRun(run, None, piece)


class DaskTaskRun(PrefectTaskRun):
    """A task run on a Dask cluster."""

    def __init__(self, run: UUID, future: PrefectFuture[Any], piece: Piece) -> None:
        super().__init__(run, future, piece)
        self._dask = future.wrapped_future  # type: ignore[attr-defined]

    def result(self) -> Answer:
        return dask_result(super().result, self._dask)


class PrefectDaskRunner(PrefectRunner):
    """Pieces on Prefect's Dask runner, in the processes of its workers."""

    remote = True

    def __init__(self, runner: TaskRunner[Any], parallel: int) -> None:
        super().__init__(runner, parallel)
        self.runs: set[str] = set()

    def submit(self, name: str, piece: Piece, after: Sequence[Task]) -> Task:
        if piece.stays:
            end = {"end": task_end(piece.attempt().jobs)}
            return self._here(note.with_options(**_named(name)), end, after, piece)
        if piece.order is not None:
            self.runs.add(piece.order.run)
        return super().submit(name, piece, after)

    def _run(self, future: PrefectFuture[Any], piece: Piece) -> Task:
        return DaskTaskRun(future.task_run_id, future, piece)


def bounded_events(url: str) -> None:
    """From now on this process drops events that the server does not take at once."""
    EventsWorker.set_client_override(PrefectEventsClient, api_url=url, reconnection_attempts=0)


@contextmanager
def task_runner(runner: TaskRunner[Any], parallel: int) -> Iterator[PrefectRunner]:
    """A runner on one of Prefect's task runners, for as long as this lasts."""
    with runner:
        here = isinstance(runner, ThreadPoolTaskRunner)
        yield (PrefectRunner if here else PrefectDaskRunner)(runner, parallel)


@contextmanager
def dask_task_runner(
    section: DaskSection, threads: int, parallel: int
) -> Iterator[PrefectDaskRunner | DaskRunner]:
    """A runner on the cluster that a campaign asks for. Raises CampaignError.

    Where workers do not reach Prefect's server, they get the same work without Prefect.
    """
    with cluster(section, threads) as own:
        from prefect_dask.task_runners import DaskTaskRunner

        place = {"address": own} if isinstance(own, str) else {"cluster": own}
        made = DaskTaskRunner(**place, client_kwargs={"timeout": CONNECT_S})
        with made as runner:
            client = connected(lambda: runner.client, section)
            url = str(get_settings_context().settings.api.url)
            found: PrefectDaskRunner | DaskRunner = PrefectDaskRunner(runner, parallel)
            if apart := workers_apart(client, url):
                logger.warning(
                    "%d Dask workers do not reach Prefect's server at %s (%s): they solve without "
                    "Prefect; set PREFECT_API_URL to an address that they reach",
                    len(apart), url, ", ".join(apart[:3])
                )  # fmt: skip
                found = DaskRunner(client, parallel)
            client.register_plugin(_worker_plugin(url))
            try:
                yield found
            finally:
                end_runs(client, sorted(found.runs))


def _worker_plugin(url: str) -> Any:
    """A plugin of Dask workers: events that a server does not take are dropped at once, and
    Prefect's log stays out of the terminal unless the user set its level."""
    from distributed import WorkerPlugin

    class PrefectWorker(WorkerPlugin):
        name = "modetune-prefect"

        def setup(self, worker: Any) -> None:
            bounded_events(url)
            if "PREFECT_LOGGING_LEVEL" not in os.environ:
                logging.getLogger("prefect").setLevel(logging.CRITICAL)

    return PrefectWorker()


def _named(name: str) -> dict[str, Any]:
    """Options that name a task by its kind, and its run as people see it."""
    kind = name.rpartition(" / ")[2].split()[0]

    def run_name() -> str:  # a text would be taken for a template
        return name

    return {"name": kind, "task_run_name": run_name}


def _edges(after: Sequence[Task]) -> dict[str, set[RunInput]]:
    """Task runs that a task follows from, as dependencies of its parameter `after`."""
    runs = (item.id for item in after if isinstance(item, PrefectTaskRun))
    return {"after": {TaskRunResult(id=run) for run in runs}}
