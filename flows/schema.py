"""The campaign file's keys: what each means, its unit, its default.

Field names are the campaign's keys; unknown keys are refused. `campaign.py` turns a valid file
into a Campaign.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from modetune.core.estimation import StepForm
from modetune.core.parameters import TARGETS, Quantity, TargetKind
from modetune.flows.execution.site import DaskSection, Engine, SlurmSection, with_site

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Retries = Annotated[int, Field(ge=0, le=10)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
Units = Literal["m-kg-s", "mm-t-s", "in-slinch-s", "ft-slug-s"]
SolverName = Literal["calculix", "nastran", "mystran", "matrices"]
NastranDialect = Literal["msc", "nx"]
Method = Literal["auto", "strain_energy", "semi_analytic", "solver", "finite_difference"]
#: Names the store's folder for all campaigns.
STORE_VARIABLE = "MODETUNE_STORE"
STORE_REMEDY = f"name another store with `store:` in the campaign or {STORE_VARIABLE}"
#: Keys that name what a parameter's quantity belongs to.
TARGET_KEYS: tuple[TargetKind, ...] = ("material", "elset", "property", "element", "part")
#: Names in upper or lower case, or the numbers that Nastran decks use.
Targets = str | int | tuple[str | int, ...]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class GeneratorSection(_Section):
    """A model that modetune makes itself: garteur in solids, or garteur_shell, a Nastran deck."""

    case: Literal["garteur", "garteur_shell"]
    mesh: Literal["coarse", "fine"] = "fine"


class ModelSection(_Section):
    """The finite element model: a deck, or one of modetune's own generators."""

    deck: str | None = None
    generator: GeneratorSection | None = None
    solver: SolverName = "calculix"
    dialect: NastranDialect = "msc"
    units: Units

    @model_validator(mode="after")
    def _one_source(self) -> ModelSection:
        if (self.deck is None) == (self.generator is None):
            raise ValueError("give either `deck` or `generator`")
        if self.generator is not None and self.solver != "calculix":
            solid = self.generator.case == "garteur"
            if solid or self.solver == "matrices":
                raise ValueError(f"the generator writes no deck for {self.solver}")
        return self


class TestSection(_Section):
    """The test: its file, and the numbers of the modes that are used."""

    __test__ = False

    modes: str
    use: tuple[int, ...] | None = Field(default=None, min_length=1)

    @model_validator(mode="after")
    def _different(self) -> TestSection:
        if self.use is not None and len(set(self.use)) != len(self.use):
            raise ValueError("`use` names a mode twice")
        return self


class ParameterSection(_Section):
    """One updating parameter; bounds, deviation and initial are relative to the deck's value."""

    name: Name
    quantity: Quantity
    item: Annotated[int, Field(ge=0)] = 0
    material: Targets | None = None
    elset: Targets | None = None
    property: Targets | None = None
    element: Targets | None = None
    part: Targets | None = None
    bounds: tuple[Positive, Positive] = (0.5, 2.0)
    deviation: Positive = 0.2
    initial: Positive = 1.0

    @model_validator(mode="after")
    def _sound(self) -> ParameterSection:
        given = [key for key in TARGET_KEYS if getattr(self, key) is not None]
        wanted = TARGETS[self.quantity]
        if len(given) != 1 or given[0] not in wanted:
            keys = " or ".join(f"`{key}`" for key in wanted)
            found = f"not {' and '.join(f'`{key}`' for key in given)}" if given else "it has none"
            raise ValueError(f"{self.quantity} needs {keys}; {found}")
        lower, upper = self.bounds
        if lower >= upper:
            raise ValueError(f"bounds: the lower ({lower:g}) must be below the upper ({upper:g})")
        if not lower <= self.initial <= upper:
            raise ValueError(f"initial value {self.initial:g} is outside the bounds")
        return self

    def by(self) -> TargetKind:
        """What the targets name."""
        return next(key for key in TARGET_KEYS if getattr(self, key) is not None)

    def targets(self) -> tuple[str, ...]:
        """The targets' names."""
        chosen = getattr(self, self.by())
        return tuple(map(str, chosen)) if isinstance(chosen, tuple) else (str(chosen),)


class ResidualSection(_Section):
    """What is compared: emphasis of frequencies and shapes, and how exactly they were measured."""

    frequency_weight: NotNegative = 1.0
    shape_weight: NotNegative = 0.0
    frequency_deviation: Positive = 0.002
    shape_deviation: Positive = 0.05


class E1Section(_Section):
    """Agreement that ends updating: relative frequency error, and least MAC."""

    frequency: Positive = 0.01
    mac: Share = 0.9


class UpdateSection(_Section):
    """The updating steps. e2 of 0 computes the sensitivity in every iteration."""

    start: Literal["deck", "last"] = "deck"
    step: StepForm = "regularised"
    regularisation: NotNegative | Literal["l_curve"] = 1.0
    e1: E1Section = E1Section()
    e2: NotNegative = 0.002
    max_iterations: Annotated[int, Field(ge=0, le=1000)] = 20
    step_limit: Positive = 0.2


class SensitivitySection(_Section):
    """How sensitivities are computed, and what is used in between."""

    method: Method = "auto"
    between: Literal["keep", "broyden"] = "broyden"
    difference: Literal["forward", "central"] = "forward"
    step: Annotated[float, Field(gt=0.0, lt=0.5)] = 0.01


class RetriesSection(_Section):
    """How often a job is tried again, by what became of it; a plain number goes for all."""

    stopped: Retries = 2
    timeout: Retries = 1
    no_result: Retries = 1


class RunSection(_Section):
    """How jobs run. parallel 0: as many as there are cores; threads 0: the cores, shared out.

    licences: jobs that may run at the same time on each solver, by its name, over all campaigns
    of the machine.
    """

    parallel: Annotated[int, Field(ge=0, le=1024)] = 0
    threads: Annotated[int, Field(ge=0, le=1024)] = 0
    licences: dict[Name, Annotated[int, Field(ge=1, le=10_000)]] = {}
    retries: RetriesSection = RetriesSection()
    failed_column: Literal["leave_out", "stop"] = "leave_out"
    timeout_s: Positive = 3600.0
    licence_pause_s: Positive = 30.0
    licence_wait_s: Positive = 86400.0
    keep_jobs: bool = False
    engine: Engine = "local"
    slurm: SlurmSection = SlurmSection()
    dask: DaskSection = DaskSection()

    @property
    def here(self) -> bool:
        """Whether jobs run on this machine and share its cores with others."""
        return self.engine == "local" or (self.engine == "dask" and self.dask.here)

    def on_site(self) -> RunSection:
        """With what the site file says beneath. Raises CampaignError, ValidationError."""
        return RunSection.model_validate(with_site(self.model_dump(exclude_unset=True)))

    @field_validator("retries", mode="before")
    @classmethod
    def _one_number_for_all(cls, given: object) -> object:
        if isinstance(given, int) and not isinstance(given, bool):
            return dict.fromkeys(("stopped", "timeout", "no_result"), given)
        return given


class CampaignFile(_Section):
    """A whole campaign file."""

    name: Name
    model: ModelSection
    test: TestSection
    parameters: tuple[ParameterSection, ...] = Field(min_length=1)
    residuals: ResidualSection = ResidualSection()
    update: UpdateSection = UpdateSection()
    sensitivity: SensitivitySection = SensitivitySection()
    run: RunSection = RunSection()
    store: str | None = None

    @model_validator(mode="after")
    def _different(self) -> CampaignFile:
        names = [parameter.name for parameter in self.parameters]
        if len(set(names)) != len(names):
            raise ValueError("two parameters have the same name")
        if self.residuals.frequency_weight == 0.0 and self.residuals.shape_weight == 0.0:
            raise ValueError("residuals: one of the weights must be above zero")
        return self
