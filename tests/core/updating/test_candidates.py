"""Changes on reduced models against the full matrices with the same change."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy import sparse
from scipy.linalg import eigh

from modetune.core.algebra.damped_modes import DampedSystem
from modetune.core.algebra.factorisation import factorise
from modetune.core.algebra.matrices import MatrixResult, upper_triangle
from modetune.core.modes import Floats
from modetune.core.updating.candidates import (
    AttachedModel,
    Released,
    Term,
    attached_model,
    spread_nodes,
)
from modetune.core.updating.frf_modes import FrfModes
from modetune.core.updating.parameter_matrices import ParameterMatrices, Powers, parameter_matrices
from modetune.core.updating.reduced_basis import reduce

N, N_MODES = 60, 12  # masses of a chain, and modes that the basis has
COMPARED = 5
#: A mode of the reduced model errs by the square of what static responses lack of its shape: for
#: modes below a third of the basis' last frequency about (1/3)^4 of a small residual.
CLOSE = 2e-5


def chain(n: int = N, scale: float = 1.0) -> tuple[Floats, Floats]:
    """Stiffness and mass of a chain that is held at its first end; scale: of the first half."""
    springs = 1e4 * np.linspace(0.9, 1.1, n)
    springs[: n // 2] *= scale
    ends = np.append(springs, 0.0)
    stiffness = np.diag(ends[:-1] + ends[1:]) - np.diag(springs[1:], 1) - np.diag(springs[1:], -1)
    return stiffness, np.diag(np.linspace(1.1, 0.9, n))


def matrices_of(make: Callable[[float], tuple[Floats, Floats]]) -> ParameterMatrices:
    """The chain with one parameter, the stiffness of its first half."""
    (base, mass), (more, _) = make(1.0), make(2.0)
    numbers = np.arange(1, base.shape[0] + 1)
    uppers = [upper_triangle(sparse.csr_array(item)) for item in (base, mass, more - base)]
    given = MatrixResult(uppers[0], uppers[1], numbers, np.ones_like(numbers))
    part = Powers(0, (1,), (uppers[2],))
    return parameter_matrices(given, np.ones(1), [part], [])


def loaded(
    places: list[int],
    released: Released | None = None,
    kept: tuple[int, ...] = (),
    dampers: tuple[sparse.csr_array, ...] = (),
) -> AttachedModel:
    """The chain on a reduced basis, with unit loads at these unknowns.

    kept, dampers: as of `attached_model`.
    """
    affine = matrices_of(lambda scale: chain(scale=scale))
    stiffness, mass = chain()
    eigenvalues, shapes = eigh(stiffness, mass, subset_by_index=[0, N_MODES - 1])
    shift = -0.1 * float(eigenvalues[0])
    inverse = factorise(sparse.csr_array(stiffness - shift * mass)).solve
    observer = sparse.csr_array(sparse.eye_array(N, format="csr"))
    model, basis = reduce(
        affine, np.ones(1), eigenvalues, shapes, inverse, np.arange(COMPARED), 0, observer
    )
    loads = sparse.csr_array(np.eye(N)[:, places])
    return attached_model(
        affine, model, basis, observer, inverse, loads, released, (np.ones(1), shift),
        np.array(kept, dtype=np.int64), dampers,
    )  # fmt: skip


def full_hz(stiffness: Floats, mass: Floats) -> Floats:
    values = eigh(stiffness, mass, eigvals_only=True, subset_by_index=[0, COMPARED - 1])
    return np.sqrt(values) / (2.0 * np.pi)


def reduced_hz(model: AttachedModel, terms: list[Term], theta: list[float]) -> Floats:
    eigenvalues, _ = model.changed(terms).modes(np.array(theta), COMPARED)
    return np.sqrt(eigenvalues) / (2.0 * np.pi)


@pytest.mark.parametrize("amplitude", [1e-3, 1.0, 30.0, 1e3])
def test_a_point_mass_of_any_size_is_exact(amplitude: float) -> None:
    model = loaded([40])
    stiffness, mass = chain()
    mass[40, 40] += amplitude
    found = reduced_hz(model, [Term("mass", 0, (0,), np.ones((1, 1)))], [1.0, amplitude])
    assert found == pytest.approx(full_hz(stiffness, mass), rel=CLOSE)


@pytest.mark.parametrize("amplitude", [1.0, 1e3, 1e6, 1e9])
def test_a_spring_between_two_places_from_soft_to_rigid_is_exact(amplitude: float) -> None:
    model = loaded([15, 45])
    stiffness, mass = chain()
    b = np.zeros(N)
    b[[15, 45]] = 1.0, -1.0
    stiffness += amplitude * np.outer(b, b)
    term = Term("stiffness", 0, (0, 1), np.array([[1.0, -1.0]]))
    assert reduced_hz(model, [term], [1.0, amplitude]) == pytest.approx(
        full_hz(stiffness, mass), rel=CLOSE
    )
    # A force pair of one moves the two places apart by the flexibility between them.
    plain, _ = chain()
    apart = model.flexibility((0, 1), np.array([1.0, -1.0]))
    assert apart == pytest.approx(
        b @ np.linalg.solve(plain, b), rel=0.1
    )  # s is a tenth of lambda_1


def test_an_absorber_brings_an_unknown_of_its_own() -> None:
    model = loaded([59])
    stiffness, mass = (np.pad(item, (0, 1)) for item in chain())
    m, k = 4.0, 120.0
    mass[N, N] = m
    b = np.zeros(N + 1)
    b[[59, N]] = 1.0, -1.0
    stiffness += k * np.outer(b, b)
    own = Term("mass", 0, (), np.zeros((1, 0)), np.ones((1, 1)))
    spring = Term("stiffness", 1, (0,), np.ones((1, 1)), -np.ones((1, 1)))
    found = reduced_hz(model, [own, spring], [1.0, m, k])
    assert found == pytest.approx(full_hz(stiffness, mass), rel=CLOSE)


def test_parameters_and_a_change_move_the_model_together() -> None:
    model = loaded([40])
    stiffness, mass = chain(scale=1.3)
    mass[40, 40] += 5.0
    term = Term("mass", 0, (0,), np.ones((1, 1)))
    # A parameter that moves by 30 % is outside its derivatives by about 0.3^2 of a small part.
    assert reduced_hz(model, [term], [1.3, 5.0]) == pytest.approx(
        full_hz(stiffness, mass), rel=1e-3
    )
    slopes = model.changed([term]).derivatives(np.array([1.0, 5.0]), np.arange(COMPARED))
    step = 1e-4
    for column in range(2):
        high, low = np.array([1.0, 5.0]), np.array([1.0, 5.0])
        high[column] += step
        low[column] -= step
        ends = [model.changed([term]).modes(at, COMPARED)[0] for at in (high, low)]
        difference = (ends[0] - ends[1]) / (2.0 * step)
        # Differences of a relative step of 1e-4 are good to its square.
        assert slopes.eigenvalues[:, column] == pytest.approx(difference, rel=1e-6)


@pytest.mark.parametrize("amplitude", [10.0, 1e4, 1e7, 1e11])
def test_a_support_yields_from_free_to_rigid(amplitude: float) -> None:
    # The free chain has the wall as its first unknown.
    def free(scale: float) -> tuple[Floats, Floats]:
        stiffness, mass = (np.pad(item, ((1, 0), (1, 0))) for item in chain(scale=scale))
        first = 1e4 * 0.9 * scale
        stiffness[0, :2] = first, -first
        stiffness[1, 0] = -first
        return stiffness, mass

    tie = sparse.csr_array(np.vstack([np.zeros((1, N)), np.eye(N)]))
    released = Released(
        matrices_of(free),
        tie,
        sparse.csr_array(np.eye(N + 1)[1:]),
        sparse.csr_array(np.eye(N + 1)[:, [41]]),
        sparse.csr_array(np.eye(N + 1)[:, :1]),
    )
    model = loaded([40], released)
    stiffness, mass = free(1.0)
    stiffness[0, 0] += amplitude
    # The wall has no mass: by its inverse the problem has modes at infinity.
    inverted = eigh(mass, stiffness, eigvals_only=True)[::-1][:COMPARED]
    term = Term("stiffness", 0, (1,), np.ones((1, 1)))
    found = reduced_hz(model, [term], [1.0, amplitude])
    # Twelve modes of the held chain make five of the free one (Craig and Bampton) to (5/12)^8.
    assert found == pytest.approx(1.0 / np.sqrt(inverted) / (2.0 * np.pi), rel=1e-3)


@pytest.mark.parametrize("damped", [False, True])
def test_response_functions_of_a_change_are_those_of_the_full_model(damped: bool) -> None:
    """A point mass at 40; a force at 20, a sensor at 55, dashpots at both and at 30."""
    force, sensor, place, mass_added = 20, 55, 40, 6.0
    dashpots = np.zeros(N)
    dashpots[[force, 30, sensor]] = 8.0, 5.0, 3.0
    stiffness, mass = chain()
    mass[place, place] += mass_added
    # At rest without forces, all dashpots' own motion is in the responses to loads at them.
    places = [place, force, sensor, 30]
    dampers = sparse.csr_array(np.diag(dashpots)), sparse.csr_array((N, N))
    kept = (1, 2, 3) if damped else (1, 2)
    model = loaded(places, kept=kept, dampers=dampers if damped else ())
    changed = model.changed([Term("mass", 0, (0,), np.ones((1, 1)))])
    few = changed.matrices().at(np.array([1.0, mass_added]))
    hz = np.linspace(0.5, 0.9 * full_hz(stiffness, mass)[-1], 60)
    seen = sparse.csr_array(changed.rows[[sensor, force]])
    system = None
    if damped:
        viscous, structural = map(sparse.csr_array, changed.dampers)
        system = DampedSystem(few.stiffness, few.mass, viscous, structural)
    modes = FrfModes.of(few, seen, float(hz.max()), COMPARED, system=system)
    if not damped:
        modes = modes.damped(np.full(modes.tau.size, 0.01))
    omega = 2.0 * np.pi * hz
    found = modes.lines(omega, 0, 1).receptance
    if damped:
        dynamic = [stiffness + 1j * w * np.diag(dashpots) - w**2 * mass for w in omega]
        expected = [np.linalg.inv(own)[sensor, force] for own in dynamic]
    else:
        values, shapes = eigh(stiffness, mass)
        terms = shapes[sensor] * shapes[force]
        line = values - omega[:, None] ** 2 + 0.02j * np.sqrt(values) * omega[:, None]
        expected = (terms / line).sum(axis=1)
    # Modes that the basis lacks are replaced by their static answer: an error of (w / w_13)^4.
    assert np.abs(found - expected).max() < 1e-4 * np.abs(expected).max()


def test_places_that_the_basis_knows_already_add_no_vectors() -> None:
    model = loaded([40, 40])
    # Two loads at one place have one response.
    term = Term("mass", 0, (0, 1), np.array([[1.0, 0.0]]))
    assert model.changed([term]).size == model.size + 1
    assert model.changed([]).size == model.size


def test_chosen_points_are_spread_over_all() -> None:
    line = np.stack([np.arange(101.0), np.zeros(101), np.zeros(101)], axis=1)
    chosen = spread_nodes(line, np.array([50]), 5)
    assert chosen.tolist() == [0, 25, 50, 75, 100]
    assert spread_nodes(line[:3], np.zeros(0, dtype=np.int64), 5).tolist() == [0, 1, 2]
