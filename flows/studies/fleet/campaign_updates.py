"""The updates of a fleet's campaigns, several at a time, each as a part of the study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed, wait
from contextvars import copy_context
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from modetune.core.errors import CampaignRunning, ModetuneError, SolverCancelled
from modetune.flows.jobs.tasks import study_run
from modetune.flows.studies.study import StudyContext
from modetune.flows.updating.forecast import Unwatched

#: Seconds for which an interrupted fleet waits for its updates, so that their pages show the end.
END_S = 10.0


@dataclass(frozen=True, slots=True)
class UpdateEnd:
    """How the update of a campaign ended: its exit code, and why it has no result."""

    exit_code: int
    failure: str = ""


def update_all(
    on: StudyContext, files: Sequence[Path], parallel: int, options: Mapping[str, Any]
) -> dict[Path, UpdateEnd]:
    """Update campaigns and return how each ended; one that fails stops no other.

    files: of the campaigns. options: parameters of all updates. If the study is interrupted, so are
    the updates.
    """
    assert on.run_study is not None
    pool = ThreadPoolExecutor(parallel, thread_name_prefix="modetune-fleet")
    futures: dict[Future[UpdateEnd], Path] = {}
    try:
        for file in files:
            futures[pool.submit(copy_context().run, _updated, on, file, options)] = file
        for done, _ in enumerate(as_completed(futures), start=1):
            on.working(f"{done} of {len(futures)} campaigns updated")
        return {file: future.result() for future, file in futures.items()}
    except BaseException:
        run = study_run()
        if run is not None:
            run.cancel()
        pool.shutdown(wait=False, cancel_futures=True)
        wait([item for item in futures if not item.cancelled()], END_S)
        raise
    finally:
        pool.shutdown(wait=False)


def _updated(on: StudyContext, file: Path, options: Mapping[str, Any]) -> UpdateEnd:
    assert on.run_study is not None
    try:
        end = on.run_study("update", {"campaign_file": file, **options}, Unwatched())
    except SolverCancelled:
        raise
    except CampaignRunning:
        return UpdateEnd(0, "not updated: another run of it is in progress")
    except ModetuneError as error:
        return UpdateEnd(error.exit_code, str(error))
    return UpdateEnd(end.exit_code)
