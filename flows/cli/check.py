"""`modetune check`: the pre-check of a campaign, and the comparison with a baseline."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import typer

from modetune.core.errors import CampaignError
from modetune.core.near_names import named
from modetune.core.storage.keys import Json
from modetune.flows.cli.ending import StudyEnd, tell_end
from modetune.flows.cli.options import (
    AsJson,
    ModelPath,
    NoPrefect,
    Settings,
    SolverChoice,
    UnitsChoice,
    begun,
    paged,
    stoppable,
    with_model,
)
from modetune.flows.report.tables import Column, Table, json_object, show, table_of

if TYPE_CHECKING:
    from modetune.flows.campaign.campaign import Campaign
    from modetune.flows.report.ci_files import CheckOutcome
    from modetune.flows.studies.check.findings import Finding
    from modetune.flows.studies.check.judging import PreCheckReport
    from modetune.flows.studies.check.model import ModelFacts
    from modetune.flows.updating.baseline import Band, State

MARKS = {"good": "", "doubtful": "yellow", "wrong": "bold red"}

Against = Annotated[
    Path | None, typer.Option(help="A campaign.h5 whose errors the model must not exceed.")
]
Record = Annotated[
    Path | None,
    typer.Option(help="With --against: compare this campaign.h5's updated model, run nothing."),
]
BaselineState = Annotated[
    str, typer.Option(help="Which model of the baseline: updated, or initial.")
]
FrequencyBand = Annotated[
    float, typer.Option(min=0.0, help="How much larger a relative frequency error may be.")
]
MacBand = Annotated[float, typer.Option(min=0.0, max=1.0, help="How much smaller a MAC may be.")]


def check(
    campaign_file: ModelPath,
    test: Annotated[
        list[Path] | None, typer.Argument(help="Beside a deck: the files of its test.")
    ] = None,
    solver: SolverChoice = None,
    units: UnitsChoice = None,
    settings: Settings = None,
    no_run: Annotated[bool, typer.Option("--no-run", help="Judge without a solver run.")] = False,
    against: Against = None,
    record: Record = None,
    state: BaselineState = "updated",
    frequency_band: FrequencyBand = 0.01,
    mac_band: MacBand = 0.05,
    summary: Annotated[
        Path | None, typer.Option(help="Add what was found to this file, in Markdown.")
    ] = None,
    junit: Annotated[
        Path | None, typer.Option(help="Write what was found as a JUnit report (XML).")
    ] = None,
    no_prefect: NoPrefect = False,
    as_json: AsJson = False,
) -> None:
    """Judge campaign, test and model before updating, at the cost of what updating begins with.

    Without a campaign file: a deck alone, or with the files of its test. With --against the model
    is solved at the deck's values and compared with a baseline.
    """
    changed = with_model(settings, solver, units)
    if against is not None or record is not None:
        if no_run and record is None:
            raise CampaignError("--against needs a solver run; with --record nothing is run")
        from modetune.flows.campaign.campaign import load_campaign
        from modetune.flows.updating.baseline import Band, State

        if against is None:
            raise CampaignError(
                "--record requires a baseline to compare with; name one with --against"
            )
        with stoppable():
            end, outcome = _compared(
                load_campaign(campaign_file, changed),
                (against, record),
                named("--state", state, get_args(State)),
                Band(frequency_band, mac_band),
                no_prefect or record is not None,
            )
        outcome.write(summary, junit)
        end.tell((), as_json)
        return
    with begun(f"reading {campaign_file}"):
        from modetune.flows.campaign.sketch import looked_at
        from modetune.flows.studies.check.judging import check_campaign

        campaign = looked_at(campaign_file, changed, test or [])
    with (
        stoppable(),
        begun("modes at the start"),
        paged("check", campaign.name, no_prefect or no_run) as pages,
    ):
        report = check_campaign(campaign, run=not no_run, watcher=pages)
        if pages is not None:
            good = report.exit_code == 0
            pages.done(_end(report), _tables(report), status=report.level, good=good)
    _outcome(campaign.name, report).write(summary, junit)
    if as_json:
        tell_end(told(campaign, report), (), as_json)
    else:
        _show(campaign, report)
    raise typer.Exit(report.exit_code)


def told(campaign: Campaign, report: PreCheckReport) -> dict[str, Json]:
    """The `--json` object of `modetune check`."""
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
        facts=_told_facts(report.facts) if report.facts else None,
        energy_shares={item.parameter: item.shares for item in report.shares},
        solver_runs=report.runs,
    )


def _told_facts(facts: ModelFacts) -> dict[str, Json]:
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


def _show(campaign: Campaign, report: PreCheckReport) -> None:
    from rich.table import Table
    from rich.text import Text

    from modetune.flows.campaign.terminal import terminal

    console = terminal()
    model = campaign.case.solver.deck.summary
    head = (
        f"{campaign.name}: model {model.name} ({len(model.node_ids)} nodes, "
        f"{model.n_elements} elements), {', '.join(_sizes(campaign))}"
    )
    show([head, *_tables(report)], console)
    for item in sorted(report.findings, key=lambda item: item.level == "good"):
        level = Text(f"{item.level:9}", style=MARKS[item.level]).append(f"{item.subject:11}", "")
        said = Text(_finding(item))
        if not console.is_terminal:  # there a finding stays one line
            show([level + said], console)
            continue
        row = Table.grid(padding=0)  # a long sentence goes on under its own beginning
        row.add_column(width=len(level), no_wrap=True)
        row.add_column(overflow="fold")
        row.add_row(level, said)
        console.print(row)
    show([_end(report)], console)


def _sizes(campaign: Campaign) -> list[str]:
    """What of test and parameters there is."""
    test, n = campaign.test, len(campaign.parameters)
    tested = f"{len(test.numbers)} test modes at {test.modes.n_dof} sensors"
    return [tested if test.numbers else "no test", f"{n} parameters" if n else "no parameters"]


def _tables(report: PreCheckReport) -> list[Table]:
    from modetune.flows.studies.check.pairing import ModePreview

    modes = table_of("Modes before updating", report.modes, ModePreview)
    return [modes, _energy_table(report)]


def _end(report: PreCheckReport) -> str:
    counts = {level: sum(item.level == level for item in report.findings) for level in MARKS}
    runs = report.runs
    made = runs.modal + runs.sensitivity
    ran = "1 solver run" if made == 1 else f"{made} solver runs"
    without = "no solver run" + (", answered by the store" if report.facts is not None else "")
    cost = ran if made else without
    return f"{report.level}: {counts['wrong']} wrong, {counts['doubtful']} doubtful; {cost}"


def _energy_table(report: PreCheckReport) -> Table:
    columns = [Column("parameter", words=True)]
    columns += [Column(f"mode {mode.mode}", form=".1f") for mode in report.modes]
    columns.append(Column("energy", words=True))
    rows = tuple((item.parameter, *(100.0 * item.shares), item.energy) for item in report.shares)
    return Table("Energy by parameter, % of each test mode", tuple(columns), rows)


def _compared(
    campaign: Campaign, files: tuple[Path, Path | None], state: State, band: Band, no_prefect: bool
) -> tuple[StudyEnd, CheckOutcome]:
    """A campaign's model beside a baseline's; files: the baseline, and a record in place of it."""
    from modetune.flows.report.ci_files import CheckOutcome, Judged
    from modetune.flows.updating.baseline import ModeCheck, check_deck, check_record

    baseline, record = files
    with paged("check", campaign.name, no_prefect) as pages:
        found = (
            check_deck(campaign, baseline, state, band, pages)
            if record is None
            else check_record(campaign, record, baseline, state, band)
        )
        outside = [(place, "") for place, mode in enumerate(found.modes) if not mode.within]
        table = table_of("Modes beside the baseline's", found.modes, ModeCheck, outside=outside)
        said = "within the band" if found.within else f"worse than the baseline: {found.reason}"
        end = StudyEnd(
            said,
            json_object(
                found,
                "reason modes remarks",
                status="within" if found.within else "worse",
                state=state,
                frequency_band=band.frequency,
                mac_band=band.mac,
                solver_runs=found.runs,
            ),
            [table],
            [*found.remarks, said],
            doubts=[] if found.within else [said],
            status="within the band" if found.within else "worse",
        )
        end.reported(("check", campaign.name), pages)
    judged = [Judged(f"mode {mode.label}", ", ".join(mode.reasons)) for mode in found.modes]
    if not judged:  # a mode was lost
        judged = [Judged("modes", found.reason)]
    return end, CheckOutcome(campaign.name, said, (table,), found.remarks, tuple(judged))


def _outcome(name: str, report: PreCheckReport) -> CheckOutcome:
    """What the pre-check found, for CI: only what is wrong fails."""
    from modetune.flows.report.ci_files import CheckOutcome, Judged
    from modetune.flows.studies.check.pairing import ModePreview

    said = [(item.subject, item.level, _finding(item)) for item in report.findings]
    remarks = tuple(
        f"{level}: {subject}: {text}" for subject, level, text in said if level != "good"
    )
    judged = tuple(
        Judged(f"{subject}: {text}", text if level == "wrong" else "")
        for subject, level, text in said
    )
    table = table_of("Modes before updating", report.modes, ModePreview)
    return CheckOutcome(name, _end(report), (table,) if table.rows else (), remarks, judged)


def _finding(item: Finding) -> str:
    where = f"{item.where}: " if item.where else ""
    return f"{where}{item.what}{f'; {item.remedy}' if item.remedy else ''}"
