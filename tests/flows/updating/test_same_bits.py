"""By stored matrices: killed and run again, a campaign ends on the bits of one undisturbed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modetune.core.algebra.eigen import ModeSolver, SolvedModes
from modetune.core.algebra.pencil import Pencil
from modetune.core.errors import ModetuneError
from modetune.core.storage.campaign_record import read_record
from modetune.core.storage.store import Entry, Store
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.studies.screen.record import Screening
from modetune.flows.studies.screen.request import ScreeningRequest
from modetune.flows.studies.screen.screening import screen_campaign
from modetune.flows.updating import solutions
from modetune.flows.updating.evaluation import Evaluation
from modetune.flows.updating.evaluator import evaluator_of
from modetune.flows.updating.forecast import Unwatched
from modetune.flows.updating.update import update_campaign
from tests.adapters.solved import needs_ccx
from tests.flows.records import differences
from tests.flows.updating.test_stored_matrices import (
    MODULI,
    STORED,
    Case,
    row_of_materials,
    written,
)

pytestmark = needs_ccx

#: 45 bricks: enough unknowns that their modes are searched for, and not found all at once.
LONG = Case(row_of_materials(45), MODULI, (1.25, 0.8, 1.15), tuple(range(5, 185, 3)))

#: Steps so short that there are several.
SHORT = "update.step_limit=0.1"


class Killed(BaseException):
    """As good as SIGKILL to whatever is in memory."""


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(LONG, tmp_path_factory.mktemp("long") / "case")


@pytest.fixture(autouse=True)
def own_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))


def run(file: Path, place: Path) -> Path:
    """Run the campaign with a store in `place`; its record."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MODETUNE_STORE", str(place / "store"))
        campaign = load_campaign(file, [STORED, SHORT])
    update_campaign(campaign, place / "run", Unwatched())
    return place / "run" / "campaign.h5"


def entries(place: Path) -> set[str]:
    """Return the names of the entries of a store."""
    return {path.name for path in Store(place / "store").entries()}


def watch_puts(monkeypatch: pytest.MonkeyPatch, after: Callable[[Store, Entry], None]) -> None:
    real = Store.put

    def put(self: Store, entry: Entry, *given: Any) -> None:
        real(self, entry, *given)
        after(self, entry)

    monkeypatch.setattr(Store, "put", put)


@pytest.fixture
def ways(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """How each search for modes went, in order."""
    found: list[str] = []
    real = ModeSolver.solve

    def solve(self: ModeSolver, *given: Any) -> SolvedModes:
        solved = real(self, *given)
        found.append(solved.way)
        return solved

    monkeypatch.setattr(ModeSolver, "solve", solve)
    return found


@pytest.mark.parametrize("blocks", [0, 8], ids=["own factors", "kept factors"])
def test_killed_after_an_entry_and_run_again_it_ends_on_the_same_bits(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ways: list[str], blocks: int
) -> None:
    # As if the model were so large that a factorisation takes longer than these blocks.
    monkeypatch.setattr(ModeSolver, "blocks_that_pay", lambda solver, n_modes: blocks)
    written_by: list[str] = []
    with monkeypatch.context() as patch:
        watch_puts(patch, lambda store, entry: written_by.append(entry.solver))
        whole = run(file, tmp_path / "whole")
    assert ways == ["random"] + ["kept factors" if blocks else "start"] * (len(ways) - 1)
    assert written_by.count("modetune") >= 6  # matrices; modes and reduced models of some sets
    for count in range(3, len(written_by), 3):  # from the matrices on
        place = tmp_path / str(count)
        seen: list[str] = []

        def stop(store: Store, entry: Entry, count: int = count, seen: Any = seen) -> None:
            seen.append(entry.solver)
            if len(seen) == count:
                raise Killed

        with monkeypatch.context() as patch:
            watch_puts(patch, stop)
            with pytest.raises(Killed):
                run(file, place)
        with monkeypatch.context() as patch:
            watch_puts(patch, lambda store, entry, seen=seen: seen.append(entry.solver))  # type: ignore[misc]
            again = run(file, place)
        assert differences(whole, again) == []
        assert sorted(seen) == sorted(written_by)  # nothing was computed twice
        assert entries(place) == entries(tmp_path / "whole")  # nothing is lost, nothing is left


def test_each_search_but_the_first_begins_with_modes_that_are_known(
    file: Path, tmp_path: Path, ways: list[str]
) -> None:
    run(file, tmp_path)
    assert len(ways) > 2
    assert ways == ["random"] + ["start"] * (len(ways) - 1)


def at_points(file: Path, place: Path) -> list[Evaluation | ModetuneError]:
    """Evaluations of sets beside each other, as studies ask for them; the store is in `place`."""
    campaign = load_campaign(file, [f"store={place / 'store'}", STORED])
    engine = job_engine(campaign)
    thetas = np.random.default_rng(1).uniform(0.8, 1.2, (5, 3))
    return list(evaluator_of(campaign, engine).points("points", thetas))


def test_points_of_a_study_that_was_killed_have_the_same_bits(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ways: list[str]
) -> None:
    whole = at_points(file, tmp_path / "whole")
    assert ways == ["random"] + ["start"] * 4
    left = 3 + 2  # two matrix jobs, what is made of them, two points

    def stop(store: Store, entry: Entry) -> None:
        nonlocal left
        left -= 1
        if left == 0:
            raise Killed

    with monkeypatch.context() as patch:
        watch_puts(patch, stop)
        with pytest.raises(Killed):
            at_points(file, tmp_path / "killed")
    again = at_points(file, tmp_path / "killed")
    assert ways[5:] == ["random", "start", "random", "start", "start", "start"]  # the first again
    for one, other in zip(whole, again, strict=True):
        assert isinstance(one, Evaluation)
        assert isinstance(other, Evaluation)
        assert one.key == other.key
        np.testing.assert_array_equal(one.residual.values, other.residual.values)
        np.testing.assert_array_equal(one.seen.mode_shapes, other.seen.mode_shapes)


def screened(file: Path, place: Path) -> Screening:
    campaign = load_campaign(file, [f"store={place / 'store'}", STORED])
    return screen_campaign(campaign, ScreeningRequest("lhs", points=16), Unwatched().working)


def test_a_range_that_was_killed_takes_each_full_solution_from_the_store(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ways: list[str]
) -> None:
    monkeypatch.setattr(solutions, "KEPT_FROM", 0)  # as if the model were large
    kinds: list[type] = []
    with monkeypatch.context() as patch:
        watch_puts(patch, lambda store, entry: kinds.append(type(entry.result)))
        whole = screened(file, tmp_path / "whole")
    assert whole.reduced_model is not None
    grown, all_ways = kinds.count(SolvedModes), len(ways)
    # The solution that the range begins with is stored, and each by which it grows.
    assert whole.reduced_model.solutions == grown >= 4
    for count in range(1, grown + 1):
        seen: list[type] = []

        def stop(store: Store, entry: Entry, count: int = count, seen: Any = seen) -> None:
            seen.append(type(entry.result))
            if seen.count(SolvedModes) == count:
                raise Killed

        place = tmp_path / str(count)
        with monkeypatch.context() as patch:
            watch_puts(patch, stop)
            with pytest.raises(Killed):
                screened(file, place)
        ways.clear()
        again = screened(file, place)
        assert len(ways) == all_ways - count
        np.testing.assert_array_equal(
            again.responses.frequencies_hz, whole.responses.frequencies_hz
        )
        assert again.points_by == whole.points_by
        # What the range is made of is not kept beside it.
        store = Store(place / "store")
        held = {getattr(store.holding(path.name[:64]), "kind", "") for path in store.entries()}
        assert "reduced_range" in held
        assert "solved_modes" not in held


def test_where_factors_are_kept_updating_ends_where_it_does_with_new_ones(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shifts: list[float] = []
    real = Pencil.factorise

    def factorise(self: Pencil, shift: float) -> None:
        shifts.append(shift)
        real(self, shift)

    monkeypatch.setattr(Pencil, "factorise", factorise)
    new = read_record(run(file, tmp_path / "new"))
    before = len(shifts)
    monkeypatch.setattr(ModeSolver, "blocks_that_pay", lambda solver, n_modes: 8)
    kept = read_record(run(file, tmp_path / "kept"))
    assert new.status == kept.status == "converged"
    assert len(shifts) - before == 1 < before  # of the first set alone
    # e1 lets frequencies be 1e-6 off, moduli twice that, times a condition of a few.
    np.testing.assert_allclose(kept.updated, new.updated, rtol=1e-5)
    assert len(kept.iterations) <= len(new.iterations) + 1
