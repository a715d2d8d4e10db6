"""Dimensions of sections move parts of a model of matrices, against an assembly by numpy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy import sparse

from modetune.adapters.matrices.deck import MatrixDeck, read_deck
from modetune.core.algebra.matrices import symmetric
from modetune.core.modes import Floats
from modetune.core.parameters import Parameter, counted_from
from modetune.core.updating.parameter_matrices import ParameterMatrices
from modetune.core.updating.reduced_basis import unreduced
from tests.section_frames import Frame, arch, grid, portal

Section = Callable[[Floats], tuple[float, float]]
INNER, STRIP = 0.015, 0.04


@dataclass(frozen=True)
class Structure:
    """section: area and inertia of dimensions; start: these in the model; scales: expressions of
    the factors on area and inertia."""

    frame: Callable[[], Frame]
    section: Section
    start: dict[str, float]
    area: str
    inertia: str


STRUCTURES = {
    "portal of a tube": Structure(
        portal,
        lambda d: (np.pi * (d[0] ** 2 - INNER**2), np.pi / 4 * (d[0] ** 4 - INNER**4)),
        {"r": 0.02},
        f"(r**2 - {INNER}**2) / (0.02**2 - {INNER}**2)",
        f"(r**4 - {INNER}**4) / (0.02**4 - {INNER}**4)",
    ),
    "grid of strips": Structure(
        grid,
        lambda d: (STRIP * d[0], STRIP * d[0] ** 3 / 12),
        {"t": 0.006},
        "t / 0.006",
        "(t / 0.006)**3",
    ),
    "arch of a rectangle": Structure(
        arch,
        lambda d: (d[0] * d[1], d[0] * d[1] ** 3 / 12),
        {"b": 0.03, "h": 0.05},
        "b * h / (0.03 * 0.05)",
        "b * h**3 / (0.03 * 0.05**3)",
    ),
}


def variable(name: str, start: float) -> Parameter:
    """An absolute dimension whose bounds make it one of an origin of its own."""
    origin, scale = counted_from("absolute", start, -start, 0.3 * start)
    bounds = ((-start - origin) / scale, (2 * start - origin) / scale)
    return Parameter(
        name, "variable", "placeholder", (name,), *bounds, 0.1, values="absolute", origin=origin,
        scale=scale,
    )  # fmt: skip


def related(name: str, part: str, expression: str) -> Parameter:
    free = (-np.inf, np.inf, np.nan, np.nan)
    return Parameter(name, "matrix_factor", "part", (part,), *free, expression=expression)


@pytest.fixture(params=list(STRUCTURES))
def structure(request: pytest.FixtureRequest) -> Structure:
    return STRUCTURES[request.param]


def deck_of(structure: Structure, folder: Path) -> MatrixDeck:
    free = [variable(name, start) for name, start in structure.start.items()]
    path = structure.frame().write(folder, *structure.section(dimensions(structure)))
    return read_deck(path, (
        *free, related("A", "axial", structure.area), related("m", "section", structure.area),
        related("I", "bending", structure.inertia),
    ))  # fmt: skip


def dimensions(structure: Structure, factor: float = 1.0) -> Floats:
    """The start, or somewhere else, each dimension by another factor."""
    start = np.array(list(structure.start.values()))
    return np.asarray(start * factor ** np.arange(1, start.size + 1))


def counted(deck: MatrixDeck, at: Floats) -> Floats:
    free = [item for item in deck.parameters if not item.expression]
    return np.array([item.counted(value) for item, value in zip(free, at, strict=True)])


def model_of(deck: MatrixDeck) -> ParameterMatrices:
    return deck.matrices(tuple(item for item in deck.parameters if not item.expression))


def test_matrices_are_those_assembled_at_the_dimensions(
    structure: Structure, tmp_path: Path
) -> None:
    deck = deck_of(structure, tmp_path)
    model, frame = model_of(deck), structure.frame()
    assert deck.problems(deck.parameters) == []
    for factor in (1.0, 0.9, 1.3):
        at = dimensions(structure, factor)
        stiffness, mass = frame.at(*structure.section(at))
        theta = counted(deck, at)
        values = dict(zip(structure.start, theta.tolist(), strict=True))
        edited = deck.edited(values)
        for found in (model.at(theta), edited.model.assembled(edited.factors)):
            close(found.stiffness.toarray(), stiffness)
            close(found.mass.toarray(), mass)
        written = read_deck(deck.write_updated(values, tmp_path / f"at_{factor}")).model
        close(written.stiffness.toarray(), stiffness)
        close(written.mass.toarray(), mass)
        close(written.parts["bending"].matrices["stiffness"].toarray() + written.parts["axial"]
              .matrices["stiffness"].toarray(), stiffness)  # fmt: skip


def test_derivatives_are_those_of_differences_and_of_the_section(
    structure: Structure, tmp_path: Path
) -> None:
    deck = deck_of(structure, tmp_path)
    model, frame = model_of(deck), structure.frame()
    at = dimensions(structure, 1.2)
    theta, free = counted(deck, at), [p for p in deck.parameters if not p.expression]
    for column, item in enumerate(free):
        move = 1e-4 * np.eye(at.size)[column]
        ends = [frame.at(*structure.section(at * (1 + sign * move))) for sign in (1, -1)]
        middle = frame.at(*structure.section(at))
        run = 1e-4 * at[column] / item.scale
        first, second = model.change(theta, column), model.change(theta, column, order=2)
        assert not model.is_linear(column)
        for place in (0, 1):
            high, low = ends[0][place], ends[1][place]
            # The third derivative over the first is some 12 / d^2: step^2 / 6 of it is 2e-8.
            close(symmetric(first[place]).toarray(), (high - low) / (2 * run), 1e-7)
            # Rounding of 1e-16 over step^2.
            bent = (high - 2 * middle[place] + low) / run**2
            size = np.abs(middle[place]).max() / (at[column] / item.scale) ** 2
            assert np.abs(symmetric(second[place]).toarray() - bent).max() < 1e-6 * size
        # dK/d(theta) from the section's own derivative, by a complex step, which is exact.
        stepped = at.astype(complex)
        stepped[column] += 1e-30j
        area, inertia = (value.imag / 1e-30 for value in structure.section(stepped))
        slopes = frame.at(area, inertia)[0], frame.at(area, inertia)[1] - frame.lumps
        for found, expected in zip(first, slopes, strict=True):
            close(symmetric(found).toarray(), expected * item.scale, 1e-13)


def test_a_reduced_model_has_the_modes_and_slopes_of_the_section(
    structure: Structure, tmp_path: Path
) -> None:
    deck = deck_of(structure, tmp_path)
    model, frame, n = model_of(deck), structure.frame(), 4
    at = dimensions(structure, 1.1)
    theta = counted(deck, at)
    whole = unreduced(model, -1.0, sparse.csr_array(np.eye(model.base.nodes.size)))
    eigenvalues = (2 * np.pi * frame.hz(*structure.section(at), n)) ** 2
    np.testing.assert_allclose(whole.modes(theta, n)[0], eigenvalues, rtol=1e-9)
    found = whole.derivatives(theta, np.arange(n)).eigenvalues
    for column, item in enumerate(p for p in deck.parameters if not p.expression):
        move = 1e-4 * np.eye(at.size)[column]
        high, low = (
            (2 * np.pi * frame.hz(*structure.section(at * (1 + sign * move)), n)) ** 2
            for sign in (1, -1)
        )
        expected = (high - low) / (2e-4 * at[column] / item.scale)
        np.testing.assert_allclose(found[:, column], expected, rtol=1e-6)


def close(found: Floats, expected: Floats, share: float = 1e-12) -> None:
    """Entries are sums of some ten members, with rounding of the largest."""
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=share * np.abs(expected).max())


def test_what_an_expression_moves_has_no_energies_and_cannot_move_twice(tmp_path: Path) -> None:
    structure = STRUCTURES["grid of strips"]
    deck = deck_of(structure, tmp_path)
    own = Parameter("k", "matrix_factor", "part", ("bending",), 0.5, 2.0, 0.1)
    assert deck.energy_sets(own) == ("bending",)
    driver = related("I", "axial", "k**2")
    both = read_deck(deck.file.path, (own, driver))
    assert both.energy_sets(own) == ()
    assert both.energy_sets(driver) == ()
    (twice,) = deck.problems((*deck.parameters, own))
    assert twice.endswith("part bending: both I and k change this number")
    (unknown,) = deck.problems((*deck.parameters, related("J", "twist", "t")))
    assert "the model has no part twist" in unknown


def test_dampers_follow_an_expression(tmp_path: Path) -> None:
    """One factor k: a spring with k, a damper with sqrt(k), as at a constant damping ratio."""
    path = tmp_path / "model.yaml"
    path.write_text(
        "masses: {m1: 2.0}\nsprings:\n  k1: {between: [ground, m1], stiffness: 800.0}\n"
        "dampers:\n  c1: {between: [ground, m1], viscous: 1.6}\n"
    )
    own = Parameter("k", "spring_stiffness", "elset", ("k1",), 0.5, 2.0, 0.1)
    free = (-np.inf, np.inf, np.nan, np.nan)
    driven = Parameter("c", "viscous_damping", "elset", ("c1",), *free, expression="sqrt(k)")
    deck = read_deck(path, (driven, own))
    model, damping = deck.matrices((own,)), deck.damping(deck.matrices((own,)).base)
    theta = np.array([1.44])
    system, change = damping.system(model, theta), damping.change(model, theta, 0)
    assert system.viscous.toarray() == pytest.approx(1.6 * 1.2)
    assert change.viscous.toarray() == pytest.approx(1.6 * 0.5 / 1.2)
    assert change.stiffness.toarray() == pytest.approx(800.0)
