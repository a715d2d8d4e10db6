"""A deployed campaign with a server of its own, whose processes can be killed."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from modetune.core.storage.locks import FileLock
from modetune.flows.campaign.campaign import cores
from modetune.flows.jobs import prefect_server as process
from modetune.flows.jobs.limits import CORES, Limit, MachineLimits
from modetune.flows.jobs.server_client import ServerRefused
from tests.flows.conftest import api_of

SIX_MASS = Path(__file__).resolve().parents[3] / "configs" / "six_mass"
#: What the processes of a site are, by a part of their command lines.
WORKER, RUN = b"modetune\0server\0worker", b"server.run_program"
SERVER = (b"jobs.prefect_server", b"prefect\0server")
#: Seconds that a busy machine may need to start something.
PATIENCE_S = 200.0
ENDED = {"COMPLETED", "FAILED", "CRASHED", "CANCELLED"}
#: States that a good update ends in.
GOOD = ("Completed", "Converged, trusted", "Unchanged, trusted")


class Site:
    """A folder with the six-mass campaign, deployed, and the shared server below a base."""

    def __init__(self, folder: Path, base: Path | None = None) -> None:
        self.folder = folder
        self.base = base or folder / "home"
        self.home = process.machine_home(self.base)
        shutil.copytree(
            SIX_MASS, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("__py*", "*.py")
        )
        self.store = folder / "store"
        self.environment = {
            **os.environ,
            process.HOME_VARIABLE: str(self.base),
            "MODETUNE_STORE": str(self.store),
            "PREFECT_WORKER_QUERY_SECONDS": "2",  # by default a worker looks each ten seconds
        }
        self._cores = ExitStack()
        self._started: list[subprocess.Popen[str]] = []
        for name in (*process.FOREIGN, "MODETUNE_NO_PREFECT"):
            self.environment.pop(name, None)
        deployed = self.run("server", "deploy", "campaign.yaml")
        assert deployed.returncode == 0, deployed.stderr

    def run(self, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
        """Run `modetune ARGUMENTS` in the folder."""
        return self.program(sys.executable, "-m", "modetune", *arguments, **environment)

    def program(self, *command: str, **environment: str) -> subprocess.CompletedProcess[str]:
        """Run a program in the folder."""
        return subprocess.run(
            command,
            cwd=self.folder,
            env={**self.environment, **environment},
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )

    def prefect(self) -> dict[str, str]:
        """Variables that make Prefect a client of the server."""
        address = process.running_address(self.home)
        assert address is not None
        lock = FileLock(self.folder / "never")
        return process.SharedServer(
            self.home, address, lock, process.read_login(self.home)
        ).settings()

    def ask(self, path: str, content: object = None) -> Any:
        """Return the server's answer to its owner."""
        api = api_of(self.home)
        return api.get(path) if content is None else api.post(path, content)

    def deployment(self, name: str = "update/six-mass") -> Any:
        return self.ask(f"/deployments/name/{name}")

    def due(self, name: str = "update/six-mass", /, **parameters: object) -> str:
        """Ask for a run of a deployment with these parameters over its own; its identity."""
        content = {"state": {"type": "SCHEDULED"}, "parameters": parameters}
        made = self.ask(f"/deployments/{self.deployment(name)['id']}/create_flow_run", content)
        return str(made["id"])

    def end(self, run: str) -> Any:
        """The run once it has ended, by a worker that the tests of a file share."""
        if not self._started:
            self.worker()
        return self.wait(run, lambda run: run["state_type"] in ENDED)[0]

    def worker(self) -> subprocess.Popen[str]:
        return self.start("server", "worker")

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        """Start `modetune ARGUMENTS` in the folder."""
        started = subprocess.Popen(
            [sys.executable, "-m", "modetune", *arguments],
            cwd=self.folder,
            env=self.environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        self._started.append(started)
        return started

    def end_started(self) -> None:
        """Kill what a failed test left running."""
        for started in self._started:
            with started:  # waits, and closes the pipe that a test may have read to its end
                started.kill()
        self._started.clear()

    def state(self, run: str) -> Any:
        return self.ask(f"/flow_runs/{run}")

    def wait(self, run: str, wanted: Callable[[Any], bool]) -> tuple[Any, float]:
        """The run once it is as wanted, and the seconds until then; the server may be gone."""
        began, found = time.monotonic(), None
        while time.monotonic() - began < PATIENCE_S:
            try:
                found = self.state(run)
            except (ServerRefused, AssertionError):
                pass
            else:
                if wanted(found):
                    return found, time.monotonic() - began
            time.sleep(0.3)
        raise AssertionError(f"not in {PATIENCE_S:.0f} s: {found and found['state']}")

    def hang(self) -> None:
        """From now on a run of the campaign waits: its jobs want cores, which are all taken."""
        shutil.rmtree(self.store, ignore_errors=True)
        every = (Limit(CORES, cores(), cores()),)
        limits = MachineLimits(self.home / "limits")
        self._cores.enter_context(limits.held(every, lambda name: time.sleep(0.05)))

    def resume(self) -> None:
        """Give the cores back."""
        self._cores.close()

    def processes(self, *kinds: bytes) -> list[int]:
        """The site's living processes of these kinds."""
        ours, found = f"{process.HOME_VARIABLE}={self.base}".encode(), []
        for entry in Path("/proc").glob("[0-9]*"):
            try:
                if ours in (entry / "environ").read_bytes().split(b"\0"):
                    line = (entry / "cmdline").read_bytes()
                    if any(kind in line for kind in kinds):
                        found.append(int(entry.name))
            except OSError:
                continue
        return found

    def kill(self, *kinds: bytes, blow: signal.Signals = signal.SIGKILL) -> int:
        """Send a signal to the site's processes of these kinds; how many there were."""
        found = self.processes(*kinds)
        for pid in found:
            try:
                os.kill(pid, blow)
            except ProcessLookupError:  # it ended with its parent
                continue
        return len(found)

    def slots(self) -> int:
        """Runs of the deployment that hold its one slot."""
        return int(self.deployment()["global_concurrency_limit"]["active_slots"])


def stop(worker: subprocess.Popen[str]) -> str:
    """End a worker by SIGTERM; what it wrote to standard error."""
    worker.terminate()
    text = worker.communicate(timeout=60.0)[1]
    assert worker.returncode == 130, text
    return text
