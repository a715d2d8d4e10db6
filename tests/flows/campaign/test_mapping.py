"""From test points to model nodes: alignments, tolerances, tilted sensors, doubts and refusals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import TestGeometry
from modetune.core.mesh import Cells, Mesh
from modetune.core.modes import Floats, Integers, ModeSet, mode_set
from modetune.flows.campaign.mapping import Mapping, map_sensors
from modetune.flows.campaign.schema import SensorSection
from modetune.flows.cli.sensors import sensor_lines, sensor_table, sensors_json
from modetune.flows.report import mesh_picture
from modetune.flows.report.mesh_picture import save_sensor_picture

MM = 1e-3


def plate(frames: dict[int, Floats] | None = None) -> Mesh:
    """A tapered plate in mm, 9 by 5 nodes 100 mm apart at its root, one tip node raised."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(9.0), np.arange(5.0), indexing="ij"))
    places = np.column_stack([100.0 * x, 100.0 * y * (1.0 - 0.05 * x), np.zeros(45)])
    places[44, 2] = 150.0
    corners = [
        [1 + 5 * i + j, 6 + 5 * i + j, 7 + 5 * i + j, 2 + 5 * i + j]
        for i in range(8)
        for j in range(4)
    ]
    quads = Cells("quad", np.arange(1, 33), np.array(corners))
    return Mesh(np.arange(1, 46), places, (quads,), frames or {})


def sensors(nodes: list[int], components: list[int]) -> ModeSet:
    shapes = np.ones((len(nodes), 1))
    return mode_set([10.0], shapes, nodes, components)


def geometry(
    nodes: list[int] | Integers, places: Floats, metres: float = MM, frames: Floats | None = None
) -> TestGeometry:
    n = len(nodes)
    axes = np.tile(np.eye(3), (n, 1, 1)) if frames is None else frames
    nothing = np.zeros((0, 2), np.int64)
    return TestGeometry(
        np.asarray(nodes), places, axes, nothing, np.zeros((0, 3), np.int64), metres
    )


def section(**keys: Any) -> SensorSection:
    return SensorSection.model_validate(keys)


def at_nodes(mesh: Mesh, nodes: list[int]) -> Floats:
    return mesh.coordinates[mesh.rows(np.array(nodes))]


#: Test points 201.. at these nodes of the plate.
MAPPED_NODES = [1, 3, 5, 21, 25, 41, 43, 45]
NAMES = list(range(201, 209))


def mapped(
    places: Floats, metres: float = MM, frames: Floats | None = None, **keys: Any
) -> Mapping:
    return map_sensors(
        sensors(NAMES, [3] * 8),
        geometry(NAMES, places, metres, frames),
        plate(),
        section(**keys),
        MM,
    )


def test_without_geometry_sensors_are_nodes_in_the_axes_of_their_results() -> None:
    frame = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    found = map_sensors(sensors([3, 7], [1, 5]), None, plate({3: frame}), section(), MM)
    assert found.alignment is None
    assert found.sensors.model_nodes.tolist() == [3, 7]
    # As before there was a map: component x of node 3 is its results' x.
    np.testing.assert_array_equal(found.sensors.directions, [[1, 0, 0], [0, 1, 0]])
    assert found.sensors.turns.tolist() == [False, True]
    assert [row.verdict for row in found.table] == ["good", "good"]


def test_numbers_that_are_not_the_models_are_matched_by_hand() -> None:
    found = map_sensors(sensors([901, 7], [3, 3]), None, plate(), section(match={901: 4}), MM)
    assert found.sensors.nodes.tolist() == [901, 7]
    assert found.sensors.model_nodes.tolist() == [4, 7]


def test_a_node_the_model_lacks_is_refused_and_named() -> None:
    with pytest.raises(CampaignError, match=r"2 sensors.*sensor 99: .*no results at a node 99.*98"):
        map_sensors(sensors([99, 1, 98], [3, 3, 3]), None, plate(), section(), MM)


def test_metres_of_the_test_become_millimetres_of_the_model() -> None:
    found = mapped(at_nodes(plate(), MAPPED_NODES) / 1000.0, metres=1.0)
    assert found.sensors.model_nodes.tolist() == MAPPED_NODES
    assert found.alignment is not None
    assert found.alignment.scale == pytest.approx(1000.0)
    assert found.notes == ()
    np.testing.assert_allclose(found.sensors.distances, 0.0, atol=1e-9)


def test_a_test_without_units_is_taken_in_the_models_and_told() -> None:
    found = mapped(at_nodes(plate(), MAPPED_NODES), metres=float("nan"))
    assert found.sensors.model_nodes.tolist() == MAPPED_NODES
    assert found.notes[0].startswith("the test has no unit of length; assumed that of the model")
    assert len(found.notes) == 1


def test_a_wrong_unit_is_told_with_the_one_that_would_fit() -> None:
    with pytest.raises(CampaignError) as raised:
        mapped(at_nodes(plate(), MAPPED_NODES) / 1000.0, metres=float("nan"))
    assert "all sensors are within" in str(raised.value)
    # The plate spans sqrt(800^2 + 400^2 + 150^2) = 907 mm; as metres its sensors span 0.9.
    assert "; m would fit" in str(raised.value)
    assert "spans 0.9069 mm and the model 906.9 mm" in str(raised.value)


def test_a_given_scale_goes_before_the_units_and_says_so() -> None:
    found = mapped(at_nodes(plate(), MAPPED_NODES) / 10.0, metres=1.0, scale=10.0)
    assert found.sensors.model_nodes.tolist() == MAPPED_NODES
    assert found.notes == ("`scale` 10 is used, although the units of test and model give 1000",)


@pytest.mark.parametrize("as_matrix", [False, True])
def test_given_rotation_and_translation_place_the_test(as_matrix: bool) -> None:
    angles = (30.0, -20.0, 75.0)
    about_x, about_y, about_z = (
        Rotation.from_rotvec(np.radians(angle) * axis).as_matrix()
        for angle, axis in zip(angles, np.eye(3), strict=True)
    )
    rotation = about_z @ about_y @ about_x  # about the model's x first, then y, then z
    shift = np.array([5.0, -70.0, 300.0])
    test = (at_nodes(plate(), MAPPED_NODES) - shift) @ rotation
    given = rotation.tolist() if as_matrix else angles
    found = mapped(test, rotation=given, translation=shift.tolist())
    assert found.sensors.model_nodes.tolist() == MAPPED_NODES
    np.testing.assert_allclose(found.sensors.distances, 0.0, atol=1e-9)
    # z of the test is the third column of the rotation in the model.
    np.testing.assert_allclose(
        found.sensors.directions, np.tile(rotation[:, 2], (8, 1)), atol=1e-12
    )


def test_a_test_in_its_own_axes_is_fitted() -> None:
    rotation = Rotation.from_euler("xyz", [10, 25, -140], degrees=True).as_matrix()
    test = (at_nodes(plate(), MAPPED_NODES) / 1000.0 - [3.0, 1.0, -2.0]) @ rotation
    found = mapped(test, metres=1.0, align="fit")
    assert found.sensors.model_nodes.tolist() == MAPPED_NODES
    assert found.alignment is not None
    np.testing.assert_allclose(found.alignment.rotation, rotation, atol=1e-6)
    assert found.alignment.largest < 1e-6


def test_a_fit_without_units_finds_the_unit() -> None:
    # Placed by hand, to 5 mm: a free scale would come out some percent small.
    rng = np.random.default_rng(2)
    rotation = Rotation.from_euler("xyz", [70, 0, -30], degrees=True).as_matrix()
    placed = at_nodes(plate(), MAPPED_NODES) + rng.normal(0.0, 5.0, (8, 3))
    found = mapped((placed / 25.4) @ rotation, metres=float("nan"), align="fit")
    assert found.alignment is not None
    assert found.alignment.scale == pytest.approx(25.4, rel=1e-12)
    assert "assumed in, which fits the model" in found.notes[-1]
    assert found.sensors.model_nodes.tolist() == MAPPED_NODES


def test_a_fit_of_a_scale_that_is_no_unit_says_so() -> None:
    found = mapped(at_nodes(plate(), MAPPED_NODES) / 7.0, metres=float("nan"), align="fit")
    assert found.alignment is not None
    assert found.alignment.scale == pytest.approx(7.0)
    assert "no known unit fits; the fitted scale is 7" in found.notes[-1]


def test_three_partners_fix_the_fit_and_the_rest_follows() -> None:
    rotation = Rotation.from_euler("xyz", [200, 5, 60], degrees=True).as_matrix()
    test = (at_nodes(plate(), MAPPED_NODES) / 1000.0) @ rotation
    found = mapped(test, metres=float("nan"), match={201: 1, 203: 5, 206: 41})
    assert found.sensors.model_nodes.tolist() == MAPPED_NODES
    assert found.alignment is not None
    assert found.alignment.scale == pytest.approx(1000.0)


def test_partners_that_do_not_suffice_are_refused() -> None:
    with pytest.raises(CampaignError, match="partners are 2; a fit takes three or more"):
        mapped(at_nodes(plate(), MAPPED_NODES), match={201: 1, 203: 5})
    with pytest.raises(CampaignError, match=r"lie on one line.*give `scale`, `rotation`"):
        mapped(at_nodes(plate(), MAPPED_NODES), match={201: 1, 202: 3, 203: 5})
    with pytest.raises(CampaignError, match="test point 777, which has no coordinates"):
        mapped(at_nodes(plate(), MAPPED_NODES), match={201: 1, 202: 3, 777: 5})
    with pytest.raises(CampaignError, match="model node 46, which has no results"):
        mapped(at_nodes(plate(), MAPPED_NODES), match={201: 46})


def test_a_sensor_matched_by_hand_takes_no_other_node() -> None:
    # With `align: none` partners do not move the test.
    found = mapped(at_nodes(plate(), MAPPED_NODES), align="none", match={201: 2})
    assert found.sensors.model_nodes.tolist() == [2, *MAPPED_NODES[1:]]
    assert found.table[0].distance == pytest.approx(100.0)
    assert found.table[0].reason == "farther than the tolerance"


def test_a_tilted_single_axis_sensor_reads_its_direction_in_the_nodes_axes() -> None:
    """Test axes turned against the model, the sensor against these, the node against both."""
    to_model = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    cylindrical = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # radial is y at 90 degrees
    mesh = plate({5: cylindrical})
    looks = np.array([0.6, 0.0, 0.8])  # of component x, in the test's axes
    frames = np.array([[looks, [0, 1, 0], [-0.8, 0, 0.6]]])
    place = mesh.coordinates[[4]] @ to_model  # the row of node 5, seen from the test
    found = map_sensors(
        sensors([31], [1]),
        geometry([31], place, MM, frames),
        mesh,
        section(rotation=[0, 0, 90]),
        MM,
    )
    # By hand: test x is the model's y, which is radial there: u = 0.6 u_r + 0.8 u_z.
    np.testing.assert_allclose(found.sensors.directions, [[0.6, 0.0, 0.8]], atol=1e-12)
    np.testing.assert_allclose(found.table[0].direction, [0.0, 0.6, 0.8], atol=1e-12)
    motion = mode_set([1.0], [[2.0], [7.0], [-1.0]], [5, 5, 5], [1, 2, 3])
    seen = found.sensors.observe(motion)
    np.testing.assert_allclose(seen.mode_shapes, [[0.6 * 2.0 + 0.8 * -1.0]])


def test_sensors_of_a_cylindrical_test_see_a_breathing_ring_alike() -> None:
    angles = np.radians([0.0, 60.0, 120.0, 180.0, 240.0, 300.0])
    radial = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(6)])
    tangential = np.column_stack([-np.sin(angles), np.cos(angles), np.zeros(6)])
    frames = np.stack([radial, tangential, np.tile([0.0, 0, 1], (6, 1))], axis=1)
    names = list(range(1, 7))
    ring = Mesh(np.arange(1, 7), 50.0 * radial, ())
    found = map_sensors(
        sensors(names * 2, [1] * 6 + [2] * 6),
        geometry(names, 50.0 * radial, MM, frames),
        ring,
        section(),
        MM,
    )
    breathing = mode_set([1.0], radial.reshape(-1, 1), np.repeat(names, 3), np.tile([1, 2, 3], 6))
    seen = found.sensors.observe(breathing).mode_shapes[:, 0]
    np.testing.assert_allclose(seen, [1.0] * 6 + [0.0] * 6, atol=1e-12)


def test_the_default_tolerance_is_the_larger_of_both_rules() -> None:
    found = mapped(at_nodes(plate(), MAPPED_NODES))
    edges = [0.0]
    mesh = plate()
    for corners in mesh.cells[0].nodes:
        places = mesh.coordinates[corners - 1]
        edges += np.linalg.norm(places - np.roll(places, 1, axis=0), axis=1).tolist()
    assert found.tolerance == pytest.approx(np.sum(edges) / 128.0 / 2.0)  # 32 quads, 4 edges each
    assert found.tolerance > 0.02 * np.linalg.norm([800.0, 400.0, 150.0])


def test_sensors_beyond_the_tolerance_are_all_named_with_their_distances() -> None:
    places = at_nodes(plate(), MAPPED_NODES)
    places[1, 2] += 60.0
    places[6, 2] += 81.0
    with pytest.raises(CampaignError) as raised:
        mapped(places)
    said = str(raised.value)
    assert said.startswith("2 sensors are without a node in the model (tolerance ")
    assert "sensor 202: the nearest node, 3, is 60 mm away" in said
    assert "sensor 207: the nearest node, 43, is 81 mm away" in said
    for remedy in ("align: fit", "tolerance", "unmapped: leave_out"):
        assert remedy in said


def test_they_are_left_out_only_when_told_so() -> None:
    places = at_nodes(plate(), MAPPED_NODES)
    places[1, 2] += 60.0
    found = mapped(places, unmapped="leave_out")
    assert found.rows.tolist() == [0, 2, 3, 4, 5, 6, 7]
    assert found.sensors.nodes.tolist() == [201, 203, 204, 205, 206, 207, 208]
    assert [row.test_node for row in found.left_out] == [202]
    assert found.notes[0].startswith("left out: 1 sensor is without a node in the model")


def test_leaving_out_all_sensors_is_refused() -> None:
    with pytest.raises(
        CampaignError, match=r"8 sensors are without a node.*no other sensor remains"
    ):
        mapped(at_nodes(plate(), MAPPED_NODES) + np.array([0.0, 0.0, 5e3]), unmapped="leave_out")


def test_a_larger_tolerance_takes_them() -> None:
    places = at_nodes(plate(), MAPPED_NODES)
    places[1, 2] += 60.0
    assert mapped(places, tolerance=61.0).sensors.model_nodes.tolist() == MAPPED_NODES


def test_doubtful_sensors_are_named_with_the_reason() -> None:
    places = at_nodes(plate(), MAPPED_NODES)
    places[0, 2] += 30.0  # more than half of 48
    places[1] = [0.0, 149.0, 0.0]  # nearly half way from node 2 to node 3
    found = mapped(places, tolerance=55.0)
    assert [(row.test_node, row.reason) for row in found.doubtful] == [
        (201, "more than half the tolerance away"),
        (202, "more than half the tolerance away; node 3 is as near"),
    ]


def test_points_read_at_one_node_are_told_where_they_are_apart() -> None:
    places = at_nodes(plate(), MAPPED_NODES)
    places[1] = places[0] + [10.0, 0.0, 0.0]
    found = mapped(places)
    assert [row.reason for row in found.doubtful] == [
        "read at the same node as test point 202",
        "read at the same node as test point 201",
    ]
    places[1] = places[0]  # two sensors on one block
    assert mapped(places).doubtful == ()


def test_two_model_nodes_in_one_place_are_told() -> None:
    mesh = plate()
    joint = Mesh(
        np.append(mesh.nodes, 99), np.vstack([mesh.coordinates, mesh.coordinates[:1]]), mesh.cells
    )
    found = map_sensors(
        sensors([201], [3]), geometry([201], mesh.coordinates[:1]), joint, section(), MM
    )
    assert "has the same position" in found.doubtful[0].reason


def test_points_without_coordinates_are_named() -> None:
    with pytest.raises(CampaignError, match="sensor 208: the test has no coordinates of it"):
        map_sensors(
            sensors(NAMES, [3] * 8),
            geometry(NAMES[:7], at_nodes(plate(), MAPPED_NODES[:7])),
            plate(),
            section(),
            MM,
        )


def test_rotations_that_the_model_does_not_compute_are_refused_or_left_out() -> None:
    measured, places = sensors([1, 1], [3, 5]), geometry([1], at_nodes(plate(), [7]))
    solids = frozenset({1, 2, 3})
    for where in (None, places):
        with pytest.raises(CampaignError, match=r"sensor 1.ry: the model's results have no ry"):
            map_sensors(measured, where, plate(), section(), MM, solids)
    found = map_sensors(measured, places, plate(), section(unmapped="leave_out"), MM, solids)
    assert found.rows.tolist() == [0]
    assert found.table[1].verdict == "left out"


def test_settings_about_places_need_coordinates() -> None:
    for keys in ({"align": "fit"}, {"scale": 2.0}, {"translation": [1, 2, 3]}):
        with pytest.raises(CampaignError, match="the test has no coordinates"):
            map_sensors(sensors([1], [3]), None, plate(), section(**keys), MM)


def test_numbers_are_used_in_spite_of_coordinates_when_asked() -> None:
    far = geometry([3], np.array([[9e9, 0, 0]]))
    found = map_sensors(sensors([3], [3]), far, plate(), section(by="number"), MM)
    assert found.alignment is None
    assert found.sensors.model_nodes.tolist() == [3]


def test_a_test_of_frequencies_alone_has_nothing_to_map() -> None:
    found = map_sensors(
        mode_set([1.0, 2.0]), geometry([1], np.zeros((1, 3))), plate(), section(), MM
    )
    assert (found.sensors.n_sensors, found.table, found.rows.size) == (0, (), 0)


def test_a_fit_that_stays_far_from_the_model_is_told() -> None:
    places = at_nodes(plate(), MAPPED_NODES)
    places[:, 2] += 35.0 * np.array([1, -1, 1, 1, -1, -1, 1, -1])
    found = mapped(places, align="fit", tolerance=60.0)
    assert any("check the picture" in what for what, _ in found.uncertain)
    # What it leaves is told of each sensor, and as its root mean square.
    assert found.alignment is not None
    misfits = np.array([row.misfit for row in found.table])
    assert found.alignment.rms == pytest.approx(np.sqrt(np.mean(misfits**2)))


def rectangle() -> Mesh:
    """A flat plate in mm of 8 by 4 elements, 100 by 100 each; half turns take it to itself."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(9.0), np.arange(5.0), indexing="ij"))
    places = np.column_stack([100.0 * x, 100.0 * y, np.zeros(45)])
    return Mesh(np.arange(1, 46), places, plate().cells)


def on_rectangle(**keys: Any) -> Mapping:
    mesh = rectangle()
    places = mesh.coordinates[[0, 4, 22, 40, 44, 8, 31, 13]]
    turned = places @ Rotation.from_euler("z", 20, degrees=True).as_matrix()
    return map_sensors(
        sensors(NAMES, [3] * 8), geometry(NAMES, turned), mesh, section(align="fit", **keys), MM
    )


def test_poses_that_cannot_be_told_apart_are_shown_and_asked_about() -> None:
    found = on_rectangle()
    assert len(found.others) == 3  # half turns about x, y and z
    ((what, remedy),) = found.uncertain
    assert what.startswith("4 poses of the test fit equally well")
    assert "rotation: [0, 0, 20], translation: [0, 0, 0]" in what
    assert "rotation: [0, 0, -160], translation: [800, 400, 0]" in what
    assert "with `align: fit`" in remedy
    assert "uncertain: 4 poses" in sensor_lines(found)[-1]
    assert sensors_json(found)["status"] == "doubtful"


@pytest.mark.parametrize(
    ("keys", "node"),
    [
        ({"rotation": [0, 0, 15]}, 1),
        ({"rotation": [0, 0, -150]}, 45),
        ({"translation": [790, 390, 0], "rotation": [0, 0, -160]}, 45),
        ({"match": {201: 45}}, 45),
        ({"match": {201: 5}}, 5),
        ({"match": {201: [810.0, 5.0, 0.0]}}, 41),
    ],
)
def test_a_rotation_or_one_landmark_chooses_among_poses(keys: dict[str, Any], node: int) -> None:
    found = on_rectangle(**keys)
    assert found.uncertain == ()
    assert found.sensors.model_nodes[0] == node  # of the first sensor, at a corner
    np.testing.assert_allclose(found.sensors.distances, 0.0, atol=1e-9)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_a_geometry_of_two_points_cannot_be_fitted_and_is_told_what_helps(count: int) -> None:
    names = NAMES[:count]
    places = at_nodes(plate(), MAPPED_NODES[:count])
    measured = sensors(names, [3] * count)
    if count:
        with pytest.raises(
            CampaignError, match=rf"points are {count}; .*three or more.*give `scale`, `rotation`"
        ):
            map_sensors(measured, geometry(names, places), plate(), section(align="fit"), MM)
    # In the model's axes two points, or none, are as good as many.
    found = map_sensors(measured, geometry(names, places), plate(), section(), MM)
    assert found.sensors.model_nodes.tolist() == MAPPED_NODES[:count]


def test_of_very_many_sensors_those_in_doubt_are_shown_and_few_are_named() -> None:
    rng = np.random.default_rng(2)
    places = rng.uniform([0, 0, -1], [700, 250, 1], (3000, 3))
    places[1700, 2] = 12.0  # more than half the tolerance away
    names = list(range(1, 3001))
    where = geometry(names, places)
    measured = sensors(names, [3] * 3000)
    found = map_sensors(measured, where, plate(), section(tolerance=200.0), MM)
    table = sensor_table(found)
    assert len(table.rows) == 500
    assert "the table has 500 sensors" in sensor_lines(found)[0]
    told = sensors_json(found)["sensors"]
    assert isinstance(told, list)
    assert len(told) == 3000
    with pytest.raises(CampaignError, match=r"3000 sensors are without a node .*; and 2980 more\."):
        map_sensors(measured, where, plate(), section(tolerance=0.01), MM)


def test_landmarks_may_be_places_of_the_model() -> None:
    test = at_nodes(plate(), MAPPED_NODES) / 1000.0
    marks = {201: [0.0, 0.0, 0.0], 203: [0.0, 400.0, 0.0], 206: [800.0, 0.0, 0.0]}
    found = mapped(test + 3.0, metres=1.0, match=marks)
    assert found.sensors.model_nodes.tolist() == MAPPED_NODES
    assert found.uncertain == ()


def test_sensors_amid_a_flat_plate_may_slide_and_it_is_said() -> None:
    mesh = rectangle()
    rng = np.random.default_rng(1)
    places = np.column_stack([rng.uniform([200, 150], [600, 250], (8, 2)), np.zeros(8)])
    found = map_sensors(
        sensors(NAMES, [3] * 8),
        geometry(NAMES, places),
        mesh,
        section(align="fit", tolerance=75.0),
        MM,
    )
    what, remedy = found.uncertain[0]
    assert what.startswith("the fit leaves positions along the surface uncertain by up to ")
    assert "three or more landmarks" in remedy


def test_left_handed_axes_are_told() -> None:
    # Not flat: the raised tip tells left from right where a sensor beside it is raised half way.
    places = at_nodes(plate(), [*MAPPED_NODES, 44])
    places[8] = (places[7] + places[8]) / 2.0
    mirrored = places * [1.0, -1.0, 1.0]
    names = [*NAMES, 209]
    found = map_sensors(
        sensors(names, [3] * 9), geometry(names, mirrored), plate(),
        section(align="fit", unmapped="leave_out"), MM,
    )  # fmt: skip
    assert any("left-handed" in what for what, _ in found.uncertain)


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "is not a rotation"),
        ({"rotation": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]}, "is not a rotation"),
        ({"by": "number", "scale": 3.0}, "sensors by number have no place"),
        ({"tolerance": 0}, "greater than 0"),
        ({"scale": -1.0}, "greater than 0"),
        ({"scale": float("nan")}, "finite"),
        ({"match": {0: 3}}, "greater than or equal to 1"),
        ({"nearest": True}, "Extra inputs"),
    ],
)
def test_settings_that_make_no_sense_are_refused(keys: dict[str, Any], said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        section(**keys)


def test_the_table_and_its_json_tell_the_same() -> None:
    places = at_nodes(plate(), MAPPED_NODES)
    places[1, 2] += 60.0
    found = mapped(places, unmapped="leave_out", rotation=[0, 0, 0])
    lines = sensor_lines(found)
    first, second = sensor_table(found).texts[:2]
    assert first == ["201.z", "1", "0", "0.000, 0.000, +1.000", "good", ""]
    assert second[:3] == ["202.z", "", "60"]
    assert second[4:] == ["left out", "the nearest node, 3, is 60 mm away"]
    assert lines[0].startswith("8 sensors: 7 good, 0 doubtful, 1 left out; tolerance ")
    assert lines[1] == "alignment: scale 1, rotation 0 degrees, translation 0, 0, 0 (given)"
    told = json.loads(json.dumps(sensors_json(found)))
    assert told["status"] == "doubtful"
    assert told["sensors"][1] == {
        "test_node": 202, "component": "z", "model_node": None, "distance": 60.0,
        "direction": [0.0, 0.0, 1.0], "verdict": "left out",
        "reason": "the nearest node, 3, is 60 mm away", "misfit": None, "node_name": "",
        "at_rest": False,
    }  # fmt: skip
    assert told["alignment"]["residual_rms"] is None


@pytest.mark.skipif(not mesh_picture.can_draw(), reason="no OpenGL to draw with (libosmesa6)")
def test_the_picture_shows_model_and_sensors(tmp_path: Path) -> None:
    places = at_nodes(plate(), MAPPED_NODES)
    places[1, 2] += 60.0
    found = mapped(places, unmapped="leave_out")
    save_sensor_picture(tmp_path / "new" / "sensors.png", found, plate())
    drawn = imread(tmp_path / "new" / "sensors.png")[:, :, :3]
    for colour in ("#0072B2", "#D55E00"):  # good and left out
        wanted = np.array([int(colour[k : k + 2], 16) / 255.0 for k in (1, 3, 5)])
        assert (np.abs(drawn - wanted).max(axis=2) < 0.02).sum() > 100, colour


def test_a_machine_that_cannot_draw_is_told_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr(mesh_picture, "LIBRARIES", ("libthere-is-none.so.1",))
    with pytest.raises(CampaignError, match="apt-get install libosmesa6"):
        save_sensor_picture(tmp_path / "s.png", mapped(at_nodes(plate(), MAPPED_NODES)), plate())
    assert not (tmp_path / "s.png").exists()


def test_a_picture_of_another_kind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CampaignError, match=r"sensors\.jpg: the picture is a PNG"):
        save_sensor_picture(
            tmp_path / "sensors.jpg", mapped(at_nodes(plate(), MAPPED_NODES)), plate()
        )


def test_a_model_without_places_cannot_be_drawn(tmp_path: Path) -> None:
    nowhere = Mesh(np.zeros(0, np.int64), np.zeros((0, 3)), ())
    with pytest.raises(CampaignError, match="no places to draw"):
        save_sensor_picture(tmp_path / "s.png", mapped(at_nodes(plate(), MAPPED_NODES)), nowhere)


def test_more_sensors_than_can_be_told_of_are_refused_at_once() -> None:
    n = 1_000_000
    test = mode_set([10.0], np.ones((n, 1)), np.arange(n) + 1, np.full(n, 3))
    with pytest.raises(CampaignError, match=r"has 1,000,000 sensors, but at most 100,000 .* fewer"):
        map_sensors(test, None, plate(), section(), MM)


def on_plate(
    fixed: dict[int, frozenset[int]], shapes: Floats, frames: dict[int, Floats] | None = None,
    **keys: Any,
) -> Mapping:  # fmt: skip
    """Sensors 201.x, 201.z and 202.z next to the nodes 23 and 33 of the plate."""
    places = at_nodes(plate(), [23, 33]) + np.array([2.0, 0.0, 0.0])
    return map_sensors(
        mode_set([10.0], shapes, [201, 201, 202], [1, 3, 3]),
        geometry([201, 202], places),
        plate(frames),
        section(**keys),
        MM,
        fixed=fixed,
    )


MOVING = np.ones((3, 1))
CLAMPED = {23: frozenset(range(1, 7))}


def test_a_sensor_is_read_at_the_next_node_that_can_move_along_it() -> None:
    found = on_plate({23: frozenset((1, 2))}, MOVING, tolerance=120.0)
    assert found.sensors.model_nodes.tolist() == [22, 23, 33]
    assert found.table[0].reason.startswith("the nearest node, 23, is fixed in this direction")
    assert found.table[0].distance == pytest.approx(np.hypot(2.0, 80.0))
    assert found.table[1].reason == ""
    assert found.notes[-1] == (
        "1 sensor is read at the next node that can move, because the nearest one is "
        "fixed in its direction: 201.x (22 instead of 23)"
    )


def test_fixed_components_are_in_the_axes_of_the_nodes_results() -> None:
    turned = {23: np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])}  # its first axis is the global z
    found = on_plate({23: frozenset((1, 2))}, MOVING, turned, tolerance=120.0)
    assert found.sensors.model_nodes.tolist() == [23, 22, 33]


def test_a_sensor_at_rest_on_a_node_that_cannot_move_is_left_out_and_named() -> None:
    found = on_plate(CLAMPED, np.array([[1e-3], [0.0], [1.0]]), tolerance=120.0)
    assert found.sensors.model_nodes.tolist() == [33]
    assert [row.at_rest for row in found.table] == [True, True, False]
    assert found.notes[-1] == (
        "left out: 2 sensors at nodes that cannot move in the model: 201.x, 201.z"
    )


def test_a_sensor_at_rest_is_read_at_a_node_that_is_fixed_in_its_direction_alone() -> None:
    still = np.array([[1e-3], [0.0], [1.0]])
    found = on_plate({23: frozenset((1, 2))}, still, tolerance=120.0)
    assert found.sensors.model_nodes.tolist() == [23, 23, 33]
    assert not any("fixed" in note for note in found.notes)


def test_a_fixed_node_is_doubtful_where_none_within_the_tolerance_can_move() -> None:
    found = on_plate({23: frozenset((1, 3))}, MOVING, tolerance=50.0)
    assert found.sensors.model_nodes.tolist() == [23, 23, 33]
    assert [row.verdict for row in found.table] == ["doubtful", "doubtful", "good"]
    assert "node 23 is fixed in this direction, as all within the toler" in found.table[1].reason


def test_a_sensor_is_left_out_where_no_node_within_the_tolerance_can_move() -> None:
    found = on_plate(CLAMPED, MOVING, tolerance=50.0)
    assert found.sensors.model_nodes.tolist() == [33]
    assert [row.verdict for row in found.table] == ["left out", "left out", "good"]
    assert found.table[0].reason == "node 23 cannot move in the model"
    assert not found.table[0].at_rest


def test_sensors_by_number_on_grounded_nodes_are_left_out_and_named() -> None:
    found = map_sensors(
        sensors([22, 23, 23], [1, 1, 3]), None, plate(), section(), MM, fixed=CLAMPED
    )
    assert found.sensors.model_nodes.tolist() == [22]
    assert found.notes == (
        "left out: 2 sensors at nodes that cannot move in the model: 23.x, 23.z",
    )
    with pytest.raises(CampaignError, match=r"23\.x, 23\.z; no other sensor remains"):
        map_sensors(sensors([23, 23], [1, 3]), None, plate(), section(), MM, fixed=CLAMPED)


def test_nodes_that_the_user_names_are_taken_though_they_are_fixed() -> None:
    found = on_plate(CLAMPED, MOVING, tolerance=120.0, match={201: 23}, align="none")
    assert found.sensors.model_nodes.tolist() == [23, 23, 33]


def test_a_fixed_node_at_the_same_place_casts_no_doubt_on_the_other() -> None:
    mesh = plate()
    twice = Mesh(np.arange(1, 47), np.vstack([mesh.coordinates, mesh.coordinates[22]]), mesh.cells)
    for fixed, free in ((46, 23), (23, 46)):
        found = map_sensors(
            mode_set([10.0], np.ones((1, 1)), [201], [3]),
            geometry([201], at_nodes(mesh, [23])),
            twice,
            section(),
            MM,
            fixed={fixed: frozenset(range(1, 7))},
        )
        assert found.sensors.model_nodes.tolist() == [free]
        assert found.table[0].verdict == "good"
