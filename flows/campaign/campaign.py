"""From a campaign file to a Campaign whose every part has been checked.

All problems are collected and reported at once, each with file and line, before any solver runs.
"""

from __future__ import annotations

import dataclasses
import logging
import os
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np
from pydantic import ValidationError

from modetune.adapters.solver import Solver
from modetune.adapters.yaml_file import YamlFile, read_yaml
from modetune.core.algebra.rigid_modes import RigidByHand
from modetune.core.correlation.pairing import PairRules
from modetune.core.errors import CampaignError, ModelError
from modetune.core.expressions import names_of
from modetune.core.machine import usable_cores
from modetune.core.measurement.measurement import Measurement
from modetune.core.modes import Floats, MeasuredModes
from modetune.core.near_names import listed
from modetune.core.parameters import Parameter, ParameterSet, Values, frequency_reach
from modetune.core.storage.store import Store
from modetune.core.surface import display_surface
from modetune.core.updating.criteria import Tolerances
from modetune.core.updating.parameter_fields import Field, prior_precision
from modetune.core.updating.weighting import Weighting, weighting_side_by_side
from modetune.flows.campaign.case import Case, whole_test
from modetune.flows.campaign.configurations import configuration_files
from modetune.flows.campaign.matrix_plan import unsuitable
from modetune.flows.campaign.parameters import targets_of, with_fields
from modetune.flows.campaign.schema import (
    BY_NAME,
    NO_TEST,
    STORE_VARIABLE,
    CampaignFile,
    ModelFile,
    MonitoringSection,
    OpenFile,
    ReportSection,
    SensitivitySection,
    SolverName,
    UpdateSection,
    override,
)
from modetune.flows.campaign.site import RunSection
from modetune.flows.campaign.solvers import Binder, bind_solver, untested_capabilities
from modetune.flows.campaign.test import (
    complex_shapes,
    frfs_on_model,
    held_out_modes,
    map_test,
    pairing_nodes,
    read_test,
    used_modes,
)
from modetune.flows.campaign.units import KILOGRAMS, METRES
from modetune.flows.responses.residuals import UNWEIGHTED, ResidualSection, weighting_of
from modetune.flows.responses.response import TestedModel
from modetune.flows.responses.section import section_problems

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, repr=False)
class Campaign:
    """A campaign that can run: settings checked, models and tests read.

    cases: one, or one for each configuration. begin: parameter values (n_parameters,) to start
    from, instead of the initial ones. fields: parameters with a value for each zone."""

    name: str
    file: Path
    text: str
    cases: tuple[Case, ...]
    parameters: ParameterSet
    residuals: ResidualSection
    tolerances: Tolerances
    update: UpdateSection
    sensitivity: SensitivitySection
    run: RunSection
    store: Store
    report: ReportSection
    settings: tuple[str, ...] = ()
    begin: tuple[float, ...] | None = None
    fields: tuple[Field, ...] = ()
    monitoring: MonitoringSection = dataclasses.field(default_factory=MonitoringSection)

    @property
    def case(self) -> Case:
        """The only case. Raises CampaignError where there are several."""
        if len(self.cases) > 1:
            names = ", ".join(item.name for item in self.cases)
            raise CampaignError(
                f"{self.file}: this command works on one model, and the campaign has several "
                f"configurations ({names}); give it a campaign file with one of them as `model` "
                "and `test`"
            )
        return self.cases[0]

    @property
    def only(self) -> Case | None:
        """The only case; None where there are several, which share no surface and no sensors."""
        return self.cases[0] if len(self.cases) == 1 else None

    @property
    def used(self) -> tuple[Case, ...]:
        """The cases that take part in updating, not only in judging it."""
        return tuple(item for item in self.cases if not item.aside)

    @property
    def test(self) -> MeasuredModes:
        """The modes of all cases that are used."""
        return whole_test(self.cases)

    @property
    def weighting(self) -> Weighting:
        """The weighting of `test`."""
        return weighting_side_by_side([item.weighting for item in self.used])

    def __repr__(self) -> str:
        names = self.parameters.names
        models = ", ".join(
            f"{item.solver.deck.summary.name} on {item.solver.program.name}" for item in self.cases
        )
        return (
            f"Campaign {self.name} ({self.file}): {models}; {len(self.test.numbers)} test modes\n"
            f"parameters: {listed(names, 12)}"
        )

    @property
    def configurations(self) -> tuple[str, ...]:
        """The configuration of each mode of `test`; empty where the campaign has one model."""
        if self.only is not None:
            return ()
        return tuple(item.name for item in self.used for _ in item.test.numbers)

    @property
    def environment(self) -> dict[str, float]:
        """What was measured with the tests, by name, with the configuration's where several."""
        return {
            case.of(name): value
            for case in self.used
            for name, value in case.measurement.environment.items()
        }

    @property
    def measured_at(self) -> float:
        """When the newest of the tests was measured, seconds since 1970; NaN if unknown."""
        known = [case.measurement.measured_at for case in self.used]
        return max((at for at in known if at == at), default=float("nan"))

    @property
    def start(self) -> Floats:
        """Parameter values (n_parameters,) that updating starts from."""
        return self.parameters.initial if self.begin is None else np.array(self.begin)

    def precision(self, theta: Floats) -> Floats:
        """Return the parameters' weights at these values.

        They are reciprocals of variances (n_parameters,), or where there are fields the inverse of
        the covariance (n_parameters, n_parameters)."""
        own = self.parameters
        return prior_precision(self.fields, theta - own.initial, own.standard_deviations)

    @property
    def solver_name(self) -> str:
        """The solvers of all cases."""
        return "+".join(dict.fromkeys(item.solver.program.name for item in self.cases))

    def solver_version(self) -> str:
        """The versions of all cases' solvers. Raises SolverMissing."""
        return ", ".join(dict.fromkeys(item.solver.program.version() for item in self.cases))

    @property
    def parallel(self) -> int:
        """Jobs at the same time."""
        return self.run.parallel or cores()

    @property
    def threads(self) -> int:
        """Threads of each job: by default the machine's cores divided among parallel jobs."""
        return self.run.threads or max(1, cores() // self.parallel)

    def alone(self, case: Case) -> Campaign:
        """Return the campaign of one case alone, with the parameters that it has."""
        own = replace(self, cases=(replace(case, columns=None, weight=1.0, aside=False),))
        if case.columns is None:
            return own
        return replace(
            own,
            parameters=self.parameters.only(case.columns),
            begin=None if self.begin is None else tuple(self.begin[n] for n in case.columns),
        )

    def deck_value(self, parameter: Parameter) -> float:
        """Return a parameter's value in the deck of the first case that has it."""
        own = ((case, self.alone(case).parameters) for case in self.cases)
        case = next(c for c, p in own if parameter in (*p.parameters, *p.dependents))
        return case.solver.deck.deck_value(parameter)

    @property
    def splits(self) -> tuple[str, ...]:
        """Cards that were added to the decks for the elements of parameters, a sentence each."""
        return tuple(
            dict.fromkeys(text for case in self.cases for text in case.solver.deck.splits())
        )

    def write_updated(self, values: Values, folder: Path) -> Path:
        """Write the updated deck and return its path.

        Several cases go to folders named as their configurations; the return value is the folder
        of these."""
        if len(self.cases) == 1:
            return self.case.solver.deck.write_updated(values, folder)
        for item in self.cases:
            own = {name: values[name] for name in self.alone(item).parameters.names}
            item.solver.deck.write_updated(own, folder / item.name)
        return folder


def cores() -> int:
    """Return the number of cores that this process may use."""
    return usable_cores()


def load_campaign(
    path: Path | YamlFile,
    settings: list[str] | None = None,
    form: type[CampaignFile] = CampaignFile,
    solver: Solver | None = None,
    bind: Binder = bind_solver,
) -> Campaign:
    """Read a campaign file, its models and its tests, and check all of it.

    form: which keys are required. solver: already bound to the model, for a campaign without
    parameters. bind: what binds solvers to models. Raises CampaignError with all problems,
    StoreError.
    """
    source = path if isinstance(path, YamlFile) else read_yaml(path, "a campaign")
    file = campaign_form(source, settings, form)
    run = file.run.on_site()
    problems: list[str] = []
    source, file, fields = _with_fields(source, file, problems)
    parameters = file.parameter_set()
    cases = _read_cases(source, file, problems, solver, bind)
    problems += core_problems(source, run, cores()) + licence_problems(source, file)
    if problems:
        raise CampaignError(list(dict.fromkeys(problems)))
    return Campaign(
        name=file.name,
        file=source.path,
        text=source.text,
        cases=tuple(cases),
        parameters=parameters,
        residuals=file.residuals,
        tolerances=Tolerances(file.update.e1.frequency, file.update.e1.mac),
        update=file.update,
        sensitivity=file.sensitivity,
        run=run,
        store=Store(_store_folder(source, file)),
        report=file.report,
        settings=tuple(settings or ()),
        fields=fields,
        monitoring=file.monitoring,
    )


def load_model(path: Path | YamlFile, settings: list[str] | None = None) -> Campaign:
    """Read a campaign file for commands that use only its model, with or without a test.

    A readable test is read, so that modes are those of updating. Raises as `load_campaign`.
    """
    try:
        return load_campaign(path, settings, OpenFile)
    except CampaignError:
        return load_campaign(path, settings, ModelFile)


def campaign_form(
    source: YamlFile, settings: list[str] | None = None, form: type[CampaignFile] = CampaignFile
) -> CampaignFile:
    """Return the sections of a campaign file without reading tests and decks.

    Raises CampaignError with all problems.
    """
    if source.at(("masses",)) is not None and source.at(("model",)) is None:
        raise CampaignError(
            f"{source.path} is a model of masses and springs, not a campaign, which names it as "
            "`model.deck` with `solver: matrices`"
        )
    try:
        file = form.model_validate(override(source, settings or []))
        file.run.on_site()
    except ValidationError as error:
        raise CampaignError(section_problems(error, source, form, "campaign")) from None
    return file


def _with_fields(
    source: YamlFile, file: CampaignFile, problems: list[str]
) -> tuple[YamlFile, CampaignFile, tuple[Field, ...]]:
    """Return the file with a parameter for each zone of its fields, and the fields."""
    if not any(item.field for item in file.parameters):
        return source, file, ()
    base = tuple(item.parameter() for item in file.parameters)
    try:
        solver = bind_solver(file.model, source.path.parent / file.model.deck, base)
    except ModelError:  # reported where the model is read
        return source, file, ()
    source, sections, fields = with_fields(source, file.parameters, solver, problems)
    return source, file.model_copy(update={"parameters": sections}), fields


def _read_cases(
    source: YamlFile,
    file: CampaignFile,
    problems: list[str],
    solver: Solver | None,
    bind: Binder,
) -> list[Case]:
    """Return the campaign's case, or one per configuration, without those that have problems."""
    if not file.configurations:
        case = _read_case(source, file, problems, solver, bind)
        return [] if case is None else [case]
    cases = []
    for item in configuration_files(source, file, problems):
        texts: list[str] = []
        case = _read_case(item.source, item.file, texts, None, bind) if item.columns else None
        problems += texts
        if case is not None:
            section = item.section
            cases.append(
                replace(
                    case,
                    name=section.name,
                    columns=item.columns,
                    weight=section.weight,
                    aside=section.hold_out,
                )
            )
    return cases


def _read_case(
    source: YamlFile,
    file: CampaignFile,
    problems: list[str],
    solver: Solver | None,
    bind: Binder,
) -> Case | None:
    """Return a model with its test; None where there are problems."""
    measurement = read_test(source, file, problems)
    solver = solver or _read_model(source, file, problems, bind)
    mapping, store = None, Store(_store_folder(source, file))
    if measurement is not None and solver is not None:
        residuals = file.residuals.with_default(_compares_shapes(file, measurement, solver))
        file = file.model_copy(update={"residuals": residuals})
        mapping = map_test(source, file, measurement, solver, problems, store)
        problems += method_problems(source, file, solver)
    if problems or measurement is None or solver is None or mapping is None:
        return None
    used, held = used_modes(file, measurement), held_out_modes(file, measurement)
    test = replace(used, modes=used.modes.rows(mapping.rows))
    tolerances = Tolerances(file.update.e1.frequency, file.update.e1.mac)
    given = TestedModel(
        test,
        solver.deck,
        tolerances,
        file.parameter_set(),
        KILOGRAMS[file.model.units],
        METRES[file.model.units],
        *frfs_on_model(source, file, measurement, solver, problems, store),
        measurement.notes,
        mapping.sensors,
        complex_shapes(measurement, test),
        measurement.repeats,
    )
    if not problems:
        problems += file.residuals.problems(source, given, solver)
    if problems:
        return None
    for text in file.residuals.warnings(source, given):
        logger.warning("%s", text)
    parameters, gauged = given.parameters, file.residuals.nodes(solver.deck)
    return Case(
        solver=solver,
        units=file.model.units,
        measurement=measurement,
        test=test,
        mapping=mapping,
        surface=display_surface(solver.deck.mesh(), file.report.nodes),
        nodes=pairing_nodes(test, mapping.sensors, solver, gauged),
        gauged=gauged,
        weighting=weighting_of(file.residuals, measurement, test),
        held_out=replace(held, modes=held.modes.rows(mapping.rows)) if held else None,
        held_out_deviations=(
            weighting_of(file.residuals, measurement, held).frequency_deviations
            if held
            else np.zeros(0)
        ),
        eigensolver=file.model.eigensolver,
        accepted=file.model.checks,
        rules=PairRules(
            by_hand=file.test.pairs,
            drop=file.test.unmatched == "drop",
            reach=frequency_reach(parameters, parameters.initial),
        ),
        compared=file.residuals.responses(given),
        tolerances=tolerances,
    )


def _compares_shapes(file: CampaignFile, measurement: Measurement, solver: Solver) -> bool:
    """Return whether the test has shapes, and step and sensitivity method can use them."""
    method = file.sensitivity.method
    gives = method in ("auto", "finite_difference")
    gives |= method == "semi_analytic" and solver.deck.summary.solid_shapes
    gives |= method == "solver" and solver.program.capabilities.shape_sensitivities
    has = measurement.modes is not None and measurement.modes.has_shapes
    return has and gives and file.update.step not in UNWEIGHTED


def store_of(source: YamlFile) -> Store:
    """Return the store of a campaign file. Raises CampaignError."""
    return Store(_store_folder(source, campaign_form(source)))


def _store_folder(source: YamlFile, file: CampaignFile) -> Path:
    base = source.path.resolve().parent
    if file.store is not None:
        return base / file.store
    named = os.environ.get(STORE_VARIABLE)
    return Path(named) if named else base / ".modetune" / "store"


def _read_model(
    source: YamlFile, file: CampaignFile, problems: list[str], bind: Binder
) -> Solver | None:
    parameters = tuple(item.parameter() for item in file.parameters)
    without = target_problems(source, file)
    if without:
        problems += without
        return None
    deck = source.path.parent / file.model.deck
    remedy = "" if deck.exists() else _written_deck(source, file)
    try:
        solver = bind(file.model, deck, parameters)
    except ModelError as error:
        problems.append(f"{error} (named in {source.where(('model', 'deck'))}){remedy}")
        return None
    for position, parameter in enumerate(parameters):
        place = source.where(("parameters", position))
        named = [p for p in parameters if p.name in names_of(parameter.expression or "0")]
        texts = solver.deck.problems((parameter, *named))
        own = f"parameter {parameter.name}: "
        problems += [f"{place}: {text}" for text in texts if not named or text.startswith(own)]
    if not problems:  # interactions of several parameters
        place = source.where(("parameters",))
        problems += [f"{place}: {text}" for text in solver.deck.problems(parameters)]
    number = file.model.rigid_modes
    if number == "auto":
        return solver
    where = f"{source.where(('model', 'rigid_modes'))}: model.rigid_modes"
    return replace(solver, rigid_modes=RigidByHand(number, where))


def _written_deck(source: YamlFile, file: CampaignFile) -> str:
    """Write the missing deck of an example in a clone, or return what writes it, after a colon."""
    if not source.path.is_file():
        return ""
    from modetune.configs.cases import write_own_decks, writing_command

    with suppress(OSError):
        if write_own_decks(source.path):
            logger.warning("wrote the decks of the example %s", source.path.parent.name)
            return ""
    command = writing_command(source.path, file.model.deck)
    return command and f": {command}"


def core_problems(source: YamlFile, run: RunSection, cores: int) -> list[str]:
    """Return a problem where parallel jobs times their threads exceed the machine's cores."""
    wanted = max(run.parallel, 1) * max(run.threads, 1)
    if wanted <= cores or not run.here:
        return []
    return [
        f"{source.where(('run',))}: run: {max(run.parallel, 1)} jobs of {max(run.threads, 1)} "
        f"threads need {wanted} cores, but this machine has {cores}; reduce `parallel` or "
        "`threads`, or leave them out"
    ]


def target_problems(source: YamlFile, file: CampaignFile) -> list[str]:
    """Return a problem for each parameter without a target, where the solver needs one."""
    if file.model.solver not in get_args(SolverName) or file.model.solver in BY_NAME:
        return []
    return [
        f"{source.where(('parameters', place))}: parameters.{place}: {item.quantity} needs "
        f"{targets_of(item.quantity)}"
        for place, item in enumerate(file.parameters)
        if item.by() == "placeholder" and item.quantity != "variable"
    ]


def licence_problems(source: YamlFile, file: CampaignFile) -> list[str]:
    """Return a problem for licences that no solver has, which would limit nothing."""
    models = [item.model for item in file.configurations] + ([file.model] if file.model else [])
    known = [*get_args(SolverName), *(model.program for model in models)]
    unknown = sorted(set(file.run.licences) - set(known))
    if not unknown:
        return []
    return [
        f"{source.where(('run', 'licences'))}: run.licences has the unknown name "
        f"{', '.join(unknown)}; expected solvers: {', '.join(dict.fromkeys(known))}"
    ]


def method_problems(source: YamlFile, file: CampaignFile, solver: Solver) -> list[str]:
    """Return why the campaign's sensitivity method or eigensolver is unavailable."""
    method, has = file.sensitivity.method, solver.program.capabilities
    shapes = file.residuals.shape_changes
    place = source.where(("sensitivity", "method"))
    offered = {
        "strain_energy": has.strain_energies,
        "semi_analytic": solver.offers.matrices,
        "solver": has.shape_sensitivities if shapes else has.frequency_sensitivities,
    }
    if not offered.get(method, True):
        why = untested_capabilities(solver) if method == "semi_analytic" and has.matrices else ""
        text = f"{solver.program.name} has no {method} sensitivities for this campaign"
        return [f"{place}: {why or text}; use `auto`"]
    if file.model.eigensolver == "solver" and file.update.confirm == "matrices":
        where = source.where(("update", "confirm"))
        return [
            f"{where}: `update.confirm: matrices` needs modes from matrices, but "
            "`model.eigensolver: solver` uses solver runs; leave one of the two out"
        ]
    if file.model.eigensolver not in ("auto", "solver"):
        where = f"{source.where(('model', 'eigensolver'))}: eigensolver {file.model.eigensolver}"
        reason = (
            "without a test modes come from solver runs"
            if file.test.modes == NO_TEST
            else unsuitable(solver, file.parameter_set().parameters, method)
        )
        if reason is not None:
            return [f"{where}: {reason}; use `auto` or solver"]
    if method == "semi_analytic" and shapes and not solver.deck.summary.solid_shapes:
        return [
            f"{place}: shape sensitivities from matrices need a model of solids without dependent "
            "nodes; use `auto` or finite_difference"
        ]
    if method != "strain_energy":
        return []
    if shapes:
        return [f"{place}: strain energies do not give shape sensitivities; use `auto`"]
    return [
        f"{place}: the stiffness is not proportional to {item.name} "
        f"({solver.deck.preload() or item.quantity}); use `auto`"
        for item in file.parameter_set().parameters
        if not solver.deck.problems((item,)) and not solver.deck.energy_sets(item)
    ]
