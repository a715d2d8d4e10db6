"""Growth: exponents, and a chain whose update finds its hidden springs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benchmarks.growth import CASES, chain, exponent, lines

import modetune


def test_the_exponent_is_that_of_the_two_largest_sizes() -> None:
    found = [{"size": n, "wall_s": t} for n, t in ((10.0, 5.0), (100.0, 6.0), (1000.0, 60.0))]
    assert exponent(found, "wall_s") == pytest.approx(1.0)


def test_a_case_is_a_row_a_size_and_its_exponents() -> None:
    row = {"wall_s": 2.0, "cpu_s": 1.0, "solver_s": 0.0, "peak_bytes": 1e9}
    told = [*lines(CASES[0], [{"size": 10.0, **row}, {"size": 100.0, **row}])]
    assert len(told) == 3
    assert "CPU 0.00, memory 0.00" in told[-1]
    assert len({case.name for case in CASES}) == len(CASES)


def test_the_chains_springs_are_found(tmp_path: Path) -> None:
    run = modetune.update(
        chain(4, tmp_path), tmp_path / "runs", settings={"store": str(tmp_path / "store")}
    )
    assert run.record.status == "converged"
    # The truth is drawn as `chain` draws it: deck's values first, then the factors.
    rng = np.random.default_rng(3)
    rng.uniform(0.5, 2.0, 8)
    np.testing.assert_allclose(run.record.updated, rng.uniform(0.9, 1.1, 8)[1::2], atol=5e-3)
