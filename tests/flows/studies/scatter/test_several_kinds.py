"""Repeated tests of several kinds at once: frequencies, damping ratios and a weighing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modetune.core.modes import Floats
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.studies.scatter.record import SCATTER
from tests.command_line import run_command

#: Masses, springs and the damper at the ground of a chain; kg, N/m, N s/m.
MASSES, SPRINGS, DAMPER = np.array([2.0, 1.5, 1.0]), np.array([4e3, 3e3, 2.5e3]), 3.0
#: Of all masses, the second spring and the damper: means, and from test to test deviations and
#: correlation of the last two (an oil and a rubber that are warm together).
MEANS, SIZES, TIE = np.array([1.05, 1.1, 1.2]), np.array([0.01, 0.03, 0.08]), -0.6
N_TESTS, NOISE = 400, 2e-4
CAMPAIGN = """name: warm
model: {deck: chain.yaml, solver: matrices, units: m-kg-s}
test: {modes: tests.csv}
parameters:
  - {name: m, quantity: mass, elset: [m1, m2, m3], bounds: [0.8, 1.25]}
  - {name: k2, quantity: spring_stiffness, elset: k2, bounds: [0.7, 1.5]}
  - {name: c, quantity: viscous_damping, elset: c1, bounds: [0.6, 2.0]}
residuals:
  damping: {}
  mass_properties: {mass: {target: 4.725, deviation: 0.03}}
"""


def responses(parameters: Floats) -> Floats:
    """Frequencies, damping ratios and the mass, (7,), by LAPACK on the state space."""
    m, k2, c = parameters
    springs = SPRINGS * [1.0, k2, 1.0]
    k = np.diag(springs + np.append(springs[1:], 0.0))
    k -= np.diag(springs[1:], 1) + np.diag(springs[1:], -1)
    mass = m * MASSES
    hz = np.sqrt(np.linalg.eigvalsh(k / np.sqrt(np.outer(mass, mass)))) / (2.0 * np.pi)
    damping = np.diag([c * DAMPER, 0.0, 0.0]) / mass[:, None]
    state = np.block([[np.zeros((3, 3)), np.eye(3)], [-k / mass[:, None], -damping]])
    roots = sorted((s for s in np.linalg.eigvals(state) if s.imag > 0.0), key=abs)
    return np.array([*hz, *(-s.real / abs(s) for s in roots), m * MASSES.sum()])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("warm")
    ends = ["ground", "m1", "m2", "m3"]
    masses = "".join(f"  m{n}: {mass}\n" for n, mass in enumerate(MASSES, start=1))
    springs = "".join(
        f"  k{n}: {{between: [{ends[n - 1]}, {ends[n]}], stiffness: {value}}}\n"
        for n, value in enumerate(SPRINGS, start=1)
    )
    damper = f"dampers:\n  c1: {{between: [ground, m1], viscous: {DAMPER}}}\n"
    (path / "chain.yaml").write_text(f"masses:\n{masses}springs:\n{springs}{damper}")
    random = np.random.default_rng(5)
    covariance = np.diag(SIZES**2)
    covariance[1, 2] = covariance[2, 1] = TIE * SIZES[1] * SIZES[2]
    sets = random.multivariate_normal(MEANS, covariance, N_TESTS)
    # As the campaign's deviations stand to each other: 0.002, 0.1 of a ratio, 0.03 kg.
    off = NOISE * random.standard_normal((N_TESTS, 7))
    off[:, 3:6] *= 0.1 / 0.002
    off[:, 6] *= 0.03 / 0.002 / (MEANS[0] * MASSES.sum())
    values = (1.0 + off) * [responses(row) for row in sets]
    rows = [[f"{value:.9g}" for value in row] for row in values.tolist()]
    heads = [f"{what}_{n}" for what in ("frequency", "damping") for n in (1, 2, 3)] + ["mass"]
    lines = [",".join(["test", *heads]), *(",".join([str(n), *r]) for n, r in enumerate(rows, 1))]
    (path / "tests.csv").write_text("\n".join(lines) + "\n")
    (path / "warm.yaml").write_text(CAMPAIGN)
    return path


def test_damping_and_weighings_tell_what_frequencies_cannot(folder: Path) -> None:
    ended = run_command(
        folder, "scatter", "warm.yaml", "--json", "--no-prefect", "--page", "w.html"
    )
    assert ended.returncode in (0, 3), ended.stderr
    found = json.loads(ended.stdout)
    assert found["measured"][3:] == [*(f"damping of mode {n}" for n in (1, 2, 3)), "mass"]
    assert found["answers"][0]["noise"] == pytest.approx(NOISE, rel=0.1)
    covariance = np.array(found["answers"][0]["covariance"])
    # 400 tests know a deviation to 1/sqrt(800) of itself, 3.5 %, and three of them are 11 %.
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), SIZES, rtol=0.11)
    assert covariance[1, 2] / np.sqrt(covariance[1, 1] * covariance[2, 2]) == pytest.approx(
        TIE, abs=0.1
    )
    rows = {item["name"]: item["mean"] for item in found["answers"][0]["parameters"]}
    # Three standard errors of the means of 400 tests.
    np.testing.assert_allclose(list(rows.values()), MEANS, atol=3.0 * SIZES.max() / 20.0)
    record = SCATTER.read(folder / "runs" / "warm" / "scatter.h5")
    assert record.covariance.shape == (7, 7)
    assert np.abs(record.covariance[:3, 3:]).max() > 0.0
    page = (folder / "w.html").read_text()
    assert "400 tests of 3 frequencies and 4 other values" in page


def test_an_answer_that_breaks_a_limit_is_left_out(folder: Path) -> None:
    limit = "residuals.mass_properties.mass.limits=[4.6, 4.7]"
    target = "residuals.mass_properties.mass.target=4.69"
    ended = run_command(
        folder, "scatter", "warm.yaml", "--set", limit, "--set", target, "--no-prefect"
    )
    said = " ".join(ended.stderr.split())
    assert ended.returncode == 2, said
    assert "is left out, because it violates a limit (mass)" in said
    assert "every solution violates the limits" in said


def test_an_update_weighs_ratios_by_what_they_have_in_common(folder: Path) -> None:
    def noise(*settings: str) -> Any:
        case = load_campaign(folder / "warm.yaml", list(settings)).case
        return next(item.covariance for item in case.compared if item.kind == "damping")  # type: ignore[attr-defined]

    own = noise()
    assert own.shape == (3, 3)
    # One damper makes all ratios: their errors are almost one.
    assert own[0, 1] / np.sqrt(own[0, 0] * own[1, 1]) > 0.8
    assert noise("residuals.damping.deviation=0.05").size == 0


def test_a_column_that_is_not_compared_is_refused(folder: Path) -> None:
    ended = run_command(
        folder, "scatter", "warm.yaml", "--set", "residuals.mass_properties=null", "--no-prefect"
    )
    assert ended.returncode == 2
    said = " ".join(ended.stderr.split())
    assert "tests.csv, line 2: the tests have a column `mass`" in said
    assert "name it under `residuals`, or leave the column out" in said


def test_a_value_that_is_no_number_is_told_with_its_line(folder: Path, tmp_path: Path) -> None:
    for name in ("chain.yaml", "warm.yaml", "tests.csv"):
        (tmp_path / name).write_text((folder / name).read_text())
    table = (tmp_path / "tests.csv").read_text().splitlines()
    table[3] = ",".join([*table[3].split(",")[:-1], "heavy"])
    (tmp_path / "tests.csv").write_text("\n".join(table))
    ended = run_command(tmp_path, "scatter", "warm.yaml", "--no-prefect")
    assert ended.returncode == 2
    assert "tests.csv, line 4: `mass` has 'heavy', not a number" in " ".join(ended.stderr.split())
