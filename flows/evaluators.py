"""What evaluates a campaign: the solver's own modes, its matrices, or several configurations."""

from __future__ import annotations

from modetune.flows.campaign import Campaign
from modetune.flows.configurations.joint import JointEvaluator
from modetune.flows.evaluating import Evaluating
from modetune.flows.evaluator import Evaluator
from modetune.flows.execution.engine import JobEngine
from modetune.flows.execution.work import Execution


def evaluator_of(campaign: Campaign, engine: JobEngine, execution: Execution) -> Evaluating:
    """What evaluates a campaign's parameter sets, by its `eigensolver` and configurations."""
    if campaign.configurations:
        return JointEvaluator(campaign, engine, execution)
    if campaign.eigensolver == "solver":
        return Evaluator(campaign, engine, execution)
    from modetune.flows.by_matrices.choice import matrix_source

    source = matrix_source(campaign, engine)
    if source is None:
        return Evaluator(campaign, engine, execution)
    from modetune.flows.by_matrices.evaluator import MatrixEvaluator

    return MatrixEvaluator(campaign, engine, execution, source)
