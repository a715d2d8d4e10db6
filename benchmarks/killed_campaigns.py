"""Campaigns that are killed at random moments and run again until they finish.

A small campaign on CalculiX first runs undisturbed, twice. Then its process is killed, alone or
together with its solvers and their supervisors, or only a solver is; the campaign runs again on the
same store until it finishes. Three conditions must hold: no solver run of a cached job, no process
left ten seconds after a kill, and a bit-identical record.

Runs are forks of this process, which has the packages loaded.
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from tests.flows.records import differences
from tests.flows.updating.test_same_bits import LONG, SHORT
from tests.flows.updating.test_stored_matrices import OWN, STORED, written

from modetune.flows.cli.main import main as modetune
from modetune.flows.jobs.prefect_server import HOME_VARIABLE, shared_server, stop_server

#: In the environment of every process of one benchmark.
MARK = "MODETUNE_KILLS_MARK"
#: Seconds within which all remaining processes must end after a kill.
GRACE_S = 10.0
#: Each attempt is killed within this share of an undisturbed run's time, if it lasts so long.
SHARE = 0.7
SOLVER = """#!/bin/sh
basename "$PWD" .part >> "{log}"
exec "{ccx}" "$@"
"""


#: Where the standard output of a command goes.
PRINTED = "printed.json"


@dataclass(frozen=True, slots=True)
class Command:
    """A command, with the record that it leaves in its run folder, or what it prints."""

    arguments: tuple[str, ...]
    record: str = ""

    def result(self, place: Path) -> Path:
        """Return the file to compare."""
        return place / "part" / self.record if self.record else place / PRINTED


DIFFERENCES = ("--set", "sensitivity.method=finite_difference")
UPDATE = ("update", "part.yaml", "--no-prefect", "--json", "--set", SHORT)
#: As a flow of Prefect's, on a server that no blow hits.
FLOW = tuple(word for word in UPDATE if word != "--no-prefect")
SCREEN = ("screen", "part.yaml", "--no-prefect", "--json", "--method", "lhs", "--points", "20")
SAMPLE = (
    *(
        "sample",
        "part.yaml",
        "--no-prefect",
        "--json",
        "--steps",
        "100",
        "--points",
        "20",
        "--checks",
        "3",
    ),
    *("--set", "residuals.frequency_deviation=0.05"),
)
#: Studies that print their result, as flows.
STUDIES = (
    "modes part.yaml", "check part.yaml", "localise part.yaml", "pretest part.yaml",
    "reduce part.yaml", "direct part.yaml", "expand part.yaml", "correlate part.yaml part.yaml",
    "validate part.yaml --leave-one-out",
)  # fmt: skip
#: Kinds that run on a server.
SERVED = ("flow", "studies")
#: What is killed, a command for each campaign in turn.
KINDS: dict[str, tuple[Command, ...]] = {
    "matrices": (Command((*UPDATE, "--set", STORED), "campaign.h5"),),
    "solver": (Command((*UPDATE, "--set", OWN, *DIFFERENCES), "campaign.h5"),),
    "flow": (Command((*FLOW, "--set", OWN, *DIFFERENCES), "campaign.h5"),),
    "screening": tuple(Command((*SCREEN, "--set", way), "screening.h5") for way in (STORED, OWN)),
    "sampling": tuple(Command((*SAMPLE, "--set", way), "posterior.h5") for way in (STORED, OWN)),
    "studies": tuple(Command((*line.split(), "--json")) for line in STUDIES),
}


@dataclass(slots=True)
class Found:
    """What came of the kills of one kind."""

    blows: Counter[str] = field(default_factory=Counter)
    campaigns: int = 0
    repeated: int = 0
    orphans: int = 0
    differ: list[str] = field(default_factory=list)

    @property
    def good(self) -> bool:
        return not (self.repeated or self.orphans or self.differ)


class Field:
    """A folder with the campaign, and what runs there."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder = folder
        self.random = np.random.default_rng(seed)
        # In a separate process: campaigns would share the supervisors that it starts, which then
        # outlive them.
        pid = os.fork()
        if not pid:
            written(LONG, folder / "case")
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

    def kill(self, kind: str, count: int) -> Found:
        """Kill campaigns of one type; count: number of kills."""
        with self._served() if kind in SERVED else nullcontext():
            return self._killed(kind, count)

    @contextmanager
    def _served(self) -> Iterator[None]:
        """A server that campaigns share; it lacks their mark, and so is no orphan of theirs."""
        os.environ[HOME_VARIABLE] = self.environment[HOME_VARIABLE]
        server = shared_server()
        try:
            assert server.wait() == "ready", f"no server; its log is in {server.home}"
            yield
        finally:
            server.close()
            stop_server(server.home)

    def _killed(self, kind: str, count: int) -> Found:
        found = Found()
        wholes = [self._undisturbed(kind, turn, found) for turn in range(len(KINDS[kind]))]
        commands = KINDS[kind]
        for command, (whole, seconds) in zip(commands, wholes, strict=True):
            before = found.blows.total()
            while found.blows.total() < before + count / len(commands):
                place = self.folder / f"{kind}-{found.campaigns}"
                self._until_it_ends(command, place, SHARE * seconds, found)
                found.campaigns += 1
                found.differ += differences(whole, command.result(place))
                shutil.rmtree(place)
        return found

    def _undisturbed(self, kind: str, turn: int, found: Found) -> tuple[Path, float]:
        """Return the first record of two undisturbed runs and the time of the second, seconds."""
        command, records, seconds = KINDS[kind][turn], [], 0.0
        for name in ("first", "second"):
            place = self.folder / f"{kind}-{turn}-{name}"
            began = time.monotonic()
            self._wait(self._start(command, place))
            seconds = time.monotonic() - began
            records.append(command.result(place))
        found.differ += differences(*records)
        return records[0], seconds

    def _until_it_ends(self, command: Command, place: Path, longest_s: float, found: Found) -> None:
        had: set[str] = set()
        while True:
            had |= {path.name[:64] for path in (place / "store").glob("??/*.h5")}
            self.log.write_text("")
            pid = self._start(command, place)
            blow = str(self.random.choice(["campaign", "all", "solver"]))
            ended = self._waits(pid, longest_s * self.random.uniform(), blow != "campaign")
            if not ended:
                ended = self._strike(blow, pid, found)
            found.repeated += len(had.intersection(self.log.read_text().split()))
            if ended:
                return

    def _strike(self, blow: str, pid: int, found: Found) -> bool:
        """Kill what a blow is named for; whether the campaign came to its end all the same."""
        solvers = self._processes(solving=True)
        if blow != "campaign" and not solvers:
            blow = "campaign"  # it ended this very moment
        found.blows[blow] += 1
        for victim in {"campaign": [], "all": self._processes(), "solver": solvers}[blow]:
            _kill(victim)
        if blow == "solver":  # it is run again
            self._wait(pid)
            return True
        _kill(pid)
        os.waitpid(pid, 0)
        deadline = time.monotonic() + GRACE_S
        while self._processes() and time.monotonic() < deadline:
            time.sleep(0.02)
        found.orphans += len(self._processes())
        return False

    def _start(self, command: Command, place: Path) -> int:
        place.mkdir(exist_ok=True)
        pid = os.fork()
        if pid:
            return pid
        code = 70
        try:
            os.environ |= {**self.environment, "MODETUNE_STORE": str(place / "store")}
            os.setsid()
            shutil.copytree(self.folder / "case", place / "case", dirs_exist_ok=True)
            os.chdir(place / "case")
            log = os.open(place / "log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
            printed = os.open(place / PRINTED, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(printed, 1)
            os.dup2(log, 2)
            folder = ["--runs", str(place)] if command.record else []
            sys.argv = ["modetune", *command.arguments, *folder]
            modetune()
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 70
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)

    def _wait(self, pid: int) -> None:
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        assert code in (0, 3), f"it ended with code {code}; look at the logs in {self.folder}"

    def _waits(self, pid: int, seconds: float, solving: bool) -> bool:
        """Return whether a process ends within these seconds, after a solver runs if required."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline or (solving and not self._processes(solving=True)):
            done, status = os.waitpid(pid, os.WNOHANG)
            if done:
                assert os.waitstatus_to_exitcode(status) in (0, 3)
                return True
            time.sleep(0.005)
        return False

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


def _kill(pid: int) -> None:
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return
