"""`modetune sample`: the posterior of a campaign's parameters."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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

if TYPE_CHECKING:
    from modetune.flows.studies.sample.record import PosteriorRecord

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
        from modetune.flows.studies.sample.record import POSTERIOR
        from modetune.flows.studies.sample.running import SamplingRequest, sample_campaign
        from modetune.flows.studies.sample.telling import findings, posterior_table, told

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
        written = [folder / POSTERIOR.file]
        if figures is not None:
            from modetune.flows.report.matplotlib_charts import save_all
            from modetune.flows.studies.sample.figures import posterior_figures

            written += save_all(posterior_figures(found), figures)
        doubts = [finding.text for finding in findings(found) if finding.red]
        if pages is not None:
            said = "; ".join(doubts) or found.points_by or "sampled"
            status = "unreliable" if doubts else "completed"
            pages.done(said, [posterior_table(found)], written, status, good=not doubts)
    if as_json:
        typer.echo(json.dumps(told(found, written)))
    else:
        _show(found, written)
    raise typer.Exit(3 if doubts else 0)


def _show(found: PosteriorRecord, written: list[Path]) -> None:
    from rich.text import Text

    from modetune.flows.report.tables import show
    from modetune.flows.studies.sample.telling import findings, posterior_table

    by_model = found.by_reduced_model
    called = "reduced model" if by_model else "surrogate"
    left_out = "" if by_model else f"{found.left_out.max():.2g} with a set left out, "
    density = "" if by_model else f"; log density within {found.density_error:.2g}"
    lines = [
        f"solver runs: {found.runs.modal}, {found.runs.reused} answered by the store; the {called} "
        f"rests on {found.near.size} sets, {int(found.near.sum())} of them near the posterior; "
        f"sets left out: {len(found.failures)}",
        f"{called}, in standard deviations of the test: worst response {left_out}"
        f"{found.check_errors.max():.2g} at {len(found.check_keys)} checks{density}",
        f"samples: {found.walkers} walkers, {found.steps - found.burned} steps kept, effective "
        f"sample size {found.effective_sizes.min():.0f}, R-hat {found.r_hat.max():.3f}",
    ]
    if found.points_by:
        lines.insert(0, found.points_by)
    judged = [Text(item.text, style="red" if item.red else "") for item in findings(found)]
    files = [f"written: {path}" for path in written]
    show([posterior_table(found), *lines, *judged, *files])
