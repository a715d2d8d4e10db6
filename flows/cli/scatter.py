"""`modetune scatter`: the scatter of parameters behind that of repeated tests."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from modetune.flows.cli.ending import Page, StudyEnd
from modetune.flows.cli.options import (
    AsJson,
    CampaignPath,
    Figures,
    NoPrefect,
    Runs,
    Settings,
    begun,
    paged,
    stoppable,
)
from modetune.flows.cli.sample import Points, Record, Seed

Of = Annotated[
    list[str] | None,
    typer.Option(help="A parameter that differs from test to test; others are the same in all."),
]
Deviation = Annotated[
    float | None,
    typer.Option(
        help="Scatter of a frequency by the measurement alone, relative; else the tests tell it "
        "where there are more frequencies than parameters, or it is taken as none."
    ),
]


def scatter(
    campaign_file: CampaignPath,
    of: Of = None,
    measurement_deviation: Deviation = None,
    record: Record = None,
    points: Points = None,
    seed: Seed = 1,
    figures: Figures = None,
    page: Page = None,
    settings: Settings = None,
    runs: Runs = Path("runs"),
    no_prefect: NoPrefect = False,
    as_json: AsJson = False,
) -> None:
    """What makes repeated tests differ: mean and covariance of the parameters behind them.

    Leaves scatter.h5 in the campaign's run folder. Ends with exit code 3 where the answer cannot be
    relied on.
    """
    with begun(f"reading {campaign_file}"):
        from modetune.core.storage.files import check_writable
        from modetune.core.storage.record_file import read_record
        from modetune.flows.campaign.campaign import load_campaign
        from modetune.flows.report.study_page import check_page
        from modetune.flows.studies.scatter.figures import scatter_charts
        from modetune.flows.studies.scatter.record import SCATTER
        from modetune.flows.studies.scatter.running import ScatterRequest, scatter_campaign
        from modetune.flows.studies.scatter.telling import findings, scatter_tables, summary, told

        check_page(page)

        campaign = load_campaign(campaign_file, settings or [])
    folder = runs / campaign.name
    check_writable(folder, "name another place for run folders with --runs")
    earlier = None
    if record is not None:
        earlier = read_record(record / "campaign.h5" if record.is_dir() else record)
    request = ScatterRequest(tuple(of or ()), measurement_deviation, points, seed)
    with (
        stoppable(),
        begun(f"scatter of {campaign.name}") as working,
        paged("scatter", campaign.name, no_prefect) as pages,
    ):
        found = scatter_campaign(campaign, request, working, earlier, pages)
        SCATTER.write(folder / SCATTER.file, found)
        runs_said = f"solver runs: {found.runs.modal}, answered by the store: {found.runs.reused}"
        model = [found.reduced_model.sentence] if found.reduced_model else []
        judged = findings(found)
        end = StudyEnd(
            "scatter",
            campaign.name,
            "scatter found",
            told(found),
            scatter_tables(found),
            [*summary(found), *model, runs_said, *(finding.text for finding in judged)],
            [folder / SCATTER.file],
            scatter_charts(found),
            [finding.text for finding in judged if finding.red],
        )
        files = end.reported(pages, page, figures)
    end.tell(files, as_json)
