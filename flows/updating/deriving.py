"""The sensitivity of all cases at an evaluation point, from the finders' derivatives.

A finder that cannot be believed is replaced; a column that one case lacks is missing altogether,
since half a derivative is a wrong one.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from modetune.core.algebra.factor_room import factor_room
from modetune.core.modes import Floats
from modetune.core.updating.residual import residual_sensitivity
from modetune.core.updating.responses.frequencies import Frequencies
from modetune.core.updating.responses.response import ModelState, StateDerivatives
from modetune.core.updating.results import ModeDerivatives
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.case import Case
from modetune.flows.jobs.watching import doing
from modetune.flows.updating.asked import Ahead, CaseState, Piece
from modetune.flows.updating.evaluation import (
    CaseEvaluation,
    Evaluation,
    Matrix,
    model_state,
    part_rows,
)
from modetune.flows.updating.finders import REDUCED, UNFIT, Columns
from modetune.flows.updating.pieces import Pieces
from modetune.flows.updating.sensitivities import UnbalancedEnergies, by_energies


@dataclass(frozen=True, slots=True)
class Deriving:
    """Derives a campaign's residual in the cases that are used."""

    campaign: Campaign
    used: Sequence[CaseState]
    pieces: Pieces

    def works(self, theta: Floats) -> list[Piece]:
        """What has to be carried out before the sensitivity at a set is found."""
        return [
            (state, work)
            for state in self.used
            for work in state.finder.sensitivity_works(state.own(theta), state.analysis)
        ]

    def matrix(self, title: str, evaluation: Evaluation, ahead: Ahead) -> Matrix:
        """The sensitivity at a point; ahead: what was carried out before."""
        columns: dict[int, Columns] = {}
        parts = list(evaluation.parts)
        waiting = list(range(len(parts)))
        while waiting:
            for place in waiting:
                parts[place] = self._suited(title, place, parts[place])
            works = [
                state.finder.sensitivity_works(parts[place].theta, state.analysis)
                for place, state in enumerate(self.used)
            ]
            listed = [(self.used[place], work) for place in waiting for work in works[place]]
            done = iter(self.pieces.run(title, listed, ahead))
            again = []
            for place in waiting:
                state, own = self.used[place], [next(done) for _ in works[place]]
                try:
                    with doing(title):
                        point = parts[place].point
                        columns[place] = state.finder.columns(point, state.analysis, own)
                    self._tell(title, state, columns[place])
                except UNFIT as error:
                    state.finder = state.finder.instead(error)
                    again.append(place)
            waiting = again
        return self._stacked(parts, [columns[place] for place in range(len(parts))])

    def by_energies(self, evaluation: Evaluation) -> Floats:
        """What strain energies tell of the sensitivity at a point, without a job: rows of
        frequencies (n_frequencies, n_parameters), NaN where they tell nothing."""
        parameters, parts = self.campaign.parameters.names, evaluation.parts
        whole = evaluation.residual.rows("frequencies")
        found = np.full((whole.stop - whole.start, len(parameters)), np.nan)
        for state, part, rows in zip(self.used, parts, part_rows(parts), strict=True):
            with suppress(UnbalancedEnergies):
                slopes = by_energies(part.point, state.campaign.parameters.names)
                place = np.ix_(rows[part.residual.rows("frequencies")], state.columns)
                found[place] = Frequencies().slopes(_model_state(state.case, part), slopes)
        return found

    def _tell(self, title: str, state: CaseState, columns: Columns) -> None:
        """Tell of columns that no work stood for: those of a reduced model around a set."""
        if state.finder.name != REDUCED and set(columns.methods) == {REDUCED}:
            named = state.campaign.parameters.names
            names = [state.case.of(f"sensitivity {name}") for name in named]
            reason = "follows from the reduced model"
            self.pieces.execution.skip(title, names, "Derived", reason)

    def _suited(self, title: str, place: int, part: CaseEvaluation) -> CaseEvaluation:
        """An evaluated case with all that its finder's derivatives are made of."""
        state = self.used[place]
        if state.finder.suits(part, state.analysis):
            return part
        key, modal = self.pieces.modes(title, state, part.theta, state.analysis)
        return state.compared(part.theta, key, modal, part, state.finder.name)

    def _stacked(self, parts: Sequence[CaseEvaluation], columns: Sequence[Columns]) -> Matrix:
        """The sensitivities of all cases as one."""
        names, rows = self.campaign.parameters.names, part_rows(parts)
        values = np.zeros((sum(own.size for own in rows), len(names)))
        methods: list[dict[str, None]] = [{} for _ in names]
        missing: set[int] = set()
        for state, part, found, own in zip(self.used, parts, columns, rows, strict=True):
            there = [n for n in range(state.columns.size) if n not in found.missing]
            seen = self._seen(state.case, part, found.derivatives)
            with factor_room(state.engine.room):
                values[np.ix_(own, state.columns[there])] = residual_sensitivity(
                    part.responses,
                    _model_state(state.case, part),
                    StateDerivatives(seen, tuple(there), found.derivatives),
                )
            missing |= {int(state.columns[column]) for column in found.missing}
            for column, method in zip(state.columns.tolist(), found.methods, strict=True):
                methods[column][method] = None
        values[:, sorted(missing)] = 0.0
        return Matrix(
            values=values,
            methods=tuple("+".join(found) for found in methods),
            keys=tuple(key for found in columns for key in found.keys),
            age=0,
            missing=tuple(sorted(missing)),
        )

    def _seen(
        self, case: Case, part: CaseEvaluation, derivatives: ModeDerivatives
    ) -> ModeDerivatives:
        """Derivatives of shapes as the test's sensors see them."""
        if not case.needs("shapes"):
            return derivatives
        modes = part.modal.modes
        observer = case.sensors.matrix(modes.nodes, modes.components)
        shapes = derivatives.mode_shapes
        seen = observer @ shapes.reshape(shapes.shape[0], -1)
        return replace(derivatives, mode_shapes=np.asarray(seen).reshape(-1, *shapes.shape[1:]))


def _model_state(case: Case, part: CaseEvaluation) -> ModelState:
    """An evaluated case as its responses see it."""
    return model_state(case, part.seen, part.pairing, part.modal, part.matrices)
