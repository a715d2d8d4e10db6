"""The commands that a server may run: studies and updates, each a flow of its name.

A study is named as it is typed, `screen --method morris`; what it asks for is checked when it is
deployed, and paths in it are made absolute, since a worker may stand elsewhere.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from modetune.core.errors import CampaignError
from modetune.flows.cli.command import command_of
from modetune.flows.cli.options import on_pages
from modetune.flows.studies.catalogue import find_study

if TYPE_CHECKING:
    from modetune.flows.updating.prefect import Pages

    from modetune.flows.campaign.campaign import Campaign

#: Each in the module of its name.
STUDIES = (
    "update", "screen", "sample", "scatter", "validate", "localise", "check", "pretest",
    "correlate", "expand", "reduce", "direct",
)  # fmt: skip
#: What is not part of a study: `deploy` has options for it, or nobody would see it.
NOT_THERE = ("settings", "runs", "as_json", "no_prefect", "dry_run")
#: What a wrong command line raises; typer has no name for it that all its versions share.
WRONG: Any = typer.BadParameter.__bases__[0]
app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
for study in STUDIES:
    app.command()(command_of(find_study(study)))


@dataclass(frozen=True, slots=True)
class Study:
    """A study of a campaign: its command's name and its options."""

    name: str
    options: tuple[str, ...] = ()

    def campaign(self, file: Path, settings: list[str]) -> Campaign:
        """The campaign, read as the study reads it. Raises CampaignError."""
        from modetune.flows.campaign.campaign import load_campaign, load_model

        return (
            load_model(file, settings) if self.name == "pretest" else load_campaign(file, settings)
        )

    def arguments(self, campaign: Path, settings: list[str], runs: Path) -> list[str]:
        """The command line. Raises CampaignError where it is not one of the study's."""
        pairs = [item for setting in settings for item in ("--set", setting)]
        if any("--runs" in item.opts for item in _command(self.name).params):
            pairs += ["--runs", str(runs)]
        arguments = [self.name, str(campaign), *pairs, *self.options]
        _parsed(self.name, arguments[1:])
        return arguments


def read_study(line: str, campaign: Path) -> Study:
    """A study as it is typed after `modetune`, without the campaign. Raises CampaignError."""
    try:
        name, *options = shlex.split(line)
    except ValueError as error:
        raise CampaignError(f"--study {line!r}: expected a command and its options") from error
    context = _parsed(name, [str(campaign), *options])
    made: list[str] = []
    for item in context.command.params[1:]:
        value = context.params[item.name]
        if context.get_parameter_source(item.name).name != "COMMANDLINE":
            continue
        if item.name in NOT_THERE:
            raise CampaignError(
                f"--study {line!r}: {item.opts[0]} is not part of a study; `--set` and `--runs` "
                "are options of deploy and serve themselves"
            )
        named = [item.opts[0]] if item.opts[0].startswith("-") else []
        for one in value if isinstance(value, list | tuple) else [value]:
            made += named if one is True else [*named, _absolute(one)]
    return Study(name, tuple(made))


def run_study(arguments: list[str], pages: Pages) -> None:
    """Run a study on the pages of the run that a server started. Raises what its command does."""
    with on_pages(pages):
        app(arguments, standalone_mode=False, prog_name="modetune")


def _absolute(value: object) -> str:
    return str(value.resolve() if isinstance(value, Path) else value)


def _command(name: str) -> Any:
    commands: dict[str, Any] = vars(typer.main.get_command(app))["commands"]
    if name not in commands:
        known = ", ".join(commands)
        raise CampaignError(f"{name!r} is not a study that a server runs: expected one of {known}")
    return commands[name]


def _parsed(name: str, arguments: list[str]) -> Any:
    try:
        return _command(name).make_context(name, list(arguments))
    except WRONG as error:
        raise CampaignError(f"the study {name}: {error.format_message()}") from error
