"""Universal files that are broken, hostile, or hold what nobody knows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from modetune.adapters.test_files.measurements import read_measurement
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import Measurement
from tests.adapters.test_files.universal_text import (
    binary_58,
    dataset,
    even_58,
    mode_55,
    nodes_15,
    nodes_2411,
    save,
    system_18,
    units_164,
)

GOOD = mode_55(1, 5.0, {1: [1, 2, 3], 2: [4, 5, 6]})
WHOLE = "".join(
    [
        units_164(1000.0),
        dataset(18, *system_18(2, 0, 0, ((0, 0, 0), (1, 0, 0), (0, 0, 1)))),
        nodes_15((1, 0, 2, (1, 2, 3)), (2, 0, 0, (4, 5, 6))),
        nodes_2411((3, 0, (1, 2, 3))),
        dataset(82, f"{1:10d}{2:10d}{0:10d}", "a", f"{1:10d}{2:10d}"),
        dataset(2412, f"{1:10d}{91:10d}{1:10d}{1:10d}{7:10d}{3:10d}", f"{1:10d}{2:10d}{3:10d}"),
        GOOD,
        mode_55(2, complex(-1, 50), {1: [1 + 1j] * 3, 2: [2 + 2j] * 3}),
        even_58([1 + 1j, 2 + 2j, 3 + 3j], (1, 1, 2, 2)),
    ]
)


def refused(path: Path) -> str:
    with pytest.raises(CampaignError) as raised:
        read_measurement([path])
    return str(raised.value)


def test_an_empty_file_is_refused(tmp_path: Path) -> None:
    assert refused(save(tmp_path / "t.unv", "")).startswith(
        f"{tmp_path / 't.unv'} is an empty file"
    )
    assert "is empty" in refused(save(tmp_path / "t.unv", "\n \n"))


def test_a_folder_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    (tmp_path / "folder.unv").mkdir()
    assert "Is a directory" in refused(tmp_path / "folder.unv")
    assert "No such file" in refused(tmp_path / "none.unv")


def test_a_file_without_datasets_is_refused(tmp_path: Path) -> None:
    assert "holds no dataset of a universal file" in refused(save(tmp_path / "t.unv", "hello\n"))


def test_a_file_that_is_cut_short_is_refused_with_the_line(tmp_path: Path) -> None:
    path = save(tmp_path / "t.unv", GOOD, GOOD[:-20])
    said = refused(path)
    assert f"{path}, line 17: dataset 55 has no end mark" in said
    assert "copy or export it again" in said


@pytest.mark.parametrize("claimed", [999_999_999_999, 100_000_000_000])
def test_a_header_that_claims_what_the_file_cannot_hold_is_refused(
    tmp_path: Path, claimed: int
) -> None:
    data = binary_58(np.ones(2), (1, 1, 1, 1), (6, 9_999_999_999, 1, 0.0, 1.0), claimed=claimed)
    assert "line 2: dataset 58b has no end mark" in refused(save(tmp_path / "t.unv", data))


def test_text_that_announces_more_values_than_it_has_is_passed_over(tmp_path: Path) -> None:
    text = even_58([1 + 1j, 2 + 2j], (1, 1, 1, 1)).replace(f"{5:10d}{2:10d}", f"{5:10d}9999999999")
    said = refused(save(tmp_path / "t.unv", text))
    assert "announces 9999999999 values and has 2" in said


def test_unknown_datasets_are_named_and_the_others_read(tmp_path: Path) -> None:
    path = save(
        tmp_path / "t.unv", dataset(2467, "      1"), GOOD, dataset(777, "x"), dataset(777, "x")
    )
    measurement = read_measurement([path])
    assert measurement.modes is not None
    assert f"{path}: dataset 2467 (line 2) is not one that is read here" in measurement.notes
    assert any("dataset 777 (2 times, lines" in note for note in measurement.notes)


@pytest.mark.parametrize(
    "text",
    [
        dataset(15, f"{1:10d}{0:10d}{0:10d}{0:10d} 1.0 2.0"),
        dataset(15, f"{1:10d}{0:10d}{0:10d}{0:10d} 1.0 2.0 x"),
        dataset(2411, f"{1:10d}{0:10d}"),
        dataset(18, "1"),
        dataset(55, "a"),
        dataset(55, *["NONE"] * 5, "", "", ""),
        GOOD.replace(f"{2:10d}\n", f"{'two':>10}\n"),
        dataset(82, "x"),
        dataset(164, "x"),
        dataset(2412, "1 2"),
        dataset(2412, f"{1:10d}{91:10d}{1:10d}{1:10d}{7:10d}{3:10d}", f"{1:10d}"),
        dataset(2414, "1"),
        dataset(2420, "1"),
        dataset(58, "NONE"),
        nodes_15((1, 0, 0, (1, 2, 3))).replace("2.00000E+00", "        NaN"),
        nodes_15((1, 0, 0, (1, 2, 3))).replace("         1  ", "       1.5  ", 1),
    ],
)
def test_a_dataset_out_of_form_is_named_with_its_line_and_the_others_read(
    tmp_path: Path, text: str
) -> None:
    path = save(tmp_path / "t.unv", mode_55(7, 9.0, {1: [1, 2, 3]}), text)
    measurement = read_measurement([path])
    assert measurement.modes is not None
    assert measurement.modes.numbers == (7,)
    assert any(f"{path}, line 15 (dataset" in note for note in measurement.notes), measurement.notes


def test_a_row_that_ends_like_a_mark_ends_nothing(tmp_path: Path) -> None:
    path = save(
        tmp_path / "t.unv",
        GOOD.replace("NONE\n", "x    -1\n", 2),
        mode_55(2, 6.0, {1: [1, 2, 3], 2: [1, 1, 1]}),
    )
    measurement = read_measurement([path])
    assert measurement.modes is not None
    assert measurement.modes.numbers == (1, 2)


def test_ids_of_any_bytes_and_line_ends_of_windows_are_read(tmp_path: Path) -> None:
    text = GOOD.encode().replace(b"NONE", b"Gr\xf6\xdfe \x85 \x0c \x1c", 1)
    measurement = read_measurement([save(tmp_path / "t.unv", text.replace(b"\n", b"\r\n"))])
    assert measurement.modes is not None
    assert measurement.modes.modes.mode_shapes[:, 0].tolist() == [1, 2, 3, 4, 5, 6]


def test_the_mark_of_an_editor_before_the_first_dataset_is_no_part_of_it(tmp_path: Path) -> None:
    assert read_measurement([save(tmp_path / "t.unv", b"\xef\xbb\xbf", GOOD)]).modes


def test_words_after_the_last_dataset_are_passed_over(tmp_path: Path) -> None:
    assert read_measurement([save(tmp_path / "t.unv", "a comment\n", GOOD, "end\n    -1\n")]).modes


def read_or_refuse(path: Path) -> Measurement | None:
    try:
        return read_measurement([path])
    except CampaignError:
        return None


@settings(max_examples=150)
@given(st.data())
def test_a_damaged_file_is_read_or_refused_and_nothing_else(
    tmp_path: Path, data: st.DataObject
) -> None:
    text = bytearray(WHOLE.encode())
    for _ in range(data.draw(st.integers(1, 6))):
        place = data.draw(st.integers(0, len(text) - 1))
        text[place] = data.draw(st.sampled_from(b" 0123456789-+.ED\nxb\xff"))
    read_or_refuse(save(tmp_path / "t.unv", bytes(text)))


@pytest.mark.parametrize("end", range(7, len(WHOLE), 211))
def test_a_file_cut_anywhere_is_read_or_refused(tmp_path: Path, end: int) -> None:
    read_or_refuse(save(tmp_path / "t.unv", WHOLE[:end]))


def test_the_whole_file_of_these_tests_is_read(tmp_path: Path) -> None:
    measurement = read_or_refuse(save(tmp_path / "t.unv", WHOLE))
    assert measurement is not None
    assert measurement.modes is not None
    assert measurement.geometry is not None
    assert measurement.frfs is not None
    assert measurement.geometry.metres == 0.001
