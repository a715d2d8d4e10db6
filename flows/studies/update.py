"""`modetune update`: update a campaign's model until it agrees with its test."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modetune.core.errors import CampaignError
from modetune.flows.studies.result import StudyResult, near
from modetune.flows.studies.study import CampaignOptions, FailOnOption, Runs, StudyContext, study

if TYPE_CHECKING:
    from rich.console import Console

    from modetune.core.storage.campaign_record import CampaignRecord
    from modetune.core.updating.verdict import FailOn
    from modetune.flows.campaign.campaign import Campaign
    from modetune.flows.updating.forecast import Progress
    from modetune.flows.updating.record import CampaignRun


@dataclass(frozen=True)
class UpdateOptions(CampaignOptions):
    """Options of an update."""

    starts: Annotated[
        int | None, typer.Option(help="Number of starting points, as `--set update.starts=N`.")
    ] = None
    fail_on: FailOnOption = None
    runs: Runs = Path("runs")

    def open(self, progress: Progress, campaign: Campaign | None) -> StudyContext:
        if campaign is not None and self.starts is not None:
            raise CampaignError("the campaign is loaded already; give `update.starts` to load")
        return super().open(progress, campaign)

    def load(self) -> Campaign:
        from modetune.flows.campaign.campaign import load_campaign

        starts = [] if self.starts is None else [f"update.starts={self.starts}"]
        return load_campaign(self.campaign_file, [*(self.settings or []), *starts])

    def folder(self, campaign: Campaign) -> Path:
        return self.runs / campaign.name


@study(UpdateOptions)
def update(on: StudyContext, options: UpdateOptions) -> StudyResult:
    """Update the campaign's model until it agrees with its test.

    Adds the run to the history of the structure. Exit code 3 if e1 is not met, whatever the
    verdict; otherwise 6 if --fail-on excludes the verdict on the updated parameters, or 7 with
    --fail-on change if the structure has changed over its runs.
    """
    from modetune.flows.updating.update import is_same

    on.campaign.solver_version()  # a missing solver is reported before anything else starts
    return updated(on, options.fail_on, on.scheduled and is_same(on.campaign, on.folder))


def updated(on: StudyContext, fail_on: FailOn | None, same: bool = False) -> StudyResult:
    """Run the context's campaign, and return the result of its update.

    same: whether a schedule repeats the run before. Raises as `update_campaign` does.
    """
    from modetune.flows.report.headline import first_line
    from modetune.flows.report.mode_tables import mode_table
    from modetune.flows.report.parameter_tables import parameter_table
    from modetune.flows.updating.forecast import told_forecast
    from modetune.flows.updating.record import summary
    from modetune.flows.updating.run_history import drift_json
    from modetune.flows.updating.update import update_from_starts

    campaign, progress = on.campaign, on.progress
    progress.keep(on.folder)
    run = update_from_starts(campaign, on.folder, progress, forecast=progress.forecast)
    run = replace(run, fail_on=fail_on or campaign.run.fail_on)
    record, verdict = run.record, run.verdict
    status, reason = record.status, record.reason
    if same and not record.runs.modal + record.runs.sensitivity:
        reason = (
            "nothing changed since the previous run: no solver run, all "
            f"{record.runs.reused} results from the store; still {status.replace('_', ' ')}: "
            f"{reason}"
        )
        status = "unchanged"
    forecast = told_forecast(run.forecast) if run.forecast else None
    failed = {
        6: f"--fail-on {run.fail_on} excludes this verdict: {verdict}",
        7: f"--fail-on change: {record.drift}",
    }.get(run.exit_code, "")
    sentence = " ".join([first_line(record), *filter(None, [f"{reason}.", failed])])
    return StudyResult(
        run,
        sentence,
        {
            **summary(record, near(run.folder)),
            "fail_on": run.fail_on,
            "exit_code": run.exit_code,
            "forecast": forecast,
            "drift": drift_json(run.drift),
        },
        [mode_table(record), parameter_table(record)],
        written=None,
        doubts=[sentence] if run.exit_code else [],
        status=_state(record, f"{status.replace('_', ' ')}, {verdict.brief}"),
        exit_code=run.exit_code,
        shown=partial(_show, run, failed),
    )


def _state(record: CampaignRecord, status: str) -> str:
    """Return the name of the flow run's state, which begins with a change of the structure."""
    if record.state == "changed":
        return f"{record.drift}; {status}"
    return f"{status}, steady" if record.state == "steady" else status


def _show(run: CampaignRun, failed: str, console: Console) -> None:
    from rich.text import Text

    from modetune.flows.report.tables import OUTSIDE, show
    from modetune.flows.updating.display import show_run

    show_run(console, replace(run, folder=near(run.folder), updated_deck=near(run.updated_deck)))
    if failed:
        show([Text(failed, style=OUTSIDE)], console)
