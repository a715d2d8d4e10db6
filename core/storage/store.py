"""The store: results of solver runs by content key, one HDF5 file each, shared by everybody.

    STORE/ab/abcdef....3.h5   a result, and before it in plain text what was asked, by whom it was
                              computed, and a note; 3 is the number of the format
    STORE/damaged/            entries whose checksum did not hold, set aside
    STORE/locks/KEY           one lock a job under way, freed when its holder dies; its file goes
                              with it

A file is written aside, flushed to disk and renamed, so an entry is whole or absent. Many
processes and machines may share the folder. An entry whose checksum does not match
(`core/storage/sealed_file`) is set aside with a warning and counts as absent.

In a folder that is set-group-ID and that its group may write, the group's members may read, write
and remove every file and folder of the store, whoever made it and with whatever umask.

The format before is read too, where its content has all that this one's has; `upgrade` rewrites
such an entry. Entries of other formats, older or newer, are other files: they are left alone.
"""

from __future__ import annotations

import io
import json
import logging
import os
import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import IO, Any, TypeVar

import h5py

from modetune.core.algebra.eigen import SolvedModes
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.algebra.rigid_modes import COMPLETE
from modetune.core.errors import StorageUnavailable, StoreDamaged, StoreError
from modetune.core.measurement.registration import Registration
from modetune.core.storage.codec import read_array, read_value, write_value
from modetune.core.storage.files import check_writable, make_folder, storage_errors, writing
from modetune.core.storage.locks import FileLock
from modetune.core.storage.sealed_file import content, holds, read_head, sealed
from modetune.core.updating.job_results import ModalResult, ModesForecast, Result
from modetune.core.updating.minima import SearchEnds
from modetune.core.updating.parameter_matrices import ParameterMatrices
from modetune.core.updating.reduced_basis import ReducedModel, ReducedRange
from modetune.core.updating.sensitivity import ModeDerivatives

R = TypeVar("R")

logger = logging.getLogger(__name__)

#: The name of an entry's file.
ENTRY = re.compile(r"(?P<key>[0-9a-f]{64})\.(?P<format>\d{1,9})\.h5")
#: Grows whenever the layout of a result's dataclasses changes.
FORMAT = 4
KIND_OF_FILE = "modetune store entry "
TITLE = f"{KIND_OF_FILE}{FORMAT}"
KINDS: dict[str, type[Result]] = {
    "modal": ModalResult,
    "matrices": MatrixResult,
    "derivatives": ModeDerivatives,
    "parameter_matrices": ParameterMatrices,
    "reduced": ReducedModel,
    "reduced_range": ReducedRange,
    "modes_forecast": ModesForecast,
    "registration": Registration,
    "solved_modes": SolvedModes,
    "search_ends": SearchEnds,
}


def _with_rigid_modes(kind: str, file: h5py.File) -> None:
    """Change a result of format 3 into one of format 4, which counts the rigid modes.

    Energies decide it where each is all of its mode's eigenvalue: then no mode is rigid. Raises
    ValueError for any other modes, as only their solver knows what its energies leave out.
    """
    if kind == "modal":
        eigenvalues = read_array(file, "eigenvalues")
        missing = 2.0 * read_array(file, "total_strain_energy") - eigenvalues
        if not (abs(missing) <= COMPLETE * abs(eigenvalues)).all():
            raise ValueError("how many of its modes are rigid is not known")
        file.attrs["n_rigid"] = 0


#: By the number of an earlier format: changes the content of a result of a kind into the next
#: format's, or raises ValueError where that cannot be done.
EARLIER: dict[int, Callable[[str, h5py.File], None]] = {3: _with_rigid_modes}


@dataclass(frozen=True, slots=True)
class Entry:
    """A stored result with what it cost and who computed it."""

    key: str
    result: Result
    solver: str
    solver_version: str
    wall_s: float


@dataclass(frozen=True, slots=True)
class Holding:
    """The head of an entry, before its result.

    kind: of the result, one of KINDS; asked: the canonical JSON behind the key; note: additional
    information for people, may be empty.
    """

    key: str
    kind: str
    asked: str
    note: str
    solver: str
    solver_version: str
    wall_s: float


@dataclass(frozen=True, slots=True)
class Store:
    """A folder of results by content key."""

    folder: Path

    def path(self, key: str, number: int = FORMAT) -> Path:
        return self.folder / key[:2] / f"{key}.{number}.h5"

    @property
    def is_read_only(self) -> bool:
        """Whether the folder is there and may be read, but not written."""
        may = os.access(self.folder, os.R_OK | os.X_OK)
        return may and not os.access(self.folder, os.W_OK)

    def check_usable(self, remedy: str) -> None:
        """Warn of a store that can only be read. Raises StorageUnavailable for any other trouble.

        What such a store has is used, and the first result that it lacks ends the run.
        """
        if not self.is_read_only:
            check_writable(self.folder, remedy)
            return
        logger.warning(
            "the store %s can only be read: its results are used, and the first one that it lacks "
            "ends the run; to compute more, %s",
            self.folder,
            remedy,
        )

    def __contains__(self, key: str) -> bool:
        path = self.path(key)
        with storage_errors(path):
            found = path.is_file()
            there = not found and path.parent.is_dir()
            beside = [item.name for item in path.parent.iterdir()] if there else []
        if any(name.startswith(f"{key}.") and name.endswith("h5") for name in beside):
            if self._earlier(key) is not None:
                return True
            _tell_of_other_formats(self.folder)
        return found

    def get(self, key: str) -> Entry | None:
        """The entry of this key, or nothing; a damaged one is set aside and counts as nothing.

        Raises StorageUnavailable where the folder may not be read.
        """
        # Another process may upgrade or write the entry between the first look and the second.
        return (
            self._checked(key, _read_entry) or self._earlier(key) or self._checked(key, _read_entry)
        )

    def check(self, key: str) -> bool:
        """Whether the entry of this key is, bit for bit, what was written; a damaged one is set
        aside. Raises StorageUnavailable where it may not be read."""
        return self._checked(key, _head_of) is not None

    def _earlier(self, key: str) -> Entry | None:
        """The entry of this key in an earlier format; nothing where it cannot be read."""
        for number in sorted(EARLIER, reverse=True):
            with suppress(FileNotFoundError, StoreError):
                return self.read_earlier(key, number)[0]
        return None

    def read_earlier(self, key: str, number: int) -> tuple[Entry, str, str]:
        """Return an entry of an earlier format, with what was asked and its note.

        Raises FileNotFoundError, StoreDamaged, StorageUnavailable.
        """
        path = self.path(key, number)
        if number not in EARLIER:
            raise StoreDamaged(
                f"{path} has format {number}, and this version of modetune reads results of format "
                f"{' and '.join(map(str, (*EARLIER, FORMAT)))}; "
                + (
                    "use the later version"
                    if number > FORMAT
                    else "what is needed is computed again"
                )
            )
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            raise
        except OSError as error:
            raise StorageUnavailable(f"{path} could not be read: {error.strerror}") from error
        return _read_earlier(data, path, key, number)

    def upgrade(self, key: str, number: int) -> None:
        """Rewrite an entry of an earlier format; the old file goes when the new one is verified.

        Whoever computes the same result at that time writes the same file. Raises
        FileNotFoundError, StoreDamaged, StorageUnavailable.
        """
        path, old = self.path(key), self.path(key, number)
        entry, asked, note = self.read_earlier(key, number)
        with storage_errors(path, "ask its owner"):
            written = old.stat()
            if not (path.is_file() and self.check(key)):
                self.put(entry, asked, note)
                os.utime(path, ns=(written.st_atime_ns, written.st_mtime_ns))
            if not self.check(key):
                raise StoreDamaged(f"{path} was written and is damaged; check the disk")
            old.unlink(missing_ok=True)

    def _checked(self, key: str, read: Callable[[bytes, Path, str], R]) -> R | None:
        """What is read of an entry; nothing where there is none, or `read` finds it damaged."""
        path = self.path(key)
        try:
            with path.open("rb") as file:
                try:
                    return read(file.read(), path, key)
                except StoreDamaged as problem:
                    logger.warning("%s; set aside, it will be computed again", problem)
                    self._set_aside(path, os.fstat(file.fileno()).st_ino)
                    return None
        except FileNotFoundError:
            return None
        except PermissionError as error:
            raise StorageUnavailable(f"{path} may not be read; give read permission") from error
        except OSError as error:  # too many files, a stale handle, a bad disk: no word on the entry
            raise StorageUnavailable(f"{path} could not be read: {error}") from error

    def put(self, entry: Entry, asked: str, note: str = "") -> None:
        """Write an entry whole or not at all.

        asked: the canonical JSON behind the key; note: additional information for people.
        Raises StorageUnavailable on a full disk or without permission.
        """
        kind = next(name for name, form in KINDS.items() if isinstance(entry.result, form))
        head = json.dumps(
            {
                "key": entry.key,
                "kind": kind,
                "asked": asked,
                "note": note,
                "solver": entry.solver,
                "solver_version": entry.solver_version,
                "wall_s": entry.wall_s,
            }
        )
        data = sealed(TITLE, lambda file: write_value(file, entry.result), head)
        with writing(self.path(entry.key)) as part:
            part.write_bytes(data)

    def entries(self, start: str = "") -> Iterator[Path]:
        """The files of entries whose keys start so; start: at least two digits, or nothing."""
        return self.folder.glob(f"{start[:2] or '[0-9a-f][0-9a-f]'}/{start}*.{FORMAT}.h5")

    def holding(self, key: str) -> Holding | None:
        """Return the head of the entry of this key; None if it cannot be read.

        It reads no result and verifies no checksum, so do not compute anything from it: reading the
        entry finds damage.
        """
        try:
            with self.path(key).open("rb") as file:
                return _holding(file)
        except OSError:
            return None

    def drop(self, key: str) -> None:
        """Remove the entry of this key, if there is one. Raises StorageUnavailable."""
        path = self.path(key)
        with storage_errors(path):
            path.unlink(missing_ok=True)

    @contextmanager
    def lock(self, key: str, waiting: Callable[[], None]) -> Iterator[None]:
        """Hold the job of this key; a second holder, of this or another process, waits.

        waiting: called over and over while another holds it; it sleeps a little, or raises. The
        file of the lock is removed while it is held: who waits for it makes a new one.
        """
        lock = FileLock(self.folder / "locks" / key)
        with ExitStack() as stack:
            try:
                stack.enter_context(lock.held(waiting))
            except StorageUnavailable as error:
                text = f"the store {self.folder} lacks the result {key[:12]}, and {error}"
                raise StorageUnavailable(text) from error
            try:
                yield
            finally:
                with suppress(StorageUnavailable):  # the next holder, or `prunable`, removes it
                    lock.remove()

    def _set_aside(self, path: Path, inode: int) -> None:
        """Move a damaged file away, unless another process has put a good one there since."""
        with storage_errors(path):
            target = self.folder / "damaged" / path.name
            make_folder(target.parent)
            with suppress(FileNotFoundError):  # another process found the same damage
                if path.stat().st_ino != inode:
                    return
                path.replace(target)
                if target.stat().st_ino != inode:  # written between two breaths: back with it
                    target.replace(path)


@cache
def _tell_of_other_formats(folder: Path) -> None:
    """Say it once."""
    logger.warning(
        "%s holds results in a format that this version of modetune does not read (it reads "
        "KEY.%s.h5); they are left alone, and what is needed is computed again. Remove them "
        "when no other version uses the store.",
        folder,
        ".h5 and KEY.".join(map(str, (FORMAT, *EARLIER))),
    )


def _holding(file: IO[bytes]) -> Holding | None:
    try:
        head = json.loads(read_head(file, TITLE))
        return Holding(
            key=str(head["key"]),
            kind=str(head["kind"]),
            asked=str(head["asked"]),
            note=str(head["note"]),
            solver=str(head["solver"]),
            solver_version=str(head["solver_version"]),
            wall_s=float(head["wall_s"]),
        )
    except (ValueError, KeyError, TypeError, RecursionError):
        return None


def _head_of(data: bytes, path: Path, key: str, title: str = TITLE) -> dict[str, Any]:
    """Return the head of a file after its checksum was verified. Raises StoreDamaged."""
    if not holds(data, title):
        raise StoreDamaged(f"the checksum of {path} does not hold")
    try:
        head: dict[str, Any] = json.loads(read_head(io.BytesIO(data), title))
        other = head["key"] != key
    except (ValueError, KeyError, TypeError) as error:
        raise StoreDamaged(f"{path} is not a readable store entry ({error})") from error
    if other:
        raise StoreDamaged(f"{path} is the entry of another key")
    return head


def _read_entry(data: bytes, path: Path, key: str) -> Entry:
    """The entry that a file's bytes are. Raises StoreDamaged."""
    head = _head_of(data, path, key)
    try:
        with content(data) as file:
            result = read_value(file, KINDS[head["kind"]])
        return Entry(key, result, head["solver"], head["solver_version"], head["wall_s"])
    except (ValueError, KeyError, TypeError, StoreDamaged) as error:
        raise StoreDamaged(f"{path} is not a readable store entry ({error})") from error


def _read_earlier(data: bytes, path: Path, key: str, number: int) -> tuple[Entry, str, str]:
    """The entry of an earlier format that a file's bytes are. Raises StoreDamaged."""
    head = _head_of(data, path, key, f"{KIND_OF_FILE}{number}")
    try:
        with content(data, "r+") as file:
            for earlier in range(number, FORMAT):
                EARLIER[earlier](head["kind"], file)
            result = read_value(file, KINDS[head["kind"]])
        entry = Entry(key, result, head["solver"], head["solver_version"], head["wall_s"])
        return entry, str(head["asked"]), str(head["note"])
    except (ValueError, KeyError, TypeError, StoreDamaged) as error:
        raise StoreDamaged(
            f"{path} has a result of format {number} that cannot be read as one of format "
            f"{FORMAT} ({error}); it is computed again when it is needed"
        ) from error
