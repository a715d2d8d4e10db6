"""Flags, sentences and verdicts, each by the rule that `core/updating/trust` states."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import get_args

import h5py
import numpy as np
import pytest

from modetune.core.modes import Floats
from modetune.core.parameters import Parameter, ParameterSet
from modetune.core.storage.codec import read_value, write_value
from modetune.core.updating.identifiability import identifiability
from modetune.core.updating.parameter_steps import LCurve
from modetune.core.updating.trust import (
    StartSpread,
    Trust,
    combination_sentences,
    judge_parameters,
    trust_sentences,
    verdict_reasons,
    with_concerns,
    with_spread,
)
from modetune.core.updating.verdict import FailOn, TrustVerdict


def trust(
    sensitivity: Floats,
    updated: list[float],
    errors: list[float] | None = None,
    missing: tuple[int, ...] = (),
    agrees: bool = True,
    remaining: list[float] | None = None,
    freedom: int = 3,
) -> Trust:
    """Of parameters a, b, ... with deviations 0.2 and bounds 0.5 to 2, measured to deviation 1."""
    n = sensitivity.shape[1]
    names = "abcdefghijkl"[:n]
    parameters = ParameterSet(
        tuple(Parameter(name, "mass", "elset", (name,), 0.5, 2.0, 0.2) for name in names)
    )
    values = np.array(updated)
    found = identifiability(sensitivity, np.ones(len(sensitivity)), np.full(n, 0.2), values)
    standard = np.array(errors) if errors else np.full(n, 0.001)
    judged = judge_parameters(parameters, values, np.ones(n), standard, standard, found, missing)
    left = np.array(remaining) if remaining else np.zeros(n)
    unseen = combination_sentences(parameters.names, found)
    same = spread(n, (), ())
    return Trust(judged, found, agrees, left, freedom, unseen, spread=same)


def flags(found: Trust) -> list[tuple[str, ...]]:
    return [item.flags for item in found.parameters]


def spread(
    n: int,
    rivals: tuple[int, ...],
    differ: tuple[str, ...],
    valley: tuple[str, ...] = (),
    exchanged: tuple[int, ...] = (),
) -> StartSpread:
    """Of three starts two ended, at a rival where there is one; the third failed."""
    names = list("abcdefghijkl"[:n])
    return StartSpread(
        np.ones((3, n)),
        np.array([np.full(n, value) for value in (1.0, 2.0, np.nan)]),
        np.array([1.0, 1.0, np.nan]),
        ("converged", "converged", "failed: lost"),
        np.array([0, 1 if rivals else 0, -1]),
        rivals,
        differ,
        0,
        4,
        n_starts=3,
        exchanged=exchanged,
        extent=np.array([np.ones(n), np.ones(n) + 0.5 * np.isin(names, valley)]),
        valley=valley,
    )


WELL_POSED = 500.0 * np.eye(4)


def test_nothing_is_flagged_where_everything_is_told() -> None:
    found = trust(WELL_POSED, [1.1, 0.9, 1.2, 0.8])
    assert found.flagged == ()
    assert found.verdict == "trusted"
    # (500 x 0.2)^2 = 10^4 to 1 of the prior: 99.99 % of each.
    assert trust_sentences(found) == (
        "The parameters are trusted: none in doubt. The test determines all 4 parameters.",
        "Updating ended at the minimum misfit.",
        "Of 3 starting points 2 converged to the reported solution, 1 failed.",
    )
    assert found.parameters[0].sentence == "a is determined by the test (100 %), to ±0.1 %."


@pytest.mark.parametrize(("value", "said"), [(0.5, "lower bound (0.5)"), (2.0, "upper bound (2)")])
def test_a_parameter_on_a_bound_is_flagged_with_the_bound(value: float, said: str) -> None:
    found = trust(WELL_POSED, [value, 1.1, 1.1, 1.1])
    assert "on_bound" in found.parameters[0].flags
    assert said in found.parameters[0].sentence
    assert found.verdict == "trusted with reservations"


def test_what_the_test_does_not_see_is_flagged_by_its_share() -> None:
    # Shares s^2 / (s^2 + 1) of s = sensitivity x 0.2: 0, 0.2, 0.8, 0.9999.
    found = trust(np.diag([0.0, 2.5, 10.0, 500.0]), [1.0, 1.05, 1.1, 1.1])
    assert flags(found) == [("unseen",), ("prior",), (), ()]
    assert "(the test determines 20 % of its value)" in found.parameters[1].sentence
    assert found.verdict == "trusted with reservations"
    assert found.parameters[0].sentence == (
        "a stays at its start value: no measured value changes with it (over its bounds by 0 "
        "standard deviations of the test)."
    )
    assert (
        "2 of 4 parameters in doubt (a and b); measured values hardly change with a"
        in (trust_sentences(found)[0])
    )


def test_what_hardly_moves_the_measured_values_is_not_said_to_stay_where_it_moved() -> None:
    # 0.2 of the test's deviation for a change by one: 0.3 from 0.5 to 2, a share of 0.04^2.
    found = trust(np.diag([0.2, 500.0, 500.0, 500.0]), [1.273, 1.05, 1.1, 1.1])
    assert flags(found)[0] == ("unseen",)
    assert found.parameters[0].sentence == (
        "a was moved by +27.3 % without information from the test: measured values hardly change "
        "with it (over its bounds by 0.3 standard deviations of the test)."
    )


def test_a_modulus_and_a_density_are_called_a_ratio() -> None:
    found = trust(np.outer(np.ones(3), [400.0, -400.0]), [1.1, 1.1])
    assert flags(found) == [("collinear",), ("collinear",)]
    assert found.parameters[0].collinear_with == ("b",)
    assert found.unseen == (
        "The test determines only the ratio of a and b: raising both by the same share hardly "
        "changes the measured values.",
    )
    assert found.verdict == "not to be trusted"  # two of two


def test_springs_in_series_are_told_together_in_the_share_each_gives() -> None:
    # 1 / (1/k1 + 1/k2) with k2 = 2 k1: d ln k = (2/3) d ln k1 + (1/3) d ln k2.
    s = np.zeros((4, 4))
    s[0, :2], s[1, 2], s[2, 3] = (600.0, 300.0), 500.0, 500.0
    found = trust(s, [1.0, 1.0, 1.1, 1.1])
    (said,) = found.unseen
    assert said.startswith("The test determines b and a only together: raising b by 1 % and ")
    assert "by 0.5 %" in said
    assert flags(found) == [("collinear",), ("collinear",), (), ()]
    assert found.verdict == "trusted with reservations"  # two of four are not a majority


def test_three_in_one_combination_are_named_with_their_changes() -> None:
    found = trust(np.array([[500.0, 500.0, 0.0], [0.0, 500.0, 500.0]]), [1.0, 1.0, 1.0])
    # What leaves a + b and b + c alone is (1, -1, 1).
    (said,) = found.unseen
    assert said.startswith("The test cannot separate a, b and c: changing a by +1 % together with ")
    assert "b by -1 %" in said
    assert "c by +1 %" in said


def test_a_scale_of_all_parameters_is_one_sentence_and_flags_none_of_many() -> None:
    n = 12
    # Columns sum to nothing: all of them together are unseen, each by itself to one twelfth.
    s = 500.0 * (np.eye(n) - 1.0 / n)
    found = trust(s, [1.1] * n)
    assert flags(found) == [()] * n
    assert "only relative to each other" in found.unseen[0]
    assert found.verdict == "trusted with reservations"


def test_almost_alike_is_flagged_although_it_is_told() -> None:
    # At an angle of 2 degrees the index is 1 / sqrt(1 - cos 2) = 40.5.
    turned = np.deg2rad(2.0)
    s = 1e5 * np.array([[1.0, np.cos(turned)], [0.0, np.sin(turned)]])
    found = trust(s, [1.1, 1.1])
    assert flags(found) == [("alike",), ("alike",)]
    assert found.verdict == "trusted with reservations"  # told, and yet
    assert "collinearity index 41" in found.unseen[0]
    assert "has almost the same effect as b" in found.parameters[0].sentence


def test_a_value_far_from_the_deck_is_flagged_by_its_own_deviation() -> None:
    found = trust(WELL_POSED, [1.59, 1.61, 1.0, 1.0])  # three deviations are 0.6
    assert flags(found)[:2] == [(), ("far",)]
    assert "+61 % from the deck" in found.parameters[1].sentence


def test_a_change_within_its_error_is_said_and_doubts_nothing() -> None:
    found = trust(WELL_POSED, [1.02, 1.02, 1.001, 1.2], [0.03, 0.01, 0.009, 0.001])
    # The third is within its error too, but both are below one percent.
    assert flags(found) == [("uncertain",), (), (), ()]
    assert "+2 %, less than its standard error (±3 %)" in found.parameters[0].sentence
    assert found.verdict == "trusted"


def test_a_parameter_with_an_infinite_error_is_in_doubt_whatever_its_share() -> None:
    found = trust(WELL_POSED, [1.1] * 4, [0.01, 0.01, 0.01, np.inf])
    assert flags(found) == [(), (), (), ("undetermined",)]
    assert found.verdict is TrustVerdict.RESERVATIONS
    assert verdict_reasons(found) == ("1 of 4 parameters in doubt (d)",)
    assert found.parameters[3].sentence == (
        "d has no finite standard error: the test alone does not fix it."
    )
    # Another flag that doubts it is reason enough.
    bound = trust(WELL_POSED, [1.1, 1.1, 1.1, 2.0], [0.01, 0.01, 0.01, np.inf])
    assert flags(bound)[3] == ("on_bound", "far")


def test_a_value_on_its_bound_has_no_error() -> None:
    found = trust(WELL_POSED, [2.0, 1.1, 1.1, 1.1], [0.0, 0.01, 0.01, 0.01])
    assert [item.error for item in found.parameters] == [None, 0.01, 0.01, 0.01]
    # Short of the minimum misfit it has one: the distance to it.
    short = trust(WELL_POSED, [2.0, 1.1, 1.1, 1.1], [0.02, 0.01, 0.01, 0.01])
    assert short.parameters[0].error == 0.02


@pytest.mark.parametrize(
    ("verdict", "excluded"),
    [
        (TrustVerdict.TRUSTED, set()),
        (TrustVerdict.RESERVATIONS, {"doubt"}),
        (TrustVerdict.NOT_JUDGED, {"doubt"}),
        (TrustVerdict.NOT_TRUSTED, {"doubt", "not-trusted"}),
    ],
)
def test_a_verdict_is_excluded_by_doubt_or_only_where_it_is_not_to_be_trusted(
    verdict: TrustVerdict, excluded: set[str]
) -> None:
    assert {name for name in get_args(FailOn) if verdict.excluded_by(name)} == excluded


def test_a_column_that_could_not_be_computed_is_not_called_unseen() -> None:
    s = WELL_POSED.copy()
    s[:, 1] = 0.0
    assert flags(trust(s, [1.1, 1.0, 1.1, 1.1], missing=(1,)))[1] == ("missing",)


def test_more_than_half_in_doubt_is_not_to_be_trusted() -> None:
    # The footbridge of the literature: 13 of 17 on a bound; here 3 of 4, and 2 of 4.
    assert trust(WELL_POSED, [0.5, 2.0, 0.5, 1.1]).verdict == "not to be trusted"
    assert trust(WELL_POSED, [0.5, 1.1, 0.5, 1.1]).verdict == "trusted with reservations"


def test_without_agreement_or_with_a_concern_there_are_reservations() -> None:
    assert trust(WELL_POSED, [1.1] * 4, agrees=False).verdict == "trusted with reservations"
    found = with_concerns(trust(WELL_POSED, [1.1] * 4), "No parameter can remove the residual.")
    assert found.verdict == "trusted with reservations"
    assert trust_sentences(found)[-1] == "No parameter can remove the residual."


def test_what_no_noise_explains_takes_the_trust_away() -> None:
    for times, verdict in ((2.9, "trusted with reservations"), (3.1, "not to be trusted")):
        found = replace(with_concerns(trust(WELL_POSED, [1.1] * 4), "One."), times_noise=times)
        assert found.verdict == verdict
    assert "the remaining misfit is 3.1 times what noise explains" in (trust_sentences(found)[0])
    assert "none in doubt" not in trust_sentences(found)[0]


def test_an_answer_short_of_the_least_misfit_is_a_reservation_and_names_all() -> None:
    # Errors of the least misfit 0.01 and 0.001; what is told holds for the values as they stand.
    way = [0.025, -0.02, 0.0, 0.0]
    errors = [float(np.hypot(0.01, 0.025)), float(np.hypot(0.001, 0.02)), np.inf, 0.001]
    found = trust(WELL_POSED, [1.1] * 4, errors, remaining=way)
    assert found.ended == "good enough"
    assert found.too_short
    assert found.verdict == "trusted with reservations"
    said = trust_sentences(found)[1]
    assert said.startswith(
        "Updating ended with e1 met, before the minimum misfit, which is further"
    )
    assert "(b by -2 %, 20.0 standard errors, a by +2.5 %, 2.5 standard errors)" in said
    # By 1.5 of its errors, or by five but less than one percent: told, and no reservation.
    for short, scatter in (([0.015, 0.0, 0.0, 0.0], 0.01), ([0.005, 0.0, 0.0, 0.0], 0.001)):
        errors = [float(np.hypot(scatter, short[0])), *[0.001] * 3]
        near = trust(WELL_POSED, [1.1] * 4, errors, remaining=short)
        assert near.ended == "good enough"
        assert near.verdict == "trusted"
    unmet = trust(WELL_POSED, [1.1] * 4, errors, agrees=False, remaining=short)
    assert unmet.ended == "under way"


def test_a_way_that_is_small_beside_the_error_is_the_least_misfit() -> None:
    found = trust(WELL_POSED, [1.1] * 4, [0.01, 0.01, 0.01, np.inf], remaining=[0.0028] * 4)
    assert found.ended == "least misfit"
    # 0.003 of sqrt(0.01^2 - 0.003^2) is 0.31.
    assert trust(WELL_POSED, [1.1] * 4, [0.01] * 4, remaining=[0.003] * 4).ended == "good enough"


def test_nothing_is_trusted_by_itself_where_no_degree_of_freedom_is_left() -> None:
    found = replace(trust(WELL_POSED, [1.1] * 4, freedom=0), spread=None)
    assert found.verdict == "not to be trusted"
    assert "no degree of freedom is left" in trust_sentences(found)[0]
    # Other starts that end at the same values speak for it, those with a rival against.
    assert with_spread(found, spread(4, (), ())).verdict == "trusted with reservations"
    assert with_spread(found, spread(4, (1,), ("b",))).verdict == "not to be trusted"


def test_other_starts_that_fit_as_well_take_the_trust_away() -> None:
    found = with_spread(trust(WELL_POSED, [1.1] * 4), spread(4, (1,), ("b",)))
    assert flags(found) == [(), ("starts",), (), ()]
    assert found.verdict == "not to be trusted"
    said = trust_sentences(found)[2]
    assert said == (
        "Of 3 starting points 1 converged to the reported solution, 1 to other minima, 1 failed."
    )
    assert trust_sentences(found)[3] == (
        "Other values fit as well: a 2, b 2, c 2, d 2; the answer is a 1.1, b 1.1, c 1.1, d 1.1."
    )


def test_other_starts_that_end_at_the_same_values_confirm_the_answer() -> None:
    found = with_spread(trust(WELL_POSED, [1.1] * 4), spread(4, (), ()))
    assert found.verdict == "trusted"
    said = "Of 3 starting points 2 converged to the reported solution, 1 failed."
    assert trust_sentences(found)[2] == said


def test_what_was_flagged_already_is_no_news_from_other_starts() -> None:
    s = WELL_POSED.copy()
    s[:, 1] = 0.0
    found = with_spread(trust(s, [1.1, 1.0, 1.1, 1.1]), spread(4, (1,), ("b",)))
    assert flags(found)[1] == ("unseen", "starts")
    assert found.verdict == "trusted with reservations"


def test_what_was_not_tested_for_other_minima_is_not_trusted_without_reservations() -> None:
    found = replace(trust(WELL_POSED, [1.1] * 4), spread=None)
    assert found.verdict == "trusted with reservations"
    assert "uniqueness not tested" in trust_sentences(found)[0]
    assert trust_sentences(found)[2].startswith("Uniqueness not tested: ")
    assert "not tested" not in "".join(trust_sentences(trust(WELL_POSED, [1.1] * 4)))


@pytest.mark.parametrize("times_noise", [0.0, 2.0, 5.0])
def test_other_values_never_fit_as_well_where_nothing_explains_the_test(times_noise: float) -> None:
    unexplained = "No parameter values within the bounds explain the test."
    found = trust(WELL_POSED, [1.1] * 4)
    if times_noise:
        found = replace(with_concerns(found, unexplained), times_noise=times_noise)
    found = with_spread(found, spread(4, (1,), ("b",)))
    said = " ".join(trust_sentences(found))
    assert ("fit as well" in said) is not (unexplained in said)
    assert found.fit_as_well == (() if times_noise else (1,))
    assert found.verdict == "not to be trusted"


def test_a_valley_is_reported_with_its_extent_and_doubts_the_parameter() -> None:
    found = with_spread(trust(WELL_POSED, [1.1] * 4), spread(4, (), (), valley=("c",)))
    assert flags(found) == [(), (), ("starts",), ()]
    assert found.verdict == "not to be trusted"
    said = "Along a valley the misfit rises by no more than noise: c 1 to 1.5."
    assert said in trust_sentences(found)
    assert found.parameters[2].sentence == "c may be anywhere from 1 to 1.5, along a valley."
    # What is in doubt by its sensitivity is no news.
    s = np.diag([500.0, 500.0, 0.0, 500.0])
    unseen = with_spread(trust(s, [1.1] * 4), spread(4, (), (), valley=("c",)))
    assert "starts" not in flags(unseen)[2]


def test_exchanges_of_the_answer_are_one_sentence_with_their_number() -> None:
    found = trust(WELL_POSED, [1.0, 2.0, 1.1, 1.1])
    own = np.array([item.updated for item in found.parameters])
    orders = np.array([[0, 1, 2, 3], [1, 0, 2, 3], [1, 2, 0, 3]])
    three = replace(
        spread(4, (1, 2), ("a", "b", "c"), exchanged=(1, 2)),
        updated=own[orders],
        misfits=np.ones(3),
        minima=np.arange(3),
    )
    said = [text for text in trust_sentences(with_spread(found, three)) if "exchange" in text]
    assert said == [
        "2 more minima, exchanges of the values of a, b and c, fit as well, such as a 2, b 1, "
        "c 1.1, d 1.1; the answer is a 1, b 2, c 1.1, d 1.1."
    ]


@pytest.mark.parametrize("whole", [True, False])
def test_the_file_gives_back_what_was_written(tmp_path: Path, whole: bool) -> None:
    s = np.array([[500.0, 500.0, 0.0, 0.0], [0.0, 0.0, 500.0, 0.0]])
    found = trust(s, [1.0, 1.0, 0.5, 1.0], [np.inf, np.inf, 0.01, np.nan])
    if whole:
        curve = LCurve(np.array([1.0, 2.0]), np.array([3.0, 4.0]), np.array([5.0, 6.0]), 1.5)
        found = with_spread(with_concerns(found, "One.", "Two."), spread(4, (1,), ("a", "b")))
        found = replace(
            found, curve=curve, regularisation=0.5, age=2, notes=("Three.",), times_noise=1.7
        )
    with h5py.File(tmp_path / "trust.h5", "w") as file:
        write_value(file, found)
        assert repr(read_value(file, Trust)) == repr(found)
