"""The store under attack: what is damaged is never believed, and what is good is never lost."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import StorageUnavailable
from modetune.core.modes import mode_set
from modetune.core.storage.sealed_file import BLOCK
from modetune.core.storage.store import Entry, Store
from modetune.core.updating.job_results import ModalResult
from tests.core.storage.test_store import holdings, matrices

KEYS = 200
PROCESSES = 8
#: An account without rights, for tests that root could not fail.
NOBODY = 65534

needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can do this")


def key_of(number: int) -> str:
    return f"{number:04d}" + "0" * 60


def result_of(number: int) -> ModalResult:
    """The one right result of a key."""
    random = np.random.default_rng(number)
    frequencies = np.sort(random.uniform(1.0, 9.0, 3))
    return ModalResult(
        (2 * np.pi * frequencies) ** 2,
        mode_set(frequencies, random.uniform(size=(6, 3)), np.arange(1, 7), np.ones(6)),
        (),
        np.zeros((0, 3)),
        np.ones(3),
        1.0,
    )


def put(store: Store, number: int) -> None:
    store.put(Entry(key_of(number), result_of(number), "calculix", "2.20", 1.5), "{}")


def is_right(entry: Entry, number: int) -> bool:
    found, expected = entry.result, result_of(number)
    assert isinstance(found, ModalResult)
    return np.array_equal(found.eigenvalues, expected.eigenvalues) and np.array_equal(
        found.modes.mode_shapes, expected.modes.mode_shapes
    )


def vandal(data: bytes, random: np.random.Generator) -> bytes:
    """The bytes with some flipped, overwritten, cut off, put in, or gone."""
    spoilt = bytearray(data)
    for _ in range(int(random.integers(1, 4))):
        place = int(random.integers(0, max(1, len(spoilt))))
        kind = int(random.integers(0, 5))
        if kind == 0 and spoilt:
            spoilt[min(place, len(spoilt) - 1)] ^= 1 << int(random.integers(0, 8))
        elif kind == 1:
            spoilt[place : place + 16] = random.bytes(16)
        elif kind == 2:
            del spoilt[place:]
        elif kind == 3:
            spoilt[place:place] = random.bytes(int(random.integers(1, 64)))
        else:
            del spoilt[place : place + int(random.integers(1, 64))]
    return bytes(spoilt)


def attack(folder: str, seed: int) -> tuple[int, int, int]:
    """Write, read and spoil the same keys as all others; counts of wrong, good and absent."""
    logging.disable(logging.CRITICAL)
    store, random = Store(Path(folder)), np.random.default_rng(seed)
    counts = [0, 0, 0]
    for number in random.permutation(KEYS).tolist():
        path, deed = store.path(key_of(number)), int(random.integers(0, 3))
        if deed == 0:
            put(store, number)
        elif deed == 1 and path.exists():
            try:
                path.write_bytes(vandal(path.read_bytes(), random))  # in place, others read
            except FileNotFoundError:
                pass  # set aside by another
        entry = store.get(key_of(number))
        place = 2 if entry is None else int(is_right(entry, number))
        counts[place] += 1
    return counts[0], counts[1], counts[2]


def test_eight_processes_never_believe_what_others_damage(tmp_path: Path) -> None:
    store = Store(tmp_path)
    with multiprocessing.get_context("spawn").Pool(PROCESSES) as pool:
        ends = pool.starmap(attack, [(str(tmp_path), seed) for seed in range(PROCESSES)])
    wrong, good, absent = (sum(counts) for counts in zip(*ends, strict=True))
    assert wrong == 0
    assert good > KEYS
    assert absent > 0
    assert list((tmp_path / "damaged").iterdir())
    assert not list(tmp_path.glob("**/.*.part"))
    for number in range(KEYS):  # whatever stands there now is right, or found out and replaced
        entry = store.get(key_of(number))
        if entry is None:
            put(store, number)
            entry = store.get(key_of(number))
        assert entry is not None
        assert is_right(entry, number)


def test_every_single_flipped_bit_of_a_file_is_found(tmp_path: Path) -> None:
    store = Store(tmp_path)
    put(store, 1)
    path = store.path(key_of(1))
    good, random = path.read_bytes(), np.random.default_rng(7)
    places = {0, BLOCK - 1, BLOCK, len(good) - 1, *random.integers(0, len(good), 400).tolist()}
    for place in sorted(places):
        spoilt = bytearray(good)
        spoilt[place] ^= 1 << int(random.integers(0, 8))
        path.write_bytes(spoilt)
        assert store.get(key_of(1)) is None, f"byte {place}"
        assert not path.exists()
    path.write_bytes(good)
    assert store.get(key_of(1)) is not None


def test_a_good_entry_written_meanwhile_is_not_set_aside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store(tmp_path)
    put(store, 1)
    path = store.path(key_of(1))
    path.write_bytes(path.read_bytes()[:-1])
    honest = Store._set_aside

    def after_another_wrote(self: Store, place: Path, inode: int) -> None:
        put(store, 1)
        honest(self, place, inode)

    monkeypatch.setattr(Store, "_set_aside", after_another_wrote)
    entry = store.get(key_of(1))  # damaged at first, and there when it looks again
    assert entry is not None
    assert is_right(entry, 1)


def test_an_entry_without_its_seal_is_no_hit(tmp_path: Path) -> None:
    store = Store(tmp_path)
    put(store, 1)
    path = store.path(key_of(1))
    path.write_bytes(path.read_bytes()[BLOCK:])  # a whole HDF5 file
    assert store.get(key_of(1)) is None


@pytest.mark.parametrize("name", ["{}.h5", "{}.3.h5"])
def test_an_entry_of_another_format_is_left_alone_and_told_of_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, name: str
) -> None:
    store = Store(tmp_path)
    other = tmp_path / key_of(1)[:2] / name.format(key_of(1))
    other.parent.mkdir()
    other.write_bytes(b"of another version")
    for _ in range(2):
        assert key_of(1) not in store
        assert store.get(key_of(1)) is None
    assert caplog.text.count("in a format that this version of modetune does not read") == 1
    assert holdings(store) == []
    put(store, 1)
    assert store.get(key_of(1)) is not None
    assert other.read_bytes() == b"of another version"
    assert [holding.key for holding in holdings(store)] == [key_of(1)]


def test_what_stands_before_entries_is_read_without_hdf5(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store(tmp_path)
    put(store, 1)
    good, random = store.path(key_of(1)).read_bytes(), np.random.default_rng(5)

    def opened(*_: object) -> None:
        raise AssertionError("HDF5 opens an entry")

    monkeypatch.setattr("h5py.File.__init__", opened)
    for _ in range(300):
        store.path(key_of(1)).write_bytes(vandal(good, random))
        assert len(holdings(store)) <= 1
    store.path(key_of(1)).write_bytes(good)
    (holding,) = holdings(store)
    assert (holding.key, holding.kind, holding.wall_s) == (key_of(1), "modal", 1.5)
    assert store.holding(key_of(1)) == holding
    assert store.holding(key_of(2)) is None


WITHOUT_RIGHTS = """
import os, sys
from pathlib import Path
from modetune.core.errors import StorageUnavailable
from modetune.core.storage.files import check_writable
from modetune.core.storage.store import Store
from tests.core.storage.test_store_attack import key_of, put
store = Store(Path(sys.argv[1]))
path = store.path(key_of(1))
def refused(deed):
    try:
        deed()
    except StorageUnavailable as error:
        print(error)
        return
    sys.exit(f"{deed} was not refused")
os.setgroups([])
os.setgid(int(sys.argv[2]))
os.setuid(int(sys.argv[2]))
refused(lambda: store.get(key_of(1)))
refused(lambda: put(store, 1))
refused(lambda: check_writable(store.folder / "x", "use MODETUNE_STORE"))
refused(lambda: store.lock(key_of(1), lambda: None).__enter__())
refused(lambda: key_of(2) in store)
"""


@needs_root
def test_a_store_without_permission_is_told_and_nothing_in_it_harmed(tmp_path: Path) -> None:
    store = Store(tmp_path / "store")
    put(store, 1)
    put(store, 2)
    before = store.path(key_of(1)).read_bytes()
    store.path(key_of(1)).chmod(0o600)
    folder = store.path(key_of(2)).parent
    told = without_rights(store, folder)
    assert told.returncode == 0, told.stdout + told.stderr
    assert "Traceback" not in told.stderr
    assert told.stdout.count("permission") >= 3
    assert store.path(key_of(1)).read_bytes() == before
    assert store.get(key_of(2)) is not None


def without_rights(store: Store, folder: Path) -> subprocess.CompletedProcess[str]:
    folder.chmod(0o700)
    parents = [*store.folder.parents][:3]
    modes = [parent.stat().st_mode for parent in parents]
    try:
        for parent in parents:
            parent.chmod(0o755)
        return subprocess.run(
            [sys.executable, "-c", WITHOUT_RIGHTS, str(store.folder), str(NOBODY)],
            cwd=Path(__file__).resolve().parents[3],
            capture_output=True,
            text=True,
            check=False,
        )
    finally:
        for parent, mode in zip(parents, modes, strict=True):
            parent.chmod(mode)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 256 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=256k", "none", str(folder)]
    if subprocess.run(command, capture_output=True, check=False).returncode != 0:
        pytest.skip("no disk can be mounted here")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def fill(store: Store) -> None:
    for number in range(1000):
        put(store, number)


@needs_root
def test_a_full_disk_loses_nothing_and_is_used_again_when_there_is_room(small_disk: Path) -> None:
    store = Store(small_disk)
    with pytest.raises(StorageUnavailable, match="full; nothing stored before was harmed"):
        fill(store)
    written = len(list(small_disk.glob("??/*.h5")))
    assert written > 5
    for number in range(written):
        entry = store.get(key_of(number))
        assert entry is not None
        assert is_right(entry, number)
    assert store.get(key_of(written)) is None
    assert not list(small_disk.glob("**/.*"))  # no half file takes up the room
    for number in range(3):
        store.path(key_of(number)).unlink()
    put(store, written)
    assert store.get(key_of(written)) is not None


@needs_root
def test_matrices_too_large_for_the_disk_are_told(small_disk: Path) -> None:
    from scipy import sparse

    noise = np.random.default_rng(1).uniform(size=40_000)  # does not pack
    large = sparse.csr_array(sparse.diags_array(noise, format="csr"))
    names = np.arange(40_000)
    store = Store(small_disk)
    with pytest.raises(StorageUnavailable, match="full"):
        store.put(Entry(key_of(1), MatrixResult(large, large, names, names), "x", "1", 1.0), "{}")
    put(store, 2)
    assert store.get(key_of(2)) is not None


HOLDER = """
import os, sys
from pathlib import Path
from modetune.core.storage.store import Store
from tests.core.storage.test_store_attack import key_of, put
store = Store(Path(sys.argv[1]))
with store.lock(key_of(1), lambda: sys.exit("held by another")):
    print("held", flush=True)
    while True:
        put(store, 1)
"""


def test_killed_holders_leave_the_lock_free_and_the_entry_whole(tmp_path: Path) -> None:
    store = Store(tmp_path)
    for _ in range(5):
        holder = subprocess.Popen(
            [sys.executable, "-c", HOLDER, str(tmp_path)],
            stdout=subprocess.PIPE,
            text=True,
            cwd=Path(__file__).resolve().parents[3],
        )
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        while store.get(key_of(1)) is None:
            assert holder.poll() is None
        holder.send_signal(signal.SIGKILL)
        holder.communicate()

        def busy() -> None:
            raise AssertionError("the lock of a dead process holds")

        with store.lock(key_of(1), busy):
            entry = store.get(key_of(1))
        assert entry is not None
        assert is_right(entry, 1)


def test_matrices_come_back_whole_from_memory(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.put(Entry(key_of(1), matrices(), "calculix", "2.20", 1.5), "{}", "a note")
    entry = store.get(key_of(1))
    assert entry is not None
    assert isinstance(entry.result, MatrixResult)
    np.testing.assert_array_equal(entry.result.mass.toarray(), np.eye(3))
