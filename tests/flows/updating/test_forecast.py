"""What a campaign will cost is told from what jobs of its model cost before."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from modetune.adapters.solver import ModalAnalysis
from modetune.core.storage.store import Entry
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.campaign.schema import SensitivitySection
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.jobs.job import Job, read_note
from modetune.flows.jobs.limits import Limit
from modetune.flows.jobs.lookup import MedianCost, job_costs, parallel_time
from modetune.flows.updating.forecast import (
    Cost,
    Forecast,
    cost_text,
    forecast_text,
    job_cost,
    told_forecast,
)
from modetune.flows.updating.update import update_campaign
from tests.adapters.solved import needs_ccx
from tests.core.storage.test_store import holdings
from tests.flows.updating.test_stored_matrices import BAR, STORED, written

TRUTH = {"k1": 1.2, "k2": 0.8}
DIFFERENCES = SensitivitySection(method="finite_difference")


def forecasts(bench: Any, watcher: Any, campaign: Any) -> list[Forecast]:
    told: list[Forecast] = []
    run = update_campaign(campaign, bench.folder / "run", watcher, forecast=told.append)
    assert run.forecast == told[0]
    return told


def stored_in(seconds: float, campaign: Any) -> None:
    """Let the store say that each of its results took so long."""
    for holding in holdings(campaign.store):
        entry = campaign.store.get(holding.key)
        campaign.store.put(
            Entry(entry.key, entry.result, entry.solver, entry.solver_version, seconds),
            holding.asked,
            holding.note,
        )


def test_an_empty_store_knows_no_price_and_says_so(bench: Any, watcher: Any) -> None:
    told = forecasts(bench, watcher, bench.campaign(TRUTH, sensitivity=DIFFERENCES))
    first = told[0]
    assert not first.known
    assert (first.coming.jobs, first.coming.unknown) == (3, 3)  # modal, and one a parameter
    assert "of unknown cost" in forecast_text(first)
    assert told_forecast(first)["first_iteration"] == {
        "jobs": 3, "jobs_of_unknown_cost": 3, "core_minutes": None, "licence_minutes": None,
        "wall_s": None,
    }  # fmt: skip
    assert told[1].known  # by its own first iteration


def test_costs_follow_from_what_the_store_says_of_jobs_of_that_kind(
    bench: Any, watcher: Any
) -> None:
    campaign = bench.campaign(TRUTH, sensitivity=DIFFERENCES)
    forecasts(bench, watcher, campaign)
    stored_in(60.0, campaign)
    other = replace(campaign, parameters=bench.campaign({"k3": 1.1, "k4": 1.1}).parameters)
    (first, *_) = forecasts(bench, watcher, other)
    # 3 jobs of a minute each on one thread; two of them at a time take two minutes.
    assert first.coming.jobs == 3
    assert first.further.jobs == 3
    assert first.further.core_s == pytest.approx(180.0 * campaign.threads)
    assert first.further.wall_s == pytest.approx(120.0)
    assert first.most.jobs == first.coming.jobs + 3 * first.iterations


def test_a_campaign_that_ran_has_nothing_to_run_first(bench: Any, watcher: Any) -> None:
    campaign = bench.campaign(TRUTH, sensitivity=DIFFERENCES)
    forecasts(bench, watcher, campaign)
    again = forecasts(bench, watcher, campaign)
    assert again[0].coming.jobs == 0
    assert "first iteration nothing to run" in forecast_text(again[0])


def test_each_iteration_leaves_one_less_to_come(bench: Any, watcher: Any) -> None:
    campaign = bench.campaign(TRUTH)
    told = forecasts(bench, watcher, campaign)
    left = [forecast.iterations for forecast in told[1:]]
    most = campaign.update.max_iterations
    assert left == [most - line.number for line in watcher.lines]


def test_constant_matrices_are_counted_in_the_first_iteration_only(
    bench: Any, watcher: Any
) -> None:
    told = forecasts(bench, watcher, bench.campaign(TRUTH, shapes=True))
    assert told[0].coming.jobs == 4  # modal, the model's own matrices and one a spring
    assert told[0].further.jobs == 1


@needs_ccx
def test_by_stored_matrices_the_solvers_own_run_at_the_end_is_counted(
    tmp_path: Path, watcher: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))
    file = written(BAR, tmp_path / "bar")
    campaign = load_campaign(file, [f"store={tmp_path / 'store'}", STORED])
    told: list[Forecast] = []
    run = update_campaign(campaign, tmp_path / "run", watcher, forecast=told.append)
    assert (told[0].last.jobs, told[0].iterations) == (1, 0)
    runs = run.record.runs
    assert (runs.modal, told[0].most.jobs) == (1, runs.modal + runs.sensitivity)
    assert (told[1].coming.jobs, told[1].most.jobs) == (0, 1)  # all but that run is done
    assert "; the solver's own run at the end 1 job" in forecast_text(told[0])
    last = told_forecast(told[0])["last_run"]
    assert isinstance(last, dict)
    assert last["jobs"] == 1


def test_an_earlier_state_of_the_deck_gives_prices_until_there_are_own_ones(
    bench: Any, watcher: Any
) -> None:
    campaign = bench.campaign(TRUTH)
    forecasts(bench, watcher, campaign)
    engine = job_engine(campaign)
    assert job_costs(engine, engine.plans.model_digest()).keys() == {"modal"}
    assert job_costs(engine, "another digest").keys() == {"modal"}  # by the model's name


def test_licences_are_counted_where_the_campaign_has_some(bench: Any) -> None:
    engine = job_engine(bench.campaign(TRUTH))
    engine = replace(engine, limits=(*engine.limits, Limit("scripted", 2, 1)))
    job = Job({}, ModalAnalysis(6, ()))
    cost = job_cost(engine, {"modal": MedianCost(30.0, 60.0)}, 2)([job, job])
    assert (cost.core_s, cost.licence_s, cost.wall_s) == (120.0, 60.0, 30.0)
    assert "2 core-minutes, 1 licence-minutes, about 30 s" in cost_text(cost)


def test_jobs_side_by_side_take_as_long_as_the_fullest_place() -> None:
    assert parallel_time([3.0, 2.0, 2.0, 1.0], 2) == 4.0
    assert parallel_time([], 2) == 0.0


def test_a_cost_without_some_prices_says_how_many() -> None:
    assert cost_text(Cost(3, 1, 60.0, 0.0, 60.0)).endswith("without 1 of unknown cost")


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"model": 1}', "not JSON", "null"])
def test_a_note_of_another_shape_is_none(text: str) -> None:
    assert read_note(text) is None
