"""What Prefect's pages show of campaigns, and where a campaign starts."""

from __future__ import annotations

import fcntl
import json
import logging
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from modetune.core.errors import CampaignRunning
from modetune.core.modes import MeasuredModes
from modetune.core.parameters import Parameter
from modetune.core.updating.criteria import Tolerances
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.server import artifacts
from modetune.flows.updating.update import is_unchanged, read_earlier, start_of, update_campaign
from tests.flows.conftest import Bench, ChainDeck, Watcher, recased

TRUTH = {"k1": 1.2, "k4": 0.9}
#: A later test of the same structure.
AGED = {"k1": 1.1, "k4": 0.85}


def ran(bench: Bench, campaign: Campaign, watcher: Watcher) -> Any:
    return update_campaign(campaign, bench.folder / "run", watcher).record


def from_last(campaign: Campaign) -> Campaign:
    return replace(campaign, update=campaign.update.model_copy(update={"start": "last"}))


def test_artifact_keys_have_the_form_that_prefect_requires() -> None:
    assert artifacts.artifact_key("GARTEUR_wing.v2", "mac") == "garteur-wing-v2-mac"


def test_artifacts_show_rounded_numbers_bounds_and_standard_errors(
    bench: Bench, watcher: Watcher
) -> None:
    record = ran(bench, bench.campaign(TRUTH, shapes=True), watcher)
    results = {item.key: item for item in artifacts.result_artifacts(record, bench.folder)}
    assert set(results) == {
        f"chain-{kind}" for kind in ("frequencies", "parameters", "record", "mac")
    }
    assert all(re.fullmatch(r"[a-z0-9-]+", key) for key in results)
    first = json.loads(str(results["chain-parameters"].data))[0]
    assert (first["parameter"], first["parameter updated"]) == ("k1", "1.2")
    assert first["bounds"] == "0.3, 3"
    assert float(first["standard error, of deck, %"]) > 0.0
    modes = json.loads(str(results["chain-frequencies"].data))
    assert [row["test mode"] for row in modes] == ["1", "2", "3", "4", "5"]
    assert list(modes[0])[:3] == [
        "test mode",
        "test, Hz",
        "before, Hz",
    ]  # columns stay in this order
    assert str(bench.folder / "campaign.h5") in str(results["chain-record"].data)
    picture = str(results["chain-mac"].data)
    assert picture.startswith("![MAC](data:image/png;base64,iVBOR")
    assert len(picture) < artifacts.LARGEST_PICTURE + 100


def test_there_is_no_mac_picture_where_no_shapes_were_measured(
    bench: Bench, watcher: Watcher
) -> None:
    record = ran(bench, bench.campaign(TRUTH), watcher)
    assert not any(
        "mac" in artifact.key for artifact in artifacts.result_artifacts(record, bench.folder)
    )


def test_progress_is_the_tolerance_over_the_largest_error_and_ends_at_100(
    bench: Bench, watcher: Watcher
) -> None:
    record = ran(bench, bench.campaign(TRUTH), watcher)
    start = record.iterations[0]
    half = Tolerances(frequency=0.5 * start.worst_error, mac=0.0)
    assert artifacts.progress_artifacts("chain", half, [start])[0].data == pytest.approx(50.0)
    done = artifacts.progress_artifacts("chain", Tolerances(1e-8, 0.0), record.iterations)
    assert done[0].data == 100.0
    rows = json.loads(str(done[1].data))
    assert [row["iteration"] for row in rows] == [item.number for item in record.iterations]


def test_a_second_run_of_the_same_campaign_is_unchanged_and_costs_nothing(
    bench: Bench, watcher: Watcher
) -> None:
    campaign = from_last(bench.campaign(TRUTH))
    first = ran(bench, campaign, watcher)
    cost = bench.runs()
    earlier = read_earlier(bench.folder / "run")
    assert earlier is not None
    assert is_unchanged(campaign, job_engine(campaign), earlier)
    again = ran(bench, campaign, watcher)
    assert bench.runs() == cost
    assert again.updated.tolist() == first.updated.tolist()


def test_new_test_data_starts_from_the_last_updated_parameters_when_asked(
    bench: Bench, watcher: Watcher
) -> None:
    first = ran(bench, from_last(bench.campaign(TRUTH)), watcher)
    changed = bench.campaign(AGED)
    earlier = read_earlier(bench.folder / "run")
    assert earlier is not None
    assert not is_unchanged(changed, job_engine(changed), earlier)
    assert start_of(changed, job_engine(changed), earlier).start.tolist() == [1.0, 1.0]
    second = ran(bench, from_last(changed), watcher)
    assert second.iterations[0].parameters == pytest.approx(first.updated, rel=1e-12)
    assert second.updated == pytest.approx([1.1, 0.85], rel=1e-6)
    cost = bench.runs()
    third = ran(bench, from_last(changed), watcher)  # nothing changed: the same start once more
    assert bench.runs() == cost
    assert third.iterations[0].parameters.tolist() == second.iterations[0].parameters.tolist()


def test_the_last_values_are_kept_where_the_deck_was_replaced_by_the_updated_one(
    bench: Bench, watcher: Watcher
) -> None:
    first = ran(bench, bench.campaign(TRUTH), watcher)

    class Updated(ChainDeck):
        """Its deck has the updated values."""

        def deck_value(self, parameter: Parameter) -> float:
            return super().deck_value(parameter) * TRUTH[parameter.name]

    solver = replace(bench.solver(), deck=Updated())
    campaign = recased(from_last(bench.campaign(AGED)), solver=solver)
    earlier = read_earlier(bench.folder / "run")
    begin = start_of(campaign, job_engine(campaign), earlier).start
    assert begin == pytest.approx(first.updated / np.array([1.2, 0.9]), rel=1e-12)


def test_a_start_outside_the_bounds_is_brought_onto_them(bench: Bench, watcher: Watcher) -> None:
    ran(bench, bench.campaign(TRUTH), watcher)
    narrow = from_last(bench.campaign(AGED, bounds=(0.95, 1.15)))
    begin = start_of(narrow, job_engine(narrow), read_earlier(bench.folder / "run")).start
    assert begin.tolist() == [1.15, 0.95]


def test_a_parameter_that_is_new_starts_at_its_initial_value(
    bench: Bench, watcher: Watcher
) -> None:
    ran(bench, bench.campaign({"k1": 1.2}), watcher)
    wider = from_last(bench.campaign(TRUTH))
    begin = start_of(wider, job_engine(wider), read_earlier(bench.folder / "run")).start
    assert begin == pytest.approx([1.2, 1.0], rel=1e-6)


def test_a_record_that_cannot_be_read_is_told_and_the_deck_is_the_start(
    bench: Bench, watcher: Watcher, caplog: pytest.LogCaptureFixture
) -> None:
    (bench.folder / "run").mkdir()
    (bench.folder / "run" / "campaign.h5").write_bytes(b"half a file")
    with caplog.at_level(logging.WARNING, logger="modetune"):
        record = ran(bench, from_last(bench.campaign(TRUTH)), watcher)
    assert "cannot be read" in caplog.text
    assert record.iterations[0].parameters.tolist() == [1.0, 1.0]


def test_a_test_that_measured_more_modes_is_a_change(bench: Bench, watcher: Watcher) -> None:
    campaign = bench.campaign(TRUTH)
    ran(bench, campaign, watcher)
    earlier = read_earlier(bench.folder / "run")
    assert earlier is not None
    numbers = (1, 2, 3, 4)
    fewer = recased(campaign, test=MeasuredModes(numbers, bench.measured(TRUTH, numbers, False)))
    assert not is_unchanged(fewer, job_engine(fewer), earlier)


def test_a_campaign_under_way_is_an_error_of_its_own(bench: Bench, watcher: Watcher) -> None:
    (bench.folder / "run").mkdir()
    with (bench.folder / "run" / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(CampaignRunning, match="in progress"):
            ran(bench, bench.campaign(TRUTH), watcher)
