"""`modetune confirm`: let the solver confirm the answer of an update that ended without it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from modetune.core.errors import CampaignError
from modetune.flows.studies.result import StudyResult, near
from modetune.flows.studies.study import FailOnOption, Runs, StudyContext, StudyOptions, study
from modetune.flows.studies.update import updated

if TYPE_CHECKING:
    from modetune.flows.campaign.campaign import Campaign
    from modetune.flows.updating.forecast import Progress


@dataclass(frozen=True)
class ConfirmOptions(StudyOptions):
    """Options of a confirmation."""

    run: Annotated[Path, typer.Argument(help="Run folder of an update, or its campaign file.")]
    by: Annotated[
        Literal["auto", "modes", "matrices"],
        typer.Option(help="What the solver computes, as `update.confirm`."),
    ] = "auto"
    fail_on: FailOnOption = None
    runs: Runs = Path("runs")

    def open(self, progress: Progress, campaign: Campaign | None) -> StudyContext:
        from modetune.flows.studies.run_source import open_run

        source = open_run(self.run, self.settings or [], self.runs)
        campaign, record = source.campaign, source.record
        if record is None:
            raise CampaignError(
                f"{near(source.run_folder)} has no update of {campaign.name}; run `modetune "
                "update` first, or name its run folder"
            )
        if not record.unconfirmed:
            raise CampaignError(
                f"{near(source.run_folder)} has nothing left to confirm: {record.best.solved_by} "
                "found the modes of its answer"
            )
        own = campaign.update.confirm  # other than the run's, if --set says so
        by = own if self.by == "auto" and own != "later" else self.by
        rules = campaign.update.model_copy(update={"confirm": by})
        campaign = replace(campaign, update=rules)
        return StudyContext(campaign.name, progress, campaign, folder=source.run_folder)


@study(ConfirmOptions)
def confirm(on: StudyContext, options: ConfirmOptions) -> StudyResult:
    """Let the solver confirm the answer of an update.

    For updates with `update.confirm: later`. Takes all other results from the store and replaces
    the run's record, report and verdict. If the solver disagrees, updating goes on by its modes.
    Exit codes are those of `update`.
    """
    on.campaign.solver_version()  # a missing solver is reported before anything else starts
    return updated(on, options.fail_on)
