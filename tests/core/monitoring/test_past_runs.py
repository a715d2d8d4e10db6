"""The history of a structure: small files that are written once, read whole or left out."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from modetune.core.errors import CampaignError
from modetune.core.monitoring.past_runs import (
    FOLDER,
    PAST_RUN,
    History,
    PastRun,
    add_past_run,
    read_history,
)
from modetune.core.updating.verdict import TrustVerdict

#: 2026-11-27T21:05:11Z, and a day.
EVENING, DAY_S = 1795813511.0, 86400.0


def past(number: int, stiffness: float = 1.0, **changed: object) -> PastRun:
    """A run of a structure with one spring and one mode, a night after the one before."""
    run = PastRun(
        number=number,
        name="bridge",
        ended_at=EVENING + DAY_S * number,
        measured_at=float("nan"),
        evidence=f"{number:064x}"[::-1],
        test_digest=f"test {number}",
        status="converged",
        reason="e1 is met",
        verdict=TrustVerdict.TRUSTED,
        state="steady",
        drift="Steady",
        changed=(),
        names=("k",),
        quantities=("spring_stiffness",),
        units="m-kg-s",
        values=np.array([200.0 * stiffness]),
        deck_values=np.array([200.0]),
        standard_errors=np.array([4.0]),
        repeatability=np.array([2.0]),
        covariance=np.array([[4.0]]),
        modes=("1",),
        test_hz=np.array([3.0]),
        damping_ratios=np.array([np.nan]),
        updated_hz=np.array([3.01]),
        macs=np.array([0.99]),
        elastic_modes=np.array([1]),
        environment={"temperature_C": 20.0 + number},
        deck_digest="d" * 64,
        modal_key="m" * 64,
        settings=(),
        solver="matrices",
        solver_version="1",
        modetune_version="1",
        versions=("Python 3",),
    )
    return replace(run, **changed)  # type: ignore[arg-type]


def test_a_run_is_read_as_it_was_written_and_its_name_has_its_time(tmp_path: Path) -> None:
    file = add_past_run(tmp_path, past(0))
    assert file == tmp_path / FOLDER / f"2026-11-27T21-05-11Z-{'0' * 8}.h5"
    history = read_history(tmp_path)
    assert history.problems == ()
    (found,) = history.runs
    assert found.at == "2026-11-27T21:05:11Z"
    assert (found.environment, found.verdict) == ({"temperature_C": 20.0}, TrustVerdict.TRUSTED)
    assert found.covariance.tolist() == [[4.0]]
    assert found.pairs == {"1": 1}


def test_a_file_is_never_rewritten(tmp_path: Path) -> None:
    file = add_past_run(tmp_path, past(1))
    before = file.read_bytes(), file.stat().st_ino
    assert add_past_run(tmp_path, past(1, 0.5)) == file
    assert (file.read_bytes(), file.stat().st_ino) == before


def test_a_folder_without_runs_has_an_empty_history(tmp_path: Path) -> None:
    assert read_history(tmp_path / "nowhere") == History()
    (tmp_path / FOLDER).write_text("a file in the way")
    history = read_history(tmp_path)
    assert (history.runs, len(history.problems)) == ((), 1)
    assert history.problems[0].endswith("history cannot be read: Not a directory")


def _cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def _one_bit(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)


def _later_format(file: Path) -> None:
    title = f"{PAST_RUN.title}{PAST_RUN.format}".encode()
    file.write_bytes(file.read_bytes().replace(title, b"modetune history record 99"))


def _foreign_hdf5(file: Path) -> None:
    file.unlink()
    with h5py.File(file, "w") as made:
        made["x"] = 1.0


def _folder(file: Path) -> None:
    file.unlink()
    file.mkdir()


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (_cut, "checksum"),
        (_one_bit, "checksum"),
        (lambda file: file.write_bytes(b""), "is not a record of a history"),
        (lambda file: file.write_text("notes of the lab\n"), "is not a record of a history"),
        (_later_format, "is a history record 99, and this version of modetune reads format 1"),
        (_foreign_hdf5, "HDF5 without a seal"),
        (_folder, "is not there"),
    ],
)
def test_what_cannot_be_read_is_left_out_with_a_sentence(
    tmp_path: Path, spoil: Callable[[Path], object], said: str
) -> None:
    files = [add_past_run(tmp_path, past(number)) for number in (1, 2, 3)]
    spoil(files[1])
    history = read_history(tmp_path)
    assert [run.number for run in history.runs] == [1, 3]
    (problem,) = history.problems
    assert said in problem
    assert files[1].name in problem


def test_numbers_order_runs_where_the_clock_goes_back(tmp_path: Path) -> None:
    for run in (past(1), past(2, ended_at=EVENING - 400 * DAY_S), past(3)):
        add_past_run(tmp_path, run)
    history = read_history(tmp_path)
    assert [run.number for run in history.runs] == [1, 2, 3]
    assert (np.diff(history.series().times) >= 0.0).all()


def test_a_test_counts_once_and_the_last_run_of_it(tmp_path: Path) -> None:
    same = {"test_digest": "test 1"}
    history = History((past(1), past(2, 0.9), past(3, 1.1, **same)))
    assert [run.number for run in history.nights()] == [2, 3]
    assert history.series().values[:, 0] == pytest.approx([0.9, 1.1])


def test_runs_with_other_parameters_do_not_belong_to_the_series() -> None:
    history = History((past(1, names=("E",)), past(2), past(3)))
    assert [run.number for run in history.nights()] == [2, 3]
    with pytest.raises(CampaignError, match="no run"):
        History().series()


def test_values_are_relative_to_the_newest_deck() -> None:
    """A deck that took over updated values makes no step: 180 N/m are 180 N/m."""
    newer = {"deck_values": np.array([180.0])}
    series = History((past(1, 0.9), past(2, 0.9, **newer))).series()
    assert series.values[:, 0] == pytest.approx([1.0, 1.0])
    assert series.covariances[:, 0, 0] == pytest.approx([4.0 / 180.0**2] * 2)


def test_an_unknown_quantity_of_the_environment_is_a_gap() -> None:
    series = History((past(1, environment={}), past(2, environment={"wind": 3.0}))).series()
    assert series.quantities == ("wind",)
    np.testing.assert_array_equal(series.environment, [[np.nan], [3.0]])


WRITER = """
import sys
from dataclasses import replace
from pathlib import Path
from modetune.core.monitoring.past_runs import PAST_RUN, add_past_run, read_history
(run,) = read_history(Path(sys.argv[1])).runs
print("ready", flush=True)
for number in range(int(sys.argv[3]), int(sys.argv[3]) + 100_000):
    key = f"{number:064x}"[::-1]
    new = replace(run, number=number, evidence=key, test_digest=key)
    add_past_run(Path(sys.argv[2]), new)
    print(number, flush=True)
"""


def test_two_writers_at_once_and_a_kill_lose_nothing(tmp_path: Path) -> None:
    """Each line of a writer is a file that was complete when it was killed."""
    add_past_run(tmp_path / "seed", past(1))
    words = [sys.executable, "-c", WRITER, str(tmp_path / "seed"), str(tmp_path)]
    writers = [
        subprocess.Popen([*words, first], stdout=subprocess.PIPE, text=True)
        for first in ("1000000", "2000000")
    ]
    said: list[set[int]] = []
    for writer in writers:
        assert writer.stdout is not None
        assert writer.stdout.readline() == "ready\n"
    for writer in writers:
        assert writer.stdout is not None
        lines = [writer.stdout.readline() for _ in range(20)]
        writer.send_signal(signal.SIGKILL)
        rest, _ = writer.communicate()
        # The last line may be cut where the kill met it.
        said.append({int(line) for line in (*lines, *rest.splitlines(keepends=True)[:-1])})
    history = read_history(tmp_path)
    assert history.problems == ()
    assert said[0] | said[1] <= {run.number for run in history.runs}
    assert min(len(numbers) for numbers in said) >= 20
