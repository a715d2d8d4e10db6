"""Which tasks a study has, their names and their ends: on decks of bricks, skew shells and a bar on
soft mounts, solved by CalculiX, and on the scripted solver."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from modetune.core.errors import ModesError, SolverCancelled
from modetune.flows.campaign.campaign import Campaign, load_campaign
from modetune.flows.jobs.execution import EACH_A_TASK
from modetune.flows.jobs.progress import Ended, JobProgress, doing
from modetune.flows.jobs.runner import Computation, PoolRunner, Task, TaskRun, TaskState, task_state
from modetune.flows.jobs.tasks import StudyRun, Tasks, use_run
from modetune.flows.studies.screen.request import ScreeningRequest
from modetune.flows.studies.screen.screening import screen_campaign
from modetune.flows.updating.forecast import Unwatched
from modetune.flows.updating.update import update_from_starts
from tests.adapters.solved import needs_ccx
from tests.flows.conftest import Bench, Watcher
from tests.flows.updating.test_reduced_model import CASES
from tests.flows.updating.test_stored_matrices import BAR, STORED, written

TRUTH = {"k1": 1.2, "k4": 0.9}


class Recorder(PoolRunner):
    """Threads of this process; keeps each task's name and how it ended."""

    def __init__(self) -> None:
        super().__init__(2)
        self.begun: list[tuple[str, TaskRun]] = []
        self.computed: list[tuple[str, str]] = []

    def submit(self, name: str, task: Task, after: Sequence[TaskRun]) -> TaskRun:
        run = super().submit(name, task, after)
        self.begun.append((name, run))
        return run

    def compute(self, name: str, work: Computation[Any], after: Sequence[TaskRun]) -> None:
        self.computed.append((name, work.run().name))

    def note(self, name: str, end: TaskState, after: Sequence[TaskRun]) -> None:
        self.computed.append((name, end.name))

    @property
    def ended(self) -> list[tuple[str, str]]:
        solved = [(name, task_state(task.result().jobs).name) for name, task in self.begun]
        return solved + self.computed

    def states(self, part: str) -> Counter[str]:
        return Counter(state for name, state in self.ended if part in name)


def screened(campaign: Campaign, points: int) -> tuple[Recorder, Any]:
    """The tasks of a screening, and what it found."""
    runner, request = Recorder(), ScreeningRequest("lhs", points=points)
    with use_run(StudyRun(runner)):
        return runner, screen_campaign(campaign, request, Unwatched().working)


def updated(campaign: Campaign, folder: Path) -> Recorder:
    """The tasks of an update."""
    runner = Recorder()
    with use_run(StudyRun(runner)):
        run = update_from_starts(campaign, folder, Watcher())
    assert run.record.status == "converged"
    return runner


@needs_ccx
@pytest.mark.parametrize("name", CASES)
def test_many_sets_by_a_reduced_model_are_one_piece_however_many(name: str, tmp_path: Path) -> None:
    few, _ = screened(load_campaign(written(CASES[name], tmp_path / "few")), 24)
    many, found = screened(load_campaign(written(CASES[name], tmp_path / "many")), 240)
    assert found.runs.modal == 1
    assert few.states("24 sets by the reduced model") == {"Derived": 1}
    assert many.states("240 sets by the reduced model") == {"Derived": 1}
    assert many.states("modal confirmation by calculix") == {"Completed": 1}
    # A set that the model does not hold for is a full solution and a piece of its own.
    full = [runner.states("points of the design, ") for runner in (few, many)]
    assert len(many.ended) - full[1].total() <= len(few.ended) - full[0].total() + 2


def test_pieces_of_a_screening_are_named_by_the_point_that_they_are_for(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("modetune.flows.updating.evaluator.TOGETHER", 3)
    runner, _ = screened(bench.campaign(TRUTH), 5)
    assert runner.states("deck's values / modal") == {"Completed": 1}
    assert runner.states("points of the design, 1 to 3 of 5 / modal 2 of 3") == {"Completed": 1}
    assert runner.states("points of the design, 4 to 5 of 5 / modal 2 of 2") == {"Completed": 1}
    assert not runner.states("iteration")


@needs_ccx
def test_solutions_of_points_by_matrices_are_named_by_the_point_too(tmp_path: Path) -> None:
    runner, _ = screened(load_campaign(written(BAR, tmp_path / "bar"), [STORED]), 5)
    for point in range(1, 6):
        name = f"points of the design, {point} of 5 / modal by stored matrices"
        assert runner.states(name) == {"Completed": 1}
    assert not runner.states("iteration")


@needs_ccx
def test_an_update_by_matrices_has_tasks_for_modes_columns_and_confirmation(tmp_path: Path) -> None:
    campaign = load_campaign(written(BAR, tmp_path / "bar"), [STORED])
    runner, again = (updated(campaign, tmp_path / "run") for _ in range(2))
    assert runner.states("iteration 0 / modal by stored matrices") == {"Completed": 1}
    assert set(again.states("modal by stored matrices")) == {"Cached"}
    names = [f"iteration 0 / sensitivity {name}" for name in campaign.parameters.names]
    assert all(runner.states(name) == {"Derived": 1} for name in names)
    assert runner.states("modal confirmation by calculix") == {"Completed": 1}
    assert again.states("modal confirmation by calculix") == {"Cached": 1}


def test_the_names_of_tasks_distinguish_updates_in_parallel(bench: Bench) -> None:
    campaign = bench.campaign(TRUTH)
    two = campaign.update.model_copy(update={"starts": 2})
    runner = updated(replace(campaign, update=two), bench.folder / "run")
    for title in ("start 1, iteration 0 / modal", "start 2, iteration 0 / modal"):
        assert runner.states(title).total() == 1


class Shown(JobProgress):
    """A display that keeps how pieces ended."""

    def __init__(self) -> None:
        super().__init__(Console(quiet=True))
        self.ended: list[Ended] = []

    def began(self, iteration: str, name: str) -> Callable[[Ended], None]:
        return self.ended.append


def test_a_computation_that_fails_has_ended_on_the_display() -> None:
    shown = Shown()
    tasks = Tasks(Recorder(), shown)

    def fail(error: BaseException) -> Any:
        raise error

    for error in (ModesError("lost"), KeyboardInterrupt()):
        with pytest.raises(type(error)), doing("model"):
            tasks.compute("modal", lambda error=error: fail(error))  # type: ignore[misc]
    assert [task_state(ended).name for ended in shown.ended] == ["Failed", "Cancelled"]
    assert tasks.compute("modal", lambda: (1.0, ())) == 1.0  # without a title: no task
    assert len(shown.ended) == 2


@pytest.mark.parametrize(
    ("done", "kind"),
    [(SolverCancelled("x"), "CANCELLED"), (ModesError("x"), "FAILED"), ((), "COMPLETED")],
)
def test_only_what_has_a_result_is_green(done: Ended, kind: str) -> None:
    assert task_state(done).kind == kind


def test_many_points_that_the_store_answers_are_one_task(bench: Bench) -> None:
    campaign = bench.campaign({"k1": 1.2, "k2": 0.8}, modes=(1, 2, 3))
    points = EACH_A_TASK + 20
    (first, found), (again, _) = (screened(campaign, points) for _ in range(2))
    assert found.responses.n_failed == 0
    assert first.states("points of the design / modal") == {"Completed": points}
    named = {name for name, _ in first.ended if "/ modal " in name}
    assert named == {
        f"points of the design / modal {place} of {points}" for place in range(1, points + 1)
    }
    assert bench.runs("modal") == points + 1
    assert again.states(f"points of the design / {points} cached results") == {"Cached": 1}
    assert len(again.ended) < 10
