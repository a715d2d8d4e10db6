"""`modetune compare`: models of matrices of one test, and a frame with a device by MYSTRAN."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import eigh

import modetune
from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.core.errors import CampaignError
from modetune.core.modes import mode_set
from modetune.flows.studies.compare.competing_models import ModelChoice
from tests.command_line import run_command
from tests.flows.studies.test_localise import frame, frame_deck, needs_mystran

__all__ = ["frame"]  # a fixture

SPRINGS = {"k1": 900.0, "k2": 1000.0, "k3": 1100.0, "k4": 1050.0, "k5": 950.0, "k6": 1000.0}
MASSES = (1.0, 1.1, 0.9, 1.05, 1.2)
SENSORS = (1, 2, 4)
FREQUENCY, SHAPE = 0.002, 0.02


def chain_modes(springs: dict[str, float]) -> tuple[Any, Any]:
    k = np.array(list(springs.values()))
    stiffness = np.diag(k[:-1] + k[1:]) - np.diag(k[1:-1], 1) - np.diag(k[1:-1], -1)
    lam, shapes = eigh(stiffness, np.diag(MASSES))
    return np.sqrt(lam) / (2.0 * np.pi), shapes


def write_test(folder: Path, changed: dict[str, float], seed: int = 0, n_modes: int = 4) -> None:
    """A test of the chain with other springs: modes with noise of the stated deviations."""
    hz, shapes = chain_modes({**SPRINGS, **changed})
    rng = np.random.default_rng(seed)
    rows = shapes[[node - 1 for node in SENSORS], :n_modes]
    rows = rows + SHAPE * np.sqrt(np.mean(rows**2, axis=0)) * rng.standard_normal(rows.shape)
    hz = hz[:n_modes] * (1.0 + FREQUENCY * rng.standard_normal(n_modes))
    measured = mode_set(hz, rows, SENSORS, [1] * len(SENSORS))
    write_modes_csv(folder / "measured.csv", range(1, n_modes + 1), measured)


def write_model(folder: Path, name: str, *parameters: str, bounds: str = "[0.5, 2.0]") -> Path:
    """A campaign of the chain with these springs as parameters."""
    lines = [f"masses: {{{', '.join(f'm{n}: {m}' for n, m in enumerate(MASSES, 1))}}}", "springs:"]
    ends = ["ground", *(f"m{n}" for n in range(1, len(MASSES) + 1)), "ground"]
    for place, (spring, k) in enumerate(SPRINGS.items()):
        lines.append(f"  {spring}: {{between: [{ends[place]}, {ends[place + 1]}], stiffness: {k}}}")
    (folder / "chain.yaml").write_text("\n".join([*lines, ""]))
    listed = "\n".join(
        f"  - {{name: {p}, quantity: spring_stiffness, elset: {p}, bounds: {bounds}}}"
        for p in parameters
    )
    file = folder / f"{name}.yaml"
    file.write_text(
        f"name: {name}\nmodel: {{deck: chain.yaml, solver: matrices, units: m-kg-s}}\n"
        f"test: {{modes: measured.csv}}\nparameters:\n{listed}\n"
        f"residuals: {{frequency_deviation: {FREQUENCY}, shape_deviation: {SHAPE}}}\n"
    )
    return file


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def compared(folder: Path, *files: Path) -> ModelChoice:
    found: ModelChoice = modetune.compare(list(files), folder / "runs")
    return found


def test_the_model_whose_spring_was_changed_is_chosen_and_its_evidence_is_the_integral(
    folder: Path,
) -> None:
    write_test(folder, {"k3": 1300.0})
    found = compared(folder, write_model(folder, "k5", "k5"), write_model(folder, "k3", "k3"))
    best = found.models[0]
    assert found.decided
    assert best.name == "k3"
    assert best.probability > 0.99
    # The integral of the likelihood over the logarithm of k3, by hand on the chain's own modes.
    campaign = modetune.load(folder / "k3.yaml")
    test = campaign.test.modes

    def chi_square(log_k3: float) -> float:
        hz, shapes = chain_modes({**SPRINGS, "k3": 1100.0 * np.exp(log_k3)})
        rows = shapes[[node - 1 for node in SENSORS], :4]
        cosines = np.sum(rows * test.mode_shapes, axis=0) ** 2 / (
            np.sum(rows**2, axis=0) * np.sum(test.mode_shapes**2, axis=0)
        )
        errors = (hz[:4] - test.frequencies_hz) / test.frequencies_hz / FREQUENCY
        return float(np.sum(errors**2) + np.sum(len(SENSORS) * (1.0 - cosines)) / SHAPE**2)

    points = np.linspace(np.log(0.5), np.log(2.0), 20_001)
    values = np.array([chi_square(x) for x in points])
    integral = np.log(np.mean(np.exp(-0.5 * (values - values.min()) / found.scale)))
    expected = -0.5 * values.min() / found.scale + integral
    # Laplace's approximation: chi-square is a parabola within a few standard errors of 0.3 %.
    assert best.log_evidence == pytest.approx(expected, abs=0.05)
    assert best.chi_square == pytest.approx(values.min(), rel=0.01)
    assert best.freedom == 4 + 4 * (len(SENSORS) - 1) - 1


def test_a_parameter_that_the_test_does_not_need_costs_its_occam_factor(folder: Path) -> None:
    write_test(folder, {"k3": 1300.0})
    few, many = write_model(folder, "few", "k3"), write_model(folder, "many", "k3", "k5")
    found = compared(folder, many, few)
    assert found.models[0].name == "few"
    assert found.models[1].chi_square < found.models[0].chi_square
    # Wider bounds make the same parameter more expensive, by the logarithm of the widths' ratio.
    wide = write_model(folder, "wide", "k3", bounds="[0.125, 8.0]")
    again = compared(folder, few, wide)
    by_name = {item.name: item for item in again.models}
    cost = by_name["few"].log_evidence - by_name["wide"].log_evidence
    assert cost == pytest.approx(np.log(3.0), abs=0.01)


def test_models_that_fit_alike_are_undecided_and_the_next_measurement_tells_them_apart(
    folder: Path,
) -> None:
    write_test(folder, {"k2": 1020.0}, n_modes=3)
    found = compared(folder, write_model(folder, "k2", "k2"), write_model(folder, "k3", "k3"))
    assert not found.decided
    assert found.status == "undecided"
    assert found.sentence.startswith("undecided: ")
    assert found.further
    values = [item.deviations for item in found.further]
    assert values == sorted(values, reverse=True)
    # The fourth mode is below 1.5 times the third: what the two models say of it, in deviations.
    mode = next(item for item in found.further if item.unit == "Hz")
    ends = {item.name: item.updated[0] for item in found.models}
    predicted = [
        chain_modes({**SPRINGS, item.name: SPRINGS[item.name] * ends[item.name]})[0][3]
        for item in found.models
    ]
    assert [mode.best, mode.second] == pytest.approx(predicted, rel=1e-6)
    apart = abs(predicted[0] - predicted[1]) / np.mean(predicted) / FREQUENCY
    assert mode.deviations == pytest.approx(apart, rel=1e-6)
    assert any(item.what.startswith(("sensor at 3.x", "sensor at 5.x")) for item in found.further)


def test_a_second_comparison_runs_nothing(folder: Path) -> None:
    write_test(folder, {"k3": 1300.0})
    files = [write_model(folder, "one", "k3"), write_model(folder, "two", "k5")]
    first, second = compared(folder, *files), compared(folder, *files)
    assert [item.new for item in first.models] == [True, True]
    assert [item.new for item in second.models] == [False, False]
    assert second.models[0].log_evidence == pytest.approx(first.models[0].log_evidence)


def test_what_distinguishes_the_models_adds_up_to_their_chi_squares(folder: Path) -> None:
    write_test(folder, {"k3": 1300.0})
    found = compared(folder, write_model(folder, "k5", "k5"), write_model(folder, "k3", "k3"))
    best, second = found.models
    assert sum(item.best for item in found.modes) == pytest.approx(best.chi_square)
    assert sum(item.second for item in found.modes) == pytest.approx(second.chi_square)
    sizes = [abs(item.difference) for item in found.modes]
    assert sizes == sorted(sizes, reverse=True)
    assert {item.of for item in found.sensors} == {f"sensor {node}.x" for node in SENSORS}
    shapes = sum(item.best for item in found.modes if item.of.startswith("shape"))
    assert sum(item.best for item in found.sensors) == pytest.approx(shapes, rel=1e-3)


def test_campaigns_that_cannot_be_compared_are_refused_in_one_sentence(folder: Path) -> None:
    write_test(folder, {"k3": 1300.0})
    one, two = write_model(folder, "one", "k3"), write_model(folder, "two", "k5")
    with pytest.raises(CampaignError, match="two campaigns or more"):
        compared(folder, one)
    two.write_text(two.read_text().replace("name: two", "name: one"))
    with pytest.raises(CampaignError, match="would share a run folder"):
        compared(folder, one, two)
    two = write_model(folder, "two", "k5")
    shutil.copyfile(folder / "measured.csv", folder / "same.csv")
    two.write_text(two.read_text().replace("measured.csv", "same.csv"))
    assert compared(folder, one, two).decided  # by content, whatever the name of the file
    write_test(folder, {"k3": 1301.0}, seed=1)
    with pytest.raises(CampaignError, match="have different test frequencies"):
        compared(folder, one, two)
    two = write_model(folder, "two", "k5")
    two.write_text(two.read_text().replace("shape_deviation: 0.02", "shape_deviation: 0.05"))
    with pytest.raises(CampaignError, match="measurement deviations under `residuals`"):
        compared(folder, one, two)


def test_the_command_tells_machines_and_people(folder: Path) -> None:
    write_test(folder, {"k3": 1300.0})
    write_model(folder, "k3", "k3")
    write_model(folder, "k5", "k5")
    words = ("compare", "k5.yaml", "k3.yaml", "--no-prefect")
    home = {"MODETUNE_HOME": str(folder / "home")}
    shown = run_command(folder, *words, **home)
    assert shown.returncode == 0, shown.stderr
    assert "k3 explains the test best" in shown.stdout
    told = json.loads(run_command(folder, *words, "--json", **home).stdout)
    assert told["status"] == "decided"
    assert [item["name"] for item in told["models"]] == ["k3", "k5"]
    assert told["models"][0]["updated_now"] is False
    assert sum(item["probability"] for item in told["models"]) == pytest.approx(1.0)
    (folder / "k5.yaml").write_text((folder / "k5.yaml").read_text().replace("0.002", "0.004"))
    refused = run_command(folder, *words, **home)
    assert refused.returncode == 2
    assert "only models of one test can be compared" in refused.stderr
    assert "Traceback" not in refused.stderr


@needs_mystran
def test_a_device_on_a_mount_is_told_from_one_on_a_rigid_link_by_mystran(frame: Path) -> None:
    folder = frame.parent
    (folder / "mount.bdf").write_text(frame_deck(mounted=True))
    text = frame.read_text().replace("frame.bdf", "mount.bdf").replace("name: frame", "name: mount")
    (folder / "mount.yaml").write_text(text)
    found = compared(folder, frame, folder / "mount.yaml")
    best, second = found.models
    assert found.decided
    assert (best.name, second.name) == ("mount", "frame")
    # The rigid link leaves frequencies 2 % off, ten deviations; the mount is the truth.
    assert second.chi_square > best.chi_square + 100.0
    assert best.chi_square < best.freedom
    assert found.modes[0].of.startswith("frequency of mode")
    assert found.modes[0].difference > 0.0
