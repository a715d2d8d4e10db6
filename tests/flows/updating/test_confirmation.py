"""What ends updating by stored matrices: a modal run of the solver, or its matrices there."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

import modetune
from modetune.core.algebra import pencil
from modetune.core.algebra.eigen import ModeSolver, SolvedModes
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import CampaignError, SolverExhausted
from modetune.core.monitoring.past_runs import read_history
from modetune.core.storage.campaign_record import CampaignRecord, read_record
from modetune.core.storage.store import Entry, Store
from modetune.core.updating.verdict import TrustVerdict
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.updating import mode_source, solutions
from modetune.flows.updating.forecast import Unwatched
from modetune.flows.updating.update import update_campaign
from tests.adapters.solved import needs_ccx
from tests.flows.records import differences
from tests.flows.studies.test_once import cymbal, ladder, tuning_fork
from tests.flows.updating.test_same_bits import Killed, watch_puts
from tests.flows.updating.test_stored_matrices import (
    BAR,
    STORED,
    Case,
    row_of_materials,
    updated,
    written,
)

pytestmark = needs_ccx


def record_of(file: Path, folder: Path, watcher: Any, *settings: str) -> CampaignRecord:
    own = f"store={folder / 'store'}", "update.starts=1"
    return updated(load_campaign(file, [*own, STORED, *settings]), folder, watcher)


def long_bar() -> Case:
    """Of too many unknowns to be solved whole."""
    return replace(BAR, deck=row_of_materials(60), nodes=tuple(range(5, 245, 9)))


@pytest.mark.parametrize(
    ("case", "way", "settings"),
    [
        (tuning_fork, "start", ()),
        (cymbal, "start", ()),
        (ladder, "whole", ("run.memory_gb=4",)),
        (long_bar, "start", ("run.memory_gb=4",)),
        (long_bar, "kept factors", ()),
    ],
)
def test_a_run_that_would_take_long_is_left_to_matrices_with_the_same_answer(
    case: Callable[[], Case],
    way: str,
    settings: Sequence[str],
    tmp_path: Path,
    watcher: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = case()
    file = written(made, tmp_path / "part")
    if way == "kept factors":  # as where a factorisation takes as long as hundreds of vectors
        monkeypatch.setattr(pencil, "FACTORISED_COLUMNS", 100.0)
    ways = list[str]()
    real = ModeSolver.solve

    def solve(*given: Any, **named: Any) -> Any:
        found = real(*given, **named)
        ways.append(found.way)
        return found

    monkeypatch.setattr(ModeSolver, "solve", solve)
    by_modes = record_of(file, tmp_path / "modes", watcher)
    assert by_modes.best.solved_by == "calculix"  # of so few elements a run takes nothing
    searched = ways.copy()
    ways.clear()
    monkeypatch.setattr(mode_source, "SPARED_S", 0.0)
    by_matrices = record_of(file, tmp_path / "matrices", watcher, *settings)
    assert re.fullmatch(r"calculix's matrices, \d+ modes counted", by_matrices.best.solved_by)
    assert by_matrices.runs.modal == 0
    assert by_matrices.runs.sensitivity == by_modes.runs.sensitivity + 1
    assert ways[-1] == way
    # What was found there is counted, not searched for again; a reduced model foresaw the
    # cymbal's end.
    assert ways == searched + [way] * (case is cymbal)
    np.testing.assert_array_equal(by_matrices.updated, by_modes.updated)
    np.testing.assert_allclose(by_matrices.updated, made.truth, rtol=1e-4)
    # CalculiX prints eigenvalues with seven digits.
    np.testing.assert_allclose(
        by_matrices.best.computed.frequencies_hz, by_modes.best.computed.frequencies_hz, rtol=1e-6
    )
    # The choice stays in the store, whatever is expected later.
    monkeypatch.setattr(mode_source, "RUN_S", 1e3)
    monkeypatch.setattr(mode_source, "SPARED_S", 100.0)
    again = record_of(file, tmp_path / "modes", watcher)
    assert (again.best.solved_by, again.runs.modal) == ("calculix", 0)


@pytest.mark.parametrize(
    ("case", "by"), [(cymbal, "modes"), (tuning_fork, "matrices"), (long_bar, "matrices")]
)
def test_an_answer_is_confirmed_later_by_one_job(
    case: Callable[[], Case],
    by: Literal["modes", "matrices"],
    tmp_path: Path,
    watcher: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(solutions, "KEPT_FROM", 0)  # as of a large model
    file, place = written(case(), tmp_path / "part"), tmp_path / "later"
    at_once = record_of(file, tmp_path / "at once", watcher, f"update.confirm={by}")
    found, folder = record_of(file, place, watcher, "update.confirm=later"), place / "run0"
    assert (found.unconfirmed, found.runs.modal) == (True, 0)
    assert found.verdict is not TrustVerdict.TRUSTED
    assert found.runs.sensitivity == at_once.runs.sensitivity - (by == "matrices")

    real, solve, solved = Store.put, ModeSolver.solve, list[bool]()

    def noted(*given: Any, **named: Any) -> Any:
        solved.append(True)
        return solve(*given, **named)

    monkeypatch.setattr(ModeSolver, "solve", noted)

    def killed(self: Store, *given: Any) -> None:
        raise Killed

    monkeypatch.chdir(file.parent)
    with monkeypatch.context() as patch:
        patch.setattr(Store, "put", killed)
        with pytest.raises(Killed):
            modetune.confirm(folder, by=by)
    assert read_record(folder).unconfirmed
    assert Store.put is real
    # A setting says as much as the argument.
    confirmed = modetune.confirm(folder, settings={"update.confirm": by}).record
    assert not solved  # the store has the shapes of the end
    kept = read_record(folder)
    assert not kept.unconfirmed
    # The record has the cost of both; the command itself ran one job.
    assert confirmed.runs.modal + confirmed.runs.sensitivity == 1
    assert (kept.runs.modal, kept.runs.sensitivity) == (
        at_once.runs.modal,
        at_once.runs.sensitivity,
    )
    records = tmp_path / "at once" / "run0" / "campaign.h5", folder / "campaign.h5"
    assert differences(*records) == ["settings"]  # where their stores are
    # The history keeps both, and the night is the confirmed one.
    history = read_history(folder)
    assert [run.verdict for run in history.runs] == [found.verdict, kept.verdict]
    assert [run.number for run in history.nights()] == [2]
    with pytest.raises(CampaignError, match="nothing left to confirm: calculix"):
        modetune.confirm(folder)


def test_modes_that_the_count_finds_missing_are_searched_for(
    tmp_path: Path, watcher: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, settings = written(long_bar(), tmp_path / "part"), ("update.confirm=matrices",)
    whole = record_of(file, tmp_path / "whole", watcher, *settings)
    real, counted = ModeSolver.counted, list[bool]()

    def lacking(self: ModeSolver, stiffness: Any, mass: Any, solved: SolvedModes) -> Any:
        few = replace(
            solved,
            eigenvalues=np.delete(solved.eigenvalues, 2),
            shapes=np.delete(solved.shapes, 2, axis=1),
        )
        found = real(self, stiffness, mass, few)
        counted.append(found is not None)
        return found

    monkeypatch.setattr(ModeSolver, "counted", lacking)
    again = record_of(file, tmp_path / "again", watcher, *settings)
    assert counted == [False]
    assert again.best.solved_by == whole.best.solved_by
    np.testing.assert_allclose(
        again.best.computed.frequencies_hz, whole.best.computed.frequencies_hz, rtol=1e-9
    )


@pytest.mark.parametrize("case", [long_bar, cymbal, tuning_fork])
def test_without_room_for_a_count_matrices_confirm_uncounted(
    case: Callable[[], Case],
    tmp_path: Path,
    watcher: Any,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    file, auto = written(case(), tmp_path / "part"), "model.eigensolver=auto"
    monkeypatch.setattr(mode_source, "RUN_S", 1e3)
    real, counts = ModeSolver.solve, list[bool]()

    def solve(self: ModeSolver, *given: Any) -> Any:
        counts.append(given[-1])
        if counts[-1]:
            raise SolverExhausted("no room")
        return real(self, *given)

    def count(self: ModeSolver, *given: Any) -> Any:
        counts.append(True)
        raise SolverExhausted("no room")

    counted = record_of(file, tmp_path / "counted", watcher, auto)
    assert re.fullmatch(r"calculix's matrices, \d+ modes counted", counted.best.solved_by)
    monkeypatch.setattr(ModeSolver, "solve", solve)
    monkeypatch.setattr(ModeSolver, "counted", count)
    record = record_of(file, tmp_path / "without", watcher, auto)
    assert re.fullmatch(r"calculix's matrices, \d+ modes not counted", record.best.solved_by)
    assert "modes at the end are not counted: no room" in caplog.text
    assert counts.count(True) == 1
    assert record.status == counted.status
    assert record.runs.sensitivity == counted.runs.sensitivity  # one job at the end all the same
    np.testing.assert_array_equal(record.updated, counted.updated)
    np.testing.assert_allclose(
        record.best.computed.frequencies_hz, counted.best.computed.frequencies_hz, rtol=1e-8
    )
    # Once more nothing is run or searched, and nothing more is claimed.
    counts.clear()
    again = record_of(file, tmp_path / "without", watcher, auto)
    assert again.best.solved_by == record.best.solved_by
    assert (again.runs.sensitivity, again.runs.modal, counts) == (0, 0, [])
    with pytest.raises(SolverExhausted, match="no room"):  # double precision is asked for by name
        record_of(file, tmp_path / "named", watcher)


@pytest.mark.parametrize("columns", [0.5, 100.0], ids=["own factors", "kept factors"])
@pytest.mark.parametrize("kept_from", [solutions.KEPT_FROM, 0], ids=["", "kept"])
def test_killed_before_matrices_confirm_it_ends_on_the_same_bits(
    columns: float, kept_from: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(solutions, "KEPT_FROM", kept_from)
    file = written(long_bar(), tmp_path / "part")
    monkeypatch.setattr(pencil, "FACTORISED_COLUMNS", columns)
    settings = [STORED, "update.confirm=matrices"]

    def run(place: Path) -> Path:
        campaign = load_campaign(file, [f"store={place / 'store'}", *settings])
        update_campaign(campaign, place / "run", Unwatched())
        return place / "run" / "campaign.h5"

    whole, put = run(tmp_path / "whole"), 0

    def stop(store: Store, entry: Entry) -> None:
        nonlocal put
        put += isinstance(entry.result, MatrixResult)
        if put == 3:  # two for the matrices of all values
            raise Killed

    with monkeypatch.context() as patch:
        watch_puts(patch, stop)
        with pytest.raises(Killed):
            run(tmp_path / "killed")
    solved, factorised, real, held = 0, 0, ModeSolver.solve, pencil.Pencil.factorise

    def solve(*given: Any, **named: Any) -> Any:
        nonlocal solved
        solved += 1
        return real(*given, **named)

    def factorise(*given: Any) -> None:
        nonlocal factorised
        factorised += 1
        held(*given)

    monkeypatch.setattr(ModeSolver, "solve", solve)
    monkeypatch.setattr(pencil.Pencil, "factorise", factorise)
    assert differences(whole, run(tmp_path / "killed")) == ["settings"]  # where their stores are
    if kept_from:
        assert solved > 1  # set by set
        return
    # What is kept has the modes of the end, which are counted, and then leaves.
    assert (solved, factorised) == (0, 1)
    for place in ("whole", "killed"):
        store = Store(tmp_path / place / "store")
        held_kinds = {
            getattr(store.holding(path.name[:64]), "kind", "") for path in store.entries()
        }
        assert "solved_modes" not in held_kinds
