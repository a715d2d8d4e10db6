"""Prefect's server: the user's own where there is one, else one that all commands share.

`PREFECT_API_URL` set: that server is used as it is. Otherwise one server on loopback, started in
the background by the first command that needs it and found again by the next through
`server.json`. It ends by itself when no command has used it for a while: each user holds a shared
lock that the kernel frees when it dies. Nothing here imports Prefect; the settings must stand in
the environment before anything does.
"""

from __future__ import annotations

import fcntl
import json
import logging
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Literal

from modetune.adapters.process import SUPERVISOR
from modetune.core.store import locked, storage_errors

logger = logging.getLogger(__name__)

#: What became of a request to end the shared server.
Stopped = Literal["stopped", "none", "in use"]
#: Where the shared server keeps its database, log and address.
HOME_VARIABLE = "MODETUNE_HOME"
#: Seconds without a user after which the shared server ends.
IDLE_VARIABLE = "MODETUNE_SERVER_IDLE_S"
IDLE_S = 900.0
PATIENCE_S = 120.0
#: A server that the user named is up already or it is not.
NAMED_PATIENCE_S = 10.0

#: Quiet, offline, and fit for many small task runs on SQLite.
SETTINGS: Mapping[str, str] = {
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_UI_SHOW_PROMOTIONAL_CONTENT": "false",
    "PREFECT_SERVER_CONCURRENCY_LEASE_STORAGE":
        "prefect.server.concurrency.lease_storage.filesystem",
    "PREFECT_SERVER_SERVICES_TASK_RUN_RECORDER_BATCH_SIZE": "100",
    "PREFECT_SERVER_SERVICES_TASK_RUN_RECORDER_READ_BATCH_SIZE": "100",
    # Whole seconds: Prefect 3.8.8 cuts 0.5 down to 0, and an idle server then never sleeps.
    "PREFECT_SERVER_SERVICES_TASK_RUN_RECORDER_FLUSH_INTERVAL": "1",
    "PREFECT_LOGGING_LEVEL": "CRITICAL",
    "PREFECT_LOGGING_INTERNAL_LEVEL": "CRITICAL",
    "PREFECT_LOGGING_TO_API_ENABLED": "false",
    # A server that is gone is asked for 14 s, not for 62, before a campaign goes on without it.
    "PREFECT_CLIENT_MAX_RETRIES": "3",
    "PREFECT_CLI_PROMPT": "false",
}  # fmt: skip


def server_home() -> Path:
    """The folder of the shared server."""
    named = os.environ.get(HOME_VARIABLE)
    if named:
        return Path(named)
    base = os.environ.get("XDG_DATA_HOME") or str(Path.home() / ".local" / "share")
    return Path(base) / "modetune"


@dataclass(frozen=True, slots=True)
class Address:
    """Where a shared server answers, and the process that keeps it."""

    url: str
    pid: int

    @property
    def shown(self) -> str:
        """The URL without a user's name and password, for people and logs."""
        before, _, rest = self.url.partition("://")
        host, slash, path = rest.partition("/")
        return f"{before}://{host.rpartition('@')[2]}{slash}{path}"


@dataclass(slots=True)
class SharedServer:
    """The use of a server by this process, until `close` or the end of the process."""

    home: Path
    address: Address
    users: IO[str] | None

    def wait(self) -> bool:
        """Wait until the server answers; False where it does not in good time."""
        deadline = time.monotonic() + (PATIENCE_S if self.shared else NAMED_PATIENCE_S)
        while time.monotonic() < deadline:
            if answers(self.address.url):
                return True
            if self.shared and not is_keeper(self.address.pid):
                return False
            time.sleep(0.1)
        return False

    @property
    def shared(self) -> bool:
        """Whether it is modetune's own and not one the user named."""
        return self.users is not None

    def close(self) -> None:
        """End the use; the server lives on for others, and for a while."""
        if self.users is not None:
            self.users.close()


def use_server() -> SharedServer:
    """Find or start the server and set the environment for it; does not wait for it to answer.

    Raises StorageUnavailable where its folder cannot be written.
    """
    for name, value in SETTINGS.items():
        os.environ.setdefault(name, value)
    home = server_home()
    named = os.environ.get("PREFECT_API_URL")
    if named:
        return SharedServer(home, Address(named, 0), None)
    remedy = f"name another place with {HOME_VARIABLE}, or use --no-prefect"
    with storage_errors(home / "server.json", remedy):
        home.mkdir(parents=True, exist_ok=True)
        users = (home / "users.lock").open("w")
        fcntl.flock(users, fcntl.LOCK_SH)
        with (home / "server.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            address = read_address(home)
            if address is None or not is_keeper(address.pid):
                address = _start(home)
    os.environ["PREFECT_HOME"] = str(home / "prefect")
    os.environ["PREFECT_API_URL"] = address.url
    return SharedServer(home, address, users)


def read_address(home: Path) -> Address | None:
    """The address a running server left, or nothing."""
    try:
        told = json.loads((home / "server.json").read_text())
        return Address(str(told["url"]), int(told["pid"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None


def answers(url: str) -> bool:
    """Whether a Prefect server answers at this address."""
    try:
        with urllib.request.urlopen(f"{url}/health", timeout=2.0) as reply:
            return bool(reply.status == 200)
    except (urllib.error.URLError, OSError, ValueError):
        return False


def stop_server(home: Path) -> Stopped:
    """End the shared server unless a campaign uses it."""
    address = read_address(home)
    if address is None or not is_keeper(address.pid):
        return "none"
    with (home / "users.lock").open("w") as users:
        if not locked(users):
            return "in use"
    os.kill(address.pid, signal.SIGTERM)
    deadline = time.monotonic() + 10.0
    while is_keeper(address.pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    return "stopped"


def is_keeper(pid: int) -> bool:
    """Whether a process is a living keeper of ours: numbers are given out again, and an ended
    child that nobody has waited for has no command line."""
    for _ in range(5):
        try:
            line = Path(f"/proc/{pid}/cmdline").read_bytes()
        except OSError:
            return False
        if line:
            return b"modetune.flows.server.process" in line
        time.sleep(0.05)  # one that is just being started has none yet either
    return False


def _start(home: Path) -> Address:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    with (home / "server.log").open("wb") as log:
        keeper = subprocess.Popen(
            [sys.executable, "-m", "modetune.flows.server.process", str(home), str(port)],
            cwd=home,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
    address = Address(f"http://127.0.0.1:{port}/api", keeper.pid)
    (home / "server.json").write_text(json.dumps({"url": address.url, "pid": address.pid}))
    return address


def keep(home: Path, port: int) -> None:
    """Run a server until nobody has used it for a while, or until SIGTERM."""
    environment = {
        **os.environ,
        **SETTINGS,
        "PREFECT_HOME": str(home / "prefect"),
        "PREFECT_SERVER_API_PORT": str(port),
    }
    environment.pop("PREFECT_API_URL", None)
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(0))
    # Below a supervisor with a pipe to this process, so that no end of ours leaves it behind.
    server = subprocess.Popen(
        [sys.executable, "-I", "-S", str(SUPERVISOR), "prefect.log",
         sys.executable, "-m", "prefect", "server", "start",
         "--host", "127.0.0.1", "--port", str(port)],
        cwd=home, env=environment, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL,
        start_new_session=True,
    )  # fmt: skip
    try:
        _wait_for_idleness(home, server)
    finally:
        _end(home, server)


def _end(home: Path, server: subprocess.Popen[bytes]) -> None:
    """End the server, and take its address away unless another server's stands there by now."""
    assert server.stdin is not None
    server.stdin.close()
    server.wait()
    address = read_address(home)
    if address is not None and address.pid == os.getpid():
        (home / "server.json").unlink(missing_ok=True)


def _wait_for_idleness(home: Path, server: subprocess.Popen[bytes]) -> None:
    limit = float(os.environ.get(IDLE_VARIABLE, IDLE_S))
    used = time.monotonic()
    while server.poll() is None:
        time.sleep(min(1.0, limit))
        with (home / "server.lock").open("w") as lock, (home / "users.lock").open("w") as users:
            fcntl.flock(lock, fcntl.LOCK_EX)  # nobody may come to use it in between
            if not locked(users):
                used = time.monotonic()
            elif time.monotonic() - used > limit:
                _end(home, server)
                return
    sys.stderr.write(f"Prefect's server ended by itself with code {server.returncode}\n")


if __name__ == "__main__":
    keep(Path(sys.argv[1]), int(sys.argv[2]))
