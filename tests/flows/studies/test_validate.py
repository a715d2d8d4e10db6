"""Held-out modes and leave-one-out on the scripted chain, whose truth is known."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from scipy.optimize import brentq

from modetune.core.correlation.holdout import LOST, judge_held_out, pair_held_out, track_held_out
from modetune.core.correlation.pairing import pair_by_order, pair_by_shape
from modetune.core.errors import CampaignError, SolverCrashed
from modetune.core.modes import Floats, MeasuredModes, mode_set
from modetune.core.parameters import Values
from modetune.core.storage.campaign_record import CampaignRecord, read_record
from modetune.flows.campaign.campaign import Campaign, load_campaign
from modetune.flows.report.mode_tables import held_out_lines, held_out_table
from modetune.flows.report.page import page
from modetune.flows.report.tables import show
from modetune.flows.studies.validate.validation import leave_one_out, leave_out, validate
from modetune.flows.updating.display import held_out_parts
from modetune.flows.updating.record import summary
from modetune.flows.updating.update import update_campaign
from tests.command_line import run_command as modetune
from tests.flows.conftest import recased

TRUTH = {"k1": 1.2, "k2": 0.8, "k3": 1.1}


def hold_out(campaign: Campaign, numbers: tuple[int, ...]) -> Campaign:
    """The campaign with some of its test's modes held out instead of used."""
    rest = tuple(number for number in campaign.test.numbers if number not in numbers)
    return recased(campaign, test=campaign.test.use(rest), held_out=campaign.test.use(numbers))


def run(bench: Any, watcher: Any, campaign: Campaign, name: str = "run") -> CampaignRecord:
    return update_campaign(campaign, bench.folder / name, watcher).record


def silent(text: str) -> None:
    pass


@pytest.mark.parametrize("shapes", [True, False])
def test_a_held_out_mode_comes_true_with_the_true_parameters(
    bench: Any, watcher: Any, shapes: bool
) -> None:
    record = run(bench, watcher, hold_out(bench.campaign(TRUTH, shapes=shapes), (2, 5)))
    held = record.held_out
    assert record.test.numbers == (1, 3, 4)
    assert held is not None
    assert held.numbers.tolist() == [2, 5]
    # The parameters are the true ones, so modes that nobody fitted are the true ones too.
    np.testing.assert_allclose(record.updated, list(TRUTH.values()), rtol=1e-6)
    np.testing.assert_allclose(held.error_updated, 0.0, atol=1e-7)
    assert (np.abs(held.error_initial) > 1e-4).all()
    assert not held.any_worse
    np.testing.assert_allclose(held.mac_updated, 1.0 if shapes else np.nan, rtol=1e-9)


def test_before_and_after_are_the_models_own_frequencies(
    bench: Any, watcher: Any, chain_of: Callable[[Values], tuple[Floats, Floats]]
) -> None:
    record = run(bench, watcher, hold_out(bench.campaign(TRUTH), (4,)))
    held = record.held_out
    assert held is not None
    for found, values in ((held.initial_hz, {}), (held.updated_hz, TRUTH)):
        np.testing.assert_allclose(found, frequencies(chain_of, values)[3], rtol=1e-6)


def test_what_is_held_out_never_influences_the_answer(bench: Any, watcher: Any) -> None:
    whole = bench.campaign(TRUTH, shapes=True)
    without = recased(whole, test=whole.test.use((1, 2, 3)))
    plain = run(bench, watcher, without, "plain")
    lies = MeasuredModes(
        (4, 5), replace(whole.test.use((4, 5)).modes, frequencies_hz=np.array([3.0, 900.0]))
    )
    for held in (whole.test.use((4, 5)), lies):
        other = run(bench, watcher, recased(without, held_out=held), "other")
        np.testing.assert_array_equal(other.updated, plain.updated)  # bit for bit
        assert other.best.residual.values.tolist() == plain.best.residual.values.tolist()


def test_held_out_modes_need_no_solver_run_of_their_own(bench: Any, watcher: Any) -> None:
    whole = bench.campaign(TRUTH)
    run(bench, watcher, recased(whole, test=whole.test.use((1, 2, 3))), "plain")
    plain = bench.runs()
    (bench.folder / "store").rename(bench.folder / "first-store")
    run(bench, watcher, hold_out(whole, (4, 5)), "other")
    assert bench.runs() == 2 * plain


def test_frequencies_alone_keep_their_place_in_the_order_of_all(bench: Any, watcher: Any) -> None:
    # Modes 1 and 4 are used: without mode 2 and 3 in the order, 4 would be taken for the second.
    campaign = bench.campaign(TRUTH, modes=(1, 2, 3, 4))
    record = run(bench, watcher, hold_out(campaign, (2, 3)))
    assert record.iterations[0].pairing.computed.tolist() == [0, 3]
    assert record.held_out is not None
    np.testing.assert_allclose(
        record.held_out.test_hz, campaign.test.modes.frequencies_hz[1:3], rtol=0
    )


def frequencies(chain_of: Callable[[Values], tuple[Floats, Floats]], values: Values) -> Floats:
    """Of the chain, from M^-1 K, which is not symmetric: another way than the solver's."""
    stiffness, masses = chain_of(values)
    eigenvalues = np.sort(np.linalg.eigvals(stiffness / masses[:, None]).real)
    return np.asarray(np.sqrt(eigenvalues) / 2 / np.pi)


def wrong_parameter(bench: Any, shapes: bool = False) -> Campaign:
    """The truth has another spring than the one that may change: a model-form error.

    Fitted to the first mode alone by the wrong spring, the higher modes are driven away.
    """
    campaign = bench.campaign(
        {"k1": 1.3}, modes=(1, 2, 3, 4), shapes=shapes, parameters={"k2": "spring_stiffness"}
    )
    return hold_out(campaign, (2, 3, 4))


def test_a_held_out_mode_that_got_worse_is_marked_everywhere(
    bench: Any, watcher: Any, chain_of: Callable[[Values], tuple[Floats, Floats]]
) -> None:
    record = run(bench, watcher, wrong_parameter(bench))
    held = record.held_out
    assert held is not None
    # What k2 has to be for the first frequency to be right, by bisection, and mode 4 with it.
    true = frequencies(chain_of, {"k1": 1.3})
    k2 = brentq(lambda value: frequencies(chain_of, {"k2": value})[0] - true[0], 1.0, 2.5)
    np.testing.assert_allclose(record.updated, k2, rtol=1e-6)
    bent = frequencies(chain_of, {"k2": k2})
    np.testing.assert_allclose(held.error_updated, bent[1:4] / true[1:4] - 1.0, rtol=1e-4)
    growth = np.abs(held.error_updated) - np.abs(held.error_initial)
    assert held.worse.tolist() == (growth > 0.002).tolist() == [False, False, True]
    told: Any = summary(record, Path("runs"))["held_out"]
    assert [(row["test"], row["worse"]) for row in told] == [(2, False), (3, False), (4, True)]
    assert told[2]["mac_updated"] is None
    (line,) = held_out_lines(held)
    assert line.startswith("mode 4, held out, got worse: it was ")
    section = page(record).partition('<section id="held-out">')[2].partition("</section>")[0]
    assert "Mode 4, held out, got worse" in section
    assert 'class="outside"' in section
    console = Console(force_terminal=True, color_system="standard", width=120, record=True)
    with console.capture() as shown:
        show(held_out_parts(held), console)
    assert "\x1b[1;31m" in shown.get()  # bold red


def test_the_record_keeps_what_was_held_out(bench: Any, watcher: Any) -> None:
    record = run(bench, watcher, wrong_parameter(bench, shapes=True))
    again = read_record(bench.folder / "run" / "campaign.h5")
    assert record.held_out is not None
    assert again.held_out is not None
    for name in (
        "numbers",
        "test_hz",
        "initial_hz",
        "updated_hz",
        "error_initial",
        "error_updated",
        "mac_initial",
        "mac_updated",
        "worse",
    ):
        np.testing.assert_array_equal(getattr(again.held_out, name), getattr(record.held_out, name))
    assert held_out_table(again.held_out).texts == held_out_table(record.held_out).texts


def test_without_held_out_modes_nothing_is_told(bench: Any, watcher: Any) -> None:
    record = run(bench, watcher, bench.campaign(TRUTH))
    assert record.held_out is None
    assert summary(record, Path("runs"))["held_out"] == []
    assert 'id="held-out"' not in page(record)
    assert read_record(bench.folder / "run" / "campaign.h5").held_out is None


# the judgement


def pair(frequencies: list[float], held: list[float]) -> tuple[Any, Any]:
    computed = mode_set(frequencies)
    return computed, pair_by_order(mode_set(held), computed)


@pytest.mark.parametrize(
    ("before", "after", "worse"),
    [
        (101.0, 101.15, False),  # 1.00 % and 1.15 %: within the deviation of 0.2 %
        (101.0, 101.25, True),
        (101.0, 98.9, False),  # the other side counts by its size
        (101.0, 98.7, True),
        (101.0, 100.0, False),
    ],
)
def test_a_frequency_got_worse_beyond_its_deviation(
    before: float, after: float, worse: bool
) -> None:
    test = MeasuredModes((7,), mode_set([100.0]))
    held = judge_held_out(
        test, np.full(test.modes.n_modes, 0.002), pair([before], [100.0]), pair([after], [100.0])
    )
    assert held.worse.tolist() == [worse]


@pytest.mark.parametrize(("fall", "worse"), [(0.019, False), (0.021, True)])
def test_a_shape_got_worse_where_its_mac_fell_by_two_hundredths(fall: float, worse: bool) -> None:
    def turned(mac: float) -> Any:
        shapes = np.array([[np.sqrt(mac)], [np.sqrt(1.0 - mac)]])
        return mode_set([100.0], shapes, [1, 2], [1, 1])

    test = MeasuredModes((1,), mode_set([100.0], [[1.0], [0.0]], [1, 2], [1, 1]))
    states = [(turned(mac), pair_by_shape(test.modes, turned(mac))) for mac in (0.95, 0.95 - fall)]
    held = judge_held_out(test, np.full(test.modes.n_modes, 0.002), states[0], states[1])
    assert held.worse.tolist() == [worse]


def test_a_held_out_mode_takes_no_partner_from_a_used_one() -> None:
    # Both measured shapes resemble the first computed mode most; the used one has it.
    computed = mode_set([10.0, 20.0, 30.0], np.eye(3), [1, 2, 3], [1, 1, 1])
    used = MeasuredModes((1,), mode_set([10.0], [[1.0], [0.1], [0.0]], [1, 2, 3], [1, 1, 1]))
    held = MeasuredModes((2,), mode_set([21.0], [[0.8], [0.6], [0.0]], [1, 2, 3], [1, 1, 1]))
    pairing = pair_by_shape(used.modes, computed)
    found = pair_held_out(held, used, computed, pairing)
    assert pairing.computed.tolist() == [0]
    assert found.computed.tolist() == [1]


def test_a_mode_that_is_no_longer_found_got_worse() -> None:
    computed = mode_set([10.0, 20.0], np.eye(2), [1, 2], [1, 1])
    test = MeasuredModes((2,), mode_set([20.0]))
    used = MeasuredModes((1,), mode_set([10.0]))
    before = pair_held_out(test, used, computed, pair_by_order(used.modes, computed))
    alone = mode_set([10.0], [[1.0], [0.0]], [1, 2], [1, 1])
    after = track_held_out(before, computed, alone, pair_by_order(used.modes, alone))
    assert after.computed.tolist() == [LOST]
    held = judge_held_out(
        test, np.full(test.modes.n_modes, 0.002), (computed, before), (alone, after)
    )
    assert held.worse.tolist() == [True]
    assert held.reason(0) == "is not found in the updated model"


def test_one_mode_that_is_not_there_leaves_the_others() -> None:
    # By shape: the first resembles computed mode 2, the other nothing, MAC 0.04 at most.
    points = [1, 2, 3], [1, 1, 1]
    computed = mode_set([10.0, 20.0], np.eye(3)[:, :2], *points)
    used = MeasuredModes((1,), mode_set([10.0], [[1.0], [0.0], [0.0]], *points))
    shapes = np.array([[0.0, 0.2], [1.0, 0.2], [0.1, 0.96]])
    held = MeasuredModes((2, 3), mode_set([20.0, 30.0], shapes, *points))
    for model in (computed, mode_set([10.0, 20.0, 40.0], np.diag([1.0, 1.0, 0.0]), *points)):
        found = pair_held_out(held, used, model, pair_by_shape(used.modes, model))
        assert found.computed.tolist() == [1, LOST]
        np.testing.assert_allclose(found.mac, [1.0 / 1.01, np.nan])
    # By order: the third frequency has no place among two.
    plain = MeasuredModes((2, 3), mode_set([20.0, 30.0]))
    first = MeasuredModes((1,), mode_set([10.0]))
    placed = pair_held_out(plain, first, computed, pair_by_order(first.modes, computed))
    assert placed.computed.tolist() == [1, LOST]
    # Tracked: what was found goes on, now as the first; what was lost stays so.
    now = mode_set([19.0, 25.0], np.eye(3)[:, [1, 0]], *points)
    going = replace(pair_by_order(first.modes, now), computed=np.array([1]))
    tracked = track_held_out(placed, computed, now, going)
    assert tracked.computed.tolist() == [0, LOST]
    held_out = judge_held_out(
        plain, np.full(plain.modes.n_modes, 0.002), (computed, placed), (now, tracked)
    )
    assert held_out.worse.tolist() == [True, False]  # 5 % off; the other never was there


# leave-one-out


def test_leaving_each_mode_out_finds_it_again_with_a_right_model(bench: Any) -> None:
    campaign = bench.campaign(TRUTH, shapes=True)
    found = leave_one_out(campaign, silent)
    assert [fold.number for fold in found.folds] == [1, 2, 3, 4, 5]
    assert found.held_out is not None
    assert found.held_out.numbers.tolist() == [1, 2, 3, 4, 5]
    np.testing.assert_allclose(found.held_out.error_updated, 0.0, atol=1e-7)
    assert found.status == "good"
    least, largest = found.spread
    np.testing.assert_allclose(least, list(TRUTH.values()), rtol=1e-6)
    np.testing.assert_allclose(largest, list(TRUTH.values()), rtol=1e-6)


def test_updates_share_what_they_have_in_common(bench: Any) -> None:
    campaign = bench.campaign(TRUTH, shapes=True)
    found = leave_one_out(campaign, silent)
    assert bench.runs() == found.runs.modal + found.runs.sensitivity  # no job ran twice unseen
    # The initial model and the matrices (its own and two of springs) are common to all five.
    assert bench.runs("matrices") == found.runs.sensitivity == 3
    assert found.runs.reused >= 4
    before = bench.runs()
    assert leave_one_out(campaign, silent).folds[2].updated.tolist() == (
        found.folds[2].updated.tolist()
    )
    assert bench.runs() == before


def test_an_update_in_a_round_is_the_one_that_holds_the_mode_out(bench: Any, watcher: Any) -> None:
    campaign = bench.campaign(TRUTH)
    found = leave_one_out(campaign, silent)
    single = run(bench, watcher, hold_out(campaign, (3,)))
    np.testing.assert_array_equal(found.folds[2].updated, single.updated)


def test_a_wrong_parameter_shows_in_what_was_left_out(bench: Any) -> None:
    kinds = {"k2": "spring_stiffness"}
    campaign = bench.campaign({"k1": 1.3}, modes=(1, 2, 3, 4), parameters=kinds)
    found = leave_one_out(campaign, silent)
    assert found.status == "worse"
    assert found.held_out is not None
    assert found.held_out.worse[3]  # mode 4, when k2 is fitted to the others


def test_a_mode_that_is_left_out_joins_those_that_are_held_out(bench: Any) -> None:
    campaign = hold_out(bench.campaign(TRUTH), (5,))
    left = leave_out(campaign, 2)
    assert left.test.numbers == (1, 3, 4)
    assert left.case.held_out is not None
    assert left.case.held_out.numbers == (2, 5)
    assert left.case.n_modes == campaign.case.n_modes  # so that jobs have the same keys


def test_an_update_that_fails_is_told_and_keeps_the_others(
    bench: Any, caplog: pytest.LogCaptureFixture
) -> None:
    campaign = replace(
        bench.campaign(TRUTH), run=bench.campaign(TRUTH).run.model_copy(update={"parallel": 1})
    )
    bench.script({1: "short"})
    found = leave_one_out(campaign, silent)
    assert found.status == "failed"
    assert [fold.number for fold in found.failed] == [1]
    assert "broke off" in found.failed[0].reason
    assert found.held_out is not None
    assert found.held_out.numbers.tolist() == [2, 3, 4, 5]
    assert "without mode 1" in caplog.text


def test_the_only_used_mode_cannot_be_left_out(bench: Any) -> None:
    with pytest.raises(CampaignError, match="mode 2 is the only one that is used"):
        leave_one_out(bench.campaign(TRUTH, modes=(2,)), silent)
    assert bench.runs() == 0


def test_validating_wants_something_held_out(bench: Any) -> None:
    with pytest.raises(CampaignError, match="holds out nothing"):
        validate(bench.campaign(TRUTH), silent)
    assert bench.runs() == 0


def test_a_solver_that_fails_ends_the_validation_of_held_out_modes(bench: Any) -> None:
    bench.script({1: "short"})
    with pytest.raises(SolverCrashed):
        validate(hold_out(bench.campaign(TRUTH), (5,)), silent)


# from files


CHAIN = """\
masses: {a: 2.0, b: 1.0, c: 1.5}
springs:
  k1: {between: [ground, a], stiffness: 1000.0}
  k2: {between: [a, b], stiffness: 800.0}
  k3: {between: [b, c], stiffness: 600.0}
"""
CAMPAIGN = """\
name: small
model: {deck: chain.yaml, solver: matrices, units: m-kg-s}
test:
  modes: measured.csv
  hold_out: [3]
parameters:
  - {name: k1, quantity: spring_stiffness, elset: k1}
  - {name: k2, quantity: spring_stiffness, elset: k2}
update: {step: weighted_least_squares, e1: {frequency: 1.0e-6}}
report: {page: false}
"""


def chain_hz(k1: float, k2: float) -> Floats:
    """Frequencies of the deck's chain with other springs, by LAPACK."""
    k1, k2, k3 = 1000.0 * k1, 800.0 * k2, 600.0
    stiffness = np.array([[k1 + k2, -k2, 0.0], [-k2, k2 + k3, -k3], [0.0, -k3, k3]])
    root = np.sqrt([2.0, 1.0, 1.5])
    return np.asarray(np.sqrt(np.linalg.eigvalsh(stiffness / np.outer(root, root))) / 2 / np.pi)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))
    (tmp_path / "chain.yaml").write_text(CHAIN)
    (tmp_path / "campaign.yaml").write_text(CAMPAIGN)
    frequencies = ", ".join(f"{value:.9f}" for value in chain_hz(1.1, 0.9))
    (tmp_path / "measured.csv").write_text(f"mode, 1, 2, 3\nfrequency_hz, {frequencies}\n")
    return tmp_path


def test_all_modes_but_those_held_out_are_used(folder: Path) -> None:
    campaign = load_campaign(folder / "campaign.yaml")
    assert campaign.test.numbers == (1, 2)
    assert campaign.case.held_out is not None
    assert campaign.case.held_out.numbers == (3,)


@pytest.mark.parametrize(
    ("test", "line", "said"),
    [
        ("{modes: measured.csv, use: [1, 2], hold_out: [2, 3]}", 3,
         "`hold_out` names mode 2, which `use` names too"),
        ("{modes: measured.csv, hold_out: [3, 3]}", 3, "`hold_out` names a mode twice"),
        ("{modes: measured.csv, hold_out: [7]}", 3, "mode 7 is to be held out, but measured.csv "
         "has modes 1, 2, 3"),
        ("{modes: measured.csv, hold_out: [1, 2, 3]}", 3, "nothing is left to update with"),
    ],
)  # fmt: skip
def test_what_cannot_be_held_out_is_refused_with_its_line(
    folder: Path, test: str, line: int, said: str
) -> None:
    text = CAMPAIGN.replace("test:\n  modes: measured.csv\n  hold_out: [3]\n", f"test: {test}\n")
    (folder / "campaign.yaml").write_text(text.replace("elset: k2}", "elset: nowhere}"))
    with pytest.raises(CampaignError) as caught:
        load_campaign(folder / "campaign.yaml")
    assert f"line {line}: " in str(caught.value)
    assert said in str(caught.value)
    if "use:" not in test and "3, 3" not in test:  # past the keys all problems come at once
        assert "nowhere" in str(caught.value)


def test_the_command_validates_by_what_is_held_out(folder: Path) -> None:
    done = modetune(folder, "validate", "campaign.yaml", "--no-prefect", "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["status"] == "good"
    (row,) = told["held_out"]
    assert row["test"] == 3
    np.testing.assert_allclose(row["initial_hz"], chain_hz(1.0, 1.0)[2], rtol=1e-9)
    np.testing.assert_allclose(row["updated_hz"], chain_hz(1.1, 0.9)[2], rtol=1e-6)


def test_the_command_leaves_each_mode_out_and_fails_where_one_got_worse(folder: Path) -> None:
    # One wrong spring only: k3 is not the one that differs.
    wrong = (
        CAMPAIGN.replace("  hold_out: [3]\n", "")
        .replace("  - {name: k1, quantity: spring_stiffness, elset: k1}\n", "")
        .replace("k2", "k3")
    )
    (folder / "campaign.yaml").write_text(wrong)
    done = modetune(folder, "validate", "campaign.yaml", "--no-prefect", "--leave-one-out")
    assert done.returncode == 3, done.stderr
    assert "got worse: it was" in done.stdout
    assert "3 updates; solver runs: " in done.stdout
    table = done.stdout.partition("without ")[2]  # a row a mode
    assert re.findall(r"(?m)^\D*(\d)\D+\d\.\d{4}\b", table) == ["1", "2", "3"]
    again = modetune(
        folder, "validate", "campaign.yaml", "--no-prefect", "--leave-one-out", "--json"
    )
    told = json.loads(again.stdout)
    assert told["status"] == "worse"
    assert told["solver_runs"]["modal"] == 0  # all from the store
    assert [row["test"] for row in told["held_out"]] == [1, 2, 3]
    assert [update["left_out"] for update in told["updates"]] == [1, 2, 3]


def test_the_command_says_what_is_missing_in_one_sentence(folder: Path) -> None:
    (folder / "campaign.yaml").write_text(CAMPAIGN.replace("  hold_out: [3]\n", ""))
    done = modetune(folder, "validate", "campaign.yaml", "--no-prefect")
    assert done.returncode == 2
    assert "holds out nothing to judge by" in done.stderr
    assert "Traceback" not in done.stderr
