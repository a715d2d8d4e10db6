"""`modetune scatter`: the scatter of parameters behind that of repeated tests."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

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
        from modetune.flows.studies.scatter.record import SCATTER
        from modetune.flows.studies.scatter.running import ScatterRequest, scatter_campaign
        from modetune.flows.studies.scatter.telling import findings, scatter_tables, summary, told

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
        written = [folder / SCATTER.file]
        if figures is not None:
            from modetune.flows.report.matplotlib_charts import save_all
            from modetune.flows.studies.scatter.figures import scatter_charts

            written += save_all(scatter_charts(found), figures)
        judged, tables = findings(found), scatter_tables(found)
        doubts = [finding.text for finding in judged if finding.red]
        if pages is not None:
            status = "unreliable" if doubts else "completed"
            said = "; ".join(doubts) or "scatter found"
            pages.done(said, tables, written, status, good=not doubts)
    if as_json:
        typer.echo(json.dumps(told(found, written)))
    else:
        from rich.text import Text

        from modetune.flows.report.tables import show

        runs_said = f"solver runs: {found.runs.modal}, answered by the store: {found.runs.reused}"
        model = [found.reduced_model.sentence] if found.reduced_model else []
        lines = [Text(item.text, style="red" if item.red else "") for item in judged]
        files = [f"written: {path}" for path in written]
        show([*tables, *summary(found), *model, runs_said, *lines, *files])
    raise typer.Exit(3 if doubts else 0)
