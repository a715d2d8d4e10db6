"""Displacements as sums over equations, by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import sparse

from modetune.core.algebra.matrices import DependentDofs, MatrixResult
from modetune.core.updating.observation import from_rows, nothing_known, observe

NODES = np.array([1, 1, 2, 7, 7])
COMPONENTS = np.array([1, 3, 2, 1, 1])
NOTHING = sparse.csr_array((5, 5))
MATRICES = MatrixResult(NOTHING, NOTHING, NODES, COMPONENTS)


def test_a_name_is_its_first_equation_and_one_without_is_held() -> None:
    seen = observe(MATRICES, np.array([7, 1, 2, 9]), np.array([1, 3, 1, 1]))
    np.testing.assert_array_equal(
        seen.matrix.toarray(), [[0, 0, 0, 1, 0], [0, 1, 0, 0, 0], [0] * 5, [0] * 5]
    )
    assert not seen.unknown.any()
    assert seen.held.tolist() == [False, False, True, True]


def test_what_was_eliminated_is_its_sum_of_equations() -> None:
    sums = np.array([[0.0, 0.5, 0.0, 0.5, 0.0], [0.0] * 5])
    dependent = DependentDofs(np.array([9, 9]), np.array([1, 2]), sparse.csr_array(sums))
    held = replace(MATRICES, dependent=dependent)
    seen = observe(held, np.array([9, 2, 9]), np.array([1, 2, 2]))
    np.testing.assert_array_equal(seen.matrix.toarray(), [sums[0], [0, 0, 1, 0, 0], [0] * 5])
    assert seen.held.tolist() == [False, False, True]


def test_rows_without_weights_are_held_and_those_not_told_are_unknown() -> None:
    seen = from_rows([{3: 0.5, 1: 0.25}, {}, None], 5)
    np.testing.assert_array_equal(seen.matrix.toarray()[0], [0, 0.25, 0, 0.5, 0])
    assert seen.held.tolist() == [False, True, False]
    assert seen.unknown.tolist() == [False, False, True]


def test_turned_displacements_are_unknown_where_a_part_is() -> None:
    seen = from_rows([{0: 1.0}, {}, None], 2)
    turn = sparse.csr_array(np.array([[0.6, 0.8, 0.0], [0.0, 1.0, 0.0], [0.6, 0.0, 0.8]]))
    turned = seen.turned(turn)
    np.testing.assert_array_equal(turned.matrix.toarray(), [[0.6, 0.0], [0.0, 0.0], [0.0, 0.0]])
    assert turned.held.tolist() == [False, True, False]
    assert turned.unknown.tolist() == [False, False, True]


def test_nothing_known_is_all_unknown() -> None:
    seen = nothing_known(3, 5)
    assert seen.unknown.all()
    assert not seen.held.any()
    assert seen.matrix.shape == (3, 5)
