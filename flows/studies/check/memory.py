"""Whether the factors of a model fit in memory or on disk, told before updating makes them."""

from __future__ import annotations

from modetune.core.algebra.eigen import DENSE, most_vectors, similar_vectors
from modetune.core.algebra.factor_room import factor_forecast
from modetune.core.algebra.pardiso import is_available
from modetune.core.algebra.pencil import shifted_pattern
from modetune.core.errors import SolverExhausted
from modetune.flows.studies.check.findings import MODEL, Finding
from modetune.flows.updating.evaluator import CaseState
from modetune.flows.updating.reduced_model import ByMatrices

LIMIT = "run.memory_gb"


def memory_findings(state: CaseState) -> list[Finding]:
    """What factors of a case's model will take, where its matrices are there and are factorised.

    The unknowns are ordered for it once; factors that are in memory are given up first, for they
    would count twice. Raises ModelError, StoreError.
    """
    by_matrices = isinstance(state.finder, ByMatrices)
    if not by_matrices and not state.case.needs("matrices"):
        return []
    if not is_available():
        unknown = "the memory of factors is not limited: MKL's PARDISO is not installed"
        return [MODEL.doubtful(unknown, LIMIT)] if state.campaign.run.memory_gb else []
    if isinstance(state.finder, ByMatrices):
        state.finder.release()
    base = state.finder.assembled(state.campaign.start).model.base
    pattern = shifted_pattern(base.upper_stiffness, base.upper_mass)
    if pattern.shape[0] <= DENSE:
        return []
    n_modes, room = state.analysis.n_modes, state.engine.room
    vectors = most_vectors(n_modes), similar_vectors(n_modes)
    try:
        on_disk, said = factor_forecast(pattern, vectors[0], vectors[1], room)
    except SolverExhausted as error:
        return [MODEL.wrong(str(error), LIMIT)]
    if not on_disk:
        return [MODEL.good(said, LIMIT)]
    return [MODEL.doubtful(said, LIMIT, "raise it where there is more memory")]
