"""Surfaces for pictures: what is outside, and what stays when there are too many nodes."""

from __future__ import annotations

import numpy as np
import pytest

from modetune.core.mesh import CellKind, Cells, Mesh
from modetune.core.modes import Floats, Integers
from modetune.core.surface import Surface, display_surface

BOX = np.array(
    [[0, 0, 0], [2, 0, 0], [2, 3, 0], [0, 3, 0], [0, 0, 5], [2, 0, 5], [2, 3, 5], [0, 3, 5]], float
)


def block(divisions: tuple[int, int, int], sides: tuple[float, float, float]) -> Mesh:
    """A box of hexahedra with a corner in the origin."""
    lines = [np.linspace(0.0, s, n + 1) for s, n in zip(sides, divisions, strict=True)]
    places = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(1, len(places) + 1).reshape([n + 1 for n in divisions])
    low, high = slice(None, -1), slice(1, None)
    corners = [
        number[cut].ravel()
        for cut in (
            (low, low, low), (high, low, low), (high, high, low), (low, high, low),
            (low, low, high), (high, low, high), (high, high, high), (low, high, high),
        )
    ]  # fmt: skip
    nodes = np.stack(corners, axis=1)
    return Mesh(number.ravel(), places, (Cells("hexahedron", np.arange(1, len(nodes) + 1), nodes),))


def tube(around: int, along: int, radius: float, length: float) -> Mesh:
    """A round tube of quadrilaterals about z."""
    angle, z = np.meshgrid(
        np.arange(around) * 2.0 * np.pi / around, np.linspace(0.0, length, along), indexing="ij"
    )
    places = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1).reshape(-1, 3)
    number = np.arange(1, around * along + 1).reshape(around, along)
    after = np.roll(number, -1, axis=0)
    parts = (number[:, :-1], after[:, :-1], after[:, 1:], number[:, 1:])
    nodes = np.stack([part.ravel() for part in parts], axis=1)
    return Mesh(number.ravel(), places, (Cells("quad", np.arange(1, len(nodes) + 1), nodes),))


def one_cell(kind: CellKind, places: Floats) -> Mesh:
    nodes = np.arange(1, len(places) + 1)
    return Mesh(nodes, places, (Cells(kind, np.array([1]), nodes[None]),))


def corners(surface: Surface) -> Floats:
    return surface.coordinates[surface.triangles]


def area(surface: Surface) -> float:
    a, b, c = corners(surface).transpose(1, 0, 2)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0)


def enclosed(surface: Surface) -> float:
    """Volume inside by the divergence theorem: positive if all triangles look outside."""
    a, b, c = corners(surface).transpose(1, 0, 2)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


@pytest.mark.parametrize(
    ("kind", "places", "volume", "triangles", "edges"),
    [  # base times height, and its half, third and sixth
        ("hexahedron", BOX, 30.0, 12, 12),
        ("wedge", BOX[[0, 1, 3, 4, 5, 7]], 15.0, 8, 9),
        ("pyramid", BOX[[0, 1, 2, 3, 4]], 10.0, 6, 8),
        ("tetra", BOX[[0, 1, 3, 4]], 5.0, 4, 6),
    ],
)
def test_faces_of_a_solid_look_outside(
    kind: CellKind, places: Floats, volume: float, triangles: int, edges: int
) -> None:
    surface = display_surface(one_cell(kind, places))
    assert enclosed(surface) == pytest.approx(volume)
    assert (len(surface.triangles), len(surface.edges)) == (triangles, edges)


def test_inner_faces_and_nodes_are_left_out() -> None:
    surface = display_surface(block((4, 3, 2), (8.0, 6.0, 4.0)))
    assert surface.nodes.size == 5 * 4 * 3 - 3 * 2 * 1  # all but those inside
    assert area(surface) == pytest.approx(2.0 * (48.0 + 32.0 + 24.0))
    assert enclosed(surface) == pytest.approx(192.0)
    # Euler: V - E + F = 2 for the quadrilateral faces of a closed surface.
    assert surface.nodes.size - len(surface.edges) + len(surface.triangles) // 2 == 2


def test_shells_and_lines_are_drawn_by_their_corners() -> None:
    places = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0, 0], [9, 9, 9]], float)
    mesh = Mesh(
        np.array([10, 20, 30, 40, 50, 60]),
        places,
        (
            Cells("triangle6", np.array([1]), np.array([[10, 20, 30, 50, 50, 50]])),
            Cells("line3", np.array([2]), np.array([[30, 40, 50]])),
            Cells("vertex", np.array([3]), np.array([[60]])),
        ),
    )
    surface = display_surface(mesh)
    assert surface.nodes.tolist() == [10, 20, 30, 40]
    assert surface.triangles.tolist() == [[0, 1, 2]]
    assert sorted(map(sorted, surface.edges.tolist())) == [[0, 1], [0, 2], [1, 2], [2, 3]]


def test_a_face_of_two_shells_is_drawn_once() -> None:
    places = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    mesh = Mesh(
        np.array([1, 2, 3]),
        places,
        (Cells("triangle", np.array([1, 2]), np.array([[1, 2, 3], [1, 3, 2]])),),
    )
    assert display_surface(mesh).triangles.tolist() == [[0, 1, 2]]


def test_a_mesh_without_cells_gives_its_nodes() -> None:
    places = np.arange(30.0).reshape(10, 3)
    surface = display_surface(Mesh(np.arange(1, 11), places, ()))
    assert surface.nodes.tolist() == list(range(1, 11))
    assert (surface.triangles.shape, surface.edges.shape) == ((0, 3), (0, 2))
    few = display_surface(Mesh(np.arange(1, 11), places, ()), at_most=4)
    assert 2 <= few.nodes.size <= 4
    empty = display_surface(Mesh(np.zeros(0, np.int64), np.zeros((0, 3)), ()))
    assert empty.nodes.size == 0


@pytest.mark.parametrize("at_most", [1, 60, 300, 1500])
def test_a_thinned_block_keeps_corners_edges_and_its_volume(at_most: int) -> None:
    mesh = block((24, 24, 24), (1.0, 1.0, 1.0))
    surface = display_surface(mesh, at_most)
    assert surface.nodes.size <= at_most
    check_rows(surface, mesh)
    if at_most > 1:
        # Edges and corners go before other nodes, so that the block stays a block.
        for corner in np.ndindex(2, 2, 2):
            assert (surface.coordinates == corner).all(axis=1).any()
        assert enclosed(surface) == pytest.approx(1.0, rel=1e-9)
        outside = surface.coordinates[surface.edges]
        assert (np.isin(outside, (0.0, 1.0)).sum(axis=2) >= 2).all()  # along the block's edges


def test_a_solid_plate_thinner_than_a_cube_becomes_one_sheet() -> None:
    surface = display_surface(block((60, 40, 1), (300.0, 200.0, 2.0)), 500)
    assert surface.nodes.size <= 500
    # Seen from above every place is covered once: the plan area, not two times it.
    flat = corners(surface)[:, :, :2]
    first, second = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    plan = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]).sum() / 2.0
    assert plan == pytest.approx(300.0 * 200.0, rel=1e-9)
    assert area(surface) == pytest.approx(plan, rel=0.05)


def test_a_tube_stays_round_and_hollow() -> None:
    surface = display_surface(tube(60, 80, 50.0, 300.0), 600)
    assert 300 <= surface.nodes.size <= 600
    # A polygon of about 24 sides has an outline 1 - (pi / 24)^2 / 6 of the circle's.
    assert area(surface) == pytest.approx(2.0 * np.pi * 50.0 * 300.0, rel=0.02)
    # Its two ends are the only edges.
    assert np.isin(surface.coordinates[surface.edges][:, :, 2], (0.0, 300.0)).all()


def test_a_bar_thinner_than_a_cube_becomes_a_line_from_end_to_end() -> None:
    mesh = tube(24, 400, 1.0, 1000.0)
    surface = display_surface(mesh, 100)
    assert surface.triangles.shape[0] == 0
    drawn = surface.coordinates[surface.edges][:, :, 2]
    assert drawn.min() == 0.0
    assert drawn.max() == 1000.0
    assert np.abs(np.diff(drawn, axis=1)).sum() == pytest.approx(1000.0)


def test_the_same_nodes_stay_whatever_unit_place_and_order_of_elements() -> None:
    mesh = tube(50, 60, 50.0, 300.0)
    few = display_surface(mesh, 400)
    (quads,) = mesh.cells
    order = np.random.default_rng(1).permutation(quads.elements.size)
    shuffled = Cells("quad", quads.elements[order], quads.nodes[order])
    for other in (
        Mesh(mesh.nodes, mesh.coordinates * 0.0254, mesh.cells),
        Mesh(mesh.nodes, mesh.coordinates, (shuffled,)),
        Mesh(mesh.nodes + 1000, mesh.coordinates, (Cells("quad", order, quads.nodes + 1000),)),
    ):
        again = display_surface(other, 400)
        assert again.coordinates.shape == few.coordinates.shape
        assert (again.nodes - other.nodes[0] == few.nodes - mesh.nodes[0]).all()
        assert as_set(again.triangles) == as_set(few.triangles)


def test_nodes_that_stay_are_pinned() -> None:
    # What is stored in a record must be found again by another machine.
    surface = display_surface(block((6, 4, 2), (6.0, 4.0, 2.0)), 40)
    assert surface.nodes.tolist() == [
        1,
        3,
        7,
        9,
        13,
        15,
        31,
        33,
        37,
        39,
        43,
        45,
        46,
        48,
        52,
        54,
        58,
        60,
        76,
        78,
        82,
        84,
        88,
        90,
        91,
        93,
        97,
        99,
        103,
        105,
    ]


def as_set(triangles: Integers) -> set[tuple[int, ...]]:
    return {tuple(sorted(row)) for row in triangles.tolist()}


def check_rows(surface: Surface, mesh: Mesh) -> None:
    """Real nodes, ascending, each used; triangles and edges with distinct ends, each once."""
    rows = mesh.rows(surface.nodes)  # raises for a node that is not there, or not ascending
    np.testing.assert_array_equal(mesh.coordinates[rows], surface.coordinates)
    assert (np.diff(surface.nodes) > 0).all()
    for table in (surface.triangles, surface.edges):
        assert len(as_set(table)) == len(table)
        assert all(len(set(row)) == len(row) for row in table.tolist())
