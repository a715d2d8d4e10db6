"""Laying a test over a model's surface: random poses, symmetric and mirrored tests, what slides."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from benchmarks.alignment import STRUCTURES, mesh_of, on_surface, sheet
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from modetune.core.errors import ModesError
from modetune.core.measurement.closest_points import SurfacePoints, closest_of
from modetune.core.measurement.registration import Registration, register
from modetune.core.mesh import Mesh
from modetune.core.modes import Floats
from modetune.core.surface import facets
from tests.core.test_surface import BOX, block, one_cell


def laid(
    mesh: Mesh, places: Floats, seed: int = 0, scale: float | None = 1000.0, mirrored: bool = False
) -> tuple[Registration, Floats]:
    """What is found for sensors at places (n, 3) in metres and random axes, and where that is."""
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=seed).as_matrix()
    test = (places - rng.uniform(-5e3, 5e3, 3)) @ rotation / 1000.0
    test *= [1.0, 1.0, -1.0 if mirrored else 1.0]
    found = register(test, SurfacePoints.of(facets(mesh)), mesh.coordinates, scale)
    return found, found.best.apply(test)


def spacing(places: Floats) -> float:
    return float(np.median(KDTree(places).query(places, k=[2])[0]))


#: Solids, shells and beams.
SHAPES = ("bracket", "ribbed plate", "frame", "aircraft")


@cache
def structure(shape: str) -> Mesh:
    if shape == "bracket":
        pytest.importorskip("gmsh", reason="gmsh is not installed")
    return STRUCTURES[shape]()


@pytest.mark.parametrize("shape", SHAPES)
def test_exact_places_are_found_in_any_pose(shape: str) -> None:
    mesh = structure(shape)
    places = on_surface(facets(mesh), 60, np.random.default_rng(7))
    found, where = laid(mesh, places, SHAPES.index(shape))
    # All plates of the aircraft lie along x, which only sensors at edges tell: it is told.
    assert found.slides < 0.01 * np.linalg.norm(np.ptp(mesh.coordinates, axis=0))
    away = np.linalg.norm(where - places, axis=1).max()
    assert away < max(1e-3 * spacing(places), found.slides)
    assert found.others == ()
    assert not found.mirrored


@pytest.mark.parametrize("shape", ["bracket", "aircraft"])
def test_places_by_tape_are_found_as_well_as_they_were_measured(shape: str) -> None:
    mesh, rng = structure(shape), np.random.default_rng(3)
    places = on_surface(facets(mesh), 60, rng)
    size = float(np.linalg.norm(np.ptp(mesh.coordinates, axis=0)))
    error = 0.01 * size / np.sqrt(3.0)
    seen = places + rng.normal(0.0, error, places.shape)
    found, where = laid(mesh, seen, 5)
    # Each of 60 distances tells one of six unknowns: their errors are some thirds of one place's.
    assert np.sqrt(np.mean(np.sum((where - seen) ** 2, axis=1))) < np.sqrt(3.0) * error
    assert 0.3 * error < found.best.rms < 1.5 * error
    assert found.others == ()


@pytest.mark.parametrize("shape", ["ribbed plate", "frame"])
def test_sensors_on_stand_offs_keep_their_nodes(shape: str) -> None:
    mesh, rng = structure(shape), np.random.default_rng(11)
    places = on_surface(facets(mesh), 60, rng)
    size = float(np.linalg.norm(np.ptp(mesh.coordinates, axis=0)))
    away = rng.normal(size=places.shape)
    lifted = places + 0.008 * size * away / np.linalg.norm(away, axis=1, keepdims=True)
    found, where = laid(mesh, lifted, 6)
    assert np.linalg.norm(where - lifted, axis=1).max() < 0.01 * size
    assert not found.mirrored


def test_sensors_of_one_wing_are_found() -> None:
    mesh = structure("aircraft")
    places = on_surface(facets(mesh), 400, np.random.default_rng(2))
    wing = places[(places[:, 1] > 100.0) & (places[:, 2] < 300.0)][:24]
    found, where = laid(mesh, wing, 4)
    # Either wing has them, and either side of it; where both fit both are told.
    poses = [where, *(pose.apply(_seen(wing, 4)) for pose in found.others)]
    nearest = min(np.linalg.norm(pose - wing, axis=1).max() for pose in poses)
    slack = found.slides + 1e-3 * spacing(wing)
    assert nearest <= slack


def _seen(places: Floats, seed: int) -> Floats:
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=seed).as_matrix()
    return np.asarray((places - rng.uniform(-5e3, 5e3, 3)) @ rotation / 1000.0)


def test_mirrored_axes_are_told() -> None:
    mesh = structure("ribbed plate")
    places = on_surface(facets(mesh), 60, np.random.default_rng(1))
    assert laid(mesh, places, 1, mirrored=True)[0].mirrored


def test_poses_of_a_symmetric_plate_are_all_told() -> None:
    x, y = np.linspace(0.0, 800.0, 9), np.linspace(0.0, 400.0, 5)
    places, quads = sheet(x, y, np.zeros(3), *np.eye(3)[:2])
    mesh = mesh_of(places, ("quad", quads))
    found, _ = laid(mesh, places[[0, 4, 22, 40, 44, 8, 31, 13]], 3)
    assert len(found.others) == 3  # half turns about the three axes
    assert found.on_nodes
    poses = [found.best, *found.others]
    turns = [
        Rotation.from_matrix(pose.rotation @ found.best.rotation.T).magnitude() for pose in poses
    ]
    np.testing.assert_allclose(np.degrees(turns), [0.0, 180.0, 180.0, 180.0], atol=1e-6)


def test_sensors_amid_a_plate_slide() -> None:
    x, y = np.linspace(0.0, 800.0, 9), np.linspace(0.0, 400.0, 5)
    nodes, quads = sheet(x, y, np.zeros(3), *np.eye(3)[:2])
    mesh = mesh_of(nodes, ("quad", quads))
    rng = np.random.default_rng(0)
    places = np.column_stack([rng.uniform([300, 150], [500, 250], (12, 2)), np.zeros(12)])
    # From amid the plate they may go some 150 mm and more before one leaves it.
    assert laid(mesh, places)[0].slides > 50.0


@pytest.mark.parametrize("shape", ["bracket", "aircraft"])
def test_a_stray_point_takes_no_part(shape: str) -> None:
    mesh = structure(shape)
    places = on_surface(facets(mesh), 30, np.random.default_rng(9))
    size = float(np.linalg.norm(np.ptp(mesh.coordinates, axis=0)))
    stray = np.vstack([places, places.mean(axis=0) + 0.6 * size * np.array([0.6, 0.0, 0.8])])
    found, where = laid(mesh, stray, 8)
    away = np.linalg.norm(where[:-1] - places, axis=1).max()
    assert away < max(1e-3 * spacing(places), found.slides)
    assert found.best.used.tolist() == [True] * 30 + [False]


def test_a_scale_without_units_is_found() -> None:
    mesh = structure("frame")
    found, where = laid(mesh, mesh.coordinates[::3], 2, scale=None)
    assert found.best.scale == pytest.approx(1000.0, rel=1e-9)
    np.testing.assert_allclose(where, mesh.coordinates[::3], atol=1e-6)


@pytest.mark.parametrize("points", [np.eye(3)[:2], np.zeros((0, 3)), np.ones((4, 3))])
def test_points_that_fix_no_rotation_are_refused(points: Floats) -> None:
    mesh = block((2, 2, 2), (1.0, 2.0, 3.0))
    with pytest.raises(ModesError, match=r"takes three or more|lie on one line"):
        register(points, SurfacePoints.of(facets(mesh)), mesh.coordinates, 1.0)


def test_closest_points_are_those_of_all_triangles() -> None:
    rng = np.random.default_rng(4)
    # Sizes from 1 to 1000, beams and lone nodes among them.
    corners = rng.normal(size=(300, 3, 3)) * 10.0 ** rng.uniform(0, 1.5, (300, 1, 1))
    corners += rng.uniform(-100, 100, (300, 1, 3))
    corners[:40, 2] = corners[:40, 1]
    corners[40:50] = corners[40:50, :1]
    places = rng.uniform(-100, 100, (500, 3))
    found = SurfacePoints.of(corners).closest(places)
    feet, _ = closest_of(corners[None], places[:, None])
    wanted = np.linalg.norm(feet - places[:, None], axis=2).min(axis=1)
    # Triangles of ten sizes across each other are worse than any mesh.
    assert (found.distances >= wanted - 1e-12).all()
    assert np.mean(found.distances < wanted + 1e-9) > 0.99


def test_closest_points_of_a_triangle_by_hand() -> None:
    corners = np.array([[0.0, 0, 0], [2, 0, 0], [0, 2, 0]])
    places = np.array([[0.5, 0.5, 3], [1, -1, 0], [-1, -1, 0], [2, 2, 1], [3, 0, 0]])
    feet, where = closest_of(corners[None], places)
    wanted = np.array([[0.5, 0.5, 0], [1, 0, 0], [0, 0, 0], [1, 1, 0], [2, 0, 0]])
    np.testing.assert_allclose(feet, wanted)
    assert where.tolist() == [4, 0, 3, 1, 3]


def area(corners: Floats) -> float:
    a, b, c = corners.transpose(1, 0, 2)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0)


def test_facets_are_the_outer_faces_and_beams_and_lone_nodes() -> None:
    corners = facets(block((2, 3, 4), (2.0, 3.0, 5.0)))
    assert area(corners) == pytest.approx(2 * (6.0 + 10.0 + 15.0))
    assert len(corners) == 2 * 2 * (6 + 8 + 12)
    line = facets(one_cell("line", BOX[:2]))
    np.testing.assert_allclose(line[:, [0, 2]].reshape(-1, 3)[[0, -1]], BOX[:2])
    lone = Mesh(np.array([1, 2]), BOX[:2], ())
    np.testing.assert_allclose(facets(lone)[:, 0], BOX[:2])


def test_midside_nodes_bend_a_face() -> None:
    # A quarter of a cylinder of radius 1 by one element with its midside nodes on the circle.
    angles = np.radians([0.0, 90.0, 90.0, 0.0, 45.0, 90.0, 45.0, 0.0])
    z = np.array([0.0, 0.0, 1.0, 1.0, 0.0, 0.5, 1.0, 0.5])
    places = np.column_stack([np.cos(angles), np.sin(angles), z])
    bent = SurfacePoints.of(facets(one_cell("quad8", places)))
    np.testing.assert_allclose(bent.closest(places).distances, 0.0, atol=1e-12)
    assert area(facets(one_cell("quad8", places))) == pytest.approx(4 * np.sin(np.pi / 8), rel=0.05)
