"""The zoo: its structures are structures, and updating finds the truth of some of them."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks.zoo.__main__ import Outcome, table, update_twin
from benchmarks.zoo.families import FAMILIES
from benchmarks.zoo.twins import Kind


@pytest.mark.parametrize("family", [name for name in FAMILIES if name != "bracket"])
def test_a_structure_is_its_family_and_seed(family: str) -> None:
    one, again, other = (FAMILIES[family](np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert str(one) == str(again)
    assert str(one.deck) != str(other.deck)
    assert one.parameters
    fewest = 5 if one.with_shapes else 1
    assert len(set(one.sensors)) == len(one.sensors) >= fewest


@pytest.mark.parametrize(
    ("family", "kind"),
    [
        ("chain", "exact"),
        ("mechanism", "swapped"),
        ("polar_masses", "exact"),
        ("assembly", "missing"),
        ("assembly", "far"),
        ("tower", "turned"),
        ("soft_mounts", "exact"),
        ("stick", "turned"),
        ("grillage", "swapped"),
        ("square_bar", "exact"),
        ("tube", "exact"),
        ("stiffened_plate", "missing"),
        ("round_bar", "noisy"),
    ],
)
def test_the_truth_of_a_sound_twin_is_found(family: str, kind: Kind) -> None:
    outcome = update_twin(family, 1, kind)
    assert outcome.ended == "ended", outcome.said
    assert outcome.found, outcome
    assert outcome.right, outcome


@pytest.mark.parametrize(
    "family", ["sectors", "mirrored_beam", "soil_building", "series_springs", "far_frame"]
)
def test_the_truth_is_the_answer_or_listed_where_there_are_several(family: str) -> None:
    outcome = update_twin(family, 1, "exact")
    assert outcome.ended == "ended", outcome.said
    assert outcome.listed, outcome
    assert outcome.right, outcome


@pytest.mark.parametrize("kind", ["reversed", "other"])
def test_a_fault_of_test_or_model_is_not_trusted_away_from_the_truth(kind: Kind) -> None:
    outcome = update_twin("chain", 2, kind)
    assert outcome.ended in ("ended", "lost"), outcome.said  # lost: told that no mode is a partner
    assert not outcome.apart < 0.1, outcome
    assert not outcome.trusted


def test_intervals_of_models_that_lack_a_mass_contain_the_truth() -> None:
    """Assembly, chain and grillage, none of whose parameters stand for the mass."""
    outcomes = [update_twin(family, 2, "other") for family in ("assembly", "chain", "grillage")]
    assert not any(item.trusted for item in outcomes)
    assert sum(item.intervals for item in outcomes) >= 6
    assert all(item.with_truth == item.intervals for item in outcomes), outcomes


def test_the_table_counts_how_updates_ended() -> None:
    outcomes = [
        Outcome("chain", 1, "exact", found=True, trusted=True, ended="ended", listed=True),
        Outcome("chain", 2, "exact", trusted=True, accused=True, ended="ended"),
        Outcome(
            "chain",
            3,
            "other",
            accused=True,
            ended="ended",
            withheld=True,
            intervals=3,
            with_truth=2,
        ),
        Outcome("chain", 1, "far", found=True, trusted=True, off=True, ended="ended", listed=True),
        Outcome("chain", 3, "exact", ended="lost"),
        Outcome("chain", 4, "exact", ended="fault"),
    ]
    lines = [line.split() for line in table(outcomes).splitlines()[1:]]
    assert lines == [
        ["chain", "6", "2", "2", "3", "1", "1", "3", "1", "1", "0", "1", "1", "3", "2"],
        ["exact", "4", "1", "1", "1", "1", "1", "2", "0", "1", "0", "1", "0", "0", "0"],
        ["other", "1", "0", "0", "1", "0", "0", "0", "0", "0", "0", "0", "1", "3", "2"],
        ["far", "1", "1", "1", "1", "0", "0", "1", "1", "0", "0", "0", "0", "0", "0"],
        ["all", "6", "2", "2", "3", "1", "1", "3", "1", "1", "0", "1", "1", "3", "2"],
    ]
