"""`modetune scatter`: the parameter scatter that explains the scatter of repeated tests."""

from __future__ import annotations

from modetune.flows.studies.result import StudyResult
from modetune.flows.studies.sample.study import Record, State
from modetune.flows.studies.scatter.request import ScatterRequest
from modetune.flows.studies.study import RunOptions, StudyContext, study


@study(RunOptions)
def scatter(
    on: StudyContext,
    request: ScatterRequest,
    record: Record = None,
    state: State = None,
) -> StudyResult:
    """Estimate mean and covariance of the parameters that make repeated tests differ.

    Writes scatter.h5 to the campaign's run folder. Exit code 3 if the estimate is not reliable.
    """
    from modetune.flows.studies.sample.posterior import sampling_start
    from modetune.flows.studies.scatter.estimate import scatter_campaign
    from modetune.flows.studies.scatter.figures import scatter_charts
    from modetune.flows.studies.scatter.record import SCATTER
    from modetune.flows.studies.scatter.summary import findings, lines, scatter_tables, summary

    earlier, start = sampling_start(on.campaign, record, state, on.folder)
    on.working(start)
    found = scatter_campaign(on.campaign, request, on.working, earlier)
    SCATTER.write(on.folder / SCATTER.file, found)
    runs = f"solver runs: {found.runs.modal}, cached: {found.runs.reused}"
    model = [found.reduced_model.sentence] if found.reduced_model else []
    judged = findings(found)
    doubts = [finding.text for finding in judged if finding.red]
    return StudyResult(
        found,
        "scatter found",
        summary(found),
        scatter_tables(found),
        [start, *lines(found), *model, runs, *(finding.text for finding in judged)],
        [on.folder / SCATTER.file],
        scatter_charts(found),
        doubts,
        exit_code=3 if doubts else 0,
    )
