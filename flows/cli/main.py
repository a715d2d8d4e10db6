"""The command line, which turns errors into a paragraph and an exit code.

Exit codes: 0 done (and converged); 2 bad input; 3 finished, e1 not met; 4 the solver failed;
5 the store cannot be used; 6 e1 is met, but --fail-on excludes the verdict; 7 e1 is met, but the
structure has changed and --fail-on change excludes that; 130 stopped by the user. Commands import
the heavy packages that they use.
"""

from __future__ import annotations

import atexit
import errno
import gc
import json
import logging
import os
import re
import signal
import sys
import tempfile
import threading
import traceback
import warnings
from collections.abc import Callable
from importlib import import_module
from inspect import cleandoc
from pathlib import Path
from types import EllipsisType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from modetune import __version__
from modetune.core.errors import ModetuneError, SolverExhausted
from modetune.flows.extras import named_extras
from modetune.flows.studies.catalogue import DAY, MODEL, STUDIES, STUDY, find_study

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

#: Seconds until Ctrl-C is sent again; the callback that dropped it has ended by then.
AGAIN_S = 0.05
#: Commands under the headings of `--help`; `...` is the place of the heading's studies. A study's
#: command is derived from its definition, any other is in the module of its name.
HEADINGS: dict[str, tuple[str | EllipsisType, ...]] = {
    DAY: ("go", "init", "identify", "sensors", ..., "view", "report"),
    STUDY: (...,),
    "Installation, and groups of commands": (
        MODEL,
        "files",
        "server",
        "store",
        "upgrade",
        "doctor",
        "demo",
    ),
}
#: Groups: what they do, and their commands; `MODULE.NAME` is one of several in a module.
GROUPS: dict[str, tuple[str, tuple[str | EllipsisType, ...]]] = {
    MODEL: ("Expand shapes, reduce or correct matrices, compare solvers.", (...,)),
    "files": (
        "Inspect and convert test files, write ParaView files and the schema.",
        ("inspect", "paraview", "schema"),
    ),
    "server": (
        "Run campaigns unattended: Prefect deployments, workers, the shared server.",
        ("deploy", "serve", "worker", "server.status", "server.prune", "server.stop"),
    ),
    "store": (
        "List, explain, check and prune the stored results of solver jobs.",
        ("store.list", "explain", "store.size", "store.check", "store.prune", "store.forget"),
    ),
}
#: Spellings of version 0.1, which work for one more release, and what replaces them.
OLD_SPELLINGS = {
    "deploy": "server deploy",
    "direct": "model direct",
    "expand": "model expand",
    "explain": "store explain",
    "inspect": "files inspect",
    "paraview": "files paraview",
    "reduce": "model reduce",
    "schema": "files schema",
    "serve": "server serve",
    "store ls": "store list",
    "twin": "model twin",
    "worker": "server worker",
}


#: A word of a message that is a value of a file, not a word or a path, and how much of it is shown.
LONG, SHOWN = re.compile(r"\S{1000,}"), 60
#: Lines of a message that are shown, and characters of one.
MOST_LINES, LONGEST_LINE = 50, 5000


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


def command_line(first: str = "", second: str = "") -> typer.Typer:
    """Return the command line; where the first words name a command or a group, only that.

    The modules of all commands take a moment to import.
    """
    app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False)
    app.callback()(_modetune)
    entries = [(item, heading) for heading in HEADINGS for item in _entries(heading)]
    for item, heading in [entry for entry in entries if entry[0] == first] or entries:
        if item in GROUPS:
            app.add_typer(_group(item, second), name=item, rich_help_panel=heading)
        else:
            _add(app, item, heading)
    return app


def _group(name: str, only: str) -> typer.Typer:
    """Return a group of commands, with one command where `only` is the name of one."""
    group = typer.Typer(help=GROUPS[name][0], no_args_is_help=True)
    entries = _entries(name)
    for item in [item for item in entries if item.rpartition(".")[2] == only] or entries:
        _add(group, item, name)
    return group


def _entries(place: str) -> list[str]:
    """Return the entries of a heading or a group, with its studies at their place."""
    entries = GROUPS[place][1] if place in GROUPS else HEADINGS[place]
    own = [name for name, (_, where) in STUDIES.items() if where == place]
    studies = [name for name in own if name not in entries]
    found = [[item] if isinstance(item, str) else studies for item in entries]
    return [name for names in found for name in names]


def _add(app: typer.Typer, item: str, place: str) -> None:
    """Add a command under a heading or to a group."""
    module, _, name = item.rpartition(".")
    command = _study_command(item) if item in STUDIES else _function(module, name)
    paragraphs = cleandoc(command.__doc__ or "").split("\n\n")
    # Typer keeps line ends; a paragraph in one line is wrapped at the terminal's width.
    text = "\n\n".join(" ".join(part.split()) for part in paragraphs)
    panel = None if place in GROUPS else place
    app.command(name, rich_help_panel=panel, help=text)(command)


def _study_command(name: str) -> Callable[..., None]:
    from modetune.flows.cli.command import command_of
    from modetune.flows.cli.update import show_dry_run

    return command_of(find_study(name), show_dry_run if name == "update" else None)


def _function(module: str, name: str) -> Callable[..., None]:
    found = import_module(f"modetune.flows.cli.{module or name}")
    command: Callable[..., None] = getattr(found, f"{module}_{name}" if module else name)
    return command


def _current(words: list[str]) -> list[str]:
    """Return the words of a command line in today's spelling, with a warning about an old one."""
    for old, new in OLD_SPELLINGS.items():
        length = len(old.split())
        if words[:length] == old.split():
            _print_error(
                f"`modetune {old}` is now `modetune {new}`; the next release drops the old spelling"
            )
            return [*new.split(), *words[length:]]
    return words


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


def again_if_dropped(
    before: Callable[[UnraisableHookArgs], Any],
) -> Callable[[UnraisableHookArgs], Any]:
    """Return a hook that sends Ctrl-C again where Python drops it.

    An exception in a callback of a weak reference, or in a finalizer, goes to
    `sys.unraisablehook` and no further: the command would go on as if nobody had stopped it.
    before: the hook for all other exceptions.
    """

    def hook(found: UnraisableHookArgs) -> None:
        if found.exc_type is KeyboardInterrupt:
            again = threading.Timer(AGAIN_S, os.kill, (os.getpid(), signal.SIGINT))
            again.daemon = True
            again.start()
        else:
            before(found)

    return hook


def main() -> None:
    """Run the command line and end the process with its exit code."""
    _quiet()
    gc.set_threshold(10_000, 10, 10)  # imported objects stay, so collect less often
    atexit.register(gc.freeze)  # ... and never when the process ends
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # SIGTERM ends like Ctrl-C
    sys.unraisablehook = again_if_dropped(sys.unraisablehook)
    try:
        sys.argv[1:] = _current(sys.argv[1:])
        command: Any = typer.main.get_command(command_line(*sys.argv[1:3]))
        for item in command.params:  # a line of help for each of two options of shells is too much
            item.hidden = item.hidden or item.name == "show_completion"
        with named_extras():
            command(prog_name="modetune")
    except ModetuneError as error:
        _fail(str(error), error.exit_code)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(0) from None
    except Exception as error:
        if _lacks_memory(error):
            _fail(
                "the memory of this machine, or the limit of this process (`ulimit -v`), is too "
                "small for this; raise the limit, or use a smaller model or fewer jobs in parallel",
                SolverExhausted.exit_code,
            )
        # A fault of ours, saved for a report.
        with tempfile.NamedTemporaryFile(
            "w", prefix="modetune-", suffix=".log", delete=False
        ) as log:
            traceback.print_exc(file=log)
        _fail(f"this is a fault in modetune; please report it with the file {log.name}", 70)


def _lacks_memory(error: Exception) -> bool:
    """Return whether an error is a refused request for memory, as that of a thread's stack is."""
    refused = isinstance(error, OSError) and error.errno == errno.ENOMEM
    return refused or isinstance(error, MemoryError) or "can't start new thread" in str(error)


def _fail(reason: str, code: int) -> None:
    reason = reason.replace(f"{Path.cwd()}{os.sep}", "")  # paths as people type them
    first = reason.split("\n", MOST_LINES)
    if len(first) > MOST_LINES:
        more = first.pop().count("\n") + 1
        reason = "\n".join([*first, f"and {more} more lines like these"])
    reason = LONG.sub(lambda word: f"{word[0][:SHOWN]}... ({len(word[0])} characters)", reason)
    reason = "\n".join(
        line if len(line) < LONGEST_LINE else f"{line[:LONGEST_LINE]}... ({len(line)} characters)"
        for line in reason.split("\n")
    )
    _print_error(reason)
    if "--json" in sys.argv:
        typer.echo(json.dumps({"status": "failed", "reason": reason, "exit_code": code}))
    raise SystemExit(code)


def _print_error(text: str) -> None:
    typer.echo(f"modetune: {text}", err=True)
