"""Seals: what they vouch for is what was written, and nothing else is."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest

from modetune.core.errors import CampaignError, StoreDamaged
from modetune.core.storage.sealed_file import BLOCK, content, holds, read_head, sealed, title_of


def resealed(path: Path, change: Callable[[h5py.File], None]) -> Path:
    """A file whose content somebody changed, with a right checksum."""
    title = title_of(path.read_bytes())
    with path.open("rb") as read:
        head = read_head(read, title)

    def changed(file: h5py.File) -> None:
        with h5py.File(io.BytesIO(path.read_bytes()), "r") as before:
            for name in before:
                before.copy(name, file)
            file.attrs.update(before.attrs)
        change(file)

    path.write_bytes(sealed(title, changed, head))
    return path


def damages(good: bytes, count: int = 600) -> Iterator[bytes]:
    """The bytes of a file with one bit flipped, at its ends and all over, or cut short."""
    noise = np.random.default_rng(11)
    flips = {0, 1, BLOCK - 1, BLOCK, len(good) - 1, *noise.integers(0, len(good), count).tolist()}
    for place in sorted(flips):
        yield good[:place] + bytes([good[place] ^ 1 << place % 8]) + good[place + 1 :]
    for size in noise.integers(0, len(good), count // 3).tolist():
        yield good[:size]


def refused_when_damaged(file: Path, read: Callable[[Path], object]) -> None:
    """Assert that no damage to a record is believed, and that HDF5 sees none of it."""
    good = file.read_bytes()

    def opened(*_: object) -> None:
        raise AssertionError("HDF5 opens a damaged record")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("h5py.File.__init__", opened)
        for number, damaged in enumerate(damages(good)):
            file.write_bytes(damaged)
            with pytest.raises((StoreDamaged, CampaignError)) as told:
                read(file)
            assert str(told.value).count("\n") == 0, number
            assert str(file) in str(told.value)
    file.write_bytes(good)
    read(file)


def fill(file: h5py.File) -> None:
    file["numbers"] = np.arange(5)


@pytest.mark.parametrize("length", [0, 1, 400, 431, 432, 433, 434, 500, 5000])
def test_a_head_of_any_length_stands_before_what_hdf5_reads(tmp_path: Path, length: int) -> None:
    head = "x" * length
    (tmp_path / "a.h5").write_bytes(sealed("a file 1", fill, head))
    data = (tmp_path / "a.h5").read_bytes()
    assert holds(data, "a file 1")
    assert title_of(data) == "a file 1"
    assert read_head(io.BytesIO(data), "a file 1") == head
    assert read_head(io.BytesIO(data), "a file 2") == ""
    with content(data) as file:
        assert file["numbers"][()].tolist() == [0, 1, 2, 3, 4]
    with h5py.File(tmp_path / "a.h5") as file:  # the whole file, by any program
        assert file["numbers"].shape == (5,)


@pytest.mark.parametrize("head", ["", "{}", "x" * 600])
def test_every_flipped_bit_and_every_cut_is_seen(head: str) -> None:
    good = bytes(sealed("a file 1", fill, head))
    for place in range(len(good)):
        spoilt = bytearray(good)
        spoilt[place] ^= 1 << place % 8
        assert not holds(bytes(spoilt), "a file 1"), f"byte {place}"
    assert not any(holds(good[:size], "a file 1") for size in range(0, len(good), 7))
    assert not holds(good + b"\n", "a file 1")


@pytest.mark.parametrize("data", [b"", b"\n", b"\n\n\n", b"text", b"\xff\n\n\n", b"\x89HDF\r\n"])
def test_what_was_never_sealed_is_not_vouched_for(data: bytes) -> None:
    assert not holds(data, "a file 1")
    assert read_head(io.BytesIO(data), "a file 1") == ""


def test_what_is_sealed_and_is_not_hdf5_is_told() -> None:
    with pytest.raises(StoreDamaged, match="not HDF5"), content(b"text" * 500):
        pass
