"""The updating loop on a scripted solver whose runs are counted."""

from __future__ import annotations

import fcntl
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from modetune.adapters.solver import MatrixAnalysis
from modetune.core.errors import (
    CampaignError,
    LicenceDenied,
    SolverCancelled,
    SolverCrashed,
    SolverRejected,
)
from modetune.core.storage.campaign_record import CampaignRecord, read_record
from modetune.flows.campaign.schema import E1Section, SensitivitySection, UpdateSection
from modetune.flows.campaign.site import RunSection
from modetune.flows.jobs.job import Job
from modetune.flows.updating.record import summary
from modetune.flows.updating.update import update_campaign

TRUTH = {"k1": 1.2, "k2": 0.8, "k3": 1.1, "k4": 0.9}


def settings(**changes: Any) -> UpdateSection:
    base: dict[str, Any] = {
        "step": "weighted_least_squares",
        "e1": E1Section(frequency=1e-8, mac=0.0),
        "e2": 0.0,
        "step_limit": 0.5,
    }
    return UpdateSection(**{**base, **changes})


def run(bench: Any, watcher: Any, campaign: Any, name: str = "run") -> CampaignRecord:
    return update_campaign(campaign, bench.folder / name, watcher).record


@pytest.mark.parametrize(
    "method", ["strain_energy", "semi_analytic", "solver", "finite_difference"]
)
def test_every_method_recovers_the_true_springs(bench: Any, watcher: Any, method: Any) -> None:
    sensitivity = SensitivitySection(method=method, difference="central", step=0.01)
    record = run(bench, watcher, bench.campaign(TRUTH, sensitivity=sensitivity))
    assert record.status == "converged"
    np.testing.assert_allclose(record.updated, list(TRUTH.values()), rtol=1e-5)


def test_auto_needs_no_sensitivity_job_for_springs_and_frequencies(
    bench: Any, watcher: Any
) -> None:
    record = run(bench, watcher, bench.campaign(TRUTH))
    assert bench.runs() == bench.runs("modal") == record.runs.modal
    assert record.runs.sensitivity == 0


def test_auto_takes_matrices_once_for_shapes_because_they_are_constant(
    bench: Any, watcher: Any
) -> None:
    record = run(bench, watcher, bench.campaign(TRUTH, shapes=True))
    assert record.status == "converged"
    # The model, and two jobs of springs that share no mass, ever.
    assert bench.runs("matrices") == 3


def test_masses_and_springs_together_are_recovered(bench: Any, watcher: Any) -> None:
    truth = {"k1": 1.2, "k4": 0.8, "m2": 1.1}
    kinds = {"k1": "spring_stiffness", "k4": "spring_stiffness", "m2": "mass"}
    record = run(bench, watcher, bench.campaign(truth, parameters=kinds))
    np.testing.assert_allclose(record.updated, list(truth.values()), rtol=1e-6)
    # Springs by strain energies, the mass by matrices: every run is planned and counted.
    assert bench.runs("matrices") == record.runs.sensitivity
    assert bench.runs("modal") == record.runs.modal


def test_energies_that_do_not_balance_are_not_believed(
    bench: Any, watcher: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    campaign = bench.campaign(TRUTH)
    honest = type(campaign.case.solver).read

    def without_hourglass(*arguments: Any) -> Any:
        from dataclasses import replace

        result = honest(*arguments)
        if hasattr(result, "total_strain_energy"):
            return replace(result, total_strain_energy=0.9 * result.total_strain_energy)
        return result

    monkeypatch.setattr(type(campaign.case.solver), "read", without_hourglass)
    record = run(bench, watcher, campaign)
    assert record.status == "converged"
    assert set(record.iterations[-1].sensitivity_methods) == {"semi_analytic"}


def test_e2_skips_sensitivities_and_ends_at_the_same_values(bench: Any, watcher: Any) -> None:
    differences = SensitivitySection(method="finite_difference", step=0.001)
    always = run(bench, watcher, bench.campaign(TRUTH, sensitivity=differences), "always")
    before = bench.runs()
    (bench.folder / "store").rename(bench.folder / "first-store")
    campaign = bench.campaign(TRUTH, sensitivity=differences, update=settings(e2=0.02))
    skipping = run(bench, watcher, campaign, "skipping")
    assert sum(item.sensitivity_skipped for item in skipping.iterations) >= 1
    assert skipping.runs.sensitivity < always.runs.sensitivity
    # What is counted was spared: each set but the last has a sensitivity, or is counted.
    assert all(item.accepted for item in skipping.iterations)
    spared = sum(item.sensitivity_skipped for item in skipping.iterations)
    taken = len(skipping.iterations) - 1 - spared
    assert skipping.runs.sensitivity == len(TRUTH) * taken
    assert not skipping.iterations[-1].sensitivity_skipped
    assert bench.runs() - before == skipping.runs.modal + skipping.runs.sensitivity
    np.testing.assert_allclose(skipping.updated, always.updated, rtol=1e-3)
    assert skipping.status == always.status == "converged"


def test_broyden_is_the_default_where_sensitivities_take_runs(bench: Any, watcher: Any) -> None:
    update = UpdateSection(step="weighted_least_squares", e1=E1Section(frequency=1e-5, mac=0.0))
    differences = SensitivitySection(method="finite_difference")
    campaign = bench.campaign(TRUTH, sensitivity=differences, update=update)
    record = run(bench, watcher, campaign)
    always = run(bench, watcher, replace(campaign, update=settings(e1=update.e1)), "always")
    assert record.status == always.status == "converged"
    ages, fresh = (
        [item.sensitivity_age for item in each.iterations[1:]] for each in (record, always)
    )
    assert set(fresh) == {0}
    assert 0 < ages.count(0) < len(fresh)  # the first iteration's is a new one either way
    assert record.runs.sensitivity == ages.count(0) * len(TRUTH)
    np.testing.assert_allclose(record.updated, always.updated, rtol=1e-3)


def test_a_residual_that_changed_by_more_than_e2_brings_a_new_matrix(
    bench: Any, watcher: Any
) -> None:
    differences = SensitivitySection(method="finite_difference", step=0.001)
    campaign = bench.campaign(TRUTH, sensitivity=differences, update=settings(e2=1e-9))
    record = run(bench, watcher, campaign)
    assert record.status == "converged"
    assert not any(item.sensitivity_skipped for item in record.iterations)
    assert all(item.sensitivity_age == 0 for item in record.iterations)


def test_broyden_does_not_stand_in_for_sensitivities_that_take_no_time(
    bench: Any, watcher: Any
) -> None:
    # With a place for each column beside the modal job a new matrix is there as soon as the modes.
    differences = SensitivitySection(method="finite_difference", step=0.001)
    campaign = bench.campaign(TRUTH, sensitivity=differences, update=settings(e2=0.2))
    side_by_side = replace(campaign, run=RunSection(parallel=1 + len(TRUTH)))
    record = run(bench, watcher, side_by_side)
    assert record.status == "converged"
    assert not any(item.sensitivity_skipped for item in record.iterations)
    assert all(item.sensitivity_age == 0 for item in record.iterations)


def test_broyden_does_not_stand_in_where_the_matrices_are_in_the_store(
    bench: Any, watcher: Any
) -> None:
    semi = SensitivitySection(method="semi_analytic")
    campaign = bench.campaign(TRUTH, sensitivity=semi, update=settings(e2=0.2))
    record = run(bench, watcher, replace(campaign, run=RunSection(parallel=1)))
    assert record.status == "converged"
    # The model, and two jobs of springs that share no mass, ever.
    assert bench.runs("matrices") == 3
    assert all(item.sensitivity_age == 0 for item in record.iterations)


def test_broyden_ends_where_it_would_take_more_rounds_than_a_new_matrix(
    bench: Any, watcher: Any
) -> None:
    # So far away that the first corrected matrices leave more than a new one would take to end.
    truth = {"k1": 2.2, "k2": 0.45, "k3": 1.9, "k4": 0.5}
    differences = SensitivitySection(method="finite_difference", step=0.001)
    update = settings(e2=10.0, max_iterations=60, e1=E1Section(frequency=1e-5, mac=0.99))
    campaign = bench.campaign(truth, shapes=True, sensitivity=differences, update=update)
    record = run(bench, watcher, campaign)
    assert record.status == "converged"
    ages = [item.sensitivity_age for item in record.iterations if item.accepted]
    assert max(ages) >= 1
    again = [place for place in range(2, len(ages)) if ages[place] == 0]
    assert again  # a new matrix after corrected ones
    np.testing.assert_allclose(record.updated, list(truth.values()), rtol=1e-3)


def test_broyden_is_not_trusted_where_modes_are_fewer_than_parameters(
    bench: Any, watcher: Any
) -> None:
    differences = SensitivitySection(method="finite_difference", step=0.001)
    update = settings(e2=0.2, e1=E1Section(frequency=1e-6, mac=0.0))
    campaign = bench.campaign(TRUTH, modes=(1, 2, 3), sensitivity=differences, update=update)
    free = run(bench, watcher, campaign, "free")
    assert free.status == "converged"
    assert not any(item.sensitivity_skipped for item in free.iterations)
    held = replace(campaign, update=update.model_copy(update={"step": "regularised"}))
    assert any(item.sensitivity_skipped for item in run(bench, watcher, held, "held").iterations)


def test_a_step_by_an_old_matrix_that_makes_it_worse_is_taken_back(
    bench: Any, watcher: Any
) -> None:
    # e2 so large that every sensitivity after the first is skipped, from a start far away.
    truth = {"k1": 2.2, "k2": 0.45, "k3": 1.9, "k4": 0.5}
    campaign = bench.campaign(
        truth,
        shapes=True,
        sensitivity=SensitivitySection(method="finite_difference", between="keep", step=0.001),
        update=settings(e2=1e3, max_iterations=60, e1=E1Section(frequency=1e-5, mac=0.99)),
    )
    record = run(bench, watcher, campaign)
    assert record.status == "converged"
    np.testing.assert_allclose(record.updated, list(truth.values()), rtol=1e-3)
    misfits = [item.residual.misfit for item in record.iterations if item.accepted]
    assert misfits[-1] < misfits[0]


def test_the_same_campaign_again_starts_no_solver(bench: Any, watcher: Any) -> None:
    first = run(bench, watcher, bench.campaign(TRUTH))
    count = bench.runs()
    again = run(bench, watcher, bench.campaign(TRUTH))
    assert bench.runs() == count
    assert again.runs.modal == again.runs.sensitivity == 0
    assert np.array_equal(again.updated, first.updated)
    # What it cost is told for good: the record and its page have the first run's cost.
    kept = read_record(bench.folder / "run" / "campaign.h5")
    assert kept.runs == first.runs
    assert kept.wall_s == first.wall_s
    assert [item.runs for item in kept.iterations] == [item.runs for item in first.iterations]


def test_bounds_and_step_limit_are_respected(bench: Any, watcher: Any) -> None:
    campaign = bench.campaign(TRUTH, bounds=(0.85, 1.15), update=settings(step_limit=0.04))
    record = run(bench, watcher, campaign)
    assert record.status == "stationary"
    assert "on a bound: k2" in record.reason
    for item in record.iterations:
        assert (np.abs(item.step) <= 0.04 + 1e-12).all()
        assert (item.parameters >= 0.85).all()
        assert (item.parameters <= 1.15).all()


def test_a_crashed_solver_is_tried_again(bench: Any, watcher: Any) -> None:
    bench.script({1: "killed", 3: "short"})
    record = run(bench, watcher, bench.campaign(TRUTH, retries=1))
    assert record.status == "converged"
    assert bench.runs() == record.runs.modal + 2


def test_a_licence_that_is_not_free_is_waited_for_and_is_no_failure(
    bench: Any, watcher: Any
) -> None:
    bench.script({1: "denied", 2: "denied", 4: "denied"})
    campaign = bench.campaign(TRUTH, retries=0)
    record = run(bench, watcher, campaign)
    assert record.status == "converged"
    assert bench.runs() == record.runs.modal + 3


def test_waiting_for_a_licence_has_an_end(bench: Any, watcher: Any) -> None:
    bench.script(dict.fromkeys(range(1, 100), "denied"))
    campaign = bench.campaign(TRUTH, licence_wait_s=0.05)
    with pytest.raises(LicenceDenied, match=r"no licence was free for 0\.0475 s"):
        run(bench, watcher, campaign)
    assert bench.runs() == 4  # after pauses of 0.01, 0.015 and 0.0225; another would be too long


def test_a_step_without_a_licence_is_not_a_step_too_long(bench: Any, watcher: Any) -> None:
    bench.script(dict.fromkeys(range(2, 100), "denied"))
    campaign = bench.campaign(TRUTH, licence_wait_s=0.05)
    with pytest.raises(LicenceDenied):
        run(bench, watcher, campaign)
    assert bench.runs() == 5  # the first set, and the next one with its pauses


@pytest.mark.parametrize("shapes", [False, True])
def test_the_solvers_own_sensitivities_are_one_job_an_iteration(
    bench: Any, watcher: Any, shapes: bool
) -> None:
    solver = SensitivitySection(method="solver")
    record = run(bench, watcher, bench.campaign(TRUTH, shapes=shapes, sensitivity=solver))
    assert record.status == "converged"
    assert bench.runs("derivatives") == record.runs.sensitivity == len(record.iterations) - 1
    semi = SensitivitySection(method="semi_analytic")
    again = run(bench, watcher, bench.campaign(TRUTH, shapes=shapes, sensitivity=semi), "again")
    np.testing.assert_allclose(record.updated, again.updated, rtol=1e-6)


def test_a_column_that_cannot_be_had_is_left_out_and_its_parameter_kept(
    bench: Any, watcher: Any, caplog: Any
) -> None:
    # Run 1 is of the model itself, 2 to 5 are of the columns; one job at a time.
    bench.script({3: "rejected"})
    sensitivity = SensitivitySection(method="finite_difference", step=0.01)
    campaign = replace(bench.campaign(TRUTH, sensitivity=sensitivity), run=RunSection(parallel=1))
    record = run(bench, watcher, campaign)
    assert record.status == "converged"
    first = record.iterations[1]
    left_out = [name == "missing" for name in first.sensitivity_methods]
    assert sum(left_out) == 1
    assert (first.sensitivity[:, left_out] == 0.0).all()
    assert (first.step[left_out] == 0.0).all()
    assert (first.step != 0.0).sum() == len(TRUTH) - 1
    assert "so it keeps its value in this iteration" in caplog.text
    np.testing.assert_allclose(record.updated, list(TRUTH.values()), rtol=1e-5)


def test_a_campaign_ends_where_no_column_can_be_had(bench: Any, watcher: Any) -> None:
    bench.script(dict.fromkeys(range(2, 30), "rejected"))
    sensitivity = SensitivitySection(method="finite_difference")
    with pytest.raises(SolverRejected):
        run(bench, watcher, bench.campaign(TRUTH, sensitivity=sensitivity))


def test_what_jobs_cost_is_in_the_record(bench: Any, watcher: Any) -> None:
    bench.script({1: "killed"})
    campaign = replace(bench.campaign(TRUTH), run=RunSection(parallel=2, licences={"scripted": 1}))
    record = run(bench, watcher, campaign)
    # Each job holds one core and one licence while it runs, the one that was killed too.
    assert record.runs.core_s == pytest.approx(record.runs.licence_s)
    assert 0.0 < record.runs.core_s < record.wall_s
    each = sum(iteration.runs.core_s for iteration in record.iterations)
    assert each == pytest.approx(record.runs.core_s)
    again = run(bench, watcher, campaign, "again")
    assert again.runs.core_s == again.runs.licence_s == 0.0


def test_a_failed_trial_step_is_halved(bench: Any, watcher: Any) -> None:
    bench.script({2: "short"})
    record = run(bench, watcher, bench.campaign(TRUTH))
    assert record.status == "converged"
    assert bench.runs() == record.runs.modal + 1


def test_a_failed_trial_by_an_old_matrix_is_taken_back(
    bench: Any, watcher: Any, caplog: pytest.LogCaptureFixture
) -> None:
    differences = SensitivitySection(method="finite_difference", step=0.001)
    # Runs 1-5 are the start and 6 is iteration 1, whose matrix e2 leaves to Broyden: 7 is the first
    # trial by a matrix of an earlier iteration.
    bench.script({7: "short"})
    campaign = bench.campaign(TRUTH, sensitivity=differences, update=settings(e2=1.0))
    record = run(bench, watcher, campaign)
    assert "taken back, new sensitivity" in caplog.text
    assert record.status == "converged"
    np.testing.assert_allclose(record.updated, list(TRUTH.values()), rtol=1e-3)


@pytest.mark.parametrize("step", ["pseudo_inverse", "minimum_norm", "pulled_to_initial"])
def test_every_step_form_ends_by_its_own_measure(bench: Any, watcher: Any, step: Any) -> None:
    regularisation: Any = "l_curve" if step == "pulled_to_initial" else 1.0
    update = settings(
        step=step, regularisation=regularisation, e1=E1Section(frequency=2e-3, mac=0.0)
    )
    record = run(bench, watcher, bench.campaign(TRUTH, update=update))
    assert record.status == "converged"
    assert all(item.accepted for item in record.iterations)


def test_two_runs_of_one_folder_are_refused(bench: Any, watcher: Any) -> None:
    folder = bench.folder / "run"
    folder.mkdir()
    with (folder / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(CampaignError, match="in progress"):
            run(bench, watcher, bench.campaign(TRUTH))
    assert bench.runs() == 0


def test_waiting_for_another_campaigns_job_can_be_stopped(bench: Any) -> None:
    campaign = bench.campaign(TRUTH)
    engine = bench.engine(campaign)
    job = Job(campaign.parameters.values(campaign.parameters.initial), MatrixAnalysis())
    with engine.store.lock(engine.key(job), lambda: None):
        threading.Timer(0.2, engine.cancelled.set).start()
        with pytest.raises(SolverCancelled, match="another campaign ran the same job"):
            engine.solve(job)


def test_a_rejected_first_deck_ends_the_campaign_and_keeps_its_folder(
    bench: Any, watcher: Any
) -> None:
    bench.script({1: "rejected"})
    with pytest.raises(SolverRejected, match="failed"):
        run(bench, watcher, bench.campaign(TRUTH, retries=2))
    assert bench.runs() == 1
    assert len(list((bench.folder / "store" / "jobs").glob("*.failed"))) == 1


def test_a_failure_leaves_an_earlier_record_as_it_was(bench: Any, watcher: Any) -> None:
    run(bench, watcher, bench.campaign(TRUTH))
    record = bench.folder / "run" / "campaign.h5"
    before = record.read_bytes()
    bench.script({number: "short" for number in range(1, 99)})
    with pytest.raises(SolverCrashed):
        run(bench, watcher, bench.campaign({"k5": 1.1}))
    assert record.read_bytes() == before


def test_no_iterations_compare_the_initial_model_only(bench: Any, watcher: Any) -> None:
    record = run(bench, watcher, bench.campaign(TRUTH, update=settings(max_iterations=0)))
    assert record.status == "max_iterations"
    assert bench.runs() == 1
    assert np.isnan(record.standard_errors).all()


def test_a_lost_mode_widens_the_computed_range(
    bench: Any, watcher: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("modetune.flows.campaign.case.EXTRA_MODES", 0)
    monkeypatch.setattr("modetune.flows.campaign.case.RIGID_MODES", 0)
    record = run(bench, watcher, bench.campaign(TRUTH, modes=(4, 5, 6), shapes=True))
    # Three modes were asked for at first; the measured ones are the fourth to the sixth.
    assert record.iterations[0].pairing.computed.tolist() == [3, 4, 5]


def test_the_record_reads_with_h5py_alone(bench: Any, watcher: Any) -> None:
    record = run(bench, watcher, bench.campaign(TRUTH, shapes=True))
    with h5py.File(bench.folder / "run" / "campaign.h5") as file:
        assert file.attrs["status"] == "converged"
        parameters = file["parameters/parameters"].values()
        assert [item.attrs["name"] for item in parameters] == list(TRUTH)
        np.testing.assert_array_equal(file["updated"][()], record.updated)
        assert len(file["iterations"]) == len(record.iterations)
        last = file[f"iterations/{len(record.iterations) - 1:04d}"]
        assert last.attrs["modal_key"] == record.iterations[-1].modal_key
        assert last["sensitivity"].shape == (last["residual/values"].size, len(TRUTH))
        np.testing.assert_allclose(last["pairing/mac"][()], 1.0)
        keys = [key.decode() for key in last["sensitivity_keys"][()]]
        # The jobs' in the iteration that ran them, and that of the matrices made of them in all.
        assert keys == list(record.iterations[-1].sensitivity_keys)
        counts = [len(item.sensitivity_keys) for item in record.iterations]
        assert counts == [0, 4] + [1] * (len(counts) - 2)
        store = bench.campaign(TRUTH).store
        assert all(key in store for item in record.iterations for key in item.sensitivity_keys)


def test_the_summary_has_what_machines_read(bench: Any, watcher: Any) -> None:
    record = run(bench, watcher, bench.campaign(TRUTH))
    told: Any = summary(record, Path("runs/chain"))
    for key in (
        "status",
        "reason",
        "iterations",
        "solver_runs",
        "parameters",
        "modes",
        "sensitivity_skipped",
        "wall_s",
        "run_dir",
    ):
        assert key in told
    errors = [parameter["standard_error"] for parameter in told["parameters"]]
    assert all(0.0 < error < 1.0 for error in errors)
