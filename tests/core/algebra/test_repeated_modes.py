"""The basis of repeated modes is that of their space, whichever basis comes in."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.stats import ortho_group

from modetune.core.algebra.repeated_modes import canonical_rotation
from modetune.core.modes import Floats


def ring(n: int) -> tuple[Floats, Floats]:
    """Masses on a ring, with springs to their neighbours and to ground: pairs of equal modes."""
    k = 2.5 * np.eye(n) - np.roll(np.eye(n), 1, axis=0) - np.roll(np.eye(n), -1, axis=0)
    return np.asarray(k), np.eye(n)


def three_axes(n: int) -> tuple[Floats, Floats]:
    """A chain that moves alike along x, y and z: triples of equal modes."""
    chain = 2.0 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    return np.asarray(np.kron(chain, np.eye(3)), dtype=float), np.diag(
        np.repeat(np.arange(1.0, n + 1.0), 3)
    )


def grillage(n: int) -> tuple[Floats, Floats]:
    """A square membrane of n by n points: modes (j, k) and (k, j) are equal."""
    line = 2.0 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    k = np.kron(line, np.eye(n)) + np.kron(np.eye(n), line)
    return np.asarray(k, dtype=float), np.eye(n * n)


@pytest.mark.parametrize(("model", "n"), [(ring, 9), (three_axes, 5), (grillage, 5)])
def test_the_basis_does_not_depend_on_the_one_that_comes_in(
    model: Callable[[int], tuple[Floats, Floats]], n: int
) -> None:
    k, m = model(n)
    rng = np.random.default_rng(1)
    eigenvalues, shapes = eigh(k, m)
    wanted = shapes @ canonical_rotation(eigenvalues, shapes)
    for _ in range(20):
        turned = shapes.copy()
        at = 0
        while at < eigenvalues.size:  # every set of equal ones, in another basis
            size = int(np.sum(np.abs(eigenvalues - eigenvalues[at]) < 1e-9))
            if size > 1:
                turned[:, at : at + size] @= ortho_group.rvs(size, random_state=rng)
            at += size
        found = turned @ canonical_rotation(eigenvalues, turned)
        repeated = np.abs(np.diff(eigenvalues)) < 1e-9
        members = np.flatnonzero(np.r_[False, repeated] | np.r_[repeated, False])
        assert members.size >= 4
        np.testing.assert_allclose(found[:, members], wanted[:, members], atol=1e-8)
    np.testing.assert_allclose(wanted.T @ m @ wanted, np.eye(k.shape[0]), atol=1e-12)
    np.testing.assert_allclose(k @ wanted, m @ wanted * eigenvalues, atol=1e-10)


def test_other_modes_keep_their_shapes() -> None:
    eigenvalues = np.array([1.0, 1.0 + 1e-6, 2.0])
    np.testing.assert_array_equal(canonical_rotation(eigenvalues, np.eye(3)), np.eye(3))


def test_modes_that_no_sensor_sees_stay_as_they_are() -> None:
    shapes = np.zeros((2, 3))
    shapes[:, 0] = [1.0, 2.0]
    rotation = canonical_rotation(np.ones(3), shapes)
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(shapes @ rotation, shapes, atol=1e-14)
