"""Folders of a store for files that live as long as a process: factors that memory does not hold.

    STORE/jobs/factors-NAME.part    as a job's folder, with a lock of the same name: what a killed
                                    process left is a job broken off, for everybody

It goes with its matrix, or at the process's end; what was killed before is removed by the next
campaign that uses the store.
"""

from __future__ import annotations

import shutil
import uuid
import weakref
from functools import partial
from pathlib import Path

from modetune.core.algebra.mumps import FactorFiles
from modetune.core.storage.files import storage_errors
from modetune.core.storage.locks import FileLock
from modetune.core.storage.store import Store
from modetune.flows.jobs.store_files import beside, remove

PREFIX = "factors-"


def factor_files(store: Store) -> FactorFiles:
    """An empty folder of a store for the factors of one matrix. Raises StorageUnavailable."""
    name = f"{PREFIX}{uuid.uuid4().hex}"
    folder, lock = store.folder / "jobs" / f"{name}.part", FileLock(store.folder / "locks" / name)
    with storage_errors(folder):
        lock.take()  # nobody else knows the name
        folder.mkdir(parents=True)
    files = FactorFiles(folder, partial(_remove, folder, lock))
    weakref.finalize(files, files.remove)  # at the process's end too
    return files


def remove_abandoned(store: Store) -> None:
    """Remove the folders whose processes are gone. Raises StorageUnavailable."""
    if any((store.folder / "jobs").glob(f"{PREFIX}*")):
        found = beside(store, 0.0)
        remove(store, [item for item in found if item.path.name.startswith(PREFIX)])


def _remove(folder: Path, lock: FileLock) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    lock.path.unlink(missing_ok=True)
    lock.release()
