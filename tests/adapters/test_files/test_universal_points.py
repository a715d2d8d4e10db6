"""Points, axes, units and drawings of universal files."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from modetune.adapters.test_files.universal.file import read_universal
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import TestGeometry
from tests.adapters.test_files.universal_text import (
    dataset,
    mode_55,
    nodes_15,
    nodes_2411,
    save,
    system_18,
    units_164,
)

ROOT_HALF = math.sqrt(0.5)


def read(*paths: Path) -> tuple[TestGeometry, str]:
    measurement = read_universal(paths)[0]
    assert measurement.geometry is not None
    return measurement.geometry, "\n".join(measurement.notes)


def system_2420(number: int, kind: int, rows: list[list[float]]) -> list[str]:
    text = [f"{number:10d}{kind:10d}{8:10d}", f"CS{number}"]
    return text + ["".join(f"{value:25.16E}" for value in row).replace("E", "D") for row in rows]


def test_points_of_both_kinds_of_table_are_read(tmp_path: Path) -> None:
    place = (0.1234567890123456, -2.5e-7, 1e6)
    points, _ = read(save(tmp_path / "t.unv", nodes_2411((5, 0, place))))
    np.testing.assert_array_equal(points.coordinates, [place])  # all digits
    assert math.isnan(points.metres)
    points, _ = read(save(tmp_path / "u.unv", nodes_15((5, 0, 0, (-1.5, 2.0, 3.25)))))
    np.testing.assert_array_equal(points.coordinates, [(-1.5, 2.0, 3.25)])
    np.testing.assert_array_equal(points.frames, [np.eye(3)])


def test_factors_of_dataset_164_turn_si_into_the_files_units(tmp_path: Path) -> None:
    for factor, metres in ((1000.0, 0.001), (3.28083989501312334, 0.3048), (1.0, 1.0)):
        path = save(tmp_path / "t.unv", units_164(factor), nodes_15((1, 0, 0, (1, 2, 3))))
        points, _ = read(path)
        assert points.metres == pytest.approx(metres, rel=1e-12)
        np.testing.assert_array_equal(points.coordinates, [[1, 2, 3]])  # nothing is converted


def test_a_factor_of_zero_is_passed_over(tmp_path: Path) -> None:
    path = save(tmp_path / "t.unv", units_164(0.0), nodes_15((1, 0, 0, (1, 2, 3))))
    points, notes = read(path)
    assert math.isnan(points.metres)
    assert "line 2 (dataset 164) has 0 as factor of lengths" in notes


def test_axes_of_dataset_18_are_those_of_its_three_points(tmp_path: Path) -> None:
    # x to (0, 1, 0), the x-z plane holds the global z: y = z cross x = -x of the global axes
    system = dataset(18, *system_18(4, 0, 0, ((1, 1, 1), (1, 2, 1), (1, 1, 3))))
    points, notes = read(save(tmp_path / "t.unv", system, nodes_15((1, 0, 4, (0, 0, 0)))))
    np.testing.assert_allclose(points.frames[0], [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-12)
    assert "1 of 1 points have local axes" in notes


def test_coordinates_in_a_local_system_become_global(tmp_path: Path) -> None:
    system = dataset(18, *system_18(4, 0, 0, ((10, 0, 0), (10, 1, 0), (10, 0, 1))))
    points, _ = read(save(tmp_path / "t.unv", system, nodes_15((1, 4, 0, (2, 3, 5)))))
    # 2 along y, 3 along -x, 5 along z from (10, 0, 0)
    np.testing.assert_allclose(points.coordinates[0], [7, 2, 5], atol=1e-12)


def test_systems_given_in_terms_of_others_are_resolved(tmp_path: Path) -> None:
    systems = dataset(
        18,
        *system_18(5, 0, 4, ((1, 0, 0), (1, 1, 0), (1, 0, 1))),
        *system_18(4, 0, 0, ((10, 0, 0), (10, 1, 0), (10, 0, 1))),
    )
    points, _ = read(save(tmp_path / "t.unv", systems, nodes_15((1, 5, 5, (1, 0, 0)))))
    # each turns by 90 degrees about z: origin (10, 1, 0), x of the inner one along -x
    np.testing.assert_allclose(points.coordinates[0], [9, 1, 0], atol=1e-12)
    np.testing.assert_allclose(points.frames[0], [[-1, 0, 0], [0, -1, 0], [0, 0, 1]], atol=1e-12)


def test_systems_given_in_a_ring_are_refused(tmp_path: Path) -> None:
    three = ((0, 0, 0), (1, 0, 0), (0, 0, 1))
    systems = dataset(18, *system_18(4, 0, 5, three), *system_18(5, 0, 4, three))
    with pytest.raises(CampaignError, match=r"coordinate system [45] is given in terms of itself"):
        read(save(tmp_path / "t.unv", systems, nodes_15((1, 4, 0, (0, 0, 0)))))


@pytest.mark.parametrize("far", [np.inf, np.nan, 1e300])
def test_a_system_by_a_point_that_is_nowhere_is_passed_over(tmp_path: Path, far: float) -> None:
    system = dataset(18, *system_18(4, 0, 0, ((0, 0, 0), (far, 0, 0), (0, 0, 1))))
    points, notes = read(save(tmp_path / "t.unv", system, nodes_15((1, 0, 4, (0, 0, 0)))))
    assert "has a coordinate that is not a length" in notes
    np.testing.assert_array_equal(points.frames[0], np.eye(3))


def test_three_points_on_a_line_are_passed_over(tmp_path: Path) -> None:
    system = dataset(18, *system_18(4, 0, 0, ((0, 0, 0), (1, 0, 0), (2, 0, 0))))
    points, notes = read(save(tmp_path / "t.unv", system, nodes_15((1, 0, 4, (0, 0, 0)))))
    assert "gives coordinate system 4 by three points on one line" in notes
    assert "doubtful" in notes  # node 1 is measured along a system that nobody gives
    np.testing.assert_array_equal(points.frames[0], np.eye(3))


def test_axes_of_dataset_2420_are_the_rows_of_its_matrix(tmp_path: Path) -> None:
    rows = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [5.0, 5.0, 5.0]]
    text = dataset(2420, f"{1:10d}", "NONE", *system_2420(3, 0, rows))
    points, _ = read(save(tmp_path / "t.unv", text, nodes_2411((1, 3, (1, 2, 3)), letter="E")))
    np.testing.assert_allclose(points.frames[0], rows[:3], atol=1e-15)
    np.testing.assert_array_equal(points.coordinates[0], [1, 2, 3])  # 2411 is global


def test_a_matrix_that_is_no_rotation_is_passed_over(tmp_path: Path) -> None:
    rows = [[2.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]
    text = dataset(2420, f"{1:10d}", "NONE", *system_2420(3, 0, rows))
    _, notes = read(save(tmp_path / "t.unv", text, nodes_2411((1, 3, (1, 2, 3)))))
    assert "gives coordinate system 3 axes that are not right angles" in notes


def test_directions_of_a_cylinder_turn_with_the_point(tmp_path: Path) -> None:
    system = dataset(18, *system_18(2, 1, 0, ((0, 0, 1), (1, 0, 1), (0, 0, 2))))
    # radius 2, 45 degrees, height 3 above the origin at z = 1
    points, _ = read(save(tmp_path / "t.unv", system, nodes_15((1, 2, 2, (2, 45, 3)))))
    np.testing.assert_allclose(points.coordinates[0], [2 * ROOT_HALF, 2 * ROOT_HALF, 4])
    expected = np.array([[ROOT_HALF, ROOT_HALF, 0], [-ROOT_HALF, ROOT_HALF, 0], [0, 0, 1]])
    np.testing.assert_allclose(points.frames[0], expected, atol=1e-12)


def test_directions_of_a_sphere_turn_with_the_point(tmp_path: Path) -> None:
    system = dataset(18, *system_18(2, 2, 0, ((0, 0, 0), (1, 0, 0), (0, 0, 1))))
    # radius 2, 90 degrees from z, 90 degrees about z: on the y axis
    points, _ = read(save(tmp_path / "t.unv", system, nodes_15((1, 2, 2, (2, 90, 90)))))
    np.testing.assert_allclose(points.coordinates[0], [0, 2, 0], atol=1e-12)
    np.testing.assert_allclose(points.frames[0], [[0, 1, 0], [0, 0, -1], [-1, 0, 0]], atol=1e-12)


def test_system_1_is_the_global_one_where_none_is_given(tmp_path: Path) -> None:
    points, notes = read(save(tmp_path / "t.unv", nodes_2411((1, 1, (1, 2, 3)))))
    np.testing.assert_array_equal(points.frames[0], np.eye(3))
    assert "coordinate system 1, which no dataset 18 or 2420 gives" in notes
    assert "doubtful" not in notes


def test_lines_start_anew_after_a_zero_and_elements_draw_their_sides(tmp_path: Path) -> None:
    nodes = nodes_15(*[(node, 0, 0, (node, node**2, 0)) for node in range(1, 9)])
    trace = dataset(
        82, f"{1:10d}{6:10d}{0:10d}", "a line", "".join(f"{n:10d}" for n in (1, 2, 3, 0, 5, 6))
    )
    elements = dataset(
        2412,
        *(f"{1:10d}{21:10d}{1:10d}{1:10d}{7:10d}{2:10d}", f"{0:10d}{1:10d}{1:10d}"),
        f"{7:10d}{8:10d}",
        *(f"{2:10d}{44:10d}{1:10d}{1:10d}{7:10d}{4:10d}", f"{1:10d}{2:10d}{3:10d}{4:10d}"),
        *(
            f"{3:10d}{45:10d}{1:10d}{1:10d}{7:10d}{8:10d}",
            "".join(f"{n:10d}" for n in (1, 5, 3, 6, 7, 2, 8, 4)),
        ),
    )
    points, notes = read(save(tmp_path / "t.unv", nodes, trace, elements))
    assert points.lines.tolist() == [[1, 2], [2, 3], [5, 6], [7, 8]]
    assert points.faces.tolist() == [[1, 2, 3], [1, 3, 4], [1, 3, 7], [1, 7, 8]]
    assert notes == ""


def test_elements_of_more_than_eight_nodes_go_on_in_the_next_row(tmp_path: Path) -> None:
    nodes = nodes_15(*[(node, 0, 0, (node, node**2, 0)) for node in range(1, 11)])
    elements = dataset(
        2412,
        f"{1:10d}{118:10d}{1:10d}{1:10d}{7:10d}{10:10d}",
        "".join(f"{n:10d}" for n in range(1, 9)),
        f"{9:10d}{10:10d}",
        f"{2:10d}{41:10d}{1:10d}{1:10d}{7:10d}{3:10d}",
        f"{1:10d}{2:10d}{3:10d}",
    )
    points, _ = read(save(tmp_path / "t.unv", nodes, elements))
    assert points.faces.tolist() == [[1, 2, 3]]


def test_lines_to_nodes_without_a_place_are_left_out_and_told(tmp_path: Path) -> None:
    trace = dataset(82, f"{1:10d}{2:10d}{0:10d}", "a", f"{1:10d}{9:10d}")
    points, notes = read(save(tmp_path / "t.unv", nodes_15((1, 0, 0, (0, 0, 0))), trace))
    assert points.lines.shape == (0, 2)
    assert "1 lines run to nodes without a place" in notes


def test_points_and_shapes_may_come_from_two_files(tmp_path: Path) -> None:
    first = save(tmp_path / "a.unv", nodes_15((1, 0, 0, (0, 0, 0)), (2, 0, 0, (1, 0, 0))))
    second = save(tmp_path / "b.unv", mode_55(1, 5.0, {1: [1, 0, 0], 3: [1, 0, 0]}))
    measurement = read_universal([first, second])[0]
    assert measurement.geometry is not None
    assert measurement.modes is not None
    assert "1 of 2 points have no shape" in measurement.notes
    assert "doubtful: 1 nodes have a shape and no place" in measurement.notes


def test_one_point_in_two_places_is_refused_with_both(tmp_path: Path) -> None:
    first = save(tmp_path / "a.unv", nodes_15((1, 0, 0, (0, 0, 0)), (2, 0, 0, (1, 0, 0))))
    second = save(tmp_path / "b.unv", nodes_15((2, 0, 0, (1, 0.1, 0))))
    with pytest.raises(CampaignError, match="gives node 2 another place") as raised:
        read(first, second)
    assert f"{first}, line 2" in str(raised.value)
    assert f"{second}, line 2" in str(raised.value)


def test_the_table_with_more_digits_is_taken(tmp_path: Path) -> None:
    exact = (1.0 / 3.0, 2.0, 3.0)
    path = save(tmp_path / "t.unv", nodes_15((1, 0, 0, exact)), nodes_2411((1, 0, exact)))
    assert read(path)[0].coordinates[0, 0] == exact[0]


def test_points_in_two_units_are_refused(tmp_path: Path) -> None:
    first = save(tmp_path / "a.unv", units_164(1.0), nodes_15((1, 0, 0, (0, 0, 0))))
    second = save(tmp_path / "b.unv", units_164(1e3), nodes_15((2, 0, 0, (0, 0, 0))))
    with pytest.raises(CampaignError, match=r"in 0\.001 m.*in 1 m"):
        read(first, second)


#: A turn of 30 degrees about z: its columns are not its rows.
TURNED = [[math.sqrt(0.75), 0.5, 0.0], [-0.5, math.sqrt(0.75), 0.0], [0.0, 0.0, 1.0]]


def turned_test(folder: Path, program: str, along: int | None) -> Path:
    """Five points in a row, all measured in TURNED; the row runs along a row (1) or column (-1)."""
    matrix = np.array(TURNED)
    direction = (
        np.array([0.6, 0.8, 0.0]) if along is None else (matrix if along == 1 else matrix.T)[0]
    )
    header = dataset(151, "wing", "NONE", program, "11-Oct-17", "11-Oct-17", program, "17-Oct-17")
    system = dataset(2420, f"{1:10d}", "NONE", *system_2420(3, 0, [*TURNED, [0.0, 0.0, 0.0]]))
    points = nodes_2411(*((n, 3, tuple(n * direction)) for n in range(1, 6)))
    trace = dataset(82, f"{1:10d}{5:10d}{8:10d}", "row", "".join(f"{n:10d}" for n in range(1, 6)))
    return save(folder / "t.unv", header, system, points, trace)


@pytest.mark.parametrize(
    ("program", "along", "transposed", "said"),
    [
        ("LMS Test.Lab Rev project-15A", None, True, "columns of the matrices: so Test.Lab"),
        ("Simcenter Testlab 2021.1", None, True, "columns of the matrices: so Testlab"),
        ("Simcenter Testlab", None, True, "columns of the matrices: so Testlab"),
        ("LMS Test.Lab", None, False, ""),
        ("LMS Test.Lab Rev 12A", None, False, ""),
        ("some program", None, False, ""),
        ("some program", 1, False, "rows of the matrices: the lines of the drawing run along them"),
        ("some program", -1, True, "columns of the matrices: the lines of the drawing run along"),
        ("Simcenter Testlab 2021.1", 1, False, "doubtful: Simcenter Testlab 2021.1 writes columns"),
    ],
)
def test_axes_of_2420_are_found_by_program_and_drawing(
    tmp_path: Path, program: str, along: int | None, transposed: bool, said: str
) -> None:
    points, notes = read(turned_test(tmp_path, program, along))
    expected = np.array(TURNED).T if transposed else np.array(TURNED)
    np.testing.assert_allclose(points.frames, [expected] * 5, atol=1e-15)
    assert said in notes
    assert ("of the matrices" in notes) is bool(said)


@pytest.mark.parametrize("axes", ["rows", "columns"])
def test_axes_of_2420_as_asked(tmp_path: Path, axes: Literal["rows", "columns"]) -> None:
    path = turned_test(tmp_path, "Simcenter Testlab 2021.1", -1)
    found = read_universal([path], axes)[0]
    assert found.geometry is not None
    expected = np.array(TURNED) if axes == "rows" else np.array(TURNED).T
    np.testing.assert_allclose(found.geometry.frames[0], expected, atol=1e-15)
    assert f"axes are the {axes} of the matrices: as asked" in "\n".join(found.notes)
