"""`modetune screen`: the choice of parameters among many candidates."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from modetune.flows.studies.result import StudyResult
from modetune.flows.studies.screen.request import ScreeningRequest
from modetune.flows.studies.study import RunOptions, StudyContext, study

Out = Annotated[
    Path | None,
    typer.Option(help="Campaign file to write, with only the proposed parameters (YAML)."),
]


@study(RunOptions)
def screen(on: StudyContext, request: ScreeningRequest, out: Out = None) -> StudyResult:
    """Screen candidate parameters, and propose which of them to update.

    Gives a reason for each. Writes screening.h5 to the campaign's run folder, and screening.json
    with --json. Repeating the same screening runs no solver.
    """
    from modetune.flows.studies.screen.figures import screening_charts
    from modetune.flows.studies.screen.proposal import check_out, write_proposal
    from modetune.flows.studies.screen.record import SCREENING
    from modetune.flows.studies.screen.screening import screen_campaign
    from modetune.flows.studies.screen.summary import lines, proposed, summary, tables

    if out is not None:
        check_out(on.campaign.file, out)
    found = screen_campaign(on.campaign, request, on.working)
    record = on.folder / SCREENING.file
    SCREENING.write(record, found)
    return StudyResult(
        found,
        proposed(found),
        summary(found),
        tables(found),
        lines(found),
        [record],
        screening_charts(found) if on.charted else {},
        json_file=on.folder / "screening.json",
        outputs=() if out is None else [lambda: [write_proposal(on.campaign.file, found, out)]],
    )
