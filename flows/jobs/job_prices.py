"""What jobs cost before: the medians of what the store has of a model, by kind of analysis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from modetune.flows.jobs.engine import JobEngine
from modetune.flows.jobs.job import JobNote
from modetune.flows.jobs.store_index import ask_index

#: So many of the newest results are looked at.
NEWEST = 100


@dataclass(frozen=True, slots=True)
class Price:
    """What one job costs: seconds from start to result, and cores times seconds."""

    wall_s: float
    core_s: float


def job_prices(engine: JobEngine, digest: str, newest: int = NEWEST) -> dict[str, Price]:
    """Prices by kind of analysis, as far as the newest results in the store tell.

    digest: of the model, `Plans.model_digest`.
    """
    solver, name = engine.solver.program.name, engine.solver.deck.summary.name
    found = ask_index(engine.store, lambda index: index.newest(newest))
    noted = [(item.job.note, item.wall_s) for item in found if item.job]
    ours = [(note, wall_s) for note, wall_s in noted if note and note.solver == solver]
    by_name = _medians([item for item in ours if item[0].model == name])
    return by_name | _medians([item for item in ours if item[0].model_digest == digest])


def _medians(noted: Sequence[tuple[JobNote, float]]) -> dict[str, Price]:
    prices = {}
    for kind in {note.analysis for note, _ in noted}:
        of_kind = [
            (wall_s, note.threads * wall_s) for note, wall_s in noted if note.analysis == kind
        ]
        prices[kind] = Price(
            median(wall_s for wall_s, _ in of_kind), median(core_s for _, core_s in of_kind)
        )
    return prices


def side_by_side(walls_s: Sequence[float], parallel: int) -> float:
    """How long jobs of these times take, so many at a time, the longest first."""
    ends = [0.0] * max(parallel, 1)
    for wall_s in sorted(walls_s, reverse=True):
        ends[ends.index(min(ends))] += wall_s
    return max(ends)
