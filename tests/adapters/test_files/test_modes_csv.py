"""Measured modes as CSV: what is written is read again, and bad files name file and line."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from modetune.adapters.test_files.hdf5 import read_test_hdf5, write_test_hdf5
from modetune.adapters.test_files.modes_csv import read_modes_csv, read_test_csv, write_modes_csv
from modetune.adapters.test_files.universal.file import write_universal
from modetune.core.errors import CampaignError, ModesError
from modetune.core.measurement.measurement import MeasuredDeviations
from modetune.core.modes import ModeSet, mode_set

TEXT = """\
# wing, hung on bungees
mode, 1, 3

frequency_hz, 5.5, 34.8
damping_ratio, 0.004, 0.003
101.x, 0.5, -0.25
101.rz, 0, 1e-3
"""


def file_of(folder: Path, text: str) -> Path:
    path = folder / "measured.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_file_is_read_with_its_own_mode_numbers(tmp_path: Path) -> None:
    measured = read_modes_csv(file_of(tmp_path, TEXT))
    assert measured.numbers == (1, 3)
    assert measured.modes.frequencies_hz.tolist() == [5.5, 34.8]
    assert measured.modes.damping_ratios.tolist() == [0.004, 0.003]
    assert measured.modes.nodes.tolist() == [101, 101]
    assert measured.modes.components.tolist() == [1, 6]
    assert measured.modes.mode_shapes.tolist() == [[0.5, -0.25], [0.0, 1e-3]]
    assert measured.has_shapes


def test_frequencies_alone_are_enough(tmp_path: Path) -> None:
    measured = read_modes_csv(file_of(tmp_path, "mode,7\nfrequency_hz,12.5\n"))
    assert measured.numbers == (7,)
    assert not measured.has_shapes
    assert measured.modes.damping_ratios.size == 0


@pytest.mark.parametrize(
    "dress",
    [
        lambda text: text.replace("\n", "\r\n"),
        lambda text: "\ufeff" + text,
        lambda text: text.replace("mode,", '"mode",').replace("101.x,", '"101.x",'),
        lambda text: text.replace("# wing", '#,"wing'),
        lambda text: text + ",,\n , ,\n",
        lambda text: text.rstrip("\n"),
    ],
    ids=["windows", "byte order mark", "quotes", "quote in a comment", "empty cells", "no end"],
)
def test_what_spreadsheets_make_of_a_file_reads_the_same(tmp_path: Path, dress: object) -> None:
    assert callable(dress)
    plain = read_modes_csv(file_of(tmp_path, TEXT))
    other = read_modes_csv(file_of(tmp_path, dress(TEXT)))
    assert other.numbers == plain.numbers
    np.testing.assert_array_equal(other.modes.mode_shapes, plain.modes.mode_shapes)
    np.testing.assert_array_equal(other.modes.frequencies_hz, plain.modes.frequencies_hz)


FREQUENCIES = st.floats(1e-6, 1e6)
NUMBERS = st.floats(-1e9, 1e9, allow_subnormal=False).filter(lambda x: x == 0.0 or abs(x) > 1e-300)


@st.composite
def measurements(draw: st.DrawFn) -> tuple[tuple[int, ...], ModeSet]:
    numbers = draw(st.lists(st.integers(0, 10**6), min_size=1, max_size=4, unique=True))
    count = len(numbers)
    dofs = draw(st.lists(st.tuples(st.integers(0, 10**9), st.integers(1, 6)), unique=True))
    shapes = draw(
        st.lists(
            st.lists(NUMBERS, min_size=count, max_size=count),
            min_size=len(dofs),
            max_size=len(dofs),
        )
    )
    array = np.array(shapes).reshape(len(dofs), count)
    array[:1, ~array.any(axis=0)] = 1.0  # no mode may be zero at every sensor
    modes = mode_set(
        draw(st.lists(FREQUENCIES, min_size=count, max_size=count)),
        array,
        [node for node, _ in dofs],
        [component for _, component in dofs],
        draw(st.just([]) | st.lists(st.floats(0.0, 1.0), min_size=count, max_size=count)),
    )
    return tuple(numbers), modes


@given(measurements())
def test_what_is_written_is_read_again(measurement: tuple[tuple[int, ...], ModeSet]) -> None:
    numbers, modes = measurement
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "measured.csv"
        write_modes_csv(path, numbers, modes, comment=["a test", "of two lines"])
        again = read_modes_csv(path)
    assert again.numbers == numbers
    np.testing.assert_array_equal(again.modes.nodes, modes.nodes)
    np.testing.assert_array_equal(again.modes.components, modes.components)
    for name in ("frequencies_hz", "mode_shapes", "damping_ratios"):
        # ten digits are written: half a unit of the last one is 5e-10 at most
        np.testing.assert_allclose(
            getattr(again.modes, name), getattr(modes, name), rtol=5.1e-10, atol=1e-320
        )


def test_complex_shapes_are_not_written(tmp_path: Path) -> None:
    modes = mode_set([1.0], [[1.0 + 1.0j]], [1], [1])
    with pytest.raises(ModesError, match="complex"):
        write_modes_csv(tmp_path / "measured.csv", (1,), modes)
    assert not (tmp_path / "measured.csv").exists()


@pytest.mark.parametrize(
    ("old", "new", "problems"),
    [
        (TEXT, "", ["1: the first row must be `mode, 1, 2, ...`"]),
        (TEXT, "# nothing\n\n", ["1: the first row must be `mode, 1, 2, ...`"]),
        ("mode, 1, 3\n", "", ["3: the first row must be `mode, 1, 2, ...`"]),
        ("mode, 1, 3", "mode; 1; 3", ["4: columns are separated by ',', and by ';' in"]),
        ("1, 3", "1, 1", ["2: mode numbers must be different whole numbers, found 1, 1"]),
        ("1, 3", "1, 3.5", ["2: mode numbers must be different whole numbers, found 1, 3.5"]),
        ("1, 3", "1, ²", ["2: mode numbers must be different whole numbers, found 1, ²"]),
        ("34.8", "34;8", ["4: `frequency_hz` has '34;8' where a number must be"]),
        ("34.8", "nan", ["4: `frequency_hz` has 'nan' where a number must be"]),
        ("-0.25", "inf", ["6: `101.x` has 'inf' where a number must be"]),
        ("-0.25", "", ["6: `101.x` has 1 values for 2 modes"]),
        (", -0.25", "", ["6: `101.x` has 1 values for 2 modes"]),
        ("0.003", "0.003, 0.002", ["5: `damping_ratio` has 3 values for 2 modes"]),
        ("34.8", "0", ["4: frequencies must be above zero"]),
        ("5.5", "-5.5", ["4: frequencies must be above zero"]),
        ("101.rz", "101.x", ["7: a second row `101.x`"]),
        ("101.rz", "0101.x", ["7: a second row `0101.x`"]),
        ("damping_ratio", "frequency_hz", ["5: a second row `frequency_hz`"]),
        ("damping_ratio", "loss", ["5: row `loss` is neither frequency_hz, damping_ratio"]),
        ("0.003", "1.5", ["5: 1.5 times critical damping; where it is per cent, write"]),
        ("101.rz", "101.w", ["7: row `101.w` is neither"]),
        ("101.rz", "1²1.z", ["7: row `1²1.z` is neither"]),
        ("101.rz", "mode", ["7: row `mode` is neither"]),
        ("frequency_hz, 5.5, 34.8\n", "", ["2: no row `frequency_hz` follows"]),
        ("-0.25\n101.rz, 0, 1e-3", "0\n101.rz, 0, 0", ["2: mode 3 is zero at every sensor"]),
        ("5.5, 34.8", "x, -1", ["4: `frequency_hz` has 'x' where", "4: frequencies must be"]),
        ("101.x, 0.5, -0.25\n101.rz", "101, 0.5\n101.q", ["6: `101` has 1 values for 2 modes",
         "6: row `101` is neither", "7: row `101.q` is neither"]),
    ],
)  # fmt: skip
def test_every_problem_names_file_and_line(
    tmp_path: Path, old: str, new: str, problems: list[str]
) -> None:
    assert TEXT.count(old) == 1
    path = file_of(tmp_path, TEXT.replace(old, new))
    with pytest.raises(CampaignError) as caught:
        read_modes_csv(path)
    found = caught.value.problems
    assert len(found) == len(problems)
    for said, expected in zip(found, problems, strict=True):
        assert said.startswith(f"{path}, line {expected}")


def test_a_file_that_is_no_text_names_its_line(tmp_path: Path) -> None:
    path = tmp_path / "measured.csv"
    path.write_bytes(b"mode,1\nfrequency_hz,\x00\x02\n")
    with pytest.raises(CampaignError) as caught:
        read_modes_csv(path)
    assert str(caught.value).startswith(f"test file {path}, line 2: not a text file")


def test_a_field_of_endless_length_names_its_line(tmp_path: Path) -> None:
    path = file_of(tmp_path, "mode,1\nfrequency_hz," + "9" * 200_000 + "\n")
    with pytest.raises(CampaignError) as caught:
        read_modes_csv(path)
    assert str(caught.value).startswith(f"{path}, line 2: field larger than")


@pytest.mark.parametrize("name", ["absent.csv", "."])
def test_a_file_that_cannot_be_read_is_named(tmp_path: Path, name: str) -> None:
    with pytest.raises(CampaignError) as caught:
        read_modes_csv(tmp_path / name)
    assert str(caught.value).startswith(f"test file {tmp_path / name} cannot be read: ")


def test_deviations_come_back_from_csv_and_hdf5(tmp_path: Path) -> None:
    known = MeasuredDeviations(np.array([0.001, 0.02]), np.array([0.05, 0.1]))
    modes = mode_set([3.0, 5.0], [[1.0, 2.0]], [7], [3])
    write_modes_csv(tmp_path / "a.csv", (1, 2), modes, deviations=known)
    found = read_test_csv(tmp_path / "a.csv")
    write_test_hdf5(tmp_path / "a.h5", found)
    for back in (found, read_test_hdf5(tmp_path / "a.h5")):
        assert back.deviations is not None
        np.testing.assert_array_equal(back.deviations.frequencies, known.frequencies)
        np.testing.assert_array_equal(back.deviations.shapes, known.shapes)
    with pytest.raises(ModesError, match="no place for deviations"):
        write_universal(tmp_path / "a.unv", found)
