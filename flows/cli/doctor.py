"""`modetune doctor`: test the installation and the solver features that campaigns need."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import typer

from modetune.core.near_names import named
from modetune.core.storage.files import writing
from modetune.flows.cli.options import AsJson, stoppable

if TYPE_CHECKING:
    from modetune.flows.studies.doctor.doctor import DoctorReport
    from modetune.flows.studies.doctor.installation import DoctorLine

CampaignFile = Annotated[
    Path | None,
    typer.Argument(help="Campaign file whose solver and model to test; optional."),
]
Solver = Annotated[
    str | None,
    typer.Option(
        help="Solver to test on a model of ten elements; default: all that need no licence."
    ),
]
Dialect = Annotated[str, typer.Option(help="Nastran dialect: msc, or nx (Simcenter).")]
Sent = Annotated[
    Path,
    typer.Option("--file", help="File for the report, in JSON, or in text if it ends in .txt."),
]


def doctor(
    campaign_file: CampaignFile = None,
    solver: Solver = None,
    dialect: Dialect = "msc",
    file: Sent = Path("modetune-doctor.json"),
    as_json: AsJson = False,
) -> None:
    """Test the installation, and the solver features that campaigns need.

    Tests a commercial solver only if you name it, because that takes a licence. Stores the tests
    that it passes; from then on `auto` uses those features. Exit code 4 if a test failed.
    """
    from modetune.flows.campaign.schema import NastranDialect
    from modetune.flows.report.terminal import terminal
    from modetune.flows.studies.doctor.doctor import run_doctor

    chosen: NastranDialect = named("--dialect", dialect, get_args(NastranDialect))

    def tell(line: DoctorLine) -> None:
        typer.echo(line.text, err=as_json)

    with (
        stoppable("stopped; the same command starts from the beginning"),
        terminal(stderr=True).status("testing") as status,  # nothing where it is not a terminal
    ):
        report = run_doctor(solver, chosen, campaign_file, tell, status.update)
    told = report.to_json(datetime.now(UTC))
    text = _text(report) if file.suffix == ".txt" else json.dumps(told, indent=1) + "\n"
    with writing(file, "name another place with --file") as part:
        part.write_text(text, encoding="utf-8")
    if as_json:
        typer.echo(json.dumps({**told, "file": str(file)}))
    else:
        typer.echo(f"{_counted(report)}; written: {file}, without names of people or hosts")
    raise typer.Exit(report.exit_code)


def _text(report: DoctorReport) -> str:
    return "".join(f"{line.text}\n" for line in report.lines) + f"{_counted(report)}\n"


def _counted(report: DoctorReport) -> str:
    from modetune.flows.studies.doctor.installation import STATES

    states = [line.state for line in report.lines]
    return ", ".join(f"{states.count(state)} {state}" for state in STATES)
