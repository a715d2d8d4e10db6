"""Tests as HDF5: read back exactly, refused where a bit is wrong."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from modetune.adapters.test_files.hdf5 import read_test_hdf5, write_test_hdf5
from modetune.adapters.test_files.measurements import read_measurement
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import Measurement
from tests.adapters.test_files.measured_tests import Wanted, made, wanted_tests
from tests.core.storage.test_sealed_file import resealed

TEXT = st.characters(codec="utf-8", exclude_characters="\0")


def same(one: Any, other: Any) -> None:
    """Both are equal bit for bit, field by field."""
    assert type(one) is type(other)
    if not hasattr(one, "__dataclass_fields__"):
        np.testing.assert_array_equal(one, other)
        assert getattr(one, "dtype", None) == getattr(other, "dtype", None)
        return
    for field in fields(one):
        same(getattr(one, field.name), getattr(other, field.name))


@settings(max_examples=40)
@given(wanted_tests, st.lists(st.text(TEXT, max_size=20)))
def test_a_test_is_read_back_exactly(tmp_path: Path, wanted: Wanted, notes: list[str]) -> None:
    test = replace(made(wanted), notes=tuple(notes))
    write_test_hdf5(tmp_path / "t.h5", test)
    same(read_test_hdf5(tmp_path / "t.h5"), test)


def test_a_note_that_hdf5_cannot_hold_is_kept_readable(tmp_path: Path) -> None:
    write_test_hdf5(tmp_path / "t.h5", Measurement(notes=("file \udce9.unv", "a\0b")))
    assert read_test_hdf5(tmp_path / "t.h5").notes == (r"file \udce9.unv", r"a\x00b")


def test_an_empty_test_is_read_back_and_refused_as_a_test_to_use(tmp_path: Path) -> None:
    write_test_hdf5(tmp_path / "t.h5", Measurement())
    same(read_test_hdf5(tmp_path / "t.h5"), Measurement())
    with pytest.raises(CampaignError, match="no modes, points or response functions"):
        read_measurement([tmp_path / "t.h5"])


@settings(max_examples=60)
@given(st.data())
def test_a_file_with_a_wrong_byte_is_refused(tmp_path: Path, data: st.DataObject) -> None:
    path = tmp_path / "t.h5"
    write_test_hdf5(path, made(Wanted(1)))
    content = bytearray(path.read_bytes())
    place = data.draw(st.integers(0, len(content) - 1))
    content[place] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)
    with pytest.raises(CampaignError, match=r"does not hold|is not a test that modetune wrote"):
        read_test_hdf5(path)


@pytest.mark.parametrize("size", [0, 10, 511, 512, 4000])
def test_a_file_that_is_cut_short_is_refused(tmp_path: Path, size: int) -> None:
    path = tmp_path / "t.h5"
    write_test_hdf5(path, made(Wanted(1)))
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(CampaignError):
        read_test_hdf5(path)


def test_an_hdf5_file_of_another_program_is_refused_with_the_remedy(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "t.h5", "w") as file:
        file["frequencies"] = [1.0]
    with pytest.raises(CampaignError, match=r"modetune files inspect FILES --write OUT\.h5"):
        read_test_hdf5(tmp_path / "t.h5")


def sealed(path: Path, change: Any) -> Path:
    """A file with a right checksum whose content somebody changed."""
    write_test_hdf5(path, made(Wanted(1)))
    return resealed(path, change)


def newer(file: Any) -> None:
    file.attrs["version"] = 9


def without_shapes(file: Any) -> None:
    del file["modes/mode_shapes"]


def with_text(file: Any) -> None:
    del file["modes/frequencies_hz"]
    file["modes/frequencies_hz"] = "fast"


def with_a_row_too_many(file: Any) -> None:
    nodes = file["modes/nodes"][()]
    del file["modes/nodes"]
    file["modes/nodes"] = np.append(nodes, 1)


def of_the_size_of_a_disk(file: Any) -> None:
    del file["frfs/values"]
    file.create_dataset("frfs/values", shape=(10**7, 10**7), dtype="c16", chunks=(1000, 1000))


@pytest.mark.parametrize(
    "change", [newer, without_shapes, with_text, with_a_row_too_many, of_the_size_of_a_disk]
)
def test_content_that_does_not_fit_is_refused(tmp_path: Path, change: Any) -> None:
    with pytest.raises(CampaignError, match=r"t\.h5"):
        read_test_hdf5(sealed(tmp_path / "t.h5", change))


def test_what_stood_there_stays_where_writing_fails(tmp_path: Path) -> None:
    path = tmp_path / "t.h5"
    write_test_hdf5(path, made(Wanted(1)))
    before = path.read_bytes()
    test = made(Wanted(2))
    assert test.modes is not None
    numbers: Any = ("first",) * test.modes.modes.n_modes
    wrong = replace(test.modes, numbers=numbers)
    with pytest.raises(ValueError, match="first"):
        write_test_hdf5(path, replace(test, modes=wrong))
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["t.h5"]


def test_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CampaignError, match="Is a directory"):
        read_test_hdf5(tmp_path)
