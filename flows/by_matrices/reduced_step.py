"""A step that solves the whole updating problem on a reduced model.

A reduced model knows the modes around a set for all parameter values, so the updating loop itself
runs on it, in milliseconds, to its own end: with the campaign's step form, bounds and criteria,
within the region in which the step may end. What it finds is one step of the real campaign, which
the full model then confirms or does not.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np

from modetune.core.errors import ModesError
from modetune.core.estimation import Step
from modetune.core.held_out import HeldOut
from modetune.core.modes import Floats, mode_set
from modetune.core.record import RunCounts
from modetune.core.reduced import ReducedModel
from modetune.core.residual import residual_sensitivity
from modetune.core.results import ModalResult
from modetune.flows.campaign import Campaign
from modetune.flows.evaluating import Evaluating, Matrix
from modetune.flows.evaluation import Evaluation, compare
from modetune.flows.evaluator import seen_derivatives
from modetune.flows.execution.work import Work
from modetune.flows.loop import Loop, Noted

logger = logging.getLogger(__name__)

#: How columns from a reduced model are called in records.
REDUCED = "reduced_model"
#: Steps on the reduced model at most; they cost next to nothing.
ITERATIONS = 100


def refined_step(
    campaign: Campaign,
    reduced: ReducedModel,
    current: Evaluation,
    step: Step,
    region: tuple[Floats, Floats],
) -> tuple[Step, Evaluation] | None:
    """The step to where updating ends on a reduced model around the current set, and what it
    foresees there.

    step: the linear one, whose regularisation and condition it keeps; region: lower and upper
    values. None where the reduced model cannot be updated.
    """
    inner = replace(
        campaign,
        begin=tuple(current.theta.tolist()),
        update=campaign.update.model_copy(update={"max_iterations": ITERATIONS}),
        held_out=None,
    )
    evaluator = ReducedEvaluator(inner, reduced, current)
    try:
        end = Loop(inner, evaluator, _Unwatched(), region).run()
    except ModesError as error:
        logger.debug("no reduced step: %s", error)
        return None
    change = end.last.theta - current.theta
    return replace(step, change=change, predicted=end.last.residual.values), end.last


def reduced_matrix(campaign: Campaign, reduced: ReducedModel, evaluation: Evaluation) -> Matrix:
    """The sensitivity at an evaluated set, exact within a reduced model around it."""
    modal = evaluation.modal
    paired = evaluation.pairing.computed + modal.n_rigid
    shapes = np.real(modal.modes.mode_shapes[:, paired])
    found = reduced.derivatives(evaluation.theta, paired, shapes)
    values = residual_sensitivity(
        campaign.test.modes, evaluation.seen, evaluation.pairing, campaign.weighting,
        seen_derivatives(campaign, evaluation, found),
    )  # fmt: skip
    return Matrix(values, (REDUCED,) * len(campaign.parameters), (evaluation.key,), 0)


@dataclass(frozen=True, slots=True)
class ReducedEvaluator(Evaluating):
    """Evaluates sets by a reduced model around one that was evaluated in full."""

    campaign: Campaign
    reduced: ReducedModel
    around: Evaluation

    @property
    def cheap(self) -> bool:
        return True

    @property
    def runs(self) -> RunCounts:
        return RunCounts()

    def evaluate(
        self, number: int, theta: Floats, previous: Evaluation | None, alone: bool
    ) -> tuple[Evaluation, Matrix | None]:
        known = self.around.modal
        eigenvalues, shapes = self.reduced.modes(theta, known.modes.n_modes)
        modal = ModalResult(
            eigenvalues=eigenvalues,
            modes=mode_set(
                np.sqrt(np.maximum(eigenvalues, 0.0)) / (2.0 * np.pi), shapes,
                known.modes.nodes, known.modes.components, normalisation="mass",
            ),
            groups=(),
            strain_energies=np.zeros((0, eigenvalues.size)),
            total_strain_energy=0.5 * eigenvalues,
            mass=np.nan,
        )  # fmt: skip
        evaluation = compare(
            self.campaign, theta, self.around.key, modal, previous or self.around, REDUCED
        )
        return evaluation, None if alone else self.matrix(number, evaluation)

    def matrix(self, number: int, evaluation: Evaluation) -> Matrix:
        return reduced_matrix(self.campaign, self.reduced, evaluation)

    def skip(self, number: int, slope: float) -> None:
        return

    def planned(self, theta: Floats) -> list[Work]:
        return []

    def held_out(self, initial: Evaluation, updated: Evaluation) -> HeldOut | None:
        return None


class _Unwatched:
    """A loop that nobody watches."""

    def working(self, text: str) -> None:
        return

    def noted(self, trial: Noted) -> None:
        return

    def confirmed(self, evaluation: Evaluation) -> None:
        return
