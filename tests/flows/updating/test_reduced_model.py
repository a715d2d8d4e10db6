"""Many sets by one reduced model against as many runs of ccx, on small decks, for real."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modetune.core.errors import SolverExhausted
from modetune.core.modes import Floats
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.studies.localise.localisation import Localisation, localise
from modetune.flows.studies.pretest.plan import Pretest, run_pretest
from modetune.flows.studies.pretest.request import PlacementMethod, PretestSettings
from modetune.flows.studies.sample import chains, density
from modetune.flows.studies.sample.posterior import sample_campaign
from modetune.flows.studies.sample.request import SamplingRequest
from modetune.flows.studies.screen.record import Screening
from modetune.flows.studies.screen.request import ScreeningRequest
from modetune.flows.studies.screen.screening import screen_campaign
from modetune.flows.studies.validate.validation import Validation, leave_one_out
from modetune.flows.updating import reduced_model
from modetune.flows.updating.evaluator import evaluator_of
from modetune.flows.updating.forecast import Unwatched
from modetune.flows.updating.starts import OtherStarts, Search, StartEnd
from modetune.flows.updating.update import update_from_starts
from tests.adapters.ccx_decks import bar
from tests.adapters.solved import needs_ccx
from tests.flows.updating.test_stored_matrices import (
    BAR,
    JOINT,
    OWN,
    SKEW,
    STORED,
    THICKNESS,
    Case,
    row_of_materials,
    side_by_side,
    written,
)

pytestmark = needs_ccx


AUTO = "model.eigensolver=auto"


def on_springs() -> str:
    """A square bar of two materials on three soft springs at each corner of both ends: six modes
    near 0 Hz that are no rigid ones, and bending in pairs of one frequency."""
    deck = bar("C3D8I", held="", bricks=8).replace(", 8.0\n", ", 10.0\n")
    deck = deck.replace("*SOLID SECTION, ELSET=V, MATERIAL=A\n", "")
    deck += "*MATERIAL, NAME=B\n*ELASTIC\n70000., 0.3\n*DENSITY\n2.7e-9\n"
    for place, first, last in (("A", 1, 4), ("B", 5, 8)):
        deck += f"*ELSET, ELSET=V{place}, GENERATE\n{first}, {last}\n"
        deck += f"*SOLID SECTION, ELSET=V{place}, MATERIAL={place}\n"
    number = 100
    for component in (1, 2, 3):
        deck += f"*ELEMENT, TYPE=SPRING1, ELSET=S{component}\n"
        for node in (1, 2, 3, 4, 33, 34, 35, 36):
            number += 1
            deck += f"{number}, {node}\n"
        deck += f"*SPRING, ELSET=S{component}\n{component}\n0.5\n"
    return deck


#: Materials in a row; a thickness of skew shells; a square bar on soft mounts.
CASES = {
    "bar": BAR,
    "skew shells": replace(THICKNESS, deck=SKEW),
    "square bar on soft mounts": Case(
        on_springs(),
        (
            ("E_A", "youngs_modulus", "material: A"),
            ("rho_A", "density", "material: A"),
            ("E_B", "youngs_modulus", "material: B"),
        ),
        (1.1, 1.05, 0.9),
        tuple(range(1, 37)),
        n_modes=14,
    ),
}


def screened(case: Case, folder: Path, *settings: str, points: int = 24) -> Screening:
    campaign = load_campaign(written(case, folder), list(settings))
    return screen_campaign(campaign, ScreeningRequest("lhs", points=points), Unwatched().working)


def apart(found: Floats, expected: Floats) -> float:
    """Largest difference, relative, where ccx itself found its modes."""
    assert not np.isnan(found).any()
    assert np.isnan(expected).any(axis=1).sum() <= 4  # of bodies that float it finds none at times
    return float(np.nanmax(np.abs(found / expected - 1.0)))


@pytest.mark.parametrize("name", CASES)
def test_points_are_those_of_the_solver_for_a_few_runs(name: str, tmp_path: Path) -> None:
    found = screened(CASES[name], tmp_path / "range")
    own = screened(CASES[name], tmp_path / "own", OWN)
    assert own.runs.modal + own.responses.n_failed == 25
    assert own.points_by == ""
    good = np.array([not said for said in own.responses.failures])
    # Matrix jobs: the deck's, one a set of parameters that share no node, four a thickness.
    assert found.runs.modal == 1
    assert found.runs.sensitivity <= (6 if "shells" in name else 4)
    assert "confirmed by calculix where it was worst, at " in found.points_by
    used = found.reduced_model
    assert used is not None
    assert (used.sets, used.in_full) == (24, 0)
    assert used.error <= used.asked <= 1e-5
    assert used.apart < 1e-4 > used.estimate
    # At most 1e-5 is asked of the model where it is worst; ccx prints seven digits of eigenvalues.
    assert apart(found.responses.frequencies_hz, own.responses.frequencies_hz) < 1e-4
    np.testing.assert_allclose(found.responses.mac[good], own.responses.mac[good], atol=2e-3)
    if "square" not in name:  # of its halves one tells as much as the other
        assert found.choice.chosen == own.choice.chosen


def test_the_same_again_runs_nothing_and_gives_the_same_bits(tmp_path: Path) -> None:
    file = written(BAR, tmp_path / "bar")
    request = ScreeningRequest("morris", points=40)
    first, again = (
        screen_campaign(load_campaign(file), request, Unwatched().working) for _ in range(2)
    )
    assert (again.runs.modal, again.runs.sensitivity) == (0, 0)
    np.testing.assert_array_equal(first.responses.frequencies_hz, again.responses.frequencies_hz)
    assert first.points_by == again.points_by


def test_few_points_are_runs_of_the_solver(tmp_path: Path) -> None:
    found = screened(BAR, tmp_path / "bar", points=8)
    assert (found.runs.modal, found.points_by) == (9, "")


def test_a_reduced_model_that_the_solver_does_not_confirm_gives_way_to_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    made: Callable[..., object] = reduced_model.ReducedModes._accurate

    def too_stiff(self: reduced_model.ReducedModes, theta: Floats, n_modes: int) -> object:
        return made(self, 1.001 * theta, n_modes)

    monkeypatch.setattr(reduced_model.ReducedModes, "_accurate", too_stiff)
    found = screened(BAR, tmp_path / "bar")
    assert "the solver's own frequencies differ by 5." in caplog.text
    assert found.points_by == ""
    # All of them, and the one that did not confirm.
    assert found.runs.modal == 25


def test_what_a_screening_ran_no_other_study_and_no_update_runs_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chains, "LONGEST", 1)  # how long the chains are does not matter here
    monkeypatch.setattr(density, "DRAWN", 24)
    monkeypatch.setattr(density, "STARTS", 2)
    file = written(BAR, tmp_path / "bar")
    settings = ["update.e1.frequency=1e-4", "model.eigensolver=pardiso"]
    campaign = load_campaign(file, settings)
    screened_first = screen_campaign(
        campaign, ScreeningRequest("lhs", points=24), Unwatched().working
    )
    assert (screened_first.runs.modal, screened_first.runs.sensitivity) == (1, 2)
    asked = SamplingRequest(walkers=8, steps=100)
    posterior = sample_campaign(load_campaign(file, settings), asked, Unwatched().working)
    assert (posterior.runs.modal, posterior.runs.sensitivity) == (0, 0)
    used = posterior.reduced_model
    assert used is not None
    assert used.solutions == screened_first.reduced_model.solutions  # type: ignore[union-attr]
    # Each deviation of a frequency is a few thousandths: full solutions are met far within it.
    assert posterior.check_errors.max() < 0.05
    left_out = leave_one_out(load_campaign(file, settings), Unwatched().working)
    assert (left_out.status, left_out.runs.modal, left_out.runs.sensitivity) == ("good", 0, 0)
    where = localise(load_campaign(file, settings))
    assert (where.runs.modal, where.runs.sensitivity) == (0, 0)
    updated = update_from_starts(load_campaign(file, settings), tmp_path / "run", Unwatched())
    assert updated.converged
    runs = updated.record.runs
    assert (runs.modal, runs.sensitivity) == (1, 0)  # confirms its end


def test_starts_that_were_asked_for_cost_no_runs_of_their_own(tmp_path: Path) -> None:
    settings = ["update.e1.frequency=1e-4", "model.eigensolver=pardiso", "update.starts=6"]
    file = written(BAR, tmp_path / "bar")
    record = update_from_starts(load_campaign(file, settings), tmp_path / "run", Unwatched()).record
    assert record.status == "converged"
    assert record.trust is not None
    assert record.trust.spread is not None
    assert len(record.trust.spread.starts) == 6
    assert set(record.trust.spread.minima.tolist()) == {0}  # all lead to the answer
    assert record.runs.modal == 1


def test_a_reduced_model_that_errs_far_away_is_found_out_by_one_made_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = ["update.e1.frequency=1e-4", "model.eigensolver=pardiso", "update.starts=6"]
    file, begun = written(BAR, tmp_path / "bar"), list[Floats]()
    from_starts, end, one_minimum = OtherStarts._from_starts, Search.end, Search.one_minimum

    def misled(*given: Any, **options: Any) -> Any:
        found = from_starts(*given, **options)
        # As if the model around the answer had a minimum there, as low as its own.
        there = found[2].start
        found[2] = replace(found[2], updated=there, misfit=0.0)
        return found

    def apart_there(search: Search, one: StartEnd, other: StartEnd) -> bool:
        ends = (one.updated, other.updated)
        false = any(end is not None and np.array_equal(end, begun[2]) for end in ends)
        return not false and one_minimum(search, one, other)

    def noted(search: Search, start: Floats, begin: Floats) -> Any:
        begun.append(begin)
        return end(search, start, begin)

    monkeypatch.setattr(OtherStarts, "_from_starts", misled)
    monkeypatch.setattr(Search, "end", noted)
    monkeypatch.setattr(Search, "one_minimum", apart_there)
    record = update_from_starts(load_campaign(file, settings), tmp_path / "run", Unwatched()).record
    assert record.trust is not None
    spread = record.trust.spread
    assert spread is not None
    assert set(spread.minima.tolist()) == {0}
    # Both reduced models are good to e1, 1e-4, at the answer, which moduli follow twice as much.
    np.testing.assert_allclose(spread.updated[3], record.updated, rtol=2e-4)
    # Five starts, each once (also where they were sought before the end was confirmed), and once
    # more from the false minimum, on a model made there.
    times = [sum(np.array_equal(begin, start) for begin in begun) for start in begun[:5]]
    assert times == [1, 1, 2, 1, 1]
    np.testing.assert_array_equal(begun[-1], begun[2])
    assert record.runs.modal == 1


@pytest.mark.parametrize(
    "case",
    [BAR, CASES["skew shells"], JOINT],
    ids=["bar", "skew shells", "joint with shapes"],
)
def test_one_reduced_model_stands_for_the_runs_of_leaving_each_mode_out(
    case: Case, tmp_path: Path
) -> None:
    file = written(case, tmp_path / "case")

    def left_out(eigensolver: str) -> Validation:
        place = f"store={tmp_path / eigensolver[-6:]}"
        return leave_one_out(load_campaign(file, [place, eigensolver]), lambda text: None)

    ranged, own = left_out(STORED), left_out(OWN)
    assert ranged.status == own.status == "good"
    assert len(ranged.folds) == case.n_modes
    # Besides the matrices' jobs the solver confirms the reduced model once, where it was worst.
    assert ranged.runs.modal == 1
    assert own.runs.modal > 3 * case.n_modes
    # e1 is 1e-6, moduli follow with twice that and a condition of some ten.
    for spread in ranged.spread:
        np.testing.assert_allclose(spread, case.truth, rtol=1e-4)
    assert ranged.held_out is not None
    np.testing.assert_allclose(ranged.held_out.error_updated, 0.0, atol=1e-5)
    again = left_out(STORED)
    assert (again.runs.modal, again.runs.sensitivity) == (0, 0)
    np.testing.assert_array_equal(again.spread, ranged.spread)


def test_each_configuration_is_screened_on_a_reduced_model_of_its_own(tmp_path: Path) -> None:
    def both(eigensolver: str) -> Screening:
        campaign = load_campaign(side_by_side(tmp_path / eigensolver, eigensolver))
        return screen_campaign(campaign, ScreeningRequest("lhs", points=24), Unwatched().working)

    ranged, own = both("pardiso"), both("solver")
    assert set(ranged.modes) == {
        f"mode {n} of {name}" for n in range(1, 7) for name in ("plain", "sprung")
    }
    # Both models at each of 24 points and at the start, against a word on each where it was worst.
    assert own.runs.modal == 2 * 25
    assert (ranged.runs.sensitivity, ranged.runs.modal) == (2 + 3, 2)
    # ccx prints frequencies' squares with seven digits.
    np.testing.assert_allclose(
        ranged.responses.frequencies_hz, own.responses.frequencies_hz, rtol=1e-6
    )
    assert ranged.choice.ranking == own.choice.ranking


@pytest.mark.parametrize("bricks", [9, 30])
def test_an_error_is_localised_without_a_run_of_the_solvers_own_modes(
    bricks: int, tmp_path: Path
) -> None:
    case = replace(
        BAR, deck=row_of_materials(bricks), truth=(1.3, 1.0, 1.0), nodes=tuple(range(5, 4 * bricks))
    )
    file = written(case, tmp_path / "case")

    def found(eigensolver: str) -> Localisation:
        place = f"store={tmp_path / eigensolver[-6:]}"
        settings = [place, eigensolver, "residuals.shape_weight=1.0"]
        return localise(load_campaign(file, settings))

    stored, own = found(STORED), found(OWN)
    assert (stored.runs.modal, stored.runs.sensitivity) == (0, 2)
    assert own.runs.modal == 1
    assert stored.maps is not None
    assert own.maps is not None
    np.testing.assert_array_equal(stored.maps.errors.ranking, own.maps.errors.ranking)
    # Modes of ccx have seven digits, errors some hundredths.
    np.testing.assert_allclose(
        stored.maps.errors.changes, own.maps.errors.changes, rtol=1e-3, atol=1e-4
    )
    assert stored.singles[0].members == own.singles[0].members == (0,)


def test_maps_of_the_error_keep_to_the_limit_of_memory(tmp_path: Path) -> None:
    case = replace(BAR, deck=row_of_materials(60), nodes=tuple(range(5, 240)))
    settings = [OWN, "run.memory_gb=0.001", "residuals.shape_weight=1.0"]
    campaign = load_campaign(written(case, tmp_path / "case"), settings)
    with pytest.raises(SolverExhausted, match=r"raise `run\.memory_gb`"):
        localise(campaign)


@pytest.mark.parametrize("method", ["effective_independence", "information"])
@pytest.mark.parametrize("case", [BAR, JOINT], ids=["bar", "joint"])
def test_sensors_are_placed_by_matrices_that_the_store_has(
    case: Case, method: PlacementMethod, tmp_path: Path
) -> None:
    file = written(case, tmp_path / "case")

    def placed(eigensolver: str) -> Pretest:
        campaign = load_campaign(file, [f"store={tmp_path / eigensolver[-6:]}", eigensolver])
        settings = PretestSettings(method=method, sensors=6, modes=(1, 2, 3), distance=0.0)
        return run_pretest(campaign, settings)

    campaign = load_campaign(file, [f"store={tmp_path / AUTO[-6:]}", STORED])
    engine = job_engine(campaign)
    made = evaluator_of(campaign, engine)
    made.evaluate(0, campaign.start, None, alone=True)
    stored, own = placed(AUTO), placed(OWN)
    assert own.runs.modal >= 1
    np.testing.assert_allclose(stored.frequencies_hz, own.frequencies_hz, rtol=1e-6)
    assert (stored.runs.modal, stored.runs.sensitivity) == (0, 0)
    assert stored.quality.largest == pytest.approx(own.quality.largest, abs=1e-4)
