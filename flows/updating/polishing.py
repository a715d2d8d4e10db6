"""Polishing: from where e1 holds on to the least misfit beside it, without leaving e1.

Where sets cost little, and as far as the test tells: what it does not see stays as it is. An old
matrix that led to the end goes on as long as it moves a value, if new ones would end at the same.
"""

from __future__ import annotations

import logging

import numpy as np

from modetune.core.errors import ModesError, SolverError
from modetune.flows.updating.finders import CAMPAIGNS_OWN
from modetune.flows.updating.trials import State, Trial, Trials, TrialStep

logger = logging.getLogger(__name__)

#: Largest parameter change that the least misfit is not worth, where e1 holds.
POLISHED = 1e-4
#: ... where an old matrix led there, and new ones are to end at the same values.
SAME_END = 1e-3


def polished(trials: Trials, state: State) -> Trial | None:
    """The next set on the way from a state that meets e1, None where that is not worth more."""
    current, stepping = state.current, trials.stepping
    old = trials.between.goes_on(state.matrix, current)
    if not old and not trials.evaluator.polishes(current):
        return None
    matrix = trials.matrix(state)
    if old:
        step = trials.step(lambda: stepping.step(current, matrix, state.region))
        least = SAME_END
    else:
        step = trials.step(lambda: stepping.to_least_misfit(current, matrix))
        least = POLISHED
    while np.max(np.abs(step.change)) >= least and not trials.used_up():
        found = _better(trials, state, TrialStep(step, matrix, state.region, current))
        if found is not None or old:
            return found
        step = stepping.halved(current, matrix, step)
    return None


def _better(trials: Trials, state: State, by: TrialStep) -> Trial | None:
    """The set of a step, None where it is not better, or e1 does not hold there."""
    try:
        trial = trials.tried(state, by)
    except (SolverError, ModesError) as error:
        if isinstance(error, CAMPAIGNS_OWN):
            raise
        logger.info("%s; shorter step", error)
        return None
    better = trials.stepping.better(state.current, trial.evaluation, by.step)
    if better and trial.evaluation.agrees(trials.campaign.tolerances):
        return trial
    trials.note(trial, "worse: shorter step")
    return None
