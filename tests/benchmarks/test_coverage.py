"""Coverage: intervals at default settings hold the truth, and exact twins are not accused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benchmarks.coverage import ALONE, EXACT, coverage_line, exact_line, exact_twins, noisy_twins


@pytest.fixture(autouse=True)
def _home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))


@pytest.mark.parametrize(("structure", "n"), [("six_mass", 60), ("chain_18", 15)])
def test_intervals_hold_the_truth_of_noisy_twins(structure: str, n: int) -> None:
    twins = noisy_twins(structure, n, 1, ALONE)
    held = np.array([twin.held for twin in twins])
    # 180 and 270 intervals of 95 %: three standard deviations of such counts are 5 and 4 %.
    assert 0.90 <= held.mean() <= 0.99
    # By noise alone one in a hundred is accused.
    assert sum(twin.accused for twin in twins) <= 3
    assert all(twin.iterations > 0 for twin in twins)


@pytest.mark.parametrize("family", EXACT)
def test_exact_twins_are_found_and_not_accused(family: str) -> None:
    twins = exact_twins(family, 5, 1, ALONE)
    assert [twin.found for twin in twins] == [True] * 5
    assert not any(twin.accused for twin in twins)


def test_other_starts_do_not_doubt_what_is_well_posed() -> None:
    assert all(twin.trusted for twin in exact_twins("chain", 2, 7, {}))


def test_the_tables_have_a_line_a_structure() -> None:
    noisy, exact = noisy_twins("six_mass", 2, 1, ALONE), exact_twins("mechanism", 2, 1, ALONE)
    assert coverage_line("six_mass", noisy).split()[:2] == ["six_mass", "2"]
    assert exact_line("mechanism", exact).split()[:3] == ["mechanism", "2", "100.0"]
