"""The launcher of the thesis's chapter 5.2, with real CalculiX on the coarse mesh."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modetune.adapters.solver import MatrixAnalysis
from modetune.configs.cases import write_case
from modetune.configs.launcher.launcher import GROUPS, UNIT_MOUNTS
from modetune.core.errors import SolverMissing
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.flows.campaign.campaign import Campaign, load_campaign
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.report.form_verdict import record_verdict
from modetune.flows.studies.localise.error_maps import OTHER_STIFFNESS
from modetune.flows.studies.localise.localisation import ExaminedState, localise
from modetune.flows.updating.evaluator import evaluator_of
from modetune.flows.updating.update import update_campaign

CASES = ("launcher", "case_1", "case_2")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The campaigns with a store that the tests of this file share."""
    path = tmp_path_factory.mktemp("launcher")
    write_case("launcher", path)
    return path


def loaded(folder: Path, name: str, *settings: str) -> Campaign:
    return load_campaign(folder / f"{name}.yaml", list(settings))


def run(folder: Path, watcher: Any, name: str, *settings: str) -> CampaignRecord:
    campaign = loaded(folder, name, *settings)
    try:
        campaign.solver_version()
    except SolverMissing as error:
        pytest.skip(str(error))
    return update_campaign(campaign, folder / "runs" / campaign.name, watcher).record


def test_the_three_campaigns_are_one_problem(folder: Path) -> None:
    first, *others = (loaded(folder, name) for name in CASES)
    assert [item.targets for item in first.parameters.parameters] == [(name,) for name in GROUPS]
    for other in others:
        assert other.parameters == first.parameters
        assert other.tolerances == first.tolerances
        assert other.update.step_limit == first.update.step_limit
        np.testing.assert_array_equal(
            other.case.measured.modes.mode_shapes, first.case.measured.modes.mode_shapes
        )


@pytest.mark.parametrize("eigensolver", ["solver", "pardiso"])
def test_ten_moduli_take_five_matrix_jobs(folder: Path, eigensolver: str) -> None:
    settings = [f"model.eigensolver={eigensolver}", "sensitivity.method=semi_analytic"]
    campaign = loaded(folder, "launcher", "residuals.shape_weight=0", *settings)
    try:
        campaign.solver_version()
    except SolverMissing as error:
        pytest.skip(str(error))
    engine = job_engine(campaign)
    works = evaluator_of(campaign, engine).planned(campaign.start)
    jobs = [job for work in works for job in work.jobs if isinstance(job.analysis, MatrixAnalysis)]
    # The model's own, and four lots of groups that share no node; mounts belong to none.
    assert len(jobs) == 5
    assert len({tuple(sorted(job.values.items())) for job in jobs}) == 5


def test_the_thesis_cases_differ_in_when_sensitivities_are_computed(folder: Path) -> None:
    case_1, case_2 = (loaded(folder, name) for name in CASES[1:])
    assert case_1.sensitivity == case_2.sensitivity
    assert case_1.sensitivity.method == "finite_difference"
    assert case_1.sensitivity.between == "keep"  # the thesis's way
    assert (case_1.update.e2 > 0.0, case_2.update.e2) == (True, 0.0)


def test_another_model_is_met_as_far_as_the_thesis_meets_its_test(
    folder: Path, watcher: Any
) -> None:
    record = run(folder, watcher, "launcher")
    assert record.status == "converged"
    first, last = record.iterations[0], record.best
    # Tables 22 and 23 of the thesis, before.
    np.testing.assert_allclose(np.abs(first.frequency_errors), [0.061, 0.051, 0.032], atol=0.003)
    np.testing.assert_allclose(first.pairing.mac, [0.95, 0.70, 0.86], atol=0.02)
    # Its measured modes 1 to 5 are the model's 1, 4, 5, 7 and 8.
    five = loaded(folder, "launcher", "test.use=[1,2,3,4,5]")
    engine = job_engine(five)
    evaluator = evaluator_of(five, engine)
    pairing = evaluator.evaluate(0, five.start, None, alone=True)[0].pairing
    assert (pairing.computed + 1).tolist() == [1, 2, 4, 7, 8]
    assert (np.abs(last.frequency_errors) <= [0.015, 0.012, 0.014]).all()  # and after
    assert (last.pairing.mac >= [0.95, 0.84, 0.87]).all()
    bounds = record.parameters.lower, record.parameters.upper
    assert ((record.updated > bounds[0]) & (record.updated < bounds[1])).all()
    # The joints, masses and mesh of the truth are no parameters, and it is told.
    form = record_verdict(record)
    assert form is not None
    assert form.form.suspected
    assert record.trust is not None
    assert record.trust.verdict == "not to be trusted"
    # And where: the mounts of the control unit, which the truth does not carry, hold more of the
    # error for their share of the energy than any part that has a parameter. Apart from their ends
    # the error's strain is largest where the truth has pads: between beam and fitting, 300 mm high,
    # |x| below 100 mm. The bottom plate lies on the fitting as far as 150 mm, plus an element.
    campaign = loaded(folder, "launcher")
    found = localise(campaign, ExaminedState(record.updated))
    assert (found.runs.modal, found.runs.sensitivity) == (0, 0)
    assert found.maps is not None
    errors, groups = found.maps.errors, found.maps.groups
    assert groups[int(np.nanargmax(errors.concentrations))] == OTHER_STIFFNESS
    mesh = campaign.case.solver.deck.mesh()
    ranked = mesh.coordinates[np.argsort(-found.maps.strains)]
    ends = [[600.0, 0.0, 415.0], *map(list, UNIT_MOUNTS)]
    assert sorted(ranked[:3].tolist()) == sorted(ends)
    worst = ranked[3:13]
    assert (np.abs(worst[:, 0]) <= 190.0).all()
    assert (np.abs(worst[:, 2] - 300.0) <= 34.0).all()
