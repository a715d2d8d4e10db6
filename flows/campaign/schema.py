"""The campaign file's keys: what each means, its unit, its default.

Field names are the campaign's keys; unknown keys are refused. `campaign.py` turns a valid file
into a Campaign. `campaign_schema` gives the keys as a JSON schema, for editors and other programs:
what pydantic derives, and the rules that only validators here know (which keys exclude each other,
which targets belong to which quantity). An editor that reads it (VS Code through the first line of
a campaign, `# yaml-language-server: $schema=campaign.schema.json`) completes keys and shows
mistakes while the user types.
"""

from __future__ import annotations

import ast
import inspect
import json
from collections.abc import Iterator
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import (
    Field,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticKnownError

from modetune.adapters.command.settings import CommandSettings, NumberRule
from modetune.adapters.yaml_file import YamlFile
from modetune.core.errors import CampaignError
from modetune.core.expressions import names_of
from modetune.core.modes import COMPONENTS, Floats
from modetune.core.parameters import QUANTITIES, ParameterSet
from modetune.core.updating.parameter_steps import Found, StepForm
from modetune.flows.campaign.parameters import TARGET_KEYS, ParameterSection
from modetune.flows.campaign.site import RunSection, Word
from modetune.flows.campaign.units import LengthUnit, Units
from modetune.flows.responses.residuals import ResidualSection
from modetune.flows.responses.section import Finite, Name, NotNegative, Positive, Section, Share

#: e2 where old sensitivities are kept as they are, without a correction for changed values.
KEPT_E2 = 0.002

SolverName = Literal["calculix", "nastran", "mystran", "matrices", "command"]
#: Solvers that take parameters by their names, without a target.
BY_NAME = ("command",)
NastranDialect = Literal["msc", "nx"]
Eigensolver = Literal["auto", "solver", "pardiso", "mixed_precision"]
ModelCheck = Literal["units", "size", "mass"]
Method = Literal["auto", "strain_energy", "semi_analytic", "solver", "finite_difference"]
#: Names the store's folder for all campaigns.
STORE_VARIABLE = "MODETUNE_STORE"
STORE_REMEDY = f"name another store with `store:` in the campaign or {STORE_VARIABLE}"
#: The path of the files of a test where there is no test.
NO_TEST = ""
DIALECT = "https://json-schema.org/draft/2020-12/schema"
#: A name, not an address: users keep the file wherever they like.
IDENTIFIER = "urn:modetune:campaign"
Number = Annotated[int, Field(ge=1)]
Triple = tuple[Finite, Finite, Finite]
Delimiter = Annotated[str, Field(pattern=r"^[^\w\s.:=-]{1,8}$")]


class EditSection(Section):
    """Where a number of the deck stands that has no placeholder."""

    parameter: Name
    """The parameter that scales it."""
    file: str | None = None
    """Which of `inputs` it stands in; without it the deck."""
    line: Number | None = None
    """Its line, with `field` or `columns`."""
    field: Number | None = None
    """Which word of the line: between commas, or between blanks where the line has none."""
    columns: tuple[Number, Number] | None = None
    """First and last column, for decks of fixed fields."""
    pattern: str | None = None
    """A regular expression with one group, the number, wherever it matches."""
    format: str = ""
    """How it is written, `12.5E`; without it all digits, in `columns` as many as fit."""

    @model_validator(mode="after")
    def _placed(self) -> EditSection:
        by_line = [key for key in ("field", "columns") if getattr(self, key) is not None]
        if (self.line is None) == (self.pattern is None) or len(by_line) != (self.line is not None):
            raise ValueError("give `line` with `field` or `columns`, or `pattern`")
        if self.columns is not None and self.columns[0] > self.columns[1]:
            raise ValueError("columns: the first must not be behind the last")
        return self

    def rule(self) -> NumberRule:
        """Return the edit in the adapter's form."""
        given = dict(self) | {"line": self.line or 0, "field": self.field or 0}
        given |= {"columns": self.columns or (0, 0), "pattern": self.pattern or ""}
        return NumberRule(form=given.pop("format"), **given)


class CommandSection(Section):
    """The program of `solver: command`: how it is started, and what it leaves. Its files are named
    relative to the deck."""

    run: Annotated[tuple[Word, ...], Field(min_length=1)]
    """Program and arguments, one a word, no shell: `[abaqus, "job={job}", interactive]`. {deck},
    {job} (the deck without its ending), {cores}, {folder} and {python} stand for those of the
    job."""
    version: Annotated[str, Field(min_length=1)] | Annotated[tuple[Word, ...], Field(min_length=1)]
    """The program's version, or the command line that prints it: results of another version are
    other results."""
    name: Name = "command"
    """What the program is called in tables and in `run.licences`."""
    nodes: str
    """File of the nodes that results have: `node,x,y,z` as CSV, a universal file, or HDF5; lines
    and faces in it are drawn."""
    components: Annotated[
        tuple[Literal["x", "y", "z", "rx", "ry", "rz"], ...], Field(min_length=1)
    ] = ("x", "y", "z")
    """Which motions results have at each node."""
    results: str | None = None
    """File that the program leaves with frequencies and shapes: .csv, .unv, .h5, .op2, .f06, .pch
    or .frd."""
    reader: str | None = None
    """In place of `results` a function that reads them, `file.py:function` or
    `package.module:function`."""
    normalisation: Literal["mass", "max", "unknown"] = "mass"
    """How the program scales shapes, where the file does not tell."""
    most_modes: Number | None = None
    """How many modes the deck gives at most, where that is fewer than are asked for."""
    inputs: tuple[str, ...] = ()
    """More files that the deck needs beside it; numbers may stand in them too."""
    delimiters: tuple[Delimiter, Delimiter] = ("{", "}")
    """What stands around placeholders."""
    edits: tuple[EditSection, ...] = ()
    """Where numbers without a placeholder stand."""
    success: tuple[str, ...] = ()
    """Patterns that each must be found in a line of `logs`: without them a run has failed."""
    fatal: tuple[str, ...] = ()
    """Patterns of lines by which the program refuses a deck."""
    logs: tuple[str, ...] = ("solver.log",)
    """Files that both are looked for in, `*.msg`; solver.log is what the program prints."""
    exit_codes: Annotated[tuple[int, ...], Field(min_length=1)] = (0,)
    """Codes that the program ends with after a good run."""

    @model_validator(mode="after")
    def _one_form(self) -> CommandSection:
        if (self.results is None) == (self.reader is None):
            raise ValueError("give either `results` or `reader`")
        outside = [
            name
            for name in (*self.inputs, self.results or "")
            if name.startswith("/") or ".." in name.split("/")
        ]
        if outside:
            raise ValueError(f"{outside[0]} is not in the deck's folder, or below it")
        return self

    def settings(self, metres: float) -> CommandSettings:
        """Return the program in the adapter's form; metres: of the deck's unit of length."""
        given = dict(self)
        given |= {key: given[key] or "" for key in ("results", "reader")}
        given["most_modes"] = self.most_modes or 0
        given["components"] = tuple(COMPONENTS.index(name) + 1 for name in self.components)
        given["edits"] = tuple(item.rule() for item in self.edits)
        return CommandSettings(**given, metres=metres)


class SensorSection(Section):
    """How a test's points are laid over the model."""

    by: Literal["position", "number"] = "position"
    """`position` finds nodes by the test's coordinates, `number` takes the node of the same number;
    so does a test without coordinates."""
    align: Literal["none", "fit"] | None = None
    """`fit` finds rotation and translation, and the scale where no unit tells it; those given here
    choose then among fits that cannot be told apart. `none` takes those given here, and else the
    model's axes. Without it: `match` alone fixes the alignment, else `none`."""
    scale: Annotated[Finite, Field(gt=0.0)] | None = None
    """Model lengths a test length; without it from the units of both."""
    rotation: Triple | tuple[Triple, Triple, Triple] | None = None
    """From the test's axes to the model's: degrees about the model's x, then y, then z; or a
    matrix, three rows."""
    translation: Triple | None = None
    """Where the test's origin lies in the model, in the model's length."""
    match: dict[Number, Number | Triple] = Field(default={})
    """Landmarks by hand: test node to model node, or to a place in the model's axes and length.
    Three or more, not on one line, fix the alignment; with `align: fit` fewer do, which choose."""
    tolerance: Annotated[Finite, Field(gt=0.0)] | None = None
    """How far a sensor may be from its node, in the model's length; without it 2 % of the model's
    box diagonal, or half the mean element edge where that is more."""
    unmapped: Literal["refuse", "leave_out"] = "refuse"
    """What is done with sensors that no node is near enough to, or whose motion the model's results
    lack."""

    @model_validator(mode="after")
    def _sound(self) -> SensorSection:
        if self.by == "number" and self.places:
            raise ValueError(
                "sensors by number have no place; leave out align, scale, rotation, translation"
            )
        matrix = self.matrix()
        if np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-3 or np.linalg.det(matrix) < 0.0:
            raise ValueError(
                "`rotation` is not a rotation: its rows must be unit vectors at right angles, its "
                "determinant 1"
            )
        return self

    @property
    def fits(self) -> bool:
        """Whether the alignment has to be found by a fit."""
        given = self.rotation is not None or self.translation is not None
        return self.align == "fit" or (self.align is None and bool(self.match) and not given)

    @property
    def places(self) -> bool:
        """Whether one of these keys needs the test's coordinates."""
        return self.align == "fit" or any(
            item is not None for item in (self.scale, self.rotation, self.translation)
        )

    def matrix(self) -> Floats:
        """Return the rotation (3, 3), the identity by default."""
        if self.rotation is None:
            return np.eye(3)
        given = np.array(self.rotation)
        if given.shape == (3, 3):
            return given
        from scipy.spatial.transform import Rotation  # few campaigns turn their sensors

        return np.asarray(Rotation.from_euler("xyz", given, degrees=True).as_matrix())


class ModelSection(Section):
    """The finite element model."""

    deck: str
    """Path of the deck, relative to the campaign file; its includes are followed."""
    solver: SolverName | Name = "calculix"
    """The program that runs the deck; `calculix` runs Nastran decks too, by translation; `command`
    any program; or one that an installed package brings."""
    command: CommandSection | None = None
    """The program of `solver: command`."""
    dialect: NastranDialect = "msc"
    """Which Nastran: MSC, or Simcenter (NX)."""
    eigensolver: Eigensolver = "auto"
    """Who finds the modes while updating: `solver`, the solver itself; `pardiso`, modetune from the
    matrices that CalculiX or MYSTRAN assembles once, with the solver's own run at the end;
    `mixed_precision`, the same with factors in single precision, which take half the memory;
    `auto`, what is expected to take less, in single precision where memory asks for it."""
    units: Units
    """The consistent units that the deck is written in."""
    rigid_modes: Literal["auto"] | Annotated[int, Field(ge=0, le=1000)] = "auto"
    """How many modes are rigid: bodies that are free, and mechanisms; `auto`: those without strain
    energy. A number that the energies contradict is refused."""
    checks: tuple[ModelCheck, ...] = ()
    """Doubts about the model that are known and accepted: `units`, by the speed of sound in most of
    its mass; `size`; `mass`."""

    @model_validator(mode="after")
    def _described(self) -> ModelSection:
        if (self.solver == "command") != (self.command is not None):
            raise ValueError("`solver: command` and the section `command` belong together")
        return self

    @property
    def program(self) -> str:
        """The solver's name in tables and among licences."""
        return self.command.name if self.command else self.solver


class TestSection(Section):
    """The test: its file, and the numbers of the modes that are used."""

    __test__ = False

    modes: str | Annotated[tuple[str, ...], Field(min_length=1)]
    """Path of the measured modes (CSV, universal file, HDF5), relative to the campaign file; or a
    list of files that belong together: modes, geometry, response functions."""
    repeats: tuple[str, ...] = ()
    """Files of the same test done again: the mean of all is taken, and deviations from how they
    scatter."""
    length: LengthUnit | None = None
    """Unit of the test's coordinates, where its files do not tell."""
    axes: Literal["auto", "rows", "columns"] = "auto"
    """Whether a universal file's coordinate systems (dataset 2420) hold their axes as rows or as
    columns; `auto` by the program that wrote the file and by the lines of its drawing."""
    sensors: SensorSection = SensorSection()
    """How the test's points are laid over the model."""
    use: tuple[int, ...] | None = Field(default=None, min_length=1)
    """Numbers of the modes that are used; without it all of them that are not held out."""
    hold_out: tuple[int, ...] = ()
    """Numbers of modes that are not used, and judged before and after updating."""
    pairs: dict[int, Annotated[int, Field(ge=1)]] = Field(default_factory=dict)
    """Pairs by hand, `{4: 5}`: number of a test mode, and of the elastic mode of the first model
    that answers it, as `check` counts them. Later on it is followed by its computed shape."""
    unmatched: Literal["stop", "drop"] = "stop"
    """A test mode that no computed mode answers: the run stops, or goes on without that mode."""

    @model_validator(mode="after")
    def _different(self) -> TestSection:
        for key, numbers in (("use", self.use or ()), ("hold_out", self.hold_out)):
            if len(set(numbers)) != len(numbers):
                raise ValueError(f"`{key}` names a mode twice")
        both = sorted(set(self.use or ()) & set(self.hold_out))
        if both:
            raise ValueError(
                f"`hold_out` names mode {', '.join(map(str, both))}, which `use` names too; a mode "
                "is used or held out"
            )
        return self


class ConfigurationSection(Section):
    """A configuration of the structure (fuel, payload, boundary conditions): own model and test,
    parameters shared with the others."""

    name: Name
    """What the configuration is called in tables, and its folder of the updated deck."""
    model: ModelSection
    """Its finite element model."""
    test: TestSection
    """What was measured of it."""
    residuals: ResidualSection | None = None
    """What of it is compared, and how exactly it was measured; without it as the campaign says."""
    weight: Positive = 1.0
    """Emphasis of all its residuals."""
    hold_out: bool = False
    """Whether it is not used, and judged before and after updating."""


class ReportSection(Section):
    """What is kept and made to look at."""

    page: bool = True
    """Whether `update` leaves report.html in its run folder."""
    nodes: Annotated[int, Field(ge=0, le=100_000)] = 4000
    """Shapes are kept at the sensors and at no more than so many nodes of the model's surface."""


class E1Section(Section):
    """Agreement that ends updating: relative frequency error, and least MAC."""

    frequency: Positive = 0.01
    """Largest frequency error of a model that agrees [of the measured frequency]"""
    mac: Share = 0.9
    """Least MAC of a model that agrees, wherever shapes were measured."""


class UpdateSection(Section):
    """The updating steps."""

    start: Literal["deck", "last"] = "deck"
    """Begin at the deck's values, or where the run before ended."""
    starts: Annotated[int, Field(ge=1, le=1000)] | None = None
    """Updates from so many starts, the campaign's own and others within the bounds; the best is
    the answer. Without it one, and others beside where sets cost little."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Seed of the starts that are drawn."""
    step: StepForm = "trust_region"
    """How the step follows from residual and sensitivity (see the theory)."""
    regularisation: NotNegative | Found = 1.0
    """Factor on the parameters' own weights; the corner of the L-curve; or `discrepancy`, what
    leaves as much as deviations explain. With `trust_region` the first step's. With fields
    `l_curve` unless given."""
    e1: E1Section = E1Section()
    """Agreement that ends updating."""
    e2: NotNegative = 0.2
    """Change of the residual a parameter, up to which a sensitivity is skipped; 0: never. With
    `between: keep` it is 0.002 unless given."""
    confirm: Literal["auto", "modes", "matrices"] = "auto"
    """What ends updating by stored matrices: `modes`, a modal job of the solver at the final
    values; `matrices`, the matrices that it assembles there, whose modes are found anew and counted
    where memory or disk have room for it: it takes half the time, but the solver's own
    eigensolution is not seen; `auto`, matrices where a modal job is expected to take ten seconds or
    more."""
    max_iterations: Annotated[int, Field(ge=0, le=1000)] = 20
    """Steps that are taken at most."""
    step_limit: Positive = 0.2
    """Largest change of a parameter in one step; with `trust_region` in the first, after which it
    grows as steps keep their promise [of the deck's value]"""


class SensitivitySection(Section):
    """How sensitivities are computed, and what is used in between."""

    method: Method = "auto"
    """How derivatives are computed; `auto`: the cheapest exact way for each parameter."""
    between: Literal["keep", "broyden"] = "broyden"
    """While e2 skips: the old matrix as it is, or with Broyden's correction."""
    difference: Literal["forward", "central"] = "forward"
    """Which finite differences: one job a parameter, or two."""
    step: Annotated[float, Field(gt=0.0, lt=0.5)] = 0.01
    """Step of finite differences [of the parameter's value]"""


class CampaignFile(Section):
    """A whole campaign file."""

    name: Name
    """Names the run folder, `runs/<name>`."""
    configurations: tuple[ConfigurationSection, ...] = ()
    """Several configurations of one structure, updated at once with shared parameters."""
    model: ModelSection = Field(default=None, validate_default=True)
    """The finite element model; needed unless there are `configurations`."""
    test: TestSection = Field(default=None, validate_default=True)
    """What was measured; needed unless there are `configurations`."""
    parameters: tuple[ParameterSection, ...] = Field(min_length=1)
    """What of the model may change."""
    residuals: ResidualSection = ResidualSection()
    """What is compared, and how exactly it was measured."""
    update: UpdateSection = UpdateSection()
    """The updating steps."""
    sensitivity: SensitivitySection = SensitivitySection()
    """How derivatives are computed."""
    report: ReportSection = ReportSection()
    """What is kept and made to look at."""
    run: RunSection = RunSection()
    """How jobs run."""
    store: str | None = None
    """Folder of results; else MODETUNE_STORE, or `.modetune/store` beside the campaign."""

    @field_validator("model", "test", mode="wrap")
    @classmethod
    def _needed(
        cls, given: object, validated: ValidatorFunctionWrapHandler, info: ValidationInfo
    ) -> object:
        if given is not None:
            return validated(given)
        if info.data.get("configurations", True):
            return None  # each configuration has its own
        raise PydanticKnownError("missing")

    @model_validator(mode="after")
    def _different(self) -> CampaignFile:
        if (self.model is None) != (self.test is None):
            raise ValueError("beside `configurations` give both `model` and `test`, or neither")
        if not self.configurations and any(p.configurations for p in self.parameters):
            raise ValueError("a parameter names configurations, but the campaign has none")
        names = [parameter.name for parameter in self.parameters]
        if len(set(names)) != len(names):
            raise ValueError("two parameters have the same name")
        return self

    @model_validator(mode="after")
    def _related(self) -> CampaignFile:
        free = {item.name for item in self.parameters if item.expression is None}
        variables = {item.name for item in self.parameters if item.quantity == "variable"}
        for item in self.parameters:
            names = names_of(item.expression) if item.expression else ()
            unknown = [name for name in names if name not in free]
            if unknown:
                raise ValueError(
                    f"the expression of {item.name} names {', '.join(unknown)}; it may name the "
                    f"free parameters of the campaign: {', '.join(sorted(free)) or 'none'}"
                )
            variables -= set(names)
        variables -= self._variables_of_responses()
        if variables:
            raise ValueError(f"nothing names the variable {', '.join(sorted(variables))}")
        if self.parameters and not free:
            raise ValueError("all parameters follow from expressions, none is free")
        return self

    def _variables_of_responses(self) -> set[str]:
        """Return the names of the variables that response types refer to."""
        given = {p.name: (p.values, p.bounds) for p in self.parameters if p.quantity == "variable"}
        sections = (self.residuals, *(item.residuals for item in self.configurations))
        kinds = [kind for item in sections if item is not None for kind in item.kinds.values()]
        for kind in kinds:
            kind.check_variables(given)
        return {name for kind in kinds for name in kind.variables}

    def parameter_set(self) -> ParameterSet:
        """Return the free parameters and those with expressions."""
        found = [item.parameter() for item in self.parameters]
        return ParameterSet(
            tuple(item for item in found if not item.expression),
            tuple(item for item in found if item.expression),
        )

    @model_validator(mode="after")
    def _kept(self) -> CampaignFile:
        if self.sensitivity.between != "keep" or "e2" in self.update.model_fields_set:
            return self
        update = self.update.model_copy(update={"e2": KEPT_E2})
        return self.model_copy(update={"update": update})

    @model_validator(mode="after")
    def _regularised(self) -> CampaignFile:
        """Set defaults for fields, which are hundreds of values: steps from one start are pulled to
        the initial values."""
        if not any(item.field for item in self.parameters):
            return self
        given = self.update.model_fields_set
        if self.configurations:
            raise ValueError("a field is of one model; leave `configurations` out")
        if "step" in given and self.update.step != "pulled_to_initial":
            raise ValueError(
                "a field has more values than a test tells, so its steps are `pulled_to_initial`; "
                f"update.step: {self.update.step} knows nothing of neighbours: leave it out"
            )
        found = {"step": "pulled_to_initial", "regularisation": "l_curve", "starts": 1}
        own = {key: value for key, value in found.items() if key not in given}
        return self.model_copy(update={"update": self.update.model_copy(update=own)})


class OpenFile(CampaignFile):
    """A campaign file whose `test` and `parameters` may be missing: what can be looked at without
    them."""

    parameters: tuple[ParameterSection, ...] = ()
    """What of the model may change."""

    @model_validator(mode="before")
    @classmethod
    def _without_test(cls, given: Any) -> Any:
        whole = not isinstance(given, dict) or given.get("configurations") or given.get("test")
        return given if whole else {**given, "test": {"modes": NO_TEST}}


class ModelFile(OpenFile):
    """The same before there is a test: its test is never read."""

    @model_validator(mode="before")
    @classmethod
    def _without_test(cls, given: Any) -> Any:
        return {**given, "test": {"modes": NO_TEST}} if isinstance(given, dict) else given


def campaign_schema() -> dict[str, Any]:
    """Return the JSON schema of a campaign file, draft 2020-12."""
    schema = CampaignFile.model_json_schema()
    sections = schema["$defs"]
    meanings = {kind.__name__: _meanings(kind) for kind in _kinds(Section)}
    for name, section in ((CampaignFile.__name__, schema), *sections.items()):
        section.pop("title", None)
        for key, told in section.get("properties", {}).items():
            told.pop("title", None)  # only the key's name again
            told["description"] = meanings[name][key]
            section["properties"][key] = dict(sorted(told.items()))
    _add_rules(sections)
    for key in ("model", "test"):
        del schema["properties"][key]["default"]
    schema["anyOf"] = [{"required": ["model", "test"]}, {"required": ["configurations"]}]
    schema["dependentRequired"] = {"model": ["test"], "test": ["model"]}
    return {"$schema": DIALECT, "$id": IDENTIFIER, "title": "modetune campaign", **schema}


def schema_text() -> str:
    """Return the schema as published text."""
    return json.dumps(campaign_schema(), indent=2, ensure_ascii=False) + "\n"


def _kinds(section: type[Section]) -> Iterator[type[Section]]:
    """Return all sections below a section, at any depth."""
    for kind in section.__subclasses__():
        yield kind
        yield from _kinds(kind)


def _meanings(section: type[Section]) -> dict[str, str]:
    """Return the meaning of a section's keys: the docstrings below its fields.

    Pydantic would read them each time a campaign is loaded, which takes a third of the imports'
    time.
    """
    (above,) = section.__bases__
    if above.__name__ == section.__name__:  # extended by `with_types`, without source
        fields = section.model_fields.items()
        return _meanings(above) | {
            key: item.description for key, item in fields if item.description
        }
    (body,) = ast.parse(inspect.getsource(section)).body
    assert isinstance(body, ast.ClassDef)
    told = _meanings(above) if issubclass(above, Section) else {}
    return told | {
        field.target.id: inspect.cleandoc(text.value.value)
        for field, text in pairwise(body.body)
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
        if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant)
        if isinstance(text.value.value, str)
    }


def _add_rules(sections: dict[str, Any]) -> None:
    """Add the rules of the sections' validators."""
    retries = sections["RunSection"]["properties"]["retries"]
    one_number = sections["RetriesSection"]["properties"]["stopped"]
    retries["anyOf"] = [
        {"$ref": retries.pop("$ref")},
        {key: one_number[key] for key in ("type", "minimum", "maximum")},
    ]
    parameter = sections["ParameterSection"]
    none = {"not": {"anyOf": _one_of(TARGET_KEYS)}}  # a placeholder of `solver: command`
    parameter["oneOf"] = [*_one_of(TARGET_KEYS), none]
    parameter["allOf"] = [
        {
            "if": {"properties": {"quantity": {"const": quantity}}, "required": ["quantity"]},
            "then": {"anyOf": [*_one_of(facts.targets), none]},
        }
        for quantity, facts in QUANTITIES.items()
        if facts.targets
    ]


def _one_of(keys: tuple[str, ...]) -> list[dict[str, Any]]:
    return [{"required": [key]} for key in keys]


def override(file: YamlFile, settings: list[str]) -> dict[str, object]:
    """Return the file's data with `key.key=value` settings applied, values read as YAML.

    Raises CampaignError where a setting has another form or leads through a value.
    """
    data = yaml.safe_load(file.text)
    for setting in settings:
        path, separator, text = setting.partition("=")
        *outer, last = path.strip().split(".")
        target = data
        for key in outer:
            target = target.setdefault(key, {}) if isinstance(target, dict) else None
        if not separator or not last or not isinstance(target, dict):
            raise CampaignError(f"--set {setting!r}: expected KEY.KEY=VALUE, e.g. update.e2=0.002")
        try:
            target[last] = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise CampaignError(f"--set {setting!r}: the value is not YAML") from error
    return dict(data)
