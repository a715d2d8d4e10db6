"""`modetune screen`: which of many candidate parameters to update."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from modetune.flows.cli.ending import Page, StudyEnd
from modetune.flows.cli.options import Figures, NoPrefect, Runs, Settings, begun, paged, stoppable

CampaignPath = Annotated[Path, typer.Argument(help="Campaign file (YAML) with all candidates.")]
MethodName = Annotated[str, typer.Option(help="local, morris, sobol, lhs or factorial.")]
Points = Annotated[
    int | None, typer.Option(help="Points of the design at most; about ten a parameter.")
]
Seed = Annotated[int, typer.Option(min=0, help="Of the design's random numbers.")]
Levels = Annotated[
    int | None, typer.Option(help="Of each parameter: morris (even, 4), factorial (2).")
]
Choose = Annotated[int | None, typer.Option(min=1, help="How many parameters to propose.")]
Out = Annotated[
    Path | None, typer.Option(help="Campaign file with the proposed parameters alone (YAML).")
]


def screen(
    campaign_file: CampaignPath,
    method: MethodName = "local",
    points: Points = None,
    seed: Seed = 1,
    levels: Levels = None,
    choose: Choose = None,
    out: Out = None,
    figures: Figures = None,
    page: Page = None,
    settings: Settings = None,
    runs: Runs = Path("runs"),
    no_prefect: NoPrefect = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="One JSON object on standard output, and as a file.")
    ] = False,
) -> None:
    """Screen candidate parameters, and propose which of them to update, with a reason for each.

    Leaves screening.h5 in the campaign's run folder. The same screening again starts no solver.
    """
    with begun(f"reading {campaign_file}"):
        from modetune.core.near_names import named
        from modetune.core.storage.files import check_writable, writing
        from modetune.flows.campaign.campaign import load_campaign
        from modetune.flows.report.study_page import check_page
        from modetune.flows.studies.screen.design import METHODS
        from modetune.flows.studies.screen.figures import screening_charts
        from modetune.flows.studies.screen.proposal import check_out, write_proposal
        from modetune.flows.studies.screen.record import SCREENING
        from modetune.flows.studies.screen.running import ScreeningRequest, screen_campaign
        from modetune.flows.studies.screen.telling import (
            lines,
            proposed,
            tables,
            told,
        )

        check_page(page)

        known = named("--method", method, METHODS)
        campaign = load_campaign(campaign_file, settings or [])
    if out is not None:
        check_out(campaign_file, out)
    folder = runs / campaign.name
    check_writable(folder, "name another place for run folders with --runs")
    request = ScreeningRequest(known, points, seed, levels, choose)
    with (
        stoppable(),
        begun(f"screening {campaign.name}") as working,
        paged("screen", campaign.name, no_prefect) as pages,
    ):
        screening = screen_campaign(campaign, request, working, pages)
        SCREENING.write(folder / SCREENING.file, screening)
        written = [folder / SCREENING.file]
        if out is not None:
            written.append(write_proposal(campaign_file, screening, out))
        charts = screening_charts(screening) if figures or page else {}
        made, said = tables(screening), lines(screening)
        told_so = "screen", campaign.name, proposed(screening), told(screening)
        end = StudyEnd(*told_so, made, said, written, charts)
        files = end.reported(pages, page, figures)
    if as_json:
        with writing(folder / "screening.json") as part:
            part.write_text(json.dumps(end.json(files), indent=1), encoding="utf-8")
    end.tell(files, as_json)
