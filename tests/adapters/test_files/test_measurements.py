"""A test from files of several forms."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.test_files.geometry_csv import write_geometry_csv
from modetune.adapters.test_files.hdf5 import write_test_hdf5
from modetune.adapters.test_files.measurements import inspect_files, read_measurement
from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.adapters.test_files.universal.file import write_universal
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import MeasuredFrfs, Measurement, TestGeometry
from modetune.core.modes import MeasuredModes
from tests.adapters.test_files.measured_tests import Wanted, made

WHOLE = made(Wanted(11))


def parts() -> tuple[MeasuredModes, TestGeometry, MeasuredFrfs]:
    assert WHOLE.modes is not None
    assert WHOLE.geometry is not None
    assert WHOLE.frfs is not None
    return WHOLE.modes, WHOLE.geometry, WHOLE.frfs


def test_modes_points_and_functions_come_from_three_files(tmp_path: Path) -> None:
    modes, points, frfs = parts()
    write_modes_csv(tmp_path / "modes.csv", modes.numbers, modes.modes)
    write_geometry_csv(tmp_path / "points.csv", points)
    write_universal(tmp_path / "frfs.unv", Measurement(frfs=frfs))
    found = read_measurement([tmp_path / name for name in ("modes.csv", "points.csv", "frfs.unv")])
    assert found.modes is not None
    assert found.geometry is not None
    assert found.frfs is not None
    np.testing.assert_array_equal(found.geometry.coordinates, points.coordinates)
    np.testing.assert_allclose(found.modes.modes.mode_shapes, modes.modes.mode_shapes, rtol=1e-9)
    assert found.frfs.values.shape == frfs.values.shape


@pytest.mark.parametrize("suffix", ["unv", "csv", "h5"])
def test_a_file_without_a_telling_suffix_is_known_by_its_content(
    tmp_path: Path, suffix: str
) -> None:
    modes, _, _ = parts()
    path = tmp_path / f"t.{suffix}"
    if suffix == "csv":
        write_modes_csv(path, modes.numbers, modes.modes)
    elif suffix == "h5":
        write_test_hdf5(path, Measurement(modes))
    else:
        write_universal(path, Measurement(modes))
    plain = path.rename(tmp_path / "export.dat")
    found = read_measurement([plain]).modes
    assert found is not None
    assert found.numbers == modes.numbers


def test_a_file_of_no_known_form_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "picture.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n\0\0\0")
    with pytest.raises(CampaignError, match=r"is a picture \(PNG\), not a test"):
        read_measurement([path])
    with pytest.raises(CampaignError, match="No such file"):
        read_measurement([tmp_path / "none.dat"])
    with pytest.raises(CampaignError, match="Is a directory"):
        read_measurement([tmp_path])


def test_no_file_and_one_file_twice_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CampaignError, match="no test file is named"):
        read_measurement([])
    write_geometry_csv(tmp_path / "p.csv", parts()[1])
    with pytest.raises(CampaignError, match="named twice"):
        read_measurement([tmp_path / "p.csv", tmp_path / "p.csv"])


def test_the_unit_that_is_asked_for_is_taken_and_told(tmp_path: Path) -> None:
    points = parts()[1]
    write_geometry_csv(tmp_path / "p.csv", points)  # in millimetres
    found = read_measurement([tmp_path / "p.csv"], metres=1.0)
    assert found.geometry is not None
    assert found.geometry.metres == 1.0
    np.testing.assert_array_equal(found.geometry.coordinates, points.coordinates)
    assert found.notes == ("the files have lengths in 0.001 m; 1 m is taken, as asked",)
    assert read_measurement([tmp_path / "p.csv"], metres=0.001).notes == ()
    write_geometry_csv(tmp_path / "q.csv", replace(points, metres=math.nan))
    assert read_measurement([tmp_path / "q.csv"], metres=0.5).notes == ()
    with pytest.raises(CampaignError, match="must be above zero"):
        read_measurement([tmp_path / "p.csv"], metres=0.0)


def halves(tmp_path: Path, numbers: tuple[int, ...] = (1, 2, 3), scale: float = 1.0) -> list[Path]:
    """One mode set in two files, split by sensors; the second with other numbers or frequencies."""
    modes = replace(parts()[0].modes, frequencies_hz=np.array([5.0, 7.0, 9.0]))
    half = modes.n_dof // 2
    second = modes.rows(range(half, modes.n_dof))
    second = replace(second, frequencies_hz=scale * second.frequencies_hz)
    write_modes_csv(tmp_path / "a.csv", (1, 2, 3), modes.rows(range(half)))
    write_modes_csv(tmp_path / "b.csv", numbers, second)
    return [tmp_path / "a.csv", tmp_path / "b.csv"]


def test_sensors_of_two_files_with_the_same_modes_are_put_together(tmp_path: Path) -> None:
    found = read_measurement(halves(tmp_path)).modes
    modes = parts()[0].modes
    assert found is not None
    np.testing.assert_array_equal(found.modes.nodes, modes.nodes)
    np.testing.assert_allclose(found.modes.mode_shapes, modes.mode_shapes, rtol=1e-9)


@pytest.mark.parametrize(("numbers", "scale"), [((1, 2, 4), 1.0), ((1, 2, 3), 1.01)])
def test_files_of_different_modes_are_refused_with_both_names(
    tmp_path: Path, numbers: tuple[int, ...], scale: float
) -> None:
    paths = halves(tmp_path, numbers, scale)
    with pytest.raises(CampaignError, match="hold different modes") as raised:
        read_measurement(paths)
    assert all(str(path) in str(raised.value) for path in paths)


def test_a_sensor_in_two_files_is_refused(tmp_path: Path) -> None:
    modes, _, _ = parts()
    for name in ("a.csv", "b.csv"):
        write_modes_csv(tmp_path / name, modes.numbers, modes.modes)
    with pytest.raises(CampaignError, match="both give shapes at node"):
        read_measurement([tmp_path / "a.csv", tmp_path / "b.csv"])


def test_points_of_two_files_are_put_together_where_they_agree(tmp_path: Path) -> None:
    points = parts()[1]
    some = TestGeometry(
        points.nodes[:5],
        points.coordinates[:5],
        points.frames[:5],
        points.lines[:2],
        points.faces[:1],
        points.metres,
    )
    write_geometry_csv(tmp_path / "a.csv", some)
    write_universal(tmp_path / "b.unv", Measurement(geometry=points))
    found = read_measurement([tmp_path / "a.csv", tmp_path / "b.unv"]).geometry
    assert found is not None
    assert sorted(found.nodes.tolist()) == points.nodes.tolist()
    moved = replace(some, coordinates=some.coordinates * 1.01)
    write_geometry_csv(tmp_path / "a.csv", moved)
    with pytest.raises(CampaignError, match="different places or axes"):
        read_measurement([tmp_path / "a.csv", tmp_path / "b.unv"])
    write_geometry_csv(tmp_path / "a.csv", replace(some, metres=1.0))
    with pytest.raises(CampaignError, match="different units of length"):
        read_measurement([tmp_path / "a.csv", tmp_path / "b.unv"])


def test_response_functions_of_two_forms_are_refused(tmp_path: Path) -> None:
    frfs = Measurement(frfs=parts()[2])
    write_universal(tmp_path / "a.unv", frfs)
    write_test_hdf5(tmp_path / "b.h5", frfs)
    with pytest.raises(CampaignError, match="hold response functions; leave out one"):
        read_measurement([tmp_path / "a.unv", tmp_path / "b.h5"])


def test_what_each_file_is_is_told(tmp_path: Path) -> None:
    modes, points, _ = parts()
    write_universal(tmp_path / "a.unv", Measurement(modes))
    write_geometry_csv(tmp_path / "b.csv", points)
    files = inspect_files([tmp_path / "a.unv", tmp_path / "b.csv"]).files
    assert [(file.form, file.datasets) for file in files] == [
        ("universal", ("151", "55", "55", "55")),
        ("table", ()),
    ]
