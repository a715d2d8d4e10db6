"""Runners on Prefect's engine: each task is a task run of the surrounding flow.

Prefect does not inspect the plain objects that the tasks get, and results stay in the store.
Dependencies only draw the edges of the graph; Prefect does not wait for them. Tasks read their
inputs from the store, so a failed sensitivity column stops no other.
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
from prefect.client.schemas.objects import RunInput, State, TaskRunResult
from prefect.client.schemas.objects import TaskRun as PrefectTaskRecord
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
    check_connection,
    cluster,
    connected,
    dask_result,
    end_runs,
    workers_apart,
)
from modetune.flows.jobs.runner import (
    Computation,
    Task,
    TaskResult,
    TaskRun,
    TaskState,
    retry,
    task_state,
)

logger = logging.getLogger(__name__)

#: For all tasks: the store keeps results, not Prefect.
OPTIONS: dict[str, Any] = {"cache_policy": NO_CACHE, "persist_result": False}


def retry_allowed(of: PrefectTask[..., Any], run: PrefectTaskRecord, state: State[Any]) -> bool:
    """Return whether a failed task may run again, according to its error.

    A function, because Prefect ignores methods here.
    """
    return bool(getattr(state.data, "again", False))


@task(**OPTIONS, retry_condition_fn=retry_allowed)
def solve(work: Task, after: object = None) -> State[Any]:
    """Attempt a task of solver work once; the state contains its result."""
    try:
        answer = work.attempt()
    except SolverCancelled as error:
        return Cancelled(message=str(error))
    end = task_state(answer.jobs)
    return Completed(name=end.name, message=end.message, data=answer)


@task(**OPTIONS)
def compute(work: Computation[Any], after: object = None) -> State[Any]:
    """Compute a solution, reduced model or step in the flow's process."""
    try:
        end = work.run()
    except SolverCancelled as error:
        return Cancelled(message=str(error))
    return Completed(name=end.name, message=end.message)


@task(**OPTIONS)
def note(end: TaskState, after: object = None) -> State[Any]:
    """Show a task that was skipped or not attempted."""
    made = Cancelled if end.kind == "CANCELLED" else Completed
    return made(name=end.name, message=end.message)


class PrefectTaskRun:
    """A task run of Prefect's engine; id: its identity, for edges of the graph."""

    def __init__(self, run: UUID, future: PrefectFuture[Any] | None, work: Task | None) -> None:
        self.id = run
        self._future = future
        self._work = work

    def done(self) -> bool:
        return self._future is None or self._future.wrapped_future.done()  # type: ignore[attr-defined]

    def wait(self, seconds: float) -> None:
        if self._future is not None:
            self._future.wait(seconds)

    def result(self) -> TaskResult:
        assert self._work is not None
        if self._future is None:
            return self._work.attempt()
        try:
            self._future.wait()
            state = self._future.state
            if state.is_cancelled():
                raise SolverCancelled(state.message or "the task was cancelled")
            answer = self._future.result()
        except ModetuneError:
            raise
        except Exception as error:
            # If Prefect's engine itself fails, solve the job without it.
            if self._work.fault is not None or not self._work.stays:
                raise
            logger.warning("Prefect did not run a task (%s: %s)", type(error).__name__, error)
            return retry(self._work.attempt)
        assert isinstance(answer, TaskResult)
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
    """Runs tasks on one of Prefect's task runners, computations in the calling thread."""

    remote = False

    def __init__(self, runner: TaskRunner[Any], parallel: int) -> None:
        self.parallel = parallel
        self._runner = runner
        self._lock = Lock()

    def submit(self, name: str, work: Task, after: Sequence[TaskRun]) -> TaskRun:
        of = solve.with_options(**_named(name), retries=work.tries - 1)
        with self._lock:  # parallel updates share the runner
            future = self._runner.submit(
                of, {"work": work, "after": None}, dependencies=_edges(after)
            )
        return self._run(future, work)

    def compute(self, name: str, work: Computation[Any], after: Sequence[TaskRun]) -> TaskRun:
        run = self._here(compute.with_options(**_named(name)), {"work": work}, after)
        if not work.has_run:
            work.run()
        return run

    def note(self, name: str, end: TaskState, after: Sequence[TaskRun]) -> None:
        self._here(note.with_options(**_named(name)), {"end": end}, after)

    def _run(self, future: PrefectFuture[Any], work: Task) -> TaskRun:
        return PrefectTaskRun(future.task_run_id, future, work)

    def _here(
        self,
        of: PrefectTask[..., Any],
        parameters: dict[str, Any],
        after: Sequence[TaskRun],
        work: Task | None = None,
    ) -> PrefectTaskRun:
        run = uuid4()
        run_task_sync(
            of,
            task_run_id=run,
            parameters={**parameters, "after": None},
            return_type="state",
            dependencies=_edges(after),
        )
        return PrefectTaskRun(run, None, work)


class PrefectDaskRun(PrefectTaskRun):
    """A task run on a Dask cluster."""

    def __init__(self, run: UUID, future: PrefectFuture[Any], work: Task) -> None:
        super().__init__(run, future, work)
        self._dask = future.wrapped_future  # type: ignore[attr-defined]

    def result(self) -> TaskResult:
        return dask_result(super().result, self._dask)


class PrefectDaskRunner(PrefectRunner):
    """Runs tasks on Prefect's Dask runner, in the processes of its workers."""

    remote = True

    def __init__(self, runner: TaskRunner[Any], parallel: int) -> None:
        super().__init__(runner, parallel)
        self.runs: set[str] = set()

    def submit(self, name: str, work: Task, after: Sequence[TaskRun]) -> TaskRun:
        if work.stays:
            end = {"end": task_state(work.attempt().jobs)}
            return self._here(note.with_options(**_named(name)), end, after, work)
        if work.order is not None:
            self.runs.add(work.order.run)
        check_connection(self._runner.client)  # type: ignore[attr-defined]
        return super().submit(name, work, after)

    def _run(self, future: PrefectFuture[Any], work: Task) -> TaskRun:
        return PrefectDaskRun(future.task_run_id, future, work)


def bounded_events(url: str) -> None:
    """Drop events of this process that the server does not accept at once."""
    EventsWorker.set_client_override(PrefectEventsClient, api_url=url, reconnection_attempts=0)


@contextmanager
def task_runner(runner: TaskRunner[Any], parallel: int) -> Iterator[PrefectRunner]:
    """Open a runner on one of Prefect's task runners."""
    with runner:
        here = isinstance(runner, ThreadPoolTaskRunner)
        yield (PrefectRunner if here else PrefectDaskRunner)(runner, parallel)


@contextmanager
def dask_task_runner(
    section: DaskSection, threads: int, parallel: int
) -> Iterator[PrefectDaskRunner | DaskRunner]:
    """Open a runner on a campaign's Dask cluster. Raises CampaignError.

    If some workers cannot reach Prefect's server, all work runs on the cluster without Prefect.
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
                    "%d Dask workers cannot reach Prefect's server at %s (%s) and run without "
                    "Prefect; set PREFECT_API_URL to an address they can reach",
                    len(apart), url, ", ".join(apart[:3])
                )  # fmt: skip
                found = DaskRunner(client, parallel)
            client.register_plugin(_worker_plugin(url))
            try:
                yield found
            finally:
                end_runs(client, sorted(found.runs))


def _worker_plugin(url: str) -> Any:
    """Create a plugin of Dask workers that drops events a server does not accept at once and keeps
    Prefect's log out of the terminal unless the user set its level."""
    from distributed import WorkerPlugin

    class PrefectWorker(WorkerPlugin):
        name = "modetune-prefect"

        def setup(self, worker: Any) -> None:
            bounded_events(url)
            if "PREFECT_LOGGING_LEVEL" not in os.environ:
                logging.getLogger("prefect").setLevel(logging.CRITICAL)

    return PrefectWorker()


def _named(name: str) -> dict[str, Any]:
    """Options that name a task by its kind and its run by its full name."""
    kind = name.rpartition(" / ")[2].split()[0]

    def run_name() -> str:  # Prefect treats a string as a template
        return name

    return {"name": kind, "task_run_name": run_name}


def _edges(after: Sequence[TaskRun]) -> dict[str, set[RunInput]]:
    """The predecessors of a task as dependencies of its parameter `after`."""
    runs = (item.id for item in after if isinstance(item, PrefectTaskRun))
    return {"after": {TaskRunResult(id=run) for run in runs}}
