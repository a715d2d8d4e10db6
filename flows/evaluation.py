"""One evaluated parameter set: its modes, which answer the test, and how far they are from it."""

from __future__ import annotations

from dataclasses import dataclass

from modetune.core.criteria import Tolerances, agrees, frequency_errors
from modetune.core.estimation import Step
from modetune.core.modes import Floats, ModeSet
from modetune.core.pairing import Pairing, pair_by_order, pair_by_shape, pair_by_tracking
from modetune.core.residual import Residual, residual
from modetune.core.results import ModalResult
from modetune.flows.campaign import Campaign


@dataclass(frozen=True, slots=True)
class Point:
    """Where derivatives are taken: parameter values, the modes there, and which are paired."""

    theta: Floats
    modal: ModalResult
    pairing: Pairing


@dataclass(frozen=True, slots=True)
class Evaluation:
    """A model state compared with the test.

    modal: at the nodes that pairing and derivatives need; seen: its elastic modes as the test's
    sensors see them; field: the elastic modes at every node that was asked for.
    """

    theta: Floats
    key: str
    modal: ModalResult
    seen: ModeSet
    field: ModeSet
    pairing: Pairing
    residual: Residual
    errors: Floats

    @property
    def point(self) -> Point:
        return Point(self.theta, self.modal, self.pairing)

    def agrees(self, tolerances: Tolerances) -> bool:
        """Whether e1 holds; members of a cluster of close modes are judged by its space."""
        return agrees(self.errors, self.pairing.judged_mac, tolerances)


def compare(
    campaign: Campaign,
    theta: Floats,
    key: str,
    result: ModalResult,
    previous: Evaluation | None,
) -> Evaluation:
    """Pair the modes of a model state with the test. Raises LostMode, ModesError.

    Measured shapes decide where there are some; else the pairs of `previous` are tracked, and at
    first the order of frequencies decides.
    """
    test, modal = campaign.test, result.at(campaign.nodes)
    seen = campaign.sensors.observe(modal.elastic) if test.has_shapes else modal.elastic
    if test.has_shapes:
        pairing = pair_by_shape(test.modes, seen)
    elif previous is None:
        pairing = pair_by_order(test.modes, seen)
    else:
        pairing = pair_by_tracking(previous.pairing, previous.modal.elastic, modal.elastic)
    return Evaluation(
        theta=theta,
        key=key,
        modal=modal,
        seen=seen,
        field=result.elastic,
        pairing=pairing,
        residual=residual(test.modes, seen, pairing, campaign.weighting),
        errors=frequency_errors(test.modes, seen, pairing),
    )


def expects_agreement(step: Step, evaluation: Evaluation, tolerances: Tolerances) -> bool:
    """Whether the linear model promises that e1 will hold after a step.

    Then the modal job goes alone: sensitivities computed beside it would most likely be in vain.
    """
    n_frequencies = evaluation.residual.n_frequencies
    errors = 0.5 * step.predicted[:n_frequencies]  # z is of eigenvalues: twice the frequency's
    shapes = step.predicted[n_frequencies:]
    mac = 1.0 - (shapes.reshape(n_frequencies, -1) ** 2).sum(axis=1)
    return agrees(errors, mac if shapes.size else evaluation.pairing.judged_mac, tolerances)
