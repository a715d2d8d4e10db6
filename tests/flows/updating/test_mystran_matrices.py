"""Campaigns on MYSTRAN by its matrices, against the same ones by differences, on small decks."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modetune.adapters.nastran.solver import mystran_solver
from modetune.adapters.solver import ModalAnalysis
from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.core.parameters import Parameter
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.core.updating.job_results import ModalResult
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.updating.mode_source import by_solver, modes_source
from modetune.flows.updating.update import update_campaign
from tests.adapters.mystran_decks import AVERAGED, CARRIED, bracket, frame, plate
from tests.adapters.solved import needs_mystran
from tests.adapters.test_solver_contract import run
from tests.command_line import run_command

pytestmark = needs_mystran
#: Ten parameters of a frame of ten tubes, and what they truly are.
MEMBERS = 10
TEN = {
    **{
        f"E_{m}": ("youngs_modulus", f"material: {m}", value)
        for m, value in zip(range(1, 8), (0.92, 1.06, 1.1, 0.95, 1.04, 0.9, 1.07), strict=True)
    },
    "rho_9": ("density", "material: 9", 1.08),
    "k_mount": ("spring_stiffness", "property: 217", 0.9),
    "m_unit": ("mass", "element: 301", 1.06),
}
TRUTH = np.array([value for _, _, value in TEN.values()])


#: In the axes of the whole model; the unit on its arm and the averaged one among them.
SENSORS = (4, 8, 11, 15, 19, 24, 28, 32, 36, 40, CARRIED, AVERAGED)


def campaign_file(
    folder: Path, deck: str, parameters: dict[str, Any], nodes: tuple[int, ...], n_modes: int
) -> Path:
    """A campaign whose test is MYSTRAN's run of the deck at the true values."""
    folder.mkdir(exist_ok=True)
    (folder / "part.bdf").write_text(deck)
    items, known = "", []
    for name, (quantity, target, _) in parameters.items():
        items += f"  - {{name: {name}, quantity: {quantity}, {target}, bounds: [0.6, 1.6]}}\n"
        by, number = target.split(": ")
        known.append(Parameter(name, quantity, by, (number,), 0.6, 1.6, 0.1))
    (folder / "part.yaml").write_text(
        "name: part\nmodel: {deck: part.bdf, solver: mystran, units: m-kg-s}\n"
        f"test: {{modes: part.csv}}\nparameters:\n{items}"
        "residuals: {frequency_weight: 1.0, shape_weight: 0.1}\n"
        "update:\n  starts: 1\n  step: weighted_least_squares\n"
        "  e1: {frequency: 1.0e-6, mac: 0.99}\n  e2: 0.0\n"
        "  max_iterations: 12\n  step_limit: 0.5\nreport: {page: false}\n"
    )
    solver = mystran_solver(folder / "part.bdf", tuple(known))
    values = {name: value for name, (_, _, value) in parameters.items()}
    (folder / "truth").mkdir()
    result = run(solver, values, ModalAnalysis(n_modes, nodes), folder / "truth")
    assert isinstance(result, ModalResult)
    elastic = result.elastic
    moving = elastic.components <= 3
    modes = replace(
        elastic,
        nodes=elastic.nodes[moving],
        components=elastic.components[moving],
        mode_shapes=elastic.mode_shapes[moving],
    )
    write_modes_csv(folder / "part.csv", range(1, modes.n_modes + 1), modes)
    return folder / "part.yaml"


def update(file: Path, place: Path, watcher: Any, *settings: str) -> CampaignRecord:
    campaign = load_campaign(file, [f"store={place / 'store'}", *settings])
    return update_campaign(campaign, place / "run", watcher).record


@pytest.fixture(scope="module")
def ten_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return campaign_file(tmp_path_factory.mktemp("ten"), frame(MEMBERS), TEN, SENSORS, 12)


def test_ten_parameters_cost_four_matrix_jobs_and_end_where_differences_end(
    ten_file: Path, tmp_path: Path, watcher: Any
) -> None:
    stored = update(ten_file, tmp_path / "stored", watcher)
    own = update(ten_file, tmp_path / "own", watcher, "model.eigensolver=solver")
    assert stored.status == own.status == "converged", (stored.reason, own.reason)
    # The base, tubes of even and of odd number, which share no node, and the mount of two of them.
    assert (stored.runs.sensitivity, stored.runs.modal) == (4, 1)
    assert set(own.iterations[1].sensitivity_methods) == {"finite_difference"}
    assert own.runs.sensitivity >= 2 * len(TEN)
    # e1 lets frequencies be 1e-6 off, moduli twice that, times a condition of some tens.
    np.testing.assert_allclose(stored.updated, TRUTH, rtol=1e-4)
    np.testing.assert_allclose(own.updated, TRUTH, rtol=1e-4)
    assert stored.best.solved_by == "mystran"
    (apart,) = re.findall(r"confirmed by mystran: frequencies within (\S+)", stored.best.decision)
    assert float(apart) < 1e-6  # eigenvalues are printed with seven digits


def test_the_command_line_tells_the_few_runs(ten_file: Path, tmp_path: Path) -> None:
    ended = run_command(
        ten_file.parent,
        *("update", "part.yaml", "--json", "--runs", str(tmp_path / "runs")),
        *("--set", f"store={tmp_path / 'store'}"),
    )
    assert ended.returncode == 0, ended.stderr
    told = json.loads(ended.stdout)
    assert told["solver_runs"]["sensitivity"] == 4
    assert told["solver_runs"]["modal"] == 1
    found = {item["name"]: item["updated"] for item in told["parameters"]}
    assert found == pytest.approx({name: true for name, (_, _, true) in TEN.items()}, rel=1e-4)


def test_a_free_bracket_updates_by_what_one_material_leaves_of_the_whole(
    tmp_path: Path, watcher: Any
) -> None:
    parameters = {
        f"E_{m}": ("youngs_modulus", f"material: {m}", value)
        for m, value in ((1, 0.9), (2, 1.1), (3, 0.95))
    }
    file = campaign_file(tmp_path / "bracket", bracket(3), parameters, (1, 9, 20, 30), 12)
    record = update(file, tmp_path, watcher)
    assert record.status == "converged", record.reason
    # The bricks are all that is stiff: the third material is what the others leave.
    assert (record.runs.sensitivity, record.runs.modal) == (2, 1)
    np.testing.assert_allclose(record.updated, (0.9, 1.1, 0.95), rtol=1e-4)


def test_matrices_that_cannot_be_read_leave_the_campaign_to_mystrans_own_modes(
    tmp_path: Path, watcher: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    # A MYSTRAN that keeps other files than those that are known.
    monkeypatch.setattr("modetune.adapters.nastran.matrices.STIFFNESS", "job.KLL")
    parameters = {"E_1": ("youngs_modulus", "material: 1", 0.9)}
    file = campaign_file(tmp_path / "bracket", bracket(2), parameters, (1, 9, 20), 8)
    record = update(file, tmp_path, watcher)
    assert record.status == "converged", record.reason
    assert record.best.solved_by == "mystran"
    assert "the matrices of the MYSTRAN run" in caplog.text
    np.testing.assert_allclose(record.updated, (0.9,), rtol=1e-4)


@pytest.mark.parametrize(
    ("parts", "jobs"),
    [((1, 3), 7), ((1, 2), None)],  # 13 jobs where the plates meet, and some 12 by differences
)
def test_what_takes_fewer_runs_is_chosen(
    parts: tuple[int, ...], jobs: int | None, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "part.bdf").write_text(plate())
    (tmp_path / "part.csv").write_text("mode,1,2,3\nfrequency_hz,20.,50.,80.\n")
    items = "".join(
        f"  - {{name: t_{part}, quantity: thickness, property: {part}, bounds: [0.6, 1.6]}}\n"
        for part in parts
    )
    (tmp_path / "part.yaml").write_text(
        "name: part\nmodel: {deck: part.bdf, solver: mystran, units: m-kg-s}\n"
        f"test: {{modes: part.csv}}\nparameters:\n{items}"
    )
    campaign = load_campaign(tmp_path / "part.yaml")
    with caplog.at_level("INFO"):
        source = modes_source(campaign, by_solver(campaign, job_engine(campaign)))
    if jobs is None:
        assert source is None
        assert "by the solver's own runs: 13 matrix jobs, about" in caplog.text
    else:
        assert source is not None
        assert len(source.jobs(campaign.start, range(len(parts)))) == jobs
