"""A deck's change that makes the model worse is found, and one that does not is let through."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer

from modetune.core.errors import CampaignError
from modetune.core.parameters import Values
from modetune.flows.cli.command import command_of
from modetune.flows.studies.catalogue import find_study
from modetune.flows.updating.baseline import Band, check_deck, check_record, read_agreement
from modetune.flows.updating.update import update_campaign
from tests.flows.conftest import ChainDeck, recased

TRUTH = {"k1": 1.2, "k2": 0.8}
BAND = Band(0.01, 0.05)


@dataclass(frozen=True)
class OtherDeck(ChainDeck):
    """The chain with other springs: `scale` times the nominal ones."""

    scale: tuple[tuple[str, float], ...] = ()

    def edited(self, values: Values) -> Values:
        scale = dict(self.scale)
        return {n: values.get(n, 1.0) * scale.get(n, 1.0) for n in values.keys() | scale.keys()}


@pytest.fixture
def baseline(bench: Any, watcher: Any) -> Path:
    """The record of a campaign that ended on the true springs."""
    run = update_campaign(bench.campaign(TRUTH, shapes=True), bench.folder / "base", watcher)
    assert run.record.status == "converged"
    return Path(run.folder / "campaign.h5")


def campaign_of_deck(bench: Any, scale: dict[str, float]) -> Any:
    campaign = bench.campaign(TRUTH, shapes=True)
    deck = OtherDeck(scale=tuple(scale.items()))
    return recased(campaign, solver=replace(bench.solver(), deck=deck))


def test_the_updated_deck_stays_within_the_band_at_one_modal_run(
    bench: Any, baseline: Path
) -> None:
    before = bench.runs()
    campaign = campaign_of_deck(bench, {"k1": 1.21, "k2": 0.8})
    found = check_deck(campaign, baseline, "updated", BAND)
    assert found.within
    assert [mode.mode for mode in found.modes] == [1, 2, 3, 4, 5]
    assert bench.runs() - before == found.runs.modal == 1
    again = check_deck(campaign, baseline, "updated", BAND)
    assert again.within
    assert (again.runs.modal, again.runs.reused) == (0, 1)


def test_a_deck_that_became_worse_leaves_the_band_in_the_modes_that_moved(
    bench: Any, baseline: Path
) -> None:
    campaign = campaign_of_deck(bench, {"k1": 1.2, "k2": 0.8, "m3": 1.4})
    found = check_deck(campaign, baseline, "updated", BAND)
    assert not found.within
    left = [mode for mode in found.modes if mode.reasons]
    # By hand: |error| of the changed chain is beyond 1 %, the baseline's is below 1e-8.
    assert [mode.mode for mode in left] == [
        mode.mode for mode in found.modes if abs(mode.error) > 0.01 or mode.mac < 0.95
    ]
    assert left
    assert f"mode {left[0].mode}: frequency error" in found.reason


def test_a_wide_band_lets_it_through(bench: Any, baseline: Path) -> None:
    campaign = campaign_of_deck(bench, {"k1": 1.2, "k2": 0.8, "m3": 1.4})
    assert check_deck(campaign, baseline, "updated", Band(1.0, 1.0)).within


def test_a_deck_before_updating_is_within_its_own_start_and_told_so(
    bench: Any, baseline: Path
) -> None:
    nominal = bench.campaign(TRUTH, shapes=True)
    assert check_deck(nominal, baseline, "initial", Band(0.0, 0.0)).within
    found = check_deck(nominal, baseline, "updated", BAND)
    assert not found.within
    assert any("--state initial" in remark for remark in found.remarks)


def test_a_lost_mode_is_worse_and_no_error(bench: Any, baseline: Path) -> None:
    campaign = bench.campaign(TRUTH, shapes=True)
    # Five times the same shape: it resembles no five of the orthogonal computed ones.
    alike = replace(campaign.test.modes, mode_shapes=np.tile(np.eye(6)[:, [0]], 5))
    test = replace(campaign.test, modes=alike)
    found = check_deck(recased(campaign, test=test), baseline, "updated", BAND)
    assert not found.within
    assert "a mode is lost: test modes 1 and 2: two modes have the same shape" in found.reason
    assert "So the measured mode at" in found.reason


def test_another_test_is_remarked(bench: Any, baseline: Path) -> None:
    campaign = campaign_of_deck(bench, TRUTH)
    modes = campaign.test.modes
    moved = replace(modes, frequencies_hz=1.001 * modes.frequencies_hz)
    found = check_deck(
        recased(campaign, test=replace(campaign.test, modes=moved)), baseline, "updated", BAND
    )
    assert found.within
    assert "not those of the baseline" in found.remarks[0]


def test_a_baseline_of_other_modes_is_refused(bench: Any, baseline: Path) -> None:
    campaign = bench.campaign(TRUTH, modes=(1, 2, 3), shapes=True)
    with pytest.raises(CampaignError, match=r"baseline of test modes 1, 2, 3, 4, 5, but "):
        check_deck(campaign, baseline, "updated", BAND)


def test_the_updated_model_of_another_run_is_compared_without_a_run(
    bench: Any, watcher: Any, baseline: Path
) -> None:
    campaign = campaign_of_deck(bench, {"m3": 1.4})  # no parameter can make that good
    record = update_campaign(campaign, bench.folder / "again", watcher).folder / "campaign.h5"
    count = bench.runs()
    found = check_record(campaign, record, baseline, "updated", BAND)
    assert bench.runs() == count
    assert not found.within
    assert check_record(campaign, baseline, baseline, "updated", Band(0.0, 0.0)).within


def test_what_is_no_record_is_refused_in_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(CampaignError, match="is not there"):
        read_agreement(tmp_path / "none.h5", "updated")
    (tmp_path / "text.h5").write_text("no record")
    with pytest.raises(CampaignError, match="is not a record of a campaign"):
        read_agreement(tmp_path / "text.h5", "updated")


def test_the_command_ends_with_three_and_tells_each_mode(
    bench: Any, baseline: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    campaign = campaign_of_deck(bench, {"k1": 1.2, "k2": 0.8, "m3": 1.4})
    check = command_of(find_study("check"))
    monkeypatch.setattr("modetune.flows.campaign.campaign.load_campaign", lambda *_: campaign)
    with pytest.raises(typer.Exit) as ended:
        check(campaign_file=Path("c.yaml"), against=baseline, no_prefect=True, as_json=True)
    assert ended.value.exit_code == 3
    told = json.loads(capsys.readouterr().out)
    assert told["status"] == "worse"
    assert not all(mode["within"] for mode in told["modes"])
    check(
        campaign_file=Path("c.yaml"),
        against=baseline,
        frequency_band=1.0,
        mac_band=1.0,
        no_prefect=True,
    )
    assert capsys.readouterr().out.splitlines()[-1] == "within the band"
