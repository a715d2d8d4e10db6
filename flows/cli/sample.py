"""`modetune sample`: the posterior of a campaign's parameters."""

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

Record = Annotated[
    Path | None,
    typer.Option(help="Run folder (or campaign.h5) of an update, from whose end it starts."),
]
Points = Annotated[
    int | None,
    typer.Option(help="Sets over the range; as many may follow near the posterior."),
]
Walkers = Annotated[int | None, typer.Option(help="Walkers of the sampler.")]
Steps = Annotated[int, typer.Option(help="Steps of a walker; more follow if needed.")]
Seed = Annotated[int, typer.Option(help="Seed of all random numbers.")]
Checks = Annotated[
    int | None,
    typer.Option(help="Sets of the posterior that are solved for: 8, 2 with a reduced model."),
]


def sample(
    campaign_file: CampaignPath,
    record: Record = None,
    points: Points = None,
    walkers: Walkers = None,
    steps: Steps = 2000,
    seed: Seed = 1,
    checks: Checks = None,
    figures: Figures = None,
    page: Page = None,
    settings: Settings = None,
    runs: Runs = Path("runs"),
    no_prefect: NoPrefect = False,
    as_json: AsJson = False,
) -> None:
    """Sample the parameters' posterior: how sure they are, bounds, bends and second answers seen.

    Leaves posterior.h5 in the campaign's run folder. The same sampling again starts no solver.
    Ends with exit code 3 where the posterior cannot be relied on.
    """
    with begun(f"reading {campaign_file}"):
        from modetune.core.storage.files import check_writable
        from modetune.core.storage.record_file import read_record
        from modetune.flows.campaign.campaign import load_campaign
        from modetune.flows.report.study_page import check_page
        from modetune.flows.studies.sample.figures import posterior_figures
        from modetune.flows.studies.sample.record import POSTERIOR
        from modetune.flows.studies.sample.running import SamplingRequest, sample_campaign
        from modetune.flows.studies.sample.telling import (
            findings,
            posterior_table,
            summary,
            told,
        )

        check_page(page)

        campaign = load_campaign(campaign_file, settings or [])
    folder = runs / campaign.name
    check_writable(folder, "name another place for run folders with --runs")
    earlier = read_record(record) if record is not None else None
    request = SamplingRequest(points, walkers, steps, seed, checks)
    with (
        stoppable(),
        begun(f"sampling {campaign.name}") as working,
        paged("sample", campaign.name, no_prefect) as pages,
    ):
        found = sample_campaign(campaign, request, working, earlier, pages)
        POSTERIOR.write(folder / POSTERIOR.file, found)
        judged = [finding.text for finding in findings(found)]
        said = found.points_by or "sampled"
        end = StudyEnd(
            "sample",
            campaign.name,
            said,
            told(found),
            [posterior_table(found)],
            [*summary(found), *judged],
            [folder / POSTERIOR.file],
            posterior_figures(found) if figures or page else {},
            [finding.text for finding in findings(found) if finding.red],
        )
        files = end.reported(pages, page, figures)
    end.tell(files, as_json)
