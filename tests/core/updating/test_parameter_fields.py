"""Fields: neighbours and zones of meshes, the regularised step against other methods, and what a
test cannot tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import lsq_linear
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from modetune.core.errors import ModelError
from modetune.core.mesh import Cells, Mesh
from modetune.core.modes import Floats, Integers
from modetune.core.updating.parameter_fields import (
    AS_WELL,
    Field,
    Smoothing,
    answer,
    element_graph,
    joined,
    prior_precision,
    zones_of,
)
from modetune.core.updating.parameter_steps import (
    StepProblem,
    from_initial,
    l_curve,
    parameter_step,
    weights_root,
)


def grid(n: int, m: int) -> Mesh:
    """n x m quadrilaterals; element 1 + i + n j."""
    x, y = np.meshgrid(np.arange(n + 1.0), np.arange(m + 1.0))
    nodes = np.arange(1, x.size + 1)
    corner = [1 + i + (n + 1) * j for j in range(m) for i in range(n)]
    quads = np.array([[c, c + 1, c + n + 2, c + n + 1] for c in corner])
    places = np.stack([x.ravel(), y.ravel(), 0.0 * x.ravel()], axis=1)
    return Mesh(nodes, places, (Cells("quad", np.arange(1, n * m + 1), quads),))


def chain(n: int, ring: bool = False, smoothing: Smoothing = "neighbours") -> Field:
    pairs = [(i, i + 1) for i in range(n - 1)] + ([(0, n - 1)] if ring else [])
    angle = 2 * np.pi * np.arange(n) / n
    centres = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    every = np.arange(n)
    return Field("E", every, np.array(pairs), every + 1, every, centres, smoothing)


def problem(field: Field, changes: Floats, noise: float = 0.0, n_rows: int = 9) -> StepProblem:
    """A test of fewer values than zones: smooth sensitivities, and what these changes move."""
    n = field.columns.size
    rows = np.array(
        [np.cos(np.pi * k * (np.arange(n) + 0.5) / n) ** 2 for k in range(1, n_rows + 1)]
    )
    values = rows @ changes + noise * np.random.default_rng(3).standard_normal(n_rows)
    deviations = np.full(n, 0.2)
    return StepProblem(
        rows,
        values,
        np.full(n_rows, 1e6),
        prior_precision([field], np.zeros(n), deviations),
        np.zeros(n),
        np.full(n, -0.8),
        np.full(n, 1.0),
        noise=float(n_rows),
    )


def test_shells_that_share_an_edge_are_neighbours_and_those_at_a_corner_are_not() -> None:
    numbers, centres, pairs = element_graph(grid(3, 2), frozenset({1, 2, 4, 5, 6}))
    assert numbers.tolist() == [1, 2, 4, 5, 6]
    assert centres[0].tolist() == [0.5, 0.5, 0.0]
    named = {tuple(numbers[pair].tolist()) for pair in pairs}
    assert named == {(1, 2), (1, 4), (2, 5), (4, 5), (5, 6)}


@pytest.mark.parametrize("n_zones", [2, 7, 24])
def test_zones_are_connected_as_many_as_asked_and_hold_every_element(n_zones: int) -> None:
    _, centres, pairs = element_graph(grid(6, 4), frozenset(range(1, 25)))
    owners = zones_of(centres, pairs, n_zones)
    assert sorted(set(owners.tolist())) == list(range(n_zones))
    inside = pairs[owners[pairs[:, 0]] == owners[pairs[:, 1]]]
    graph = coo_array((np.ones(len(inside)), tuple(inside.T)), shape=(24, 24))
    assert connected_components(graph, directed=False)[0] == n_zones
    assert (
        connected_components(
            coo_array(
                (np.ones(len(z := joined(pairs, owners))), tuple(z.T)), shape=(n_zones, n_zones)
            ),
            directed=False,
        )[0]
        == 1
    )


def test_more_zones_than_elements_and_fewer_than_parts_are_refused() -> None:
    _, centres, pairs = element_graph(grid(4, 1), frozenset({1, 2, 4}))  # two parts
    for n in (1, 4):
        with pytest.raises(ModelError, match="2 to 3 are possible"):
            zones_of(centres, pairs, n)


def test_a_zone_has_the_deviation_it_was_given_on_average() -> None:
    found = chain(12).precision(np.zeros(12), 0.3)
    assert np.trace(np.linalg.inv(found)) / 12 == pytest.approx(0.3**2)
    # Raising all zones alike costs next to nothing beside raising every second one.
    alike, apart = np.ones(12), np.tile([1.0, -1.0], 6)
    assert alike @ found @ alike < 0.05 * (apart @ found @ apart)


@pytest.mark.parametrize("smoothing", ["neighbours", "sparse", "total_variation"])
def test_the_norms_of_length_one_and_the_laplacian_are_what_the_module_says(
    smoothing: Smoothing,
) -> None:
    field = chain(6, smoothing=smoothing)
    x = np.array([0.1, 0.1, -0.3, 0.2, 0.2, 0.05])
    sizes = x / 0.2
    penalty = float(x @ field.precision(x, 0.2) @ x)
    edges = np.diff(sizes)
    pull = float(sizes @ sizes) / 9.0
    scale = np.trace(np.linalg.inv(np.diff(np.eye(6), axis=0).T @ np.diff(np.eye(6), axis=0)
                                   + np.eye(6) / 9.0)) / 6  # fmt: skip
    expected = {
        "neighbours": scale * (float(edges @ edges) + pull),
        "sparse": float(np.abs(sizes).sum()),
        "total_variation": float(np.abs(edges).sum()) + pull,
    }
    assert penalty == pytest.approx(expected[smoothing], rel=1e-12)


def test_the_step_is_the_direct_solution_and_in_a_box_that_of_another_method() -> None:
    changes = np.zeros(20)
    changes[6] = -0.4
    asked = replace(problem(chain(20), changes), offset=0.02 * np.arange(20.0))
    factor = 3.0
    step = parameter_step(
        replace(asked, lower=np.full(20, -9.0), upper=np.full(20, 9.0)), "pulled_to_initial", factor
    )
    s, w, p = asked.sensitivity, asked.weights, asked.parameter_weights
    normal = s.T @ (w[:, None] * s) + factor * p
    direct = np.linalg.solve(normal, s.T @ (w * asked.residual) - factor * p @ asked.offset)
    # The normal equations lose as many digits as their condition has.
    digits = np.finfo(float).eps * np.linalg.cond(normal)
    np.testing.assert_allclose(step.change, direct, atol=digits * np.abs(direct).max())
    low, high = np.full(20, -0.05), np.full(20, 0.03)
    held = parameter_step(replace(asked, lower=low, upper=high), "pulled_to_initial", factor)
    root = np.sqrt(factor) * weights_root(p)
    rows = np.vstack([np.sqrt(w)[:, None] * s, root])
    target = np.concatenate([np.sqrt(w) * asked.residual, -root @ asked.offset])
    other = lsq_linear(rows, target, (low, high), method="trf", tol=1e-14, max_iter=500)
    cost = [float(np.sum((rows @ d - target) ** 2)) for d in (held.change, other.x)]
    assert cost[0] <= cost[1] * (1 + 1e-9)
    np.testing.assert_allclose(held.change, other.x, atol=1e-4)


def test_the_curve_and_its_corner_are_those_of_direct_solutions() -> None:
    draw = np.random.default_rng(8)
    left_basis, _, right_basis = np.linalg.svd(draw.standard_normal((40, 20)), full_matrices=False)
    s = (left_basis * 10.0 ** (-np.arange(20) / 4.0)) @ right_basis
    changes = np.sin(np.arange(20) / 4.0)
    base = problem(chain(20), changes, n_rows=40)
    noisy = s @ changes + 1e-3 * draw.standard_normal(40)
    asked = replace(base, sensitivity=s, residual=noisy, noise=2.0 * 40.0)
    curve = l_curve(asked)
    w, p = asked.weights, asked.parameter_weights
    normal, side = s.T @ (w[:, None] * s), s.T @ (w * asked.residual)
    solved = [np.linalg.solve(normal + factor * p, side) for factor in curve.factors[30:]]
    left = [asked.residual - s @ d for d in solved]
    np.testing.assert_allclose([np.sqrt(z @ (w * z)) for z in left], curve.misfits[30:], rtol=1e-4)
    np.testing.assert_allclose([np.sqrt(d @ p @ d) for d in solved], curve.sizes[30:], rtol=1e-4)
    # The corner by three points of the direct curve (Menger's curvature), where noise is met.
    x, y = np.log(curve.misfits), np.log(curve.sizes)
    turns = np.zeros(x.size)
    for k in range(3, x.size - 3):
        (ax, bx, cx), (ay, by, cy) = x[[k - 1, k, k + 1]], y[[k - 1, k, k + 1]]
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        sides = np.hypot(bx - ax, by - ay) * np.hypot(cx - bx, cy - by) * np.hypot(cx - ax, cy - ay)
        turns[k] = 2.0 * area / sides
    turns[(curve.misfits**2 > asked.noise) | (curve.misfits**2 < 0.01 * asked.noise)] = -np.inf
    at = int(np.argmin(np.abs(np.log(curve.factors / curve.corner))))
    assert abs(int(np.argmax(turns)) - at) <= 1


def test_the_discrepancy_principle_leaves_what_noise_explains() -> None:
    changes = np.zeros(20)
    changes[6] = -0.4
    asked = problem(chain(20), changes, noise=1e-3)
    asked = replace(asked, lower=np.full(20, -9.0), upper=np.full(20, 9.0))
    step = parameter_step(asked, "pulled_to_initial", "discrepancy")
    left = float(step.predicted @ (asked.weights * step.predicted))
    assert left == pytest.approx(asked.noise, rel=0.05)  # between points of the curve
    # From another set the whole change is asked for, so the answer is the same.
    moved = step.change
    again = replace(asked, offset=moved, residual=asked.residual - asked.sensitivity @ moved)
    stays = parameter_step(again, "pulled_to_initial", "discrepancy").change
    np.testing.assert_allclose(stays, 0.0, atol=1e-9)
    assert from_initial(again).residual == pytest.approx(asked.residual)


def told(field: Field, rows: Floats, changes: Floats) -> tuple[Integers, ...]:
    n = field.columns.size
    found = answer(
        field,
        rows,
        rows @ changes,
        np.full(len(rows), 1e6),
        np.zeros(n),
        np.full(n, 0.2),
        [f"E.{k + 1}" for k in range(n)],
    )
    if len(found.places) > 1:
        assert any("cannot distinguish" in said for said in found.doubts)
    return found.places


def test_twins_of_a_ring_are_two_answers_and_one_with_a_sensor_that_breaks_the_symmetry() -> None:
    n = 12
    field = chain(n, ring=True)
    angle = 2 * np.pi * (np.arange(n) + 0.5) / n
    # Bending modes of order k strain as cos^2(k a); all of them are alike at a and at -a.
    rows = np.array(
        [np.cos(k * angle) ** 2 for k in (1, 2, 3, 5)] + [np.cos(angle), np.cos(2 * angle)]
    )
    changes = np.zeros(n)
    changes[2] = -0.3
    places = told(field, rows, changes)
    assert sorted(int(zone) for place in places for zone in place) == [2, n - 3]
    assert len(places) == 2
    aside = np.vstack([rows, np.sin(angle)])
    assert [place.tolist() for place in told(field, aside, changes)] == [[2]]


def test_zones_that_move_nothing_are_told_as_unseen() -> None:
    field = chain(6)
    rows = np.tile([1.0, 1.0, 1.0, 1.0, 1.0, 0.0], (3, 1))
    rows += np.vander(np.arange(3.0), 6) * 1e-2 * (np.arange(6) < 5)
    values = rows @ np.array([0.0, -0.3, 0, 0, 0, 0])
    found = answer(
        field, rows, values, np.full(3, 1e6), np.zeros(6), np.full(6, 0.2), list("abcdef")
    )
    assert found.strengths[5] == 0.0
    assert "1 of 6 zones move no measured value" in found.doubts[0]
    assert "(f)" in found.doubts[0]
    nothing = answer(
        field, rows, 0 * values, np.full(3, 1e6), np.zeros(6), np.full(6, 0.2), list("abcdef")
    )
    assert nothing.started < AS_WELL
    assert nothing.places == ()
    assert "the start explains the test" in nothing.doubts[-1]
