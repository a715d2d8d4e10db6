"""The zoo: its structures are structures, and updating finds the truth of some of them."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks.zoo.__main__ import Outcome, table, update_twin
from benchmarks.zoo.structures import FAMILIES


@pytest.mark.parametrize("family", [name for name in FAMILIES if name != "bracket"])
def test_a_structure_is_its_family_and_seed(family: str) -> None:
    one, again, other = (FAMILIES[family](np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert str(one) == str(again)
    assert str(one.deck) != str(other.deck)
    assert one.parameters
    assert len(set(one.sensors)) == len(one.sensors) >= 5


@pytest.mark.parametrize(
    "family", ["chain", "mechanism", "polar_masses", "assembly", "tower", "soft_mounts", "stick"]
)
def test_the_truth_of_an_exact_twin_is_found(family: str) -> None:
    outcome = update_twin(family, 1, "exact")
    assert outcome.ended == "ended", outcome.said
    assert outcome.found, outcome


def test_the_table_counts_how_updates_ended() -> None:
    outcomes = [
        Outcome("chain", 1, "exact", found=True, trusted=True, ended="ended"),
        Outcome("chain", 2, "exact", trusted=True, accused=True, ended="ended"),
        Outcome("chain", 3, "exact", ended="lost"),
        Outcome("chain", 4, "exact", ended="fault"),
    ]
    assert table(outcomes).splitlines()[1].split() == [
        "chain", "exact", "4", "1", "1", "1", "1", "0", "1",
    ]  # fmt: skip
