"""The command line inside the test's own process: the same entry, no interpreter to start.

What a process alone can show (signals, kills, the import weight, Prefect's settings, which it
reads once) is tested with a process.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import signal
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from subprocess import CompletedProcess
from unittest import mock

from modetune.flows.cli.main import main


def run_command(folder: Path, *arguments: str, **environment: str) -> CompletedProcess[str]:
    """Run `modetune ARGUMENTS` in a folder, with these variables over the environment's."""
    said, told = io.StringIO(), io.StringIO()
    with (
        mock.patch.dict(os.environ, environment),
        mock.patch.object(sys, "argv", ["modetune", *arguments]),
        contextlib.chdir(folder),
        contextlib.redirect_stdout(said),
        contextlib.redirect_stderr(told),
        _as_it_was(),
    ):
        try:
            main()
            code: object = 0
        except SystemExit as end:
            code = end.code or 0
    assert isinstance(code, int)
    return CompletedProcess(list(arguments), code, said.getvalue(), told.getvalue())


@contextlib.contextmanager
def _as_it_was() -> Iterator[None]:
    """Take back what the entry sets for the whole process: logging, warnings, signals."""
    ours = logging.getLogger("modetune")
    kept = ours.handlers[:], ours.level, ours.propagate
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with warnings.catch_warnings():
            yield
    finally:
        ours.handlers[:], ours.propagate = kept[0], kept[2]
        ours.setLevel(kept[1])
        for number, handler in handlers.items():
            signal.signal(number, handler)
