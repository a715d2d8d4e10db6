"""A study as a command: options that its kind has in common, what it works on, how it is run.

A study is a function of what was opened for it and of its own options, and gives its end:

    @study(ModelOptions)
    def reduce(on: Opened, asked: ReductionRequest, out: Out = None) -> StudyEnd:

Each field of a request is an option.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, is_dataclass
from functools import wraps
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    TypeVar,
    get_args,
    get_origin,
    get_type_hints,
)

from typer.models import ArgumentInfo

from modetune.core.near_names import named
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

T = TypeVar("T")


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

    @contextmanager
    def opened(self, name: str) -> Iterator[Opened]:
        page, figures = self.places
        with begun(f"reading {self.campaign_file}") as tell:
            from modetune.flows.report.page import check_page

            check_page(page)
            campaign = self.loaded()
            folder = self.folder_of(campaign)
            with paged(name, campaign.name, self.no_prefect) as pages:
                charted = bool(page or figures)
                yield Opened(campaign, pages, tell, folder=folder, charted=charted)

    def loaded(self) -> Campaign:
        """The campaign. Raises CampaignError."""
        from modetune.flows.campaign.campaign import load_campaign

        return load_campaign(self.campaign_file, self.settings or [])

    def folder_of(self, campaign: Campaign) -> Path:
        """The folder that the study writes into. Raises StorageUnavailable where it cannot be."""
        return Path()


@dataclass(frozen=True)
class RunOptions(CampaignOptions):
    """Of studies that leave a record in the campaign's run folder."""

    figures: Figures = None
    page: Page = None
    runs: Runs = Path("runs")

    def folder_of(self, campaign: Campaign) -> Path:
        folder = self.runs / campaign.name
        check_writable(folder, "name another place for run folders with --runs")
        return folder


def study(options: type[StudyOptions]) -> Callable[[Callable[..., StudyEnd]], Callable[..., None]]:
    """A study as a command that takes these options beside its own."""

    def command_of(function: Callable[..., StudyEnd]) -> Callable[..., None]:
        _, *asked = inspect.signature(function, eval_str=True).parameters.values()
        hints = {item.name: item.annotation for item in asked}
        requests = {
            name: hint
            for name, hint in hints.items()
            if isinstance(hint, type) and is_dataclass(hint)
        }
        shared = _fields(options)
        arguments = [p for p in shared if isinstance(get_args(p.annotation)[-1], ArgumentInfo)]
        own = [
            option.replace(kind=option.KEYWORD_ONLY)
            for item in asked
            for option in (_fields(item.annotation) if item.name in requests else [item])
        ]
        parameters = [*arguments, *own, *(item for item in shared if item not in arguments)]

        @wraps(function)
        def command(**given: Any) -> None:
            of = _filled(options, given)
            made = {name: _filled(kind, given) for name, kind in requests.items()}
            with stoppable(), of.opened(function.__name__) as on:
                on.working(f"{function.__name__}: {on.campaign.name} by {on.campaign.solver_name}")
                end = function(on, **made, **given)
                files = end.reported((function.__name__, on.campaign.name), on.pages, *of.places)
            end.tell(files, of.as_json)

        command.__annotations__ = {item.name: item.annotation for item in parameters}
        command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        return command

    return command_of


def _fields(kind: type) -> list[inspect.Parameter]:
    """The fields of options or a request as options: one of a few words is a text, several values
    are a list, or a text where the field names what reads it."""
    made: list[inspect.Parameter] = []
    hints = get_type_hints(kind, include_extras=True)
    for item in inspect.signature(kind).parameters.values():
        of, note, *reader = get_args(hints[item.name])
        default = item.default
        if get_origin(of) is Literal:
            of = str
        elif get_origin(of) is tuple:
            of, default = (str if reader else list[str]) | None, None
        made.append(
            item.replace(annotation=Annotated[of, note], default=default, kind=item.KEYWORD_ONLY)
        )
    return made


def _filled(kind: type[T], given: dict[str, Any]) -> T:
    """Options or a request of what was typed. Raises CampaignError for what none of it means."""
    values = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        of, _, *reader = get_args(hint)
        value = given.pop(name)
        if get_origin(of) is Literal:
            value = named(f"--{name.replace('_', '-')}", value, get_args(of))
        elif get_origin(of) is tuple:
            value = reader[0](value or "") if reader else tuple(value or ())
        values[name] = value
    return kind(**values)
