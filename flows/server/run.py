"""One entry for every study: the command and the Python verb run it here.

A study runs as a Prefect flow on the server that the user configured, else on the one that commands
share. While that starts, the campaign is loaded and checked. A server is never a reason to fail:
without one that answers in time the same study runs on a plain thread pool, and says so.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from modetune.adapters.yaml_file import read_yaml
from modetune.core.errors import ModetuneError
from modetune.flows.campaign.campaign import Campaign, campaign_form, cores
from modetune.flows.campaign.schema import ModelFile
from modetune.flows.jobs.runner import PoolRunner, Runner
from modetune.flows.jobs.tasks import StudyRun, study_run, use_run
from modetune.flows.studies.catalogue import find_study
from modetune.flows.studies.result import StudyResult
from modetune.flows.studies.study import Study, StudyContext
from modetune.flows.updating.forecast import Progress

if TYPE_CHECKING:
    from modetune.flows.jobs.prefect_server import SharedServer

#: Seconds that a study waits for a server to start.
WAIT_S = 20.0
#: The last line where the server was gone at the end of a flow.
LOST = "Prefect's server no longer answers: its page of this run has no end; the result is complete"


def carried_out(
    study: Study,
    parameters: Mapping[str, Any],
    progress: Progress,
    *,
    prefect: Literal["start", "find", "off"] = "start",
    campaign: Campaign | None = None,
    own_process: bool = False,
) -> StudyResult:
    """Run a study.

    prefect: find or start a server, find one that is configured or running, or do without.
    campaign: one that Python has loaded already. own_process: whether this process is the study's
    alone, and may be ended if the study is cancelled and does not end. Raises CampaignError and the
    errors of the study.
    """
    began, checked = time.monotonic(), study.checked(parameters)
    around = _in_flow()
    if not around and (prefect == "off" or _off(checked) or not study.solves(checked)):
        with study.opened(checked, progress, campaign) as on:
            return _on_pool(study, checked, on)
    server, remark = (None, "") if around else _server(prefect)
    with _used(server), study.opened(checked, progress, campaign) as on:
        if on.loaded is not None and not on.loaded.run.prefect:
            return _on_pool(study, checked, on)
        if around:
            return _in_pipeline(study, checked, on, progress)
        if server is not None:
            left = began + WAIT_S - time.monotonic()
            found = server.wait(
                max(left, 0.0),
                lambda s: progress.working(f"waiting for Prefect's server: {s:.0f} s"),
            )
            if found == "ready":
                end = _as_flow(study, checked, on, progress, server, own_process)
                if end is not None:
                    return end
                remark = f"Prefect's server at {server.pages} did not take the run"
            else:
                remark = server.describe(found)
        end = _on_pool(study, checked, on)
        return replace(end, remark=f"run without Prefect: {remark}") if remark else end


def _in_flow() -> bool:
    """Whether a flow of the user's own calls the study."""
    if "prefect" not in sys.modules:
        return False
    from prefect.context import FlowRunContext

    return FlowRunContext.get() is not None


def _off(parameters: Mapping[str, Any]) -> bool:
    """Whether the campaign says `run.prefect: off`; what is wrong with it is told when it loads."""
    file = Path(parameters.get("campaign_file") or "")
    if file.suffix not in (".yaml", ".yml"):
        return False
    try:
        form = campaign_form(read_yaml(file, "a campaign"), parameters["settings"], ModelFile)
    except ModetuneError:
        return False
    return not form.run.on_site().prefect


def _server(prefect: str) -> tuple[SharedServer | None, str]:
    """The server to use, and why there is none."""
    from modetune.flows.jobs.prefect_server import use_server

    try:
        return use_server(start=prefect == "start"), ""
    except ModetuneError as error:
        return None, str(error)


@contextmanager
def _used(server: SharedServer | None) -> Iterator[None]:
    if server is None:
        yield
        return
    with closing(server):
        yield


def _on_pool(study: Study, parameters: Mapping[str, Any], on: StudyContext) -> StudyResult:
    """The study without Prefect: on threads, or on the campaign's Dask cluster."""

    def run_study(name: str, given: Mapping[str, Any], watcher: Progress) -> StudyResult:
        return carried_out(find_study(name), given, watcher, prefect="off")

    with _plain_runner(on.loaded) as runner, use_run(StudyRun(runner, outer=study_run())):
        return study.call(replace(on, run_study=run_study), parameters)


@contextmanager
def _plain_runner(campaign: Campaign | None) -> Iterator[Runner]:
    if campaign is not None and campaign.run.engine == "dask":
        from modetune.flows.jobs.dask_cluster import dask_runner

        with dask_runner(campaign.run.dask, campaign.threads, campaign.parallel) as runner:
            yield runner
        return
    with closing(PoolRunner(cores() if campaign is None else campaign.parallel)) as pool:
        yield pool


def _in_pipeline(
    study: Study, parameters: Mapping[str, Any], on: StudyContext, progress: Progress
) -> StudyResult:
    """The study as a flow inside the flow that calls it, on that one's server."""
    from modetune.flows.server.flows import Handed, run_inside

    return run_inside(study.name, parameters, Handed(progress, on))


def _as_flow(
    study: Study,
    parameters: Mapping[str, Any],
    on: StudyContext,
    progress: Progress,
    server: SharedServer,
    own_process: bool,
) -> StudyResult | None:
    """The study as a flow on a server; None where the flow is refused before it begins."""
    from modetune.flows.server.prefect_client import prefect_client

    with prefect_client(server.settings()):
        from modetune.flows.server.flows import Handed, handing, run_as_flow

        handed = Handed(progress, on, own_process)
        with handing(handed):
            run_as_flow(study.name, parameters, on.name, server, handed)
        if not handed.began:
            return None
        end = handed.outcome()
        return replace(end, remark=LOST) if handed.lost else end
