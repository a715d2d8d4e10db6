"""The files of the lab that a campaign has received, and those that are new.

    tests/2026-11-27T02-00-00Z-1f0c9a2b.json    a received file: where it was, and what became of it
    tests/2026-11-27T02-00-00Z-1f0c9a2b.h5      its modes under the campaign's numbers, if accepted

Both are in the campaign's run folder. The lab's own files are read and never changed.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from modetune.adapters.test_files.file_kind import SUFFIXES
from modetune.core.errors import CampaignError
from modetune.core.monitoring.past_runs import utc
from modetune.core.storage.files import storage_errors, writing

#: The folder of received tests in a campaign's run folder.
FOLDER = "tests"
#: Files of other suffixes in the lab's folder, such as notes and pictures, are left alone.
KNOWN = frozenset({*SUFFIXES, ".mat", ".xlsx", ".op2", ".f06", ".pch", ".frd"})
#: Digits of the digest in a name.
SHORT = 8


@dataclass(frozen=True, slots=True)
class ReceivedFile:
    """A file of the lab and what became of it.

    digest: SHA-256; size, mtime_ns: by which the file is known again without reading it; at: when
    it was measured, seconds since 1970. decision: "accepted" or "set aside", with the reasons.
    modes: numbers of the modes that were found again; missing: those that were not; new_hz: of
    modes that earlier tests lack. updated: whether an update with it has ended, with its exit code,
    state and sentence.
    """

    file: str
    digest: str
    size: int
    mtime_ns: int
    at: float
    decision: str = ""
    reasons: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    modes: tuple[int, ...] = ()
    missing: tuple[int, ...] = ()
    new_hz: tuple[float, ...] = ()
    updated: bool = False
    exit_code: int = 0
    state: str = ""
    sentence: str = ""

    @property
    def stem(self) -> str:
        """The name of its files in the folder of received tests."""
        return f"{utc(self.at).replace(':', '-')}-{self.digest[:SHORT]}"

    @property
    def accepted(self) -> bool:
        return self.decision == "accepted"


class Inbox:
    """The received tests in a run folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / FOLDER
        self.received = sorted(self._read(), key=lambda item: (item.at, item.file))

    def modes_file(self, item: ReceivedFile) -> Path:
        """Return the file of an accepted test's modes."""
        return self.folder / f"{item.stem}.h5"

    def keep(self, item: ReceivedFile) -> None:
        """Write what became of a file. Raises StorageUnavailable."""
        others = [known for known in self.received if known.digest != item.digest]
        with writing(self.folder / f"{item.stem}.json") as part:
            part.write_text(f"{json.dumps(asdict(item), indent=1)}\n", encoding="utf-8")
        self.received = sorted([*others, item], key=lambda known: (known.at, known.file))

    def forget_aside(self) -> None:
        """Forget the files that were set aside, which are then new. Raises StorageUnavailable."""
        for item in [item for item in self.received if not item.accepted]:
            with storage_errors(self.folder):
                (self.folder / f"{item.stem}.json").unlink(missing_ok=True)
            self.received.remove(item)

    def new_files(
        self, places: Sequence[Path], settle_s: float
    ) -> tuple[list[ReceivedFile], list[Path]]:
        """Return the new files of folders, oldest first, and those that still arrive.

        places: folders, and files. A file arrives until it has not changed for settle_s seconds.
        Raises CampaignError for a place that is not there.
        """
        known = {(item.file, item.size, item.mtime_ns) for item in self.received}
        digests = {item.digest for item in self.received}
        new: list[ReceivedFile] = []
        arriving: list[Path] = []
        for path in _files(places):
            try:
                status = path.stat()
            except OSError:
                continue  # moved away a moment ago
            if (str(path), status.st_size, status.st_mtime_ns) in known:
                continue
            if _still_arrives(status, settle_s):
                arriving.append(path)
                continue
            digest = _digest(path)
            if digest not in digests:
                digests.add(digest)
                new.append(
                    ReceivedFile(
                        str(path),
                        digest,
                        status.st_size,
                        status.st_mtime_ns,
                        min(status.st_mtime, time.time()),
                    )
                )
        return sorted(new, key=lambda item: (item.at, item.file)), arriving

    def _read(self) -> Iterator[ReceivedFile]:
        with storage_errors(self.folder):
            texts = {file: file.read_text("utf-8") for file in sorted(self.folder.glob("*.json"))}
        for file, text in texts.items():
            try:
                yield _received(json.loads(text))
            except (ValueError, TypeError, KeyError) as error:
                raise CampaignError(
                    f"{file} is damaged ({error}); remove it, and its test is received again"
                ) from error


def _received(found: dict[str, Any]) -> ReceivedFile:
    known = {item.name for item in fields(ReceivedFile)}
    values: dict[str, Any] = {name: value for name, value in found.items() if name in known}
    values |= {name: tuple(value) for name, value in values.items() if isinstance(value, list)}
    return ReceivedFile(**values)


def _files(places: Sequence[Path]) -> Iterator[Path]:
    for place in places:
        if place.is_file():
            yield place
        elif place.is_dir():
            yield from sorted(
                path
                for path in place.iterdir()
                if path.suffix.lower() in KNOWN and path.name[0] != "." and path.is_file()
            )
        else:
            raise CampaignError(f"{place} is not there; name a folder of the lab, or a test file")


def _still_arrives(status: os.stat_result, settle_s: float) -> bool:
    """Return whether a file changed a moment ago.

    Where its writer's clock is ahead, the time at which it came counts; one that is ahead too says
    nothing.
    """
    age = time.time() - status.st_mtime
    if age < 0.0:
        age = time.time() - status.st_ctime
    return 0.0 <= age < settle_s


def _digest(path: Path) -> str:
    with storage_errors(path), path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
