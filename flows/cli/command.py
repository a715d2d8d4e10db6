"""The command of a study, derived from its definition."""

from __future__ import annotations

import inspect
import shlex
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal, get_args, get_origin

import typer

from modetune.core.errors import CampaignError
from modetune.core.near_names import named
from modetune.flows.cli.options import AsJson, NoPrefect, stoppable
from modetune.flows.cli.output import print_end
from modetune.flows.studies.catalogue import find_study
from modetune.flows.studies.result import StudyResult
from modetune.flows.studies.study import REQUIRED, Study, StudyParameter

#: Options of commands that are no parameters of a study, or that `server deploy` has itself.
NOT_THERE = ("settings", "runs", "as_json", "no_prefect", "dry_run")
#: The error of a wrong command line; typer's versions share no name for it.
WRONG: Any = typer.BadParameter.__bases__[0]
DryRun = Annotated[bool, typer.Option("--dry-run", help="List the jobs without running them.")]


def command_of(
    study: Study, show_plan: Callable[[Mapping[str, Any], bool], None] | None = None
) -> Callable[..., None]:
    """Return the command of a study.

    show_plan: prints the plan of `--dry-run` for checked parameters, as JSON or as text.
    """

    def command(
        as_json: bool = False, no_prefect: bool = False, dry_run: bool = False, **typed: Any
    ) -> None:
        with stoppable():
            parameters = study.checked(_parameters(study, typed))
            if dry_run and show_plan is not None:
                show_plan(parameters, as_json)
                return
            end = run_study(study, parameters, no_prefect)
        print_end(end, as_json)

    options = [_typed(item) for item in study.fields]
    if show_plan is not None:
        options.append(_flag("dry_run", DryRun))
    options += [_flag("no_prefect", NoPrefect), _flag("as_json", AsJson)]
    command.__name__, command.__doc__ = study.name, study.help
    command.__annotations__ = {item.name: item.annotation for item in options}
    command.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    return command


def run_study(study: Study, parameters: Mapping[str, Any], no_prefect: bool) -> StudyResult:
    """Run a study with its progress on standard error. Raises the errors of the study."""
    from modetune.flows.jobs.progress import JobProgress
    from modetune.flows.report.terminal import terminal

    console = terminal(stderr=True)
    with JobProgress(console).shown() as jobs:
        jobs.working(study.beginning(parameters))  # the imports below take a moment
        from modetune.flows.server.run import carried_out
        from modetune.flows.updating.display import ConsoleProgress

        door: Literal["off", "start"] = "off" if no_prefect else "start"
        watcher = ConsoleProgress(console, jobs)
        return carried_out(study, parameters, watcher, prefect=door, own_process=True)


def parse_study(line: str) -> tuple[Study, dict[str, Any]]:
    """Return the study and the parameters of a line such as "screen --method morris".

    Raises CampaignError.
    """
    try:
        name, *words = shlex.split(line)
    except ValueError as error:
        raise CampaignError(f"--study {line!r}: expected a command and its options") from error
    study = find_study(name)
    return study, parse_options(study, words)


def parse_options(study: Study, words: Sequence[str]) -> dict[str, Any]:
    """Return the parameters of typed options, without the campaign, with absolute paths.

    Raises CampaignError for options that are wrong or not parameters of the study.
    """
    app = typer.Typer(add_completion=False)
    app.command(study.name)(command_of(study, lambda parameters, as_json: None))
    first, *others = study.fields
    try:
        context = typer.main.get_command(app).make_context(study.name, [first.name, *words])
    except WRONG as error:
        raise CampaignError(f"the study {study.name}: {error.format_message()}") from error
    given = {item.name: item for item in context.command.params if _is_typed(context, item.name)}
    if refused := next((given[name] for name in NOT_THERE if name in given), None):
        raise CampaignError(
            f"--study {shlex.join([study.name, *words])!r}: {refused.opts[0]} is not part of a "
            "study; `--set` and `--runs` are options of server deploy and serve themselves"
        )
    typed = {item.name: context.params[item.name] for item in others if item.name in given}
    whole = {first.name: first.of_one(first.name), **_parameters(study, typed)}
    checked = study.checked(whole)
    return {name: checked[name] for name in typed}


def _is_typed(context: Any, name: str) -> bool:
    """Return whether an option was typed, and is not a default."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def _parameters(study: Study, typed: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of typed options. Raises CampaignError."""
    known = {item.name: item for item in study.fields}
    return {name: _read(known[name], value) for name, value in typed.items()}


def _read(item: StudyParameter, value: Any) -> Any:
    if item.reader is not None:
        return item.reader(value or "")
    if item.choices and value is not None:
        return named(item.option, value, item.choices)
    return value


def _typed(item: StudyParameter) -> inspect.Parameter:
    """Return a parameter for typer: choices and parameters with a reader are texts."""
    kind, default = item.kind, item.default
    if item.reader is not None or item.choices:
        optional = default is not REQUIRED and not isinstance(default, str)
        kind, default = (str | None, None) if optional else (str, default)
    elif get_origin(kind) is tuple:
        kind, default = list[get_args(kind)[0]] | None, None  # type: ignore[misc]
    return inspect.Parameter(
        item.name,
        inspect.Parameter.KEYWORD_ONLY,
        default=default,
        annotation=Annotated[kind, item.info],
    )


def _flag(name: str, kind: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=False, annotation=kind)
