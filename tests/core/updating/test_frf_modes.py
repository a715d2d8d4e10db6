"""Response functions with modal damping beside (K - w^2 M + i w C)^-1 of full matrices."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import sparse

from modetune.core.algebra.matrices import MatrixResult
from modetune.core.measurement.response_functions import Complexes
from modetune.core.modes import Floats
from modetune.core.updating.damping_model import Damper, DampingModel, GroupStiffness, Linear, Loss
from modetune.core.updating.frf_modes import FrfModes, near
from modetune.core.updating.parameter_matrices import Powers, parameter_matrices
from modetune.core.updating.responses.frf import DampedMatrices
from modetune.core.updating.responses.response import MatricesAt

SIZE = 400
DOFS = np.array([3, 100, 250])
THETA = np.array([1.2, 0.8])
#: Ratios of the lowest modes, and of all others.
RATIOS, REST = (0.01, 0.02, 0.005, 0.03, 0.01, 0.012, 0.02, 0.02), 0.01


def chain(theta: Floats, free: bool) -> tuple[Floats, Floats]:
    """400 masses; theta: of the stiffness of the first 150 springs, the mass of the last 200."""
    springs = np.full(SIZE + 1, 1e7)
    springs[:150] *= theta[0]
    if free:
        springs[[0, -1]] = 0.0
    stiffness = np.diag(springs[:-1] + springs[1:])
    stiffness -= np.diag(springs[1:-1], 1) + np.diag(springs[1:-1], -1)
    masses = np.ones(SIZE)
    masses[200:] *= theta[1]
    return stiffness, masses


def direct(theta: Floats, free: bool, omega: Floats) -> Complexes:
    """Receptances (n_lines, n_dofs, n_dofs) with the damping matrix of modal ratios."""
    stiffness, masses = chain(theta, free)
    root = np.sqrt(masses)
    lam, turned = np.linalg.eigh(stiffness / np.outer(root, root))
    ratios = np.full(SIZE, REST)
    ratios[: len(RATIOS)] = RATIOS
    ratios[0] *= not free
    moving = root[:, None] * turned
    damping = (moving * (2.0 * ratios * np.sqrt(np.maximum(lam, 0.0)))) @ moving.T
    forces = np.eye(SIZE)[:, DOFS]
    return np.array(
        [
            np.linalg.solve(stiffness - w**2 * np.diag(masses) + 1j * w * damping, forces)[DOFS]
            for w in omega
        ]
    )


@pytest.mark.parametrize("free", [False, True])
def test_values_and_derivatives_are_those_of_full_matrices(free: bool) -> None:
    stiffness, masses = chain(THETA, free)
    hz = 1e7**0.5 / SIZE / 2.0 * np.linspace(0.7, 7.5, 7)  # between the modes of a uniform chain
    omega = 2.0 * np.pi * hz
    matrices = MatrixResult.of_full(
        sparse.csr_array(stiffness),
        sparse.diags_array(masses).tocsr(),
        np.arange(SIZE),
        np.ones(SIZE, dtype=np.int64),
    )
    dofs = sparse.csr_array(np.eye(SIZE)[DOFS])
    modes = FrfModes.of(matrices, dofs, float(hz[-1]), 8)
    ratios = np.full(modes.tau.size, REST)
    ratios[: len(RATIOS)] = RATIOS
    modes = modes.damped(ratios)
    exact = direct(THETA, free, omega)
    pairs = [(j, k) for j in range(DOFS.size) for k in range(DOFS.size)]
    found = np.stack([modes.lines(omega, j, k).receptance for j, k in pairs], axis=1)
    whole = exact.reshape(omega.size, -1)
    scale = np.abs(whole).max(axis=0)
    # The first that is left out answers with (w / w_r)^2 of its square, after residual vectors.
    assert np.abs(found - whole).max(axis=0) == pytest.approx(np.zeros(9), abs=2e-4 * scale.max())
    step = 1e-4
    for column in range(2):
        moved = step * np.eye(2)[column]
        ahead, behind = chain(THETA + moved, free), chain(THETA - moved, free)
        d_stiffness = sparse.csr_array(np.triu(ahead[0] - behind[0]) / (2.0 * step))
        d_mass = sparse.diags_array((ahead[1] - behind[1]) / (2.0 * step)).tocsr()
        change = modes.change(d_stiffness, d_mass)
        slopes = np.stack([modes.lines(omega, j, k).slope(change) for j, k in pairs], axis=1)
        both = direct(THETA + moved, free, omega) - direct(THETA - moved, free, omega)
        wanted = both.reshape(omega.size, -1) / (2.0 * step)
        assert np.abs(slopes - wanted).max() < 1e-3 * np.abs(wanted).max()


def test_repeated_modes_have_finite_derivatives() -> None:
    """Two equal oscillators: d(1 / (k - w^2 m + i w c))/dk of each is the closed form."""
    base = MatrixResult.of_full(
        sparse.csr_array(np.diag([4.0, 4.0, 50.0])),
        sparse.csr_array(np.eye(3)),
        np.arange(3),
        np.ones(3, dtype=np.int64),
    )
    modes = FrfModes.of(base, sparse.csr_array(np.eye(3)), 0.4, 3).damped(np.full(3, 0.05))
    omega = np.array([1.0, 2.0])
    change = modes.change(sparse.csr_array(np.diag([1.0, 0.0, 0.0])), sparse.csr_array((3, 3)))
    gain = 1.0 / (4.0 - omega**2 + 2j * 0.05 * 2.0 * omega)
    # of k and of c = 2 zeta sqrt(k m)
    wanted = -(gain**2) * (1.0 + 1j * omega * 0.05 / 2.0)
    assert modes.lines(omega, 0, 0).slope(change) == pytest.approx(wanted, rel=1e-9)
    assert modes.lines(omega, 1, 1).slope(change) == pytest.approx(np.zeros(2), abs=1e-9)
    # of zeta of both: c = 4 zeta
    both = modes.lines(omega, 0, 0).slope_by_damping(np.array([1.0, 1.0, 0.0]))
    assert both == pytest.approx(-(gain**2) * 4j * omega, rel=1e-9)


def membrane(theta: Complexes) -> tuple[Complexes, Complexes]:
    """Nine masses in a square net held around it, whose modes come in pairs; theta: stiffness of
    all strings, and mass of one corner and stiffness of one string, which part the pairs."""
    stiffness = np.zeros((25, 25), dtype=np.complex128)
    for row in range(5):
        for column in range(5):
            for other in ((row, column + 1), (row + 1, column)):
                if max(other) < 5:
                    ends = np.array([5 * row + column, 5 * other[0] + other[1]])
                    k = 4e3 * theta[0] * (theta[2] if (row, column) == (1, 1) else 1.0)
                    stiffness[np.ix_(ends, ends)] += k * np.array([[1, -1], [-1, 1]])
    inner = [5 * row + column for row in (1, 2, 3) for column in (1, 2, 3)]
    masses = np.ones(9, dtype=np.complex128)
    masses[0] = theta[1]
    return stiffness[np.ix_(inner, inner)], masses


def damped_membrane(theta: Complexes, omega: Floats) -> Complexes:
    """H of sensors 0 and 5 by a force at 1, real parts and then imaginary ones, (n_lines, 4).

    With one ratio of all modes C = 2 zeta R (R^-1 K R^-1)^(1/2) R, R^2 = M: analytic in theta also
    where modes coincide, and so is Denman and Beavers' iteration for it. (A + i B)^-1 is that of a
    real matrix of twice the size, so parts of a complex H can be stepped with a complex theta.
    """
    stiffness, masses = membrane(theta)
    root = np.sqrt(masses)
    square: NDArray[Any] = stiffness / np.outer(root, root)
    inverse: NDArray[Any] = np.eye(9)
    for _ in range(20):
        square, inverse = (
            0.5 * (square + np.linalg.inv(inverse)),
            0.5 * (inverse + np.linalg.inv(square)),
        )
    damping = 2.0 * REST * root[:, None] * square * root
    found = []
    for w in omega:
        a, b = stiffness - w**2 * np.diag(masses), w * damping
        solved = np.linalg.solve(np.block([[a, -b], [b, a]]), np.eye(18)[:, 1])
        found.append(solved[[0, 5, 9, 14]])
    return np.array(found)


def test_slopes_are_those_of_complex_steps_also_where_modes_coincide() -> None:
    omega = 2.0 * np.pi * np.array([5.0, 8.5, 11.0, 14.0, 17.5])
    start, step = np.ones(3), 1e-30
    stiffness, masses = (part.real for part in membrane(start.astype(np.complex128)))
    hz = np.sqrt(np.linalg.eigvalsh(stiffness)) / (2.0 * np.pi)
    assert np.isclose(np.diff(hz), 0.0, atol=1e-9).sum() >= 3  # pairs, as the net is square
    matrices = MatrixResult.of_full(
        sparse.csr_array(stiffness),
        sparse.csr_array(np.diag(masses)),
        np.arange(9),
        np.ones(9, int),
    )
    modes = FrfModes.of(matrices, sparse.csr_array(np.eye(9)), 20.0, 9).damped(np.full(9, REST))
    for column in range(3):
        stepped = start + 1j * step * np.eye(3)[column]
        wanted = damped_membrane(stepped, omega).imag / step
        changed = [part.imag / step for part in membrane(stepped)]
        change = modes.change(
            sparse.csr_array(np.triu(changed[0])), sparse.csr_array(np.diag(changed[1]))
        )
        for place, output in enumerate((0, 5)):
            slope = modes.lines(omega, output, 1).slope(change)
            exact = wanted[:, place] + 1j * wanted[:, 2 + place]
            # rounding: sums of nine modes, with resonances of 1 / (2 zeta) = 50
            assert np.abs(slope - exact).max() < 1e-9 * np.abs(exact).max()


class DampedChain:
    """The chain with two dashpots, one of them from end to end and as heavy as the lowest mode
    takes, and loss factors: of all its springs, of the first 150 and of one mount.

    theta: of the first springs' stiffness and the last masses, of the first dashpot, and of the
    loss factor of the first springs.
    """

    def __init__(self, free: bool) -> None:
        def uppers(theta: Floats) -> tuple[sparse.csr_array, sparse.csr_array]:
            stiffness, masses = chain(theta, free)
            return sparse.csr_array(np.triu(stiffness)), sparse.csr_array(np.diag(masses))

        names = np.arange(SIZE), np.ones(SIZE, dtype=np.int64)
        base = uppers(np.ones(2))
        added = [uppers(np.ones(2) + np.eye(2)[column]) for column in range(2)]
        spring = sparse.csr_array(added[0][0] - base[0])
        self.model = parameter_matrices(
            MatrixResult(*base, *names),
            np.ones(4),
            [Powers(0, (1,), (spring,))],
            [Powers(1, (1,), (sparse.csr_array(added[1][1] - base[1]),))],
        )
        # The group's own model has a column for its factor, which scales all of it.
        of_group = parameter_matrices(
            MatrixResult(spring, base[1], *names), np.ones(1), [Powers(0, (1,), (spring,))], []
        )
        self.groups = GroupStiffness(of_group, np.ones(4))
        ends = np.zeros(SIZE)
        ends[[0, SIZE - 1]] = 1.0, -1.0
        inner = np.eye(SIZE)[60] - np.eye(SIZE)[70]
        mount = np.eye(SIZE)[130]
        self.damping = DampingModel(
            (
                Damper("viscous", square(ends), (Linear(0.0, 3e3, 2),)),
                Damper("viscous", square(inner), (Linear(500.0), Linear(0.0, 1.0, 2))),
                Damper("structural", square(mount), (Linear(2e4),)),
            ),
            (Loss(Linear(0.0, 0.05, 3), 0, scaled=(0,)),),
            uniform=0.01,
        )

    def at(self, theta: Floats) -> DampedMatrices:
        return DampedMatrices(MatricesAt(self.model, theta, self.groups), self.damping)

    def exact(self, theta: Floats, omega: Floats) -> Complexes:
        """(n_lines, n_dofs, n_dofs) by full matrices, of ratios in `RATIOS` none."""
        system = self.at(theta).system
        assert system is not None
        k, m, c, h = (
            part.toarray()
            for part in (system.stiffness, system.mass, system.viscous, system.structural)
        )
        forces = np.eye(SIZE)[:, DOFS]
        return np.array(
            [np.linalg.solve(k + 1j * (h + w * c) - w**2 * m, forces)[DOFS] for w in omega]
        )


def square(vector: Floats) -> sparse.csr_array:
    return sparse.csr_array(np.outer(vector, vector))


@pytest.mark.parametrize("free", [False, True])
def test_dampers_and_loss_factors_are_those_of_full_matrices(free: bool) -> None:
    case, theta = DampedChain(free), np.array([1.2, 0.8, 1.1, 0.7])
    hz = 1e7**0.5 / SIZE / 2.0 * np.linspace(0.7, 7.5, 7)
    omega = 2.0 * np.pi * hz
    dofs = sparse.csr_array(np.eye(SIZE)[DOFS])
    here = case.at(theta)
    modes = FrfModes.of(here.given.here, dofs, float(hz[-1]), 8, system=here.system)
    pairs = [(j, k) for j in range(DOFS.size) for k in range(DOFS.size)]

    def found(by: FrfModes) -> Complexes:
        return np.stack([by.lines(omega, j, k).receptance for j, k in pairs], axis=1)

    whole = case.exact(theta, omega).reshape(omega.size, -1)
    undamped = found(FrfModes.of(here.given.here, dofs, float(hz[-1]), 8))
    assert np.abs(undamped - whole).max() > 0.2 * np.abs(whole).max()
    # 2e-5; without what dampers move beyond the modes it is 4 % of the free chain.
    assert np.abs(found(modes) - whole).max() < 1e-4 * np.abs(whole).max()
    few, vectors = here.near(modes, float(hz[-1]))
    stiffness, mass = few.given.here.stiffness.toarray(), few.given.here.mass.toarray()
    small = FrfModes.whole(stiffness, mass, np.asarray(dofs @ vectors), modes.shift)
    small = small.among(few.system)
    assert np.abs(found(small) - whole).max() < 1e-4 * np.abs(whole).max()
    step = 1e-4
    for column in range(4):
        moved = step * np.eye(4)[column]
        both = case.exact(theta + moved, omega) - case.exact(theta - moved, omega)
        wanted = both.reshape(omega.size, -1) / (2.0 * step)
        for by, matrices in ((modes, here), (small, few)):
            change = by.change(*matrices.changes(column))
            slopes = np.stack([by.lines(omega, j, k).slope(change) for j, k in pairs], axis=1)
            assert np.abs(slopes - wanted).max() < 2e-3 * np.abs(wanted).max()


def test_a_model_of_few_unknowns_has_the_values_and_slopes_of_the_whole_chain() -> None:
    def uppers(theta: Floats) -> tuple[sparse.csr_array, sparse.csr_array]:
        stiffness, masses = chain(theta, free=True)
        return sparse.csr_array(np.triu(stiffness)), sparse.csr_array(np.diag(masses))

    names = np.arange(SIZE), np.ones(SIZE, dtype=np.int64)
    base = uppers(np.ones(2))
    added = [uppers(np.ones(2) + np.eye(2)[column]) for column in range(2)]
    model = parameter_matrices(
        MatrixResult(*base, *names),
        np.ones(2),
        [Powers(0, (1,), (sparse.csr_array(added[0][0] - base[0]),))],
        [Powers(1, (1,), (sparse.csr_array(added[1][1] - base[1]),))],
    )
    dofs = sparse.csr_array(np.eye(SIZE)[DOFS])
    highest = 1e7**0.5 / SIZE / 2.0 * 7.5
    omega = 2.0 * np.pi * highest * np.linspace(0.1, 1.0, 7)

    def whole(theta: Floats) -> FrfModes:
        found = FrfModes.of(model.at(theta), dofs, highest, 8)
        return found.damped(np.full(found.tau.size, REST))

    here = whole(THETA)
    small, vectors = near(model, THETA, here, highest)

    def few(theta: Floats) -> FrfModes:
        at = small.at(theta)
        pencil = at.stiffness.toarray(), at.mass.toarray()
        found = FrfModes.whole(*pencil, dofs @ vectors, here.shift)
        return found.damped(np.full(found.tau.size, REST))

    def off(change: float) -> float:
        theta = THETA * (1.0 + change)
        exact = whole(theta).lines(omega, 0, 1).receptance
        return float(np.abs(few(theta).lines(omega, 0, 1).receptance / exact - 1.0).max())

    assert off(0.0) < 2e-4  # as above: the answers to parameters make the modes better
    for column in range(2):
        slopes = [
            modes.lines(omega, 0, 1).slope(modes.change(*of.change(THETA, column)))
            for modes, of in ((few(THETA), small), (here, model))
        ]
        assert np.abs(slopes[0] - slopes[1]).max() < 1e-3 * np.abs(slopes[1]).max()
    # Fixed shapes would err by the change itself, some percent of each resonance.
    assert off(0.05) < 2e-4
    assert off(0.2) < 1e-2
