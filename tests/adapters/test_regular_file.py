"""Files are read by their size, up to a limit."""

from __future__ import annotations

from pathlib import Path

import pytest

from modetune.adapters.regular_file import PIECE, read_regular


def test_a_small_file_needs_no_memory_for_a_large_one(tmp_path: Path) -> None:
    """The limit is a share of the machine's memory, more than a process may have to set aside."""
    path = tmp_path / "small.csv"
    path.write_bytes(b"a,b\n1,2\n")
    assert read_regular(path, 1 << 60) == b"a,b\n1,2\n"
    path.write_bytes(b"")
    assert read_regular(path, 1 << 60) == b""


def test_a_file_without_a_size_is_read_whole() -> None:
    status = Path("/proc/self/status")
    assert read_regular(status).startswith(b"Name:")


def test_a_file_above_the_limit_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "large.csv"
    path.write_bytes(bytes(2 * PIECE))
    assert len(read_regular(path, 2 * PIECE)) == 2 * PIECE
    with pytest.raises(OSError, match="it has more than 2 MB"):
        read_regular(path, 2 * PIECE - 1)
