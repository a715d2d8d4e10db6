"""The evidence of a model: closed forms of Gaussian integrals, and numerical ones within bounds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import dblquad, quad

from modetune.core.updating.evidence import log_evidence, probabilities


def test_the_evidence_of_a_line_is_its_gaussian_integral_over_the_width() -> None:
    # exp(-F/2) sqrt(2 pi / h) / w with h = 400, w = 3.
    expected = -2.5 + np.log(np.sqrt(2.0 * np.pi / 400.0) / 3.0)
    h, w = np.array([[400.0]]), np.array([3.0])
    assert log_evidence(5.0, h, w) == pytest.approx(expected)
    inside = log_evidence(5.0, h, w, box=np.array([[-1.5, 1.5]]))
    assert inside == pytest.approx(expected, abs=1e-5)  # 30 deviations to the bounds


def test_a_parameter_without_effect_neither_helps_nor_costs() -> None:
    h, w = np.array([[400.0, 0.0], [0.0, 0.0]]), np.array([3.0, 2.0])
    box = np.array([[-1.5, 1.5], [-0.5, 1.5]])
    alone = log_evidence(5.0, h[:1, :1], w[:1], box=box[:1])
    assert log_evidence(5.0, h, w, box=box) == pytest.approx(alone, abs=1e-5)
    assert log_evidence(5.0, h, w) == pytest.approx(log_evidence(5.0, h[:1, :1], w[:1]))


@pytest.mark.parametrize("slope", [0.0, 5.0, 60.0])
def test_a_best_point_on_a_bound_counts_what_is_within_it(slope: float) -> None:
    h, w, box = np.array([[50.0]]), np.array([2.0]), np.array([[0.0, 2.0]])
    whole = quad(lambda d: np.exp(-slope * d - 25.0 * d**2), 0.0, 2.0, epsabs=1e-14)[0]
    found = log_evidence(3.0, h, w, gradient=np.array([slope]), box=box)
    assert found == pytest.approx(-1.5 + np.log(whole / 2.0), abs=1e-4)


def test_two_correlated_parameters_are_integrated_within_their_bounds() -> None:
    h, g = np.array([[30.0, 20.0], [20.0, 25.0]]), np.array([3.0, -4.0])
    box, w = np.array([[-0.1, 0.9], [-0.2, 0.3]]), np.array([1.0, 0.5])

    def density(y: float, x: float) -> float:
        d = np.array([x, y])
        return float(np.exp(-0.5 * (2.0 * g @ d + d @ h @ d)))

    whole = dblquad(density, *box[0], *box[1])[0]
    found = log_evidence(0.0, h, w, gradient=g, box=box)
    assert found == pytest.approx(np.log(whole / w.prod()), abs=0.02)  # of 1024 points


def test_a_misfit_beyond_noise_distinguishes_models_less() -> None:
    h, w = np.array([[400.0]]), np.array([3.0])
    gap = [log_evidence(f, h, w, scale=4.0) for f in (100.0, 108.0)]
    assert gap[0] - gap[1] == pytest.approx(1.0)  # 8 / 2 / 4


def test_probabilities_add_up_and_follow_their_prior() -> None:
    found = probabilities([-1000.0, -1002.0])
    assert found == pytest.approx([1 / (1 + np.exp(-2.0)), 1 / (1 + np.exp(2.0))])
    assert probabilities([0.0, 0.0], np.array([0.9, 0.1])) == pytest.approx([0.9, 0.1])
