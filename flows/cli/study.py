"""A study as a command: options that its kind has in common, what it works on, how it is run.

A study is a function of what was opened for it and of its own options, and gives its end:

    @study(ModelOptions)
    def reduce(on: Opened, method: Annotated[str, typer.Option(help="...")] = "guyan") -> StudyEnd:
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_type_hints

from typer.models import ArgumentInfo

from modetune.core.storage.files import check_writable
from modetune.flows.cli.ending import StudyEnd
from modetune.flows.cli.options import (
    AsJson,
    At,
    CampaignPath,
    Figures,
    ModelPath,
    NoPrefect,
    Page,
    Runs,
    Settings,
    SolverChoice,
    TestPath,
    UnitsChoice,
    begun,
    paged,
    stoppable,
    with_model,
)

if TYPE_CHECKING:
    from modetune.flows.campaign.campaign import Campaign
    from modetune.flows.updating.prefect import Pages


@dataclass(frozen=True)
class Opened:
    """What a study works on, and whom it tells.

    tell: a line for people; values: of parameters, by `--at`; folder: of the campaign's run;
    charted: whether charts are asked for.
    """

    campaign: Campaign
    pages: Pages | None
    tell: Callable[[str], None]
    values: Mapping[str, float] = field(default_factory=dict)
    folder: Path = Path()
    charted: bool = False

    def working(self, text: str) -> None:
        """Say what is being computed, on the terminal and in the log of the pages."""
        self.tell(text)
        if self.pages is not None:
            self.pages.log(text)


@dataclass(frozen=True)
class StudyOptions:
    """What all studies have; a page and figures those that name them."""

    settings: Settings = field(default=None, kw_only=True)
    no_prefect: NoPrefect = field(default=False, kw_only=True)
    as_json: AsJson = field(default=False, kw_only=True)

    def opened(self, name: str) -> AbstractContextManager[Opened]:
        """What they name, for a study of this name. Raises CampaignError, StorageUnavailable."""
        raise NotImplementedError

    @property
    def places(self) -> tuple[Path | None, Path | None]:
        """Of the page and the figures."""
        return getattr(self, "page", None), getattr(self, "figures", None)


@dataclass(frozen=True)
class ModelOptions(StudyOptions):
    """Of studies of a model, a campaign's or a deck's, with its test."""

    model: ModelPath
    test: TestPath = None
    at: At = None
    page: Page = None
    solver: SolverChoice = None
    units: UnitsChoice = None

    @contextmanager
    def opened(self, name: str) -> Iterator[Opened]:
        with begun(f"{name}: reading {self.model}") as tell:
            from modetune.flows.campaign.sketch import looked_at
            from modetune.flows.report.page import check_page
            from modetune.flows.updating.modal_run import parse_values

            check_page(self.page)
            tests = [] if self.test is None else [self.test]
            if self.test is not None and not self.test.exists():
                tests = [Path(part.strip()) for part in str(self.test).split(",")]
            changed = with_model(self.settings, self.solver, self.units)
            campaign = looked_at(self.model, changed, tests)
            values = parse_values(campaign, self.at or [])
            with paged(name, campaign.name, self.no_prefect) as pages:
                yield Opened(campaign, pages, tell, values)


@dataclass(frozen=True)
class CampaignOptions(StudyOptions):
    """Of studies of a campaign."""

    campaign_file: CampaignPath
    figures: Figures = None

    @contextmanager
    def opened(self, name: str) -> Iterator[Opened]:
        page, figures = self.places
        with begun(f"reading {self.campaign_file}") as tell:
            from modetune.flows.campaign.campaign import load_campaign
            from modetune.flows.report.page import check_page

            check_page(page)
            campaign = load_campaign(self.campaign_file, self.settings or [])
            folder = self.folder_of(campaign)
            with paged(name, campaign.name, self.no_prefect) as pages:
                charted = bool(page or figures)
                yield Opened(campaign, pages, tell, folder=folder, charted=charted)

    def folder_of(self, campaign: Campaign) -> Path:
        """The folder that the study writes into. Raises StorageUnavailable where it cannot be."""
        return Path()


@dataclass(frozen=True)
class RunOptions(CampaignOptions):
    """Of studies that leave a record in the campaign's run folder."""

    page: Page = None
    runs: Runs = Path("runs")

    def folder_of(self, campaign: Campaign) -> Path:
        folder = self.runs / campaign.name
        check_writable(folder, "name another place for run folders with --runs")
        return folder


def study(options: type[StudyOptions]) -> Callable[[Callable[..., StudyEnd]], Callable[..., None]]:
    """A study as a command that takes these options beside its own."""

    def command_of(function: Callable[..., StudyEnd]) -> Callable[..., None]:
        _, *own = inspect.signature(function, eval_str=True).parameters.values()
        hints = get_type_hints(options, include_extras=True)
        shared = [
            item.replace(annotation=hints[item.name], kind=item.KEYWORD_ONLY)
            for item in inspect.signature(options).parameters.values()
        ]
        arguments = [p for p in shared if isinstance(get_args(p.annotation)[-1], ArgumentInfo)]
        own = [item.replace(kind=item.KEYWORD_ONLY) for item in own]
        parameters = [*arguments, *own, *(item for item in shared if item not in arguments)]

        @wraps(function)
        def command(**given: Any) -> None:
            asked = options(**{item.name: given.pop(item.name) for item in shared})
            with stoppable(), asked.opened(function.__name__) as on:
                on.working(f"{function.__name__}: {on.campaign.name} by {on.campaign.solver_name}")
                end = function(on, **given)
                files = end.reported((function.__name__, on.campaign.name), on.pages, *asked.places)
            end.tell(files, asked.as_json)

        command.__annotations__ = {item.name: item.annotation for item in parameters}
        command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        return command

    return command_of
