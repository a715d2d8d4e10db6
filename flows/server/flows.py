"""The studies as Prefect flows: each study's definition gives the parameters and the work.

The command, the Python verb, a deployment and a pipeline of the user's own run the same flow, which
is importable under the study's name:

    from modetune.flows.server.flows import update

    @flow
    def nightly():
        state = update("wing/campaign.yaml", return_state=True)

Its state has the study's status as name, and the study's JSON object as result.
"""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import httpx
from prefect import Flow, tags
from prefect.client.orchestration import get_client
from prefect.client.schemas.objects import FlowRun, State
from prefect.context import FlowRunContext, get_settings_context
from prefect.exceptions import Abort, PrefectException, TerminationSignal
from prefect.flow_engine import run_flow
from prefect.states import Cancelled, Completed, Crashed, Failed, Pending
from prefect.task_runners import TaskRunner, ThreadPoolTaskRunner

from modetune.core.errors import CampaignRunning, ModetuneError, SolverCancelled
from modetune.flows.campaign.campaign import Campaign, cores
from modetune.flows.jobs.heartbeats import TAG
from modetune.flows.jobs.prefect_runner import dask_task_runner, task_runner
from modetune.flows.jobs.prefect_server import SharedServer, configured_server
from modetune.flows.jobs.run_log import logged_to
from modetune.flows.jobs.runner import Runner
from modetune.flows.jobs.server_client import ServerClient
from modetune.flows.jobs.tasks import StudyRun, study_run, use_run
from modetune.flows.server.artifacts import (
    change_event,
    files_artifact,
    result_artifacts,
    table_artifact,
)
from modetune.flows.server.run_page import PageLog, PageProgress, RunPage
from modetune.flows.studies.catalogue import STUDIES, find_study, shell_command
from modetune.flows.studies.result import StudyResult
from modetune.flows.studies.study import Study, StudyContext
from modetune.flows.updating.forecast import Progress, Unwatched
from modetune.flows.updating.record import CampaignRun

#: Names of the flows.
FLOWS = STUDIES
#: How often a flow inside another one is begun on a busy server, and the seconds in between.
BEGINS, PAUSE_S = 3, 1.0


@dataclass
class Handed:
    """What the caller in this process hands to the body of a flow, and the outcome of the body.

    opened: the campaign, loaded already. own_process: whether the process is the run's alone.
    scheduled: whether a server started the study that this one is part of.
    state: that the run ends in, whether or not the server receives it. lost: whether the server
    was gone when the body ended. interrupted: whether a signal ended the study, and not its page.
    """

    progress: Progress
    opened: StudyContext | None = None
    own_process: bool = False
    scheduled: bool = False
    began: bool = False
    end: StudyResult | None = None
    error: BaseException | None = None
    state: State[Any] | None = None
    lost: bool = False
    interrupted: bool = False

    def outcome(self) -> StudyResult:
        """The end of the study. Raises what ended it."""
        if self.error is not None:
            raise self.error
        assert self.end is not None
        return self.end


_handed: ContextVar[Handed | None] = ContextVar("handed", default=None)


@contextmanager
def handing(handed: Handed | None) -> Iterator[None]:
    """The next flow that runs in here gets this."""
    token = _handed.set(handed)
    try:
        yield
    finally:
        _handed.reset(token)


def find_flow(name: str) -> Flow[..., Any]:
    """The flow of a study. Raises CampaignError where there is none of this name."""
    return _flow_of(find_study(name))


def run_as_flow(
    study: str, parameters: Mapping[str, Any], name: str, server: SharedServer, handed: Handed
) -> None:
    """Run a study as a flow of this process; the outcome is in what was handed to it.

    parameters: as JSON. name: of the run. A server that refuses the run before it begins, or that
    is gone at its end, is no error.
    """
    flow = find_flow(study)
    with suppress(Exception, Abort):  # the study's own errors are in the outcome
        with get_client(sync_client=True) as client:
            made = client.create_flow_run(
                flow,
                name=name,
                parameters=dict(parameters),
                tags=[TAG],
                state=Pending(),
            )
        handed.progress.page(f"{server.pages}/runs/flow-run/{made.id}{server.entrance}")
        run_flow(flow, flow_run=made, parameters=dict(parameters), return_type="state")


def run_inside(name: str, parameters: Mapping[str, Any], handed: Handed) -> StudyResult:
    """Run a study as a subflow of the flow that calls this.

    Raises the errors of the study, and those of a server that refuses it before it begins.
    """
    try:
        with handing(handed):
            find_flow(name)(**parameters, return_state=True)
    except (Exception, Abort):  # the study's own errors are in the outcome
        if not handed.began:
            raise
    return handed.outcome()


def __getattr__(name: str) -> Flow[..., Any]:
    if name not in FLOWS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return find_flow(name)


#: The task runner of the flow that calls one of ours.
_around: ContextVar[TaskRunner[Any] | None] = ContextVar("around", default=None)


class StudyFlow(Flow[..., Any]):
    """The flow of a study; inside another flow it runs on that one's task runner.

    Raises KeyboardInterrupt where Ctrl-C or SIGTERM ended the study.
    """

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel to Dask workers by name, as part of the context of a task."""
        return find_flow, (self.name,)

    def __call__(self, *given: Any, **named: Any) -> Any:
        context = FlowRunContext.get()
        token = _around.set(None if context is None else context.task_runner)
        paths = [str(value) if isinstance(value, Path) else value for value in given]
        options = {
            key: str(value) if isinstance(value, Path) else value for key, value in named.items()
        }
        handed = _handed.get() or Handed(Unwatched())
        try:
            with handing(handed), tags(TAG):  # so that it is marked as crashed when it dies
                return super().__call__(*paths, **options)
        finally:
            _around.reset(token)
            if handed.interrupted:  # the flow that calls this one ends too
                raise KeyboardInterrupt


@cache
def _flow_of(study: Study) -> Flow[..., Any]:
    signature = inspect.Signature(study.parameters)

    def body(*given: Any, **named: Any) -> State[Any]:
        bound = signature.bind(*given, **named)
        bound.apply_defaults()
        handed = _handed.get() or Handed(Unwatched())
        with handing(None):  # a flow inside this one gets its own
            return _body(study, study.checked(bound.arguments), handed)

    body.__name__ = body.__qualname__ = study.name
    body.__module__, body.__doc__ = __name__, _documented(study)
    body.__signature__ = signature  # type: ignore[attr-defined]
    body.__annotations__ = {item.name: item.annotation for item in study.parameters}
    return StudyFlow(body, name=study.name, persist_result=False, log_prints=False)


def _documented(study: Study) -> str:
    """What a flow does, and its parameters in the form in which Prefect's pages look for help."""
    lines = [f"    {item.name}: {item.info.help}" for item in study.fields]
    return "\n".join([study.help, "", "Args:", *lines])


def _body(study: Study, parameters: Mapping[str, Any], handed: Handed) -> State[Any]:
    """Run a study inside its flow run, and return the state that the run ends in."""
    handed.began = True
    context = FlowRunContext.get()
    assert context is not None
    assert context.flow_run is not None
    runs: list[StudyRun] = []

    def cancel() -> None:
        for run in runs:
            run.cancel()

    page = RunPage(_client(), context.flow_run.id, cancel, handed.own_process)
    try:
        with logged_to([PageLog(page)], lambda: runs[0] if runs else None):
            state = _carried(study, parameters, handed, runs, page, context.flow_run)
    except (KeyboardInterrupt, TerminationSignal) as error:
        cancel()
        handed.error = KeyboardInterrupt()
        handed.error.__cause__ = error
        handed.interrupted = not page.cancelled
        where = "stopped by the user" if handed.interrupted else "cancelled on its page"
        state = Cancelled(message=where)
    except SolverCancelled as error:
        handed.error = error
        state = Cancelled(message=str(error))
    except CampaignRunning as error:
        handed.error = error
        state = Completed(name="Already running", message=str(error))
    except ModetuneError as error:
        handed.error = error
        state = Failed(message=str(error))
    except Exception as error:
        handed.error = error
        state = Crashed(message=f"{type(error).__name__}: {error}")
    handed.state = state
    handed.lost = not page.finish()
    if handed.lost:
        raise Abort("the server does not answer")
    return state


def _carried(
    study: Study,
    parameters: Mapping[str, Any],
    handed: Handed,
    runs: list[StudyRun],
    page: RunPage,
    flow_run: FlowRun,
) -> State[Any]:
    progress = PageProgress(handed.progress, page)
    with ExitStack() as stack:
        if handed.opened is None:
            opened = stack.enter_context(study.opened(parameters, progress))
        else:
            opened = handed.opened
        if flow_run.name != opened.name:
            _rename(flow_run, opened.name)
        if flow_run.deployment_id is None:  # the pages have no button for such a run
            page.log(f"to repeat this run: {shell_command(study, parameters)}")
            page.log(f"to cancel this run: prefect flow-run cancel {flow_run.id}")
        scheduled = handed.scheduled or flow_run.deployment_id is not None

        def run_study(name: str, given: Mapping[str, Any], watcher: Progress) -> StudyResult:
            inner, refusal = find_study(name), ""
            checked = inner.checked(given)
            for _ in range(BEGINS):  # the server of several flows may be busy
                try:
                    return run_inside(name, checked, Handed(watcher, scheduled=scheduled))
                except (PrefectException, httpx.HTTPError, Abort) as error:
                    refusal = f"{type(error).__name__}: {error}"
                    time.sleep(PAUSE_S)
            page.log(f"Prefect's server took no run of {name}, which has no page ({refusal})")
            with inner.opened(checked, watcher) as on:
                return inner.call(replace(on, scheduled=scheduled), checked)

        on = replace(opened, progress=progress, scheduled=scheduled, run_study=run_study)
        progress.name = on.name
        if study.name == "update":
            progress.tolerances = on.campaign.tolerances
        runner = stack.enter_context(_runner(on.loaded))
        runs.append(StudyRun(runner, configured_server() is not None, study_run()))
        stack.enter_context(use_run(runs[0]))
        end = handed.end = study.call(on, parameters)
    for artifact in _artifacts(study, on.name, end):
        page.artifact(artifact)
    for line in end.lines:
        page.log(line)
    if isinstance(end.found, CampaignRun) and end.found.news:
        page.event(change_event(end.found))
    name, reason = end.state[:1].upper() + end.state[1:], "; ".join(end.doubts) or end.sentence
    if end.failure is not None:
        reason = f"{reason}; not written: {end.failure}"
    # What did not succeed is not shown in green, and an automation can wait for it.
    failed = end.exit_code or end.failure is not None
    made: Callable[..., State[Any]] = Failed if failed else Completed
    return made(name=name, message=reason, data=end.to_json())


def _artifacts(study: Study, name: str, end: StudyResult) -> list[Any]:
    if isinstance(end.found, CampaignRun):
        return result_artifacts(end.found.record, end.found.folder)
    artifacts = [table_artifact(name, table.title, table) for table in end.tables]
    return artifacts + ([files_artifact(name, end.written)] if end.written else [])


def _runner(campaign: Campaign | None) -> AbstractContextManager[Runner]:
    """The runner that the campaign asks for, or one on the task runner of the user's flow."""
    parallel = cores() if campaign is None else campaign.parallel
    around = _around.get()
    if around is not None and around != ThreadPoolTaskRunner():
        return task_runner(around.duplicate(), parallel)
    if campaign is not None and campaign.run.engine == "dask":
        return dask_task_runner(campaign.run.dask, campaign.threads, parallel)
    return task_runner(ThreadPoolTaskRunner(max_workers=parallel), parallel)


def _client() -> ServerClient:
    """A client of the server that Prefect's settings name in this context."""
    settings = get_settings_context().settings.api
    login, key = settings.auth_string, settings.key
    return ServerClient(
        str(settings.url),
        None if login is None else login.get_secret_value(),
        None if key is None else key.get_secret_value(),
    )


def _rename(flow_run: FlowRun, name: str) -> None:
    """Name a run that a server started after its campaign; a name is no reason to fail."""
    with suppress(PrefectException, httpx.HTTPError), get_client(sync_client=True) as client:
        client.update_flow_run(flow_run.id, name=name)
