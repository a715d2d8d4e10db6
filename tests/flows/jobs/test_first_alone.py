"""A solver that always fails is told after few jobs; one that works runs its jobs side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import pytest

from modetune.adapters.solver import ModalAnalysis
from modetune.core.errors import SolverCancelled, SolverCrashed, SolverError
from modetune.flows.campaign.schema import SensitivitySection
from modetune.flows.jobs.engine import JobOutcome
from modetune.flows.jobs.first_alone import FIRST_FAILURES, FirstAlone
from modetune.flows.jobs.job import Job
from modetune.flows.jobs.work import Done, Work
from tests.flows.updating.test_updating import TRUTH, run

JOB = Job({}, ModalAnalysis(1, ()))
BROKEN = SolverCrashed("it broke off")


@dataclass
class Scripted:
    """An execution that answers by a piece's name, and keeps what was asked at once."""

    answers: dict[str, SolverError | bool]
    batches: list[list[str]] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)

    def run(self, iteration: str, work: Sequence[Work]) -> list[Done]:
        self.batches.append([piece.name for piece in work])
        return [self._answer(self.answers.get(piece.name, False)) for piece in work]

    def _answer(self, answer: SolverError | bool) -> Done:
        engine: Any = None
        if isinstance(answer, SolverError):
            return answer
        return (JobOutcome(JOB, "key", answer, 1.0, engine),)

    def skip(
        self, iteration: str, names: Sequence[str], reason: str, state: str = "Skipped"
    ) -> None:
        self.skipped += names


def pieces(*names: str) -> list[Work]:
    return [Work(name, (JOB,)) for name in names]


def test_after_the_first_success_all_run_at_once() -> None:
    scripted = Scripted({})
    execution = FirstAlone(scripted)
    assert len(execution.run("1", pieces("modal", "sensitivity a", "sensitivity b"))) == 3
    execution.run("2", pieces("modal", "sensitivity a"))
    assert scripted.batches == [["modal"], ["sensitivity a", "sensitivity b"],
                                ["modal", "sensitivity a"]]  # fmt: skip


def test_what_the_store_had_was_a_success_of_the_solver() -> None:
    scripted = Scripted({"modal": True})
    FirstAlone(scripted).run("1", pieces("modal", "sensitivity a", "sensitivity b"))
    assert scripted.batches == [["modal"], ["sensitivity a", "sensitivity b"]]


def test_work_of_other_kinds_is_not_tried_after_a_failure() -> None:
    scripted = Scripted({"modal": BROKEN})
    done = FirstAlone(scripted).run("1", pieces("modal", "sensitivity a", "sensitivity b"))
    assert scripted.batches == [["modal"]]
    assert scripted.skipped == ["sensitivity a", "sensitivity b"]
    assert done[0] is BROKEN
    for item in done[1:]:
        assert isinstance(item, SolverCrashed)
        assert str(item) == "not tried, for no job has succeeded so far: it broke off"


@pytest.mark.parametrize("bad", range(1, 6))
def test_few_points_are_tried_until_one_succeeds_or_three_failed(bad: int) -> None:
    names = [f"modal {number}" for number in range(8)]
    scripted = Scripted(dict.fromkeys(names[:bad], BROKEN))
    done = FirstAlone(scripted).run("points", pieces(*names))
    failed = sum(isinstance(item, SolverError) for item in done)
    assert len(done) == 8
    assert failed == (bad if bad < FIRST_FAILURES else 8)
    assert sum(map(len, scripted.batches)) == (8 if bad < FIRST_FAILURES else FIRST_FAILURES)
    assert len(scripted.batches[0]) == FIRST_FAILURES


def test_matrix_jobs_go_side_by_side_from_the_start() -> None:
    scripted = Scripted({})
    FirstAlone(scripted).run("1", pieces("matrices 1 of 2", "matrices 2 of 2", "modal"))
    assert scripted.batches == [["matrices 1 of 2", "matrices 2 of 2"], ["modal"]]


def test_failures_of_two_kinds_count_together() -> None:
    scripted = Scripted(dict.fromkeys(["modal 0", "modal 1", "other 0", "modal 2"], BROKEN))
    FirstAlone(scripted).run("1", pieces("modal 0", "modal 1", "other 0", "modal 2", "modal 3"))
    assert scripted.batches == [["modal 0", "modal 1"], ["other 0"]]
    assert scripted.skipped == ["modal 2", "modal 3"]


def test_a_campaign_that_ends_tries_nothing_more() -> None:
    scripted = Scripted({"modal 0": SolverCancelled("the campaign is ending")})
    names = [f"modal {number}" for number in range(FIRST_FAILURES + 1)]
    FirstAlone(scripted).run("points", pieces(*names))
    assert scripted.batches == [names[:FIRST_FAILURES]]


@pytest.mark.parametrize(("behaviour", "retries"), [("killed", 2), ("short", 1), ("killed", 0)])
def test_a_solver_that_always_fails_is_run_once_and_its_retries(
    bench: Any, watcher: Any, behaviour: str, retries: int
) -> None:
    bench.script(dict.fromkeys(range(1, 100), behaviour))
    sensitivity = SensitivitySection(method="finite_difference")
    campaign = bench.campaign(TRUTH, retries=retries, sensitivity=sensitivity)
    with pytest.raises(SolverCrashed):
        run(bench, watcher, campaign)
    assert bench.runs() == 1 + retries
