"""The evidence of a model against numerical integrals and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from modetune.core.updating.evidence import log_evidence, probabilities


def test_it_is_the_integral_of_the_likelihood_over_the_prior() -> None:
    # F(x) = 7 + 50 (x - 0.2)^2: half of its second derivative is 50.
    def likelihood(x: float) -> float:
        return float(np.exp(-0.5 * (7.0 + 50.0 * (x - 0.2) ** 2)))

    # The prior is much wider than the peak, whose tails outside are below 1e-30.
    whole = quad(likelihood, -2.0, 2.0, points=[0.2])[0] / 4.0
    found = log_evidence(7.0, np.array([[50.0]]), np.array([4.0]))
    assert found == pytest.approx(np.log(whole), rel=1e-9)


def test_correlated_parameters_leave_the_volume_of_their_ellipsoid() -> None:
    hessian = np.array([[400.0, 150.0], [150.0, 300.0]])
    widths = np.array([3.0, 5.0])
    volume = 2.0 * np.pi / np.sqrt(np.linalg.det(hessian)) / widths.prod()
    assert log_evidence(0.0, hessian, widths) == pytest.approx(np.log(volume), rel=1e-12)


def test_a_parameter_that_the_data_do_not_determine_costs_nothing() -> None:
    one = log_evidence(3.0, np.array([[80.0]]), np.array([2.0]))
    two = log_evidence(3.0, np.diag([80.0, 0.0]), np.array([2.0, 6.0]))
    assert two == pytest.approx(one, rel=1e-12)
    assert log_evidence(3.0, np.zeros((0, 0)), np.zeros(0)) == -1.5


def test_a_residual_above_the_noise_distinguishes_less() -> None:
    hessian, widths = np.array([[50.0]]), np.array([4.0])
    apart = [log_evidence(90.0, hessian, widths, s) - log_evidence(10.0, hessian, widths, s)
             for s in (1.0, 4.0)]  # fmt: skip
    assert apart == pytest.approx([-40.0, -10.0], rel=1e-12)


def test_probabilities_follow_from_evidence_and_prior() -> None:
    assert probabilities([1000.0, 1000.0 + np.log(3.0)]) == pytest.approx([0.25, 0.75])
    assert probabilities([0.0, 0.0], np.array([0.9, 0.1])) == pytest.approx([0.9, 0.1])
