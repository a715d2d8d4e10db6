"""Studies that are killed at random moments, with a second fault, and run again until they finish.

A small campaign on CalculiX first runs undisturbed, twice. Then its process is killed, alone or
together with its solvers and their supervisors, or only a solver is; the study runs again on the
same store until it finishes. In three of four attempts something else goes wrong, too: the disk is
full from a moment on (`disk`, a small file system of its own), the clock jumps by hours, days or a
year (`clock`, by libfaketime), or the attempt runs on a host of another name (`host`, in its own
namespace). An attempt on a full disk may end by itself, in a sentence.

Conditions: no solver run of a cached job, no stored result written again or lost, no process left
ten seconds after a kill, no file that an undisturbed run does not leave, bit-identical results.

Runs are forks of this process, which has the packages loaded; those with another clock are not.
"""

from __future__ import annotations

import ctypes
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from tests.flows.records import differences
from tests.flows.studies.test_time_histories import driven, write_csv
from tests.flows.updating.test_same_bits import LONG, SHORT
from tests.flows.updating.test_stored_matrices import DENSITY, OWN, STORED, written

from modetune.core.storage.files import WRITTEN_S
from modetune.flows.cli.main import main as modetune
from modetune.flows.jobs.prefect_server import HOME_VARIABLE, shared_server, stop_server

#: In the environment of every process of one benchmark.
MARK = "MODETUNE_KILLS_MARK"
#: Seconds within which all remaining processes must end after a kill.
GRACE_S = 10.0
#: No attempt takes longer, seconds; with a shared machine, a hundred times the usual.
LONGEST_S = 300.0
#: Each attempt is killed within this share of an undisturbed run's time, if it lasts so long.
SHARE = 0.7
SOLVER = """#!/bin/sh
basename "$PWD" .part >> "{log}"
exec "{ccx}" "$@"
"""
#: Where the standard output of a command goes.
PRINTED = "printed.json"
#: Exit codes of a study that finished, and of one that a full disk ended.
FINISHED, REFUSED = (0, 3), (2, 4, 5)
#: Bytes of the disk of a campaign, and the most that is left of it when it is full.
DISK, LEFT = 64 << 20, 400_000
#: Violated conditions of one life that are told.
SHOWN = 6
#: Seconds by which the clock jumps.
JUMPS = (-2 * 86_400, -3_600, -60, 3_600, 3 * 86_400, 400 * 86_400)
FAKETIME = next(Path("/usr/lib").glob("*/faketime/libfaketimeMT.so.1"), None)
OTHER_HOST, NEW_UTS = b"other-host", 0x04000000


@dataclass(frozen=True, slots=True)
class Command:
    """A command and what it leaves: files in the run folder `--runs`, or what it prints.

    own: keys of what it prints that depend on what was there before.
    """

    arguments: tuple[str, ...]
    records: tuple[str, ...] = ()
    own: frozenset[str] = frozenset()

    def differences(self, whole: Path, place: Path) -> list[str]:
        """Return the names of what differs between the results in two folders."""
        found = []
        for pattern in self.records or (PRINTED,):
            names = {
                str(path.relative_to(folder))
                for folder in (whole, place)
                for path in folder.glob(pattern)
            }
            for name in sorted(names or {pattern}):
                one, other = whole / name, place / name
                if not (one.exists() and other.exists()):
                    found.append(f"{name} is missing")
                elif one.suffix in (".h5", ".json"):
                    found += [item for item in differences(one, other) if not self._is_own(item)]
                elif one.read_bytes() != other.read_bytes():
                    found.append(name)
        return found

    def _is_own(self, item: str) -> bool:
        return not self.own.isdisjoint(item.split("/"))


PLAIN = ("--no-prefect", "--json")
#: Whether modes come from matrices would otherwise follow from the time that a run takes.
ALONE = (*PLAIN, "--set", STORED)
DIFFERENCES = ("--set", "sensitivity.method=finite_difference")
UPDATE = ("update", "part.yaml", *PLAIN, "--set", SHORT)
#: As a flow of Prefect's, on a server that no blow hits.
FLOW = tuple(word for word in UPDATE if word != "--no-prefect")
SCREEN = ("screen", "part.yaml", *PLAIN, "--method", "lhs", "--points", "20")
SAMPLE = (
    *("sample", "part.yaml", *PLAIN, "--steps", "100", "--points", "20", "--checks", "3"),
    *("--set", "residuals.frequency_deviation=0.05"),
)
GO = ("go", "part.inp", "part.csv", "--solver", "calculix", "--units", "mm-t-s")
#: Studies that print their result, as flows.
STUDIES = (
    "modes part.yaml", "check part.yaml", "model reduce part.yaml", "model direct part.yaml",
    "correlate part.yaml part.yaml",
)  # fmt: skip
#: Kinds that run on a server.
SERVED = ("flow", "studies")


def printed(line: str, *own: str) -> tuple[Command, ...]:
    """A command that prints its result."""
    return (Command((*line.split(), *ALONE), own=frozenset(own)),)


#: What is killed, a command for each campaign in turn.
KINDS: dict[str, tuple[Command, ...]] = {
    "matrices": (Command((*UPDATE, "--set", STORED), ("part/campaign.h5",)),),
    "solver": (Command((*UPDATE, "--set", OWN, *DIFFERENCES), ("part/campaign.h5",)),),
    "flow": (Command((*FLOW, "--set", OWN, *DIFFERENCES), ("part/campaign.h5",)),),
    "screen": tuple(
        Command((*SCREEN, "--set", way), ("part/screening.h5",)) for way in (STORED, OWN)
    ),
    "sample": tuple(
        Command((*SAMPLE, "--set", way), ("part/posterior.h5",)) for way in (STORED, OWN)
    ),
    "validate": printed("validate part.yaml --leave-one-out"),
    "localise": printed("localise part.yaml --no-changes"),
    "pretest": printed("pretest part.yaml"),
    "compare": printed("compare part.yaml other.yaml", "updated_now"),
    "receive": (
        Command(
            ("receive", "part.yaml", "lab", "--settle", "0", *ALONE, "--set", SHORT),
            ("part/campaign.h5", "part/tests/*.json"),
            frozenset(("settings", "file")),  # paths
        ),
    ),
    "fleet": (
        Command(
            ("fleet", "part.yaml", "twin.yaml", "--update", "--parallel", "1", *ALONE),
            ("part/campaign.h5", "twin/campaign.h5"),
        ),
    ),
    "go": (Command((*GO, *ALONE, "--out", "go.yaml"), ("part/campaign.h5", "case/go.yaml")),),
    "identify": (
        Command(("identify", "noise.csv", "--json", "--out", "modes.csv"), ("case/modes.csv",)),
    ),
    "expand": printed("model expand part.yaml"),
    "studies": tuple(Command((*line.split(), "--json")) for line in STUDIES),
}


@dataclass(slots=True)
class Found:
    """What came of the kills of one life of a study, from its first start to its end.

    faults: second faults that happened. refused: attempts that a full disk ended. wrong: conditions
    that did not hold, a sentence each.
    """

    blows: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    refused: int = 0
    wrong: list[str] = field(default_factory=list)

    def as_json(self) -> dict[str, Any]:
        return {
            "blows": dict(self.blows),
            "faults": dict(self.faults),
            "refused": self.refused,
            "wrong": self.wrong,
        }


@dataclass(frozen=True, slots=True)
class Whole:
    """An undisturbed run: its folder, files (`files_of`), entries of its store, and seconds."""

    place: Path
    files: Counter[str]
    entries: frozenset[str]
    seconds: float


def possible_faults() -> tuple[str, ...]:
    """The second faults that this machine allows; what is not possible is printed with a reason."""
    found, reasons = [], {}
    if FAKETIME:
        found.append("clock")
    else:
        reasons["clock"] = "libfaketime is not installed (apt-get install faketime)"
    if os.geteuid() == 0 and shutil.which("mount"):
        found.append("disk")
    else:
        reasons["disk"] = "only root may mount a small disk"
    pid = os.fork()
    if not pid:
        os._exit(0 if _on_other_host() else 1)
    if os.waitpid(pid, 0)[1] == 0:
        found.append("host")
    else:
        reasons["host"] = "only root may give a process another host name"
    for name, reason in reasons.items():
        sys.stdout.write(f"no fault `{name}`: {reason}\n")
    return tuple(found)


def _on_other_host() -> bool:
    """Give this process a host name of its own; return whether it may."""
    if ctypes.CDLL(None).unshare(NEW_UTS):
        return False
    socket.sethostname(OTHER_HOST.decode())
    return True


def files_of(place: Path) -> Counter[str]:
    """What a run leaves, by names without keys, times and hosts; its store's entries are not in it.

    Failed job folders are kept on purpose, and half-written files for an hour.
    """
    found: Counter[str] = Counter()
    for path in place.rglob("*"):
        name = str(path.relative_to(place))
        if path.is_dir() or name.startswith(("store/", "log", "full")) or ".failed" in name:
            continue
        name = re.sub(r"\d{4}-\d\d-\d\dT[\d-]+Z", "TIME", name)
        found[re.sub(r"\b[0-9a-f]{8,64}\b", "KEY", name)] += 1
    return found


def entries_of(place: Path) -> dict[str, tuple[int, int]]:
    """Entries of the store with inode and time of writing."""
    stats = {path.name: path.stat() for path in (place / "store").glob("??/[0-9a-f]*.h5")}
    return {name: (stat.st_ino, stat.st_mtime_ns) for name, stat in stats.items()}


class Field:
    """A folder with the campaigns, and what runs there. faults: second faults, of all that are."""

    def __init__(self, folder: Path, faults: tuple[str, ...]) -> None:
        self.folder = folder
        self.faults = faults
        self.random = np.random.default_rng()
        self.wholes: dict[tuple[str, int], Whole] = {}
        folder.mkdir()
        # In a separate process: campaigns would share the supervisors that it starts, which then
        # outlive them.
        pid = os.fork()
        if not pid:
            _write_case(folder / "case")
            os._exit(0)
        assert os.waitpid(pid, 0)[1] == 0, "the campaign cannot be written"
        self.log = folder / "started"
        ccx = shutil.which("ccx")
        assert ccx is not None, "CalculiX (ccx) is not here"
        program = folder / "ccx"
        program.write_text(SOLVER.format(log=self.log, ccx=ccx))
        program.chmod(0o755)
        self.environment = {
            MARK: str(folder),
            "MODETUNE_CCX": str(program),
            HOME_VARIABLE: str(folder / "home"),
        }

    @contextmanager
    def served(self) -> Iterator[None]:
        """A server that campaigns share; it lacks their mark, and so is no orphan of theirs."""
        os.environ[HOME_VARIABLE] = self.environment[HOME_VARIABLE]
        server = shared_server()
        try:
            assert server.wait() == "ready", f"no server; its log is in {server.home}"
            yield
        finally:
            server.close()
            stop_server(server.home)

    def life(self, kind: str, turn: int, seed: list[int]) -> Found:
        """Kill a study again and again until it finishes."""
        found = Found()
        command = KINDS[kind][turn]
        whole = self._whole(kind, turn, found)
        self.random = np.random.default_rng(seed)
        place = self.folder / f"{kind}-{turn}-life"
        with self._disk(place):
            # On another host a flow starts a server of its own, which outlives it for a while.
            faults = [name for name in self.faults if name != "host" or kind not in SERVED]
            self._until_it_ends(command, place, whole, faults, found)
            if found.wrong:
                found.wrong[SHOWN:] = [f"and {len(found.wrong) - SHOWN} more"] * (
                    len(found.wrong) > SHOWN
                )
                kept = self.folder / f"wrong-{kind}-{'-'.join(map(str, seed))}"
                shutil.copytree(place, kept, dirs_exist_ok=True, symlinks=True)
        shutil.rmtree(place)
        return found

    @contextmanager
    def _disk(self, place: Path) -> Iterator[None]:
        """A folder on a small disk of its own, where that is possible."""
        place.mkdir()
        small = "disk" in self.faults
        if small:
            size = f"size={DISK}"
            subprocess.run(["mount", "-t", "tmpfs", "-o", size, "tmpfs", place], check=True)
        try:
            yield
        finally:
            if small:
                subprocess.run(["umount", "--lazy", place], check=True)

    def _whole(self, kind: str, turn: int, found: Found) -> Whole:
        """Return an undisturbed run, of two, whose results must be the same."""
        if (kind, turn) in self.wholes:
            return self.wholes[kind, turn]
        command, places, seconds = KINDS[kind][turn], [], 0.0
        for name in ("first", "second"):
            place = self.folder / f"{kind}-{turn}-{name}"
            place.mkdir()
            began = time.monotonic()
            code = self._code(self._start(command, place, ""))
            assert code in FINISHED, f"{kind} ended with code {code}; look at {place / 'log'}"
            seconds = time.monotonic() - began
            places.append(place)
        found.wrong += [f"undisturbed: {name}" for name in command.differences(*places)]
        entries = frozenset(entries_of(places[0]))
        whole = Whole(places[0], files_of(places[0]), entries, seconds)
        self.wholes[kind, turn] = whole
        return whole

    def _until_it_ends(
        self, command: Command, place: Path, whole: Whole, faults: list[str], found: Found
    ) -> None:
        code = None
        while code not in FINISHED:
            before, attempt = entries_of(place), f"attempt {found.blows.total() + 1}"
            self.log.write_text("")
            fault = str(self.random.choice(["", *faults]))
            code = self._attempt(command, place, SHARE * whole.seconds, fault, found)
            after, stored = entries_of(place), {name[:64] for name in before}
            repeated = stored.intersection(self.log.read_text().split())
            written = {name for name in before if after.get(name, before[name]) != before[name]}
            lost = {name for name in before.keys() & whole.entries if name not in after}
            for names, sentence in (
                (repeated, "solver ran for stored results"),
                (written, "stored results were written again"),
                (lost, "stored results were lost"),
            ):
                if names:
                    found.wrong.append(f"{attempt}: {sentence}: {sorted(names)}")
            if found.wrong and code is not None and code not in (*FINISHED, *REFUSED):
                return
        self._remove_old_parts(command, place)
        entries = entries_of(place).keys()
        found.wrong += [f"{name[:16]} is not in the store" for name in whole.entries - entries]
        found.wrong += [f"{name[:16]} is left in the store" for name in entries - whole.entries]
        files = files_of(place)
        found.wrong += [f"{name} is left {n} times" for name, n in (files - whole.files).items()]
        found.wrong += [f"{name} is missing {n} times" for name, n in (whole.files - files).items()]
        found.wrong += [f"{name} differs" for name in command.differences(whole.place, place)]

    def _attempt(
        self, command: Command, place: Path, longest_s: float, fault: str, found: Found
    ) -> int | None:
        """Start a study, let things go wrong, kill it; return its exit code, or None if killed."""
        blow = str(self.random.choice(["campaign", "all", "solver"]))
        first_s, then_s = longest_s * self.random.uniform(size=2) * (0.3, 0.6)
        if fault == "clock":  # a process of its own starts later
            first_s, then_s = first_s + 1.0, then_s + 0.5
            (place / "log-clock").write_text("+0")
        pid = self._start(command, place, fault)
        found.faults.update([fault] * bool(fault))
        code = self._waits(pid, first_s, False)
        if code is None and fault == "disk":
            _fill(place / "full", int(self.random.integers(0, LEFT)))
        elif code is None and fault == "clock":
            (place / "log-clock").write_text(f"{int(self.random.choice(JUMPS)):+d}")
        if code is None:
            code = self._waits(pid, then_s, blow != "campaign" and fault != "disk")
        if code is None:
            code = self._strike(blow, fault, pid, found)
        (place / "full").unlink(missing_ok=True)
        if code is not None and code not in FINISHED:
            if fault == "disk" and code in REFUSED:
                found.refused += 1
            else:
                found.wrong.append(f"ended with code {code} at fault `{fault}`, blow `{blow}`")
        return code

    def _strike(self, blow: str, fault: str, pid: int, found: Found) -> int | None:
        """Kill what a blow is named for; return the exit code where the study goes on."""
        solvers = self._processes(solving=True)
        if blow != "campaign" and not solvers:
            blow = "campaign"  # it ended this very moment
        found.blows[blow] += 1
        for victim in {"campaign": [], "all": self._processes(), "solver": solvers}[blow]:
            _kill(victim)
        if blow == "solver":  # it is run again
            return self._code(pid)
        _kill(pid)
        os.waitpid(pid, 0)
        deadline = time.monotonic() + GRACE_S
        while self._processes() and time.monotonic() < deadline:
            time.sleep(0.02)
        for left in self._processes():
            with suppress(OSError):
                line = Path(f"/proc/{left}/cmdline").read_bytes().replace(b"\0", b" ").decode()
                found.wrong.append(f"left after blow `{blow}` at fault `{fault}`: {line}")
        return None

    def _remove_old_parts(self, command: Command, place: Path) -> None:
        """Run a study again when half-written files have become old, if there are any."""
        parts = [path for path in place.rglob("*.part") if not path.name.startswith("log")]
        old = time.time() - 2 * WRITTEN_S
        for path in parts:
            os.utime(path, (old, old))
        if parts:
            self._code(self._start(command, place, ""))

    def _start(self, command: Command, place: Path, fault: str) -> int:
        pid = os.fork()
        if pid:
            return pid
        code = 70
        try:
            os.environ |= {**self.environment, "MODETUNE_STORE": str(place / "store")}
            os.setsid()
            log = os.open(place / "log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
            os.dup2(log, 2)
            if not (place / "case").exists():
                shutil.copytree(self.folder / "case", place / "case.new")
                (place / "case.new").rename(place / "case")
            os.chdir(place / "case")
            os.dup2(os.open(place / PRINTED, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 1)
            runs = command.records and command.arguments[0] != "identify"
            folder = ["--runs", str(place)] if runs else []
            sys.argv = ["modetune", *command.arguments, *folder]
            if fault == "host":
                assert _on_other_host()
            if fault == "clock":
                _exec_with_clock(place / "log-clock")
            modetune()
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 70
        finally:
            try:
                sys.stdout.flush()
                sys.stderr.flush()
            except OSError:  # the disk is full: what was printed is lost, and the shell says so
                code = code or 4
            os._exit(code)

    def _code(self, pid: int) -> int:
        """Return the exit code of a study, which is killed if it takes too long."""
        code = self._waits(pid, LONGEST_S, False)
        if code is None:
            for victim in (pid, *self._processes()):
                _kill(victim)
            os.waitpid(pid, 0)
            return -signal.SIGKILL
        return code

    def _waits(self, pid: int, seconds: float, solving: bool) -> int | None:
        """Return the exit code if a process ends within these seconds, after a solver runs if so
        wanted; else None."""
        began = time.monotonic()
        while (passed := time.monotonic() - began) < LONGEST_S:
            done, status = os.waitpid(pid, os.WNOHANG)
            if done:
                return os.waitstatus_to_exitcode(status)
            if passed >= seconds and not (solving and not self._processes(solving=True)):
                break
            time.sleep(0.005 if passed < seconds else 0.02)
        return None

    def _processes(self, solving: bool = False) -> list[int]:
        """Programs that campaigns here have started: solvers and their supervisors, or only
        solvers at a job."""
        mark, found = f"{MARK}={self.folder}".encode(), []
        for entry in Path("/proc").glob("[0-9]*"):
            try:
                ours = mark in (entry / "environ").read_bytes().split(b"\0")
                line = (entry / "cmdline").read_bytes()
                if ours and not (solving and (b"supervisor" in line or b"\0-i\0" not in line)):
                    found.append(int(entry.name))
            except OSError:
                continue
        return found


def _write_case(folder: Path) -> None:
    """Write two campaigns of one deck and one of another, two tests as they arrive, a recording."""
    campaign = written(LONG, folder).read_text()
    other = "\n".join(line for line in campaign.splitlines() if "E_3" not in line)
    (folder / "other.yaml").write_text(other.replace("name: part", "name: other"))
    # Updates in parallel have other last digits: they share results and threads of BLAS.
    (folder / "twin.yaml").write_text(
        campaign.replace("part", "twin").replace("twin.csv", "part.csv")
    )
    (folder / "twin.inp").write_text(LONG.deck.replace(DENSITY, "2.8e-9"))
    modes = (folder / "part.csv").read_text()
    (folder / "lab").mkdir()
    for number, days in ((1, 500), (2, 499)):  # before the earliest clock
        test = folder / "lab" / f"night{number}.csv"
        test.write_text(f"# night {number}\n{modes}")
        at = test.stat().st_mtime - 86_400 * days
        os.utime(test, (at, at))
    write_csv(folder / "noise.csv", driven("four", 20_000, everywhere=False), with_force=True)


def _fill(path: Path, left: int) -> None:
    """Fill a disk with a file, except for some bytes; others write to it meanwhile."""
    with path.open("wb") as file:
        for _ in range(20):
            with suppress(OSError):
                size = max(shutil.disk_usage(path.parent).free - left, 1)
                os.posix_fallocate(file.fileno(), 0, size)
                return


def _exec_with_clock(offset: Path) -> None:
    """Become a new process whose clock is that of the machine plus the seconds in a file."""
    os.environ |= {
        "LD_PRELOAD": str(FAKETIME),
        "FAKETIME_TIMESTAMP_FILE": str(offset),
        "FAKETIME_CACHE_DURATION": "1",
        "FAKETIME_DONT_FAKE_MONOTONIC": "1",
        "NO_FAKE_STAT": "1",
    }
    start = "from modetune.flows.cli.main import main; main()"
    os.execv(sys.executable, [sys.executable, "-c", start, *sys.argv[1:]])


def _kill(pid: int) -> None:
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return
