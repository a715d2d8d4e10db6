"""From a campaign file to a Campaign whose every part has been looked at.

All problems are collected and told at once, each with file and line, before any solver runs.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from modetune.adapters.solver import Solver
from modetune.adapters.yaml_file import YamlFile, read_yaml
from modetune.core.criteria import Tolerances
from modetune.core.errors import CampaignError, ModelError
from modetune.core.held_out import together
from modetune.core.measurement import Measurement
from modetune.core.modes import Floats, MeasuredModes
from modetune.core.parameters import ParameterSet
from modetune.core.residual import Weighting
from modetune.core.sensors import SensorMap
from modetune.core.store import Store
from modetune.core.surface import Surface, display_surface
from modetune.flows.configurations.files import configuration_files, number_problems
from modetune.flows.configurations.joined import (
    JointPart,
    JointSolver,
    joint_test,
    no_sensors,
    no_surface,
)
from modetune.flows.execution.run_section import RunSection
from modetune.flows.refusals import core_problems, licence_problems, method_problems
from modetune.flows.schema import (
    STORE_VARIABLE,
    CampaignFile,
    Eigensolver,
    ReportSection,
    SensitivitySection,
    Units,
    UpdateSection,
)
from modetune.flows.sensors.mapping import Mapping
from modetune.flows.settings import override
from modetune.flows.solvers import bind_solver, model_deck
from modetune.flows.test_side import (
    held_out_modes,
    map_test,
    pairing_nodes,
    read_test,
    used_modes,
)
from modetune.flows.units import unit_problems

#: Elastic modes computed beyond the measured ones, so that a mode that moves up stays in sight.
EXTRA_MODES = 4
RIGID_MODES = 6


@dataclass(frozen=True, slots=True)
class Campaign:
    """A campaign that can run: settings checked, model and test read.

    test: the modes that are used; held_out: those that are only judged by. configurations: where
    there are several, each with a model and a test of its own; then `test` has the modes of all
    that are used, and `solver` stands for all and runs nothing.
    """

    name: str
    file: Path
    text: str
    solver: Solver
    units: Units
    parameters: ParameterSet
    measurement: Measurement
    test: MeasuredModes
    mapping: Mapping
    surface: Surface
    weighting: Weighting
    tolerances: Tolerances
    update: UpdateSection
    sensitivity: SensitivitySection
    run: RunSection
    store: Store
    report: ReportSection
    nodes: tuple[int, ...]
    settings: tuple[str, ...] = ()
    begin: tuple[float, ...] | None = None
    held_out: MeasuredModes | None = None
    configurations: tuple[Configuration, ...] = ()
    eigensolver: Eigensolver = "solver"

    @property
    def start(self) -> Floats:
        """Parameters (n_parameters,) that updating starts from."""
        return self.parameters.initial if self.begin is None else np.array(self.begin)

    @property
    def sensors(self) -> SensorMap:
        """How the test's sensors see the model."""
        return self.mapping.sensors

    @property
    def result_nodes(self) -> tuple[int, ...]:
        """Nodes at which the modes of the whole model are wanted: for pairing, and to look at."""
        return tuple(sorted({*self.nodes, *self.surface.nodes.tolist()}))

    @property
    def n_modes(self) -> int:
        """Modes asked of the solver: the measured ones, rigid ones and some to spare."""
        return len(self.measured.numbers) + EXTRA_MODES + RIGID_MODES

    @property
    def measured(self) -> MeasuredModes:
        """All measured modes that count: used ones, then those that are held out."""
        return self.test if self.held_out is None else together(self.test, self.held_out)

    @property
    def parallel(self) -> int:
        """Jobs at the same time."""
        return self.run.parallel or cores()

    @property
    def threads(self) -> int:
        """Threads of each job: the machine's cores shared out among parallel jobs."""
        return self.run.threads or max(1, cores() // self.parallel)


@dataclass(frozen=True, slots=True)
class Configuration:
    """One of several configurations of a structure.

    place: from 1, in the order of the file; campaign: the one it would make alone, with those of
    the whole campaign's parameters that it has; columns: their positions among all; weight: of its
    residuals; hold_out: whether it is only judged by.
    """

    name: str
    place: int
    campaign: Campaign
    columns: tuple[int, ...]
    weight: float = 1.0
    hold_out: bool = False


def cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0))


def load_campaign(
    path: Path, settings: list[str] | None = None, form: type[CampaignFile] = CampaignFile
) -> Campaign:
    """Read a campaign file of a form. Raises CampaignError with all problems; StoreError."""
    source = read_yaml(path, "a campaign")
    try:
        file = form.model_validate(override(source, settings or []))
        run = file.run.on_site()
    except ValidationError as error:
        raise CampaignError([_problem(source, item) for item in error.errors()]) from None
    problems: list[str] = []
    load = _load_joint if file.configurations else _load_one
    campaign = load(source, file, run, problems)
    problems += core_problems(source, run, cores()) + licence_problems(source, file.run)
    if problems or campaign is None:
        raise CampaignError(list(dict.fromkeys(problems)))
    return replace(campaign, settings=tuple(settings or ()))


def _load_one(
    source: YamlFile, file: CampaignFile, run: RunSection, problems: list[str]
) -> Campaign | None:
    """A campaign of one model and one test; nothing where there are problems."""
    measurement = read_test(source, file, problems)
    parameters = ParameterSet(tuple(item.parameter() for item in file.parameters))
    store = Store(_store_folder(source, file))
    solver = _read_model(source, file, store, parameters, problems)
    mapping = None
    if measurement is not None and solver is not None:
        mapping = map_test(source, file, measurement, solver, problems)
        problems += method_problems(source, file, solver)
    if problems or measurement is None or solver is None or mapping is None:
        return None
    used, held = used_modes(file, measurement), held_out_modes(file, measurement)
    test = replace(used, modes=used.modes.rows(mapping.rows))
    return Campaign(
        name=file.name,
        file=source.path,
        text=source.text,
        solver=solver,
        units=file.model.units,
        parameters=parameters,
        measurement=measurement,
        test=test,
        mapping=mapping,
        surface=display_surface(solver.mesh(), file.report.nodes),
        weighting=Weighting(
            file.residuals.frequency_deviation,
            file.residuals.shape_deviation,
            file.residuals.frequency_weight,
            file.residuals.shape_weight,
        ),
        tolerances=Tolerances(file.update.e1.frequency, file.update.e1.mac),
        update=file.update,
        sensitivity=file.sensitivity,
        run=run,
        store=store,
        report=file.report,
        nodes=pairing_nodes(test, mapping.sensors, solver),
        held_out=replace(held, modes=held.modes.rows(mapping.rows)) if held else None,
        eigensolver=file.model.eigensolver,
    )


def _load_joint(
    source: YamlFile, file: CampaignFile, run: RunSection, problems: list[str]
) -> Campaign | None:
    """A campaign of several configurations; nothing where there are problems."""
    made = _store_folder(source, file).parent
    configurations = []
    for place, item in enumerate(configuration_files(source, file, made, problems), start=1):
        said: list[str] = []
        campaign = _load_one(item.source, item.file, run, said) if item.columns else None
        problems += said
        if campaign is not None:
            where, name = item.source.where(("test", "modes")), item.section.name
            problems += number_problems(where, name, campaign.measured.numbers)
            configurations.append(
                Configuration(name, place, campaign, item.columns, item.section.weight,
                              item.section.hold_out)
            )  # fmt: skip
    if problems:
        return None
    parameters = ParameterSet(tuple(item.parameter() for item in file.parameters))
    return joined(tuple(configurations), parameters)


def joined(configurations: tuple[Configuration, ...], parameters: ParameterSet) -> Campaign:
    """The campaign of several configurations that share parameters, by the first one's settings.

    What it tells of one model alone (sensors, surface, response functions) is empty.
    """
    used = [item for item in configurations if not item.hold_out]
    test = joint_test([(item.place, item.campaign.test) for item in used])
    return replace(
        configurations[0].campaign,
        solver=JointSolver(tuple(
            JointPart(item.name, item.campaign.solver, item.campaign.parameters)
            for item in configurations
        )),
        parameters=parameters,
        measurement=Measurement(test),
        test=test,
        mapping=no_sensors(),
        surface=no_surface(),
        nodes=(),
        held_out=None,
        configurations=configurations,
    )  # fmt: skip


def _problem(source: YamlFile, item: object) -> str:
    assert isinstance(item, dict)
    place = tuple(item["loc"])
    key = ".".join(str(part) for part in place)
    said = str(item["msg"]).removeprefix("Value error, ")
    if item["type"] == "extra_forbidden":
        said = f"unknown key `{place[-1]}`"
    elif item["type"] == "missing":
        said = f"the key `{place[-1]}` is missing"
    elif not isinstance(item["input"], dict | list):
        said = f"{said}; found {item['input']!r}"
    return f"{source.where(place)}: {key or 'campaign'}: {said}"


def _store_folder(source: YamlFile, file: CampaignFile) -> Path:
    base = source.path.resolve().parent
    if file.store is not None:
        return base / file.store
    named = os.environ.get(STORE_VARIABLE)
    return Path(named) if named else base / ".modetune" / "store"


def _read_model(
    source: YamlFile,
    file: CampaignFile,
    store: Store,
    parameters: ParameterSet,
    problems: list[str],
) -> Solver | None:
    key = "deck" if file.model.deck is not None else "generator"
    where = source.where(("model", key))
    try:
        deck = model_deck(file.model, source.path.parent, store.folder.parent)
        solver = bind_solver(file.model, deck, parameters.parameters)
    except ModelError as error:
        problems.append(f"{error} (named in {where})")
        return None
    for position, parameter in enumerate(parameters.parameters):
        place = source.where(("parameters", position))
        problems += [f"{place}: {said}" for said in solver.problems((parameter,))]
    if not problems:  # what several parameters do to each other
        place = source.where(("parameters",))
        problems += [f"{place}: {said}" for said in solver.problems(parameters.parameters)]
    if not problems:
        problems += unit_problems(source.where(("model", "units")), file.model.units, solver)
    return solver
