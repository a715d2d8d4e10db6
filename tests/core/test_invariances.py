"""What must not change when close modes turn in their common space, or signs, scales, order do."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import sparse

from modetune.core.correlation.correlation import subspace_mac
from modetune.core.correlation.pairing import pair_by_shape
from modetune.core.modes import mode_set
from modetune.core.updating.direct_update import ReferenceModes, direct_matrix_update
from modetune.core.updating.sensitivity import nelson

#: Two equal chains side by side: every mode is a pair of equal frequency.
N = 5
CHAIN = 3.0 * np.eye(N) - np.diag(np.ones(N - 1), 1) - np.diag(np.ones(N - 1), -1)
MASSES = np.linspace(1.0, 2.0, N)
STIFFNESS = sparse.csr_array(sparse.block_diag([CHAIN, CHAIN]))
MASS = sparse.csr_array(sparse.block_diag([np.diag(MASSES), np.diag(MASSES)]))
NOTHING = sparse.csr_array((2 * N, 2 * N))
#: A spring at the second mass of the first chain alone.
CHANGE = sparse.csr_array(([1.0], ([1], [1])), shape=(2 * N, 2 * N))

ANGLES = st.floats(-np.pi, np.pi)
SEEDS = st.integers(0, 10_000)
SIGNS = st.lists(st.sampled_from([-1.0, 1.0]), min_size=2 * N, max_size=2 * N)
SCALES = st.lists(st.floats(1e-3, 1e3), min_size=2 * N, max_size=2 * N)


def pairs_of_modes() -> tuple[Any, Any]:
    """Eigenvalues (10,), each twice, and mass-normalised shapes; each in one chain only."""
    root = np.sqrt(MASSES)
    lam, vectors = np.linalg.eigh(CHAIN / np.outer(root, root))
    single = vectors / root[:, None]
    shapes = np.zeros((2 * N, 2 * N))
    shapes[:N, 0::2], shapes[N:, 1::2] = single, single
    return np.repeat(lam, 2), shapes


def turned(shapes: Any, angle: float) -> Any:
    """Every pair turned within its space."""
    c, s = np.cos(angle), np.sin(angle)
    whole = np.kron(np.eye(N), np.array([[c, -s], [s, c]]))
    return shapes @ whole


@given(ANGLES, SEEDS)
def test_subspace_mac_does_not_see_a_pair_turn(angle: float, seed: int) -> None:
    _, shapes = pairs_of_modes()
    shape = np.random.default_rng(seed).standard_normal(2 * N)
    before = subspace_mac(shape, shapes[:, :2])
    assert subspace_mac(shape, turned(shapes, angle)[:, :2]) == pytest.approx(before, abs=1e-12)


@given(ANGLES)
def test_the_sum_of_a_pairs_derivatives_does_not_see_it_turn(angle: float) -> None:
    lam, shapes = pairs_of_modes()
    rows = np.arange(2 * N)
    found = nelson(STIFFNESS, MASS, lam, turned(shapes, angle), [(CHANGE, NOTHING)], [2, 3], rows)
    # The trace of phi^T dK phi over the pair.
    assert found.eigenvalues.sum() == pytest.approx(shapes[1, 2] ** 2, rel=1e-9)


@given(ANGLES)
def test_a_modes_derivative_does_not_see_another_pair_turn(angle: float) -> None:
    lam, shapes = pairs_of_modes()
    pair = turned(shapes, angle)
    mixed = np.concatenate([pair[:, :2], shapes[:, 2:]], axis=1)
    rows = np.arange(2 * N)
    plain = nelson(STIFFNESS, MASS, lam, shapes, [(CHANGE, NOTHING)], [4], rows)
    other = nelson(STIFFNESS, MASS, lam, mixed, [(CHANGE, NOTHING)], [4], rows)
    np.testing.assert_allclose(other.mode_shapes, plain.mode_shapes, atol=1e-12)
    np.testing.assert_allclose(other.eigenvalues, plain.eigenvalues, atol=1e-12)


@given(ANGLES)
def test_a_turned_pair_is_still_found_in_its_space(angle: float) -> None:
    lam, shapes = pairs_of_modes()
    hz, nodes = np.sqrt(lam) / (2.0 * np.pi), np.arange(2 * N)
    measured = mode_set(hz, turned(shapes, angle), nodes, np.ones(2 * N))
    computed = mode_set(hz, shapes, nodes, np.ones(2 * N))
    pairing = pair_by_shape(measured, computed)
    assert (pairing.computed // 2 == pairing.measured // 2).all()
    np.testing.assert_allclose(pairing.subspace_mac, 1.0, atol=1e-12)


@given(st.permutations(range(N)), SIGNS, SCALES)
def test_pairs_do_not_depend_on_order_sign_or_scale(
    order: list[int], signs: list[float], scales: list[float]
) -> None:
    lam, shapes = pairs_of_modes()
    hz, single = np.sqrt(lam[0::2]) / (2.0 * np.pi), shapes[:N, 0::2]
    factors = np.array(signs[:N]) * np.array(scales[:N])
    computed = mode_set(hz[order], (single * factors)[:, order], np.arange(N), np.ones(N))
    pairing = pair_by_shape(mode_set(hz, single, np.arange(N), np.ones(N)), computed)
    assert [order[c] for c in pairing.computed.tolist()] == list(range(N))
    np.testing.assert_allclose(pairing.mac, 1.0)


@given(ANGLES, st.sampled_from([-1.0, 1.0]))
def test_a_direct_update_does_not_see_a_measured_pair_turn(angle: float, sign: float) -> None:
    # A pair of one frequency is imposed as a space, whichever of its shapes were measured.
    _, shapes = pairs_of_modes()
    hz, rows = np.array([0.3, 0.3, 0.4]), np.arange(2 * N)
    one, other = (
        direct_matrix_update(
            STIFFNESS,
            MASS,
            ReferenceModes(hz, np.column_stack([pair[:, :2], sign * shapes[:, 2]]), rows, "mass"),
        )
        for pair in (shapes, turned(shapes, angle))
    )
    np.testing.assert_allclose(
        other.stiffness_change.dense(), one.stiffness_change.dense(), atol=1e-11
    )
    np.testing.assert_allclose(other.mass_change.dense(), one.mass_change.dense(), atol=1e-11)
