"""`modetune compare`: which of several models explains a test best, and what would decide."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modetune.core.storage.files import check_writable
from modetune.core.storage.keys import Json
from modetune.flows.report.tables import Column, Table, json_object, table_of
from modetune.flows.studies.result import StudyResult, near
from modetune.flows.studies.study import Runs, StudyContext, StudyOptions, study

if TYPE_CHECKING:
    from modetune.flows.campaign.campaign import Campaign
    from modetune.flows.studies.compare.competing_models import ModelChoice
    from modetune.flows.updating.forecast import Progress

#: Rows of each table on a terminal.
SHOWN = 6


@dataclass(frozen=True)
class CompareOptions(StudyOptions):
    """Options of the comparison of models, which loads its campaigns itself."""

    campaigns: Annotated[
        tuple[Path, ...],
        typer.Argument(help="Campaign files (YAML) with one test and different models."),
    ]
    runs: Runs = Path("runs")

    def open(self, progress: Progress, campaign: Campaign | None) -> StudyContext:
        name = " or ".join(path.stem for path in self.campaigns)
        check_writable(self.runs, "name another place for run folders with --runs")
        return StudyContext(name, progress)

    def loaded(self) -> list[Campaign]:
        """Load the campaigns. Raises CampaignError."""
        from modetune.flows.campaign.campaign import load_campaign

        return [load_campaign(path, self.settings or []) for path in self.campaigns]


@study(CompareOptions)
def compare(on: StudyContext, options: CompareOptions) -> StudyResult:
    """Compare models of one test: which explains it best, and what would decide.

    Updates each campaign unless its run folder has the update, and weighs the models by their
    evidence: the likelihood of all measured data, averaged over the prior of the parameters.
    """
    from modetune.flows.studies.compare.competing_models import compare_models

    found = compare_models(options.loaded(), options.runs, on.progress)
    return StudyResult(
        found,
        found.sentence,
        summary(found),
        tables(found),
        _lines(found),
        written=None,
        status=found.status,
    )


@dataclass(frozen=True, slots=True)
class CompetingRow:
    """A model and how well it explains the test."""

    name: Annotated[str, Column("model")]
    n_parameters: Annotated[int, Column("parameters")]
    chi_square: Annotated[float, Column("chi-square", form=".4g")]
    degrees_of_freedom: Annotated[int, Column("degrees of freedom")]
    log_evidence: Annotated[float, Column("ln evidence", form=".2f")]
    probability: Annotated[float, Column("probability", "%", ".1f")]
    log_bayes_factor: Annotated[float, Column("ln Bayes factor of the best", form=".2f")]
    verdict: Annotated[str, Column("verdict of its update")]


#: Columns of what distinguishes models, and of what would.
DISTINCTION = (
    Column("measured", words=True, name="of"),
    Column("chi-square, best", form=".1f", name="best"),
    Column("second", form=".1f", name="second"),
    Column("difference", form="+.1f", name="difference"),
)
FURTHER = (
    Column("measurement", words=True, name="what"),
    Column("best predicts", form=".4g", name="best"),
    Column("second", form=".4g", name="second"),
    Column("", words=True, name="unit"),
    Column("difference, standard deviations", form=".1f", name="deviations"),
    Column("ln Bayes factor, up to", form=".1f", name="log_bayes_factor"),
)


def _rows(found: ModelChoice) -> list[CompetingRow]:
    return [
        CompetingRow(
            item.name,
            len(item.parameters),
            item.chi_square,
            item.freedom,
            item.log_evidence,
            item.probability,
            item.log_bayes_factor,
            item.verdict,
        )
        for item in found.models
    ]


def tables(found: ModelChoice) -> list[Table]:
    """Return the models, what distinguishes the two best, and what would decide."""
    best, second = (item.name for item in found.models[:2])
    apart = (*found.modes[:SHOWN], *found.sensors[:SHOWN])
    shown = [
        table_of("Models, the most probable first", _rows(found), CompetingRow),
        table_of(f"What distinguishes {best} from {second}", apart, DISTINCTION),
    ]
    if found.further:
        title = "What would decide between them"
        shown.append(table_of(title, found.further[:SHOWN], FURTHER))
    return shown


def summary(found: ModelChoice) -> dict[str, Json]:
    """Return the JSON object of a comparison."""

    def distinctions(items: object) -> Json:
        return [json_object(item, "of best second difference") for item in items]  # type: ignore[attr-defined]

    models = [
        json_object(
            row,
            "name n_parameters chi_square degrees_of_freedom log_evidence probability "
            "log_bayes_factor verdict",
            campaign=str(near(item.file)),
            parameters=dict(zip(item.parameters, item.updated.tolist(), strict=True)),
            updated_now=item.new,
            solver_runs=item.runs,
        )
        for row, item in zip(_rows(found), found.models, strict=True)
    ]
    return json_object(
        found,
        "status sentence decided scale p_value",
        models=models,
        modes=distinctions(found.modes),
        sensors=distinctions(found.sensors),
        further_measurements=[
            json_object(item, "what unit best second deviations log_bayes_factor")
            for item in found.further
        ],
    )


def _lines(found: ModelChoice) -> list[str]:
    from modetune.flows.studies.compare.competing_models import LEVEL

    lines = [found.sentence]
    if found.scale > 1.0 and found.p_value < LEVEL:
        lines.append(
            f"none of these models explains the test within its noise: even the best leaves "
            f"{found.scale:.2g} times the chi-square of noise, by which all are divided; the truth "
            "may be another model"
        )
    if not found.decided and found.further:
        first = found.further[0]
        lines.append(
            f"measure next: {first.what} (the two best models differ by {first.deviations:.1f} "
            f"standard deviations, worth a ln Bayes factor of up to {first.log_bayes_factor:.1f})"
        )
    for item in found.models:
        if item.verdict == "not to be trusted":
            lines.append(f"{item.name}: the parameters of its update are not to be trusted")
    return lines
