"""Run one program below this process and leave nothing of it behind.

A script of the standard library only: `supervisor.py LOG DISK PROGRAM ARGUMENT...`. Standard input
is a pipe: when it closes, by intent or by the death of its holder, the
program is killed. The first line on standard output is the program's process group (0 where nothing
was started), the second a JSON object with the program's end. If this supervisor itself
is killed, the kernel kills the program (PR_SET_PDEATHSIG), and who started it knows the group.

Processes whose parent has ended become children of this one (PR_SET_CHILD_SUBREAPER), whatever
group or session they took, so that at the program's end all of its descendants are found and
killed. Its output comes through a pipe: the log has the first and the last MiB of it. DISK: the
bytes that its folder and its output may take together.

Without arguments it makes supervisors (`process.py` starts it so, once): it forks for each request
on standard input, a socket on which two ends of pipes come, the supervisor's standard input and
output. That input begins with what to run (its length in eight bytes, then JSON).
A fork takes 1 ms; to start this script, which is done once, some 20.
"""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]  # the part of `signal` that is there at once
import _socket
import _thread
import ctypes
import json
import os
import select
import sys
import time

LIBC = ctypes.CDLL(None)
PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36
SIGKILL = 9
ENOENT, EINVAL = 2, 22
#: Python ignores these (SIGPIPE, SIGXFSZ); a program starts with the system's own handling.
IGNORED_BY_PYTHON = (13, 25)
#: Bytes of output that the log has from its beginning, and from its end.
HEAD = TAIL = 8 << 20
#: A folder that is its group's: set-group-ID, and the group may write (`core/storage/files.py`).
SHARED = 0o2020
#: How often the disk is measured, and how long killed processes may take to end, seconds.
LOOK_S, END_S = 1.0, 10.0


class Output:
    """What a program prints: the head written to the log at once, the tail at the end."""

    def __init__(self, log: str) -> None:
        self.size = 0
        self._log = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        self._tail = bytearray()
        self._done = _thread.allocate_lock()

    def follow(self, source: int) -> None:
        """Read from a pipe in a separate thread."""
        self._done.acquire()
        _thread.start_new_thread(self._take, (source,))

    def close(self) -> None:
        """Wait until all who hold the pipe have ended, and write the tail."""
        self._done.acquire(timeout=END_S)
        left_out = self.size - HEAD - len(self._tail)
        if left_out > 0:
            self._write(b"\n[%d bytes of output left out]\n" % left_out)
        self._write(bytes(self._tail))
        os.close(self._log)

    def _take(self, source: int) -> None:
        while data := os.read(source, 1 << 16):
            room = max(0, HEAD - self.size)
            self.size += len(data)
            self._write(data[:room])
            self._tail += data[room:]
            if len(self._tail) > 2 * TAIL:
                del self._tail[:-TAIL]
        del self._tail[:-TAIL]
        self._done.release()

    def _write(self, data: bytes) -> None:
        try:
            while data:
                data = data[os.write(self._log, data) :]
        except OSError:  # no room: the program notices at its own files
            pass


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def _start(output: int, arguments: list[str], environment: dict[str, str]) -> tuple[int, int]:
    """The program's process number, and the error number that kept it from starting, or 0."""
    parent = os.getpid()
    LIBC.prctl(PR_SET_CHILD_SUBREAPER, 1)
    told, tell = os.pipe()  # closes when the program starts
    program = os.fork()
    if program == 0:
        failure = 0
        try:
            os.setsid()
            LIBC.prctl(PR_SET_PDEATHSIG, SIGKILL)
            if os.getppid() != parent:  # it died before that call
                os._exit(1)
            for number in IGNORED_BY_PYTHON:
                LIBC.signal(number, None)
            nothing = os.open(os.devnull, os.O_RDONLY)
            for source, target in ((nothing, 0), (output, 1), (output, 2)):
                os.dup2(source, target)
            os.execvpe(arguments[0], arguments, environment)
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


def _wait(program: int, output: Output, disk: int) -> tuple[int, float, int, int]:
    """Wait for the program's end, or bring it about: at the end of standard input, or over DISK.

    Returns its return code (negative: the signal), its processor time in s, its memory in kB, and
    the bytes it had taken where they were too many, else 0.
    """
    guard, ended, taken = _thread.allocate_lock(), False, 0

    def watch() -> None:
        nonlocal taken
        while not taken:
            ready, _, _ = select.select([0], [], [], LOOK_S)
            if ready and not os.read(0, 4096):
                break
            used = 0 if ready else output.size + _used(".")
            taken = used if used > disk else 0
        with guard:
            if not ended:  # afterwards its number may be another's
                _kill(os.killpg, program)

    _thread.start_new_thread(watch, ())
    os.waitid(os.P_PID, program, os.WEXITED | os.WNOWAIT)
    with guard:
        _kill(os.killpg, program)  # helpers that the program left running
        ended = True
    _, status, usage = os.wait4(program, 0)
    _end_descendants()
    cpu_s = usage.ru_utime + usage.ru_stime
    return os.waitstatus_to_exitcode(status), cpu_s, usage.ru_maxrss, taken


def _end_descendants() -> None:
    """Kill whatever the program left, in other groups and sessions too, until nothing is left."""
    until = time.monotonic() + END_S
    while time.monotonic() < until:  # one in an uninterruptible call ends when that does
        try:
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        except ChildProcessError:
            return
        for process in _descendants():
            _kill(os.kill, process)
        time.sleep(0.001)


def _descendants() -> list[int]:
    """All processes below this one."""
    children: dict[int, list[int]] = {}
    for name in filter(str.isdigit, (entry.name for entry in os.scandir("/proc"))):
        try:
            with open(f"/proc/{name}/stat", "rb") as stat:  # noqa: PTH123  # pathlib costs time
                parent = int(stat.read().rpartition(b")")[2].split()[1])
        except (OSError, ValueError, IndexError):
            continue  # it has ended
        children.setdefault(parent, []).append(int(name))
    found = children.get(os.getpid(), [])
    for process in found:
        found.extend(children.get(process, ()))
    return found


def _used(folder: str) -> int:
    """Bytes of disk that the files of a folder take."""
    total = 0
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                total += entry.stat(follow_symlinks=False).st_blocks * 512
                if entry.is_dir(follow_symlinks=False):
                    total += _used(entry.path)
    except OSError:  # removed meanwhile
        pass
    return total


def _kill(kill, number: int) -> None:  # type: ignore[no-untyped-def]  # `typing` costs time here
    try:
        kill(number, SIGKILL)
    except (ProcessLookupError, PermissionError):
        pass


def supervise(
    log: str, disk: int, arguments: list[str], environment: dict[str, str], folder: str = "."
) -> str:
    """Run the program to its end or to the end of standard input; JSON that says how it ended."""
    try:
        os.chdir(folder)
        mode = os.stat(".").st_mode  # noqa: PTH116  # pathlib costs time
        if mode & SHARED == SHARED:  # another account may have to remove what the program leaves
            os.umask(os.umask(0o077) & ~0o070)
        output = Output(log)
        source, target = os.pipe()
        program, failure = _start(target, arguments, environment)
    except OSError as error:  # the folder, the log, or no room for a process
        _say("0")
        return f'{{"error": "{error.strerror}"}}'
    _say("0" if failure else str(program))
    if failure:
        text = "missing" if failure == ENOENT else os.strerror(failure)
        return f'{{"error": "{text}"}}'
    output.follow(source)
    code, cpu_s, memory, taken = _wait(program, output, disk)
    output.close()
    return (
        f'{{"error": "", "return_code": {code}, "cpu_s": {cpu_s}, '
        f'"peak_memory_bytes": {memory * 1024}, "disk_bytes": {taken}}}'
    )


def requested() -> tuple[str, int, list[str], dict[str, str], str]:
    """Return what to supervise, in a new process for each request; ends with the requesting one."""
    requests = _socket.socket(fileno=0)
    _signal.signal(_signal.SIGCHLD, _signal.SIG_IGN)  # the kernel sees to supervisors that end
    while True:
        message, ancillary, _, _ = requests.recvmsg(1, _socket.CMSG_SPACE(8))
        if not message:
            os._exit(0)
        ((_, _, numbers),) = ancillary
        ends = [int.from_bytes(numbers[place : place + 4], sys.byteorder) for place in (0, 4)]
        try:
            is_supervisor = os.fork() == 0
        except OSError as error:  # no room for a process
            is_supervisor = False
            os.write(ends[1], f'0\n{{"error": "{error.strerror}"}}\n'.encode())
        if is_supervisor:
            os.setsid()
            _signal.signal(_signal.SIGCHLD, _signal.SIG_DFL)
            requests.detach()  # its number, 0, is the first pipe's from here on
            for target, end in enumerate(ends):
                os.dup2(end, target)
                os.close(end)
            log, disk, words, environment, folder = json.loads(
                _read(int.from_bytes(_read(8), "big"))
            )
            return log, disk, words, environment, folder
        for end in ends:
            os.close(end)


def _read(size: int) -> bytes:
    """Return `size` bytes of standard input; fewer mean that the requesting process has ended."""
    data = b""
    while len(data) < size:
        piece = os.read(0, size - len(data))
        if not piece:
            os._exit(1)
        data += piece
    return data


if __name__ == "__main__":
    if sys.argv[1:]:
        _say(supervise(sys.argv[1], int(sys.argv[2]), sys.argv[3:], dict(os.environ)))
    else:
        _say(supervise(*requested()))
    os._exit(0)  # the watching thread still reads
