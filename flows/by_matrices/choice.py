"""Whether a campaign's modes are found from stored matrices or by the solver itself."""

from __future__ import annotations

import logging

from modetune.adapters.solver import Solver
from modetune.core.pardiso import is_available
from modetune.flows.by_matrices.source import MatrixSource
from modetune.flows.by_matrices.suitability import unsuitable
from modetune.flows.campaign import Campaign
from modetune.flows.execution.engine import JobEngine

logger = logging.getLogger(__name__)

#: Models of fewer elements are solved by the solver itself as fast.
SMALL = 2000


def matrix_source(campaign: Campaign, engine: JobEngine) -> MatrixSource | None:
    """Where the matrices of a campaign come from; None where the solver's own modes are used."""
    if campaign.eigensolver == "solver":
        return None
    solver, parameters = campaign.solver, campaign.parameters.parameters
    reason = None
    if campaign.eigensolver == "auto":  # first: the rest takes a look at the whole deck
        reason = _slower(solver)
    if reason is None and campaign.run.engine != "local":
        reason = "jobs run on other machines"
    if reason is None:
        reason = unsuitable(solver, parameters, campaign.sensitivity.method)
    if reason is not None:
        logger.info("modes are the solver's own: %s", reason)
        return None
    footprints = tuple(solver.footprint(parameter) for parameter in parameters)
    return MatrixSource(engine, campaign.parameters, tuple(filter(None, footprints)))


def _slower(solver: Solver) -> str | None:
    """Why the solver itself is as fast, None where it is not."""
    if solver.model.n_elements < SMALL:
        return f"it is as fast below {SMALL} elements"
    return None if is_available() else "MKL's PARDISO is not installed"
