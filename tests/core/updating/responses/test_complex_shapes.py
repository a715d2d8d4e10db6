"""Complex shapes: derivatives by central differences, and what scale and phase leave alone."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy import linalg, sparse

from modetune.core.algebra.matrices import MatrixResult
from modetune.core.modes import MeasuredModes, mode_set
from modetune.core.updating.damped_pairs import DampedPairs
from modetune.core.updating.damping_model import Damper, DampingModel, Linear
from modetune.core.updating.parameter_matrices import Powers, parameter_matrices
from modetune.core.updating.responses.complex_shapes import ComplexShapes
from modetune.core.updating.responses.response import MatricesAt

N, SEEN = 6, (0, 2, 3, 5)


def spring(i: int, j: int) -> Any:
    row = np.zeros(N)
    row[i], row[j] = 1.0, -1.0 if j != i else 1.0
    return np.outer(row, row)


K = 900.0 * spring(0, 0) + sum((900.0 + 80.0 * i) * spring(i, i - 1) for i in range(1, N))
M = np.diag(np.linspace(1.0, 2.0, N))
BASE = MatrixResult.of_full(
    sparse.csr_array(K), sparse.csr_array(M), np.arange(1, N + 1), np.ones(N, dtype=np.int64)
)
SPRING = sparse.csr_array(np.triu(980.0 * spring(2, 1)))
MODEL = parameter_matrices(BASE, np.ones(2), [Powers(0, (1,), (SPRING,))], [])
DAMPING = DampingModel((Damper("viscous", sparse.csr_array(spring(4, 3)), (Linear(0.0, 6.0, 1),)),))


def observe(here: MatrixResult) -> sparse.csr_array:
    return sparse.csr_array(np.eye(N)[list(SEEN)])


def at(theta: Any, shapes: Any) -> tuple[ComplexShapes, Any]:
    """The response of a test with these shapes of the first three modes, and the model's state."""
    hz = np.sqrt(linalg.eigh(K, M, eigvals_only=True)[:3]) / (2.0 * np.pi)
    test = MeasuredModes((1, 2, 3), mode_set(hz, np.zeros((0, 3)), (), (), np.full(3, 0.01)))
    state: Any = SimpleNamespace(
        test=test,
        numbers=[1, 2, 3],
        pairing=SimpleNamespace(measured=np.arange(3), computed=np.arange(3)),
        modal=SimpleNamespace(n_rigid=0),
        matrices=MatricesAt(MODEL, np.asarray(theta)),
    )
    weights = dict.fromkeys((1, 2, 3), 1.0)
    pairs = DampedPairs(lambda base: DAMPING)
    return ComplexShapes(shapes, observe, weights, 0.05, 0.9, pairs), state


def shapes_at(theta: Any) -> Any:
    response, state = at(theta, np.zeros((4, 3)))
    return np.asarray(observe(BASE) @ response.pairs.of(state).modes.shapes)


def test_derivatives_are_central_differences() -> None:
    shapes, here, step = shapes_at([1.3, 2.0]), np.array([1.0, 1.0]), 1e-5
    response, state = at(here, shapes)
    asked: Any = SimpleNamespace(columns=(1, 0))
    found = response.sensitivity(state, asked)
    for place, column in enumerate(asked.columns):
        moved = [
            response.residual(at(here + sign * step * np.eye(2)[column], shapes)[1]).values
            for sign in (1.0, -1.0)
        ]
        wanted = -(moved[0] - moved[1]) / (2.0 * step)  # of the computed side
        np.testing.assert_allclose(found[:, place], wanted, atol=1e-7 * np.abs(wanted).max())


def test_scale_and_phase_of_the_test_leave_the_misfit_alone() -> None:
    shapes = shapes_at([1.2, 1.5])
    misfits = []
    for factor in (1.0, 3.0 * np.exp(0.7j), -0.2j):
        response, state = at([1.0, 1.0], factor * shapes)
        misfits.append(response.residual(state).misfit)
    np.testing.assert_allclose(misfits, misfits[0], rtol=1e-10)
    response, state = at([1.2, 1.5], shapes)
    assert response.residual(state).misfit < 1e-16
    real, state = at([1.2, 1.5], np.real(shapes).astype(np.complex128))
    assert real.residual(state).misfit > 1e-4  # what is out of phase counts
