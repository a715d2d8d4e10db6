"""The coarse GARTEUR aircraft on real CalculiX: sensitivities, the twin, the thesis's case."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modetune.configs.cases import write_case
from modetune.configs.garteur.twin import TRUTH
from modetune.core.errors import SolverMissing
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.flows.campaign.campaign import Campaign, load_campaign
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.updating.evaluator import evaluator_of
from modetune.flows.updating.matrices import MatrixSource
from modetune.flows.updating.mode_source import sensitivities
from modetune.flows.updating.sensitivities import Exact
from modetune.flows.updating.update import update_campaign


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The campaigns with a store of their own that the tests of this file share."""
    folder = tmp_path_factory.mktemp("garteur")
    write_case("garteur", folder)
    try:
        load_campaign(folder / "twin.yaml").solver_version()
    except SolverMissing as error:
        pytest.skip(str(error))
    return folder


def run(
    folder: Path, watcher: Any, name: str, *settings: str, runs: str = "runs"
) -> CampaignRecord:
    campaign = load_campaign(folder / name, ["report.page=false", *settings])
    return update_campaign(campaign, folder / runs / campaign.name, watcher).record


def derivatives(campaign: Campaign, method: Exact, columns: list[int]) -> Any:
    """Derivatives of all paired modes at the initial model by one method."""
    engine = job_engine(campaign)
    evaluator = evaluator_of(campaign, engine)
    evaluation, _ = evaluator.evaluate(0, campaign.parameters.initial, None, alone=True)
    chosen: list[Exact] = [method] * len(campaign.parameters)
    (part,) = evaluation.parts
    source = MatrixSource(engine, campaign.parameters, campaign.sensitivity.step)
    methods = sensitivities(campaign, source, evaluator.only.analysis)
    return methods.assemble(part.point, chosen, columns), part


EMPHASIS = "emphasis.yaml"
DENSITY = (
    "parameters=[{name: E_wing, quantity: youngs_modulus, material: WING}, "
    "{name: E_fin, quantity: youngs_modulus, material: FIN}, "
    "{name: rho_wing, quantity: density, material: WING}]"
)


def test_three_methods_agree_on_frequencies(folder: Path) -> None:
    # The step of the next test, whose runs these are.
    settings = [
        DENSITY,
        "residuals.shape_weight=0",
        "sensitivity={difference: central, step: 0.005}",
    ]
    campaign = load_campaign(folder / "twin.yaml", settings)
    exact, _ = derivatives(campaign, "semi_analytic", [0, 1, 2])
    energies, _ = derivatives(campaign, "strain_energy", [0, 1])
    differences, _ = derivatives(campaign, "finite_difference", [0, 1, 2])
    # 0.1 % of the largest of each parameter: central differences err by (0.5 %)^2 of a curvature.
    for column in range(3):
        scale = 1e-3 * np.abs(exact.eigenvalues[:, column]).max()
        np.testing.assert_allclose(
            differences.eigenvalues[:, column], exact.eigenvalues[:, column], atol=scale
        )
    for column in range(2):
        scale = 1e-5 * np.abs(exact.eigenvalues[:, column]).max()
        np.testing.assert_allclose(
            energies.eigenvalues[:, column], exact.eigenvalues[:, column], atol=scale
        )


def test_shape_sensitivities_agree_with_central_differences(folder: Path) -> None:
    settings = [DENSITY, "sensitivity={difference: central, step: 0.005}"]
    campaign = load_campaign(folder / "twin.yaml", settings)
    exact, evaluation = derivatives(campaign, "semi_analytic", [0, 1, 2])
    differences, _ = derivatives(campaign, "finite_difference", [0, 1, 2])
    frequencies = evaluation.modal.elastic.frequencies_hz[evaluation.pairing.computed]
    for pair, frequency in enumerate(frequencies.tolist()):
        gaps = np.abs(np.delete(frequencies, pair) / frequency - 1.0)
        if gaps.min() < 0.01:
            continue  # a close pair turns within its space; its members have no shape of their own
        for column in range(3):
            expected = differences.mode_shapes[:, pair, column]
            # 1 % of the mode's largest derivative, or of the shape where the parameter leaves it.
            shape = np.abs(
                evaluation.modal.elastic.mode_shapes[:, evaluation.pairing.computed[pair]]
            )
            scale = 0.01 * max(np.abs(expected).max(), 0.01 * shape.max())
            np.testing.assert_allclose(exact.mode_shapes[:, pair, column], expected, atol=scale)


PLATE = """\
name: plate
model: {deck: plate.inp, solver: calculix, units: mm-t-s}
test: {modes: plate.csv}
parameters:
  - {name: thickness, quantity: thickness, elset: PLATE}
  - {name: E, quantity: youngs_modulus, material: ALU}
sensitivity: {difference: central, step: 0.01}
"""


def plate_deck() -> str:
    """A cantilevered plate of 8 x 4 S4 shells, 200 x 100 x 3 mm."""
    lines = ["*NODE"]
    lines += [f"{1 + 5 * i + j}, {25.0 * i}, {25.0 * j}, 0." for i in range(9) for j in range(5)]
    lines.append("*ELEMENT, TYPE=S4, ELSET=PLATE")
    for i in range(8):
        for j in range(4):
            n = 1 + 5 * i + j
            lines.append(f"{4 * i + j + 1}, {n}, {n + 5}, {n + 6}, {n + 1}")
    return "\n".join([
        *lines, "*MATERIAL, NAME=ALU", "*ELASTIC", "71000., .3", "*DENSITY", "2.81e-9",
        "*SHELL SECTION, ELSET=PLATE, MATERIAL=ALU", "3.", "*BOUNDARY", "1, 1, 6", "2, 1, 6",
        "3, 1, 6", "4, 1, 6", "5, 1, 6", "",
    ])  # fmt: skip


def test_methods_agree_on_the_thickness_of_a_shell_plate(folder: Path) -> None:
    (folder / "plate.yaml").write_text(PLATE)
    (folder / "plate.inp").write_text(plate_deck())
    (folder / "plate.csv").write_text("mode,1,2,3\nfrequency_hz,60,290,400\n")
    campaign = load_campaign(folder / "plate.yaml")
    exact, evaluation = derivatives(campaign, "semi_analytic", [0, 1])
    differences, _ = derivatives(campaign, "finite_difference", [0, 1])
    scale = 1e-3 * np.abs(exact.eigenvalues).max(axis=0)
    assert (np.abs(exact.eigenvalues - differences.eigenvalues) < scale).all()
    # A plate in bending: frequency as thickness, so d lambda / dp is twice lambda (thin plate).
    bending = exact.eigenvalues[0, 0] / evaluation.modal.elastic.eigenvalues[0]
    assert bending == pytest.approx(2.0, rel=0.02)


@pytest.fixture(scope="module")
def exact_twin(folder: Path) -> CampaignRecord:
    from types import SimpleNamespace

    silent = SimpleNamespace(working=lambda text: None, iteration=lambda record: None)
    return run(folder, silent, "twin.yaml", "store=twin-store", runs="exact")


def test_the_twins_truth_is_recovered(exact_twin: CampaignRecord) -> None:
    assert exact_twin.status == "converged"
    assert exact_twin.iterations[-1].number <= 6
    np.testing.assert_allclose(exact_twin.updated, list(TRUTH.values()), rtol=1e-3)
    # The model and the moduli that share no node, in the whole campaign; what these leave of the
    # stiffness is the others'.
    assert exact_twin.runs.sensitivity == 2


def test_modes_by_the_matrices_take_the_same_jobs(
    folder: Path, watcher: Any, exact_twin: CampaignRecord
) -> None:
    settings = ("store=twin-by-matrices", "model.eigensolver=pardiso")
    record = run(folder, watcher, "twin.yaml", *settings, runs="by-matrices")
    assert record.runs.sensitivity == exact_twin.runs.sensitivity == 2
    np.testing.assert_allclose(record.updated, list(TRUTH.values()), rtol=1e-3)


def test_the_twin_again_starts_no_solver_and_ends_on_the_same_bits(
    folder: Path, watcher: Any, exact_twin: CampaignRecord
) -> None:
    again = run(folder, watcher, "twin.yaml", "store=twin-store")
    assert again.runs.modal == again.runs.sensitivity == 0
    assert np.array_equal(again.updated, exact_twin.updated)


def test_noise_leaves_the_wing_within_two_per_cent(folder: Path, watcher: Any) -> None:
    record = run(folder, watcher, "twin_noisy.yaml")
    wing = record.parameters.names.index("E_wing")
    assert record.updated[wing] == pytest.approx(TRUTH["WING"], rel=0.02)
    assert record.standard_errors[wing] < 0.01


def test_the_thesiss_case_on_the_coarse_mesh_beats_its_errors(folder: Path, watcher: Any) -> None:
    mesh = "model.deck=garteur_coarse.inp"
    record = run(folder, watcher, "thesis.yaml", mesh)
    assert record.status == "converged"
    errors = np.abs(record.best.frequency_errors)
    assert errors.mean() < 0.021  # thesis Table 21: 1.6, 0.4, 3.6, 5.9, 1.0, 0.2 %
    assert (np.abs(record.updated - 1.0) <= 0.3).all()
    assert record.iterations[0].computed.n_modes == 10  # sixteen less the six rigid ones
    assert record.runs.modal == 1  # the solver's last word; all else by the store's matrices
    assert record.runs.sensitivity <= 2


def test_emphasis_moves_the_answer_to_the_first_two_frequencies(folder: Path, watcher: Any) -> None:
    settings = ("model.deck=garteur_coarse.inp", "update.e1.frequency=0.004")
    even, weighed = (run(folder, watcher, name, *settings) for name in ("thesis.yaml", EMPHASIS))
    errors = [np.abs(record.best.frequency_errors) for record in (even, weighed)]
    assert even.status == weighed.status == "stationary"
    # Thesis Table 21 has 1.6 and 0.4 %, which the fine mesh reaches; without emphasis 1.7 %.
    assert errors[1][0] < 0.016
    assert errors[1][1] < 0.005 < 0.015 < errors[0][1]
    assert errors[1].mean() < 0.024
    found = weighed.best.residual
    np.testing.assert_allclose(found.weights * found.variances, [3, 30, 1, 1, 1, 1])


def test_the_updated_deck_runs_in_plain_ccx(folder: Path, exact_twin: CampaignRecord) -> None:
    import subprocess

    updated = folder / "exact" / "garteur-twin" / "updated"
    subprocess.run(["ccx", "garteur_coarse"], cwd=updated, check=True, capture_output=True)
    table = (updated / "garteur_coarse.dat").read_text().split("P A R T I C")[0]
    rows = [line.split() for line in table.splitlines() if line.split()[:1] == ["7"]]
    expected = exact_twin.best.computed.frequencies_hz[0]
    assert float(rows[0][3]) == pytest.approx(expected, rel=1e-6)


def test_pairing_of_the_twin_is_by_shape_and_says_so(exact_twin: CampaignRecord) -> None:
    first = exact_twin.iterations[0].pairing
    assert sorted(first.computed.tolist()) == list(range(8))
    assert all("MAC" in reason for reason in first.reasons)
    # Modes 4 and 5 stand in another order in the model than in the test.
    assert first.computed.tolist() != list(range(8))
