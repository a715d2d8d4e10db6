"""Which candidates are chosen, and the reason that each gets."""

from __future__ import annotations

import numpy as np
import pytest

from modetune.core.modes import Floats
from modetune.flows.studies.screen.choice import (
    CandidateParameters,
    ChosenParameters,
    choose_parameters,
    percent,
)

#: Columns of five measurements: two at right angles, one nearly like the first, one of no size,
#: one at right angles that the residual does not need.
COLUMNS = np.array(
    [
        [5.0, 0.0, 4.0, 0.01, 0.0],
        [0.0, 8.0, 0.2, 0.0, 0.0],
        [0.0, 0.0, 0.0, 0.0, 3.0],
        [0.0, 0.0, 0.3, 0.0, 0.0],
        [0.0, 0.0, 0.0, 0.0, 0.0],
    ]
)
NAMES = ("E_wing", "E_fin", "t_wing", "E_strut", "E_tail")


def free(n: int) -> tuple[Floats, Floats]:
    """Changes without bounds."""
    return np.full(n, -np.inf), np.full(n, np.inf)


def chosen(
    residual: Floats, most: int | None = None, missing: tuple[str, ...] = ("",) * 5
) -> ChosenParameters:
    importance = np.linalg.norm(COLUMNS, axis=0)
    loudest = ("frequency of mode 1",) * 5
    return choose_parameters(
        CandidateParameters(
            NAMES, importance, loudest, missing, COLUMNS, residual, *free(len(NAMES))
        ),
        most,
    )


def reason(choice: ChosenParameters, name: str) -> str:
    return next(item.reason for item in choice.verdicts if item.name == name)


def test_each_candidate_has_its_reason() -> None:
    # The residual is two thirds along E_fin, one along E_wing: squares 16 and 4 of 20.
    choice = chosen(np.array([2.0, 4.0, 0.0, 0.0, 0.0]))
    assert choice.chosen == ("E_fin", "E_wing")
    assert "from 100 % to 20 %" in reason(choice, "E_fin")
    assert reason(choice, "t_wing").startswith("collinear with E_wing (cosine +0.99")
    assert "only a combination of the two" in reason(choice, "t_wing")
    assert reason(choice, "E_strut") == (
        "insensitive: over its bounds it changes the responses by 0.01 standard deviations of the "
        "test; most frequency of mode 1"
    )
    assert "not needed: it would reduce the squared residual by less than 1 %" in reason(
        choice, "E_tail"
    )
    assert choice.groups == ((0, 2),)
    assert choice.ranking == (1, 0, 2, 4, 3)
    np.testing.assert_allclose(choice.misfits, [1.0, 0.2, 0.0], atol=1e-12)


def test_a_number_asked_for_is_filled_with_what_is_most_independent() -> None:
    choice = chosen(np.array([2.0, 4.0, 0.0, 0.0, 0.0]), most=3)
    assert choice.chosen == ("E_fin", "E_wing", "E_tail")
    assert reason(choice, "E_tail") == ("100 % of its column is independent of the ones before it")


def test_a_number_asked_for_is_not_passed() -> None:
    choice = chosen(np.array([2.0, 4.0, 0.0, 0.0, 0.0]), most=1)
    assert choice.chosen == ("E_fin",)
    assert reason(choice, "E_wing") == "not among the 1 requested"


def test_more_than_can_be_told_apart_are_never_chosen() -> None:
    choice = chosen(np.array([2.0, 4.0, 0.0, 0.0, 0.0]), most=5)
    assert len(choice.chosen) == 3


def test_a_model_that_agrees_is_left_what_the_test_tells_apart() -> None:
    choice = chosen(np.zeros(5))
    # QR with pivoting: by the length of what each adds.
    assert choice.chosen == ("E_fin", "E_wing", "E_tail")
    assert choice.misfits == (0.0,)


def test_a_candidate_without_sensitivity_is_left_out_with_that_reason() -> None:
    choice = chosen(np.array([2.0, 4.0, 0.0, 0.0, 0.0]), missing=("", "its job failed", "", "", ""))
    assert choice.chosen == ("E_wing",)
    assert reason(choice, "E_fin") == "its sensitivity is unavailable: its job failed"


def test_opposite_columns_are_collinear_too() -> None:
    columns = np.array([[2.0, -1.9], [1.0, -1.0]])
    candidates = CandidateParameters(
        ("a", "b"), np.ones(2) * 9.0, ("", ""), ("", ""), columns, np.ones(2), *free(2)
    )
    choice = choose_parameters(candidates)
    assert "collinear with a (cosine -" in reason(choice, "b")
    assert "only a combination of the two" in reason(choice, "b")


def test_a_share_that_is_rounding_is_shown_as_zero() -> None:
    assert [percent(share) for share in (0.1234, 1.1e-8, 3e-17)] == ["12.3", "1.1e-06", "0"]
    choice = chosen(np.array([2.0, 4.0, 0.0, 0.0, 0.0]))
    assert "to 0 % of the initial one" in reason(choice, "E_wing")


def test_a_weak_parameter_whose_bounds_allow_too_little_is_not_chosen() -> None:
    # The residual is 20 of the weak column; where that may move by 1, 361 of 400 is left, and by 2
    # of the strong one 200.
    columns = np.array([[1.0, 5.0], [0.0, 5.0]])
    names, residual = ("weak", "strong"), np.array([20.0, 0.0])
    importance = np.linalg.norm(columns, axis=0)
    open_choice, bound_choice = (
        choose_parameters(
            CandidateParameters(
                names, importance, names, ("", ""), columns, residual, -limit, limit
            ),
            1,
        )
        for limit in (np.full(2, np.inf), np.array([1.0, 3.0]))
    )
    assert open_choice.chosen == ("weak",)
    assert bound_choice.chosen == ("strong",)


def test_nothing_seen_is_nothing_chosen() -> None:
    candidates = CandidateParameters(
        ("a",), np.zeros(1), ("frequency of mode 1",), ("",), np.zeros((3, 1)), np.ones(3), *free(1)
    )
    choice = choose_parameters(candidates)
    assert choice.chosen == ()
    assert reason(choice, "a").startswith("insensitive")


@pytest.mark.parametrize("seed", range(5))
def test_every_candidate_has_a_reason_and_ranks_are_without_gaps(seed: int) -> None:
    rng = np.random.default_rng(seed)
    columns = rng.normal(size=(6, 9)) * rng.uniform(0.1, 10.0, 9)
    columns[:, 4] = 1.01 * columns[:, 2]
    names = tuple(f"p{place}" for place in range(9))
    importance = np.linalg.norm(columns, axis=0)
    choice = choose_parameters(
        CandidateParameters(
            names, importance, names, ("",) * 9, columns, rng.normal(size=6), *free(9)
        ),
        6,
    )
    assert [item.name for item in choice.verdicts] == list(names)
    assert all(item.reason for item in choice.verdicts)
    ranks = sorted(item.rank for item in choice.verdicts if item.chosen)
    assert ranks == list(range(1, len(ranks) + 1))
    assert not (choice.verdicts[2].chosen and choice.verdicts[4].chosen)
