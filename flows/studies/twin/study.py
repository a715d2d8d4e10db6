"""`modetune model twin`: one model on several solvers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from modetune.core.errors import CampaignError
from modetune.flows.report.tables import Table
from modetune.flows.studies.result import StudyResult
from modetune.flows.studies.study import At, CampaignOptions, StudyContext, study

if TYPE_CHECKING:
    from modetune.flows.campaign.campaign import Campaign
    from modetune.flows.updating.forecast import Progress


@dataclass(frozen=True)
class TwinOptions(CampaignOptions):
    """Options of the comparison of solvers, which loads the campaign once for each."""

    at: At = None

    def open(self, progress: Progress, campaign: Campaign | None) -> StudyContext:
        return StudyContext(self.campaign_file.stem, progress)


@study(TwinOptions)
def twin(
    on: StudyContext,
    options: TwinOptions,
    solvers: Annotated[
        str,
        typer.Option(help="Solvers to compare, separated by commas; the first is the reference."),
    ] = "nastran,calculix",
) -> StudyResult:
    """Run the model's modal analysis on several solvers and compare their modes."""
    from modetune.flows.studies.twin.solver_modes import run_twin, twin_parts, twin_summary

    named = solvers.split(",")
    if len(named) < 2:
        raise CampaignError(f"--solvers {solvers}: name two or more, separated by commas")
    found = run_twin(options.campaign_file, named, options.at or [], options.settings or [])
    parts = twin_parts(found)
    names = [item.solver for item in found.solvers]
    alone = len(names) == 1
    return StudyResult(
        found,
        f"modes by {', '.join(names)}",
        twin_summary(found),
        [part for part in parts if isinstance(part, Table)],
        [part for part in parts if isinstance(part, str)],
        written=None,
        doubts=[f"{solver} did not run: {reason}" for solver, reason in found.absent] * alone,
        exit_code=4 if alone else 0,
    )
