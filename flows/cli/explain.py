"""`modetune store explain`: the inputs and the outcome of a job.

Heavy packages are imported where they are needed.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING, Annotated

import typer

from modetune.core.errors import CampaignError
from modetune.core.storage.keys import Json
from modetune.flows.cli.options import AsJson, StorePlace, store_and_campaign
from modetune.flows.cli.output import print_result
from modetune.flows.report.tables import json_object

if TYPE_CHECKING:
    from modetune.flows.jobs.job_description import JobDescription
    from modetune.flows.jobs.lookup import Explanation

#: Number of digits of a key to print.
SHORT = 12


def explain(
    job: Annotated[str, typer.Argument(help="First characters of a job's key, or a job's folder.")],
    store: StorePlace = None,
    as_json: AsJson = False,
) -> None:
    """Describe a job and its outcome."""
    from modetune.flows.jobs.lookup import explain_job, key_start

    start = key_start(job)
    place, campaign = store_and_campaign(store)
    found = explain_job(place, start)
    if found is None and campaign is not None:
        from modetune.flows.updating.dry_run import explain_unrun

        found = explain_unrun(campaign, start)
    if found is None:
        raise CampaignError(
            f"there is no job {start}...: {place.folder} has no result or job folder of it"
            + ("" if campaign else "; give a campaign file as --store to include its future jobs")
        )
    print_result(_told(found), [f"{heading:9}{text}" for heading, text in _lines(found)], as_json)


def _lines(found: Explanation) -> list[tuple[str, str]]:
    from modetune.flows.jobs.job_description import describe

    lines = [("job", found.key), ("state", found.state)]
    lines += describe(found.job) if found.job else [("what", "unknown: the job has no note")]
    if found.wall_s is not None:
        lines.append(("took", f"{found.wall_s:.1f} s"))
    if found.written_s is not None:
        lines.append(("when", f"{datetime.fromtimestamp(found.written_s, UTC):%Y-%m-%d %H:%M} UTC"))
    if found.where is not None:
        lines.append(("where", str(found.where)))
    return lines + ([("log", found.log)] if found.log else [])


def _told(found: Explanation) -> dict[str, Json]:
    written = found.written_s and datetime.fromtimestamp(found.written_s, UTC).isoformat()
    return json_object(
        found,
        "key where wall_s log",
        status=found.state,
        written=written,
        job=job_json(found.job),
    )


def job_json(job: JobDescription | None) -> dict[str, Json] | None:
    """Return the JSON object of a job."""
    if job is None:
        return None
    note = job.note
    return json_object(
        job,
        "solver solver_version",
        analysis=job.kind,
        model=note and note.model,
        n_modes=note and note.n_modes,
        values=note and dict(note.values),
    )
