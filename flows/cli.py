"""The command line. It alone turns errors into a paragraph and an exit code.

Exit codes: 0 done (and converged); 2 bad input; 3 finished, e1 not met; 4 the solver failed;
5 the store cannot be used; 130 stopped by the user. Heavy packages are imported by the commands
that need them.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from pathlib import Path
from typing import Annotated, Any

import typer

from modetune import __version__
from modetune.core.errors import ModetuneError
from modetune.flows.commands import check as check_command
from modetune.flows.commands import correlate as correlate_command
from modetune.flows.commands import identify as identify_command
from modetune.flows.commands import localise as localise_command
from modetune.flows.commands import paraview as paraview_command
from modetune.flows.commands import pretest as pretest_command
from modetune.flows.commands import report as report_command
from modetune.flows.commands import sample as sample_command
from modetune.flows.commands import schema as schema_commands
from modetune.flows.commands import screen as screen_command
from modetune.flows.commands import sensors as sensors_command
from modetune.flows.commands import store as store_commands
from modetune.flows.commands import test_data as test_data_commands
from modetune.flows.commands import validate as validate_command
from modetune.flows.commands.server import register
from modetune.flows.commands.stopping import stoppable

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Finite element models that agree with vibration tests.",
)
store_commands.register(app)
check_command.register(app)
correlate_command.register(app)
localise_command.register(app)
paraview_command.register(app)
report_command.register(app)
sample_command.register(app)
identify_command.register(app)
test_data_commands.register(app)
sensors_command.register(app)
screen_command.register(app)
validate_command.register(app)
pretest_command.register(app)

CampaignPath = Annotated[Path, typer.Argument(help="Campaign file (YAML).")]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", help="KEY.KEY=VALUE over the campaign file; may be repeated."),
]
At = Annotated[
    list[str] | None,
    typer.Option(help="NAME=VALUE of a parameter, relative to the deck; may be repeated."),
]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]


@app.command()
def update(
    campaign_file: CampaignPath,
    settings: Settings = None,
    runs: Annotated[Path, typer.Option(help="Where run folders go.")] = Path("runs"),
    no_prefect: Annotated[bool, typer.Option("--no-prefect", help="Plain threads only.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would be run.")] = False,
    starts: Annotated[
        int | None, typer.Option(help="Update from so many starts; as `--set update.starts=N`.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Update the campaign's model until it agrees with its test."""
    if starts is not None:
        settings = [*(settings or []), f"update.starts={starts}"]
    if dry_run:
        with stoppable():
            store_commands.show_dry_run(campaign_file, settings or [], runs, as_json)
        return
    _update(campaign_file, settings or [], runs, not no_prefect, as_json)


@app.command()
def modes(
    campaign_file: CampaignPath,
    at: At = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Compute the model's modes, at the deck's values or at those of --at."""
    from modetune.flows.modal_run import modal_summary, model_modes, parse_values

    campaign = _load(campaign_file, settings or [])
    with stoppable():
        result = model_modes(campaign, parse_values(campaign, at or []))
    told = modal_summary(campaign, result)
    if as_json:
        _tell(told, True)
        return
    for number, frequency in enumerate(told["frequencies_hz"], start=1):
        rigid = "  rigid" if number <= told["rigid_modes"] else ""
        typer.echo(f"{number:4d} {frequency:14.6f} Hz{rigid}")
    mass = "not known" if told["mass_kg"] is None else f"{told['mass_kg']:.6g} kg"
    typer.echo(f"mass {mass}; {told['solver']} {told['solver_version']}")


@app.command()
def twin(
    campaign_file: CampaignPath,
    solvers: Annotated[
        str, typer.Option(help="Solvers to compare, with commas; the first is the reference.")
    ] = "nastran,calculix",
    at: At = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Run the model's modal analysis on several solvers and show their modes side by side."""
    from modetune.flows.terminal import terminal
    from modetune.flows.twin import run_twin, twin_summary

    with stoppable():
        compared = run_twin(campaign_file, solvers.split(","), at or [], settings or [])
    if as_json:
        _tell(twin_summary(compared), True)
    else:
        from modetune.flows.display import show_twin

        show_twin(terminal(), compared)
    raise typer.Exit(0 if len(compared.solvers) > 1 else 4)


@app.command()
def demo(
    case: Annotated[str, typer.Argument(help="garteur, six-mass, fixture or lab.")] = "garteur",
    as_json: AsJson = False,
) -> None:
    """Run a case of the reference thesis, or a lab's test, from beginning to end, in ./demo."""
    from modetune.core.errors import CampaignError
    from modetune.core.store import check_writable
    from modetune.flows.cases.demo import CASES

    if case not in CASES:
        raise CampaignError(f"there is no demo {case!r}; there is {', '.join(CASES)}")
    chosen, folder = CASES[case], Path("demo") / case
    check_writable(folder, "run it in another folder")
    for file in chosen.files:
        shutil.copyfile(file, folder / file.name)
    if chosen.prepare is not None:
        chosen.prepare(folder)
    campaign = folder / chosen.campaign
    with stoppable():
        run = _run_update(campaign, [], folder / "runs", chosen.with_prefect)
        compared = chosen.compare(run, folder)
    if as_json:
        from modetune.flows.recording import summary

        _tell({**summary(run.record, run.folder), **compared.told()}, True)
    else:
        _show(run)
        compared.show()
    _end(run.record.status if compared.holds else "not as the thesis")


@app.command()
def version() -> None:
    """Print modetune's version."""
    typer.echo(__version__)


schema_commands.register(app)
register(app)


def _update(
    campaign_file: Path, settings: list[str], runs: Path, with_prefect: bool, as_json: bool
) -> None:
    from modetune.flows.recording import summary

    with stoppable():
        run = _run_update(campaign_file, settings, runs, with_prefect)
    if as_json:
        _tell(store_commands.with_forecast(summary(run.record, run.folder), run.forecast), True)
    else:
        _show(run)
    _end(run.record.status)


def _run_update(campaign_file: Path, settings: list[str], runs: Path, with_prefect: bool) -> Any:
    from modetune.flows.display import ConsoleProgress
    from modetune.flows.server.process import use_server
    from modetune.flows.terminal import terminal
    from modetune.flows.trust.starts import update_from_starts

    campaign = _load(campaign_file, settings)
    campaign.solver.version()
    server = use_server() if with_prefect else None
    try:
        with ConsoleProgress(terminal(stderr=True)).shown() as progress:
            run = update_from_starts(
                campaign, runs / campaign.name, progress, server, progress.forecast
            )
            return run
    finally:
        if server is not None:
            server.close()


def _show(run: Any) -> None:
    from modetune.flows.display import show_run
    from modetune.flows.terminal import terminal

    show_run(terminal(), run)


def _load(campaign_file: Path, settings: list[str]) -> Any:
    from modetune.flows.campaign import load_campaign

    return load_campaign(campaign_file, settings)


def _end(status: str) -> None:
    raise typer.Exit(0 if status == "converged" else 3)


def _tell(told: Any, as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps(told))
        return
    width = max(len(key) for key in told)
    for key, value in told.items():
        shown = ", ".join(map(str, value)) if isinstance(value, list) else value
        typer.echo(f"{key.replace('_', ' '):{width}}  {shown}")


def _quiet() -> None:
    """Our own warnings go to standard error a line each; libraries keep theirs to themselves."""
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("modetune: %(message)s"))
    ours = logging.getLogger("modetune")
    ours.addHandler(handler)
    level = os.environ.get("MODETUNE_LOG", "WARNING").upper()
    ours.setLevel(level if level in logging.getLevelNamesMapping() else "WARNING")
    ours.propagate = False
    warnings.simplefilter("ignore")


def main() -> None:
    """Run the command line and end the process with its exit code."""
    _quiet()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # SIGTERM ends like Ctrl-C
    try:
        app(standalone_mode=True)
    except ModetuneError as error:
        _fail(str(error), error.exit_code)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(0) from None
    except Exception:  # the last resort: a bug of ours, kept for a report, not thrown at the user
        with tempfile.NamedTemporaryFile(
            "w", prefix="modetune-", suffix=".log", delete=False
        ) as log:
            traceback.print_exc(file=log)
        _fail(f"this is a fault in modetune; please report it with the file {log.name}", 70)


def _fail(reason: str, code: int) -> None:
    typer.echo(f"modetune: {reason}", err=True)
    if "--json" in sys.argv:
        typer.echo(json.dumps({"status": "failed", "reason": reason, "exit_code": code}))
    raise SystemExit(code)
