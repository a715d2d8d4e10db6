"""Reduction: closed forms, bounds that hold for any masters, and MYSTRAN's own reduction."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import linalg, sparse

from modetune.core.condensation.reduction import (
    Reduction,
    craig_bampton,
    dynamic,
    guyan,
    irs,
    iterated_irs,
    reduced_modes,
    serep,
)
from modetune.core.errors import ModelError, ModesError
from tests.superlu import superlu_only

Method = Callable[[Any, Any, Any], Reduction]
METHODS: tuple[Method, ...] = (guyan, irs, iterated_irs)


def chain(n: int) -> tuple[sparse.csr_array, sparse.csr_array]:
    """Stiffness and mass of n masses in a row on uneven springs, the first held to ground."""
    springs = 1.0 + np.arange(n) % 3
    diagonal = springs + np.append(springs[1:], 0.0)
    off = -springs[1:]
    stiffness = sparse.diags_array([off, diagonal, off], offsets=[-1, 0, 1])
    return sparse.csr_array(stiffness), sparse.csr_array(sparse.diags_array(1.0 + np.arange(n) % 2))


def cantilever(n: int) -> tuple[sparse.csr_array, sparse.csr_array]:
    """n Euler beam elements of a cantilever of unit length, E I and mass; (w, theta) a node."""
    h = 1.0 / n
    k_e = np.array(
        [
            [12, 6 * h, -12, 6 * h],
            [6 * h, 4 * h**2, -6 * h, 2 * h**2],
            [-12, -6 * h, 12, -6 * h],
            [6 * h, 2 * h**2, -6 * h, 4 * h**2],
        ]
    ) / (h**3)
    m_e = np.array(
        [
            [156, 22 * h, 54, -13 * h],
            [22 * h, 4 * h**2, 13 * h, -3 * h**2],
            [54, 13 * h, 156, -22 * h],
            [-13 * h, -3 * h**2, -22 * h, 4 * h**2],
        ]
    ) * (h / 420.0)
    k, m = np.zeros((2 * n + 2, 2 * n + 2)), np.zeros((2 * n + 2, 2 * n + 2))
    for element in range(n):
        part = slice(2 * element, 2 * element + 4)
        k[part, part] += k_e
        m[part, part] += m_e
    return sparse.csr_array(k[2:, 2:]), sparse.csr_array(m[2:, 2:])


def eigenvalues(reduction: Reduction) -> Any:
    return linalg.eigh(reduction.stiffness, reduction.mass, eigvals_only=True)


def test_guyan_of_two_masses_gives_the_hand_calculation() -> None:
    stiffness, mass = np.array([[2.0, -1.0], [-1.0, 1.0]]), np.diag([4.0, 8.0])
    reduced = guyan(stiffness, mass, [1])
    # The slave follows by half: two unit springs in series, and a quarter of its mass.
    np.testing.assert_allclose(reduced.transformation, [[0.5], [1.0]])
    np.testing.assert_allclose(reduced.stiffness, [[0.5]])
    np.testing.assert_allclose(reduced.mass, [[9.0]])


def test_guyan_keeps_static_flexibility_at_the_masters() -> None:
    k, m = chain(30)
    masters = [4, 29, 11]
    flexibility = np.linalg.inv(k.toarray())[np.ix_(masters, masters)]
    np.testing.assert_allclose(np.linalg.inv(guyan(k, m, masters).stiffness), flexibility)


@pytest.mark.parametrize("mode", [0, 2, 5])
def test_dynamic_reduction_is_exact_at_its_frequency(mode: int) -> None:
    k, m = chain(20)
    lam, phi = linalg.eigh(k.toarray(), m.toarray())
    reduced = dynamic(k, m, [3, 9, 19], float(np.sqrt(lam[mode]) / (2.0 * np.pi)))
    at_masters = phi[reduced.masters, mode]
    force = (reduced.stiffness - lam[mode] * reduced.mass) @ at_masters
    np.testing.assert_allclose(force, 0.0, atol=1e-11)
    np.testing.assert_allclose(reduced.transformation @ at_masters, phi[:, mode], atol=1e-11)


def test_dynamic_reduction_at_rest_is_guyan() -> None:
    k, m = chain(12)
    at_rest, static = dynamic(k, m, [0, 5], 0.0), guyan(k, m, [0, 5])
    np.testing.assert_allclose(at_rest.mass, static.mass)
    np.testing.assert_allclose(at_rest.stiffness, static.stiffness)


def test_irs_is_the_formula_of_the_thesis_on_dense_matrices() -> None:
    k, m = chain(9)
    masters, slaves = [1, 4, 8], [0, 2, 3, 5, 6, 7]
    static = guyan(k, m, masters)
    # A (17): T_i = T_s + S M T_s M_r^-1 K_r with S the inverse of K_ss among zeros.
    s = np.zeros((9, 9))
    s[np.ix_(slaves, slaves)] = np.linalg.inv(k.toarray()[np.ix_(slaves, slaves)])
    t_s = static.transformation
    expected = t_s + s @ m @ t_s @ np.linalg.inv(static.mass) @ static.stiffness
    np.testing.assert_allclose(irs(k, m, masters).transformation, expected, atol=1e-12)


def test_each_method_comes_closer_to_the_cantilevers_closed_form() -> None:
    k, m = cantilever(20)
    masters = [10, 20, 30, 38]
    # Roots of cos x cosh x = -1 (Blevins 1979, table 8-1); eigenvalue x^4 for unit E I, mass.
    exact = np.array([1.87510407, 4.69409113]) ** 4
    static, improved = guyan(k, m, masters), irs(k, m, masters)
    iterated = iterated_irs(k, m, masters)
    errors = [np.abs(eigenvalues(one)[:2] / exact - 1.0) for one in (static, improved, iterated)]
    assert (errors[1] < 0.1 * errors[0]).all()
    assert iterated.converged
    assert (errors[2] < 5e-6).all()  # what 20 elements leave


def test_iterated_irs_reaches_the_lowest_modes_and_tells_when_it_did_not() -> None:
    k, m = chain(60)
    masters = [5, 20, 35, 50, 59]
    exact = linalg.eigh(k.toarray(), m.toarray(), eigvals_only=True)
    reduced = iterated_irs(k, m, masters, n_modes=3, tolerance=1e-12, max_iterations=200)
    assert reduced.converged
    np.testing.assert_allclose(eigenvalues(reduced)[:3], exact[:3], rtol=1e-7)
    assert not iterated_irs(k, m, masters, n_modes=5, max_iterations=2).converged


def test_serep_keeps_its_modes_exactly() -> None:
    k, m = cantilever(10)
    lam, phi = linalg.eigh(k.toarray(), m.toarray())
    reduced = serep(k, m, [4, 9, 14, 18], phi[:, :4])
    np.testing.assert_allclose(eigenvalues(reduced), lam[:4], rtol=1e-8)
    at_masters = phi[reduced.masters, :4]
    np.testing.assert_allclose(reduced.transformation @ at_masters, phi[:, :4], atol=1e-9)


def test_serep_of_fewer_modes_than_masters_has_their_rank() -> None:
    k, m = chain(15)
    lam, phi = linalg.eigh(k.toarray(), m.toarray())
    reduced = serep(k, m, [2, 5, 8, 11, 14], phi[:, :2])
    assert np.linalg.matrix_rank(reduced.mass, tol=1e-9) == 2
    at_masters = phi[reduced.masters, :2]
    modal = at_masters.T @ reduced.stiffness @ at_masters
    np.testing.assert_allclose(modal, np.diag(lam[:2]), atol=1e-13)


def test_serep_agrees_with_another_program(shared_data: Path) -> None:
    case = json.loads((shared_data / "refs/vibrationtesting_3dof.json").read_text())
    k, m = np.array(case["K"], dtype=float), np.array(case["M"], dtype=float)
    _, phi = linalg.eigh(k, m)
    masters = np.array(case["serep"]["masters_1based"]) - 1
    reduced = serep(k, m, masters, phi[:, : case["serep"]["modes_kept"]])
    # Slater's vibrationtesting, printed with 8 decimals.
    np.testing.assert_allclose(reduced.mass, case["serep"]["Mr"], atol=1e-8)
    np.testing.assert_allclose(reduced.stiffness, case["serep"]["Kr"], atol=1e-8)


@pytest.mark.parametrize("method", METHODS)
def test_a_model_of_masters_only_is_itself(method: Method) -> None:
    k, m = chain(6)
    order = [3, 1, 5, 0, 2, 4]
    reduced = method(k, m, order)
    np.testing.assert_allclose(reduced.stiffness, k.toarray()[np.ix_(order, order)])
    np.testing.assert_allclose(reduced.mass, m.toarray()[np.ix_(order, order)])


@given(masters=st.lists(st.integers(0, 19), min_size=1, max_size=8, unique=True))
def test_reduced_eigenvalues_never_lie_below_the_full_ones(masters: list[int]) -> None:
    k, m = chain(20)
    exact = linalg.eigh(k.toarray(), m.toarray(), eigvals_only=True)
    # Rayleigh and Ritz: T restricts the motion, so no eigenvalue falls.
    for method in (guyan, irs):
        assert (eigenvalues(method(k, m, masters)) >= exact[: len(masters)] * (1 - 1e-9)).all()


@given(masters=st.permutations([2, 7, 11, 16, 19]))
def test_the_order_of_masters_is_the_order_of_the_result(masters: list[int]) -> None:
    k, m = chain(20)
    plain, turned = irs(k, m, [2, 7, 11, 16, 19]), irs(k, m, masters)
    order = np.searchsorted([2, 7, 11, 16, 19], masters)
    np.testing.assert_allclose(turned.stiffness, plain.stiffness[np.ix_(order, order)], atol=1e-9)
    np.testing.assert_allclose(turned.transformation, plain.transformation[:, order], atol=1e-9)


def test_a_free_chain_keeps_its_rigid_motion() -> None:
    k = sparse.diags_array([[-1.0] * 9, [1.0] + [2.0] * 8 + [1.0], [-1.0] * 9], offsets=[-1, 0, 1])
    reduced = irs(k, sparse.eye_array(10), [0, 9])
    np.testing.assert_allclose(reduced.transformation.sum(axis=1), 1.0)
    assert np.ones(2) @ reduced.mass @ np.ones(2) == pytest.approx(10.0)
    assert eigenvalues(reduced)[0] == pytest.approx(0.0, abs=1e-12)


def test_both_solvers_reduce_alike() -> None:
    k, m = cantilever(30)
    one = irs(k, m, [10, 30, 58])
    with superlu_only():
        other = irs(k, m, [10, 30, 58])
    np.testing.assert_allclose(one.stiffness, other.stiffness, rtol=1e-7)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("masters", [[], [0, 0], [-1], [6], [0.5], [[0, 1]]])
def test_masters_that_are_no_rows_are_refused(method: Method, masters: Any) -> None:
    with pytest.raises(ModesError):
        method(*chain(6), masters)


@pytest.mark.parametrize("method", METHODS)
def test_matrices_that_are_no_model_are_refused(method: Method) -> None:
    k, m = chain(6)
    with pytest.raises(ModelError, match="not one model"):
        method(k, m[:5][:, :5], [0])
    with pytest.raises(ModelError, match="not finite"):
        method(k * np.nan, m, [0])
    with pytest.raises(ModelError, match="not symmetric"):
        method(sparse.triu(k), m, [0])
    with pytest.raises(ModelError, match="real"):
        method(k * 1j, m, [0])


def test_a_mechanism_among_the_slaves_is_an_error_with_its_condition() -> None:
    k = sparse.block_diag([chain(4)[0], np.array([[1.0, -1.0], [-1.0, 1.0]])])
    with pytest.raises(ModelError, match=r"1 masters held.*condition number"):
        guyan(k, sparse.eye_array(6), [0])


def test_dynamic_reduction_at_a_frequency_of_the_slaves_is_an_error() -> None:
    k, m = chain(6)
    inner = linalg.eigh(k.toarray()[:5, :5], m.toarray()[:5, :5], eigvals_only=True)
    with pytest.raises(ModelError, match="masters held"):
        dynamic(k, m, [5], float(np.sqrt(inner[1]) / (2.0 * np.pi)))
    with pytest.raises(ModesError, match="Hz"):
        dynamic(k, m, [5], -1.0)


def test_masters_without_inertia_are_an_error_of_irs() -> None:
    k, _ = chain(6)
    with pytest.raises(ModelError, match="no inertia"):
        irs(k, sparse.diags_array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]), [0, 5])


def test_modes_alike_at_the_masters_are_an_error_of_serep() -> None:
    k, m = chain(6)
    shapes = np.column_stack([np.arange(6.0), np.arange(6.0) ** 2, np.eye(6)[3]])
    with pytest.raises(ModesError, match="cannot be separated"):
        serep(k, m, [0, 1], shapes[:, :2] + 1.0)
    with pytest.raises(ModesError, match="does not move"):
        serep(k, m, [0, 1, 2], shapes)
    with pytest.raises(ModesError, match="are not real modes"):
        serep(k, m, [0, 1], shapes[:4])


def test_bad_settings_of_iterated_irs_are_refused() -> None:
    with pytest.raises(ModesError, match="settle"):
        iterated_irs(*chain(6), [0, 1], n_modes=3)


def test_guyan_reduction_of_an_aeroplane_is_mystrans(shared_data: Path) -> None:
    with np.load(shared_data / "garteur/mystran/gart_KM.npz") as file:
        shape = tuple(file["shape"].tolist())
        k = sparse.csr_array((file["KGG_data"], (file["KGG_row"], file["KGG_col"])), shape=shape)
        m = sparse.csr_array((file["MGG_data"], (file["MGG_row"], file["MGG_col"])), shape=shape)
    # Shell drilling rotations have no stiffness; MYSTRAN leaves them out on its own.
    active = np.flatnonzero(abs(k).sum(axis=1) > 0.0)
    with np.load(shared_data / "refs/mystran_garteur_guyan.npz") as file:
        unknowns = (6 * (file["aset_grids"] - 1)[:, None] + np.arange(3)).ravel()
        k_aa, m_aa, lam = file["KAA"], file["MAA"], file["lam"]
    masters = np.searchsorted(active, unknowns)
    k, m = k[active][:, active], m[active][:, active]
    static = guyan(k, m, masters)
    np.testing.assert_allclose(static.stiffness, k_aa, atol=1e-11 * np.abs(k_aa).max())
    np.testing.assert_allclose(static.mass, m_aa, atol=1e-11 * np.abs(m_aa).max())
    np.testing.assert_allclose(eigenvalues(static)[6:16], lam[6:16], rtol=1e-8)
    with np.load(shared_data / "garteur/mystran/gart_KM.npz") as file:
        full = file["lam"][6:16]
    # IRS takes off what Guyan adds, at every one of the ten lowest elastic modes.
    improved = eigenvalues(irs(k, m, masters))[6:16]
    assert (np.abs(improved / full - 1.0) < 0.01 * np.abs(lam[6:16] / full - 1.0)).all()


def test_all_fixed_modes_make_craig_and_bampton_exact_and_none_make_it_guyans() -> None:
    k, m = chain(9)
    masters = [8, 3]
    whole, static = craig_bampton(k, m, masters, 7), craig_bampton(k, m, masters, 0)
    full = linalg.eigh(k.toarray(), m.toarray(), eigvals_only=True)
    # Nothing is lost: the same space in other coordinates.
    np.testing.assert_allclose(eigenvalues(whole), full, rtol=1e-12)
    np.testing.assert_allclose(static.stiffness, guyan(k, m, masters).stiffness, rtol=1e-13)
    np.testing.assert_allclose(static.mass, guyan(k, m, masters).mass, rtol=1e-13)


def test_fixed_modes_do_not_couple_with_masters_in_stiffness() -> None:
    k, m = cantilever(8)
    reduced = craig_bampton(k, m, [14, 6], 4)
    held = np.delete(np.arange(16), [6, 14])
    inner = k.toarray()[np.ix_(held, held)], m.toarray()[np.ix_(held, held)]
    fixed = linalg.eigh(*inner, eigvals_only=True)[:4]
    size = np.abs(reduced.stiffness).max()
    np.testing.assert_allclose(reduced.stiffness[:2, 2:], 0.0, atol=1e-11 * size)
    np.testing.assert_allclose(reduced.stiffness[2:, 2:], np.diag(fixed), atol=1e-9 * fixed[-1])
    np.testing.assert_allclose(reduced.mass[2:, 2:], np.eye(4), atol=1e-10)
    with pytest.raises(ModesError, match="17 fixed-interface modes"):
        craig_bampton(k, m, [14, 6], 17)


def test_modes_of_a_reduced_model_are_ritz_modes_of_the_full_one() -> None:
    k, m = cantilever(8)
    shapes = linalg.eigh(k.toarray(), m.toarray())[1][:, :3]
    # Rank 3 at five masters: three modes, which SEREP keeps exactly.
    found, phi = reduced_modes(serep(k, m, [0, 4, 8, 12, 14], shapes))
    full = linalg.eigh(k.toarray(), m.toarray(), eigvals_only=True)
    np.testing.assert_allclose(found, full[:3], rtol=1e-7)
    np.testing.assert_allclose(np.abs(phi.T @ (m @ shapes)), np.eye(3), atol=1e-6)
