"""Orders of elimination by METIS: permutations of any pattern, fewer entries, equal modes."""

from __future__ import annotations

import subprocess
import sys
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse

from modetune.core.algebra import elimination_order as orders
from modetune.core.algebra import factor_room as rooms
from modetune.core.algebra import pardiso
from modetune.core.algebra.eigen import ModeSolver
from modetune.core.algebra.elimination_order import elimination_order
from modetune.core.algebra.factorisation import filled_triangle
from modetune.core.algebra.matrices import upper_triangle
from modetune.core.algebra.pardiso import Pardiso
from modetune.core.algebra.pencil import shifted_pattern
from modetune.core.modes import Floats, Integers

pytest.importorskip("pymetis", reason="METIS is installed on x86_64 only")
pytestmark = pytest.mark.skipif(
    not pardiso.is_available(), reason="PARDISO is installed on x86_64 only"
)
Pair = tuple[sparse.csr_array, sparse.csr_array]


@pytest.fixture(autouse=True)
def small_models_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(orders, "SMALL", 0)


def elements(nodes: Integers, unknowns: int, stiffness: Floats, n_nodes: int) -> sparse.csr_array:
    """Both triangles of equal elements; nodes: (n_elements, n_corners); stiffness of each."""
    places = (unknowns * nodes[:, :, None] + np.arange(unknowns)).reshape(len(nodes), -1)
    size = places.shape[1]
    rows, columns = np.repeat(places, size, axis=1), np.tile(places, size)
    values = np.tile(stiffness.ravel(), len(nodes))
    whole = sparse.csr_array(
        (values, (rows.ravel(), columns.ravel())), shape=(unknowns * n_nodes,) * 2
    )
    whole.sum_duplicates()
    return whole


def bricks(shape: tuple[int, int, int]) -> Integers:
    """The eight nodes of each brick of a block with so many nodes along its edges."""
    number = np.arange(np.prod(shape)).reshape(shape)
    ends = [slice(None, -1), slice(1, None)]
    return np.stack([number[a, b, c].ravel() for a in ends for b in ends for c in ends], axis=1)


def energy(corners: Floats, unknowns: int, seed: int) -> Floats:
    """A stiffness without strain in rigid motion: springs of random direction between corners."""
    rng = np.random.default_rng(seed)
    count = unknowns * len(corners)
    found = np.zeros((count, count))
    for first in range(len(corners)):
        for second in range(first):
            for _ in range(unknowns):
                row = np.zeros((len(corners), unknowns))
                row[first] = rng.standard_normal(unknowns)
                row[second] = -row[first]
                found += np.outer(row, row)
    return found


def solid_bracket() -> Pair:
    """An angle bracket of bricks, its foot held."""
    shape = (16, 9, 14)
    nodes = bricks(shape)
    place = np.stack(np.unravel_index(np.arange(np.prod(shape)), shape), axis=1)
    inside = ((place[nodes, 0] <= 4) | (place[nodes, 2] <= 4)).all(axis=1)
    k = 1e4 * elements(nodes[inside], 3, energy(np.zeros((8, 3)), 3, 1), int(np.prod(shape)))
    used = np.isin(np.arange(np.prod(shape)), nodes[inside]) & (place[:, 2] > 0)
    kept = np.flatnonzero(np.repeat(used, 3))
    k = sparse.csr_array(k[kept][:, kept])
    return upper_triangle(k), sparse.csr_array(sparse.eye_array(kept.size))


def shell() -> Pair:
    """A plate in a plane of the axes, free: its bending is not coupled to its own plane, and the
    turning about its normal has a little stiffness and no mass."""
    side = 36
    number = np.arange(side * side).reshape(side, side)
    ends = [slice(None, -1), slice(1, None)]
    nodes = np.stack([number[a, b].ravel() for a in ends for b in ends], axis=1)
    coupled = np.zeros((6, 6), dtype=bool)
    for own in ([0, 1], [2, 3, 4], [5]):  # in the plane, across it, about the normal
        coupled[np.ix_(own, own)] = True
    stiffness = energy(np.zeros((4, 6)), 6, 2) * np.tile(coupled, (4, 4))
    k = sparse.csr_array(1e4 * elements(nodes, 6, stiffness, side * side))
    k.eliminate_zeros()
    mass = np.tile([1.0, 1.0, 1.0, 0.1, 0.1, 0.0], side * side)
    k = k + sparse.diags_array(np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 1.0], side * side))
    return upper_triangle(sparse.csr_array(k)), upper_triangle(
        sparse.csr_array(sparse.diags_array(mass))
    )


def stick() -> Pair:
    """A bar of beams along an axis, held at one end, with masses beside every tenth node."""
    n, length, stiff = 120, 0.1, 1e3
    k, m = np.zeros((6 * n, 6 * n)), np.zeros((6 * n, 6 * n))
    for node in range(n - 1):
        for along in (0, 3):  # along the axis and about it
            ends = np.array([6 * node + along, 6 * node + 6 + along])
            k[np.ix_(ends, ends)] += stiff * np.array([[1.0, -1.0], [-1.0, 1.0]])
        for across, turn, sign in ((1, 5, 1.0), (2, 4, -1.0)):
            own = [6 * node + across, 6 * node + turn, 6 * node + 6 + across, 6 * node + 6 + turn]
            a, b = 12.0 / length**2, sign * 6.0 / length
            beam = np.array([[a, b, -a, b], [b, 4, -b, 2], [-a, -b, a, -b], [b, 2, -b, 4]])
            k[np.ix_(own, own)] += stiff * length**2 * beam
    for node in range(1, n):
        first = 6 * node
        arm = 0.3 if node % 10 == 0 else 0.0
        about = np.array(
            [[0.0, 0.0, -arm], [0.0, 0.0, 0.0], [arm, 0.0, 0.0]]
        )  # x cross (0, arm, 0)
        block = np.block(
            [[np.eye(3), -about], [about.T * -1.0, about.T @ about + 0.01 * np.eye(3)]]
        )
        m[first : first + 6, first : first + 6] += 1e-3 * 0.5 * (block + block.T)
    return upper_triangle(sparse.csr_array(k[6:, 6:])), upper_triangle(sparse.csr_array(m[6:, 6:]))


@pytest.mark.parametrize("structure", [solid_bracket, shell, stick])
def test_modes_in_the_order_of_metis_are_those_in_another(
    structure: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    k, m = structure()  # type: ignore[operator]
    orders_given = []

    def spy(upper: sparse.csr_array) -> Integers | None:
        orders_given.append(elimination_order(upper))
        return orders_given[-1]

    monkeypatch.setattr(rooms, "elimination_order", spy)
    found = ModeSolver().solve(k, m, 12)
    monkeypatch.setattr(orders, "SMALL", k.shape[0])
    other = ModeSolver().solve(k, m, 12)
    assert [order is not None for order in orders_given] == [True, False]  # once for all values
    assert found.counted
    assert other.counted
    # Rounding of the largest eigenvalue, and what both bounds on residuals leave.
    inertia = m.diagonal()
    largest = float(np.max(k.diagonal()[inertia > 0.0] / inertia[inertia > 0.0]))
    np.testing.assert_allclose(
        found.eigenvalues, other.eigenvalues, rtol=1e-9, atol=1e-13 * largest
    )


def test_a_solid_block_has_fewer_entries_than_in_the_order_of_pardiso() -> None:
    shape = (13, 12, 11)
    block = elements(bricks(shape), 3, energy(np.zeros((8, 3)), 3, 3), int(np.prod(shape)))
    upper = filled_triangle(block)
    order = elimination_order(upper)
    assert order is not None
    assert Pardiso(upper, order=order).factor_entries < Pardiso(upper).factor_entries


def test_unknowns_of_a_point_are_eliminated_together() -> None:
    k, m = shell()
    upper = shifted_pattern(k, m)
    points = orders._first_of_points(upper)
    assert (
        points.size == 3 * 1296
    )  # in the plane, across it, about the normal: nothing couples them
    order = elimination_order(upper)
    assert order is not None
    place = np.argsort(order)
    for first, last in zip(points, [*points[1:], upper.shape[0]], strict=True):
        assert np.array_equal(np.diff(place[first:last]), np.ones(last - first - 1))


@settings(deadline=None, max_examples=60)
@given(
    st.integers(1, 40).flatmap(
        lambda n: st.tuples(
            st.just(n),
            st.lists(st.tuples(st.integers(0, n - 1), st.integers(0, n - 1)), max_size=3 * n),
        )
    )
)
def test_any_pattern_is_ordered_and_solved(drawn: tuple[int, list[tuple[int, int]]]) -> None:
    n, edges = drawn  # unknowns without an edge, points of one unknown, whole parts apart
    rows, columns = np.array(edges, dtype=int).reshape(-1, 2).T
    off = sparse.csr_array((-np.ones(rows.size), (rows, columns)), shape=(n, n))
    off = sparse.csr_array(off + off.T)
    whole = off + sparse.diags_array(1.0 - off.sum(axis=1) + abs(off.diagonal()))
    upper = filled_triangle(sparse.csr_array(whole))
    order = elimination_order(upper)
    if order is not None:
        assert sorted(order) == list(range(n))
    factors = Pardiso(upper, order=order)
    factors.refactor(upper.data)
    # Diagonally dominant: the inverse's largest sum is one.
    np.testing.assert_allclose(whole @ factors.solve(np.ones(n)), 1.0, rtol=1e-12)


def test_a_diagonal_matrix_and_one_unknown_have_no_order_of_their_own() -> None:
    for n in (1, 2, 50):
        assert elimination_order(filled_triangle(sparse.csr_array(np.eye(n)))) is None


def test_long_integers_take_the_same_order() -> None:
    k, m = solid_bracket()
    upper = sparse.csr_array(k + m)
    order = elimination_order(upper)
    entries = []
    for long_integers in (False, True):
        factors = Pardiso(upper, order=order, long_integers=long_integers)
        factors.refactor(upper.data)
        entries.append(factors.factor_entries)
        np.testing.assert_allclose(
            factors.solve(np.ones(upper.shape[0])), _direct(upper), rtol=1e-9, atol=1e-12
        )
    assert entries[0] == entries[1]


def _direct(upper: sparse.csr_array) -> Floats:
    whole = sparse.csc_array(upper + sparse.triu(upper, 1).T)
    return np.asarray(sparse.linalg.spsolve(whole, np.ones(upper.shape[0])))


#: Orders a grid again and again until it is interrupted.
ENDLESS = """
import signal, sys
from scipy import sparse
from modetune.core.algebra.elimination_order import elimination_order
signal.signal(signal.SIGTERM, signal.default_int_handler)
line = sparse.diags([1.0, 1.0, 1.0], [-1, 0, 1], shape=(40, 40))
grid = sparse.triu(sparse.kron(sparse.kron(line, line), line), format="csr")
grid.sort_indices()
print("ready", flush=True)
try:
    while elimination_order(sparse.csr_array(grid)) is not None:
        pass
except KeyboardInterrupt:
    sys.exit(130)
"""


def test_sigterm_during_an_order_is_an_interruption() -> None:
    for wait_s in (0.3, 0.6):
        with subprocess.Popen(
            [sys.executable, "-c", ENDLESS], stdout=subprocess.PIPE, text=True
        ) as child:
            assert child.stdout is not None
            assert child.stdout.readline() == "ready\n"
            time.sleep(wait_s)
            child.terminate()
            assert child.wait(60.0) == 130
