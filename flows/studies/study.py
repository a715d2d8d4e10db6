"""A study: one definition from which its command, its Python verb and its Prefect flow derive.

A study is a function of its context and its request, and returns its result:

    @study(ModelOptions)
    def reduce(on: StudyContext, request: ReductionRequest, out: Out = None) -> StudyResult:

Its parameters are the fields of the options, which open the context, the fields of the request and
the other arguments of the function, each described once: `Annotated[TYPE, typer.Option(...)]`. The
function may also take the options themselves. Parameters travel as JSON: paths are absolute texts,
several values are a list.

Nothing heavy is imported here, because the command line reads these definitions for its help.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, is_dataclass
from functools import cached_property, reduce
from operator import or_
from os import PathLike
from pathlib import Path
from types import UnionType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from typer import Argument, Option
from typer.models import ArgumentInfo, OptionInfo

from modetune.core.errors import CampaignError
from modetune.core.near_names import suggestion
from modetune.core.storage.files import check_writable
from modetune.core.updating.verdict import FailOn
from modetune.flows.studies.result import StudyResult, near

if TYPE_CHECKING:
    from modetune.flows.campaign.campaign import Campaign
    from modetune.flows.updating.forecast import Progress

T = TypeVar("T")
REQUIRED = inspect.Parameter.empty
#: Which model of a record.
ModelState = Literal["updated", "initial"]
#: Marks an option whose text is either words or the name of a file.
FILE_OR_WORDS = "file or words"


def is_file(text: str) -> bool:
    """Return whether a text names a file; a list of words may be too long for a name."""
    try:
        return Path(text).is_file()
    except OSError:
        return False


def split_files(text: str) -> tuple[Path, ...]:
    """The files of a text: one, or several with commas between them; none of an empty text."""
    if "," not in text or Path(text).exists():
        return (Path(text),) if text else ()
    return tuple(Path(part.strip()) for part in text.split(","))


CampaignPath = Annotated[Path, Argument(help="Campaign file (YAML).")]
ModelPath = Annotated[Path, Argument(help="Campaign file (YAML), or a deck.")]
TestFiles = Annotated[
    tuple[Path, ...],
    Argument(
        help="Test instead of the campaign's own; separate several files of one test by commas."
    ),
    split_files,
]
SolverChoice = Annotated[
    str | None,
    Option(
        "--solver",
        help="Solver of a deck: calculix, nastran, mystran or matrices; default: the first "
        "installed one that reads it.",
    ),
]
UnitsChoice = Annotated[
    str | None,
    Option(
        "--units",
        help="Units of a deck: m-kg-s, m-t-s, mm-t-s, mm-kg-s, mm-g-s, cm-g-s, in-slinch-s or "
        "ft-slug-s; default: stated by the deck or inferred from its materials, and reported.",
    ),
]
SubcaseChoice = Annotated[
    int | None,
    Option("--subcase", min=1, help="Subcase of a Nastran deck that gives the modes."),
]
StepChoice = Annotated[
    int | None,
    Option(
        "--step",
        min=1,
        help="Step of a CalculiX deck that gives the modes; default: the last with *FREQUENCY.",
    ),
]
Settings = Annotated[
    list[str] | None,
    Option("--set", help="KEY.KEY=VALUE, overrides the campaign file; may be repeated."),
]
At = Annotated[
    list[str] | None,
    Option(help="NAME=VALUE of a parameter, relative to the deck; may be repeated."),
]
Runs = Annotated[Path, Option(help="Folder for run folders.")]
FailOnOption = Annotated[
    FailOn | None,
    Option(
        "--fail-on",
        help="Verdicts that end it with exit code 6: not-trusted, doubt (any but trusted) or "
        "never; or change: a changed structure ends an update with exit code 7; default: "
        "`run.fail_on`.",
    ),
]
Figures = Annotated[Path | None, Option(help="Folder for figures (PNG).")]
Page = Annotated[Path | None, Option(help="One HTML page with tables and charts (.html).")]


@dataclass(frozen=True)
class StudyContext:
    """The campaign, the parameter values, the folder and the progress of a study.

    name: the campaign's, or that of a comparison. values: the parameters', by `at`. folder: the
    campaign's run folder. charted: whether charts are wanted. loaded: None where a study loads
    its campaigns itself. scheduled: whether a server started the run. run_study: runs another study
    as part of this one, by its name, parameters and progress; a subflow where this one is a flow.
    """

    name: str
    progress: Progress
    loaded: Campaign | None = None
    values: Mapping[str, float] = field(default_factory=dict)
    folder: Path = Path()
    charted: bool = False
    scheduled: bool = False
    run_study: Callable[[str, Mapping[str, Any], Progress], StudyResult] | None = None

    @property
    def campaign(self) -> Campaign:
        """Return the campaign of the study."""
        assert self.loaded is not None
        return self.loaded

    def working(self, text: str) -> None:
        """Report what is being computed."""
        self.progress.working(text)


@dataclass(frozen=True)
class StudyOptions:
    """Options of all studies. A page and figures are written where options have these fields."""

    settings: Settings = field(default=None, kw_only=True)

    def open(self, progress: Progress, campaign: Campaign | None) -> StudyContext:
        """Load and check the context of the study.

        campaign: one that Python has loaded already. Raises CampaignError, ModelError,
        StorageUnavailable.
        """
        raise NotImplementedError

    @property
    def solves(self) -> bool:
        """Whether a solver may run."""
        return True


@dataclass(frozen=True)
class CampaignOptions(StudyOptions):
    """Options of studies of a campaign."""

    campaign_file: CampaignPath

    def open(self, progress: Progress, campaign: Campaign | None) -> StudyContext:
        from modetune.flows.report.page import check_page

        page, figures = places(self)
        check_page(page)
        campaign = campaign or self.load()
        folder = self.folder(campaign)
        return StudyContext(
            campaign.name, progress, campaign, folder=folder, charted=bool(page or figures)
        )

    def load(self) -> Campaign:
        """Load the campaign. Raises CampaignError."""
        from modetune.flows.campaign.campaign import load_campaign

        return load_campaign(self.campaign_file, self.settings or [])

    def folder(self, campaign: Campaign) -> Path:
        """The folder that the study writes into. Raises StorageUnavailable if it cannot."""
        return Path()


@dataclass(frozen=True)
class RunOptions(CampaignOptions):
    """Options of studies that write a record to the campaign's run folder."""

    figures: Figures = None
    page: Page = None
    runs: Runs = Path("runs")

    def folder(self, campaign: Campaign) -> Path:
        folder = self.runs / campaign.name
        check_writable(folder, "name another place for run folders with --runs")
        return folder


@dataclass(frozen=True)
class DeckOptions(StudyOptions):
    """Options of studies of a campaign's model or a deck."""

    model: ModelPath
    at: At = None
    solver: SolverChoice = None
    units: UnitsChoice = None
    subcase: SubcaseChoice = None
    step: StepChoice = None

    def open(self, progress: Progress, campaign: Campaign | None) -> StudyContext:
        from modetune.flows.campaign.sketch import open_model
        from modetune.flows.report.page import check_page
        from modetune.flows.updating.mode_source import parse_values

        check_page(places(self)[0])
        changed = with_model(self.settings, self.solver, self.units, self.subcase, self.step)
        campaign = campaign or open_model(self.model, changed, self.test_files)
        values = parse_values(campaign, self.at or [])
        return StudyContext(campaign.name, progress, campaign, values)

    @property
    def test_files(self) -> tuple[Path, ...]:
        """Files of a test instead of the campaign's own."""
        return ()


@dataclass(frozen=True)
class ModelOptions(DeckOptions):
    """Options of studies of a campaign's model or a deck with its test."""

    test: TestFiles = ()
    page: Page = None

    @property
    def test_files(self) -> tuple[Path, ...]:
        return self.test


def places(options: StudyOptions) -> tuple[Path | None, Path | None]:
    """The page and the folder of figures that options name."""
    return getattr(options, "page", None), getattr(options, "figures", None)


def with_model(
    settings: list[str] | None,
    solver: str | None,
    units: str | None,
    subcase: int | None = None,
    step: int | None = None,
) -> list[str]:
    """Settings with those of `--solver`, `--units`, `--subcase` and `--step`."""
    named = {
        "model.solver": solver,
        "model.units": units,
        "model.subcase": subcase,
        "model.step": step,
    }
    return [*(settings or []), *(f"{key}={value}" for key, value in named.items() if value)]


@dataclass(frozen=True)
class StudyParameter:
    """A parameter of a study.

    kind: its type for the function. default: REQUIRED where there is none. info: its help, its
    bounds and its name on the command line. reader: makes the value from the typed text.
    may_be_file: whether the text may be the name of a file.
    """

    name: str
    kind: Any
    default: Any
    info: ArgumentInfo | OptionInfo
    reader: Callable[[str], Any] | None = None
    may_be_file: bool = False

    @property
    def is_argument(self) -> bool:
        """Whether it is a positional argument on the command line."""
        return isinstance(self.info, ArgumentInfo)

    @property
    def is_path(self) -> bool:
        return _has(Path, self.kind)

    @property
    def choices(self) -> tuple[Any, ...]:
        """The choices; none if any value of the type is valid."""
        literals = (one for one in _members(self.kind) if get_origin(one) is Literal)
        return next(map(get_args, literals), ())

    @cached_property
    def json_kind(self) -> Any:
        """Its type with a value of JSON: texts for paths, lists for several values."""
        members = [_json_kind(one) for one in _members(self.kind)]
        lists = [one for one in members if get_origin(one) is list]
        return lists[0] if lists else reduce(or_, members)

    @cached_property
    def signature(self) -> inspect.Parameter:
        """The parameter for Prefect and pydantic: its type in JSON, its help and its bounds."""
        from pydantic import Field

        bounds: dict[str, Any] = {"ge": self.info.min, "le": self.info.max}
        if _has(float, self.kind):
            bounds["allow_inf_nan"] = False
        given = {name: value for name, value in bounds.items() if value is not None}
        kind = self.json_kind
        return inspect.Parameter(
            self.name,
            inspect.Parameter.POSITIONAL_OR_KEYWORD,
            default=REQUIRED if self.default is REQUIRED else self.json_value(self.default),
            annotation=Annotated[kind, Field(description=self.info.help, **given)],
        )

    def of_one(self, value: Any) -> Any:
        """A single value, as a list where the parameter takes several."""
        return [value] if get_origin(self.json_kind) is list else value

    def json_value(self, value: Any) -> Any:
        """A value as JSON has it."""
        if get_origin(self.json_kind) is list:
            value = [] if value is None else value
            return [_plain(one) for one in value] if isinstance(value, _SEVERAL) else _plain(value)
        return _plain(value)

    def problem(self, value: Any) -> str:
        """Return why a value is refused, in a sentence; empty if it is valid."""
        from pydantic import TypeAdapter, ValidationError

        try:
            TypeAdapter(self.signature.annotation).validate_python(value, strict=True)
        except ValidationError:
            return f"{self.name} {value!r}: expected {self._expected()}"
        return ""

    def absolute(self, value: Any) -> Any:
        """A value with the paths in it absolute."""
        if isinstance(value, list):
            return [self.absolute(one) for one in value]
        if value is not None and (self.is_path or (self.may_be_file and is_file(value))):
            return str(Path(value).absolute())
        return value

    def value(self, plain: Any) -> Any:
        """The function's value of one of JSON."""
        kind = next((one for one in _members(self.kind) if one is not type(None)), None)
        if plain is None:
            return None
        if get_origin(kind) in (list, tuple):
            values = [Path(one) if get_args(kind)[0] is Path else one for one in plain]
            return tuple(values) if get_origin(kind) is tuple else values
        return Path(plain) if kind is Path else plain

    @property
    def option(self) -> str:
        """Its option on the command line; typer keeps an explicit name as the first default."""
        names = (self.info.default, *(self.info.param_decls or ()))
        named = (name for name in names if isinstance(name, str) and name.startswith("--"))
        return next(named, f"--{self.name.replace('_', '-')}")

    def words(self, value: Any) -> list[str]:
        """Return the words of the command line that give a checked value; none for the default.

        Paths are always given, because their defaults depend on the current folder.
        """
        given = self.is_path or value != self.json_value(self.default)
        if not given or value in (None, []):
            return []
        if isinstance(value, bool):
            return [self.option]
        if not isinstance(value, list):
            texts = [str(value)]
        elif self.reader is None:
            texts = [str(one) for one in value]
        else:
            texts = [",".join(map(str, value))]
        return texts if self.is_argument else [word for one in texts for word in (self.option, one)]

    def _expected(self) -> str:
        if self.choices:
            return f"one of {', '.join(map(str, self.choices))}"
        several = get_origin(self.json_kind) is list
        kinds = get_args(self.json_kind) if several else _members(self.json_kind)
        one, more = next(_WORDS[kind] for kind in kinds if kind in _WORDS)
        low, high = self.info.min, self.info.max
        bounds = "" if low is None else f" from {low:g}"
        bounds += "" if high is None else f" to {high:g}"
        return f"a list of {more}" if several else f"{one}{bounds}"


#: Types of JSON in words, of one value and of several.
_WORDS: dict[Any, tuple[str, str]] = {
    bool: ("true or false", "true or false"),
    int: ("a whole number", "whole numbers"),
    float: ("a number", "numbers"),
    str: ("a text", "texts"),
}
_SEVERAL = (list, tuple)


def _members(kind: Any) -> tuple[Any, ...]:
    """The types of a union; a type alone otherwise."""
    return get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)


def _has(wanted: type, kind: Any) -> bool:
    return wanted is kind or any(_has(wanted, one) for one in get_args(kind))


def _json_kind(kind: Any) -> Any:
    if get_origin(kind) in _SEVERAL:
        return list[_json_kind(get_args(kind)[0])]  # type: ignore[misc]  # a type made at run time
    return str if kind is Path else kind


def _plain(value: Any) -> Any:
    """A value without types that JSON lacks: paths, numbers and arrays of numpy."""
    if hasattr(value, "tolist"):
        return value.tolist()
    return str(value) if isinstance(value, PathLike) else value


def _parameter(name: str, hint: Any, default: Any) -> StudyParameter:
    kind, info, *notes = get_args(hint)
    reader = next((note for note in notes if callable(note)), None)
    return StudyParameter(name, kind, default, info, reader, FILE_OR_WORDS in notes)


def _fields(kind: type) -> list[StudyParameter]:
    """The fields of options or of a request."""
    hints = get_type_hints(kind, include_extras=True)
    items = inspect.signature(kind).parameters.values()
    return [_parameter(item.name, hints[item.name], item.default) for item in items]


@dataclass(frozen=True)
class Study:
    """A study: its name, its function, and the options that open its context."""

    name: str
    function: Callable[..., StudyResult]
    options: type[StudyOptions]

    @property
    def help(self) -> str:
        """The description of the study, in paragraphs."""
        return inspect.cleandoc(self.function.__doc__ or "")

    @cached_property
    def fields(self) -> tuple[StudyParameter, ...]:
        """All parameters in the order of the command line: arguments, own options, shared ones."""
        shared = _fields(self.options)
        own: list[StudyParameter] = []
        for name, (hint, default) in self._arguments.items():
            if not _is_dataclass(hint):
                own.append(_parameter(name, hint, default))
            elif hint is not self.options:
                own += _fields(hint)
        arguments = [item for item in (*shared, *own) if item.is_argument]
        return (*arguments, *(item for item in (*own, *shared) if not item.is_argument))

    @property
    def parameters(self) -> list[inspect.Parameter]:
        """Parameters of its flow: JSON's types with help; files, settings and runs come first."""

        def place(item: StudyParameter) -> int:
            return 0 if item.is_argument else {"settings": 1, "runs": 2}.get(item.name, 3)

        return [item.signature for item in sorted(self.fields, key=place)]

    @property
    def path_parameters(self) -> tuple[str, ...]:
        """Names of the parameters that are paths or lists of paths."""
        return tuple(item.name for item in self.fields if item.is_path)

    def paths(self, parameters: Mapping[str, Any]) -> list[Path]:
        """Every file and folder that checked parameters name."""
        found: list[Path] = []
        for item in self.fields:
            value = parameters[item.name]
            values = value if isinstance(value, list) else [value]
            if item.is_path or (item.may_be_file and is_file(value)):
                found += [Path(one) for one in values if one is not None]
        return found

    def checked(self, parameters: Mapping[str, Any]) -> dict[str, Any]:
        """All parameters as JSON: defaults filled in, types checked, paths absolute.

        Raises CampaignError with all problems.
        """
        known = {item.name: item for item in self.fields}
        problems = [
            f"{self.name} has no parameter {name!r}{suggestion(name, known)}"
            for name in parameters
            if name not in known
        ]
        values: dict[str, Any] = {}
        for name, item in known.items():
            given = parameters.get(name, item.default)
            if given is REQUIRED:
                problems.append(f"{self.name}: {name} is missing")
                continue
            value = item.json_value(given)
            if problem := item.problem(value):
                problems.append(f"{self.name}: {problem}")
            else:
                values[name] = item.absolute(value)
        if problems:
            raise CampaignError(problems)
        return values

    def words(self, parameters: Mapping[str, Any]) -> list[str]:
        """Return the words that give its command these parameters, from any folder.

        Raises CampaignError.
        """
        checked = self.checked(parameters)
        return [word for item in self.fields for word in item.words(checked[item.name])]

    def solves(self, parameters: Mapping[str, Any]) -> bool:
        """Whether a solver may run with these parameters. Raises CampaignError."""
        return self._opening(parameters).solves

    def beginning(self, parameters: Mapping[str, Any]) -> str:
        """First progress message: the files to read. Imports nothing heavy."""
        checked = self.checked(parameters)
        arguments = [checked[item.name] for item in self.fields if item.is_argument]
        files = (file for one in arguments for file in (one if isinstance(one, list) else [one]))
        return f"reading {', '.join(str(near(Path(file))) for file in files)}"

    @contextmanager
    def opened(
        self, parameters: Mapping[str, Any], progress: Progress, campaign: Campaign | None = None
    ) -> Iterator[StudyContext]:
        """Load and check the context of the study.

        campaign: one that Python has loaded already. Raises CampaignError, ModelError,
        StorageUnavailable.
        """
        progress.working(self.beginning(parameters))
        yield self._opening(parameters).open(progress, campaign)

    def call(self, on: StudyContext, parameters: Mapping[str, Any]) -> StudyResult:
        """Run the study and write its page and figures. Raises the errors of its function."""
        from modetune.flows.jobs.one_thread import one_thread

        values = self._values(parameters)
        given = {
            name: hint(**_of(hint, values)) if _is_dataclass(hint) else values[name]
            for name, (hint, _) in self._arguments.items()
        }
        if on.loaded is not None:
            on.working(f"{self.name}: {on.name} by {on.campaign.solver_name}")
        page, figures = places(self.options(**_of(self.options, values)))
        with one_thread():
            return self.function(on, **given).drawn((self.name, on.name), page, figures)

    @cached_property
    def _arguments(self) -> dict[str, tuple[Any, Any]]:
        """Return type and default of the function's arguments after the context."""
        hints = get_type_hints(self.function, include_extras=True)
        _, *items = inspect.signature(self.function).parameters.values()
        return {item.name: (hints[item.name], item.default) for item in items}

    def _values(self, parameters: Mapping[str, Any]) -> dict[str, Any]:
        checked = self.checked(parameters)
        return {item.name: item.value(checked[item.name]) for item in self.fields}

    def _opening(self, parameters: Mapping[str, Any]) -> StudyOptions:
        return self.options(**_of(self.options, self._values(parameters)))


def _is_dataclass(hint: Any) -> bool:
    """Whether a type is that of a request or of options."""
    return is_dataclass(hint)


def _of(kind: Any, values: Mapping[str, Any]) -> dict[str, Any]:
    """The values that are fields of options or of a request."""
    return {name: values[name] for name in inspect.signature(kind).parameters}


def study(options: type[StudyOptions]) -> Callable[[Callable[..., StudyResult]], Study]:
    """Return a decorator that makes a study of a function, with options that open its context."""

    def made(function: Callable[..., StudyResult]) -> Study:
        return Study(function.__name__, function, options)

    return made
