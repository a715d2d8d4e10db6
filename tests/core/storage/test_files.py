"""Files: whole or not at all, and every refusal of the system a sentence."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from modetune.core.errors import StorageUnavailable
from modetune.core.storage.files import (
    WRITTEN_S,
    check_writable,
    remove_parts,
    storage_errors,
    writing,
)


def test_a_failed_write_leaves_what_stood_there(tmp_path: Path) -> None:
    target = tmp_path / "file"
    target.write_text("before")

    def fail() -> None:
        with writing(target) as part:
            part.write_text("half")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert target.read_text() == "before"
    assert list(tmp_path.iterdir()) == [target]


def test_what_a_killed_process_half_wrote_goes_after_an_hour(tmp_path: Path) -> None:
    names = (".a.part", "history/.b.part", "history/.run.part/deck.inp")
    for folder in ("old", "new"):
        for name in names:
            path = tmp_path / folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
    for part in (tmp_path / "old").rglob("*.part"):
        os.utime(part, (time.time() - WRITTEN_S - 60.0,) * 2)
    for folder in ("old", "new"):
        remove_parts(tmp_path / folder)
    assert list((tmp_path / "old").rglob("*.part")) == []
    assert len(list((tmp_path / "new").rglob("*.part"))) == len(names)


def test_a_place_that_cannot_be_a_folder_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageUnavailable, match="use MODETUNE_STORE"):
        check_writable(tmp_path / "file" / "store", "use MODETUNE_STORE")


def test_every_place_that_cannot_be_written_is_a_sentence(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")

    def write(path: Path) -> None:
        with writing(path, "name another") as part:
            part.write_text("")

    for place in (file / "a.csv", file / "deep" / "a.csv"):
        with pytest.raises(StorageUnavailable, match=f"^{file} is a file, and a folder is needed"):
            write(place)
    with pytest.raises(StorageUnavailable, match=f"^{tmp_path} is a folder, and a file is needed"):
        write(tmp_path)
    with pytest.raises(StorageUnavailable, match=r"^/proc cannot be written .*name another"):
        write(Path("/proc/a.csv"))
    with pytest.raises(StorageUnavailable, match=r"^/proc/nothing cannot be written"):
        check_writable(Path("/proc/nothing"), "name another")
    with pytest.raises(StorageUnavailable, match=r"cannot be written \(File name too long\)"):
        write(tmp_path / ("x" * 300) / "a.csv")


def test_an_error_of_another_file_is_not_the_places(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), storage_errors(tmp_path / "job.part"):
        (tmp_path / "job.part" / "result").read_text()


def test_a_device_is_written_to_and_keeps_its_place() -> None:
    with writing(Path(os.devnull)) as part:
        part.write_text("nothing")
    assert Path(os.devnull).is_char_device()


def test_a_pipe_is_written_to_and_keeps_its_place(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    with writing(pipe) as part:
        part.write_text("all of it")
    assert os.read(reader, 100) == b"all of it"
    os.close(reader)
    assert pipe.is_fifo()
