"""Motions that are no unknowns made unknowns: the same model in other coordinates."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import linalg, sparse

from modetune.core.condensation.measured_unknowns import measured_model
from modetune.core.condensation.reduction import guyan
from modetune.core.errors import ModesError
from tests.core.condensation.test_reduction import cantilever, chain


def test_sensors_at_unknowns_change_nothing() -> None:
    k, m = chain(6)
    seen = sparse.csr_array(sparse.eye_array(6))[[4, 1]]
    found = measured_model(k, m, sparse.csr_array(seen))
    assert found.rows.tolist() == [4, 1]
    assert abs(found.back - sparse.eye_array(6)).max() == 0.0
    assert abs(found.stiffness - k).max() == 0.0


def test_what_is_seen_is_an_unknown_and_eigenvalues_stay() -> None:
    k, m = cantilever(5)
    random = np.random.default_rng(4)
    seen = random.normal(size=(4, 10)) * (random.uniform(size=(4, 10)) < 0.4)
    seen[:, 2] = [1.0, 0.5, -0.3, 2.0]
    found = measured_model(k, m, sparse.csr_array(seen))
    np.testing.assert_allclose(seen @ found.back.toarray(), np.eye(10)[found.rows], atol=1e-12)
    before = linalg.eigh(k.toarray(), m.toarray(), eigvals_only=True)
    after = linalg.eigh(found.stiffness.toarray(), found.mass.toarray(), eigvals_only=True)
    np.testing.assert_allclose(after, before, rtol=1e-8)  # condition of P squared, times eps


def test_static_motion_between_inclined_sensors_costs_least_energy() -> None:
    k, m = cantilever(6)
    seen = np.zeros((2, 12))
    seen[0, [4, 5]], seen[1, [10, 11]] = (0.8, 0.6), (1.0, -0.2)
    found = measured_model(k, m, sparse.csr_array(seen))
    reduced = guyan(found.stiffness, found.mass, found.rows)
    # Lagrange: stiffness at the sensors is the inverse of the flexibility W K^-1 W^T.
    flexibility = seen @ np.linalg.solve(k.toarray(), seen.T)
    np.testing.assert_allclose(reduced.stiffness @ flexibility, np.eye(2), atol=1e-10)
    motion = found.back @ reduced.transformation
    np.testing.assert_allclose(seen @ motion, np.eye(2), atol=1e-12)


def test_sensors_that_follow_from_each_other_are_refused() -> None:
    k, m = chain(5)
    seen = np.zeros((3, 5))
    seen[0, 1], seen[1, 2], seen[2, [1, 2]] = 1.0, 1.0, (0.6, 0.8)
    with pytest.raises(ModesError, match="3 measured unknowns have 2 that do not follow"):
        measured_model(k, m, sparse.csr_array(seen))
