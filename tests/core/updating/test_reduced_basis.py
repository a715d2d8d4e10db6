"""Reduced models against the full ones they are made of."""

from __future__ import annotations

import tracemalloc
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy import sparse

from modetune.core.algebra.eigen import solve_modes
from modetune.core.algebra.factorisation import factorise
from modetune.core.algebra.matrices import MatrixResult, symmetric
from modetune.core.algebra.rigid_modes import PRINTED, matrix_energies
from modetune.core.errors import ModesError
from modetune.core.modes import Floats
from modetune.core.updating.parameter_matrices import (
    ParameterMatrices,
    Powers,
    differences,
    fit_powers,
    parameter_matrices,
    separate,
)
from modetune.core.updating.reduced_basis import (
    ReducedModel,
    reduce,
    unreduced,
    with_directions,
)
from modetune.core.updating.sensitivity import ModeDerivatives, fox_kapoor, nelson
from tests.core.matrix_decks import bar, matrices_of, plates
from tests.core.updating.test_parameter_matrices import SHELL_POWERS

FACTORS = (0.55, 0.75, 1.4, 1.9)
KNOWN, USED = 12, 5  # elastic modes that are solved for, and those that are updated


@dataclass(frozen=True)
class Full:
    """A full model at some parameter values."""

    affine: ParameterMatrices
    theta: Floats
    eigenvalues: Floats
    shapes: Floats
    n_rigid: int = 0

    @classmethod
    def at(cls, affine: ParameterMatrices, values: list[float], known: int = KNOWN) -> Full:
        theta = np.array(values)
        here = affine.at(theta)
        eigenvalues, shapes = solve_modes(here.stiffness, here.mass, known + 6)
        energies = matrix_energies(here.upper_stiffness, shapes, PRINTED)
        n_rigid = int(np.sum(energies == 0.0))
        count = known + n_rigid
        return cls(affine, theta, eigenvalues[:count], shapes[:, :count], n_rigid)

    @property
    def used(self) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        return np.arange(USED) + self.n_rigid

    @property
    def rows(self) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        return np.arange(0, self.shapes.shape[0], 7)

    def reduced(
        self, previous: Floats | None = None, most: int = 150
    ) -> tuple[ReducedModel, Floats]:
        here = self.affine.at(self.theta)
        shift = -0.1 * self.eigenvalues[self.used[0]]
        factors = factorise(here.stiffness - shift * here.mass)
        observer = sparse.csr_array(sparse.eye_array(self.shapes.shape[0], format="csr")[self.rows])
        return reduce(
            self.affine,
            self.theta,
            self.eigenvalues,
            self.shapes,
            factors.solve,
            self.used,
            self.n_rigid,
            observer,
            previous,
            most,
        )

    def derivatives(self) -> ModeDerivatives:
        here = self.affine.at(self.theta)
        changes = []
        for column in range(self.theta.size):
            stiffness, mass = self.affine.change(self.theta, column)
            changes.append((symmetric(stiffness), symmetric(mass)))
        return nelson(
            here.stiffness,
            here.mass,
            self.eigenvalues,
            self.shapes,
            changes,
            self.used.tolist(),
            self.rows,
        )


def bar_of_moduli(folder: Path, held: bool) -> ParameterMatrices:
    """Three moduli and a density: incompatible modes have no mass of their own."""
    deck, nodes = bar([1.0, 1.0, 1.0], held=held)
    base = matrices_of(deck, folder)
    ends = differences(base, matrices_of(bar([2.0, 1.0, 2.0], held=held)[0], folder))[0]
    first, last = separate(ends, base.nodes, [nodes[0], nodes[2]])
    other = matrices_of(bar([1.0, 2.0, 1.0], [1.0, 1.0, 2.0], held)[0], folder)
    middle, heavy = differences(base, other)
    shares = [Powers(c, (1,), (part,)) for c, part in enumerate((first, middle, last))]
    return parameter_matrices(base, np.ones(4), shares, [Powers(3, (1,), (heavy,))])


def plates_of_thickness(folder: Path, held: bool) -> ParameterMatrices:
    """The thickness of one plate of two that meet at a right angle, and the other's modulus."""
    base = matrices_of(plates((2.0, 2.5), 90.0, held), folder)
    pairs = [
        differences(base, matrices_of(plates((2.0 * factor, 2.5), 90.0, held), folder))
        for factor in FACTORS
    ]
    stiff = matrices_of(plates((2.0, 2.5), 90.0, held, (1.0, 2.0)), folder)
    stiffness, mass = (
        fit_powers([pair[place] for pair in pairs], FACTORS, 1.0, SHELL_POWERS) for place in (0, 1)
    )
    shares = [
        Powers(0, SHELL_POWERS, stiffness),
        Powers(1, (1,), (differences(base, stiff)[0],)),
    ]
    return parameter_matrices(base, np.ones(2), shares, [Powers(0, SHELL_POWERS, mass)])


MODELS = {"moduli": bar_of_moduli, "thickness": plates_of_thickness}


@pytest.fixture(
    scope="module",
    params=[(name, held) for name in MODELS for held in (True, False)],
    ids=lambda item: f"{item[0]}, {'held' if item[1] else 'free'}",
)
def affine(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> ParameterMatrices:
    name, held = request.param
    return MODELS[str(name)](tmp_path_factory.mktemp("matrices"), bool(held))


def away(affine: ParameterMatrices, share: float) -> list[float]:
    """Values that differ from one by a share, in turns up and down."""
    return [1.0 + share * (-1.0) ** column for column in range(affine.reference.size)]


def frequency_errors(model: ReducedModel, full: Full) -> Floats:
    """Of the used modes, relative, (n_used,)."""
    found = model.modes(full.theta, int(full.used[-1]) + 1)[0]
    return np.asarray(np.abs(np.sqrt(found[full.used] / full.eigenvalues[full.used]) - 1.0))


def test_modes_and_derivatives_are_those_of_the_full_model(affine: ParameterMatrices) -> None:
    full = Full.at(affine, [1.0] * affine.reference.size)
    model = full.reduced()[0]
    # No product K x is taken, so nothing is lost but to rounding.
    assert frequency_errors(model, full).max() < 1e-10
    given = full.shapes[np.ix_(full.rows, full.used)]
    found, expected = model.derivatives(full.theta, full.used, given), full.derivatives()
    for column in range(full.theta.size):
        stiffness, mass = (symmetric(upper) for upper in affine.change(full.theta, column))
        lam = fox_kapoor(full.eigenvalues, full.shapes, stiffness, mass)[full.used]
        np.testing.assert_allclose(found.eigenvalues[:, column], lam, atol=1e-6 * np.abs(lam).max())
        # One answer a mode and parameter, of modes up to six times the used ones' eigenvalue
        # and more: what is left of unknown modes' share.
        shapes = expected.mode_shapes[:, :, column]
        wrong = np.linalg.norm(found.mode_shapes[:, :, column] - shapes)
        assert wrong < 1e-2 * np.linalg.norm(shapes)


def test_frequencies_away_from_the_basis_are_close_and_one_more_set_makes_them_exact(
    affine: ParameterMatrices,
) -> None:
    start = Full.at(affine, [1.0] * affine.reference.size)
    model, basis = start.reduced()
    near, far = (Full.at(affine, away(affine, share)) for share in (0.1, 0.2))
    assert frequency_errors(model, near).max() < 2e-5
    before = frequency_errors(model, far).max()
    assert before < 1e-4
    richer, wider = Full.at(affine, away(affine, 0.15)).reduced(basis)
    assert basis.shape[1] < wider.shape[1] <= 150
    assert frequency_errors(richer, far).max() < max(0.02 * before, 1e-7)
    # Old vectors are kept: the first set's modes are still as good as exact.
    assert frequency_errors(richer, start).max() < 1e-6


def test_derivatives_away_from_the_basis_are_the_slopes_of_its_own_modes(
    affine: ParameterMatrices,
) -> None:
    full = Full.at(affine, [1.0] * affine.reference.size)
    model, step = full.reduced()[0], 1e-4
    theta, used = np.array(away(affine, 0.07)), full.used
    own = model.modes(theta, used[-1] + 1)[1][:, used]
    found = model.derivatives(theta, used)
    bare = model.derivatives(theta, used, of_shapes=False)
    # The sign of a mode is no matter, the rotation of close ones is.
    np.testing.assert_allclose(bare.eigenvalues, found.eigenvalues, rtol=1e-12)
    assert bare.mode_shapes.shape == (0, used.size, theta.size)
    for column in range(theta.size):
        move = step * np.eye(theta.size)[column]
        (upper, high), (lower, low) = (
            model.modes(theta + sign * move, used[-1] + 1) for sign in (1, -1)
        )
        high, low = (
            shapes[:, used] * np.sign(np.sum(shapes[:, used] * own, axis=0))
            for shapes in (high, low)
        )
        # Central differences err by step^2, times large numbers for close modes.
        np.testing.assert_allclose(
            found.eigenvalues[:, column],
            (upper - lower)[used] / (2 * step),
            atol=1e-5 * full.eigenvalues[used[-1]],
        )
        scale = np.abs(found.mode_shapes).max()
        np.testing.assert_allclose(
            found.mode_shapes[:, :, column], (high - low) / (2 * step), atol=1e-4 * scale
        )


def test_a_basis_has_no_more_vectors_than_allowed(tmp_path: Path) -> None:
    affine = bar_of_moduli(tmp_path, True)
    full = Full.at(affine, [1.0] * 4)
    basis = full.reduced()[1]
    small, few = full.reduced(most=KNOWN + 6 + 3)
    assert small.size == few.shape[1] < basis.shape[1]
    same = full.reduced(basis)[1]
    assert same.shape[1] == basis.shape[1]  # it has nothing new
    model, enriched = Full.at(affine, away(affine, 0.2)).reduced(basis, basis.shape[1] + 4)
    assert model.size == enriched.shape[1] == basis.shape[1] + 4


def test_a_parameter_without_effect_has_no_derivatives(tmp_path: Path) -> None:
    affine = bar_of_moduli(tmp_path, True)
    wider = parameter_matrices(affine.base, np.ones(6), [], [])
    wider = ParameterMatrices(np.ones(6), affine.base, affine.stiffness, affine.mass)
    full = Full.at(wider, [1.0] * 6)
    found = full.reduced()[0].derivatives(full.theta, full.used)
    assert not found.eigenvalues[:, 4:].any()
    assert not found.mode_shapes[:, :, 4:].any()


def square_model(n: int = 8) -> ParameterMatrices:
    """A chain that moves alike in two directions: every eigenvalue stands twice.

    Column 0 stiffens both directions' first spring, column 1 one's last; unknown 2 n is without
    mass, on the way of both.
    """
    springs = np.ones((2, n + 1))
    k = np.zeros((2 * n + 1, 2 * n + 1))
    soft = np.zeros_like(k)
    turned = np.zeros_like(k)
    for way in range(2):
        for place in range(n):
            row = way * n + place
            k[row, row] = springs[way, place] + springs[way, place + 1]
            if place + 1 < n:
                k[row, row + 1] = k[row + 1, row] = -springs[way, place + 1]
        soft[way * n, way * n] = 1.0
    # One corner against the unknown without mass, at an angle to both ways.
    k[2 * n, 2 * n] = 1.0
    arms = np.zeros(2 * n + 1)
    arms[[n - 1, 2 * n - 1, 2 * n]] = 0.6, 0.8, -1.0
    turned += np.outer(arms, arms)
    mass = np.diag([1.0] * (2 * n) + [0.0])

    def upper(full: Floats) -> sparse.csr_array:
        return sparse.csr_array(np.triu(full))

    base = MatrixResult(upper(k), upper(mass), np.arange(2 * n + 1), np.ones(2 * n + 1, np.int64))
    shares = [Powers(0, (1,), (upper(soft),)), Powers(1, (1,), (upper(turned),))]
    return parameter_matrices(base, np.array([1.0, 0.0]), shares, [])


def test_repeated_modes_are_treated_as_the_full_model_treats_them() -> None:
    affine = square_model()
    full = Full.at(affine, [1.0, 0.0], known=8)
    full = Full(affine, full.theta, full.eigenvalues[:10], full.shapes[:, :10])
    used = np.arange(4)
    assert np.ptp(full.eigenvalues[:2]) < 1e-12
    model = reduce(
        affine,
        full.theta,
        full.eigenvalues,
        full.shapes,
        factorise(affine.at(full.theta).stiffness + 0.1 * affine.at(full.theta).mass).solve,
        used,
        0,
        sparse.csr_array(sparse.eye_array(17, format="csr")),
    )[0]
    changes = [tuple(symmetric(a) for a in affine.change(full.theta, c)) for c in (0, 1)]
    here = affine.at(full.theta)
    expected = nelson(
        here.stiffness,
        here.mass,
        full.eigenvalues,
        full.shapes,
        [(dk, dm) for dk, dm in changes],
        used.tolist(),
        np.arange(17),
    )
    found = model.derivatives(full.theta, used, full.shapes[:, used])
    np.testing.assert_allclose(found.eigenvalues, expected.eigenvalues, atol=1e-7)
    # Ten of sixteen modes are known; the largest derivative is 0.9.
    np.testing.assert_allclose(found.mode_shapes, expected.mode_shapes, atol=1e-2)


def test_an_unknown_without_mass_leaves_derivatives_finite() -> None:
    """Where nothing is reduced, it is a vector of the basis without any eigenvalue."""
    stiffness = np.array([[2.0, -1.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 1.0]])
    mass = np.diag([1.0, 1.0, 0.0])
    base = MatrixResult(
        sparse.csr_array(stiffness), sparse.csr_array(mass), np.arange(3), np.ones(3, np.int64)
    )
    first = Powers(0, (1,), (sparse.csr_array(np.diag([1.0, 0.0, 0.0])),))
    affine = parameter_matrices(base, np.ones(1), [first], [])
    model = unreduced(affine, -1.0, sparse.csr_array(np.eye(3)))
    found = model.derivatives(np.ones(1), np.arange(2))
    # Shapes (1, 1) and (1, -1) of unit mass move the first unknown by the root of a half.
    np.testing.assert_allclose(found.eigenvalues[:, 0], [0.5, 0.5], rtol=1e-12)
    assert np.isfinite(found.mode_shapes).all()


def test_what_a_reduced_model_has_not_is_told() -> None:
    affine = square_model()
    full = Full.at(affine, [1.0, 0.0], known=8)
    model = full.reduced()[0]
    with pytest.raises(ModesError, match=r"40 modes were asked of a reduced model that has \d+;"):
        model.modes(full.theta, 40)
    with pytest.raises(ModesError, match="has no mode 40"):
        model.derivatives(full.theta, np.array([40]))
    with pytest.raises(ModesError, match="below its shift"):
        model.modes(np.array([-50.0, 0.0]), 2)
    with pytest.raises(ModesError, match="do not fit its basis"):
        ReducedModel(np.ones(1), -1.0, np.eye(2), np.eye(3), (), (), np.ones((4, 2)))


def test_forces_on_known_modes_alone_and_parameters_that_strain_nothing_add_no_vectors() -> None:
    affine = square_model()
    full = Full.at(affine, [1.0, 0.0], known=8)
    whole = full.reduced()[1]
    # All of the mass moves no shape; 10^-12 of the first spring changes one by 10^-6 at most.
    heavy = Powers(2, (1,), (affine.base.upper_mass,))
    faint = Powers(
        3, (1,), (affine.stiffness[0].upper(affine.base.upper_stiffness, np.array([1e-12])),)
    )
    shares = [
        Powers(part.column, (1,), (part.upper(affine.base.upper_stiffness, np.ones(1)),))
        for part in affine.stiffness
    ]
    wider = parameter_matrices(
        affine.base, np.array([1.0, 0.0, 1.0, 1.0]), [*shares, faint], [heavy]
    )
    again = Full(wider, np.array([1.0, 0.0, 1.0, 1.0]), full.eigenvalues, full.shapes)
    model, basis = again.reduced()
    assert basis.shape == whole.shape
    doubled = np.array([1.0, 0.0, 2.0, 1.0])
    halved = model.modes(doubled, 6)[0]
    np.testing.assert_allclose(halved, 0.5 * full.eigenvalues[:6], rtol=1e-9)
    # Back at the values of the base from a set elsewhere.
    shares_moved = Full.at(wider, [1.2, 0.0, 1.5, 1.0], known=8).reduced()[0]
    lowest = shares_moved.modes(np.array([1.0, 0.0, 1.0, 1.0]), 1)[0]
    np.testing.assert_allclose(lowest, full.eigenvalues[:1], rtol=1e-4)


def test_an_older_basis_joins_a_new_one_without_a_copy_of_either() -> None:
    n, random = 60_000, np.random.default_rng(0)
    diagonal = random.uniform(1.0, 2.0, n)
    basis, older = random.standard_normal((n, 5)), random.standard_normal((n, 60))
    answers = np.asfortranarray(older[:, :10] + 0.1 * random.standard_normal((n, 10)))
    tracemalloc.start()
    try:
        found = with_directions(lambda x: diagonal[:, None] * x, basis, [answers, older], 70)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert found.shape == (n, 75)
    # What is found, and beside it rows and columns of a few at a time, never all of `older`.
    assert peak < found.nbytes + 0.75 * older.nbytes
    gram = found[:, 5:].T @ (diagonal[:, None] * found[:, 5:])
    np.testing.assert_allclose(gram, np.eye(70), atol=1e-11)
    np.testing.assert_allclose(found[:, :5].T @ (diagonal[:, None] * found[:, 5:]), 0.0, atol=1e-7)
