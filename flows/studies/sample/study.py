"""`modetune sample`: the posterior of a campaign's parameters."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from modetune.flows.studies.result import StudyResult
from modetune.flows.studies.sample.request import SamplingRequest
from modetune.flows.studies.study import ModelState, RunOptions, StudyContext, study

Record = Annotated[
    Path | None,
    typer.Option(
        help="Run folder (or campaign.h5) of an update, from whose final values to start; default: "
        "the newest update of this campaign."
    ),
]
State = Annotated[
    ModelState | None,
    typer.Option(
        help="Values to start from: updated, or initial to learn over the whole bounds; default: "
        "updated where there is an update."
    ),
]


@study(RunOptions)
def sample(
    on: StudyContext,
    request: SamplingRequest,
    record: Record = None,
    state: State = None,
) -> StudyResult:
    """Sample the posterior of the parameters.

    The posterior includes bounds, nonlinearity and second solutions. Writes posterior.h5 to the
    campaign's run folder. Repeating the same sampling runs no solver. Exit code 3 if the posterior
    is not reliable.
    """
    from modetune.flows.studies.sample.figures import posterior_figures
    from modetune.flows.studies.sample.posterior import sample_campaign, sampling_start
    from modetune.flows.studies.sample.record import POSTERIOR
    from modetune.flows.studies.sample.summary import findings, lines, posterior_table, summary

    earlier, start = sampling_start(on.campaign, record, state, on.folder)
    on.working(start)
    found = sample_campaign(on.campaign, request, on.working, earlier)
    POSTERIOR.write(on.folder / POSTERIOR.file, found)
    judged = findings(found)
    doubts = [finding.text for finding in judged if finding.red]
    return StudyResult(
        found,
        found.points_by or "sampled",
        summary(found),
        [posterior_table(found)],
        [start, *lines(found), *(finding.text for finding in judged)],
        [on.folder / POSTERIOR.file],
        posterior_figures(found) if on.charted else {},
        doubts,
        exit_code=3 if doubts else 0,
    )
