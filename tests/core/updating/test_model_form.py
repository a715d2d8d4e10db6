"""The test for model-form error: its closed forms, its rate of false alarms, and what it finds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.stats import binom, chi2, kstest

from modetune.core.correlation.pairing import pair_by_shape
from modetune.core.errors import CampaignError
from modetune.core.modes import Floats, ModeSet, mode_set
from modetune.core.updating.model_form import (
    ModelForm,
    model_form,
    model_form_sentence,
    shares_left,
)
from modetune.core.updating.responses.response import Residual
from modetune.core.updating.sensitivity import ModeDerivatives
from modetune.core.updating.weighting import even_weighting
from tests.core.updating.compared import residual, residual_sensitivity

FREE = np.array([np.inf])
SPRINGS = np.array([1500.0, 1600.0, 1400.0, 2500.0, 1300.0, 1500.0, 1300.0, 1700.0])
MASSES = np.array([1.8, 2.4, 1.6, 1.2, 1.1, 0.9, 1.4])
#: Springs that are parameters.
CHOSEN = (0, 3, 6)
WEIGHTING = even_weighting(5, 7, 0.002, 0.05)
TRUTH = np.array([1.15, 0.9, 1.08])


def stiffness(springs: Floats) -> Floats:
    return (
        np.diag(springs[:-1] + springs[1:]) - np.diag(springs[1:-1], 1) - np.diag(springs[1:-1], -1)
    )


def chain_modes(theta: Floats, fault: float = 1.0) -> tuple[Floats, Floats]:
    """All modes; fault: factor on a spring that no parameter has, the second."""
    springs = SPRINGS.copy()
    springs[list(CHOSEN)] *= theta
    springs[1] *= fault
    root = np.sqrt(MASSES)
    values, vectors = np.linalg.eigh(stiffness(springs) / np.outer(root, root))
    return values, vectors / root[:, None]


def modes_of(values: Floats, shapes: Floats) -> ModeSet:
    return mode_set(np.sqrt(values) / 2 / np.pi, shapes, np.arange(1, 8), np.ones(7))


def derivatives(values: Floats, shapes: Floats, n_modes: int) -> ModeDerivatives:
    """By the sum over all modes, exact for the whole basis (Fox and Kapoor 1968)."""
    slopes, turns = [], []
    for place in CHOSEN:
        alone = np.zeros(8)
        alone[place] = SPRINGS[place]
        k = shapes.T @ stiffness(alone) @ shapes
        gaps = values[None, :] - values[:, None] + np.eye(7)
        share = k / gaps
        np.fill_diagonal(share, 0.0)
        slopes.append(np.diag(k)[:n_modes])
        turns.append((shapes @ share)[:, :n_modes])
    return ModeDerivatives(np.stack(slopes, axis=1), np.stack(turns, axis=2))


@dataclass(frozen=True)
class Case:
    found: Residual
    sensitivity: Floats
    theta: Floats

    def form(self, level: float = 0.01) -> ModelForm:
        return model_form(
            self.sensitivity,
            self.found.values,
            self.found.variances,
            0.5 - self.theta,
            2.0 - self.theta,
            shapes=np.concatenate([np.full(5, -1), np.repeat(np.arange(5), 7)]),
            level=level,
        )


def updated(seed: int, fault: float = 1.0, n_steps: int = 4) -> Case:
    """A noisy test of the true chain, five modes, and a model brought as near as it gets."""
    rng = np.random.default_rng(seed)
    values, shapes = (part[..., :5] for part in chain_modes(TRUTH, fault))
    noise = WEIGHTING.shape_deviations[0] * np.sqrt(np.mean(shapes**2, axis=0))
    test = modes_of(
        values * (1.0 + WEIGHTING.frequency_deviations * rng.standard_normal(5)) ** 2,
        shapes + noise * rng.standard_normal(shapes.shape),
    )
    theta = np.ones(3)
    for step in range(n_steps + 1):
        lam, phi = chain_modes(theta)
        model = modes_of(lam[:5], phi[:, :5])
        pairing = pair_by_shape(test, model)
        found = residual(test, model, pairing, WEIGHTING)
        change = derivatives(lam, phi, 5)
        ordered = ModeDerivatives(
            change.eigenvalues[pairing.computed], change.mode_shapes[:, pairing.computed]
        )
        matrix = residual_sensitivity(test, model, pairing, WEIGHTING, ordered)
        if step < n_steps:
            root = np.sqrt(found.weights)
            theta = (
                theta + np.linalg.lstsq(root[:, None] * matrix, root * found.values, rcond=None)[0]
            )
    return Case(found, matrix, theta)


def test_one_value_and_no_sensitivity_is_the_square_of_its_deviations() -> None:
    # Three standard deviations from nothing: chi-square 9 with one degree of freedom.
    form = model_form(np.zeros((1, 1)), np.array([0.3]), np.array([0.01]), -FREE, FREE)
    assert form.dof == 1
    assert form.statistic == pytest.approx(9.0)
    assert form.p_value == pytest.approx(chi2.sf(9.0, 1))
    assert form.suspected
    assert form.standardised == pytest.approx([3.0])


def test_the_mean_of_equal_values_is_the_sample_variance() -> None:
    # One parameter that moves n values alike: chi^2 is (n - 1) s^2 / sigma^2.
    values = np.array([0.1, 0.3, 0.2, 0.7])
    form = model_form(np.ones((4, 1)), values, np.full(4, 0.04), -FREE, FREE)
    allowed = (0.5 * abs(values.mean()) ** 2) ** 2  # how far a step of its size may bend
    assert form.dof == 3
    assert form.change == pytest.approx([values.mean()])
    assert form.statistic == pytest.approx(3 * values.var(ddof=1) / (0.04 + allowed))


def test_a_parameter_on_a_bound_does_not_count_as_fitted() -> None:
    sensitivity = np.ones((4, 1))
    form = model_form(sensitivity, np.full(4, 0.5), np.full(4, 1e-4), -np.ones(1), np.array([0.1]))
    assert form.at_bound.tolist() == [True]
    assert form.change == pytest.approx([0.1])
    assert form.dof == 4
    assert form.suspected


def test_two_parameters_that_do_the_same_count_as_one() -> None:
    rng = np.random.default_rng(0)
    column = rng.standard_normal((6, 1))
    wide = np.full(2, 10.0)
    form = model_form(
        np.hstack([column, 2 * column]),
        rng.standard_normal(6) * 0.01,
        np.full(6, 1e-4),
        -wide,
        wide,
    )
    assert form.dof == 5


def test_without_degrees_of_freedom_nothing_is_suspected_and_the_sentence_says_why() -> None:
    form = model_form(np.eye(2), np.array([0.1, 0.2]), np.ones(2), -np.ones(2), np.ones(2))
    assert form.dof == 0
    assert np.isnan(form.p_value)
    assert not form.suspected
    assert "as many free parameters" in model_form_sentence(form, ("a", "b"), ("p", "q"), True)


def test_an_old_sensitivity_is_believed_less() -> None:
    sensitivity = np.array([[1.0], [1.0], [0.5]])
    values = np.array([0.1, 0.12, 0.02])
    fresh, old = (
        model_form(sensitivity, values, np.full(3, 1e-5), -FREE, FREE, moved=moved)
        for moved in (None, np.array([0.3]))
    )
    assert old.statistic < fresh.statistic


def test_a_shape_counts_one_less_and_half_of_its_turn_is_allowed_to_it() -> None:
    # S d = (0.1, 0.1): a mean square of 0.01, of which a quarter is added to each variance; what
    # one parameter leaves of (0.15, 0.05) is (0.05, -0.05).
    shape = np.zeros(2, dtype=np.int64)
    form = model_form(
        np.ones((2, 1)), np.array([0.15, 0.05]), np.full(2, 0.001), -FREE, FREE, shapes=shape
    )
    variance = 0.001 + (0.1 * 0.05) ** 2 + 0.25 * 0.01
    assert form.dof == 0
    assert form.statistic == pytest.approx(2 * 0.05**2 / variance)


def test_variances_must_be_above_zero() -> None:
    with pytest.raises(CampaignError, match="variance above zero"):
        model_form(np.ones((2, 1)), np.ones(2), np.array([1.0, 0.0]), -FREE, FREE)


def test_what_is_left_is_told_by_label_the_largest_first() -> None:
    form = model_form(np.zeros((3, 1)), np.array([1.0, 3.0, 1.0]), np.ones(3), -FREE, FREE)
    shares = shares_left(form, ("a", "b", "a"))
    assert [name for name, _ in shares] == ["b", "a"]
    assert [share for _, share in shares] == pytest.approx([9 / 11, 2 / 11])


def test_good_models_are_suspected_as_often_as_the_level_says() -> None:
    """Well-posed noisy twins: p-values are uniform, so a level of 5 % alarms in 5 % of them."""
    forms = [updated(seed).form(level=0.05) for seed in range(300)]
    alarms = sum(form.suspected for form in forms)
    # 99.9 % of binomial counts with n = 300 and p = 0.05 lie between these.
    assert binom.ppf(0.0005, 300, 0.05) <= alarms <= binom.ppf(0.9995, 300, 0.05)
    assert kstest([form.p_value for form in forms], "uniform").pvalue > 0.01


def test_a_faulty_spring_that_no_parameter_has_is_found_in_all_noisy_twins() -> None:
    forms = [updated(seed, fault=1.1).form() for seed in range(60)]
    assert all(form.suspected for form in forms)
    assert min(form.times_noise for form in forms) > 1.5


def test_the_forecast_before_updating_sees_the_faulty_spring_and_spares_the_good_model() -> None:
    good = [updated(seed, n_steps=0).form() for seed in range(60)]
    faulty = [updated(seed, fault=1.1, n_steps=0).form() for seed in range(60)]
    assert sum(form.suspected for form in good) <= binom.ppf(0.999, 60, 0.01)
    assert all(form.suspected for form in faulty)


def test_the_sentence_names_what_is_left_and_the_bound() -> None:
    form = model_form(
        np.ones((3, 1)), np.array([1.0, 1.0, 3.0]), np.full(3, 1e-2), -np.ones(1), np.array([0.2])
    )
    labels = tuple(f"the frequency of mode {number}" for number in (1, 2, 3))
    said = model_form_sentence(form, labels, ("k1",), updated=False)
    assert "No parameter values within the bounds are expected to explain the test" in said
    assert "most of it in the frequency of mode 3" in said
    assert "k1 would go beyond a bound" in said


def test_a_good_fit_is_said_to_be_within_noise() -> None:
    form = model_form(np.zeros((4, 1)), np.full(4, 0.9), np.ones(4), -FREE, FREE)
    said = model_form_sentence(form, ("a",) * 4, ("p",), updated=True)
    assert said.startswith("What is left of the residual is within measurement noise")


def test_a_forecast_suspects_nothing_close_to_noise() -> None:
    # 1000 values of 1.1 deviations each: chi-square 1210 of 1000, p 5e-6, 1.1 times noise.
    values = (np.zeros((1000, 1)), np.full(1000, 1.1), np.ones(1000), -FREE, FREE)
    assert model_form(*values).suspected
    form = model_form(*values, least=1.5)
    assert form.times_noise == pytest.approx(1.1)
    assert not form.suspected
    said = model_form_sentence(form, ("a",) * 1000, ("p",), updated=False)
    assert said.startswith("What is left of the residual would be 1.1 times measurement noise")
    assert model_form(values[0], 1.6 * np.ones(1000), *values[2:], least=1.5).suspected


def test_far_too_small_a_chi_square_blames_the_deviations() -> None:
    form = model_form(np.zeros((50, 1)), np.full(50, 0.2), np.ones(50), -FREE, FREE)
    said = model_form_sentence(form, ("a",) * 50, ("p",), updated=True)
    assert "only 0.2 times what the stated measurement deviations lead to expect" in said
    assert "standard errors that follow from them are too large too" in said
    # Two values leave so little by chance in more than one of a hundred cases.
    few = model_form(np.zeros((2, 1)), np.full(2, 0.2), np.ones(2), -FREE, FREE)
    assert not few.overstated


def test_a_probability_of_nothing_is_said_to_be_small() -> None:
    form = model_form(np.zeros((9, 1)), np.full(9, 100.0), np.ones(9), -FREE, FREE)
    said = model_form_sentence(form, ("a",) * 9, ("p",), updated=True)
    assert ", p < 1e-300)" in said
