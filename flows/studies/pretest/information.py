"""The information of each candidate sensor about a campaign's parameters.

Shapes are measured up to a scale, so what counts is how a shape's direction turns with a
parameter: d phi less its part along phi, in units of the shape's rms over the candidates, divided
by the standard deviation that the campaign gives shapes and multiplied by the parameter's own. The
information from the frequencies is present before any sensor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from modetune.adapters.solver import ModalAnalysis
from modetune.core.correlation.pairing import alone
from modetune.core.errors import CampaignError
from modetune.core.mesh import Mesh
from modetune.core.modes import Floats, Integers
from modetune.core.planning.sensor_placement import parameter_information
from modetune.core.updating.job_results import ModalResult
from modetune.core.updating.weighting import even_weighting
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.schema import SensitivitySection
from modetune.flows.report.tables import Column
from modetune.flows.studies.pretest.candidate_sensors import CandidateSensors
from modetune.flows.updating.evaluation import Point
from modetune.flows.updating.evaluator import Evaluator


@dataclass(frozen=True, slots=True)
class Knowledge:
    """How well a parameter would be known: relative standard deviations, linear.

    beforehand: as the campaign says; by_frequencies: from those of the modes alone; by_sensors:
    with shapes at the chosen sensors; by_all: at all candidates.
    """

    name: Annotated[str, Column("parameter")]
    beforehand: Annotated[float, Column("beforehand", "%", ".3g")]
    by_frequencies: Annotated[float, Column("frequencies", "%", ".3g")]
    by_sensors: Annotated[float, Column("and these sensors", "%", ".3g")]
    by_all: Annotated[float, Column("and all candidates", "%", ".3g")]


@dataclass(frozen=True, slots=True)
class Information:
    """Of all candidates on the parameters, in units of their deviations beforehand.

    matrices: (n, n_parameters, n_parameters); base: (n_parameters, n_parameters), without shapes.
    """

    matrices: Floats
    base: Floats

    def knowledge(self, campaign: Campaign, chosen: Integers) -> tuple[Knowledge, ...]:
        """How well each parameter would be known with these sensors."""
        sums = (
            self.base,
            self.base + self.matrices[chosen].sum(axis=0),
            self.base + self.matrices.sum(axis=0),
        )
        shares = [np.sqrt(np.diag(np.linalg.inv(item))) for item in sums]
        return tuple(
            Knowledge(
                item.name,
                item.standard_deviation,
                *(float(item.standard_deviation * share[place]) for share in shares),
            )
            for place, item in enumerate(campaign.parameters.parameters)
        )

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
    evaluator: Evaluator,
    analysis: ModalAnalysis,
    modal: ModalResult,
    modes: Integers,
    candidates: CandidateSensors,
    mesh: Mesh,
) -> Information:
    """Information of the candidates.

    modes: positions among the elastic ones. Raises CampaignError without parameters; SolverError.
    """
    if not len(campaign.parameters):
        raise CampaignError(
            f"{campaign.file}: this --method places sensors for `parameters`, and the campaign has "
            "none; add them, or choose another --method"
        )
    point = Point(campaign.parameters.initial, "", modal, alone(modes))
    found = evaluator.derivatives(point, analysis)
    deviations = campaign.parameters.standard_deviations
    shown = modal.elastic.select(modes)
    rows = candidates.rows(shown, mesh)
    turned = [
        _turning(rows, candidates.rows(replace(shown, mode_shapes=change), mesh))
        for change in np.moveaxis(found.mode_shapes, 2, 0)
    ]
    readings = np.stack(turned, axis=-1).reshape(candidates.n, -1, len(turned))
    known = campaign.residuals
    slopes = found.eigenvalues / shown.eigenvalues[:, None] / 2.0 * deviations
    slopes = slopes / known.of_others("frequency_deviation")
    readings = readings * deviations / known.of_others("shape_deviation")
    matrices = parameter_information(readings)
    return Information(matrices, np.eye(deviations.size) + slopes.T @ slopes)


def _turning(rows: Floats, change: Floats) -> Floats:
    """Return the change of shapes (n, n_directions, n_modes) without their scale, over their
    rms."""
    squares = np.sum(rows**2, axis=(0, 1))
    squares = np.where(squares > 0.0, squares, 1.0)
    along = np.sum(rows * change, axis=(0, 1)) / squares
    rms = np.sqrt(squares / (rows.shape[0] * rows.shape[1]))
    return np.asarray((change - rows * along) / rms)


def with_shapes(campaign: Campaign, nodes: tuple[int, ...]) -> Campaign:
    """The campaign with derivatives of shapes at these nodes, whatever its residual compares."""
    weighting = even_weighting(1, 0, 1.0, 1.0)
    return replace(
        campaign,
        cases=(replace(campaign.case, nodes=nodes, weighting=weighting),),
        sensitivity=_settings(campaign),
    )


def _settings(campaign: Campaign) -> SensitivitySection:
    """The campaign's, or `auto` where its method is for frequencies alone."""
    settings, solver = campaign.sensitivity, campaign.case.solver
    shapes = {
        "strain_energy": False,
        "semi_analytic": solver.deck.summary.solid_shapes,
        "solver": solver.program.capabilities.shape_sensitivities,
    }
    if shapes.get(settings.method, True):
        return settings
    return settings.model_copy(update={"method": "auto"})
