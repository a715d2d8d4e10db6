"""Places for sensors and exciters from the model alone: the Python API of `modetune pretest`.

Whoever finds the modes for updating gives the shapes at all candidates (the store first, as ever;
before there is a test, one modal job); for the information on parameters the jobs of their
sensitivities join it. Everything else is linear algebra on them.

The sensors become a file of points, which a campaign reads as its test's geometry.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from modetune.adapters.solver import MatrixAnalysis, ModalAnalysis
from modetune.adapters.test_files.geometry_csv import write_geometry_csv
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.brief import brief
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import TestGeometry
from modetune.core.mesh import Mesh
from modetune.core.modes import Floats
from modetune.core.planning.sensor_placement import ALIKE, Quality, judge
from modetune.core.storage.campaign_record import RunCounts
from modetune.core.updating.job_results import ModalResult
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.case import EXTRA_MODES, RIGID_MODES
from modetune.flows.campaign.units import METRES, Units
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.jobs.execution import Work
from modetune.flows.jobs.job import Job
from modetune.flows.studies.pretest.candidate_sensors import (
    CandidateSensors,
    candidates_of,
    moving,
    placed_mesh,
)
from modetune.flows.studies.pretest.excitation import (
    PlacedExciter,
    SuspensionPoint,
    excitation_notes,
    place_exciters,
    suspension_points,
)
from modetune.flows.studies.pretest.information import Knowledge, information_of, with_shapes
from modetune.flows.studies.pretest.placement import (
    Ground,
    PlacedSensor,
    check_count,
    check_settings,
    choose_sensors,
    likeness,
    needed_number,
    placed_sensors,
)
from modetune.flows.studies.pretest.request import PretestSettings
from modetune.flows.updating.evaluator import Evaluator, evaluator_of
from modetune.flows.updating.matrices import MatrixSource
from modetune.flows.updating.mode_source import campaign_analysis

#: Number of elastic modes where none are named.
FIRST_MODES = 8


@dataclass(frozen=True, slots=True, repr=False)
class Pretest:
    """Places for a test. quality: of the chosen sensors; whole: of all candidates.

    needed: how many sensors would keep modes apart, where these do not and that many would.
    distance: what was kept between sensors, the deck's length.
    """

    name: str
    settings: PretestSettings
    mode_numbers: tuple[int, ...]
    frequencies_hz: Floats
    n_rigid: int
    n_candidates: int
    distance: float
    sensors: tuple[PlacedSensor, ...]
    quality: Quality
    whole: Quality
    needed: int | None
    exciters: tuple[PlacedExciter, ...]
    suspension: tuple[SuspensionPoint, ...]
    knowledge: tuple[Knowledge, ...]
    notes: tuple[str, ...]
    runs: RunCounts

    __repr__ = brief

    @property
    def doubtful(self) -> bool:
        """Whether two modes look alike to the sensors."""
        return self.quality.largest > ALIKE


def run_pretest(campaign: Campaign, settings: PretestSettings) -> Pretest:
    """Choose sensors and exciters for a model.

    Raises CampaignError for unavailable settings, ModesError for modes that the sensors cannot
    distinguish, SolverError, StoreError.
    """
    check_settings(settings)
    campaign.solver_version()  # report a missing solver before anything else starts
    mesh = placed_mesh(campaign.case.solver)
    asked = candidates_of(
        campaign.case.solver, settings.candidates, settings.directions, settings.triaxial
    )
    analysis = _analysis(campaign, settings, asked)
    own = with_shapes(campaign, analysis.nodes)
    engine = job_engine(own)
    evaluator = evaluator_of(own, engine, like=campaign)
    modal = evaluator.modes(own.parameters.initial, analysis)
    numbers = _mode_numbers(settings.modes, modal.elastic.n_modes)
    modes = np.array(numbers, dtype=np.int64) - 1
    shown = modal.elastic.select(modes)
    candidates = moving(asked, asked.rows(shown, mesh))
    rows = candidates.rows(shown, mesh)
    information = None
    if settings.method == "information":
        information = information_of(own, evaluator, analysis, modal, modes, candidates, mesh)
    weighted = rows
    if settings.by_mass:
        weighted = rows * np.sqrt(_masses(own, evaluator, candidates))[:, :, None]
    model = Ground(shown, mesh, candidates, rows, weighted, information)
    return _pretest(campaign, settings, model, modal, numbers, evaluator.runs)


def _pretest(
    campaign: Campaign,
    settings: PretestSettings,
    model: Ground,
    modal: ModalResult,
    numbers: tuple[int, ...],
    runs: RunCounts,
) -> Pretest:
    count = settings.sensors or min(2 * len(numbers), model.candidates.n)
    check_count(count, len(numbers), model.rows.shape[1])
    chosen, spacing, notes = choose_sensors(model, settings, count)
    quality = judge(model.rows, chosen)
    needed = None
    if quality.largest > ALIKE:
        needed = needed_number(model, spacing, count)
        notes.append(likeness(model, quality, numbers, count, needed))
    exciters = place_exciters(
        model.candidates,
        model.rows,
        _rigid_rows(model, modal),
        settings.exciters,
        campaign.case.units,
    )
    notes += excitation_notes(exciters, numbers, model.modes.frequencies_hz)
    return Pretest(
        name=campaign.name,
        settings=settings,
        mode_numbers=numbers,
        frequencies_hz=model.modes.frequencies_hz,
        n_rigid=modal.n_rigid,
        n_candidates=model.candidates.n,
        distance=spacing.distance,
        sensors=placed_sensors(campaign, settings, model, chosen, numbers),
        quality=quality,
        whole=judge(model.rows, np.arange(model.candidates.n)),
        needed=needed,
        exciters=exciters,
        suspension=suspension_points(model.candidates, model.modes, model.mesh, modal.n_rigid),
        knowledge=model.information.knowledge(campaign, chosen) if model.information else (),
        notes=tuple(notes),
        runs=runs,
    )


def _analysis(
    campaign: Campaign, settings: PretestSettings, candidates: CandidateSensors
) -> ModalAnalysis:
    """The modes that are wanted, rigid ones and some to spare, at the candidates; those that
    updating begins with, where these are among them."""
    n_modes = max(settings.modes, default=FIRST_MODES) + RIGID_MODES
    nodes, own = np.unique(candidates.nodes).tolist(), campaign_analysis(campaign)
    if n_modes <= own.n_modes and set(nodes) <= set(own.nodes):
        return own
    return replace(own, n_modes=n_modes + EXTRA_MODES, nodes=tuple(nodes))


def _mode_numbers(asked: tuple[int, ...], there: int) -> tuple[int, ...]:
    if not asked:
        return tuple(range(1, min(FIRST_MODES, there) + 1))
    missing = [number for number in asked if number > there]
    if missing:
        raise CampaignError(
            f"--modes: elastic mode {missing[0]} is asked for, and the model has {there} within "
            "what was computed; leave it out"
        )
    return asked


def _rigid_rows(model: Ground, modal: ModalResult) -> Floats:
    rigid = modal.modes.select(np.arange(modal.n_rigid))
    return model.candidates.rows(rigid, model.mesh)


def _masses(campaign: Campaign, evaluator: Evaluator, candidates: CandidateSensors) -> Floats:
    """Mass along each direction of each candidate, (n, n_directions), from the mass matrix."""
    solver = campaign.case.solver
    if not solver.offers.matrices:
        raise CampaignError(
            f"--mass: {solver.program.name} gives no mass matrix here; leave it out"
        )
    theta, columns = campaign.parameters.initial, range(len(campaign.parameters))
    source = MatrixSource(evaluator.only.engine, campaign.parameters, campaign.sensitivity.step)
    if source.everywhere and not source.jobs(theta, columns):
        found = source.matrices(theta, columns).at(source.written(theta))
    else:
        work = Work("matrices", (Job(campaign.parameters.values(theta), MatrixAnalysis()),))
        ((outcome,),) = evaluator.carry_out("masses", [work])
        found = outcome.result(MatrixResult)
    names = zip(found.nodes.tolist(), found.components.tolist(), strict=True)
    masses = dict(zip(names, found.upper_mass.diagonal().tolist(), strict=True))
    nodes = candidates.nodes.tolist()
    table = np.array([[masses.get((node, axis), np.nan) for axis in (1, 2, 3)] for node in nodes])
    weights = candidates.directions**2
    # A component that a candidate does not look along need not be there.
    parts = np.where(weights > 1e-12, weights * table[:, None, :], 0.0)
    along = parts.sum(axis=2)
    if np.isnan(along).any():
        lost = candidates.nodes[np.isnan(along).any(axis=1)]
        raise CampaignError(
            f"--mass: the stored mass matrix has no equation for node {lost[0]} (it has "
            "expanded shells and beams, and no constrained nodes); leave --mass out"
        )
    return np.asarray(np.maximum(along, 0.0))


def check_out(path: Path, mesh: Mesh) -> None:
    """Raise CampaignError for another kind of file, or a model without places."""
    if path.suffix.lower() != ".csv":
        raise CampaignError(f"{path}: the sensor file is CSV; give a name that ends with .csv")
    if mesh.nodes.size == 0:
        raise CampaignError(
            f"{path}: the model has no places for sensors: it is matrices alone; leave --out away, "
            "the table names the degrees of freedom"
        )


def sensor_dofs(sensor: PlacedSensor) -> tuple[str, ...]:
    """How the rows of measured modes are to be named for a sensor: `node.component`."""
    if sensor.label == "normal":
        return (f"{sensor.node}.z",)
    return tuple(f"{sensor.node}.{axis}" for axis in sensor.label)


def write_sensor_file(path: Path, pretest: Pretest, units: Units) -> None:
    """Write one point a place, numbered as its node, and in comments what is measured there.

    A sensor along the normal is the local z of its point. Raises StorageUnavailable.
    """
    places = {item.node: item for item in pretest.sensors}
    found = list(places.values())
    comment = [
        f"modetune pretest of {pretest.name}: {len(pretest.sensors)} sensors at {len(found)} "
        "places",
        f"method {pretest.settings.method}, elastic modes "
        + ", ".join(map(str, pretest.mode_numbers)),
    ]
    comment += [
        f"sensor {number}: {' '.join(sensor_dofs(item))}"
        for number, item in enumerate(pretest.sensors, start=1)
    ]
    geometry = TestGeometry(
        nodes=np.array([item.node for item in found], dtype=np.int64),
        coordinates=np.array([item.place for item in found]),
        frames=np.array([_axes(item) for item in found]),
        metres=METRES[units],
    )
    write_geometry_csv(path, geometry, comment)


def _axes(sensor: PlacedSensor) -> Floats:
    """The point's own axes (3, 3), rows in global ones: z along a normal, else the global ones."""
    if sensor.label != "normal":
        return np.eye(3)
    z = np.array(sensor.frame[0])
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])
