"""Output of a command: a JSON object for machines, or tables and sentences for people."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping

import typer
from rich.text import Text

from modetune.core.errors import ModetuneError
from modetune.core.storage.files import writing
from modetune.core.storage.keys import Json
from modetune.flows.report.tables import Table, show
from modetune.flows.studies.result import StudyResult, near


def print_result(
    result: Json | Mapping[str, Json], parts: Iterable[Table | Text | str], as_json: bool
) -> None:
    """Print the JSON object of a result, or its tables and sentences."""
    if as_json:
        typer.echo(json.dumps(result))
    else:
        show(parts)


def print_end(end: StudyResult, as_json: bool) -> None:
    """Print the end of a study. Raises typer.Exit with its exit code unless that is 0.

    Raises its failure after the result; a JSON object has it as `failure` instead.
    """
    result = end.to_json() if as_json else {}
    reported = as_json and isinstance(end.failure, ModetuneError)
    if reported:
        result["failure"] = str(end.failure)
    if as_json and end.json_file is not None:
        with writing(end.json_file) as part:
            part.write_text(json.dumps(result, indent=1), encoding="utf-8")
    files = [f"written: {near(path)}" for path in end.written or ()]
    if end.shown is not None and not as_json:
        from modetune.flows.report.terminal import terminal

        end.shown(terminal())
        show(files)
    else:
        lines = (Text(line, style="red" if line in end.doubts else "") for line in end.lines)
        print_result(result, [*end.tables, *lines, *files], as_json)
    if end.remark:
        typer.echo(f"modetune: {end.remark}", err=True)
    if reported and isinstance(end.failure, ModetuneError):
        typer.echo(f"modetune: {end.failure}", err=True)
        raise typer.Exit(end.failure.exit_code)
    if end.failure is not None:
        raise end.failure
    if end.exit_code:
        raise typer.Exit(end.exit_code)
