"""Every universal file of the shared data: what it holds, or why it is refused.

The expected figures were read in the files' texts.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.test_files.measurements import inspect_files, read_measurement
from modetune.adapters.test_files.universal.file import read_universal
from modetune.core.errors import CampaignError


@dataclass(frozen=True, slots=True)
class Expected:
    """datasets in order; numbers of points, lines, triangles; modes at sensors; functions."""

    datasets: tuple[str, ...]
    points: tuple[int, int, int] = (0, 0, 0)
    modes: tuple[int, int] = (0, 0)
    functions: int = 0


FILES = {
    "Artemis export - Geometry RPBC_setup_05_14102016_105117.uff": Expected(
        ("15", "82", "82", "2412"), (74, 108, 108)
    ),
    "Sample_UFF58_ascii.uff": Expected(("58",), functions=1),
    "Sample_UFF58b_bin.uff": Expected(("58b",), functions=1),
    # trace lines: 7 (Massif), 16 (Stator) and 7 (Dalle) strokes between two nodes
    "TestLab 161 164 18 15 82.uff": Expected(
        ("151", "164", "18", "15", "82", "82", "82"), (36, 30, 0)
    ),
    "binary8byte.uff": Expected(("58b",), functions=1),
    # 4 tetrahedra with 4 sides each, 4 triangles, one of them a side of a tetrahedron
    "heat_engine_housing.uff": Expected(("151", "164", "2411", "2412", "2414"), (10, 0, 19)),
    # 72 quadrilaterals
    "mesh_Oros-modal_uff15_uff2412.uff": Expected(("18", "15", "2412"), (96, 0, 144)),
    "non_ascii_header.uff": Expected(("58",), functions=1),
    "time-history-not-all-columns-filled.uff": Expected(("58",), functions=1),
    "uff55 sample_test record10.uff": Expected(("55",), modes=(1, 3)),
    "uff55_translation.uff": Expected(("55",) * 3, modes=(3, 12)),
    "uff55_translation_rotation.uff": Expected(("55",), modes=(1, 129)),
}


def test_every_file_is_in_the_table(shared_data: Path) -> None:
    assert sorted(path.name for path in (shared_data / "uff").glob("*.uff")) == sorted(FILES)


@pytest.mark.parametrize("name", FILES)
def test_a_file_holds_what_its_text_says(shared_data: Path, name: str) -> None:
    expected = FILES[name]
    path = shared_data / "uff" / name
    measurement, files = read_universal([path])
    assert files[0].datasets == expected.datasets
    assert inspect_files([path]).n_functions == expected.functions
    assert measurement.frfs is None  # none of the files has a response function with its places
    points, modes = measurement.geometry, measurement.modes
    found = (
        (0, 0, 0) if points is None else (points.nodes.size, len(points.lines), len(points.faces))
    )
    assert found == expected.points
    assert (
        (0, 0) == expected.modes
        if modes is None
        else ((modes.modes.n_modes, modes.modes.n_dof) == expected.modes)
    )


@pytest.mark.parametrize("name", [name for name, file in FILES.items() if file.functions])
def test_a_file_of_other_functions_alone_is_refused_with_what_they_are(
    shared_data: Path, name: str
) -> None:
    with pytest.raises(CampaignError, match=r"no modes, points or response functions") as raised:
        read_measurement([shared_data / "uff" / name])
    said = "without node or direction" if name.startswith("non_ascii") else "1 x time history"
    assert said in str(raised.value)


def test_axes_of_test_lab_points_are_those_of_dataset_18(shared_data: Path) -> None:
    points = read_measurement([shared_data / "uff" / "TestLab 161 164 18 15 82.uff"]).geometry
    assert points is not None
    assert points.metres == 1.0  # dataset 164: factor 1
    row = points.nodes.tolist().index(7)
    np.testing.assert_allclose(points.coordinates[row], [-1.75, 0.0, 0.1])
    # SYS7: x to the point (0, 0, 1) above its origin, the x-z plane through (0, -1, 1)
    np.testing.assert_allclose(points.frames[row], [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-6)
    row = points.nodes.tolist().index(36)  # SYS36 looks along the global axes
    np.testing.assert_allclose(points.frames[row], np.eye(3), atol=1e-6)


def test_millimetres_of_dataset_164_are_told(shared_data: Path) -> None:
    points = read_measurement([shared_data / "uff" / "heat_engine_housing.uff"]).geometry
    assert points is not None
    assert points.metres == pytest.approx(1e-3)  # factor 1000
    np.testing.assert_array_equal(  # node 1, not a digit lost
        points.coordinates[0], [-1.711755676269531e02, 1.036403427124023e02, 1.384829101562500e02]
    )


def test_real_modes_are_read_to_the_last_digit(shared_data: Path) -> None:
    measured = read_measurement([shared_data / "uff" / "uff55_translation.uff"]).modes
    assert measured is not None
    assert measured.numbers == (1, 2, 3)
    np.testing.assert_array_equal(measured.modes.frequencies_hz, [10.0, 12.0, 13.0])
    np.testing.assert_array_equal(measured.modes.nodes[::3], [1, 2, 3, 4])
    np.testing.assert_array_equal(measured.modes.mode_shapes[0], [-1.46518, 1.82904, -0.634670])
    np.testing.assert_array_equal(measured.modes.mode_shapes[11], [0.724863, 1.98289, -0.795555])


def test_rotations_that_are_all_zero_were_not_measured(shared_data: Path) -> None:
    path = shared_data / "uff" / "uff55_translation_rotation.uff"
    measured = read_measurement([path]).modes
    assert measured is not None
    assert set(measured.modes.components.tolist()) == {1, 2, 3}
    assert measured.modes.frequencies_hz[0] == 97.013
    assert measured.modes.mode_shapes[45, 0] == -1.0  # node 16 along x


def test_a_complex_mode_has_the_frequency_and_damping_of_its_pole(shared_data: Path) -> None:
    path = shared_data / "uff" / "uff55 sample_test record10.uff"
    measurement = read_measurement([path])
    assert measurement.modes is not None
    modes = measurement.modes.modes
    pole = -0.1111111 + 41.11111j  # record 8
    assert modes.frequencies_hz[0] == pytest.approx(abs(pole) / (2 * np.pi), rel=1e-7)
    assert modes.damping_ratios[0] == pytest.approx(0.1111111 / abs(pole), rel=1e-6)
    np.testing.assert_array_equal(modes.nodes, [60101, 111111, 111111])
    np.testing.assert_array_equal(modes.components, [3, 2, 3])
    assert any("mode 1 0.950" in note for note in measurement.notes)


def test_both_forms_of_one_recording_hold_the_same_values(shared_data: Path) -> None:
    # one recording exported twice, as text with 6 digits and as binary
    from modetune.adapters.test_files.universal.datasets import Function
    from modetune.adapters.test_files.universal.file import read_file

    found = [
        read_file(shared_data / "uff" / name).contents[0]
        for name in ("Sample_UFF58_ascii.uff", "Sample_UFF58b_bin.uff")
    ]
    text, binary = found
    assert isinstance(text, Function)
    assert isinstance(binary, Function)
    assert text.values.size == binary.values.size == 79292  # record 7
    np.testing.assert_allclose(text.values, binary.values, rtol=1e-5)
    assert text.values[0] == -1.47553e-02


def test_binary_values_of_eight_bytes_end_before_their_mark(shared_data: Path) -> None:
    from modetune.adapters.test_files.universal.datasets import Function
    from modetune.adapters.test_files.universal.file import read_file

    content = read_file(shared_data / "uff" / "binary8byte.uff").contents[0]
    assert isinstance(content, Function)
    assert content.values.size == 250  # record 7
    # ... of a sine of 5 Hz at 100 values a second
    np.testing.assert_allclose(content.values, np.sin(2 * np.pi * 5 * content.abscissae), atol=0.1)


def test_a_last_row_that_is_not_full_is_read(shared_data: Path) -> None:
    from modetune.adapters.test_files.universal.datasets import Function
    from modetune.adapters.test_files.universal.file import read_file

    path = shared_data / "uff" / "time-history-not-all-columns-filled.uff"
    content = read_file(path).contents[0]
    assert isinstance(content, Function)
    assert content.values.size == 13
    assert (content.values[0], content.values[-1]) == (-3.81956, -5.84096)
    assert content.unit == "m/s2"
