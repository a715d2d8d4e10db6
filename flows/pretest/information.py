"""What each possible sensor would tell of a campaign's parameters.

Shapes are measured up to a scale, so what counts is how a shape's direction turns with a
parameter: d phi less its part along phi, in units of the shape's rms over the candidates, divided
by the standard deviation that the campaign gives shapes and multiplied by the parameter's own. What
the frequencies tell is there before any sensor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modetune.adapters.solver import ModalAnalysis
from modetune.core.errors import CampaignError, ModetuneError
from modetune.core.mesh import Mesh
from modetune.core.modes import Floats, Integers
from modetune.core.pairing import Pairing
from modetune.core.placement import parameter_information
from modetune.core.record import RunCounts
from modetune.core.results import ModalResult, ModeDerivatives
from modetune.flows.campaign import Campaign
from modetune.flows.evaluation import Point
from modetune.flows.evaluator import outcomes_count
from modetune.flows.execution.engine import JobEngine
from modetune.flows.execution.work import ThreadExecution, Work
from modetune.flows.pretest.candidates import Candidates
from modetune.flows.schema import SensitivitySection
from modetune.flows.semi_analytic import UnlikeMatrices
from modetune.flows.sensitivities import Exact, Sensitivities


@dataclass(frozen=True, slots=True)
class Knowledge:
    """How well a parameter would be known: relative standard deviations, linear.

    beforehand: as the campaign says; by_frequencies: from those of the modes alone; by_sensors:
    with shapes at the chosen sensors; by_all: at all candidates.
    """

    name: str
    beforehand: float
    by_frequencies: float
    by_sensors: float
    by_all: float


@dataclass(frozen=True, slots=True)
class Information:
    """Of all candidates on the parameters, in units of their deviations beforehand.

    matrices: (n, n_parameters, n_parameters); base: (n_parameters, n_parameters), without shapes.
    """

    matrices: Floats
    base: Floats

    def knowledge(self, campaign: Campaign, chosen: Integers) -> tuple[Knowledge, ...]:
        """How well each parameter would be known with these sensors."""
        sums = (self.base, self.base + self.matrices[chosen].sum(axis=0),
                self.base + self.matrices.sum(axis=0))  # fmt: skip
        shares = [np.sqrt(np.diag(np.linalg.inv(item))) for item in sums]
        return tuple(
            Knowledge(item.name, item.standard_deviation,
                      *(float(item.standard_deviation * share[place]) for share in shares))
            for place, item in enumerate(campaign.parameters.parameters)
        )  # fmt: skip

    def lost(self, chosen: Integers) -> tuple[Floats, Integers]:
        """Share of the determinant lost without each chosen sensor, and whom that hits most."""
        parts = self.matrices[chosen]
        whole = self.base + parts.sum(axis=0)
        without = np.linalg.inv(whole - parts)
        # By logarithms: determinants of many well-known parameters are beyond all numbers.
        lost = -np.expm1(np.linalg.slogdet(whole - parts)[1] - np.linalg.slogdet(whole)[1])
        growth = np.diagonal(without, axis1=1, axis2=2) / np.diag(np.linalg.inv(whole))
        return lost, np.argmax(growth, axis=1).astype(np.int64)


def information_of(
    campaign: Campaign,
    engine: JobEngine,
    analysis: ModalAnalysis,
    modal: ModalResult,
    modes: Integers,
    candidates: Candidates,
    mesh: Mesh,
) -> tuple[Information, RunCounts]:
    """Information of the candidates, and the runs that it took.

    modes: positions among the elastic ones. Raises CampaignError without parameters; SolverError.
    """
    if not len(campaign.parameters):
        raise CampaignError(
            f"{campaign.file}: sensors that tell the parameters need `parameters`; name them in "
            "the campaign, or choose another --method"
        )
    nothing = np.full(modes.size, np.nan)
    pairing = Pairing(np.arange(modes.size), modes, nothing, nothing, ("",) * modes.size)
    point = Point(campaign.parameters.initial, modal, pairing)
    found, runs = _derivatives(campaign, engine, analysis, point)
    deviations = campaign.parameters.standard_deviations
    shown = modal.elastic.select(modes)
    rows = candidates.rows(shown, mesh)
    turned = [
        _turning(rows, candidates.rows(replace(shown, mode_shapes=change), mesh))
        for change in np.moveaxis(found.mode_shapes, 2, 0)
    ]
    readings = np.stack(turned, axis=-1).reshape(candidates.n, -1, len(turned))
    weighting = campaign.weighting
    slopes = found.eigenvalues / shown.eigenvalues[:, None] / 2.0 * deviations
    slopes = slopes / weighting.frequency_deviation
    matrices = parameter_information(readings * deviations / weighting.shape_deviation)
    return Information(matrices, np.eye(deviations.size) + slopes.T @ slopes), runs


def _turning(rows: Floats, change: Floats) -> Floats:
    """Change of shapes (n, n_directions, n_modes) but for their scale, over their rms."""
    squares = np.sum(rows**2, axis=(0, 1))
    squares = np.where(squares > 0.0, squares, 1.0)
    along = np.sum(rows * change, axis=(0, 1)) / squares
    rms = np.sqrt(squares / (rows.shape[0] * rows.shape[1]))
    return np.asarray((change - rows * along) / rms)


def _derivatives(
    campaign: Campaign, engine: JobEngine, analysis: ModalAnalysis, point: Point
) -> tuple[ModeDerivatives, RunCounts]:
    """Derivatives of the modes by the campaign's method, by differences where it cannot be had."""
    plans = Sensitivities(engine, campaign.parameters, _settings(campaign), True, analysis)
    methods = plans.methods()
    runs = _run(campaign, engine, plans, point.theta, methods)
    columns = range(len(methods))
    try:
        return plans.assemble(point, methods, columns), runs
    except UnlikeMatrices:
        if plans.settings.method != "auto":
            raise
    instead: tuple[Exact, ...] = tuple(
        "finite_difference" if method == "semi_analytic" else method for method in methods
    )
    runs = runs.plus(_run(campaign, engine, plans, point.theta, instead))
    return plans.assemble(point, instead, columns), runs


def _settings(campaign: Campaign) -> SensitivitySection:
    """The campaign's, or `auto` where its method is for frequencies alone."""
    settings, solver = campaign.sensitivity, campaign.solver
    shapes = {
        "strain_energy": False,
        "semi_analytic": solver.model.solid_shapes,
        "solver": solver.capabilities.shape_sensitivities,
    }
    if shapes.get(settings.method, True):
        return settings
    return settings.model_copy(update={"method": "auto"})


def _run(
    campaign: Campaign,
    engine: JobEngine,
    plans: Sensitivities,
    theta: Floats,
    methods: tuple[Exact, ...],
) -> RunCounts:
    """Run all jobs that the columns need, side by side. Raises what the first of them met."""
    works = [
        Work("sensitivity matrices", plans.shared(theta, methods)),
        *(
            Work(f"sensitivity {name}", plans.plan(theta, column, methods[column]))
            for column, name in enumerate(campaign.parameters.names)
        ),
    ]
    runs = RunCounts()
    for done in ThreadExecution(engine, campaign.parallel).run("pretest", works):
        if isinstance(done, ModetuneError):
            raise done
        runs = runs.plus(outcomes_count("sensitivity", done))
    return runs
