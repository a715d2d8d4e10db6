"""Parameters told apart in one stored state of a model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import sparse

from modetune.core.algebra.matrices import MatrixResult, symmetric
from modetune.core.errors import ModelError
from modetune.core.updating.parameter_matrices import ROUNDING, differences, remainder, separate
from tests.core.matrix_decks import bar, bracket, matrices_of, plates


def test_parts_from_one_job_are_those_from_a_job_each(tmp_path: Path) -> None:
    deck, node_groups = bar([1.0, 1.0, 1.0], held=False)
    base = matrices_of(deck, tmp_path)
    both = differences(base, matrices_of(bar([2.0, 1.0, 2.0], held=False)[0], tmp_path))[0]
    ends = [node_groups[0], node_groups[2]]
    assert base.nodes.max() > max(max(nodes) for nodes in node_groups)  # incompatible modes
    apart = separate(both, base.nodes, ends)
    for found, moduli in zip(apart, ([2.0, 1.0, 1.0], [1.0, 1.0, 2.0]), strict=True):
        alone = differences(base, matrices_of(bar(moduli, held=False)[0], tmp_path))[0]
        np.testing.assert_array_equal(found.toarray(), alone.toarray())
    assert apart[0].nnz + apart[1].nnz == both.nnz
    # Rigid motion strains no element, to the rounding of the text in the difference.
    sideways = (base.components == 2) & np.isin(base.nodes, list(frozenset().union(*node_groups)))
    for part in apart:
        forces = symmetric(part) @ sideways.astype(np.float64)
        assert np.abs(forces).max() < 1e-11 * np.abs(part.data).max()


def test_moduli_and_densities_of_one_job_are_in_different_matrices(tmp_path: Path) -> None:
    deck, node_groups = bar([1.0, 1.0])
    base = matrices_of(deck, tmp_path)
    other = matrices_of(bar([2.0, 1.0], [1.0, 2.0])[0], tmp_path)
    stiffness, mass = differences(base, other)
    (stiff,), (heavy,) = (
        separate(part, base.nodes, [nodes])
        for part, nodes in zip((stiffness, mass), node_groups, strict=True)
    )
    assert stiff.nnz == stiffness.nnz
    assert heavy.nnz == mass.nnz


def test_the_last_part_is_what_the_others_leave(tmp_path: Path) -> None:
    deck, node_groups = bar([1.5, 1.0, 2.0])
    base = matrices_of(deck, tmp_path)
    middle = differences(base, matrices_of(bar([1.5, 2.0, 2.0])[0], tmp_path))[0]
    rest = remainder(base.upper_stiffness, [(1.0, middle)])
    found = separate(rest, base.nodes, [node_groups[0], node_groups[2]])
    size = np.sqrt(base.upper_stiffness.diagonal())
    for part, value, moduli in zip(
        found, (1.5, 2.0), ([2.5, 1.0, 2.0], [1.5, 1.0, 3.0]), strict=True
    ):
        own = differences(base, matrices_of(bar(moduli)[0], tmp_path))[0]
        apart = (part / value - own).toarray() / np.outer(size, size)
        assert np.abs(apart).max() < 1e-12  # two differences of text of 14 digits


@pytest.mark.parametrize("dust", [0.0, 1e-13, 1e-12])
@pytest.mark.parametrize("taken", [(1,), (0, 1), (0, 2), (0, 1, 2)])
def test_rounding_of_coordinates_leaves_no_change_where_nothing_changed(
    dust: float, taken: tuple[int, ...], tmp_path: Path
) -> None:
    """Entries that are zero on the ideal mesh are 1e-13 of the diagonal on this one: those below
    what is seen of a change must not be seen in the remainder, outside of what is left."""
    deck, nodes = bracket([1.0, 1.0, 1.0], dust)
    base = matrices_of(deck, tmp_path)
    found = []
    for part in taken:
        moduli = [2.0 if place == part else 1.0 for place in range(3)]
        change = differences(base, matrices_of(bracket(moduli, dust)[0], tmp_path))[0]
        found += separate(change, base.nodes, [nodes[part]], base.upper_stiffness)
    rest = remainder(base.upper_stiffness, [(1.0, part) for part in found])
    left = [nodes[place] for place in range(3) if place not in taken]
    parts = separate(rest, base.nodes, left, base.upper_stiffness)
    assert sum(part.nnz for part in parts) == rest.nnz
    assert bool(rest.nnz) == bool(left)


def test_shells_that_become_unequal_have_other_equations(tmp_path: Path) -> None:
    base = matrices_of(plates((2.0, 2.0), 0.0), tmp_path)
    other = matrices_of(plates((2.2, 2.0), 0.0), tmp_path)
    with pytest.raises(ModelError, match="shells of equal thickness become unequal"):
        differences(base, other)


def chain(n: int = 8) -> MatrixResult:
    k = sparse.csr_array(2.0 * np.eye(n) - np.eye(n, k=1))
    names = np.arange(1, n + 1), np.ones(n, dtype=np.int64)
    return MatrixResult(k, sparse.csr_array(np.eye(n)), *names)


def moved(base: MatrixResult, changes: dict[tuple[int, int], float]) -> MatrixResult:
    rows, columns = np.array(list(changes)).T
    change = sparse.coo_array((list(changes.values()), (rows, columns)), shape=(8, 8))
    return replace(base, upper_stiffness=sparse.csr_array(base.upper_stiffness + change.tocsr()))


def test_rounding_in_the_last_digit_joins_nothing_and_small_parts_are_kept() -> None:
    small = 1e-9
    spring = {(0, 0): small, (0, 1): -small, (1, 1): small}
    # Off by the rounding of two matrices whose diagonal is 2.
    off = 0.9 * 2 * ROUNDING * 2.0
    dust = {(1, 2): off, (2, 2): -off, (2, 3): off, (5, 5): 1.0}
    found = differences(chain(), moved(chain(), {**spring, **dust}))[0]
    assert found.nnz == 4
    first, second = separate(found, chain().nodes, [frozenset({1, 2}), frozenset({6})])
    np.testing.assert_allclose(first.toarray()[:2, :2], [[small, -small], [0, small]], rtol=1e-6)
    assert (first.nnz, second.nnz) == (3, 1)


def test_unnamed_unknowns_go_with_what_they_are_joined_to() -> None:
    change = moved(chain(), {(1, 1): 1.0, (1, 7): 0.5, (7, 7): 1.0, (4, 4): 1.0, (4, 6): 1.0})
    found = differences(chain(), change)[0]
    first, second = separate(found, chain().nodes, [frozenset({2}), frozenset({5})])
    assert (first.nnz, second.nnz) == (3, 2)


def test_changes_that_belong_to_no_parameter_or_to_two_are_refused() -> None:
    one, other = frozenset({1, 2}), frozenset({5, 6})
    found = differences(chain(), moved(chain(), {(0, 0): 1.0, (7, 7): 1.0}))[0]
    with pytest.raises(ModelError, match="changed at node 8, which is not joined"):
        separate(found, chain().nodes, [one, other])
    found = differences(chain(), moved(chain(), {(0, 0): 1.0, (0, 5): 1.0, (5, 5): 1.0}))[0]
    with pytest.raises(ModelError, match="changed at node 1 by two parameters"):
        separate(found, chain().nodes, [one, other])
    with pytest.raises(ModelError, match="parameters 0 and 1 of one matrix job share node 2"):
        separate(found, chain().nodes, [one, frozenset({2})])


def test_what_is_left_without_any_part_does_not_touch_the_triangle() -> None:
    upper = sparse.csr_array(np.array([[2.0, 1e-30], [0.0, 2.0]]))
    left = remainder(upper, [])
    assert left.nnz == 2  # rounding beside the diagonal has gone
    assert (upper.nnz, upper.indices.size, upper.data.size) == (3, 3, 3)
