"""Other starts that nobody asked for, on models of matrices: second answers are found and told."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares

import modetune
from modetune.core.modes import Floats
from modetune.core.updating.trust import trust_sentences

#: Nominal storey stiffness, N/m, and mass of a storey, kg, of the frame in the shared data.
STIFFNESS, MASS = 9106.39, 0.1122
#: Means of its fifty tests, Hz.
MEASURED = (15.538615, 44.619224, 70.531457, 87.090770)


def frequencies(theta: Floats) -> Floats:
    """Of four storeys from the ground up, Hz, (4,)."""
    k = STIFFNESS * np.append(theta, 0.0)
    stiffness = np.diag(k[:-1] + k[1:]) - np.diag(k[1:-1], 1) - np.diag(k[1:-1], -1)
    return np.asarray(np.sqrt(np.linalg.eigvalsh(stiffness / MASS)) / (2.0 * np.pi))


def answer(near: list[float]) -> Floats:
    """The storeys with exactly these frequencies, by SciPy."""

    def errors(theta: Floats) -> Floats:
        return frequencies(theta) / MEASURED - 1.0

    found = least_squares(errors, near, xtol=1e-15, ftol=1e-15)
    assert found.cost < 1e-20
    return np.asarray(found.x)


@pytest.fixture
def frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., modetune.Campaign]:
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))

    def load(hz: Any = MEASURED, initial: Any = (1.0,) * 4, **update: Any) -> modetune.Campaign:
        parts, n = {}, 4
        for place in range(n):
            ends = np.zeros(n)
            ends[place] = 1.0
            ends[place - 1] -= float(place > 0)
            parts[f"k{place + 1}"] = {"stiffness": STIFFNESS * np.outer(ends, ends)}
        stiffness = sum((part["stiffness"] for part in parts.values()), np.zeros((n, n)))
        return modetune.load(
            {
                "name": "frame",
                "model": {"stiffness": stiffness, "mass": MASS * np.eye(n), "parts": parts},
                "test": {"frequencies_hz": np.array(hz)},
                "parameters": [
                    {"name": name, "quantity": "matrix_factor", "part": name, "initial": float(at)}
                    for name, at in zip(parts, initial, strict=True)
                ],
                "update": update,
                "report": {"page": False},
                "run": {"parallel": 1},
                "store": str(tmp_path / "store"),
            },
            folder=tmp_path / "campaign",
        )

    return load


def test_both_answers_of_four_storeys_are_found_and_neither_is_trusted(
    frame: Callable[..., modetune.Campaign], tmp_path: Path
) -> None:
    run = modetune.update(frame(), tmp_path / "runs")
    first, second = answer([0.9, 1.15, 1.05, 1.05]), answer([1.9, 0.6, 1.45, 0.65])
    record = run.record
    assert record.status == "converged"
    np.testing.assert_allclose(record.updated, first, atol=2e-4)
    assert record.trust is not None
    assert record.trust.freedom == 0
    assert record.trust.verdict == "not to be trusted"
    spread = record.trust.spread
    assert spread is not None
    (rival,) = spread.rivals
    there = spread.updated[spread.minima == rival]
    np.testing.assert_allclose(there, np.tile(second, (len(there), 1)), atol=2e-4)
    told = run.summary["trust"]
    shown = f"Other values fit as well: k1 {second[0]:.3g}"
    assert any(said.startswith(shown) for said in told["sentences"])
    assert told["degrees_of_freedom"] == 0
    assert told["starts"]["fit_as_well"] == [rival]
    # Other starts took no run of the solver, but for the look at the second answer.
    assert record.runs.modal <= record.iterations[-1].number + 4


def test_one_start_is_one_start_and_not_trusted_by_itself(
    frame: Callable[..., modetune.Campaign], tmp_path: Path
) -> None:
    record = modetune.update(frame(starts=1), tmp_path / "runs").record
    assert record.trust is not None
    assert record.trust.spread is None
    assert record.trust.verdict == "not to be trusted"
    assert "no degree of freedom is left" in trust_sentences(record.trust)[0]


def test_a_start_that_fits_better_becomes_the_answer(
    frame: Callable[..., modetune.Campaign], tmp_path: Path
) -> None:
    # From here least squares ends at (1.05, 0.84, 0.76, 1.5), with errors of up to 5 %.
    run = modetune.update(frame(initial=(0.72, 0.99, 1.26, 1.68)), tmp_path / "runs")
    record = run.record
    assert record.status == "converged"
    exact = [answer([0.9, 1.15, 1.05, 1.05]), answer([1.9, 0.6, 1.45, 0.65])]
    assert min(np.abs(record.updated - each).max() for each in exact) < 2e-4
    assert "another start fits better" in [item.decision for item in record.iterations]
    assert "the best of" in record.reason
    assert [item.number for item in record.iterations] == list(range(len(record.iterations)))


def test_the_means_of_the_shared_tests_are_those_used_here(shared_data: Path) -> None:
    with (shared_data / "four_storey" / "tests_br.csv").open() as file:
        rows = [list(map(float, row[1:5])) for row in list(csv.reader(file))[1:]]
    np.testing.assert_allclose(np.mean(rows, axis=0), MEASURED, rtol=1e-5)


def test_where_sets_cost_little_updating_goes_on_to_the_least_misfit(
    frame: Callable[..., modetune.Campaign], tmp_path: Path
) -> None:
    # All within 1 % at first, so e1 holds from the beginning.
    truth = np.array([1.01, 0.995, 1.005, 0.99])
    run = modetune.update(frame(frequencies(truth)), tmp_path / "runs")
    assert run.record.iterations[0].worst_error < 0.01
    np.testing.assert_allclose(run.record.updated, truth, atol=2e-4)
    assert run.summary["ended_at"] == "least misfit"
