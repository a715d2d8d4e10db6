"""Updates from several starts on the scripted solver: one place, several, rivals, failures."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from rich.console import Console

from modetune.core.errors import SolverRejected
from modetune.core.storage.campaign_record import CampaignRecord, read_record
from modetune.core.updating.trust import StartSpread
from modetune.flows.campaign.schema import E1Section, ReportSection, UpdateSection
from modetune.flows.report.page import page
from modetune.flows.updating import update
from modetune.flows.updating.display import show_run
from modetune.flows.updating.record import CampaignRun, summary
from modetune.flows.updating.update import update_from_starts

TRUTH = {"k1": 1.2, "k2": 0.8, "k3": 1.1}


def settings(starts: int, seed: int = 0) -> UpdateSection:
    return UpdateSection(
        step="weighted_least_squares",
        e1=E1Section(frequency=1e-6, mac=0.0),
        e2=0.0,
        step_limit=0.5,
        starts=starts,
        seed=seed,
    )


def run(bench: Any, watcher: Any, campaign: Any, name: str = "run") -> CampaignRun:
    return update_from_starts(campaign, bench.folder / name, watcher)


def spread_of(run: CampaignRun) -> StartSpread:
    assert run.record.trust is not None
    assert run.record.trust.spread is not None
    return run.record.trust.spread


def symmetric(bench: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the chain its own mirror image: then k1 and k7 can be swapped."""
    module = sys.modules[type(bench).__module__]
    monkeypatch.setattr(module, "SPRINGS", np.full(7, 1500.0))
    monkeypatch.setattr(module, "MASSES", np.ones(6))


def test_starts_of_a_well_posed_twin_end_at_the_truth(bench: Any, watcher: Any) -> None:
    truth = {"k1": 1.2, "k7": 0.8}
    told = run(bench, watcher, bench.campaign(truth, update=settings(5), bounds=(0.5, 2.0)))
    spread = spread_of(told)
    np.testing.assert_allclose(spread.updated, np.tile([1.2, 0.8], (5, 1)), rtol=1e-4)
    assert spread.minima.tolist() == [0] * 5
    assert spread.chosen == 0
    np.testing.assert_array_equal(spread.starts[0], [1.0, 1.0])
    assert told.record.trust is not None
    assert told.record.trust.verdict == "trusted"
    # Every process is counted, and the answer's own record took none: the store had it all.
    assert bench.runs() == told.record.runs.modal
    assert told.record.runs.reused >= len(told.record.iterations)
    kept = sorted(path.name for path in (told.folder / "starts").iterdir())
    assert kept == ["00.h5", "01.h5", "02.h5", "03.h5", "04.h5"]


def test_the_report_is_drawn_once_and_earlier_starts_go(
    bench: Any, watcher: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[int] = []

    def draw(record: CampaignRecord, folder: Path) -> Path:
        assert record.trust is not None
        assert record.trust.spread is not None  # the record of all starts
        drawn.append(len(record.trust.spread.outcomes))
        return folder / "report.html"

    monkeypatch.setattr(update, "draw_report", draw)
    truth, told = {"k1": 1.2, "k7": 0.8}, None
    for n in (3, 2):
        campaign = replace(
            bench.campaign(truth, update=settings(n), bounds=(0.5, 2.0)),
            report=ReportSection(page=True),
        )
        told = run(bench, watcher, campaign)
        assert told.page == told.folder / "report.html"
        assert len(list((told.folder / "starts").iterdir())) == n
    assert drawn == [3, 2]


def test_a_second_run_of_the_starts_needs_no_solver(bench: Any, watcher: Any) -> None:
    campaign = bench.campaign(TRUTH, update=settings(4))
    first = run(bench, watcher, campaign)
    before = bench.runs()
    again = run(bench, watcher, campaign, "again")
    assert bench.runs() == before
    assert again.record.runs.modal == 0
    np.testing.assert_array_equal(spread_of(first).updated, spread_of(again).updated)


def test_one_start_is_the_plain_update(bench: Any, watcher: Any) -> None:
    told = run(bench, watcher, bench.campaign(TRUTH, update=settings(1)))
    assert told.record.trust is not None
    assert told.record.trust.spread is None
    assert not (told.folder / "starts").exists()


def test_a_place_that_fits_worse_is_told_and_does_not_take_the_trust_away(
    bench: Any, watcher: Any
) -> None:
    # From (1.77, 2.23, 0.67), one of the starts of seed 0, the springs end in another minimum.
    told = run(bench, watcher, bench.campaign(TRUTH, update=settings(5)))
    spread = spread_of(told)
    assert spread.minima.max() == 1
    assert spread.rivals == ()
    np.testing.assert_allclose(told.record.updated, list(TRUTH.values()), rtol=1e-4)
    assert told.record.trust is not None
    assert told.record.trust.verdict == "trusted"
    shown = Console(file=StringIO(), width=200)
    show_run(shown, told)
    assert "to other minima" in shown.file.getvalue()  # type: ignore[attr-defined]  # a StringIO


def test_a_mirror_image_that_fits_as_well_takes_the_trust_away(
    bench: Any, watcher: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    symmetric(bench, monkeypatch)
    truth = {"k1": 1.3, "k7": 0.7}
    campaign = bench.campaign(
        truth, modes=(1, 2, 3, 4, 5, 6), update=settings(8), bounds=(0.5, 2.0)
    )
    told = run(bench, watcher, campaign)
    spread = spread_of(told)
    assert spread.rivals == (1,)
    assert spread.differ == ("k1", "k7")
    ends = {
        tuple(np.round(end, 3).tolist())
        for end, place in zip(spread.updated, spread.minima, strict=True)
        if place in (0, 1)
    }
    assert ends == {(1.3, 0.7), (0.7, 1.3)}
    assert told.record.trust is not None
    assert told.record.trust.verdict == "not to be trusted"
    assert all("starts" in item.flags for item in told.record.trust.parameters)


def test_the_record_goes_from_the_initial_model_to_the_best_start(
    bench: Any, watcher: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    # By symmetry the campaign's own start (1, 1) cannot leave k1 = k7; the others can.
    symmetric(bench, monkeypatch)
    campaign = bench.campaign(
        {"k1": 1.3, "k7": 0.7}, modes=(1, 2, 3, 4, 5, 6), update=settings(8), bounds=(0.5, 2.0)
    )
    told = run(bench, watcher, campaign)
    spread, record = spread_of(told), read_record(told.folder / "campaign.h5")
    assert spread.chosen > 0
    assert [item.number for item in record.iterations] == list(range(len(record.iterations)))
    np.testing.assert_array_equal(record.iterations[0].parameters, [1.0, 1.0])
    np.testing.assert_array_equal(record.iterations[1].parameters, spread.starts[spread.chosen])
    assert f"start {spread.chosen + 1} of 8" in record.iterations[1].decision
    assert record.trust is not None
    assert repr(record.trust) == repr(told.record.trust)
    text = page(record)
    assert "Updates from 8 starts (seed 0)" in text
    starts = json.loads(json.dumps(summary(record, told.folder), allow_nan=False))["trust"][
        "starts"
    ]
    assert len(starts["runs"]) == 8
    assert starts["fit_as_well"] == [1]


def test_a_start_that_fails_leaves_the_others(bench: Any, watcher: Any) -> None:
    # The scripted solver refuses its first run, whichever start that was for.
    bench.script({1: "rejected"})
    told = run(bench, watcher, bench.campaign({"k1": 1.2, "k7": 0.8}, update=settings(4)))
    spread = spread_of(told)
    failed = [outcome for outcome in spread.outcomes if outcome.startswith("failed: ")]
    assert len(failed) == 1
    assert "refused its input" in failed[0]
    assert spread.n_ended == 3
    assert told.record.status == "converged"


def test_where_all_starts_fail_the_first_error_is_told(bench: Any, watcher: Any) -> None:
    bench.script(dict.fromkeys(range(1, 40), "rejected"))
    with pytest.raises(SolverRejected, match="refused its input"):
        run(bench, watcher, bench.campaign(TRUTH, update=settings(3)))
    assert not (bench.folder / "run" / "campaign.h5").exists()


@pytest.mark.parametrize("starts", [0, -1, 1001])
def test_a_number_of_starts_that_makes_no_sense_is_refused(starts: int) -> None:
    with pytest.raises(ValidationError):
        settings(starts)
