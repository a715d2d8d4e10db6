"""The cost of a command: wall time, processor time, memory of its process tree, runs of the solver.

Memory is the largest sum of resident sizes over the command and all its descendants, sampled 20
times a second from /proc; shared pages count in each process. Runs are counted by a shell script in
place of the solver, which records the type and duration of each job.
"""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from modetune.adapters.calculix.solver import PROGRAM_VARIABLE
from modetune.adapters.nastran.dialect import MYSTRAN

#: Solvers: the variable that names the program, and its usual name.
PROGRAMS = {"calculix": (PROGRAM_VARIABLE, "ccx"), "mystran": (MYSTRAN.variable, MYSTRAN.program)}
PERIOD_S = 0.05
PAGE = os.sysconf("SC_PAGE_SIZE")

#: Asking for the version is not a run. What a job is for is in its deck's first or last lines.
COUNTER = """\
#!/bin/sh
case "$1" in
-i) deck=$2.inp ;;
*) deck=$1 ;;
esac
if [ -f "$deck" ]; then
    kind=modal
    if {{ head -n 100 "$deck"; tail -n 200 "$deck"; }} | grep -qi -e MATRIXSTORAGE -e CHKPNT; then
        kind=matrices
    fi
    echo $kind >> {log}
    begun=$(date +%s.%N)
    {program} "$@"
    code=$?
    echo seconds $begun $(date +%s.%N) >> {log}
    exit $code
fi
exec {program} "$@"
"""


@dataclass(frozen=True, slots=True)
class Cost:
    """wall_s: from start to end. cpu_s: of the command and all it waited for. peak_bytes: of the
    tree. modal_runs, matrix_runs: of CalculiX; solver_s: wall time of those that ended, in all."""

    wall_s: float
    cpu_s: float
    peak_bytes: int
    modal_runs: int
    matrix_runs: int
    solver_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Ended:
    """return_code, output and errors of a command, and what it cost."""

    return_code: int
    output: str
    errors: str
    cost: Cost


def run_counted(
    command: Sequence[str], folder: Path, environment: Mapping[str, str], solver: str = "calculix"
) -> Ended:
    """Run a command in a folder with a counting solver.

    environment: all of the command's; the variable that names the solver is added.
    """
    log, counter = folder / "runs.txt", counting(folder, solver)
    with (folder / "output.txt").open("wb") as output, (folder / "errors.txt").open("wb") as errors:
        started = time.monotonic()
        process = subprocess.Popen(
            command,
            cwd=folder,
            env={**environment, PROGRAMS[solver][0]: str(counter)},
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=errors,
            start_new_session=True,  # Dakota ends with its group
        )
        with watched(process.pid) as peak:
            try:
                _, status, usage = os.wait4(process.pid, 0)
            except BaseException:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
                raise
        wall_s = time.monotonic() - started
    process.returncode = os.waitstatus_to_exitcode(status)
    lines = [line.split() for line in log.read_text().splitlines()]
    kinds = [line[0] for line in lines]
    cost = Cost(
        wall_s,
        usage.ru_utime + usage.ru_stime,
        peak[0],
        kinds.count("modal"),
        kinds.count("matrices"),
        sum(
            float(end) - float(begin)
            for _, begin, end in (line for line in lines if len(line) == 3)
        ),
    )
    output_text, errors_text = (
        (folder / name).read_text(errors="replace") for name in ("output.txt", "errors.txt")
    )
    return Ended(process.returncode, output_text, errors_text, cost)


def counting(folder: Path, solver: str) -> Path:
    """Write a script in place of a solver, with an empty list of its runs; return its path.

    Raises SystemExit where the solver is not installed.
    """
    log, counter = folder / "runs.txt", folder / f"counted-{solver}"
    variable, usual = PROGRAMS[solver]
    program = found(os.environ.get(variable, usual))
    log.write_text("")
    counter.write_text(COUNTER.format(log=shlex.quote(str(log)), program=shlex.quote(program)))
    counter.chmod(0o755)
    return counter


def calculix() -> str:
    """Full path of CalculiX, as modetune would start it. Raises SystemExit where it is missing."""
    return found(os.environ.get(PROGRAM_VARIABLE, "ccx"))


def found(program: str) -> str:
    """Full path of a program. Raises SystemExit where there is none."""
    path = shutil.which(program)
    if path is None:
        sys.exit(f"`{program}` is not installed; `modetune doctor` says how to get solvers")
    return path


def tree_bytes(root: int) -> int:
    """Sum of the resident sizes of a process and all its descendants."""
    total, left = 0, [root]
    while left:
        place = Path(f"/proc/{left.pop()}")
        try:
            total += int((place / "statm").read_text().split()[1]) * PAGE
            for task in (place / "task").iterdir():
                left += map(int, (task / "children").read_text().split())
        except (OSError, IndexError):
            continue  # it ended while its files were read
    return total


@contextmanager
def watched(root: int) -> Iterator[list[int]]:
    """Yield a list whose only entry is the largest `tree_bytes` so far."""
    ended, peak = threading.Event(), [0]

    def watch() -> None:
        while not ended.wait(PERIOD_S):
            peak[0] = max(peak[0], tree_bytes(root))

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        yield peak
    finally:
        ended.set()
        watcher.join()
