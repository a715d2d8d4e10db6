"""Pieces of the cases' work: carried out side by side, each once, and counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from modetune.adapters.solver import ModalAnalysis
from modetune.core.errors import ModetuneError
from modetune.core.modes import Floats
from modetune.core.storage.record import RunCounts
from modetune.core.updating.results import ModalResult
from modetune.flows.jobs.engine import JobOutcome
from modetune.flows.jobs.execution import Done, Execution, Work
from modetune.flows.jobs.watching import doing
from modetune.flows.updating.asked import Ahead, CaseState, Piece
from modetune.flows.updating.finders import UNFIT


class Pieces:
    """Where pieces are carried out, and what they cost so far."""

    def __init__(self, execution: Execution) -> None:
        self.execution = execution
        self._runs = RunCounts()

    @property
    def runs(self) -> RunCounts:
        """Solver runs so far, and what they cost."""
        ledger = self.execution.engine.ledger
        return replace(self._runs, core_s=ledger.core_s, licence_s=ledger.licence_s)

    def run(
        self, title: str, works: Sequence[Piece], ahead: Ahead, beside: Sequence[Piece] = ()
    ) -> list[Done]:
        """What became of each piece, in order, and counts the runs.

        Pieces that were carried out ahead are not run again; those beside are kept for later.
        """
        listed = {_identity(piece): piece for piece in (*works, *beside)}
        missing = {mark: piece for mark, piece in listed.items() if mark not in ahead}
        if missing:
            named = _numbered([state.named(work) for state, work in missing.values()])
            for mark, work, done in zip(
                missing, named, self.execution.run(title, named), strict=True
            ):
                ahead[mark] = done
                if not isinstance(done, ModetuneError):
                    self._runs = self._runs.plus(outcomes_count(work.name, done))
        return [ahead[_identity(piece)] for piece in works]

    def modes(
        self, title: str, state: CaseState, theta: Floats, analysis: ModalAnalysis
    ) -> tuple[str, ModalResult]:
        """The key and the modes of one case at a set."""
        while True:
            works = [(state, work) for work in state.finder.works(theta, analysis)]
            done = self.run(title, works, Ahead())
            try:
                with doing(title):
                    return state.finder.modes(theta, analysis, done)
            except UNFIT as error:
                state.finder = state.finder.instead(error)


def _numbered(works: Sequence[Work]) -> list[Work]:
    """Pieces with a name each: those of one name, as of many sets, are numbered."""
    many, place = Counter(work.name for work in works), Counter[str]()
    told = []
    for work in works:
        place[work.name] += 1
        which = f" {place[work.name]} of {many[work.name]}" if many[work.name] > 1 else ""
        told.append(replace(work, name=work.name + which))
    return told


def _identity(piece: Piece) -> tuple[object, ...]:
    """What a piece of work is told from others by."""
    state, work = piece
    return id(state), work.name, *((*job.values.items(), job.analysis) for job in work.jobs)


def outcomes_count(name: str, outcomes: tuple[JobOutcome, ...]) -> RunCounts:
    """The runs of one piece of work by kind."""
    ran = sum(not outcome.reused for outcome in outcomes)
    modal = name.startswith("modal")
    return RunCounts(
        modal=ran if modal else 0, sensitivity=0 if modal else ran, reused=len(outcomes) - ran
    )
