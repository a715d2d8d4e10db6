"""Who watches hears of every solution, by solver or by matrices, and of many sets once: on decks of
bricks, skew shells and a bar on soft mounts, solved by CalculiX."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from modetune.core.errors import ModesError, SolverCancelled
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.jobs.watching import Derivation, Ended, doing, part_of, told
from modetune.flows.jobs.work import TOLD_EACH
from modetune.flows.studies.requests import ScreeningRequest
from modetune.flows.studies.screen.running import screen_campaign
from modetune.flows.updating.prefect import became
from modetune.flows.updating.starts import update_from_starts
from modetune.flows.updating.updating import Unwatched
from tests.adapters.solved import needs_ccx
from tests.flows.conftest import Bench, Watcher
from tests.flows.updating.test_by_matrices import BAR, STORED, written
from tests.flows.updating.test_by_range import CASES

TRUTH = {"k1": 1.2, "k4": 0.9}


class Heard:
    """Keeps each piece's name and the state that it ended in; the pages' own words."""

    name = "heard"

    def __init__(self) -> None:
        self.ended: list[tuple[str, str]] = []
        self.begun = 0

    def began(self, iteration: str, name: str) -> Callable[[Ended], None]:
        self.begun += 1
        return lambda done: self.ended.append((f"{iteration} / {name}", became(done)[1]))

    def skipped(
        self, iteration: str, names: Sequence[str], reason: str, state: str = "Skipped"
    ) -> None:
        self.begun += len(names)
        self.ended += [(f"{iteration} / {name}", state) for name in names]

    def log(self, text: str) -> None:
        return

    def sheet(self, sheet: object) -> None:
        return

    def states(self, part: str) -> Counter[str]:
        return Counter(state for name, state in self.ended if part in name)


def screened(file: Path, points: int) -> tuple[Heard, Any]:
    heard, request = Heard(), ScreeningRequest("lhs", points=points)
    found = screen_campaign(load_campaign(file), request, Unwatched().working, heard)
    assert heard.begun == len(heard.ended)  # what begins ends
    return heard, found


@needs_ccx
@pytest.mark.parametrize("name", CASES)
def test_many_sets_by_a_reduced_model_are_one_piece_however_many(name: str, tmp_path: Path) -> None:
    few, _ = screened(written(CASES[name], tmp_path / "few"), 24)
    many, found = screened(written(CASES[name], tmp_path / "many"), 240)
    assert found.runs.modal == 1
    assert few.states("24 sets by the reduced model") == {"Derived": 1}
    assert many.states("240 sets by the reduced model") == {"Derived": 1}
    assert many.states("modal confirmation by calculix") == {"Completed": 1}
    # A set that the model does not hold for is a full solution and a piece of its own.
    full = [heard.states("points of the design, ") for heard in (few, many)]
    assert many.begun - full[1].total() <= few.begun - full[0].total() + 2


def test_pieces_of_a_screening_are_named_by_the_point_that_they_are_for(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("modetune.flows.updating.evaluator.TOGETHER", 3)
    heard, request = Heard(), ScreeningRequest("lhs", points=5)
    screen_campaign(bench.campaign(TRUTH), request, Unwatched().working, heard)
    assert heard.states("deck's values / modal") == {"Completed": 1}
    assert heard.states("points of the design, 1 to 3 of 5 / modal 2 of 3") == {"Completed": 1}
    assert heard.states("points of the design, 4 to 5 of 5 / modal 2 of 2") == {"Completed": 1}
    assert not heard.states("iteration")


@needs_ccx
def test_solutions_of_points_by_matrices_are_named_by_the_point_too(tmp_path: Path) -> None:
    campaign, heard = load_campaign(written(BAR, tmp_path / "bar"), [STORED]), Heard()
    screen_campaign(campaign, ScreeningRequest("lhs", points=5), Unwatched().working, heard)
    for point in range(1, 6):
        name = f"points of the design, {point} of 5 / modal by stored matrices"
        assert heard.states(name) == {"Completed": 1}
    assert not heard.states("iteration")


@needs_ccx
def test_an_update_by_matrices_tells_of_modes_columns_and_confirmation(tmp_path: Path) -> None:
    campaign = load_campaign(written(BAR, tmp_path / "bar"), [STORED])
    heard, again = Heard(), Heard()
    for watcher in (heard, again):
        run = update_from_starts(campaign, tmp_path / "run", Watcher(), watcher)  # type: ignore[arg-type]  # no end
        assert run.record.status == "converged"
    assert heard.states("iteration 0 / modal by stored matrices") == {"Completed": 1}
    assert set(again.states("modal by stored matrices")) == {"Cached"}
    names = [f"iteration 0 / sensitivity {name}" for name in campaign.parameters.names]
    assert all(heard.states(name) == {"Derived": 1} for name in names)
    assert heard.states("modal confirmation by calculix") == {"Completed": 1}
    assert again.states("modal confirmation by calculix") == {"Cached": 1}


def test_updates_side_by_side_are_told_apart(bench: Bench) -> None:
    campaign, heard = bench.campaign(TRUTH), Heard()
    two = campaign.update.model_copy(update={"starts": 2})
    update_from_starts(
        replace(campaign, update=two),
        bench.folder / "run",
        Watcher(),
        heard,  # type: ignore[arg-type]  # no end
    )
    for title in ("start 1, iteration 0 / modal", "start 2, iteration 0 / modal"):
        assert heard.states(title).total() == 1


def test_a_piece_that_breaks_off_has_ended(tmp_path: Path) -> None:
    heard = Heard()
    for error in (ModesError("lost"), KeyboardInterrupt()):
        with pytest.raises(type(error)), doing("model"), told(heard, "modal"):
            raise error
    assert [state for _, state in heard.ended] == ["Failed", "Cancelled"]
    with told(heard, "modal") as outcomes:  # nobody asked for its title
        outcomes.append(Derivation("key", True, 0.0))
    assert heard.begun == 2
    assert part_of(None, "start 1") is None


@pytest.mark.parametrize(
    ("done", "kind"),
    [(SolverCancelled("x"), "CANCELLED"), (ModesError("x"), "FAILED"), ((), "COMPLETED")],
)
def test_only_what_has_a_result_is_green(done: Ended, kind: str) -> None:
    assert became(done)[0] == kind


def test_many_points_that_the_store_answers_are_one_piece(bench: Bench) -> None:
    campaign = bench.campaign({"k1": 1.2, "k2": 0.8}, modes=(1, 2, 3))
    request = ScreeningRequest("lhs", points=TOLD_EACH + 20)
    first, again = Heard(), Heard()
    for heard in (first, again):
        found = screen_campaign(campaign, request, Unwatched().working, heard)
        assert found.responses.n_failed == 0
    assert first.states("points of the design / modal") == {"Completed": TOLD_EACH + 20}
    named = {name for name, _ in first.ended if "/ modal " in name}
    assert named == {
        f"points of the design / modal {place} of {TOLD_EACH + 20}"
        for place in range(1, TOLD_EACH + 21)
    }
    assert bench.runs("modal") == TOLD_EACH + 21
    assert again.states(f"points of the design / {TOLD_EACH + 20} results of the store") == {
        "Cached": 1
    }
    assert again.begun < 10
