"""How a test's sensors see the model."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from modetune.core.errors import ModesError
from modetune.core.measurement.sensor_map import (
    Sections,
    SensorMap,
    bar_sections,
    mean_edge,
    next_nodes,
    result_directions,
    section_factors,
)
from modetune.core.mesh import Cells, Mesh
from modetune.core.modes import mode_set
from tests.node_sensors import by_number

EVERY = (
    np.repeat([1, 2], 6),
    np.tile(np.arange(1, 7), 2),
)


def one_sensor(direction: list[float], turns: bool = False) -> SensorMap:
    return SensorMap(
        nodes=np.array([101]),
        components=np.array([4 if turns else 1]),
        model_nodes=np.array([2]),
        directions=np.array([direction]),
        turns=np.array([turns]),
        distances=np.zeros(1),
    )


def test_a_tilted_sensor_sees_the_motion_along_its_direction() -> None:
    shapes = np.arange(24.0).reshape(12, 2)
    modes = mode_set([1.0, 2.0], shapes, *EVERY)
    seen = one_sensor([0.6, 0.0, 0.8]).observe(modes)
    # Rows 6, 7, 8 are x, y, z of node 2: 0.6 u_x + 0.8 u_z by hand.
    np.testing.assert_allclose(seen.mode_shapes, [[0.6 * 12 + 0.8 * 16, 0.6 * 13 + 0.8 * 17]])
    assert (seen.nodes.tolist(), seen.components.tolist()) == ([101], [1])
    np.testing.assert_array_equal(seen.frequencies_hz, modes.frequencies_hz)


def test_a_rotational_sensor_sees_the_rotation_about_its_direction() -> None:
    modes = mode_set([1.0], np.arange(12.0)[:, None], *EVERY)
    seen = one_sensor([0.0, 1.0, 0.0], turns=True).observe(modes)
    np.testing.assert_allclose(seen.mode_shapes, [[10.0]])  # ry of node 2


def test_complex_shapes_are_seen_as_they_are() -> None:
    modes = mode_set([1.0], 1j * np.arange(12.0)[:, None], *EVERY)
    seen = one_sensor([0.0, 0.0, -1.0]).observe(modes)
    np.testing.assert_allclose(seen.mode_shapes, [[-8j]])


def test_sensors_by_number_pick_the_rows_of_the_shapes() -> None:
    rng = np.random.default_rng(1)
    shapes = rng.normal(size=(12, 3))
    modes = mode_set([1.0, 2.0, 3.0], shapes, *EVERY)
    chosen = np.array([11, 0, 4])
    seen = by_number(EVERY[0][chosen], EVERY[1][chosen]).observe(modes)
    np.testing.assert_array_equal(seen.mode_shapes, shapes[chosen])


def test_a_mode_that_rests_at_the_sensors_but_for_rounding_is_zero_there() -> None:
    shapes = np.zeros((12, 4))
    shapes[8] = 1.0, 3e-9, 1e-3, 1e-17  # z of node 2: bending, in the plane, weak, of a part apart
    shapes[6] = 0.0, 1.4, 1e2, 1e-17
    modes = mode_set([1.0, 2.0, 3.0, 4.0], shapes, *EVERY)
    seen = one_sensor([0.0, 0.0, 1.0]).observe(modes)
    np.testing.assert_array_equal(seen.mode_shapes, [[1.0, 0.0, 1e-3, 0.0]])
    light = mode_set([1.0, 2.0], [[1.0, 2e6]], [2], [3])
    np.testing.assert_array_equal(
        one_sensor([0.0, 0.0, 1.0]).observe(light).mode_shapes, [[1.0, 2e6]]
    )


def test_a_component_the_results_lack_counts_only_where_it_is_looked_along() -> None:
    flat = mode_set([1.0], [[3.0], [5.0]], [2, 2], [1, 2])
    seen = one_sensor([0.6, 0.8, 1e-9]).observe(flat)
    np.testing.assert_allclose(seen.mode_shapes, [[0.6 * 3 + 0.8 * 5]])
    with pytest.raises(ModesError, match=r"no component 3 at node 2.*test point 101"):
        one_sensor([0.6, 0.0, 0.8]).observe(flat)


def square(cells: tuple[Cells, ...] = ()) -> Mesh:
    corners = np.array([[0.0, 0, 0], [4, 0, 0], [4, 2, 0], [0, 2, 0]])
    return Mesh(np.array([1, 2, 5, 9]), corners, cells)


def test_the_next_two_nodes_are_found_with_their_distances() -> None:
    nodes, distances = next_nodes(np.array([[3.0, 0.0, 0.0]]), square())
    assert nodes.tolist() == [[2, 5]]
    np.testing.assert_allclose(distances, [[1.0, np.sqrt(5.0)]])


def test_a_mesh_of_one_node_has_no_second() -> None:
    nodes, distances = next_nodes(np.zeros((1, 3)), Mesh(np.array([7]), np.ones((1, 3)), ()))
    assert nodes[0, 0] == 7
    np.testing.assert_allclose(distances, [[np.sqrt(3.0), np.inf]])


def test_directions_are_turned_into_the_axes_of_a_nodes_results() -> None:
    # A cylindrical frame at 90 degrees: radial is global y, tangential is global -x.
    frame = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    mesh = Mesh(np.array([1, 2]), np.eye(3)[:2], (), {2: frame})
    found = result_directions(np.array([1, 2, 2]), np.eye(3)[[0, 0, 1]], mesh)
    np.testing.assert_allclose(found, [[1, 0, 0], [0, -1, 0], [1, 0, 0]])


@pytest.mark.parametrize(
    ("kind", "nodes", "length"),
    [
        ("quad", [1, 2, 5, 9], 3.0),  # sides 4, 2, 4, 2
        ("line", [1, 2], 4.0),
        ("triangle", [1, 2, 5], (6.0 + np.sqrt(20.0)) / 3.0),
        ("line3", [1, 5, 2], np.sqrt(20.0)),  # its midside node stands last and does not count
        ("tetra", [1, 2, 5, 9], (6.0 + np.sqrt(20.0)) / 3.0),  # the face of its first corners
        ("vertex", [1], 0.0),
    ],
)
def test_the_mean_edge_of_elements(kind: str, nodes: list[int], length: float) -> None:
    cells = Cells(kind, np.array([1]), np.array([nodes]))  # type: ignore[arg-type]
    assert mean_edge(square((cells,))) == pytest.approx(length)


def test_a_mesh_without_elements_has_no_edge() -> None:
    assert mean_edge(square()) == 0.0


def test_a_million_sensors_see_what_their_nodes_do() -> None:
    n = 1_000_000
    rng = np.random.default_rng(5)
    names, every = np.arange(1, 2001), np.tile(np.arange(1, 7), 2000)
    shuffled = rng.permutation(12_000)  # rows of results come in any order
    nodes, components = np.repeat(names, 6)[shuffled], every[shuffled]
    motion = rng.normal(size=(2000, 6))
    modes = mode_set([1.0], motion.reshape(-1, 1)[shuffled], nodes, components)
    at, turns = rng.integers(1, 2001, n), rng.random(n) < 0.1
    directions = rng.normal(size=(n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    test_points = np.arange(n)
    sensors = SensorMap(test_points, 1 + 3 * turns, at, directions, turns, np.zeros(n))
    halves = np.where(turns[:, None], motion[at - 1, 3:], motion[at - 1, :3])
    np.testing.assert_allclose(
        sensors.observe(modes).mode_shapes[:, 0], np.sum(halves * directions, axis=1), atol=1e-12
    )


@pytest.mark.parametrize("turns", [False, True])
@pytest.mark.parametrize("part", [0.0, 0.3, 0.5])
def test_a_sensor_on_an_arm_moves_rigidly_with_a_rigid_bar(turns: bool, part: float) -> None:
    # A rotation about the origin moves a place p by theta x p; all results are in rotated frames.
    rng = np.random.default_rng(7)
    places = rng.normal(size=(2, 3))
    frames = {n: Rotation.random(random_state=n).as_matrix() for n in (1, 2)}
    bar = Cells("line", np.array([5]), np.array([[1, 2]]))
    mesh = Mesh(np.array([1, 2]), places, (bar,), frames, bars=frozenset({5}))
    arm, theta, direction = rng.normal(size=(3, 3))
    nodes, components, factors = section_factors(1, 2, part, arm, turns, mesh)
    assert factors.shape == (nodes.size, 3)
    motion = np.concatenate(
        [frames[n] @ field for n, p in zip((1, 2), places, strict=True)
         for field in (np.cross(theta, p), theta)]
    )  # fmt: skip
    sensor = SensorMap(
        np.array([9]), np.array([4 if turns else 1]), np.array([1]),
        result_directions(np.array([1]), direction[None], mesh), np.array([turns]), np.zeros(1),
        Sections(np.zeros(nodes.size, dtype=np.int64), nodes, components, factors),
    )  # fmt: skip
    seen = sensor.observe(mode_set([1.0], motion[:, None], *EVERY)).mode_shapes[0, 0]
    there = places[0] + part * (places[1] - places[0]) + arm
    expected = direction @ (theta if turns else np.cross(theta, there))
    assert seen == pytest.approx(expected, rel=1e-12)


def test_the_section_next_to_a_place_is_of_the_nearest_bar() -> None:
    places = np.array([[0.0, 0, 0], [2, 0, 0], [2, 3, 0], [9, 9, 9]])
    lines = Cells("line", np.array([1, 2, 3]), np.array([[1, 2], [2, 3], [3, 4]]))
    mesh = Mesh(np.arange(1, 5), places, (lines,), bars=frozenset({1, 2}))
    found = bar_sections(np.array([[0.5, 0.4, 0.0], [2.2, 2.4, 0.0], [-3.0, 0.0, 4.0]]), mesh)
    assert found.nodes.tolist() == [[1, 2], [3, 2], [1, 2]]
    np.testing.assert_allclose(found.parts, [0.25, 0.2, 0.0], rtol=1e-12)
    np.testing.assert_allclose(found.distances, [0.4, 0.2, 5.0], rtol=1e-12)
