"""`modetune check`: the gate before a campaign, and the comparison with a baseline."""

from __future__ import annotations

import json
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from modetune.core.keys import number_or_null
from modetune.flows.commands import store as store_commands
from modetune.flows.commands.stopping import stoppable

if TYPE_CHECKING:
    from rich.table import Table

    from modetune.flows.campaign import Campaign
    from modetune.flows.gate.judging import GateReport
    from modetune.flows.gate.model import ModelFacts

MARKS = {"good": "", "doubtful": "yellow", "wrong": "bold red"}
AsJson = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command()(check)


def check(
    campaign_file: Annotated[Path, typer.Argument(help="Campaign file (YAML).")],
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="KEY.KEY=VALUE over the campaign file; may be repeated."),
    ] = None,
    no_run: Annotated[bool, typer.Option("--no-run", help="Judge without a solver run.")] = False,
    against: store_commands.Against = None,
    record: store_commands.Record = None,
    state: store_commands.BaselineState = "updated",
    frequency_band: store_commands.FrequencyBand = 0.01,
    mac_band: store_commands.MacBand = 0.05,
    as_json: AsJson = False,
) -> None:
    """Judge campaign, test and model before updating, at the cost of its first modal run.

    With --against the model is solved at the deck's values and compared with a baseline.
    """
    if against is not None or record is not None:
        if no_run and record is None:
            from modetune.core.errors import CampaignError

            raise CampaignError("--against needs a solver run; with --record nothing is run")
        bands = frequency_band, mac_band
        with stoppable():
            store_commands.show_check(
                campaign_file, settings or [], against, record, state, bands, as_json
            )
        return
    from modetune.flows.campaign import load_campaign
    from modetune.flows.gate.judging import check_campaign

    campaign = load_campaign(campaign_file, settings or [])
    with stoppable():
        report = check_campaign(campaign, run=not no_run)
    if as_json:
        typer.echo(json.dumps(told(campaign, report)))
    else:
        _show(campaign, report)
    raise typer.Exit(report.exit_code)


def told(campaign: Campaign, report: GateReport) -> dict[str, Any]:
    """The `--json` object of `modetune check`."""
    model = campaign.solver.model
    return {
        "status": report.level,
        "exit_code": report.exit_code,
        "name": campaign.name,
        "model": model.name,
        "nodes": len(model.node_ids),
        "elements": model.n_elements,
        "parameters": list(campaign.parameters.names),
        "test_modes": list(campaign.test.numbers),
        "sensors": int(campaign.test.modes.n_dof),
        "store": str(campaign.store.folder),
        "findings": [
            {"level": item.level, "subject": item.subject, "what": item.what,
             "where": item.where, "remedy": item.remedy}
            for item in report.findings
        ],
        "modes": [
            {"mode": mode.number, "test_hz": mode.test_hz, "elastic_mode": mode.computed,
             "computed_hz": mode.computed_hz, "error": mode.error, "mac": number_or_null(mode.mac),
             "subspace_mac": number_or_null(mode.space_mac), "second_mode": mode.second or None,
             "second_mac": number_or_null(mode.second_mac)}
            for mode in report.modes
        ],
        "facts": _told_facts(report.facts) if report.facts else None,
        "energy_shares": {item.parameter: item.shares.tolist() for item in report.shares},
        "solver_runs": {"modal": report.runs.modal, "reused": report.runs.reused},
    }  # fmt: skip


def _told_facts(facts: ModelFacts) -> dict[str, Any]:
    body = facts.body
    return {
        "size_m": number_or_null(facts.size_m),
        "mass": number_or_null(facts.mass),
        "mass_kg": number_or_null(facts.mass_kg),
        "mass_of_rigid_modes": body.mass if body else None,
        "centre": body.centre.tolist() if body else None,
        "inertia": body.inertia.tolist() if body else None,
        "inertia_missing": facts.body_missing,
        "rigid_modes": facts.n_rigid,
        "rigid_hz": facts.rigid_hz,
        "elastic_hz": facts.elastic_hz.tolist(),
    }


def _show(campaign: Campaign, report: GateReport) -> None:
    from rich.table import Table
    from rich.text import Text

    from modetune.flows.terminal import terminal

    console = terminal()
    model = campaign.solver.model
    console.print(
        Text(
            f"{campaign.name}: model {model.name} ({len(model.node_ids)} nodes, "
            f"{model.n_elements} elements), {len(campaign.test.numbers)} test modes at "
            f"{campaign.test.modes.n_dof} sensors, {len(campaign.parameters)} parameters"
        ),
        soft_wrap=True,
    )
    if report.modes:
        console.print(_mode_table(report))
    if report.shares:
        console.print(_energy_table(report))
    for item in sorted(report.findings, key=lambda item: item.level == "good"):
        where = f"{item.where}: " if item.where else ""
        remedy = f"; {item.remedy}" if item.remedy else ""
        head = Text(f"{item.level:9}", style=MARKS[item.level]).append(f"{item.subject:11}", "")
        said = Text(f"{where}{item.what}{remedy}")
        if not console.is_terminal:  # there a finding stays one line
            console.print(head + said, soft_wrap=True)
            continue
        row = Table.grid(padding=0)  # a long sentence goes on under its own beginning
        row.add_column(width=len(head), no_wrap=True)
        row.add_column(overflow="fold")
        row.add_row(head, said)
        console.print(row)
    console.print(Text(_end(report)), soft_wrap=True)


def _end(report: GateReport) -> str:
    counts = {level: sum(item.level == level for item in report.findings) for level in MARKS}
    runs = report.runs
    cost = "1 solver run" if runs.modal else "answered by the store" if runs.reused else "no run"
    return f"{report.level}: {counts['wrong']} wrong, {counts['doubtful']} doubtful; {cost}"


def _mode_table(report: GateReport) -> Table:
    from rich.table import Table

    table = Table(title="Modes before updating", title_justify="left")
    for heading in ("test", "test Hz", "model", "Hz", "error %", "MAC", "close", "next", "MAC"):
        table.add_column(heading, justify="right")
    for mode in report.modes:
        second = str(mode.second) if isfinite(mode.second_mac) else "-"
        table.add_row(
            str(mode.number), f"{mode.test_hz:.3f}", str(mode.computed), f"{mode.computed_hz:.3f}",
            f"{100 * mode.error:+.2f}", _shown(mode.mac), _shown(mode.space_mac), second,
            _shown(mode.second_mac),
        )  # fmt: skip
    return table


def _energy_table(report: GateReport) -> Table:
    from rich.table import Table

    table = Table(title="Strain energy by parameter, % of each test mode", title_justify="left")
    table.add_column("parameter")
    for mode in report.modes:
        table.add_column(str(mode.number), justify="right")
    for item in report.shares:
        table.add_row(item.parameter, *(f"{100 * share:.1f}" for share in item.shares))
    return table


def _shown(value: float) -> str:
    return f"{value:.3f}" if isfinite(value) else "-"
