"""The solver that the documentation takes apart, run as it stands there."""

from __future__ import annotations

import importlib.util
import json
import re
import sys
import threading
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from modetune.adapters.process import run_process
from modetune.adapters.solver import ModalAnalysis, Solver
from modetune.core.errors import CampaignError, ModelError, NoResult, SolverCrashed, SolverRejected
from modetune.core.parameters import Parameter
from modetune.core.storage.keys import canonical_json
from modetune.core.updating.job_results import ModalResult
from modetune.flows.campaign import solvers
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.updating.forecast import Unwatched
from modetune.flows.updating.update import update_campaign

EXAMPLES = Path(__file__).resolve().parent.parent / "docs" / "examples"
#: Steel, N, mm, t: 2 x 250 mm in two materials of the same numbers.
E, RHO, LENGTH, ELEMENTS = 210_000.0, 7.85e-9, 500.0, 40
DECK = f"""material ROOT {E} {RHO}
material TIP  {E} {RHO}
rod ROOT 250. {ELEMENTS // 2} 100.
rod TIP  250. {ELEMENTS // 2} 100.
"""
PARAMETERS = tuple(
    Parameter(f"E_{name}", "youngs_modulus", "material", (name,), 0.5, 2.0, 0.2)
    for name in ("ROOT", "TIP")
)


@pytest.fixture(scope="module")
def example() -> ModuleType:
    found = importlib.util.spec_from_file_location("rod_solver", EXAMPLES / "rod_solver.py")
    assert found is not None
    assert found.loader is not None
    module = importlib.util.module_from_spec(found)
    sys.modules["rod_solver"] = module
    found.loader.exec_module(module)
    return module


@pytest.fixture
def solver(example: ModuleType, tmp_path: Path) -> Solver:
    (tmp_path / "bar.rod").write_text(DECK)
    made: Solver = example.rod_solver(tmp_path / "bar.rod", PARAMETERS)
    return made


def solved(solver: Solver, folder: Path, **at: float) -> Any:
    folder.mkdir()
    analysis = ModalAnalysis(3, (1, 41))
    solver.render(at, analysis).write(folder)
    finished = run_process(solver.program.command(1), folder, 60.0, threading.Event())
    return solver.read(at, analysis, folder, finished.return_code)


def test_the_modes_of_a_rod_are_those_of_theory(solver: Solver, tmp_path: Path) -> None:
    result = solved(solver, tmp_path / "job")
    assert isinstance(result, ModalResult)
    # (2 j - 1) c / 4 L with c = sqrt(E / rho); 40 linear elements are about 1e-4 j^2 stiff.
    exact = np.array([1.0, 3.0, 5.0]) * (E / RHO) ** 0.5 / (4.0 * LENGTH)
    np.testing.assert_allclose(result.modes.frequencies_hz, exact, rtol=2e-3)
    assert result.mass == pytest.approx(RHO * LENGTH * 100.0)
    assert result.n_rigid == 0
    # The tip of a clamped rod moves by sqrt(2 / m) in each mass-normalised mode.
    tip = np.abs(result.modes.mode_shapes[result.modes.nodes == 41])
    np.testing.assert_allclose(tip, (2.0 / result.mass) ** 0.5, rtol=1e-2)
    assert (result.modes.mode_shapes[result.modes.nodes == 1] == 0.0).all()


def test_twice_the_modulus_raises_frequencies_by_its_root(solver: Solver, tmp_path: Path) -> None:
    before = solved(solver, tmp_path / "before")
    after = solved(solver, tmp_path / "after", E_ROOT=2.0, E_TIP=2.0)
    np.testing.assert_allclose(after.eigenvalues, 2.0 * before.eigenvalues, rtol=1e-9)


def test_an_updated_deck_has_the_job_s_modes_and_its_other_lines(
    example: ModuleType, solver: Solver, tmp_path: Path
) -> None:
    updated = solver.deck.write_updated({"E_TIP": 1.25}, tmp_path / "updated")
    lines = updated.read_text().splitlines()
    assert lines[0] == DECK.splitlines()[0]
    assert lines[1].split() == ["material", "TIP", str(1.25 * E), str(RHO)]
    job = solved(solver, tmp_path / "job", E_TIP=1.25)
    again = solved(example.rod_solver(updated, PARAMETERS), tmp_path / "again")
    np.testing.assert_array_equal(again.eigenvalues, job.eigenvalues)


def test_content_sees_numbers_and_neither_paths_nor_blanks(
    example: ModuleType, solver: Solver, tmp_path: Path
) -> None:
    def content(of: Solver, **at: float) -> str:
        return canonical_json(of.render(at, ModalAnalysis(3, (1,))).content)

    (tmp_path / "other.rod").write_text(DECK.replace("TIP  ", "TIP "))
    assert content(example.rod_solver(tmp_path / "other.rod", PARAMETERS)) == content(solver)
    assert content(solver, E_TIP=1.1) != content(solver)


def test_its_mesh_has_every_node_where_it_lies(solver: Solver) -> None:
    mesh = solver.deck.mesh()
    assert set(mesh.nodes.tolist()) == solver.deck.summary.node_ids
    np.testing.assert_allclose(mesh.coordinates[-1], [LENGTH, 0.0, 0.0])
    assert mesh.cells[0].nodes.shape == (ELEMENTS, 2)


def test_a_refused_deck_a_broken_run_and_a_cut_result_are_told_apart(
    example: ModuleType, solver: Solver, tmp_path: Path
) -> None:
    (tmp_path / "wrong.rod").write_text(DECK.replace("rod TIP", "rod TOP"))
    with pytest.raises(SolverRejected, match="FATAL line 4: rod TOP"):
        solved(example.rod_solver(tmp_path / "wrong.rod", PARAMETERS), tmp_path / "refused")
    solved(solver, tmp_path / "job")
    told = json.loads((tmp_path / "job" / "job.modes").read_text())
    (tmp_path / "job" / "job.modes").write_text(json.dumps(told)[:-9])
    with pytest.raises(NoResult, match=r"job\.modes is missing, cut or damaged"):
        solver.read({}, ModalAnalysis(3, (1, 41)), tmp_path / "job", 0)
    (tmp_path / "job" / "solver.log").write_text("reading\n")
    with pytest.raises(SolverCrashed, match="broke off"):
        solver.read({}, ModalAnalysis(3, (1, 41)), tmp_path / "job", 0)


def test_what_a_rod_lacks_is_told_before_it_runs(example: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "bar.rod").write_text(DECK)
    asked = (
        Parameter("t", "thickness", "elset", ("ROOT",), 0.5, 2.0, 0.2),
        Parameter("E_1", "youngs_modulus", "material", ("TIP",), 0.5, 2.0, 0.2),
        Parameter("E_2", "youngs_modulus", "material", ("TIP",), 0.5, 2.0, 0.2),
        Parameter("E_3", "youngs_modulus", "material", ("TOP",), 0.5, 2.0, 0.2),
    )
    told = "\n".join(example.rod_solver(tmp_path / "bar.rod", asked).deck.problems(asked))
    assert "a rod has no thickness" in told
    assert "bar.rod has no TOP" in told
    assert "line 2: both E_1 and E_2 change this number" in told
    with pytest.raises(ModelError, match="cannot be read"):
        example.rod_solver(tmp_path / "missing.rod", asked)


CAMPAIGN = """name: rod
model: {deck: bar.rod, solver: matrices, units: mm-t-s}
test: {modes: measured.csv}
parameters:
  - {name: E_ROOT, quantity: youngs_modulus, material: ROOT}
  - {name: E_TIP, quantity: youngs_modulus, material: TIP}
update: {step: weighted_least_squares, e1: {frequency: 1.0e-6}, e2: 0.0}
"""


def test_a_campaign_finds_two_moduli_with_it(
    example: ModuleType, solver: Solver, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Bound to a name that the campaign file knows, as a new one would be in flows/campaign/solvers.
    monkeypatch.setitem(
        solvers.SOLVERS, "matrices", lambda model, deck, given: example.rod_solver(deck, given)
    )
    truth = {"E_ROOT": 1.2, "E_TIP": 0.85}
    test = solved(solver, tmp_path / "truth", **truth).modes.frequencies_hz
    rows = ("mode,1,2,3", "frequency_hz," + ",".join(f"{value:.12g}" for value in test))
    (tmp_path / "measured.csv").write_text("\n".join(rows) + "\n")
    (tmp_path / "campaign.yaml").write_text(CAMPAIGN)
    run = update_campaign(load_campaign(tmp_path / "campaign.yaml"), tmp_path / "run", Unwatched())
    assert run.record.status == "converged", run.record.reason
    assert run.record.iterations[-1].parameters == pytest.approx(list(truth.values()), rel=1e-4)
    assert (tmp_path / "run" / "updated" / "bar.rod").is_file()
    wrong = CAMPAIGN.replace("material: TIP", "material: TOP")
    (tmp_path / "campaign.yaml").write_text(wrong)
    with pytest.raises(CampaignError, match=re.escape("line 6: parameter E_TIP: ")):
        load_campaign(tmp_path / "campaign.yaml")
