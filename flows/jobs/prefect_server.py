"""Prefect's server: the user's own where there is one, else one that all commands share.

`PREFECT_API_URL` set: that server is used as it is, with the user's own login. Otherwise one server
on loopback, started in the background by the first command that needs it and found again by the
next through `server.json`. It ends by itself when no command has used it for a while: each command
holds the lock of a file in `users/`, which is free when it dies. Its keeper also tells it of runs
that died without a word. Nothing here imports Prefect.

Loopback is open to every account of a machine, so the shared server asks for a login: a random
secret in a file that its owner alone can read, in a folder of the same kind. It reaches processes
by file and environment, never by a command line, and is sent to nobody but a process of the same
user. Folders are named for host and user: a home may be shared by several machines.
"""

from __future__ import annotations

import json
import os
import re
import secrets
import signal
import socket
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit

from modetune.adapters import supervisor
from modetune.core.errors import StorageUnavailable
from modetune.core.storage.files import storage_errors
from modetune.core.storage.locks import FileLock
from modetune.flows.campaign.site import HOME_VARIABLE as HOME_VARIABLE
from modetune.flows.campaign.site import machine_home as machine_home
from modetune.flows.campaign.site import server_home as server_home
from modetune.flows.jobs.heartbeats import BEAT_S, SilentRuns
from modetune.flows.jobs.prefect_api import PATIENCE_S, PROBE_S, Answer, PrefectApi, ServerRefused

#: What became of a request to end the shared server.
Stopped = Literal["stopped", "none", "in use"]
#: Seconds without a user after which the shared server ends.
IDLE_VARIABLE = "MODETUNE_SERVER_IDLE_S"
IDLE_S = 900.0
#: A machine whose cores are all taken ten times over needs two minutes and more.
START_PATIENCE_S = 300.0
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
    # A slot that a killed campaign held is free at once when its lease has run out.
    "PREFECT_SERVER_SERVICES_REPOSSESSOR_LOOP_SECONDS": "5",
    "PREFECT_LOGGING_LEVEL": "CRITICAL",
    "PREFECT_LOGGING_INTERNAL_LEVEL": "CRITICAL",
}  # fmt: skip


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
    """The use of a server by this process, until `close` or the end of the process.

    use: the lock that tells of it; None for the user's own server. login: of the shared server.
    """

    home: Path
    address: Address
    use: FileLock | None
    login: str | None = None

    def wait(self) -> Answer:
        """Wait until something answers; what that is, or that nothing did in good time."""
        deadline = time.monotonic() + (START_PATIENCE_S if self.shared else NAMED_PATIENCE_S)
        while (found := self.answer()) == "does not answer":
            if time.monotonic() > deadline or (self.shared and not is_keeper(self.address.pid)):
                break
            time.sleep(0.1)
        return found

    def told(self, found: Answer) -> str:
        """What stands at the address in place of a server that could be used, and what to do."""
        if self.shared:
            return f"Prefect's server {found} (its log is in {self.home})"
        remedy = {
            "asks for a login": "; set PREFECT_API_AUTH_STRING=name:password to that of its users",
            "is not a Prefect server": "; set PREFECT_API_URL to a server's .../api, or unset it",
        }.get(found, "")
        return f"{self.address.shown}, named by PREFECT_API_URL, {found}{remedy}"

    def answer(self) -> Answer:
        """What stands at the server's address now. Another user's process is told no secret."""
        if self.shared and not is_ours(self.address.url):
            return "does not answer"
        with self.api(PROBE_S) as api:
            return api.answer()

    def api(self, patience_s: float = PATIENCE_S) -> PrefectApi:
        """Its interface, for this user."""
        return PrefectApi(self.address.url, self.login, patience_s)

    @property
    def pages(self) -> str:
        """Where people look at it."""
        return self.address.shown.removesuffix("/api")

    @property
    def shared(self) -> bool:
        """Whether it is modetune's own and not one the user named."""
        return self.use is not None

    def close(self) -> None:
        """End the use; the server lives on for others, and for a while."""
        if self.use is not None:
            self.use.remove()
            self.use.release()


def use_server() -> SharedServer:
    """Find or start the server; does not wait for it to answer.

    Raises StorageUnavailable where its folder cannot be written.
    """
    home = server_home()
    named = os.environ.get("PREFECT_API_URL")
    if named:
        return SharedServer(home, Address(named, 0), None)
    remedy = f"name another place with {HOME_VARIABLE}, or use --no-prefect"
    with storage_errors(home / "server.json", remedy):
        make_private(home)
        with _gate(home):
            use = _new_use(home)
            login = read_login(home)
            address = read_address(home)
            if address is None or not is_keeper(address.pid):
                address = _start(home)
    return SharedServer(home, address, use, login)


def make_private(folder: Path) -> None:
    """A folder that its owner alone can enter. Raises OSError, StorageUnavailable."""
    folder.parent.parent.mkdir(parents=True, exist_ok=True)
    folder.parent.mkdir(mode=0o700, exist_ok=True)
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid():
        raise StorageUnavailable(
            f"{folder} is not a folder of the user with number {os.getuid()}; remove it, or name "
            f"another place with {HOME_VARIABLE}"
        )
    if stat.S_IMODE(found.st_mode) != 0o700:
        folder.chmod(0o700)


def read_login(home: Path) -> str:
    """The shared server's login, `name:password`; made where there is none yet."""
    path = home / "login"
    for _ in range(2):
        try:
            login = path.read_text().strip()
        except FileNotFoundError:
            login = ""
        if re.fullmatch(r"modetune:[\w-]{40,}", login):
            path.chmod(0o600)
            return login
        _write_private(path, f"modetune:{secrets.token_urlsafe(32)}\n")
    raise StorageUnavailable(f"{path} cannot be written")


def _write_private(path: Path, text: str) -> None:
    """Put a file that its owner alone can read in place, whole."""
    handle, part = tempfile.mkstemp(dir=path.parent, prefix=".", suffix=".part")  # mode 0600
    with os.fdopen(handle, "w") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    Path(part).replace(path)


def read_address(home: Path) -> Address | None:
    """The address a running server left, or nothing."""
    try:
        told = json.loads((home / "server.json").read_text())
        return Address(str(told["url"]), int(told["pid"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None


def is_ours(url: str) -> bool:
    """Whether a process of this user listens at an address of this machine."""
    port = f":{urlsplit(url).port or 0:04X}"
    lines = (line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:])
    listeners = {line[7] for line in lines if line[3] == "0A" and line[1].endswith(port)}
    return listeners == {str(os.getuid())}


def stop_server(home: Path) -> Stopped:
    """End the shared server unless a campaign uses it."""
    address = read_address(home)
    if address is None or not is_keeper(address.pid):
        return "none"
    with _gate(home):
        if _in_use(home):
            return "in use"
    os.kill(address.pid, signal.SIGTERM)
    deadline = time.monotonic() + 10.0
    while is_keeper(address.pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    return "stopped"


def _gate(home: Path) -> AbstractContextManager[None]:
    """Nobody else starts, ends or begins to use the server for as long as this is held."""
    return FileLock(home / "server.lock").held(lambda: time.sleep(0.05))


def _new_use(home: Path) -> FileLock:
    folder = home / "users"
    folder.mkdir(mode=0o700, exist_ok=True)
    use = FileLock(folder / f"{os.getpid()}-{secrets.token_hex(4)}.lock")
    use.take()
    return use


def _in_use(home: Path) -> bool:
    """Whether a living process uses the server; what dead ones left is removed."""
    for path in (home / "users").glob("*.lock"):
        with FileLock(path) as use:
            if not use.take():
                return True
            use.remove()
    return False


def is_keeper(pid: int) -> bool:
    """Whether a process is a living keeper of ours: numbers are given out again, and an ended
    child that nobody has waited for has no command line."""
    for _ in range(5):
        try:
            line = Path(f"/proc/{pid}/cmdline").read_bytes()
        except OSError:
            return False
        if line:
            return b"modetune.flows.jobs.prefect_server" in line
        time.sleep(0.05)  # one that is just being started has none yet either
    return False


def _start(home: Path) -> Address:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    with (home / "server.log").open("wb") as log:
        keeper = subprocess.Popen(
            [sys.executable, "-m", "modetune.flows.jobs.prefect_server", str(home), str(port)],
            cwd=home,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
    address = Address(f"http://127.0.0.1:{port}/api", keeper.pid)
    _write_private(home / "server.json", json.dumps({"url": address.url, "pid": address.pid}))
    return address


def keep(home: Path, port: int) -> None:
    """Run a server until nobody has used it for a while, or until SIGTERM."""
    os.umask(0o077)
    environment = {
        **os.environ,
        **SETTINGS,
        "PREFECT_HOME": str(home / "prefect"),
        "PREFECT_SERVER_API_PORT": str(port),
        "PREFECT_SERVER_API_AUTH_STRING": read_login(home),
        "PREFECT_SERVER_API_CSRF_PROTECTION_ENABLED": "true",
        # Pages of other places that the user has open in a browser have no business here.
        "PREFECT_SERVER_API_CORS_ALLOWED_ORIGINS": f"http://127.0.0.1:{port}",
    }
    for name in ("PREFECT_API_URL", "PREFECT_API_AUTH_STRING", "PREFECT_API_KEY"):
        environment.pop(name, None)
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(0))
    # Below a supervisor with a pipe to this process, so that no end of ours leaves it behind.
    server = subprocess.Popen(
        [sys.executable, "-I", "-S", supervisor.__file__, "prefect.log", str(sys.maxsize),
         sys.executable, "-m", "prefect", "server", "start",
         "--host", "127.0.0.1", "--port", str(port)],
        cwd=home, env=environment, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL,
        start_new_session=True,
    )  # fmt: skip
    try:
        _wait_for_idleness(home, f"http://127.0.0.1:{port}/api", server)
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


def _wait_for_idleness(home: Path, url: str, server: subprocess.Popen[bytes]) -> None:
    limit = float(os.environ.get(IDLE_VARIABLE, IDLE_S))
    used = looked = time.monotonic()
    watch = SilentRuns()
    while server.poll() is None:
        time.sleep(min(1.0, limit))
        if time.monotonic() - looked > BEAT_S:
            looked = time.monotonic()
            try:
                with PrefectApi(url, read_login(home)) as api:
                    watch.look(api)
            except ServerRefused:
                watch = SilentRuns()  # a server that did not answer heard nobody meanwhile
        with _gate(home):
            if _in_use(home):
                used = time.monotonic()
            elif time.monotonic() - used > limit:
                _end(home, server)
                return
    sys.stderr.write(f"Prefect's server ended by itself with code {server.returncode}\n")


if __name__ == "__main__":
    keep(Path(sys.argv[1]), int(sys.argv[2]))
