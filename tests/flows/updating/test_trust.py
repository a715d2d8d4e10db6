"""What a campaign says of its own answer: a well-posed twin, and cases that cannot be told."""

from __future__ import annotations

import json
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from modetune.core.modes import MeasuredModes
from modetune.core.storage.campaign_record import IterationRecord, read_record
from modetune.core.updating.parameter_steps import StepForm
from modetune.core.updating.trust import Trust, trust_sentences
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.campaign.schema import E1Section, UpdateSection
from modetune.flows.report.page import page, prose
from modetune.flows.updating.diagnosis import checked
from modetune.flows.updating.display import show_run
from modetune.flows.updating.record import CampaignRun, summary
from modetune.flows.updating.update import update_campaign
from tests.flows.conftest import recased

TRUTH = {"k1": 1.2, "k2": 0.8, "k3": 1.1}
FORMS: tuple[StepForm, ...] = (
    "trust_region",
    "pseudo_inverse",
    "weighted_least_squares",
    "minimum_norm",
    "regularised",
    "pulled_to_initial",
)


def run(bench: Any, watcher: Any, campaign: Any) -> CampaignRun:
    return update_campaign(campaign, bench.folder / "run", watcher)


def trust_of(run: CampaignRun) -> Trust:
    assert run.record.trust is not None
    return run.record.trust


@pytest.mark.parametrize("form", FORMS)
def test_nothing_is_flagged_on_a_well_posed_twin(bench: Any, watcher: Any, form: StepForm) -> None:
    update = UpdateSection(step=form, e1=E1Section(frequency=2e-3, mac=0.0), e2=0.0, step_limit=0.5)
    found = trust_of(run(bench, watcher, bench.campaign(TRUTH, update=update)))
    assert found.flagged == ()
    # The scripted solver has no matrices, and no other start was requested.
    assert found.untested
    assert found.verdict == "trusted with reservations"
    assert found.unseen == ()


def test_an_update_that_e1_ends_early_says_where_its_standard_errors_hold(
    bench: Any, watcher: Any
) -> None:
    # Damped steps until all frequencies are within 2 %, measured to 0.2 %.
    update = UpdateSection(
        step="regularised", regularisation=1000.0, e2=0.0, e1=E1Section(frequency=0.02, mac=0.0)
    )
    early = run(bench, watcher, bench.campaign(TRUTH, update=update))
    found = trust_of(early)
    assert found.agrees
    assert found.ended == "good enough"
    assert found.verdict == "trusted with reservations"
    said = trust_sentences(found)[1]
    assert said.startswith(
        "Updating ended with e1 met, before the minimum misfit, which is further"
    )
    exact = UpdateSection(step="regularised", e2=0.0, e1=E1Section(frequency=1e-5, mac=0.0))
    told = update_campaign(bench.campaign(TRUTH, update=exact), bench.folder / "exact", watcher)
    assert trust_of(told).ended == "least misfit"
    # The way to the least misfit is in the standard errors of the values that stop before it.
    way, errors = told.record.updated - early.record.updated, early.record.standard_errors
    assert (np.abs(way) <= 1.96 * errors).all()
    assert (np.abs(way) > 3.0 * told.record.standard_errors).any()
    scatter = np.sqrt(errors**2 - found.remaining**2)
    np.testing.assert_allclose(scatter, told.record.standard_errors, rtol=0.5)
    summed: Any = summary(early.record, early.folder)
    assert summed["ended_at"] == "good enough"
    assert summed["trust"]["ended_at"] == "good enough"
    assert "agrees with its test (e1), short of the minimum misfit" in page(early.record)
    assert "agrees with its test, at the minimum misfit" in page(told.record)


@pytest.mark.parametrize("truth", [TRUTH, {**TRUTH, "k5": 1.5}])
def test_what_no_parameter_stands_for_takes_the_trust_away_everywhere(
    bench: Any, watcher: Any, truth: dict[str, float]
) -> None:
    parameters: Any = dict.fromkeys(TRUTH, "spring_stiffness")
    update = UpdateSection(
        step="weighted_least_squares", e2=0.0, step_limit=0.5, e1=E1Section(frequency=1e-4, mac=0.0)
    )
    campaign = bench.campaign(truth, shapes=True, parameters=parameters, update=update)
    held = recased(campaign, test=campaign.test.use((1, 2, 4, 5)), held_out=campaign.test.use((3,)))
    told = run(bench, watcher, held)
    found = trust_of(told)
    summed: Any = summary(told.record, told.folder)
    console = Console(file=StringIO(), width=2000)
    show_run(console, told)
    shown = console.file.getvalue()  # type: ignore[attr-defined]  # a StringIO
    for sentence in trust_sentences(found):
        assert sentence in shown
        assert sentence in summed["trust"]["sentences"]
        assert prose(sentence) in page(told.record)
    assert summed["trust"]["verdict"] == found.verdict
    kept = read_record(told.folder / "campaign.h5").trust
    assert kept is not None
    assert kept.verdict == found.verdict
    if "k5" not in truth:
        assert found.verdict == "trusted with reservations"
        assert found.untested
        assert found.concerns == ()
        return
    assert found.times_noise > 3.0
    assert found.verdict == "not to be trusted"
    assert any("No parameter values within the bounds" in concern for concern in found.concerns)


def test_a_held_out_mode_that_got_worse_is_a_reservation(bench: Any, watcher: Any) -> None:
    campaign = bench.campaign(TRUTH, shapes=True)
    modes = campaign.test.use((4,)).modes
    lies = MeasuredModes(
        (4,), replace(modes, frequencies_hz=bench.measured({}, (4,), False).frequencies_hz)
    )
    # Measured as the model has it before, so updating takes the model away from it.
    told = run(
        bench, watcher, recased(campaign, test=campaign.test.use((1, 2, 3, 5)), held_out=lies)
    )
    found = trust_of(told)
    assert found.verdict == "trusted with reservations", trust_sentences(found)
    assert "1 of 1 held-out modes got worse by updating (mode 4)" in found.concerns[-1]


def test_modes_that_updating_brought_below_those_of_the_test_are_a_reservation(
    bench: Any, watcher: Any
) -> None:
    record = run(bench, watcher, bench.campaign(TRUTH, shapes=True)).record
    assert record.trust is not None
    assert record.trust.concerns == ()

    def moved(iteration: IterationRecord, below: int) -> IterationRecord:
        """With a partner further up for each measured mode, as if others had come below."""
        pairing = iteration.pairing
        return replace(iteration, pairing=replace(pairing, computed=pairing.computed + below))

    first, *_, last = record.iterations
    for before, after, told in ((0, 1, True), (1, 1, False), (2, 1, False)):
        ends = replace(record, iterations=(moved(first, before), moved(last, after)))
        found = checked(ends).trust
        assert found is not None
        said = [item for item in found.concerns if "below all that answer the test" in item]
        assert bool(said) is told
        if told:
            assert f"({last.computed.frequencies_hz[0]:.4g} Hz)" in said[0]
            assert found.verdict == "trusted with reservations"


def test_shares_and_singular_values_are_those_of_the_chain(bench: Any, watcher: Any) -> None:
    """Against the normal equations of the sensitivity that the record holds."""
    record = run(bench, watcher, bench.campaign(TRUTH)).record
    assert record.trust is not None
    found = record.trust.identifiability
    # The loop ends without a new matrix where the step promised e1: the last one is the step's.
    s, w = record.best.sensitivity, record.best.residual.weights
    information = s.T @ (w[:, None] * s)
    expected = np.diag(np.linalg.solve(information + np.eye(3) / 0.3**2, information))
    np.testing.assert_allclose(found.test_shares, expected, rtol=1e-3)
    values = np.sqrt(np.linalg.eigvalsh(information * 0.3**2))[::-1]
    np.testing.assert_allclose(found.singular_values, values, rtol=1e-2)


def test_more_springs_than_frequencies_are_not_to_be_trusted(bench: Any, watcher: Any) -> None:
    update = UpdateSection(step="regularised", e1=E1Section(frequency=1e-4, mac=0.0), e2=0.0)
    told = run(bench, watcher, bench.campaign(TRUTH, modes=(1,), update=update))
    assert told.record.status == "converged"  # the one frequency is met
    found = trust_of(told)
    assert found.verdict == "not to be trusted"
    assert found.identifiability.n_told == pytest.approx(1.0, abs=0.01)


def test_a_parameter_on_its_bound_is_named_in_table_summary_and_report(
    bench: Any, watcher: Any
) -> None:
    told = run(bench, watcher, bench.campaign(TRUTH, bounds=(0.9, 1.3)))
    found = trust_of(told)
    assert "on_bound" in found.parameters[1].flags
    sentence = found.parameters[1].sentence
    assert "k2 is on its lower bound (0.9)" in sentence
    console = Console(file=StringIO(), width=200)
    show_run(console, told)
    shown = console.file.getvalue()  # type: ignore[attr-defined]  # a StringIO
    assert f"- {sentence}" in shown
    assert found.verdict in shown
    text = page(told.record)
    assert 'id="trust"' in text
    assert "k2 is on its lower bound (0.9)" in text
    assert 'data-chart="l_curve"' in text


def test_the_summary_has_every_number_as_json(bench: Any, watcher: Any) -> None:
    told = run(bench, watcher, bench.campaign(TRUTH, modes=(1, 2)))
    trust = json.loads(json.dumps(summary(told.record, told.folder), allow_nan=False))["trust"]
    assert set(trust) >= {"verdict", "sentences", "condition", "singular_values", "parameters"}
    assert trust["condition"] is None  # three springs from two frequencies: infinite
    for item in trust["parameters"]:
        assert set(item) == {
            "name",
            "test_share",
            "standard_error",
            "repeatability",
            "on_bound",
            "collinear_with",
            "flags",
            "sentence",
            "to_least_misfit",
        }
    assert 0.0 <= trust["parameters"][0]["test_share"] <= 1.0


def test_the_record_keeps_it_and_the_l_curve_of_the_last_step(bench: Any, watcher: Any) -> None:
    update = UpdateSection(
        step="regularised", regularisation="l_curve", e2=0.0, e1=E1Section(frequency=1e-3, mac=0.0)
    )
    told = run(bench, watcher, bench.campaign(TRUTH, update=update))
    kept = read_record(told.folder / "campaign.h5").trust
    assert repr(kept) == repr(told.record.trust)
    assert kept is not None
    assert kept.curve is not None
    # The last step took the corner of this curve.
    assert kept.curve.corner == pytest.approx(kept.regularisation)
    assert kept.curve.corner in kept.curve.factors


def test_a_campaign_without_a_step_has_nothing_to_say(bench: Any, watcher: Any) -> None:
    update = UpdateSection(max_iterations=0, e1=E1Section(frequency=1e-8, mac=0.0))
    told = run(bench, watcher, bench.campaign(TRUTH, update=update))
    assert told.record.trust is None
    assert summary(told.record, told.folder)["trust"] is None
    assert 'id="trust"' not in page(told.record)


def test_a_twin_that_agrees_from_the_start_is_told_by_its_only_sensitivity(
    bench: Any, watcher: Any
) -> None:
    told = run(bench, watcher, bench.campaign({"k1": 1.0, "k2": 1.0}))
    found = trust_of(told)
    assert found.curve is None
    # k1 is known to 1.4 %, so that its change of nothing is within its error; k2 to less than 1 %.
    assert [item.flags for item in found.parameters] == [("uncertain",), ()]
    assert found.verdict == "trusted with reservations"
    assert found.untested


# -- Cases that cannot be told, on the embedded solver.


def system(folder: Path, masses: str, springs: str, parameters: str, frequencies: str) -> Path:
    (folder / "system.yaml").write_text(f"masses: {{{masses}}}\nsprings:\n{springs}")
    count = len(frequencies.split(","))
    (folder / "measured.csv").write_text(
        f"mode,{','.join(str(number + 1) for number in range(count))}\nfrequency_hz,{frequencies}\n"
    )
    path = folder / "campaign.yaml"
    path.write_text(
        "name: system\nmodel: {deck: system.yaml, solver: matrices, units: m-kg-s}\n"
        f"test: {{modes: measured.csv}}\nparameters:\n{parameters}"
        "update: {step: regularised, e1: {frequency: 0.001}, e2: 0.0}\n"
    )
    return path


def test_stiffness_and_mass_of_the_same_group_can_only_be_told_as_a_ratio(
    tmp_path: Path, watcher: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))
    # Two equal masses between walls: omega^2 = k / m and 3 k / m; 5 % up in frequency.
    hz = np.sqrt(np.array([1000.0, 3000.0])) / 2 / np.pi * 1.05
    path = system(
        tmp_path,
        "m1: 1.0, m2: 1.0",
        "  s1: {between: [ground, m1], stiffness: 1000.0}\n"
        "  s2: {between: [m1, m2], stiffness: 1000.0}\n"
        "  s3: {between: [m2, ground], stiffness: 1000.0}\n",
        "  - {name: E, quantity: spring_stiffness, elset: [s1, s2, s3]}\n"
        "  - {name: rho, quantity: mass, elset: [m1, m2]}\n",
        f"{hz[0]!s},{hz[1]!s}",
    )
    told = update_campaign(load_campaign(path), tmp_path / "run", watcher)
    assert told.record.status == "converged"  # both frequencies are met, and yet
    found = trust_of(told)
    assert found.verdict == "not to be trusted"
    assert [item.flags for item in found.parameters] == [("collinear",)] * 2
    assert found.parameters[0].collinear_with == ("rho",)
    assert "The test determines only the ratio of" in found.unseen[0]
    np.testing.assert_allclose(found.identifiability.test_shares, 0.5, atol=0.06)


def test_two_springs_in_series_are_flagged_and_the_third_is_not(
    tmp_path: Path, watcher: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))
    # ground - a - (a mass of 0.001) - b - m1 - c - m2: a and b act as ab / (a + b) = 1000.
    k = np.array([[1000.0 * 1.1 + 2000.0, -2000.0], [-2000.0, 2000.0]])  # the pair 10 % stiffer
    hz = np.sqrt(np.linalg.eigvalsh(k)) / 2 / np.pi
    path = system(
        tmp_path,
        "m0: 0.001, m1: 1.0, m2: 1.0",
        "  a: {between: [ground, m0], stiffness: 2000.0}\n"
        "  b: {between: [m0, m1], stiffness: 2000.0}\n"
        "  c: {between: [m1, m2], stiffness: 2000.0}\n",
        "".join(
            f"  - {{name: {name}, quantity: spring_stiffness, elset: {name}}}\n" for name in "abc"
        ),
        f"{hz[0]!s},{hz[1]!s}",
    )
    told = update_campaign(load_campaign(path), tmp_path / "run", watcher)
    assert told.record.status == "converged"
    found = trust_of(told)
    flags = {item.name: item.flags for item in found.parameters}
    assert flags["a"] == flags["b"] == ("collinear",)
    assert "collinear" not in flags["c"]
    assert "determines a and b only together" in found.unseen[0] or (
        "determines b and a only together" in found.unseen[0]
    )
