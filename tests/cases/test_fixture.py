"""Chapter 6 of the thesis on the vibration fixture, with real CalculiX."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from modetune.configs.cases import write_case
from modetune.configs.fixture.thesis import (
    THESIS_AFTER,
    THESIS_BEFORE,
    THESIS_MAC_AFTER,
    THESIS_MAC_BEFORE,
    beside,
    claims,
)
from modetune.configs.fixture.twin import MODULI, mean_stiffness
from modetune.core.errors import CampaignError, SolverMissing
from modetune.core.modes import Floats
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.core.updating.trust import trust_sentences
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.report.form_verdict import record_verdict
from modetune.flows.report.parameter_tables import parameter_table, trust_table
from modetune.flows.studies.screen.request import ScreeningRequest
from modetune.flows.studies.screen.screening import screen_campaign
from modetune.flows.updating.evaluator import evaluator_of
from modetune.flows.updating.forecast import Unwatched
from modetune.flows.updating.matrices import MatrixSource
from modetune.flows.updating.record import CampaignRun
from modetune.flows.updating.sensitivities import Sensitivities
from modetune.flows.updating.update import update_campaign

COARSE = "model.deck=fixture_coarse.inp"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The campaigns with a store that the tests of this file share."""
    path = tmp_path_factory.mktemp("fixture")
    write_case("fixture", path)
    try:
        load_campaign(path / "fixture.yaml").solver_version()
    except SolverMissing as error:
        pytest.skip(str(error))
    return path


@pytest.fixture(scope="module")
def run(folder: Path) -> CampaignRun:
    """The campaign as it comes, which was designed to be the thesis's case on this mesh alone."""
    return update_campaign(load_campaign(folder / "fixture.yaml"), folder / "fine", Unwatched())


def holding(record: CampaignRecord) -> list[bool]:
    return [claim.holds for claim in claims(record)]


def test_another_model_is_met_as_the_thesis_meets_its_test(run: CampaignRun) -> None:
    record = run.record
    assert record.status == "converged"
    assert record.iterations[-1].number <= 6  # thesis: six iterations
    first, last = record.iterations[0], record.best
    # As near to Table 26 as the search for the true fixture came (docs/thesis.md).
    np.testing.assert_allclose(np.abs(first.frequency_errors), THESIS_BEFORE, atol=0.015)
    np.testing.assert_allclose(first.pairing.mac, THESIS_MAC_BEFORE, atol=0.05)
    assert (np.abs(last.frequency_errors) <= THESIS_AFTER).all()
    # The MAC of each pair itself, not of the space of close modes.
    assert (last.pairing.mac >= THESIS_MAC_AFTER).all()
    assert holding(record) == [True] * 5


def test_values_that_miss_the_truth_are_told_as_such(run: CampaignRun) -> None:
    record = run.record
    truth = np.array(
        [
            MODULI[target] if target in MODULI else mean_stiffness(target)
            for item in record.parameters.parameters
            for target in item.targets
        ]
    )
    # Pads, roots, masses and uneven ground are no parameters: four of five miss what they stand for
    # by more than two deviations of the test's noise. The model's own error is so large that no
    # standard error is printed; K_x on its bound has none.
    missed = np.abs(record.updated - truth) > 2.0 * record.repeatability
    assert missed.sum() == 4
    assert np.isnan(record.standard_errors).sum() == 4
    form = record_verdict(record)
    assert form is not None
    assert form.form.suspected
    assert record.trust is not None
    assert record.trust.withheld
    assert (
        "the model's own error is too large for standard errors" in trust_sentences(record.trust)[0]
    )
    for table in (parameter_table(record), trust_table(record.trust)):
        assert ["withheld" in row for row in table.texts] == [False, True, True, True, True]
    # Two other minima have as low a misfit, with K_x at 2.6 and 12 times the deck's; none fits.
    assert record.trust.verdict == "not to be trusted"
    flags = {item.name: item.flags for item in record.trust.parameters if item.doubtful}
    assert flags["K_x"] == ("on_bound", "starts")
    assert record.trust.fit_as_well == ()


def test_matrices_serve_all_columns_with_four_jobs(run: CampaignRun) -> None:
    assert set(run.record.best.sensitivity_methods) == {"reduced_model"}
    # The model, and a job for each direction of the springs at the same nodes, the two moduli
    # among them, once and for all.
    assert run.record.runs.sensitivity == 4


def test_shape_sensitivities_to_a_spring_agree_with_central_differences(folder: Path) -> None:
    campaign = load_campaign(
        folder / "fixture.yaml", [COARSE, "sensitivity={difference: central, step: 0.005}"]
    )
    engine = job_engine(campaign)
    evaluator = evaluator_of(campaign, engine)
    evaluation, _ = evaluator.evaluate(0, campaign.start, None, alone=True)
    point = evaluation.parts[0].point
    at_sensors = replace(evaluator.only.analysis, nodes=campaign.case.nodes)
    source = MatrixSource(engine, campaign.parameters, campaign.sensitivity.step)
    methods = Sensitivities(source, campaign.sensitivity, True, at_sensors)
    exact = methods.assemble(point, ["semi_analytic"] * 5, [0, 1])
    differences = methods.assemble(point, ["finite_difference"] * 5, [0, 1])
    for column in range(2):
        # ccx prints seven digits, and central differences err by a curvature times (0.5 %)^2.
        for name in ("eigenvalues", "mode_shapes"):
            expected = getattr(differences, name)[..., column]
            scale = 0.01 * np.abs(expected).max()
            np.testing.assert_allclose(getattr(exact, name)[..., column], expected, atol=scale)


def normalised_sensitivities(file: Path, settings: list[str]) -> tuple[tuple[str, ...], Floats]:
    """Names of a campaign's parameters, and (d f / f) / (d p / p) at its start, (n_modes, n)."""
    campaign = load_campaign(file, [*settings, "residuals.shape_weight=0"])
    engine = job_engine(campaign)
    evaluator = evaluator_of(campaign, engine)
    evaluation, matrix = evaluator.evaluate(0, campaign.start, None, alone=False)
    assert matrix is not None
    measured = campaign.test.modes.eigenvalues[evaluation.pairing.measured]
    computed = evaluation.seen.eigenvalues[evaluation.pairing.computed]
    # The matrix has (d lambda / lambda_measured) / d theta; d f / f is half d lambda / lambda.
    values = 0.5 * matrix.values * (measured / computed)[:, None] * campaign.start
    return campaign.parameters.names, np.asarray(values)


def test_strain_and_spring_energies_are_all_of_the_energy(folder: Path) -> None:
    names, values = normalised_sensitivities(folder / "fixture_candidates.yaml", [COARSE])
    assert (len(names), values.shape) == (13, (3, 13))
    # A half of each mode's eigenvalue.
    np.testing.assert_allclose(values.sum(axis=1), 0.5, rtol=1e-4)


def test_screening_ranks_the_thesiss_five_first(folder: Path) -> None:
    campaign = load_campaign(folder / "fixture_candidates.yaml")
    screening = screen_campaign(campaign, ScreeningRequest("local"), Unwatched().working)
    chosen = load_campaign(folder / "fixture.yaml").parameters.names
    ranked = np.argsort(-screening.importance)[:5]
    assert {campaign.parameters.names[place] for place in ranked} == set(chosen)
    # The linear choice needs the ground alone: the extensions come after, or say the same as K_y.
    assert set(screening.choice.chosen) == {"K_x", "K_y", "K_z"}


def test_frequencies_alone_do_not_tell_five_parameters(folder: Path) -> None:
    settings = [COARSE, "residuals.shape_weight=0", "update.starts=1"]
    campaign = load_campaign(folder / "fixture.yaml", settings)
    record = update_campaign(campaign, folder / "frequencies", Unwatched()).record
    assert np.abs(record.best.frequency_errors).max() <= 0.02
    assert not np.isfinite(record.standard_errors).any()


def test_claims_say_what_does_not_hold(run: CampaignRun) -> None:
    record = run.record
    first = replace(record, iterations=record.iterations[:1])
    # Off this far nothing is reached but the starting point.
    assert holding(first) == [True, True, False, False, True]
    assert holding(replace(record, status="max_iterations"))[4] is False


def test_results_stand_beside_the_thesiss(run: CampaignRun) -> None:
    modes, parameters = beside(run.record)
    assert "34.4" in modes.rows[1]  # thesis Table 26
    assert [row[0] for row in parameters.rows] == list(run.record.parameters.names)
    assert parameters.rows[3][2] == f"{MODULI['EXTENSION_LEFT']:.3f}"
    assert parameters.rows[0][2] == f"{mean_stiffness('FOUNDATION_X'):.3f}"


def test_other_modes_are_not_the_thesiss_case(run: CampaignRun) -> None:
    fewer = replace(run.record, test=run.record.test.use((1, 2)))
    with pytest.raises(CampaignError, match="modes 1, 2 and 3; this campaign used 1, 2"):
        claims(fewer)
