"""A solver that always fails is told after few jobs; one that works runs its jobs side by side."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from modetune.adapters.solver import ModalAnalysis
from modetune.core.errors import SolverCancelled, SolverCrashed, SolverError
from modetune.flows.campaign.schema import SensitivitySection
from modetune.flows.jobs.engine import JobOutcome
from modetune.flows.jobs.execution import FIRST_FAILURES, Done, Execution, Work
from modetune.flows.jobs.job import Job
from tests.flows.updating.test_update import TRUTH, run

JOB = Job({}, ModalAnalysis(1, ()))
BROKEN = SolverCrashed("it broke off")


class Skips:
    """Tasks that keep the names of the skipped ones."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def note(self, iteration: str, names: Sequence[str], state: str, reason: str) -> None:
        self.names += names


class Scripted(Execution):
    """An execution that answers by a piece's name, and keeps what was asked at once."""

    def __init__(self, answers: dict[str, SolverError | bool]) -> None:
        self.tasks = Skips()
        engine: Any = SimpleNamespace(may_run=True, tasks=self.tasks)
        super().__init__(engine)
        self.answers = answers
        self.batches: list[list[str]] = []

    @property
    def skipped(self) -> list[str]:
        return self.tasks.names

    def _together(self, iteration: str, works: Sequence[Work]) -> list[Done]:
        self.batches.append([piece.name for piece in works])
        return [self._answer(self.answers.get(piece.name, False)) for piece in works]

    def _answer(self, answer: SolverError | bool) -> Done:
        engine: Any = None
        if isinstance(answer, SolverError):
            return answer
        return (JobOutcome(JOB, "key", answer, 1.0, engine),)


def pieces(*names: str) -> list[Work]:
    return [Work(name, (JOB,)) for name in names]


def test_after_the_first_success_all_run_at_once() -> None:
    scripted = Scripted({})
    assert len(scripted.run("1", pieces("modal", "sensitivity a", "sensitivity b"))) == 3
    scripted.run("2", pieces("modal", "sensitivity a"))
    assert scripted.batches == [["modal"], ["sensitivity a", "sensitivity b"],
                                ["modal", "sensitivity a"]]  # fmt: skip


def test_what_the_store_had_was_a_success_of_the_solver() -> None:
    scripted = Scripted({"modal": True})
    scripted.run("1", pieces("modal", "sensitivity a", "sensitivity b"))
    assert scripted.batches == [["modal"], ["sensitivity a", "sensitivity b"]]


def test_work_of_other_kinds_is_not_tried_after_a_failure() -> None:
    scripted = Scripted({"modal": BROKEN})
    done = scripted.run("1", pieces("modal", "sensitivity a", "sensitivity b"))
    assert scripted.batches == [["modal"]]
    assert scripted.skipped == ["sensitivity a", "sensitivity b"]
    assert done[0] is BROKEN
    for item in done[1:]:
        assert isinstance(item, SolverCrashed)
        assert str(item) == "not tried: no job has succeeded so far: it broke off"


@pytest.mark.parametrize("bad", range(1, 6))
def test_few_points_are_tried_until_one_succeeds_or_three_failed(bad: int) -> None:
    names = [f"modal {number}" for number in range(8)]
    scripted = Scripted(dict.fromkeys(names[:bad], BROKEN))
    done = scripted.run("points", pieces(*names))
    failed = sum(isinstance(item, SolverError) for item in done)
    assert len(done) == 8
    assert failed == (bad if bad < FIRST_FAILURES else 8)
    assert sum(map(len, scripted.batches)) == (8 if bad < FIRST_FAILURES else FIRST_FAILURES)
    assert len(scripted.batches[0]) == FIRST_FAILURES


def test_matrix_jobs_go_side_by_side_from_the_start() -> None:
    scripted = Scripted({})
    scripted.run("1", pieces("matrices 1 of 2", "matrices 2 of 2", "modal"))
    assert scripted.batches == [["matrices 1 of 2", "matrices 2 of 2"], ["modal"]]


def test_failures_of_two_kinds_count_together() -> None:
    scripted = Scripted(dict.fromkeys(["modal 0", "modal 1", "other 0", "modal 2"], BROKEN))
    scripted.run("1", pieces("modal 0", "modal 1", "other 0", "modal 2", "modal 3"))
    assert scripted.batches == [["modal 0", "modal 1"], ["other 0"]]
    assert scripted.skipped == ["modal 2", "modal 3"]


def test_a_campaign_that_ends_tries_nothing_more() -> None:
    scripted = Scripted({"modal 0": SolverCancelled("the campaign is ending")})
    names = [f"modal {number}" for number in range(FIRST_FAILURES + 1)]
    scripted.run("points", pieces(*names))
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
