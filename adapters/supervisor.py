"""Run one program in its own process group and leave nothing of it behind.

Started by `process.py` as a script, standard library only: `supervisor.py LOG PROGRAM ARGUMENT...`.
Standard input is a pipe: when it closes, by intent or by the death of its holder, the whole group
is killed. The first line on standard output is the group's number (0 where nothing was started),
the second a JSON object that tells how the program ended. If this supervisor itself is killed, the
kernel kills the program (PR_SET_PDEATHSIG), and who started it knows the group.

Every job waits for this script to start, so it takes only modules that are there at once: with
`subprocess`, `signal`, `pathlib` and `json` it started in 28 ms, without them in 12.
"""

from __future__ import annotations

import _thread
import ctypes
import os
import sys

PR_SET_PDEATHSIG = 1
SIGKILL = 9
ENOENT, EINVAL = 2, 22
#: Python ignores these (SIGPIPE, SIGXFSZ); a program starts with the system's own handling.
IGNORED_BY_PYTHON = (13, 25)


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def _start(log: str, arguments: list[str]) -> tuple[int, int]:
    """The program's process number, and the error number that kept it from starting, or 0."""
    output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
    libc, parent = ctypes.CDLL(None), os.getpid()
    told, tell = os.pipe()  # closes when the program starts
    program = os.fork()
    if program == 0:
        failure = 0
        try:
            os.setsid()
            libc.prctl(PR_SET_PDEATHSIG, SIGKILL)
            if os.getppid() != parent:  # it died before the kernel was told
                os._exit(1)
            for number in IGNORED_BY_PYTHON:
                libc.signal(number, None)
            nothing = os.open(os.devnull, os.O_RDONLY)
            for source, target in ((nothing, 0), (output, 1), (output, 2)):
                os.dup2(source, target)
            os.execvp(arguments[0], arguments)
        except OSError as error:
            failure = error.errno or 0
        except ValueError:  # a zero byte in an argument
            failure = EINVAL
        finally:
            os.write(tell, str(failure or 1).encode())
            os._exit(127)
    os.close(tell)
    os.close(output)
    with os.fdopen(told, "rb") as pipe:
        failure = int(pipe.read() or b"0")
    if failure:
        os.waitpid(program, 0)
    return program, failure


def _wait(program: int) -> tuple[int, float, int]:
    """Wait for the program's end, or bring it about at the end of standard input.

    Returns its return code (negative: the signal), its processor time in s, and its memory in kB.
    """
    guard, ended = _thread.allocate_lock(), False

    def watch() -> None:
        while os.read(0, 4096):
            pass
        with guard:
            if not ended:  # afterwards its number may be another's
                _kill_group(program)

    _thread.start_new_thread(watch, ())
    os.waitid(os.P_PID, program, os.WEXITED | os.WNOWAIT)
    with guard:
        _kill_group(program)  # helpers that the program left running
        ended = True
    _, status, usage = os.wait4(program, 0)
    cpu_s = usage.ru_utime + usage.ru_stime
    return os.waitstatus_to_exitcode(status), cpu_s, usage.ru_maxrss


def _kill_group(group: int) -> None:
    try:
        os.killpg(group, SIGKILL)
    except (ProcessLookupError, PermissionError):
        pass


def supervise(log: str, arguments: list[str]) -> str:
    """Run the program to its end or to the end of standard input; JSON that says how it ended."""
    try:
        program, failure = _start(log, arguments)
    except OSError as error:  # the log, or no room for a process
        _say("0")
        return f'{{"error": "{error.strerror}"}}'
    _say("0" if failure else str(program))
    if failure:
        said = "missing" if failure == ENOENT else os.strerror(failure)
        return f'{{"error": "{said}"}}'
    code, cpu_s, memory = _wait(program)
    return (
        f'{{"error": "", "return_code": {code}, "cpu_s": {cpu_s}, '
        f'"peak_memory_bytes": {memory * 1024}}}'
    )


if __name__ == "__main__":
    _say(supervise(sys.argv[1], sys.argv[2:]))
    os._exit(0)  # the watching thread still reads
