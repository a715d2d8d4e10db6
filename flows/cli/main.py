"""The command line. It alone turns errors into a paragraph and an exit code.

Exit codes: 0 done (and converged); 2 bad input; 3 finished, e1 not met; 4 the solver failed;
5 the store cannot be used; 130 stopped by the user. Heavy packages are imported by the commands
that need them.
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
from typing import Annotated

import typer

from modetune import __version__
from modetune.core.errors import ModetuneError
from modetune.flows.studies.catalogue import STUDIES, find_study

#: In the order of a campaign's life, under the headings of `--help`. A study's command is derived
#: from its definition, any other is in the module of its name.
COMMANDS = {
    "The test": ("pretest", "inspect", "identify", "sensors"),
    "Model and test, before updating": (
        "init", "check", "modes", "correlate", "screen", "localise",
    ),
    "Updating": ("update", "view", "explain"),
    "Whole matrices": ("expand", "reduce", "direct"),
    "How far to trust it": ("validate", "sample", "scatter"),
    "Results": ("report", "paraview"),
    "Unattended": ("deploy", "serve", "worker", "server"),
    "This installation": ("demo", "doctor", "twin", "schema", "store"),
}  # fmt: skip
#: The extra of `modetune[...]` that brings a package; a cluster's tell themselves.
EXTRAS = {
    **dict.fromkeys(("polars", "pypardiso"), "calculix"),
    **dict.fromkeys(("pyvista", "vtkmodules", "ccx2paraview"), "pictures"),
    **dict.fromkeys(("SALib", "emcee", "pandas"), "studies"),
    "pyoma2": "oma",
    "prefect_dask": "cluster",
}


def _tell_version(asked: bool) -> None:
    if asked:
        typer.echo(f"modetune {__version__}")
        raise typer.Exit


def _modetune(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_tell_version, is_eager=True, help="Tell the version."),
    ] = False,
) -> None:
    """Finite element models that agree with vibration tests."""


def command_line(asked: str = "") -> typer.Typer:
    """The command line; of the one command that is asked for, where there is such a one: the
    modules of all of them take a moment to import."""
    app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False)
    app.callback()(_modetune)
    alone = any(asked in names for names in COMMANDS.values())
    for heading, names in COMMANDS.items():
        for name in (asked,) * (asked in names) if alone else names:
            command = _command(name)
            if isinstance(command, typer.Typer):
                app.add_typer(command, name=name, rich_help_panel=heading)
                continue
            paragraphs = cleandoc(command.__doc__ or "").split("\n\n")
            # Typer keeps line ends: a paragraph is broken anew at the terminal's width.
            told = "\n\n".join(" ".join(part.split()) for part in paragraphs)
            app.command(rich_help_panel=heading, help=told)(command)
    return app


def _command(name: str) -> Callable[..., None] | typer.Typer:
    """A command, or the group of commands of this name."""
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
    """Our own warnings go to standard error a line each; libraries keep theirs to themselves."""
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
    gc.set_threshold(10_000, 10, 10)  # imports make objects that stay: looked at less often
    atexit.register(gc.freeze)  # ... and not at all when the process ends
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # SIGTERM ends like Ctrl-C
    try:
        command_line(*sys.argv[1:2])(standalone_mode=True)
    except ModetuneError as error:
        _fail(str(error), error.exit_code)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(0) from None
    except Exception as error:  # the last resort: a bug of ours, kept for a report
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
