"""From a campaign file to a Campaign whose every part has been looked at.

All problems are collected and told at once, each with file and line, before any solver runs.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import numpy as np
from pydantic import ValidationError

from modetune.adapters.solver import Solver
from modetune.adapters.yaml_file import YamlFile, read_yaml
from modetune.core.criteria import Tolerances
from modetune.core.errors import CampaignError, ModelError
from modetune.core.measurement import Measurement
from modetune.core.modes import Floats, MeasuredModes
from modetune.core.parameters import Parameter, ParameterSet
from modetune.core.residual import Weighting
from modetune.core.sensors import SensorMap
from modetune.core.store import Store
from modetune.core.surface import Surface, display_surface
from modetune.flows.schema import (
    STORE_VARIABLE,
    CampaignFile,
    ReportSection,
    RunSection,
    SensitivitySection,
    SolverName,
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

    test: the modes that are used; held_out: those that are only judged by.
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
        measured = len(self.test.numbers) + (len(self.held_out.numbers) if self.held_out else 0)
        return measured + EXTRA_MODES + RIGID_MODES

    @property
    def parallel(self) -> int:
        """Jobs at the same time."""
        return self.run.parallel or cores()

    @property
    def threads(self) -> int:
        """Threads of each job: the machine's cores shared out among parallel jobs."""
        return self.run.threads or max(1, cores() // self.parallel)


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
    measurement = read_test(source, file, problems)
    parameters = _parameters(file)
    store = Store(_store_folder(source, file))
    solver = _read_model(source, file, store, parameters, problems)
    mapping = None
    if measurement is not None and solver is not None:
        mapping = map_test(source, file, measurement, solver, problems)
        problems += _method_problems(source, file, solver)
    problems += _core_problems(source, run) + _licence_problems(source, file.run)
    if problems or measurement is None or solver is None or mapping is None:
        raise CampaignError(problems)
    used = used_modes(file, measurement)
    test = replace(used, modes=used.modes.rows(mapping.rows))
    held = held_out_modes(file, measurement)
    return Campaign(
        name=file.name,
        file=path,
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
        settings=tuple(settings or ()),
        held_out=replace(held, modes=held.modes.rows(mapping.rows)) if held else None,
    )


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


def _core_problems(source: YamlFile, run: RunSection) -> list[str]:
    """Jobs in parallel times threads of each must not be more than the machine's cores."""
    wanted = max(run.parallel, 1) * max(run.threads, 1)
    if wanted <= cores() or not run.here:
        return []
    return [
        f"{source.where(('run',))}: run: {max(run.parallel, 1)} jobs of {max(run.threads, 1)} "
        f"threads want {wanted} cores, this machine has {cores()}; lower `parallel` or `threads`, "
        "or leave them out"
    ]


def _licence_problems(source: YamlFile, run: RunSection) -> list[str]:
    """A licence that no solver has would limit nothing, without a word."""
    unknown = sorted(set(run.licences) - set(get_args(SolverName)))
    if not unknown:
        return []
    return [
        f"{source.where(('run', 'licences'))}: run.licences names {', '.join(unknown)}; licences "
        f"go by the solver's name: {', '.join(get_args(SolverName))}"
    ]


def _store_folder(source: YamlFile, file: CampaignFile) -> Path:
    base = source.path.resolve().parent
    if file.store is not None:
        return base / file.store
    named = os.environ.get(STORE_VARIABLE)
    return Path(named) if named else base / ".modetune" / "store"


def _parameters(file: CampaignFile) -> ParameterSet:
    return ParameterSet(
        tuple(
            Parameter(
                item.name,
                item.quantity,
                item.by(),
                item.targets(),
                *item.bounds,
                item.deviation,
                item.initial,
                item.item,
            )
            for item in file.parameters
        )
    )


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


def _method_problems(source: YamlFile, file: CampaignFile, solver: Solver) -> list[str]:
    """Why the campaign's sensitivity method cannot be had."""
    method, has = file.sensitivity.method, solver.capabilities
    shapes = file.residuals.shape_weight > 0.0
    place = source.where(("sensitivity", "method"))
    offered = {
        "strain_energy": has.strain_energies,
        "semi_analytic": has.matrices,
        "solver": has.shape_sensitivities if shapes else has.frequency_sensitivities,
    }
    if not offered.get(method, True):
        return [f"{place}: {solver.name} does not offer {method} here; use `auto`"]
    if method == "semi_analytic" and shapes and not solver.model.solid_shapes:
        return [
            f"{place}: shape sensitivities from matrices need a model of solids without dependent "
            "nodes; use `auto` or finite_difference"
        ]
    if method != "strain_energy":
        return []
    if shapes:
        return [f"{place}: strain energies give no shape sensitivities; use `auto`"]
    return [
        f"{place}: the stiffness is not proportional to {item.name} ({item.quantity}); use `auto`"
        for item in _parameters(file).parameters
        if not solver.problems((item,)) and not solver.energy_sets(item)
    ]
