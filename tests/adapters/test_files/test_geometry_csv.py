"""Points as CSV: what is written is read back, what is wrong is told with its line."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings

from modetune.adapters.test_files.geometry_csv import (
    is_geometry,
    read_geometry_csv,
    write_geometry_csv,
)
from modetune.adapters.test_files.tables import read_tables
from modetune.core.errors import CampaignError
from tests.adapters.test_files.measured_tests import Wanted, made, wanted_tests

HEADER = "node,x,y,z,xx,xy,xz,yx,yy,yz,zx,zy,zz"


def saved(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "points.csv"
    path.write_text(text)
    return path


@settings(max_examples=40)
@given(wanted_tests)
def test_points_are_read_back_exactly(tmp_path: Path, wanted: Wanted) -> None:
    points = made(Wanted(wanted.seed, turned=wanted.turned, metres=wanted.metres)).geometry
    assert points is not None
    write_geometry_csv(tmp_path / "p.csv", points, ["a comment"])
    found = read_geometry_csv(tmp_path / "p.csv")
    for name in ("nodes", "coordinates", "frames", "lines", "faces", "metres"):
        np.testing.assert_array_equal(getattr(found, name), getattr(points, name))


def test_the_example_of_the_documentation_is_read(tmp_path: Path) -> None:
    path = saved(
        tmp_path,
        f"# a test\n\nmetres, 0.001\n{HEADER.replace(',', ', ')}\n101, 0.0, 12.5, 3.0\n"
        "102, 1.0, 12.5, 3.0, 0,1,0, -1,0,0, 0,0,1\n103, 5, 5, 5,,,,,,,,,\nline, 101, 102,,\n"
        "face, 101, 102, 103\n",
    )
    points = read_geometry_csv(path)
    assert points.metres == 0.001
    assert points.nodes.tolist() == [101, 102, 103]
    np.testing.assert_array_equal(points.frames[0], np.eye(3))
    np.testing.assert_array_equal(points.frames[1], [[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    assert points.lines.tolist() == [[101, 102]]
    assert points.faces.tolist() == [[101, 102, 103]]


def test_directions_may_be_missing_altogether(tmp_path: Path) -> None:
    points = read_geometry_csv(saved(tmp_path, "node,x,y,z\n1,0,0,0\n"))
    assert math.isnan(points.metres)
    np.testing.assert_array_equal(points.frames, [np.eye(3)])


def test_every_problem_is_told_at_once_with_its_line(tmp_path: Path) -> None:
    path = saved(
        tmp_path,
        "metres,-1\nnode,x,y,z\n1,0,0,0\n1,2,2,2\n2,0,x,0\n3,0,0\nline,1,9\nabc,1,2,3\n"
        "4,0,0,0,1,0,0,0,2,0,0,0,1\nface,1,2\n",
    )
    with pytest.raises(CampaignError) as raised:
        read_geometry_csv(path)
    said = str(raised.value)
    for line, reason in (
        (1, "metres must be above zero"),
        (4, f"node 1 is in {path}, line 3 already"),
        (5, "`2` has 'x' where a number must be"),
        (6, "2 numbers where 3 must be"),
        (7, "node 9 has no row"),
        (8, "`abc` is neither a node number, line nor face"),
        (9, "the directions of node 4 are not unit vectors at right angles"),
        (10, "2 numbers where 3 must be"),
    ):
        assert f"{path}, line {line}: {reason}" in said


@pytest.mark.parametrize("text", ["", "# nothing\n", "name,x,y,z\n1,0,0,0\n", "metres,1\n"])
def test_a_file_without_the_header_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(CampaignError, match="the header must be `node,x,y,z`"):
        read_geometry_csv(saved(tmp_path, text))


def test_a_file_without_points_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CampaignError, match="line 1: no point follows the header"):
        read_geometry_csv(saved(tmp_path, "node,x,y,z\n"))


def test_points_are_told_from_modes_by_the_first_row(tmp_path: Path) -> None:
    for text, points in (
        ("# hm\nnode,x,y,z\n", True),
        ("metres,1\n", True),
        ("mode,1\nfrequency_hz,5\n", False),
        ("", False),
    ):
        assert is_geometry(read_tables(saved(tmp_path, text))[0]) is points


def test_headings_tell_the_unit_of_length(tmp_path: Path) -> None:
    path = saved(tmp_path, "Point;X [mm];Y [mm];Z [mm]\n7;1,5;0;-2\n")
    points = read_geometry_csv(path)
    assert points.metres == 0.001
    assert points.coordinates.tolist() == [[1.5, 0.0, -2.0]]


@pytest.mark.parametrize(
    ("head", "said"),
    [
        ("node,x [mm],y [m],z [mm]", "line 1: the coordinates have different units: mm, m, mm"),
        ("node,x [mil],y [mil],z [mil]", "line 1: `x` has the unit 'mil'; known are m, cm"),
        ("metres,1\nnode,x/mm,y/mm,z/mm", "line 2: the unit mm contradicts `metres, 1` above it"),
    ],
)
def test_units_that_cannot_be_are_told(tmp_path: Path, head: str, said: str) -> None:
    with pytest.raises(CampaignError, match=said):
        read_geometry_csv(saved(tmp_path, f"{head}\n1,0,0,0\n"))
