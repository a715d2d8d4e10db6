"""Files that earlier versions wrote are read, upgraded and read again."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy

from modetune.core.monitoring.past_runs import PAST_RUN, read_history
from modetune.core.storage import upgrade
from modetune.core.storage.campaign_record import CAMPAIGN, CampaignRecord, read_record
from modetune.core.storage.locks import FileLock
from modetune.core.storage.sealed_file import holds
from modetune.core.storage.store import FORMAT, Store
from modetune.core.updating.job_results import ModalResult
from tests.command_line import run_command

HERE = Path(__file__).parent
RECORDS = {"format_8": 8, "format_9": 9, "format_10": 10, "format_11": 11, "format_12": 12}
#: A record of a golden store, and an entry of `store_3`.
RECORD = Path("runs") / "two-mass" / "campaign.h5"
FIRST = "4133dfdca44539a073167c4085705085ddbeada1adf8072d806b9f1b78a12c24"


def unpacked(name: str, folder: Path) -> Path:
    with zipfile.ZipFile(HERE / f"{name}.zip") as archive:
        archive.extractall(folder)
    return folder / name


def format_of(path: Path) -> int:
    return int(path.read_bytes()[:100].partition(b"\n")[0].split()[-1])


def upgraded(place: Path, *options: str) -> tuple[int, dict[str, Any]]:
    """The exit code and the object of `modetune upgrade`."""
    said = run_command(place, "upgrade", "--json", *options)
    return said.returncode, json.loads(said.stdout)


def same(one: CampaignRecord, other: CampaignRecord) -> bool:
    return CAMPAIGN.sealed(one) == CAMPAIGN.sealed(other)


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", RECORDS)
def test_a_golden_store_is_read_upgraded_and_read_again(name: str, tmp_path: Path) -> None:
    place = unpacked(name, tmp_path)
    record = read_record(place / RECORD)
    assert (format_of(place / RECORD), record.status) == (RECORDS[name], "converged")
    # k1 is 2000 N/m in the test and 2400 N/m in the deck. Table 4.2's steps end within 1e-3.
    np.testing.assert_allclose(record.updated, [2000.0 / 2400.0], rtol=1e-3)
    assert run_command(place, "report", str(RECORD.parent)).returncode == 0
    history = read_history(place / RECORD.parent)
    newest = (CAMPAIGN.format, PAST_RUN.format, FORMAT)
    old = [path for path in place.rglob("*.h5") if format_of(path) not in newest]
    code, found = upgraded(place)
    assert (code, len(found["upgraded"]), found["left"]) == (0, len(old), [])
    assert format_of(place / RECORD) == CAMPAIGN.format
    assert same(read_record(place / RECORD), record)
    assert repr(read_history(place / RECORD.parent)) == repr(history)
    assert upgraded(place)[1]["upgraded"] == []


@pytest.mark.parametrize("name", ["format_9", "format_10", "format_11", "format_12"])
def test_the_store_has_all_jobs_of_an_update_of_before(name: str, tmp_path: Path) -> None:
    place = unpacked(name, tmp_path)
    if read_record(place / RECORD).solver_version != scipy.__version__:
        pytest.skip("keys have the version of SciPy, which solves models of matrices")
    environment = {"MODETUNE_STORE": str(place / "store"), "MODETUNE_NO_PREFECT": "1"}
    said = run_command(place, "update", "campaign.yaml", "--json", **environment)
    done = json.loads(said.stdout)
    # Runs of an update without any are those of the record before.
    assert (said.returncode, done["status"]) == (0, "converged"), said.stderr
    entries = list((place / "store").glob("[0-9a-f][0-9a-f]/*.h5"))
    kinds = [
        getattr(Store(place / "store").holding(path.name[:64]), "kind", "") for path in entries
    ]
    assert len(entries) == 7
    assert kinds.count("search_ends") == 1  # which versions before did not keep
    assert len(read_history(place / RECORD.parent).runs) == 1


def test_results_of_the_format_before_are_those_of_this_one(tmp_path: Path) -> None:
    """`format_8` has results with keys of `store_3`, computed by a later commit."""
    old = Store(unpacked("store_3", tmp_path) / "store")
    new = Store(unpacked("format_8", tmp_path) / "store")
    keys = {path.name[:64] for path in new.entries()} & {
        path.name[:64] for path in old.folder.glob("??/*.3.h5")
    }
    assert len(keys) == 5
    for key in keys:
        assert key in old
        ours, theirs = old.get(key), new.get(key)
        assert ours is not None
        assert theirs is not None
        if isinstance(ours.result, ModalResult):
            assert isinstance(theirs.result, ModalResult)
            assert ours.result.n_rigid == theirs.result.n_rigid == 0
            np.testing.assert_array_equal(ours.result.eigenvalues, theirs.result.eigenvalues)
    code, found = upgraded(old.folder.parent)
    assert (code, len(found["upgraded"])) == (2, 5)  # its record is of format 4
    for key in keys:
        ours, theirs = old.get(key), new.get(key)
        assert ours is not None
        assert theirs is not None
        assert (repr(ours.result), ours.solver) == (repr(theirs.result), theirs.solver)
    assert list(old.folder.rglob("*.3.h5")) == list((old.folder / "locks").iterdir()) == []


def test_what_cannot_be_upgraded_stays_as_it_is(tmp_path: Path) -> None:
    place = unpacked("store_3", tmp_path)
    entry = Store(place / "store").path(FIRST, 3)
    later = place / "runs" / "later.h5"
    later.write_bytes(b"modetune campaign record 99\n")
    named = entry.with_name("other.h5")
    named.write_bytes(entry.read_bytes())
    formats = {number: Store(place / "store").path(FIRST, number) for number in (2, 9)}
    for number, path in formats.items():
        path.write_bytes(f"modetune store entry {number}\n".encode())
    entry.write_bytes(entry.read_bytes()[:-1])
    unknown = place / "unknown.h5"
    unknown.write_bytes(b"modetune weather record 1\n")
    (place / "foreign.h5").write_bytes(b"\x89HDF\r\n")
    before = contents(place)
    code, found = upgraded(place)
    assert code == 2
    reasons = {Path(str(item["path"])): str(item["reason"]) for item in found["left"]}
    assert {place / path for path in reasons} == {
        place / RECORD, entry, later, named, unknown, *formats.values(),
    }  # fmt: skip
    for path, said in (
        (RECORD, r"record 4, .* reads format 7 to \d+; use the earlier version that wrote it"),
        (later.relative_to(place), "use the later version that wrote it"),
        (entry.relative_to(place), "checksum"),
        (named.relative_to(place), "under another name"),
        (unknown.relative_to(place), "does not know"),
        (formats[2].relative_to(place), "of format 3 and 4; what is needed is computed again"),
        (formats[9].relative_to(place), "of format 3 and 4; use the later version"),
    ):
        assert re.search(said, reasons[path])
    after = contents(place)
    assert all(after[path] == before[path] for path in (place / RECORD, entry, later, named))


def test_a_dry_run_writes_nothing(tmp_path: Path) -> None:
    place = unpacked("format_10", tmp_path)
    before = contents(place)
    code, found = upgraded(place, "--dry-run")
    assert (code, len(found["upgraded"])) == (0, 1)
    assert contents(place) == before


def test_a_campaign_names_its_record_and_its_store(tmp_path: Path) -> None:
    place = unpacked("store_3", tmp_path)
    said = run_command(
        place, "upgrade", "campaign.yaml", "--json", MODETUNE_STORE=str(place / "store")
    )
    found = json.loads(said.stdout)
    assert (len(found["upgraded"]), len(found["left"])) == (5, 1)
    said = run_command(place, "upgrade", "nowhere")
    assert (said.returncode, "nowhere is not there" in said.stderr) == (2, True)


def test_a_record_of_a_run_in_progress_waits(tmp_path: Path) -> None:
    place = unpacked("format_10", tmp_path)
    with FileLock((place / RECORD).parent / upgrade.RUN_LOCK) as lock:
        assert lock.take()
        code, found = upgraded(place)
        assert (code, format_of(place / RECORD)) == (2, 10)
        assert "a run is in progress" in str(found["left"][0]["reason"])
    assert upgraded(place)[0] == 0
    assert sorted(path.name for path in (place / RECORD).parent.iterdir()) == [
        ".lock", "campaign.h5", "updated",
    ]  # fmt: skip


def test_a_record_that_was_written_meanwhile_is_not_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An update ends between reading and replacing."""
    place = unpacked("format_10", tmp_path)
    other = unpacked("format_11", tmp_path)
    upgraded(other)
    newer = (other / RECORD).read_bytes()

    def update(data: bytes, title: str) -> bool:
        part = place / "part"
        part.write_bytes(newer)
        part.replace(place / RECORD)
        return holds(data, title)

    monkeypatch.setattr(upgrade, "holds", update)
    code, found = upgraded(place, "runs")
    assert (code, found["upgraded"], found["left"]) == (0, [], [])
    assert (place / RECORD).read_bytes() == newer


@pytest.mark.skipif(os.getuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written_is_a_sentence(tmp_path: Path) -> None:
    place = unpacked("format_10", tmp_path)
    (place / RECORD).parent.chmod(0o500)
    code, found = upgraded(place)
    assert (code, "cannot be written" in str(found["left"][0]["reason"])) == (2, True)
    assert format_of(place / RECORD) == 10


#: Upgrades a folder, and is killed where the n-th file is about to be renamed.
KILLED = f"""
import os, signal, sys
from pathlib import Path
left, replace = int(sys.argv[1]), Path.replace
def killed(self, target):
    global left
    left -= 1
    if left < 0:
        os.kill(os.getpid(), {signal.SIGKILL:d})
    return replace(self, target)
Path.replace = killed
sys.argv = ["modetune", "upgrade", "."]
from modetune.flows.cli.main import main
main()
"""


def test_a_kill_loses_nothing_and_a_second_call_continues(tmp_path: Path) -> None:
    place = unpacked("store_3", tmp_path)
    store = Store(place / "store")
    keys = [path.name[:64] for path in store.folder.glob("??/*.3.h5")]
    results = {key: repr(store.get(key)) for key in keys}
    killed = subprocess.run([sys.executable, "-c", KILLED, "2"], cwd=place, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert {key: repr(store.get(key)) for key in keys} == results
    code, found = upgraded(place)
    assert (code, len(found["upgraded"]), found["newest"]) == (2, 3, 2)
    assert {key: repr(store.get(key)) for key in keys} == results
