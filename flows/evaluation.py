"""One evaluated parameter set: its modes, which answer the test, and how far they are from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modetune.core.criteria import Tolerances, agrees, frequency_errors
from modetune.core.estimation import Step
from modetune.core.held_out import HeldOut, judge_held_out, pair_held_out, track_held_out
from modetune.core.modes import Floats, Integers, ModeSet
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
    sensors see them; field: the elastic modes at every node that was asked for; held_out: where
    the test's held-out modes are among them; parts: the evaluations of a campaign's configurations
    of which this one is made; solved_by: the program that found the modes.
    """

    theta: Floats
    key: str
    modal: ModalResult
    seen: ModeSet
    field: ModeSet
    pairing: Pairing
    residual: Residual
    errors: Floats
    held_out: Pairing | None = None
    parts: tuple[Evaluation, ...] = ()
    solved_by: str = ""

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
    solved_by: str = "",
) -> Evaluation:
    """Pair the modes of a model state with the test. Raises LostMode, ModesError.

    solved_by: the program that found them, the campaign's solver unless told. Measured shapes
    decide where there are some; else the pairs of `previous` are tracked, and at first the order
    of frequencies decides.
    """
    test, modal = campaign.test, result.at(campaign.nodes)
    seen = campaign.sensors.observe(modal.elastic) if test.has_shapes else modal.elastic
    if test.has_shapes:
        pairing = pair_by_shape(test.modes, seen)
    elif previous is None:
        others = () if campaign.held_out is None else campaign.held_out.modes.frequencies_hz
        pairing = pair_by_order(test.modes, seen, others)
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
        held_out=_held_out(campaign, seen, pairing, previous),
        solved_by=solved_by or campaign.solver.name,
    )


def _held_out(
    campaign: Campaign, seen: ModeSet, pairing: Pairing, previous: Evaluation | None
) -> Pairing | None:
    """Where the modes that are only judged by are; a lost one is no error."""
    held = campaign.held_out
    if held is None:
        return None
    if held.has_shapes or previous is None or previous.held_out is None:
        return pair_held_out(held, campaign.test, seen, pairing)
    return track_held_out(previous.held_out, previous.seen, seen, pairing)


def judged(campaign: Campaign, initial: Evaluation, updated: Evaluation) -> HeldOut | None:
    """The modes that are only judged by, before and after; None where there are none."""
    if campaign.held_out is None or initial.held_out is None or updated.held_out is None:
        return None
    return judge_held_out(
        campaign.held_out, campaign.weighting.frequency_deviation,
        (initial.seen, initial.held_out), (updated.seen, updated.held_out),
    )  # fmt: skip


def part_rows(parts: Sequence[Evaluation]) -> list[Integers]:
    """Of each configuration the rows it has in the whole residual: frequencies of all come first,
    then shapes of all."""
    n_frequencies = [part.residual.n_frequencies for part in parts]
    n_shapes = [part.residual.values.size - n for part, n in zip(parts, n_frequencies, strict=True)]
    rows, first, shape = [], 0, sum(n_frequencies)
    for frequencies, shapes in zip(n_frequencies, n_shapes, strict=True):
        rows.append(np.r_[first : first + frequencies, shape : shape + shapes])
        first, shape = first + frequencies, shape + shapes
    return rows


def expects_agreement(step: Step, evaluation: Evaluation, tolerances: Tolerances) -> bool:
    """Whether the linear model promises that e1 will hold after a step.

    Then the modal job goes alone: sensitivities computed beside it would most likely be in vain.
    """
    if evaluation.parts:
        shares = zip(evaluation.parts, part_rows(evaluation.parts), strict=True)
        return all(
            expects_agreement(replace(step, predicted=step.predicted[rows]), part, tolerances)
            for part, rows in shares
        )
    n_frequencies = evaluation.residual.n_frequencies
    errors = 0.5 * step.predicted[:n_frequencies]  # z is of eigenvalues: twice the frequency's
    shapes = step.predicted[n_frequencies:]
    mac = 1.0 - (shapes.reshape(n_frequencies, -1) ** 2).sum(axis=1)
    return agrees(errors, mac if shapes.size else evaluation.pairing.judged_mac, tolerances)
