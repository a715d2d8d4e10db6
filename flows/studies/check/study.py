"""`modetune check`: the pre-check of a campaign, and the comparison with a baseline."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modetune.core.errors import CampaignError
from modetune.core.storage.keys import Json
from modetune.flows.report.tables import Column, Table, json_object, show, table_of
from modetune.flows.studies.result import StudyResult
from modetune.flows.studies.study import (
    FailOnOption,
    ModelPath,
    ModelState,
    SolverChoice,
    StepChoice,
    StudyContext,
    StudyOptions,
    SubcaseChoice,
    UnitsChoice,
    study,
    with_model,
)

if TYPE_CHECKING:
    from rich.console import Console

    from modetune.flows.campaign.campaign import Campaign
    from modetune.flows.report.ci_files import CheckOutcome
    from modetune.flows.studies.check.model import ModelFacts
    from modetune.flows.studies.check.pre_check import PreCheckReport
    from modetune.flows.updating.baseline import Band
    from modetune.flows.updating.forecast import Progress

MARKS = {"good": "", "doubtful": "yellow", "wrong": "bold red"}

BaselineState = Annotated[
    ModelState, typer.Option(help="Model of the baseline: updated or initial.")
]
FrequencyBand = Annotated[
    float, typer.Option(min=0.0, help="Allowed increase of a relative frequency error.")
]
MacBand = Annotated[float, typer.Option(min=0.0, max=1.0, help="Allowed decrease of a MAC.")]


@dataclass(frozen=True)
class CheckOptions(StudyOptions):
    """Options of the pre-check of a campaign or a deck, or of the comparison with a baseline."""

    campaign_file: ModelPath
    test: Annotated[
        list[Path] | None, typer.Argument(help="With a deck: the files of its test.")
    ] = None
    solver: SolverChoice = None
    units: UnitsChoice = None
    subcase: SubcaseChoice = None
    step: StepChoice = None
    no_run: Annotated[bool, typer.Option("--no-run", help="Check without a solver run.")] = False
    against: Annotated[
        Path | None,
        typer.Option(help="Baseline: a campaign.h5 whose errors the model must not exceed."),
    ] = None
    record: Annotated[
        Path | None,
        typer.Option(
            help="With --against: compare the updated model of this campaign.h5, and run no job."
        ),
    ] = None
    fail_on: FailOnOption = None

    def open(self, progress: Progress, campaign: Campaign | None) -> StudyContext:
        if self.record is not None and self.against is None:
            raise CampaignError(
                "--record requires a baseline to compare with; name one with --against"
            )
        if self.against is not None and self.no_run and self.record is None:
            raise CampaignError("--against needs a solver run; with --record nothing is run")
        if self.fail_on is not None and self.against is None:
            raise CampaignError("--fail-on judges an update; name its record with --against")
        if self.fail_on == "change":
            raise CampaignError(
                "--fail-on change judges the runs of a structure: give it to `modetune update`"
            )
        from modetune.flows.campaign.campaign import load_campaign
        from modetune.flows.campaign.sketch import open_model

        changed = with_model(self.settings, self.solver, self.units, self.subcase, self.step)
        if campaign is None and self.against is not None:
            campaign = load_campaign(self.campaign_file, changed)
        campaign = campaign or open_model(self.campaign_file, changed, self.test or [])
        return StudyContext(campaign.name, progress, campaign)

    @property
    def solves(self) -> bool:
        return self.record is None and not self.no_run


@study(CheckOptions)
def check(
    on: StudyContext,
    options: CheckOptions,
    state: BaselineState = "updated",
    frequency_band: FrequencyBand = 0.01,
    mac_band: MacBand = 0.05,
    summary: Annotated[
        Path | None, typer.Option(help="Append the findings to this file, in Markdown.")
    ] = None,
    junit: Annotated[
        Path | None, typer.Option(help="Write the findings as a JUnit report (XML).")
    ] = None,
) -> StudyResult:
    """Check campaign, test and model, with the jobs that updating runs first.

    Accepts a deck instead of a campaign file, alone or with the files of its test. With --against,
    solves the model at the deck's values and compares it with a baseline. Exit code 3 if a mode
    leaves its band; otherwise 6 if --fail-on excludes the verdict of the record, or else of the
    baseline.
    """
    if options.against is not None:
        from modetune.flows.updating.baseline import Band

        band = Band(frequency_band, mac_band)
        end, outcome = _compared(on.campaign, options, options.against, state, band)
    else:
        from modetune.flows.studies.check.pre_check import check_campaign

        on.working("modes at the start")
        report = check_campaign(on.campaign, run=not options.no_run)
        end, outcome = _judged(on.campaign, report), _outcome(on.name, report)
    outcome.write(summary, junit)
    return end


def _judged(campaign: Campaign, report: PreCheckReport) -> StudyResult:
    """The outcome of a pre-check."""
    wrong = [item.text for item in report.findings if item.level == "wrong"]
    return StudyResult(
        report,
        _end(report),
        check_summary(campaign, report),
        _tables(report),
        written=None,
        doubts=wrong,
        status=report.level,
        exit_code=report.exit_code,
        shown=partial(_show, campaign, report),
    )


def check_summary(campaign: Campaign, report: PreCheckReport) -> dict[str, Json]:
    """Return the JSON object of a pre-check."""
    model = campaign.case.solver.deck.summary
    return json_object(
        report,
        "findings modes exit_code",
        status=report.level,
        name=campaign.name,
        model=model.name,
        nodes=len(model.node_ids),
        elements=model.n_elements,
        parameters=campaign.parameters.names,
        test_modes=campaign.test.numbers,
        sensors=campaign.test.modes.n_dof,
        store=campaign.store.folder,
        facts=_facts_json(report.facts) if report.facts else None,
        energy_shares={item.parameter: item.shares for item in report.shares},
        solver_runs=report.runs,
    )


def _facts_json(facts: ModelFacts) -> dict[str, Json]:
    body = facts.body
    return json_object(
        facts,
        "size_m mass mass_kg mass_by rigid_hz elastic_hz",
        mass_of_rigid_modes=body.mass if body else None,
        centre=body.centre if body else None,
        inertia=body.inertia if body else None,
        inertia_missing=facts.body_missing,
        rigid_modes=facts.n_rigid,
    )


def _show(campaign: Campaign, report: PreCheckReport, console: Console) -> None:
    from rich.table import Table
    from rich.text import Text

    model = campaign.case.solver.deck.summary
    head = (
        f"{campaign.name}: model {model.name} ({len(model.node_ids)} nodes, "
        f"{model.n_elements} elements), {', '.join(_sizes(campaign))}"
    )
    show([head, *_tables(report)], console)
    for item in sorted(report.findings, key=lambda item: item.level == "good"):
        level = Text(f"{item.level:9}", style=MARKS[item.level]).append(f"{item.subject:11}", "")
        text = Text(item.text)
        if not console.is_terminal:  # there a finding stays one line
            show([level + text], console)
            continue
        row = Table.grid(padding=0)  # a long sentence continues below its own start
        row.add_column(width=len(level), no_wrap=True)
        row.add_column(overflow="fold")
        row.add_row(level, text)
        console.print(row)
    show([_end(report)], console)


def _sizes(campaign: Campaign) -> list[str]:
    """The test and the parameters, as far as the campaign has them."""
    test, n = campaign.test, len(campaign.parameters)
    tested = f"{len(test.numbers)} test modes at {test.modes.n_dof} sensors"
    return [tested if test.numbers else "no test", f"{n} parameters" if n else "no parameters"]


def _tables(report: PreCheckReport) -> list[Table]:
    from modetune.flows.diagnosis.pairing import ModePreview

    modes = table_of("Modes before updating", report.modes, ModePreview)
    return [modes, _energy_table(report)]


def _end(report: PreCheckReport) -> str:
    counts = {level: sum(item.level == level for item in report.findings) for level in MARKS}
    runs = report.runs
    made = runs.modal + runs.sensitivity
    ran = "1 solver run" if made == 1 else f"{made} solver runs"
    without = "no solver run" + (", results cached" if report.facts is not None else "")
    cost = ran if made else without
    return f"{report.level}: {counts['wrong']} wrong, {counts['doubtful']} doubtful; {cost}"


def _energy_table(report: PreCheckReport) -> Table:
    columns = [Column("parameter", words=True)]
    columns += [Column(f"mode {mode.mode}", form=".1f") for mode in report.modes]
    columns.append(Column("energy", words=True))
    rows = tuple((item.parameter, *(100.0 * item.shares), item.energy) for item in report.shares)
    return Table("Energy by parameter, % of each test mode", tuple(columns), rows)


def _compared(
    campaign: Campaign, options: CheckOptions, baseline: Path, state: ModelState, band: Band
) -> tuple[StudyResult, CheckOutcome]:
    """Compare a campaign's model, or that of a record, with a baseline's."""
    from modetune.flows.report.ci_files import CheckItem, CheckOutcome
    from modetune.flows.updating.baseline import ModeCheck, check_deck, check_record

    record, fail_on = options.record, options.fail_on or campaign.run.fail_on
    found = (
        check_deck(campaign, baseline, state, band)
        if record is None
        else check_record(campaign, record, baseline, state, band)
    )
    outside = [(place, "") for place, mode in enumerate(found.modes) if not mode.within]
    table = table_of("Modes compared with the baseline", found.modes, ModeCheck, outside=outside)
    text = "within the band" if found.within else f"worse than the baseline: {found.reason}"
    excluded = found.verdict.excluded_by(fail_on)
    verdict = f"verdict of {baseline if record is None else record}: {found.verdict}"
    verdict += f", which --fail-on {fail_on} excludes" if excluded else ""
    remarks = (*found.remarks, verdict)
    end = StudyResult(
        found,
        text,
        json_object(
            found,
            "reason modes remarks verdict",
            status="within" if found.within else "worse",
            fail_on=fail_on,
            state=state,
            frequency_band=band.frequency,
            mac_band=band.mac,
            solver_runs=found.runs,
        ),
        [table],
        [*remarks, text],
        doubts=[*([] if found.within else [text]), *([verdict] * excluded)],
        status=f"{'within the band' if found.within else 'worse'}, {found.verdict.brief}",
        exit_code=3 if not found.within else 6 if excluded else 0,
    )
    items = [CheckItem(f"mode {mode.label}", ", ".join(mode.reasons)) for mode in found.modes]
    if not items:  # a mode was lost
        items = [CheckItem("modes", found.reason)]
    items.append(CheckItem(f"verdict: {found.verdict}", verdict if excluded else ""))
    return end, CheckOutcome(campaign.name, text, (table,), remarks, tuple(items))


def _outcome(name: str, report: PreCheckReport) -> CheckOutcome:
    """The findings of the pre-check, for CI: only errors fail."""
    from modetune.flows.diagnosis.pairing import ModePreview
    from modetune.flows.report.ci_files import CheckItem, CheckOutcome

    texts = [(item.subject, item.level, item.text) for item in report.findings]
    remarks = tuple(
        f"{level}: {subject}: {text}" for subject, level, text in texts if level != "good"
    )
    items = tuple(
        CheckItem(f"{subject}: {text}", text if level == "wrong" else "")
        for subject, level, text in texts
    )
    table = table_of("Modes before updating", report.modes, ModePreview)
    return CheckOutcome(name, _end(report), (table,) if table.rows else (), remarks, items)
