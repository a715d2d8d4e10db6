"""Modes and whole cases that are only judged by: how they are met before and after updating."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

from modetune.core.correlation.held_out import HeldOut, join_held_out, judge_held_out, unfound
from modetune.core.correlation.pairing import LostMode, Pairing
from modetune.core.errors import ModesError, SolverError
from modetune.core.modes import Floats, ModeSet
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.updating.asked import AskedModes, CaseState
from modetune.flows.updating.evaluation import CaseEvaluation, Evaluation, judged
from modetune.flows.updating.finders import CAMPAIGNS_OWN
from modetune.flows.updating.pieces import Pieces

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class HoldingOut:
    """used: cases that are updated by; aside: those that are held out."""

    campaign: Campaign
    used: Sequence[CaseState]
    aside: Sequence[CaseState]
    pieces: Pieces

    def before_and_after(self, initial: Evaluation, updated: Evaluation) -> HeldOut | None:
        """Modes and whole cases that are only judged by, before and after.

        A case that is held out takes two modal runs.
        """
        found = [
            self._named(held, state)
            for state, before, after in zip(self.used, initial.parts, updated.parts, strict=True)
            if (held := judged(state.case, before, after)) is not None
        ]
        found += [self._judged_aside(state, initial.theta, updated.theta) for state in self.aside]
        return join_held_out(found)

    def _judged_aside(self, state: CaseState, initial: Floats, updated: Floats) -> HeldOut:
        states: list[tuple[ModeSet, Pairing]] = []
        before = None
        for theta in (initial, updated):
            try:
                before = self._aside_part(state, state.own(theta), before)
                states.append((before.seen, before.pairing))
            except (ModesError, SolverError) as error:
                if isinstance(error, CAMPAIGNS_OWN):
                    raise
                logger.warning("the held-out configuration %s: %s", state.case.name, error)
                states.append(unfound(state.case.test))
        deviations = state.case.weighting.frequency_deviations
        return self._named(judge_held_out(state.case.test, deviations, *states), state)

    def _aside_part(
        self, state: CaseState, theta: Floats, before: CaseEvaluation | None
    ) -> CaseEvaluation:
        item = AskedModes(0, state, theta, state.analysis)
        while True:
            key, modal = self.pieces.modes("held out", state, theta, item.analysis)
            try:
                return item.compared(key, modal, before)
            except LostMode as error:
                if not item.widen(error, modal.modes.n_modes):
                    raise

    def _named(self, held: HeldOut, state: CaseState) -> HeldOut:
        """With the name of the case, where there are several."""
        several = () if self.campaign.only else (state.case.name,) * held.numbers.size
        return replace(held, configurations=several)
