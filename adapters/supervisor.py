"""Run one program in its own process group and leave nothing of it behind.

Started by `process.py` as a script, standard library only: `supervisor.py LOG PROGRAM ARGUMENT...`.
Standard input is a pipe: when it closes, by intent or by the death of its holder, the whole group
is killed. The first line on standard output is the group's number (0 where nothing was started),
the second a JSON object that tells how the program ended. If this supervisor itself is killed, the
kernel kills the program (PR_SET_PDEATHSIG), and who started it knows the group.
"""

from __future__ import annotations

import ctypes
import json
import os
import resource
import select
import signal
import subprocess
import sys
from pathlib import Path

PR_SET_PDEATHSIG = 1


def _die_with(parent: int) -> None:
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it died before the kernel was told
        os._exit(1)


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def supervise(log: str, arguments: list[str]) -> dict[str, object]:
    """Run the program to its end or to the end of standard input; says how it ended."""
    wake_read, wake_write = os.pipe()
    os.set_blocking(wake_write, False)
    signal.set_wakeup_fd(wake_write)
    signal.signal(signal.SIGCHLD, lambda number, frame: None)
    parent = os.getpid()
    program = None
    try:
        output = Path(log).open("wb")
    except OSError as error:
        _say("0")
        return {"error": str(error)}
    try:
        with output:
            program = subprocess.Popen(
                arguments,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=lambda: _die_with(parent),
            )
    except FileNotFoundError:
        return {"error": "missing"}
    except OSError as error:
        return {"error": str(error)}
    finally:
        _say(str(program.pid if program else 0))
    while program.poll() is None:
        ready, _, _ = select.select([0, wake_read], [], [])
        if 0 in ready and not os.read(0, 4096):
            _kill_group(program.pid)
            program.wait()
        if wake_read in ready:
            os.read(wake_read, 4096)
    _kill_group(program.pid)  # helpers that the program left running
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        "error": "",
        "return_code": program.returncode,
        "cpu_s": usage.ru_utime + usage.ru_stime,
        "peak_memory_bytes": usage.ru_maxrss * 1024,
    }


def _kill_group(group: int) -> None:
    try:
        os.killpg(group, signal.SIGKILL)
    except ProcessLookupError:
        pass


if __name__ == "__main__":
    ending = json.dumps(supervise(sys.argv[1], sys.argv[2:]))
    _say(ending)
