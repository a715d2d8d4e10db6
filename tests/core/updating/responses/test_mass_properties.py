"""Mass properties of matrices: closed forms of bodies, derivatives, what is held."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import sparse

from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.solver import MatrixAnalysis
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.correlation.pairing import pair_by_order
from modetune.core.errors import ModesError
from modetune.core.mesh import Mesh
from modetune.core.modes import Floats, mode_set
from modetune.core.updating.parameter_matrices import (
    ParameterMatrices,
    Powers,
    parameter_matrices,
)
from modetune.core.updating.responses.mass_properties import (
    MASS_QUANTITIES,
    MassResponse,
    MassTarget,
)
from modetune.core.updating.responses.response import MatricesAt, ModelState, StateDerivatives
from modetune.core.updating.sensitivity import ModeDerivatives
from modetune.core.updating.weighting import even_weighting
from tests.adapters.ccx_decks import attached, plate, wall
from tests.adapters.test_solver_contract import run
from tests.core.matrix_decks import DENSITY, bar, matrices_of
from tests.core.updating.compared import state_of

NOISE = np.random.default_rng(3)
#: Points that no symmetry lines up, those of the second half on a body that a parameter scales.
PLACES = NOISE.uniform(-2.0, 3.0, (8, 3))
MASSES = NOISE.uniform(0.5, 4.0, 8)
SECOND = np.arange(8) >= 4
ALL = {name: MassTarget(0.0, 1.0) for name in MASS_QUANTITIES}
THETA = np.array([1.3])


def points(power: int = 1) -> MatricesAt:
    """Point masses, three unknowns each; those of the second half go with theta^power."""
    diagonal = np.repeat(MASSES, 3)
    base = MatrixResult.of_full(
        sparse.csr_array(np.eye(24)),
        sparse.csr_array(np.diag(diagonal)),
        np.repeat(np.arange(1, 9), 3),
        np.tile([1, 2, 3], 8),
    )
    upper = sparse.csr_array(np.diag(np.where(np.repeat(SECOND, 3), diagonal, 0.0)))
    part = Powers(0, (power,), (upper,))
    return MatricesAt(parameter_matrices(base, np.ones(1), (), (part,)), THETA)


def closed_form(masses: Floats) -> Floats:
    mass = masses.sum()
    centre = masses @ PLACES / mass
    x = PLACES - centre
    inertia = sum(
        (m * (r @ r * np.eye(3) - np.outer(r, r)) for m, r in zip(masses, x, strict=True)),
        np.zeros((3, 3)),
    )
    return np.array([mass, *centre, *inertia[[0, 1, 2, 0, 1, 2], [0, 1, 2, 1, 2, 0]]])


def beside(matrices: MatricesAt, frames: dict[int, Floats] | None = None) -> ModelState:
    nothing = mode_set([5.0], np.ones((1, 1)), [1], [1])
    state = state_of(
        nothing, nothing, pair_by_order(nothing, nothing), even_weighting(1, 1, 0.01, 0.1)
    )
    mesh = Mesh(np.arange(1, 9), PLACES, (), frames or {})
    return replace(state, matrices=matrices, mesh=mesh)


def test_points_have_the_mass_properties_of_their_sums() -> None:
    masses = np.where(SECOND, 1.3, 1.0) * MASSES
    found = MassResponse(ALL).residual(beside(points()))
    np.testing.assert_allclose(-found.values, closed_form(masses), rtol=1e-12)
    assert found.labels[:2] == ("mass", "centre x")


@pytest.mark.parametrize("power", [1, 3])
def test_derivatives_are_those_of_the_closed_form(power: int) -> None:
    state = beside(points(power))
    derivatives = StateDerivatives(ModeDerivatives(np.zeros((1, 1)), np.zeros((0, 1, 1))), (0,))
    found = MassResponse(ALL).sensitivity(state, derivatives)[:, 0]

    def at(theta: float) -> Floats:
        return closed_form(np.where(SECOND, theta**power, 1.0) * MASSES)

    h = 1e-5
    central = (at(1.3 + h) - at(1.3 - h)) / (2.0 * h)
    np.testing.assert_allclose(found, central, rtol=1e-7, atol=1e-8)


def test_axes_of_nodes_change_nothing() -> None:
    turned, _ = np.linalg.qr(NOISE.normal(size=(3, 3)))
    # Point masses are alike in all axes, so the matrix stays what it is.
    one, other = (
        MassResponse(ALL).residual(beside(points(), frames)).values
        for frames in ({}, {2: turned, 7: turned.T})
    )
    np.testing.assert_allclose(one, other, rtol=1e-12)


def test_unknowns_inside_of_elements_move_with_no_rigid_motion() -> None:
    whole = points()
    base = whole.model.base
    joined = np.zeros((24, 1))
    joined[[0, 3]] = [[0.5], [-0.5]]  # with forces that cancel where both nodes move alike
    more = MatrixResult(
        sparse.csr_array(
            np.block([[base.upper_stiffness.toarray(), joined], [np.zeros((1, 24)), np.eye(1)]])
        ),
        sparse.csr_array(sparse.block_diag([base.upper_mass, 7.0 * np.eye(1)])),
        np.append(base.nodes, 3),
        np.append(base.components, 2),
    )
    model = parameter_matrices(more, np.ones(1), (), ())
    found = MassResponse({"mass": MassTarget(0.0, 1.0)}).residual(
        beside(MatricesAt(model, np.ones(1)))
    )
    assert -found.values[0] == pytest.approx(MASSES.sum())


def test_a_structure_that_is_held_in_a_direction_is_refused() -> None:
    model = points().model
    kept = np.delete(np.arange(24), [0, 3])  # two points held along x
    base = model.base
    held = MatrixResult(
        base.upper_stiffness[kept][:, kept],
        base.upper_mass[kept][:, kept],
        base.nodes[kept],
        base.components[kept],
    )
    state = beside(MatricesAt(parameter_matrices(held, np.ones(1), (), ()), np.ones(1)))
    with pytest.raises(ModesError, match=r"along x, y and z.*supports hold the remaining mass"):
        MassResponse(ALL).residual(state)


def test_a_chain_of_one_direction_has_a_mass_but_no_places() -> None:
    chain = MatrixResult.of_full(
        sparse.csr_array(np.eye(3)),
        sparse.csr_array(np.diag([1.0, 2.0, 3.5])),
        np.arange(1, 4),
        np.ones(3, dtype=np.int64),
    )
    model = parameter_matrices(chain, np.ones(1), (), ())
    nowhere = Mesh(np.zeros(0, np.int64), np.zeros((0, 3)), ())
    state = replace(beside(MatricesAt(model, np.ones(1))), mesh=nowhere)
    found = MassResponse({"mass": MassTarget(6.0, 0.1)}, within=6.0).residual(state)
    assert found.values == pytest.approx([-0.5])
    assert MassResponse({}, within=6.0).agrees(found)
    assert not MassResponse({}, within=4.0).agrees(found)
    with pytest.raises(ModesError, match="at no node of the model"):
        MassResponse(ALL).residual(state)


EXPANDED = {
    "plate": plate("S4", held=""),
    "quadratic plate": plate("S8R", held=""),
    "a plate on springs with a mass": plate("S4", held="") + attached(1, 12),
    "a wall on a plate": plate("S4", held="") + wall((2, 6, 10), 10.0),
}


@pytest.mark.skipif(shutil.which("ccx") is None, reason="ccx is not installed")
@pytest.mark.parametrize("name", EXPANDED)
def test_expanded_shells_have_their_closed_form_and_exact_derivatives(
    name: str, tmp_path: Path
) -> None:
    """The parameter is the plate's thickness; K and M at it are linear in their own differences."""
    deck, found, h = None, [], 1e-3
    for factor in (1.0, 1.0 + h, 1.0 - h):
        folder = tmp_path / str(factor)
        folder.mkdir()
        (folder / "model.inp").write_text(
            EXPANDED[name].replace("\n2.0\n", f"\n{2.0 * factor:.6f}\n")
        )
        solver = calculix_solver(folder / "model.inp", ())
        deck = solver.deck
        result = run(solver, {}, MatrixAnalysis(), folder)
        assert isinstance(result, MatrixResult)
        found.append(result)
    assert deck is not None
    parts = []
    for key in ("upper_stiffness", "upper_mass"):
        change = (getattr(found[1], key) - getattr(found[2], key)) / (2.0 * h)
        parts.append(Powers(0, (1,), (sparse.csr_array(change),)))
    here = parameter_matrices(found[0], np.ones(1), parts[:1], parts[1:])
    ends = [parameter_matrices(item, np.ones(1), (), ()) for item in found[1:]]
    response = MassResponse(ALL, observe=deck.observation)

    def state(model: ParameterMatrices) -> ModelState:
        return replace(beside(MatricesAt(model, np.ones(1))), mesh=deck.mesh())

    values = -response.residual(state(here)).values
    scales = np.array([values[0], *[10.0] * 3, *[values[6]] * 6])
    if name.endswith("plate") and "wall" not in name:
        a, b, t = 30.0, 20.0, 2.0
        m = 2.7e-9 * a * b * t
        turned = m / 12.0 * np.array([b**2 + t**2, a**2 + t**2, a**2 + b**2, 0.0, 0.0, 0.0])
        expected = np.array([m, a / 2, b / 2, 0.0, *turned])
        # The condition of the expanded plate, 1e5, times rounding.
        np.testing.assert_allclose(values / scales, expected / scales, atol=1e-10)
    derivatives = StateDerivatives(ModeDerivatives(np.zeros((1, 1)), np.zeros((0, 1, 1))), (0,))
    slopes = response.sensitivity(state(here), derivatives)[:, 0]
    one, other = (-response.residual(state(model)).values for model in ends)
    central = (one - other) / (2.0 * h)
    # Differences of cubes in the thickness: h^2 of them is left.
    np.testing.assert_allclose(slopes / scales, central / scales, atol=1e-5)
    assert abs(slopes[0]) > 0.5 * 2.7e-9 * 30.0 * 20.0 * 2.0


def test_a_bar_of_two_densities_by_calculix_has_the_properties_of_two_bricks(
    tmp_path: Path,
) -> None:
    deck, _ = bar([1.0, 1.0], [1.0, 2.0], held=False)
    stored = matrices_of(deck, tmp_path)
    lines = [line.split(",") for line in deck.splitlines()[1:46]]
    numbers = np.array([int(line[0]) for line in lines])
    places = np.array([[float(item) for item in line[1:]] for line in lines])
    order = np.argsort(numbers)
    state = replace(
        beside(MatricesAt(parameter_matrices(stored, np.ones(1), (), ()), np.ones(1))),
        mesh=Mesh(numbers[order], places[order], ()),
    )
    found = -MassResponse(ALL).residual(state).values
    a, b, c = 20.0, 10.0, 8.0  # of each brick
    m = DENSITY * a * b * c * np.array([1.0, 2.0])
    x = m @ np.array([10.0, 30.0]) / m.sum()
    along = m.sum() * a**2 / 12.0 + m @ (np.array([10.0, 30.0]) - x) ** 2
    expected = [
        m.sum(), x, b / 2, c / 2,
        m.sum() * (b**2 + c**2) / 12.0, along + m.sum() * c**2 / 12.0,
        along + m.sum() * b**2 / 12.0, 0.0, 0.0, 0.0,
    ]  # fmt: skip
    # Stored matrices have fourteen digits; entries of zero are differences of the others.
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * found[4])
