"""From a deck and what a lab sent to an updated model, in one command."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import modetune
from modetune.adapters.test_files.measurements import write_test
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import MeasuredFrfs, Measurement, TestGeometry
from modetune.core.modes import MeasuredModes, mode_set
from modetune.core.updating.verdict import TrustVerdict
from modetune.flows.campaign.sketch import open_model
from tests.adapters.solved import needs_ccx
from tests.command_line import run_command
from tests.flows.studies.test_init import bracket

pytestmark = needs_ccx

#: What the true web's modulus is of the deck's, and the modes that are measured.
WEB, MODES = 0.92, 6


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Measurement:
    """Modes of the true bracket at a third of its nodes, with the places of these."""
    folder = tmp_path_factory.mktemp("truth")
    deck = folder / "truth.inp"
    deck.write_text(bracket().replace("71000000000.0", f"{WEB * 7.1e10:.0f}"))
    assert f"{WEB * 7.1e10:.0f}" in deck.read_text()
    found = modetune.modes(str(deck), number=12).elastic
    mesh = open_model(deck).case.solver.deck.mesh()
    seen = np.isin(found.nodes, np.arange(1, 36, 3)) & (found.components <= 3)
    modes = found.rows(np.flatnonzero(seen)).select(np.arange(MODES))
    points = np.unique(modes.nodes)
    places = mesh.coordinates[mesh.rows(points)]
    frames = np.tile(np.eye(3), (points.size, 1, 1))
    numbers = tuple(range(1, MODES + 1))
    return Measurement(MeasuredModes(numbers, modes), TestGeometry(points, places, frames))


def accelerances(truth: Measurement, damping: float) -> Measurement:
    """Accelerances of all sensors for a force at the first one, by the elastic modes."""
    assert truth.modes is not None
    modes = truth.modes.modes
    hz, shapes = modes.frequencies_hz, modes.mode_shapes
    lines = np.arange(0.7 * hz[0], 1.15 * hz[-1], 0.002 * hz[0])
    omega, poles = 2.0 * np.pi * lines[:, None], 2.0 * np.pi * hz[None, :]
    gains = 1.0 / (poles**2 - omega**2 + 2j * damping * omega * poles)
    values = -(omega**2) * ((gains * shapes[0]) @ shapes.T)
    n, ones = modes.n_dof, np.ones(modes.n_dof)
    at = np.full(n, modes.nodes[0]), np.full(n, modes.components[0])
    frfs = MeasuredFrfs(
        "accelerance", lines, values, modes.nodes, modes.components, ones, *at, ones,
        np.zeros((0, 0)),
    )  # fmt: skip
    return Measurement(None, truth.geometry, frfs)


def test_response_functions_and_a_deck_are_enough(tmp_path: Path, truth: Measurement) -> None:
    (tmp_path / "bracket.inp").write_text(bracket())
    write_test(tmp_path / "lab.unv", accelerances(truth, 0.005))
    ended = run_command(tmp_path, "go", "bracket.inp", "lab.unv", "--json")
    assert ended.returncode == 0, ended.stderr + ended.stdout
    told = json.loads(ended.stdout)
    guesses = " ".join(told["guesses"])
    for key in ("model.units", "test.use", "test.sensors", "parameters", "residuals"):
        assert f"`{key}`" in guesses
    found = {item["name"]: item["updated"] for item in told["update"]["parameters"]}
    assert found["E_ALU"] == pytest.approx(WEB, abs=0.01)
    assert (tmp_path / "runs" / "bracket" / "report.html").is_file()
    again = run_command(tmp_path, "go", "bracket.inp", "--json")  # the campaign is there
    assert json.loads(again.stdout)["guesses"] == []
    assert json.loads(again.stdout)["update"]["solver_runs"]["modal"] == 0


def test_python_gets_the_run_or_the_reason(tmp_path: Path, truth: Measurement) -> None:
    deck = tmp_path / "bracket.inp"
    deck.write_text(bracket())
    write_test(tmp_path / "modes.h5", truth)
    run = modetune.go(deck, tmp_path / "modes.h5", runs=tmp_path / "runs")
    assert run.record.verdict is not TrustVerdict.NOT_TRUSTED
    with pytest.raises(CampaignError, match="name the test too"):
        modetune.go(deck, out=tmp_path / "other.yaml")


def test_unknown_units_stop_it_and_leave_no_guess_behind(
    tmp_path: Path, truth: Measurement
) -> None:
    text = bracket()
    for density in ("7850.0", "2710.0", "1140.0"):
        text = text.replace(f"\n{density}\n", "\n77.7\n")
    (tmp_path / "bracket.inp").write_text(text)
    write_test(tmp_path / "lab.unv", accelerances(truth, 0.005))
    ended = run_command(tmp_path, "go", "bracket.inp", "lab.unv")
    assert ended.returncode == 2
    assert "the units of bracket.inp are unknown" in ended.stdout
    assert "repeat the command with --units" in ended.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bracket.inp", "lab.unv"]


def test_a_test_of_another_structure_is_refused_with_the_finding(
    tmp_path: Path, truth: Measurement
) -> None:
    assert truth.modes is not None
    modes = truth.modes.modes
    noise = np.random.default_rng(1).standard_normal(modes.mode_shapes.shape)
    other = mode_set(20.0 * modes.frequencies_hz, noise, modes.nodes, modes.components)
    (tmp_path / "bracket.inp").write_text(bracket())
    write_test(tmp_path / "modes.h5", Measurement(MeasuredModes(truth.modes.numbers, other)))
    ended = run_command(tmp_path, "go", "bracket.inp", "modes.h5", "--json")
    told = json.loads(ended.stdout)
    assert (ended.returncode, told["status"], told["update"]) == (2, "stopped", None)
    assert told["reason"].startswith("the pre-check found ")
    assert "wrong" in {item["level"] for item in told["findings"]}
    assert not (tmp_path / "runs").exists()
