"""Modes and whole cases held out of updating: the agreement before and after."""

from __future__ import annotations

import logging
from dataclasses import replace

from modetune.core.correlation.holdout import HeldOut, join_held_out, judge_held_out, unfound
from modetune.core.correlation.pairing import LostMode, Pairing
from modetune.core.errors import ModesError, SolverError
from modetune.core.modes import Floats, ModeSet
from modetune.flows.updating.evaluation import CaseEvaluation, Evaluation, judged
from modetune.flows.updating.evaluator import Evaluator
from modetune.flows.updating.mode_source import CAMPAIGNS_OWN, CaseState, ModeRequest

logger = logging.getLogger(__name__)


def held_out(evaluator: Evaluator, initial: Evaluation, updated: Evaluation) -> HeldOut | None:
    """Return how held-out modes and cases agree before and after; None where there are none.

    Each held-out case takes two modal runs.
    """
    found = [
        (state, held)
        for state, before, after in zip(evaluator.used, initial.parts, updated.parts, strict=True)
        if (held := judged(state.case, before, after)) is not None
    ]
    found += [
        (state, _case_held_out(evaluator, state, initial.theta, updated.theta))
        for state in evaluator.aside
    ]
    if not evaluator.campaign.only:  # results of several cases carry their names
        found = [
            (state, replace(held, configurations=(state.case.name,) * held.numbers.size))
            for state, held in found
        ]
    return join_held_out([held for _, held in found])


def _case_held_out(
    evaluator: Evaluator, state: CaseState, initial: Floats, updated: Floats
) -> HeldOut:
    states: list[tuple[ModeSet, Pairing]] = []
    before = None
    for theta in (initial, updated):
        try:
            before = _evaluated(evaluator, state, state.own(theta), before)
            states.append((before.seen, before.pairing))
        except (ModesError, SolverError) as error:
            if isinstance(error, CAMPAIGNS_OWN):
                raise
            logger.warning("the held-out configuration %s: %s", state.case.name, error)
            states.append(unfound(state.case.test))
    return judge_held_out(state.case.test, state.case.weighting.frequency_deviations, *states)


def _evaluated(
    evaluator: Evaluator, state: CaseState, theta: Floats, before: CaseEvaluation | None
) -> CaseEvaluation:
    item = ModeRequest(0, state, theta, state.analysis)
    while True:
        key, modal = evaluator.case_modes("held out", state, theta, item.analysis)
        try:
            return item.compared(key, modal, before)
        except LostMode as error:
            if not item.widen(error, modal.modes.n_modes):
                raise
