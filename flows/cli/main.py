"""The command line, which turns errors into a paragraph and an exit code.

Exit codes: 0 done (and converged); 2 bad input; 3 finished, e1 not met; 4 the solver failed;
5 the store cannot be used; 130 stopped by the user. Commands import the heavy packages that they
use.
"""

from __future__ import annotations

import atexit
import gc
import json
import logging
import os
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable
from importlib import import_module
from inspect import cleandoc
from pathlib import Path
from types import EllipsisType
from typing import Annotated

import typer

from modetune import __version__
from modetune.core.errors import ModetuneError
from modetune.flows.studies.catalogue import (
    BEFORE,
    HERE,
    MATRICES,
    STUDIES,
    TEST,
    TRUST,
    UPDATING,
    find_study,
)

#: Commands in the order of a campaign's life, under the headings of `--help`; `...` is the place of
#: the heading's studies. A study's command is derived from its definition, any other is in the
#: module of its name.
HEADINGS: dict[str, tuple[str | EllipsisType, ...]] = {
    TEST: (..., "inspect", "identify", "sensors"),
    BEFORE: ("init", ...),
    UPDATING: (..., "view", "explain"),
    MATRICES: (...,),
    TRUST: (...,),
    "Results": ("report", "paraview"),
    "Unattended": ("deploy", "serve", "worker", "server"),
    HERE: ("demo", "doctor", ..., "schema", "store"),
}
#: The extra of `modetune[...]` that brings a package; a cluster's packages report themselves.
EXTRAS = {
    **dict.fromkeys(("polars", "pypardiso"), "calculix"),
    **dict.fromkeys(("pyvista", "vtkmodules", "ccx2paraview"), "pictures"),
    **dict.fromkeys(("SALib", "emcee", "pandas"), "studies"),
    "pyoma2": "oma",
    "prefect_dask": "cluster",
}


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"modetune {__version__}")
        raise typer.Exit


def _modetune(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Finite element models that agree with vibration tests."""


def command_line(only: str = "") -> typer.Typer:
    """Return the command line, with one command where `only` is the name of one.

    The modules of all commands take a moment to import.
    """
    app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False)
    app.callback()(_modetune)
    commands = [(name, heading) for heading in HEADINGS for name in _names(heading)]
    for name, heading in [item for item in commands if item[0] == only] or commands:
        command = _command(name)
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=name, rich_help_panel=heading)
            continue
        paragraphs = cleandoc(command.__doc__ or "").split("\n\n")
        # Typer keeps line ends; a paragraph in one line is wrapped at the terminal's width.
        text = "\n\n".join(" ".join(part.split()) for part in paragraphs)
        app.command(rich_help_panel=heading, help=text)(command)
    return app


def _names(heading: str) -> list[str]:
    """Return the commands under a heading, with its studies at their place."""
    studies = [name for name, (_, of) in STUDIES.items() if of == heading]
    found = [[item] if isinstance(item, str) else studies for item in HEADINGS[heading]]
    return [name for names in found for name in names]


def _command(name: str) -> Callable[..., None] | typer.Typer:
    """Return the command, or the group of commands, of this name."""
    if name in STUDIES:
        from modetune.flows.cli.command import command_of
        from modetune.flows.cli.update import show_dry_run

        return command_of(find_study(name), show_dry_run if name == "update" else None)
    module = import_module(f"modetune.flows.cli.{name}")
    found: Callable[..., None] | typer.Typer = getattr(module, f"{name}_app", None) or getattr(
        module, name
    )
    return found


def __getattr__(name: str) -> typer.Typer:
    if name == "app":
        return command_line()
    raise AttributeError(name)


def _quiet() -> None:
    """Print our own warnings on standard error, a line each, and none of the libraries'."""
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("modetune: %(message)s"))
    ours = logging.getLogger("modetune")
    ours.addHandler(handler)
    level = os.environ.get("MODETUNE_LOG", "WARNING").upper()
    level = level if level in logging.getLevelNamesMapping() else "WARNING"
    handler.setLevel(level)  # a campaign's log file has more
    ours.setLevel(level)
    ours.propagate = False
    warnings.simplefilter("ignore")


def main() -> None:
    """Run the command line and end the process with its exit code."""
    _quiet()
    gc.set_threshold(10_000, 10, 10)  # imported objects stay, so collect less often
    atexit.register(gc.freeze)  # ... and never when the process ends
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # SIGTERM ends like Ctrl-C
    try:
        command_line(*sys.argv[1:2])(standalone_mode=True)
    except ModetuneError as error:
        _fail(str(error), error.exit_code)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(0) from None
    except Exception as error:  # a fault of ours, saved for a report
        missing = error.name if isinstance(error, ModuleNotFoundError) and error.name else ""
        if extra := EXTRAS.get(missing.partition(".")[0]):
            _fail(
                f"this requires the package {missing.partition('.')[0]}, which is not installed: "
                f"pip install 'modetune[{extra}]', or modetune[all] for everything",
                2,
            )
        with tempfile.NamedTemporaryFile(
            "w", prefix="modetune-", suffix=".log", delete=False
        ) as log:
            traceback.print_exc(file=log)
        _fail(f"this is a fault in modetune; please report it with the file {log.name}", 70)


def _fail(reason: str, code: int) -> None:
    reason = reason.replace(f"{Path.cwd()}{os.sep}", "")  # paths as people type them
    typer.echo(f"modetune: {reason}", err=True)
    if "--json" in sys.argv:
        typer.echo(json.dumps({"status": "failed", "reason": reason, "exit_code": code}))
    raise SystemExit(code)
