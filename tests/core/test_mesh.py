"""Strain of a mesh from displacements: rigid motion, stretching, bending of one layer of solids."""

from __future__ import annotations

import numpy as np
import pytest

from modetune.core.mesh import Cells, Mesh, node_strains, part_labels
from modetune.core.modes import Floats

#: Corners of a box of lengths 4, 2 and 1, in the order of VTK.
CORNERS = np.array(
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
) * np.array([4.0, 2.0, 1.0])


def box() -> Mesh:
    nodes = np.arange(1, 9)
    return Mesh(nodes, CORNERS, (Cells("hexahedron", np.array([1]), nodes[None, :]),))


def bars() -> Mesh:
    """Two bars of lengths 2 and 4 along x, and a mass at the end."""
    nodes = np.array([1, 2, 3])
    places = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [6.0, 0.0, 0.0]])
    links = Cells("line", np.array([1, 2]), np.array([[1, 2], [2, 3]]))
    return Mesh(nodes, places, (links, Cells("vertex", np.array([3]), np.array([[3]]))))


def field(values: Floats) -> Floats:
    return np.asarray(values)[None, :, :]


def test_rigid_motion_strains_nothing() -> None:
    turn = np.array([0.3, -0.2, 0.5])
    moved = np.array([1.0, 2.0, 3.0]) + np.cross(turn, CORNERS)
    assert node_strains(box(), field(moved)) == pytest.approx(np.zeros(8), abs=1e-12)


def test_equal_stretching_in_all_directions_is_that_strain_everywhere() -> None:
    assert node_strains(box(), field(1e-3 * CORNERS)) == pytest.approx(np.full(8, 1e-3))


def test_bars_have_their_elongation_and_nodes_the_mean_square_of_their_bars() -> None:
    # Elongations 0.02 / 2 and 0.02 / 4; motion across a bar counts for nothing.
    moved = np.array([[0.0, 0.0, 0.0], [0.02, 0.5, 0.0], [0.04, 0.0, 0.0]])
    strains = node_strains(bars(), field(moved))
    middle = np.sqrt((0.01**2 + 0.005**2) / 2)
    assert strains == pytest.approx([0.01, middle, 0.005])


def test_bending_of_one_layer_is_seen_by_the_edges_along_it_alone() -> None:
    # u = kappa (x - 2) (z - 1/2): four edges along x elongate by +-1/2 kappa of the 28 pairs, and
    # four diagonals of the lower and upper face, of squared length 20, by 4 * (+-2 kappa) / 20.
    kappa = 1e-3
    moved = np.zeros((8, 3))
    moved[:, 0] = kappa * (CORNERS[:, 0] - 2.0) * (CORNERS[:, 2] - 0.5)
    expected = np.sqrt((4 * (kappa / 2) ** 2 + 4 * (4 * 2 * kappa / 20.0) ** 2) / 28)
    assert node_strains(box(), field(moved)) == pytest.approx(np.full(8, expected))


def test_several_fields_count_by_their_mean_square() -> None:
    both = np.stack([3e-3 * CORNERS, 4e-3 * CORNERS])
    assert node_strains(box(), both) == pytest.approx(np.full(8, np.sqrt(12.5) * 1e-3))


def test_a_spring_between_nodes_at_one_place_has_no_strain() -> None:
    nodes = np.array([1, 2])
    mesh = Mesh(nodes, np.zeros((2, 3)), (Cells("line", np.array([1]), nodes[None, :]),))
    assert node_strains(mesh, field(np.array([[0.0, 0, 0], [1.0, 0, 0]]))).tolist() == [0.0, 0.0]


def test_parts_are_what_elements_join_through_the_given_nodes() -> None:
    nodes = np.arange(1, 8)
    chain = Cells("line", np.arange(1, 6), np.array([[1, 2], [2, 3], [3, 4], [5, 6], [6, 7]]))
    mesh = Mesh(nodes, np.zeros((7, 3)), (chain,))
    assert part_labels(mesh, nodes).tolist() == [0, 0, 0, 0, 1, 1, 1]
    # Without node 2, node 1 has no neighbour among them.
    assert part_labels(mesh, np.array([1, 3, 4, 6])).tolist() == [0, 1, 1, 2]
    assert part_labels(mesh, nodes[:0]).size == 0
