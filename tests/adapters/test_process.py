"""The runner of programs, with small Python programs: what it tells, and that it leaves nothing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from modetune.adapters import process
from modetune.adapters.process import LOG, Finished, log_tail, read_log, run_process
from modetune.adapters.solver import Command
from modetune.adapters.supervisor import HEAD, TAIL
from modetune.core.errors import (
    NoResult,
    SolverCancelled,
    SolverCrashed,
    SolverExhausted,
    SolverMissing,
    SolverTimeout,
    StorageUnavailable,
)

#: Generous: only a fault makes a test wait this long.
DEADLINE_S = 30.0
LONG_S = 600

# A program that tells its own number and a child's, and then both sleep.
FAMILY = f"""
import os, pathlib, time
child = os.fork()
if child == 0:
    time.sleep({LONG_S})
part = pathlib.Path("pids.part")
part.write_text(f"{{os.getppid()}} {{os.getpid()}} {{child}}")
part.rename("pids")
time.sleep({LONG_S})
"""


def python(code: str, *arguments: str) -> Command:
    return Command((sys.executable, "-c", code, *arguments))


def run(command: Command, folder: Path) -> Finished:
    return run_process(command, folder, 60.0, threading.Event())


def wait_for(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline, f"{what} did not happen"
        time.sleep(0.01)


def family(folder: Path) -> tuple[int, int, int]:
    """Process numbers of the supervisor, the program and its child, once they run."""
    wait_for((folder / "pids").exists, "the program's start")
    supervisor, program, child = map(int, (folder / "pids").read_text().split())
    return supervisor, program, child


def gone(pid: int) -> bool:
    """Whether a process has ended; one that nobody has waited for yet has."""
    try:
        status = Path(f"/proc/{pid}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return True
    return status.rpartition(")")[2].split()[0] in "ZX"


def assert_gone(*pids: int) -> None:
    for pid in pids:
        wait_for(partial(gone, pid), f"the end of process {pid}")


def in_thread(folder: Path, cancelled: threading.Event) -> tuple[threading.Thread, list[Exception]]:
    """The sleeping family under run_process in a thread, and where its error will be."""
    raised: list[Exception] = []

    def body() -> None:
        try:
            run_process(python(FAMILY), folder, float(LONG_S), cancelled)
        except (SolverCancelled, SolverCrashed) as error:
            raised.append(error)

    thread = threading.Thread(target=body)
    thread.start()
    return thread, raised


def test_return_code_output_and_cost_are_told(tmp_path: Path) -> None:
    code = (
        "import sys; print('out'); sys.stdout.flush(); print('err', file=sys.stderr); sys.exit(3)"
    )
    finished = run(python(code), tmp_path)
    assert finished.return_code == 3
    assert (tmp_path / LOG).read_text() == "out\nerr\n"
    assert finished.wall_s > 0.0
    assert finished.cpu_s > 0.0
    assert finished.peak_memory_bytes > 1 << 20  # no Python fits into 1 MiB


def test_a_program_runs_in_its_folder_with_nothing_to_read_and_our_variables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("INHERITED", "kept")
    code = (
        "import os, sys; print(os.getcwd(), repr(sys.stdin.read()), os.environ['INHERITED'], "
        "os.environ['OMP_NUM_THREADS'])"
    )
    command = Command(python(code).arguments, (("OMP_NUM_THREADS", "2"),))
    assert run(command, tmp_path).return_code == 0
    assert (tmp_path / LOG).read_text() == f"{tmp_path.resolve()} '' kept 2\n"


def test_arguments_reach_the_program_as_they_are(tmp_path: Path) -> None:
    words = ["two words", ";", "$HOME", "`ls`", "*", "a'b\"c", "", "> x", "&&", "ü"]
    run(python("import sys; print(ascii(sys.argv[1:]))", *words), tmp_path)
    assert (tmp_path / LOG).read_text() == ascii(words) + "\n"
    assert [path.name for path in tmp_path.iterdir()] == [LOG]  # no shell has written `x`


def test_a_missing_program_is_named(tmp_path: Path) -> None:
    with pytest.raises(SolverMissing, match=r"`no-such-solver -i job`.*no such program"):
        run(Command(("no-such-solver", "-i", "job")), tmp_path)


def test_a_program_that_may_not_be_run_is_no_missing_one(tmp_path: Path) -> None:
    program = tmp_path / "program"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o644)
    with pytest.raises(SolverCrashed, match=r"could not be started: .*Permission denied"):
        run(Command((str(program),)), tmp_path)


def test_a_timeout_kills_the_program_and_its_child(tmp_path: Path) -> None:
    class OnceItRuns(threading.Event):
        """Asked before the clock is looked at."""

        def is_set(self) -> bool:
            family(tmp_path)
            return False

    code = FAMILY.replace("import os", "print('so far', flush=True); import os", 1)
    with pytest.raises(SolverTimeout, match=r"longer than 0\.01 s and was killed.*\n  \| so far"):
        run_process(python(code), tmp_path, 0.01, OnceItRuns())
    assert_gone(*family(tmp_path))


def test_cancelling_kills_the_program_and_its_child(tmp_path: Path) -> None:
    cancelled = threading.Event()
    thread, raised = in_thread(tmp_path, cancelled)
    pids = family(tmp_path)
    cancelled.set()
    thread.join(DEADLINE_S)
    assert [type(error) for error in raised] == [SolverCancelled]
    assert_gone(*pids)


def test_a_cancelled_campaign_starts_nothing_that_lasts(tmp_path: Path) -> None:
    cancelled = threading.Event()
    cancelled.set()
    with pytest.raises(SolverCancelled):
        run_process(python(f"import time; time.sleep({LONG_S})"), tmp_path, 60.0, cancelled)


def test_a_program_killed_by_a_signal_crashed(tmp_path: Path) -> None:
    code = "import os; print('before', flush=True); os.kill(os.getpid(), 11)"
    with pytest.raises(SolverCrashed, match=r"killed by signal 11\n  \| before"):
        run(python(code), tmp_path)


def test_a_child_left_behind_by_a_finished_program_is_killed(tmp_path: Path) -> None:
    code = FAMILY.rstrip().removesuffix(f"time.sleep({LONG_S})")
    assert run(python(code), tmp_path).return_code == 0
    assert_gone(*family(tmp_path))


def test_killing_the_caller_kills_the_program_and_its_child(tmp_path: Path) -> None:
    caller = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "import pathlib, sys, threading\n"
            "from modetune.adapters.process import run_process\n"
            "from modetune.adapters.solver import Command\n"
            "run_process(Command((sys.executable, '-c', sys.argv[1])), pathlib.Path(sys.argv[2]),"
            " 600.0, threading.Event())",
            FAMILY,
            str(tmp_path),
        ]
    )
    try:
        pids = family(tmp_path)
        assert not any(map(gone, pids))
    finally:
        caller.kill()
        caller.wait()
    assert_gone(*pids)


def test_killing_the_supervisor_kills_the_program_and_its_child(tmp_path: Path) -> None:
    thread, raised = in_thread(tmp_path, threading.Event())
    pids = family(tmp_path)
    os.kill(pids[0], signal.SIGKILL)
    thread.join(DEADLINE_S)
    assert [type(error) for error in raised] == [SolverCrashed]
    assert "its supervisor was killed" in str(raised[0])
    assert_gone(*pids)


def test_an_interrupt_of_the_caller_kills_the_program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Interrupting(threading.Event):
        def is_set(self) -> bool:
            family(tmp_path)  # once it runs
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_process(python(FAMILY), tmp_path, float(LONG_S), Interrupting())
    assert_gone(*family(tmp_path))


@pytest.mark.parametrize("program", [sys.executable, "no-permission"])
def test_a_failure_on_a_full_disk_is_the_disks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: str
) -> None:
    monkeypatch.setattr(process, "FULL_DISK", 1 << 80)  # more than any disk has free
    (tmp_path / "no-permission").write_text("")
    path = program if program == sys.executable else str(tmp_path / program)
    with pytest.raises(StorageUnavailable, match="the disk is full; free some space"):
        run(Command((path, "-c", "raise SystemExit(1)")), tmp_path)
    assert run(python("pass"), tmp_path).return_code == 0


def test_many_programs_at_once_keep_to_themselves(tmp_path: Path) -> None:
    codes: dict[int, int] = {}

    def body(number: int) -> None:
        folder = tmp_path / str(number)
        folder.mkdir()
        code = "import sys; print(sys.argv[1]); sys.exit(int(sys.argv[1]))"
        codes[number] = run(python(code, str(number)), folder).return_code

    threads = [threading.Thread(target=body, args=(number,)) for number in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(DEADLINE_S)
    assert codes == {number: number for number in range(6)}
    assert [(tmp_path / str(n) / LOG).read_text() for n in range(6)] == [f"{n}\n" for n in range(6)]


def test_the_tail_of_a_log_is_its_last_lines(tmp_path: Path) -> None:
    assert log_tail(tmp_path) == "(no log)"
    (tmp_path / LOG).write_text("\n \n")
    assert log_tail(tmp_path) == "(the log is empty)"
    (tmp_path / LOG).write_bytes(b"\xff\n" + b"".join(b"line %d\n\n" % n for n in range(5000)))
    assert log_tail(tmp_path, lines=2) == "  | line 4998\n  | line 4999"


# A program whose child takes its own session, has a child of its own there, and ends before it.
ESCAPED = f"""
import os, pathlib, sys, time
if os.fork() == 0:
    os.setsid()
    child = os.fork()
    if child == 0:
        time.sleep({LONG_S})
    part = pathlib.Path("pids.part")
    part.write_text(f"{{os.getpid()}} {{child}} {{os.getsid(0)}}")
    part.rename("pids")
    if len(sys.argv) > 1:
        os._exit(0)
    time.sleep({LONG_S})
while not os.path.exists("pids"):
    time.sleep(0.01)
"""


@pytest.mark.parametrize("words", [(), ("orphaned",)])
def test_a_child_in_a_session_of_its_own_ends_with_its_program(
    tmp_path: Path, words: tuple[str, ...]
) -> None:
    assert run(python(ESCAPED, *words), tmp_path).return_code == 0
    child, grandchild, session = map(int, (tmp_path / "pids").read_text().split())
    assert session == child
    assert gone(child)  # by the time that the run has ended
    assert gone(grandchild)


@pytest.mark.parametrize(("mode", "expected"), [(0o2770, 0o770), (0o755, 0o700)])
def test_a_folders_group_may_remove_what_a_program_leaves(
    tmp_path: Path, mode: int, expected: int
) -> None:
    tmp_path.chmod(mode)
    before = os.umask(0o077)
    try:
        process._supervisors.end()  # the next one begins with this umask
        assert run(python("import os; os.mkdir('scratch')"), tmp_path).return_code == 0
    finally:
        os.umask(before)
        process._supervisors.end()
    assert (tmp_path / "scratch").stat().st_mode & 0o777 == expected


def test_cancelling_ends_a_child_in_a_session_of_its_own(tmp_path: Path) -> None:
    class OnceItRuns(threading.Event):
        def is_set(self) -> bool:
            wait_for((tmp_path / "pids").exists, "the child's start")
            return True

    with pytest.raises(SolverCancelled):
        run_process(
            python(ESCAPED + f"time.sleep({LONG_S})"), tmp_path, float(LONG_S), OnceItRuns()
        )
    assert all(gone(int(pid)) for pid in (tmp_path / "pids").read_text().split()[:2])


def test_of_much_output_the_log_has_head_and_tail(tmp_path: Path) -> None:
    code = (
        "import sys\nline = b'x' * 1023 + b'\\n'\nsys.stdout.buffer.write(b'first\\n')\n"
        "for _ in range(40 << 10): sys.stdout.buffer.write(line)\n"
        "sys.stdout.buffer.write(b'last\\n')"
    )
    assert run(python(code), tmp_path).return_code == 0
    log = (tmp_path / LOG).read_bytes()
    size = len(b"first\n") + (40 << 20) + len(b"last\n")
    left_out = size - HEAD - TAIL
    assert log.startswith(b"first\nxxx")
    assert log.endswith(b"xxx\nlast\n")
    assert b"\n[%d bytes of output left out]\n" % left_out in log
    assert len(log) == HEAD + TAIL + len(f"\n[{left_out} bytes of output left out]\n")


def test_output_up_to_head_and_tail_is_whole(tmp_path: Path) -> None:
    code = f"import os, sys; sys.stdout.buffer.write(b'ab' * {(HEAD + TAIL) // 2})"
    run(python(code), tmp_path)
    assert (tmp_path / LOG).read_bytes() == b"ab" * ((HEAD + TAIL) // 2)


@pytest.mark.parametrize("code", [
    "import sys\nwhile True: sys.stdout.write('x' * 65536)",
    "import os\nos.mkdir('scratch')\nwith open('scratch/big', 'wb') as out:\n"
    " for _ in range(64): out.write(b'x' * (1 << 20))\n"
    " out.flush()\n import time; time.sleep(600)",
])  # fmt: skip
def test_a_job_that_takes_too_much_disk_is_killed_and_what_it_took_freed(
    tmp_path: Path, code: str
) -> None:
    with pytest.raises(SolverExhausted, match=r"more than the 0\.03 GB .*raise `run: disk_gb`"):
        run_process(python(code), tmp_path, 60.0, threading.Event(), 30_000_000)
    assert sum(path.stat().st_size for path in tmp_path.rglob("*")) < 20 << 20
    assert (tmp_path / LOG).is_file()


def test_a_folder_or_log_that_is_removed_meanwhile_is_told(tmp_path: Path) -> None:
    folder = tmp_path / "job"
    folder.mkdir()
    code = "import os, shutil; shutil.rmtree(os.getcwd()); raise SystemExit(1)"
    assert run(python(code), folder).return_code == 1
    assert log_tail(folder) == "(no log)"
    with pytest.raises(NoResult, match="something else has changed the job's folder"):
        read_log(folder)
    os.mkfifo(tmp_path / LOG)
    with pytest.raises(NoResult, match="it is a pipe or a device"):
        read_log(tmp_path)


MAKER = """
import os, threading
from pathlib import Path
from modetune.adapters.process import run_process
from modetune.adapters.solver import Command

run_process(Command(("true",)), Path("."), 60.0, threading.Event())
below = Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
print(*below, flush=True)
"""


def test_what_forks_supervisors_ends_with_the_process_that_uses_it(tmp_path: Path) -> None:
    told = subprocess.run(
        [sys.executable, "-W", "error", "-c", MAKER],
        cwd=tmp_path, capture_output=True, text=True, timeout=60.0,
    )  # fmt: skip
    assert (told.returncode, told.stderr) == (0, "")
    (maker,) = map(int, told.stdout.split())
    assert_gone(maker)


def test_it_is_started_again_where_it_was_killed(tmp_path: Path) -> None:
    for _ in range(2):
        assert run_process(python("pass"), tmp_path, 60.0, threading.Event()).return_code == 0
        children = Path(f"/proc/self/task/{threading.main_thread().native_id}/children").read_text()
        makers = [
            pid
            for pid in map(int, children.split())
            if Path(f"/proc/{pid}/cmdline").read_bytes().endswith(b"supervisor.py\0")
        ]
        assert len(makers) == 1
        os.kill(makers[0], signal.SIGKILL)
        os.waitid(os.P_PID, makers[0], os.WEXITED | os.WNOWAIT)
