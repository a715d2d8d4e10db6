"""Keys of the campaign file: meaning, unit and default of each.

Field names are the campaign's keys; unknown keys are refused. `campaign.py` turns a valid file into
a Campaign. `campaign_schema` gives the keys as a JSON schema, for editors and other programs:
pydantic's schema, and the rules of the validators here (keys that exclude each other, targets of
each quantity). An editor that reads it (VS Code through the first line of a campaign, `#
yaml-language-server: $schema=campaign.schema.json`) completes keys and marks mistakes while the
user types.
"""

from __future__ import annotations

import ast
import inspect
import json
from collections.abc import Iterator
from datetime import date, datetime
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import (
    BeforeValidator,
    Field,
    ValidationError,
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
ModelCheck = Literal["units", "size", "mass", "mesh"]
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


def _sensor_name(value: object) -> str:
    node, _, component = str(value).partition(".")
    if not (node.isdecimal() and (not component or component in COMPONENTS)):
        raise ValueError(f"{value} is not a sensor's name; write node.component (12.z) or a node")
    return str(value)


SensorName = Annotated[str, BeforeValidator(_sensor_name)]
NodeName = Annotated[str, Field(min_length=1)]
Triple = tuple[Finite, Finite, Finite]
Delimiter = Annotated[str, Field(pattern=r"^[^\w\s.:=-]{1,8}$")]


class EditSection(Section):
    """Location of a number in the deck that has no placeholder."""

    parameter: Name
    """Name of the parameter that scales the number."""
    file: str | None = None
    """The file of `inputs` that contains the number; without this key the deck."""
    line: Number | None = None
    """Line of the number, with `field` or `columns`."""
    field: Number | None = None
    """Position of the number among the words of the line, from 1. Commas separate words, or blanks
    if the line has no comma."""
    columns: tuple[Number, Number] | None = None
    """First and last column of the number, for decks with fixed fields."""
    pattern: str | None = None
    """Regular expression with one group, the number; it applies wherever it matches."""
    format: str = ""
    """Format of the number, such as `12.5E`; without it all digits, or in `columns` as many as
    fit."""

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
    """The program of `solver: command`: how modetune starts it, and which files it writes. Paths
    are relative to the deck."""

    run: Annotated[tuple[Word, ...], Field(min_length=1)]
    """Program and arguments as a list, without a shell: `[abaqus, "job={job}", interactive]`.
    modetune replaces {deck}, {job} (the deck without its suffix), {cores}, {folder} and {python} by
    the values of the job."""
    version: Annotated[str, Field(min_length=1)] | Annotated[tuple[Word, ...], Field(min_length=1)]
    """The program's version, or the command line that prints it. The store keeps results of
    different versions apart."""
    name: Name = "command"
    """Name of the program in tables and in `run.licences`."""
    nodes: str
    """File with the nodes of the results: `node,x,y,z` as CSV, a universal file, or HDF5. Figures
    show the lines and faces in it."""
    components: Annotated[
        tuple[Literal["x", "y", "z", "rx", "ry", "rz"], ...], Field(min_length=1)
    ] = ("x", "y", "z")
    """Components of motion that the results contain at each node."""
    results: str | None = None
    """File with frequencies and shapes that the program writes: .csv, .unv, .h5, .op2, .f06, .pch
    or .frd."""
    reader: str | None = None
    """Function that reads the results, instead of `results`: `file.py:function` or
    `package.module:function`."""
    normalisation: Literal["mass", "max", "unknown"] = "mass"
    """How the program scales mode shapes, if the file does not define it."""
    most_modes: Number | None = None
    """Maximum number of modes that the deck gives, if modetune may request more."""
    inputs: tuple[str, ...] = ()
    """Further files that the deck needs; parameters may scale numbers in them too."""
    depends: tuple[Word, ...] = ()
    """Files and folders that the program reads from elsewhere, such as a script's modules. A change
    of their content makes new results; files named in `run` count without this key."""
    environment: tuple[Word, ...] = ()
    """Names of environment variables that change the results. Their values enter the key of the
    store as a digest."""
    delimiters: tuple[Delimiter, Delimiter] = ("{", "}")
    """Characters before and after a placeholder."""
    edits: tuple[EditSection, ...] = ()
    """Locations of numbers without a placeholder."""
    success: tuple[str, ...] = ()
    """Patterns, each of which must match a line of `logs`; otherwise the run has failed."""
    fatal: tuple[str, ...] = ()
    """Patterns of the lines with which the program refuses a deck."""
    logs: tuple[str, ...] = ("solver.log",)
    """Files to search for both kinds of pattern, such as `*.msg`; solver.log has the program's
    output."""
    exit_codes: Annotated[tuple[int, ...], Field(min_length=1)] = (0,)
    """Exit codes of a successful run."""

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
        """Return the program in the adapter's form; metres: the deck's length unit in metres."""
        given = dict(self)
        given |= {key: given[key] or "" for key in ("results", "reader")}
        given["most_modes"] = self.most_modes or 0
        given["components"] = tuple(COMPONENTS.index(name) + 1 for name in self.components)
        given["edits"] = tuple(item.rule() for item in self.edits)
        return CommandSettings(**given, metres=metres)


class SensorSection(Section):
    """How sensors are assigned to nodes of the model."""

    by: Literal["position", "number"] = "position"
    """`position` finds nodes by the test's coordinates; `number` takes the node with the same
    number, as does any test without coordinates."""
    align: Literal["none", "fit"] | None = None
    """`fit` finds rotation and translation, and the scale if no unit defines it; any values given
    here then choose among equally good fits. `none` takes the values given here, and otherwise the
    model's axes. Without this key `match` alone fixes the alignment, and otherwise it is `none`."""
    scale: Annotated[Finite, Field(gt=0.0)] | None = None
    """Model lengths per test length; without it the ratio of the two units."""
    rotation: Triple | tuple[Triple, Triple, Triple] | None = None
    """Rotation from the test's axes to the model's: degrees about the model's x, then y, then z; or
    a matrix of three rows."""
    translation: Triple | None = None
    """Position of the test's origin in the model, in the model's length unit."""
    match: dict[Number, Number | NodeName | Triple] = Field(default={})
    """Landmarks set by hand: test node to model node (of a deck with instances also by name,
    `WING-1.12`), or to a position in the model's axes and
    length unit. Three or more that are not collinear fix the alignment; with `align: fit` fewer are
    enough to choose among fits."""
    tolerance: Annotated[Finite, Field(gt=0.0)] | None = None
    """Maximum distance of a sensor from its node, in the model's length unit; without it 2 % of the
    diagonal of the model's bounding box, or half the mean element edge if that is larger."""
    attach: bool | None = None
    """Whether sensors without a node near them are attached rigidly to the nearest bar or beam:
    `true` at any distance, `false` never. Without this key they are in a model of mostly bars and
    beams, up to 15 % of the diagonal of its bounding box. The solver's results must have
    rotations."""
    unmapped: Literal["refuse", "leave_out"] = "refuse"
    """What to do with sensors that have no node within the tolerance and no bar to be attached to,
    or whose motion is missing from the model's results."""
    reverse: tuple[SensorName, ...] = ()
    """Sensors with the wrong sign, `[202.x]`; a node alone means all its directions. Applied last,
    after `exchange`."""
    exchange: tuple[tuple[SensorName, SensorName], ...] = ()
    """Pairs of sensors that were plugged in for each other, `[[12.x, 14.x]]`."""
    drop: tuple[SensorName, ...] = ()
    """Sensors that failed; the test is read as if it did not have them."""

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
    """Path of the deck, relative to the campaign file; modetune reads its includes too."""
    solver: SolverName | Name = "calculix"
    """The program that runs the deck. `calculix` also runs Nastran decks, by translation; `command`
    runs any program; installed packages may add others."""
    command: CommandSection | None = None
    """The program of `solver: command`."""
    dialect: NastranDialect = "msc"
    """Nastran dialect: MSC or Simcenter (NX)."""
    subcase: Annotated[int, Field(ge=1)] | None = None
    """Number of the subcase of a Nastran deck whose modes the campaign takes, with its SPC, MPC,
    METHOD and other selections. Required where several subcases have different modes."""
    step: Annotated[int, Field(ge=1)] | None = None
    """Number of the *STEP of a CalculiX deck whose *FREQUENCY gives the modes; default: the last
    one with *FREQUENCY."""
    eigensolver: Eigensolver = "auto"
    """What computes the modes during updating: `solver`, the solver itself; `pardiso`, modetune,
    from the matrices that CalculiX or MYSTRAN assembles once, with a solver run at the end;
    `mixed_precision`, the same with single-precision factors, which take half the memory; `auto`,
    whichever should be faster, in single precision if memory requires it."""
    units: Units
    """Consistent units of the deck."""
    rigid_modes: Literal["auto"] | Annotated[int, Field(ge=0, le=1000)] = "auto"
    """Number of rigid-body modes, from free bodies and mechanisms; `auto`: the modes without strain
    energy. modetune refuses a number that the strain energies contradict."""
    checks: tuple[ModelCheck, ...] = ()
    """Doubts about the model that you have examined and accept: `units`, from the speed of sound in
    most of its mass; `size`; `mass`; `mesh`, where ten-node tetrahedra are large for a mode."""

    @model_validator(mode="after")
    def _described(self) -> ModelSection:
        if (self.solver == "command") != (self.command is not None):
            raise ValueError("`solver: command` and the section `command` belong together")
        if self.subcase is not None and self.solver not in ("calculix", "nastran", "mystran"):
            raise ValueError("`subcase` is for Nastran decks")
        if self.step is not None and self.solver != "calculix":
            raise ValueError("`step` is for CalculiX decks on `solver: calculix`")
        return self

    @property
    def program(self) -> str:
        """The solver's name in tables and among licences."""
        return self.command.name if self.command else self.solver


class TestSection(Section):
    """The test: its files, and the numbers of the modes to use."""

    __test__ = False

    modes: str | Annotated[tuple[str, ...], Field(min_length=1)]
    """Path of the measured modes (CSV, universal file, HDF5), relative to the campaign file; or a
    list of the files of one test: modes, geometry, response functions."""
    repeats: tuple[str, ...] = ()
    """Files of repetitions of the test. modetune uses the mean of all, and takes deviations from
    their scatter."""
    environment: dict[Name, Finite] = Field(default={})
    """What else was measured with the test, by name: `{temperature_C: 21.5}`. Rows `environment
    temperature_C, 21.5` of the test's tables give the same; a value here replaces theirs."""
    measured_at: datetime | None = None
    """When the test was measured, for the history of the structure: `2026-11-27T02:00:00Z`, in UTC
    without a zone. A row `measured_at` of the test's tables gives the same; this value replaces it.
    """
    length: LengthUnit | None = None
    """Length unit of the test's coordinates, if its files do not define it."""
    axes: Literal["auto", "rows", "columns"] = "auto"
    """Whether the coordinate systems of a universal file (dataset 2420) have their axes as rows or
    as columns; `auto` decides by the program that wrote the file and by the lines of its
    drawing."""
    sensors: SensorSection = SensorSection()
    """How sensors are assigned to nodes of the model."""
    use: tuple[int, ...] | None = Field(default=None, min_length=1)
    """Numbers of the modes to use; without it all modes that are not held out."""
    hold_out: tuple[int, ...] = ()
    """Numbers of modes that updating does not use; modetune compares them with the model before and
    after."""
    pairs: dict[int, Annotated[int, Field(ge=1)]] = Field(default_factory=dict)
    """Pairs set by hand, `{4: 5}`: the number of a test mode, and that of its elastic mode of the
    initial model, as `check` counts them. Later iterations follow that mode by its computed
    shape."""
    unmatched: Literal["stop", "drop"] = "stop"
    """What to do with a test mode that cannot be paired: stop the run, or drop that mode and
    continue."""

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
    """A configuration of the structure (fuel, payload, boundary conditions), with its own model and
    test; all configurations share the parameters."""

    name: Name
    """Name of the configuration in tables, and of the folder with its updated deck."""
    model: ModelSection
    """The configuration's finite element model."""
    test: TestSection
    """The configuration's test."""
    residuals: ResidualSection | None = None
    """Responses to compare in this configuration, with their deviations; without it the campaign's
    `residuals`."""
    weight: Positive = 1.0
    """Weight of all residuals of the configuration."""
    hold_out: bool = False
    """Hold the configuration out: updating does not use it, and modetune compares it with the model
    before and after."""


class ReportSection(Section):
    """The report, and the shapes that the record keeps for it."""

    page: bool = True
    """Whether `update` writes report.html to its run folder."""
    nodes: Annotated[int, Field(ge=0, le=100_000)] = 4000
    """Maximum number of surface nodes at which the record keeps shapes, in addition to the
    sensors."""


class E1Section(Section):
    """Tolerances of a converged campaign: relative frequency error and minimum MAC."""

    frequency: Positive = 0.01
    """Largest frequency error that e1 accepts [of the measured frequency]"""
    mac: Share = 0.9
    """Smallest MAC that e1 accepts, wherever shapes were measured."""


class UpdateSection(Section):
    """Updating: starting points, steps and tolerances."""

    start: Literal["deck", "last"] = "deck"
    """Start from the deck's values, or from the final values of the previous run."""
    starts: Annotated[int, Field(ge=1, le=1000)] | None = None
    """Number of starting points: the campaign's own and others within the bounds; the best solution
    is the answer. Without this key one, and more if evaluations are cheap."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Seed of the random starting points."""
    step: StepForm = "trust_region"
    """How to compute the step from residual and sensitivity (see the theory)."""
    regularisation: NotNegative | Found = 1.0
    """Factor on the parameters' own weights; `l_curve`, its value at the corner of the L-curve; or
    `discrepancy`, the value that leaves a residual as large as the deviations explain. With
    `trust_region` it applies to the first step. The default with fields is `l_curve`."""
    e1: E1Section = E1Section()
    """Tolerances of a converged campaign."""
    e2: NotNegative = 0.2
    """Change of the residual per parameter up to which an iteration reuses its sensitivity; 0:
    never. The default with `between: keep` is 0.002."""
    confirm: Literal["auto", "modes", "matrices", "later"] = "auto"
    """How updating with stored matrices confirms its final values: `modes`, by a modal job of the
    solver; `matrices`, by matrices that the solver assembles there, whose modes modetune computes
    again, and counts if memory or disk has room: this takes half the time, but omits the solver's
    own eigensolution; `auto`, by matrices if a modal job should take ten seconds or more; `later`,
    not within the update but by `modetune confirm`; until then values are trusted only with
    reservations."""
    max_iterations: Annotated[int, Field(ge=0, le=1000)] = 20
    """Maximum number of steps."""
    step_limit: Positive = 0.2
    """Largest change of a parameter in one step; with `trust_region` in the first step, after which
    the limit grows while steps improve the misfit as predicted [of the deck's value]"""


class SensitivitySection(Section):
    """How to compute sensitivities, and what to use when an iteration computes none."""

    method: Method = "auto"
    """How to compute derivatives; `auto`: the cheapest exact method for each parameter."""
    between: Literal["keep", "broyden"] = "broyden"
    """Sensitivity of an iteration that computes none, within e2: the previous matrix unchanged, or
    with Broyden's correction."""
    difference: Literal["forward", "central"] = "forward"
    """Kind of finite differences: one job per parameter, or two."""
    step: Annotated[float, Field(gt=0.0, lt=0.5)] = 0.01
    """Step size of finite differences [of the parameter's value]"""


class MonitoringSection(Section):
    """How the runs of a campaign are watched for a change of the structure."""

    learning: Annotated[int, Field(ge=6, le=10_000)] = 30
    """Number of runs from which the normal scatter is learned; until then only changes by ten
    repeatability errors or more are reported, and large ones among them."""
    reference: date | None = None
    """Date (UTC) of the first run to learn from, such as the day after a repair; without it the
    first run of the history."""
    structures: Number = 1
    """Number of structures that are watched alike: false alarms are those of all together."""
    false_alarm_rate: Annotated[float, Field(gt=0.0, lt=0.5)] = 1e-3
    """Probability of a false alarm per run, of all structures together."""


class CampaignFile(Section):
    """A whole campaign file."""

    name: Name
    """Name of the campaign and of its run folder, `runs/<name>`."""
    configurations: tuple[ConfigurationSection, ...] = ()
    """Several configurations of one structure, updated together with shared parameters."""
    model: ModelSection = Field(default=None, validate_default=True)
    """The finite element model; required unless there are `configurations`."""
    test: TestSection = Field(default=None, validate_default=True)
    """The test; required unless there are `configurations`."""
    parameters: tuple[ParameterSection, ...] = Field(min_length=1)
    """The parameters that updating may change."""
    residuals: ResidualSection = ResidualSection()
    """Responses to compare, with their weights and deviations."""
    update: UpdateSection = UpdateSection()
    """Updating: starting points, steps and tolerances."""
    sensitivity: SensitivitySection = SensitivitySection()
    """How to compute sensitivities."""
    report: ReportSection = ReportSection()
    """The report, and the shapes that the record keeps for it."""
    run: RunSection = RunSection()
    """How jobs run."""
    monitoring: MonitoringSection = MonitoringSection()
    """How the runs of the campaign are watched for a change of the structure."""
    store: str | None = None
    """Folder of the store; default: MODETUNE_STORE, or `.modetune/store` next to the campaign."""

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
            raise ValueError("with `configurations` give both `model` and `test`, or neither")
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
        for position, item in enumerate(self.parameters):
            names = names_of(item.expression) if item.expression else ()
            unknown = [name for name in names if name not in free]
            if unknown:
                error = ValueError(
                    f"the expression of {item.name} names {', '.join(unknown)}; it may name the "
                    f"free parameters of the campaign: {', '.join(sorted(free)) or 'none'}"
                )
                place = ("parameters", position, "expression")
                raise ValidationError.from_exception_data(
                    "expression",
                    [{"type": "value_error", "loc": place, "input": {}, "ctx": {"error": error}}],
                )
            variables -= set(names)
        variables -= self.variables_of_responses()
        if variables:
            raise ValueError(f"the variable {', '.join(sorted(variables))} is not used")
        if self.parameters and not free:
            raise ValueError("all parameters have expressions; at least one must be free")
        return self

    def variables_of_responses(self) -> set[str]:
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
        """Set defaults for fields, which have hundreds of values: one starting point, and steps
        that are pulled to the initial values."""
        if not any(item.field for item in self.parameters):
            return self
        given = self.update.model_fields_set
        if self.configurations:
            raise ValueError("a field works with one model; leave `configurations` out")
        if "step" in given and self.update.step != "pulled_to_initial":
            raise ValueError(
                "a field has more values than a test can determine and needs `pulled_to_initial`; "
                f"leave out update.step: {self.update.step}"
            )
        found = {"step": "pulled_to_initial", "regularisation": "l_curve", "starts": 1}
        own = {key: value for key, value in found.items() if key not in given}
        return self.model_copy(update={"update": self.update.model_copy(update=own)})


class OpenFile(CampaignFile):
    """A campaign file whose `test` and `parameters` may be missing, for studies that do not need
    them."""

    parameters: tuple[ParameterSection, ...] = ()
    """The parameters that updating may change."""

    @model_validator(mode="before")
    @classmethod
    def _without_test(cls, given: Any) -> Any:
        whole = not isinstance(given, dict) or given.get("configurations") or given.get("test")
        return given if whole else {**given, "test": {"modes": NO_TEST}}


class ModelFile(OpenFile):
    """A campaign file before the test: its `test` is never read; configurations keep theirs."""

    @model_validator(mode="before")
    @classmethod
    def _without_test(cls, given: Any) -> Any:
        whole = not isinstance(given, dict) or given.get("configurations")
        return given if whole else {**given, "test": {"modes": NO_TEST}}


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

    Raises CampaignError if a setting has another form, or its path leads through a value.
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
