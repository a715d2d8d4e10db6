"""Dampers found from damping ratios, through the command line, on models that are matrices."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import linalg

from tests.adapters.test_files.universal_text import mode_55, save
from tests.command_line import run_command

MASSES = np.array([2.0, 1.5, 1.0, 1.2])
SPRINGS = np.array([4000.0, 3000.0, 2500.0, 2000.0])
#: Viscous between the ground and m1, structural between m3 and m4; and the second spring.
TRUTH = {"c1": 1.7, "h4": 0.6, "k2": 1.15}
MODEL = """masses: {m1: 2.0, m2: 1.5, m3: 1.0, m4: 1.2}
springs:
  k1: {between: [ground, m1], stiffness: 4000.0}
  k2: {between: [m1, m2], stiffness: 3000.0}
  k3: {between: [m2, m3], stiffness: 2500.0}
  k4: {between: [m3, m4], stiffness: 2000.0}
dampers:
  c1: {between: [ground, m1], viscous: 3.0}
  h4: {between: [m3, m4], structural: 60.0}
"""
CAMPAIGN = """name: damped
model: {deck: chain.yaml, solver: matrices, units: m-kg-s}
test: {modes: measured.csv}
parameters:
  - {name: c1, quantity: viscous_damping, elset: c1, bounds: [0.2, 5.0]}
  - {name: h4, quantity: structural_damping, elset: h4, bounds: [0.2, 5.0]}
  - {name: k2, quantity: spring_stiffness, elset: k2, bounds: [0.5, 2.0]}
residuals:
  damping: {deviation: 0.01, tolerance: 1.0e-4}
update: {e1: {frequency: 1.0e-5}, starts: 1}
"""


def true_modes() -> tuple[Any, Any, Any]:
    """Undamped frequencies, roots and shapes of the truth, by LAPACK on the whole state space."""
    stiffness = SPRINGS * [1.0, TRUTH["k2"], 1.0, 1.0]
    k, c, h = np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((4, 4))
    for place in range(4):
        row = np.eye(4)[place] - (np.eye(4)[place - 1] if place else 0.0)
        k += stiffness[place] * np.outer(row, row)
        if place == 0:
            c += 3.0 * TRUTH["c1"] * np.outer(row, row)
        if place == 3:
            h += 60.0 * TRUTH["h4"] * np.outer(row, row)
    m = np.diag(MASSES)
    hz = np.sqrt(linalg.eigh(k, m, eigvals_only=True)) / (2.0 * np.pi)
    state = np.block(
        [[np.zeros((4, 4)), np.eye(4)], [-linalg.solve(m, k + 1j * h), -linalg.solve(m, c)]]
    )
    roots, vectors = linalg.eig(state)
    order = [place for place in np.argsort(np.abs(roots)) if roots[place].imag > 0.0]
    return hz, roots[order], vectors[:4, order]


def measured() -> str:
    """Frequencies are those of the undamped truth."""
    hz, roots, _ = true_modes()
    ratios = -roots.real / np.abs(roots)
    return "mode, 1, 2, 3, 4\n" + "".join(
        f"{name}, {', '.join(f'{value:.12g}' for value in values)}\n"
        for name, values in (("frequency_hz", hz), ("damping_ratio", ratios))
    )


def files(folder: Path, model: str = MODEL, test: str = "", text: str = CAMPAIGN) -> None:
    (folder / "chain.yaml").write_text(model)
    (folder / "measured.csv").write_text(test or measured())
    (folder / "campaign.yaml").write_text(text)


def test_dampers_and_a_spring_are_found_from_ratios_and_frequencies(tmp_path: Path) -> None:
    files(tmp_path)
    ended = run_command(tmp_path, "update", "campaign.yaml", "--json", "--set", "report.page=false")
    assert ended.returncode == 0, ended.stderr
    told = json.loads(ended.stdout)
    updated = {item["name"]: item["updated"] for item in told["parameters"]}
    # e1 holds ratios to 1e-4 of themselves.
    assert updated == pytest.approx(TRUTH, rel=1e-3)
    (written,) = (tmp_path / told["run_dir"] / "updated").rglob("chain.yaml")
    assert f"viscous: {3.0 * updated['c1']!r}" in written.read_text()


@pytest.mark.parametrize(
    ("model", "test", "said"),
    [
        (MODEL.split("dampers")[0], "", "the model has no `viscous` or `structural` damping"),
        (MODEL, measured().replace("damping_ratio", "# "), "the test has no damping ratios"),
        (MODEL.replace("viscous: 3.0", "vicous: 3.0"), "", "did you mean viscous"),
        (MODEL.replace("viscous: 3.0", "viscous: -3.0"), "", "needs a plain number above zero"),
    ],
)
def test_what_is_missing_is_told(model: str, test: str, said: str, tmp_path: Path) -> None:
    text = CAMPAIGN if "dampers" in model else CAMPAIGN.replace("c1, bounds", "c1, bounds")
    if "dampers" not in model:
        lines = CAMPAIGN.splitlines()
        text = "\n".join(line for line in lines if "_damping" not in line) + "\n"
    files(tmp_path, model, test, text)
    ended = run_command(tmp_path, "update", "campaign.yaml")
    assert ended.returncode == 2
    assert said in " ".join(ended.stderr.split())


def complex_test(folder: Path) -> None:
    """The truth's modes as a test gives them, in any phase and scale."""
    _, roots, shapes = true_modes()
    modes = []
    for mode, root in enumerate(roots):
        values = (complex(2.0, -1.5) * shapes[:, mode]).tolist()
        points = {node: [value, 0.0j, 0.0j] for node, value in enumerate(values, start=1)}
        modes.append(mode_55(mode + 1, complex(root), points))
    save(folder / "measured.unv", *modes)


def test_dampers_are_found_from_complex_shapes_alone(tmp_path: Path) -> None:
    text = CAMPAIGN.replace("measured.csv", "measured.unv").replace(
        "  damping: {deviation: 0.01, tolerance: 1.0e-4}",
        "  frequency_weight: 0\n  complex_shapes: {deviation: 0.001, mac: 0.9999999}",
    )
    files(tmp_path, text=text)
    complex_test(tmp_path)
    ended = run_command(tmp_path, "update", "campaign.yaml", "--json", "--set", "report.page=false")
    assert ended.returncode == 0, ended.stderr
    told = json.loads(ended.stdout)
    updated = {item["name"]: item["updated"] for item in told["parameters"]}
    # e1 leaves an angle of 3e-4 in a shape; imaginary parts are some hundredths of it.
    assert updated == pytest.approx(TRUTH, rel=1e-2)
    assert "real parts" not in " ".join(told["trust"]["sentences"])


def test_it_is_told_that_complex_shapes_are_compared_by_their_real_parts(tmp_path: Path) -> None:
    text = CAMPAIGN.replace("measured.csv", "measured.unv")
    files(tmp_path, text=text.replace("  damping:", "  shape_weight: 1\n  damping:"))
    complex_test(tmp_path)
    ended = run_command(tmp_path, "update", "campaign.yaml", "--json", "--set", "report.page=false")
    said = " ".join(json.loads(ended.stdout)["trust"]["sentences"])
    assert "measured shapes are complex: their real parts are compared" in said
    checked = run_command(tmp_path, "check", "campaign.yaml")
    assert "residuals.complex_shapes" in checked.stdout.replace("\n", "")


def test_complex_shapes_need_a_test_that_has_them(tmp_path: Path) -> None:
    files(tmp_path, text=CAMPAIGN.replace("damping: {deviation: 0.01, tolerance: 1.0e-4}",
                                          "complex_shapes: {}"))  # fmt: skip
    ended = run_command(tmp_path, "check", "campaign.yaml")
    assert ended.returncode == 2
    assert "residuals.complex_shapes: the test's shapes are real" in " ".join(ended.stderr.split())
