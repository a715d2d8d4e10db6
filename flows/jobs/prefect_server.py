"""Prefect's server: the user's own where one is configured, else one that all commands share.

PREFECT_API_URL, in the environment or in Prefect's active profile, names the user's own, which is
used as it is with the user's login. Otherwise one server on loopback serves all commands of a user:
the first one that needs it starts it in the background, and the next finds it in `server.json`. It
ends when no command has used it for a while: each command holds the lock of a file in `users/`,
which is free when the command dies. Its keeper marks runs that died. Nothing here imports Prefect.

Loopback is open to every account of a machine, so the shared server asks for a login: a random
secret in a file that its owner alone can read, in a folder of the same kind. It reaches processes
by file and environment, never by a command line, and only a process of the same user receives it.
Folders are named for host and user: a home may be shared by several machines.
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
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, overload
from urllib.parse import unquote, urlsplit

from modetune.adapters import supervisor
from modetune.core.errors import StorageUnavailable
from modetune.core.storage.files import storage_errors
from modetune.core.storage.locks import FileLock
from modetune.flows.campaign.site import HOME_VARIABLE as HOME_VARIABLE
from modetune.flows.campaign.site import machine_home as machine_home
from modetune.flows.campaign.site import server_home as server_home
from modetune.flows.jobs.server_client import (
    PROBE_S,
    Answer,
    ServerClient,
    ServerRefused,
    prefect_setting,
)
from modetune.flows.jobs.silent_runs import LOOK_S, SilentRuns

#: The outcome of a request to end the shared server.
Stopped = Literal["stopped", "none", "in use"]
#: Seconds without a user after which the shared server ends.
IDLE_VARIABLE = "MODETUNE_SERVER_IDLE_S"
IDLE_S = 900.0
#: Seconds until the shared server answers on a machine whose cores are overloaded tenfold.
START_PATIENCE_S = 300.0
#: The server that the user configured is up already or it is not.
CONFIGURED_PATIENCE_S = 10.0
#: Seconds for which another process may start, end or begin to use the server.
GATE_S = 10.0

#: Quiet and offline, for the server and its clients.
QUIET: Mapping[str, str] = {
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "DO_NOT_TRACK": "1",
    "PREFECT_LOGGING_LEVEL": "CRITICAL",
    "PREFECT_LOGGING_INTERNAL_LEVEL": "CRITICAL",
}
#: Fit for many small task runs on SQLite.
SETTINGS: Mapping[str, str] = {
    **QUIET,
    "PREFECT_SERVER_UI_SHOW_PROMOTIONAL_CONTENT": "false",
    "PREFECT_SERVER_CONCURRENCY_LEASE_STORAGE":
        "prefect.server.concurrency.lease_storage.filesystem",
    "PREFECT_SERVER_SERVICES_TASK_RUN_RECORDER_BATCH_SIZE": "100",
    "PREFECT_SERVER_SERVICES_TASK_RUN_RECORDER_READ_BATCH_SIZE": "100",
    # Whole seconds: Prefect 3.8.8 cuts 0.5 down to 0, and an idle server then never sleeps.
    "PREFECT_SERVER_SERVICES_TASK_RUN_RECORDER_FLUSH_INTERVAL": "1",
    # A slot that a killed campaign held is free at once when its lease has run out.
    "PREFECT_SERVER_SERVICES_REPOSSESSOR_LOOP_SECONDS": "5",
}  # fmt: skip


#: Variables of the user's that would lead a process to another server than the shared one.
FOREIGN = (
    "PREFECT_API_URL", "PREFECT_API_AUTH_STRING", "PREFECT_API_KEY", "PREFECT_PROFILE",
    "PREFECT_PROFILES_PATH",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Address:
    """Where a server answers, without a name and password, and the process that keeps it."""

    url: str
    pid: int


@dataclass(slots=True)
class SharedServer:
    """The use of a server by this process, until `close` or the end of the process.

    use: the lock that shows others this use; None for the user's own server. login:
    `name:password`; key: the API key of the user's own server.
    """

    home: Path
    address: Address
    use: FileLock | None
    login: str | None = None
    key: str | None = None
    client: ServerClient = field(init=False)

    def __post_init__(self) -> None:
        self.client = ServerClient(self.address.url, self.login, self.key)

    def wait(
        self, seconds: float = START_PATIENCE_S, waiting: Callable[[float], None] | None = None
    ) -> Answer:
        """Wait until the address answers, so many seconds at most; return the last answer.

        waiting: called about once a second with the seconds waited.
        """
        if not self.shared:
            seconds = min(seconds, CONFIGURED_PATIENCE_S)
        began, shown = time.monotonic(), 0
        while (found := self.answer(max(0.5, began + seconds - time.monotonic()))) == (
            "does not answer"
        ):
            waited = time.monotonic() - began
            if waited > seconds or (self.shared and not is_keeper(self.address.pid)):
                break
            if waiting is not None and int(waited) > shown:
                shown = int(waited)
                waiting(waited)
            time.sleep(0.1)
        return found

    def describe(self, answer: Answer) -> str:
        """Return the sentence about an address that gave this answer, and what to do."""
        if self.shared:
            return f"Prefect's server {answer} (its log is in {self.home})"
        remedy = {
            "asks for a login": "; set PREFECT_API_AUTH_STRING=name:password to that of its users",
            "is not a Prefect server": "; set PREFECT_API_URL to a server's .../api, or unset it",
        }.get(answer, "")
        return f"{self.address.url}, named by PREFECT_API_URL, {answer}{remedy}"

    def answer(self, seconds: float = PROBE_S) -> Answer:
        """Probe the address, PROBE_S at most. A process of another user receives no secret."""
        if self.shared and not is_ours(self.address.url):
            return "does not answer"
        return self.client.answer(min(seconds, PROBE_S))

    def settings(self) -> dict[str, str]:
        """Return the environment variables that make Prefect a client of this server.

        A client of the shared server neither reads nor writes the user's own Prefect folder. What
        the user set for logging holds.
        """
        chosen = {
            "PREFECT_API_URL": self.address.url,
            "PREFECT_SERVER_ALLOW_EPHEMERAL_MODE": "false",
            **{name: os.environ.get(name, value) for name, value in QUIET.items()},
        }
        if self.login:
            chosen["PREFECT_API_AUTH_STRING"] = self.login
        if self.key:
            chosen["PREFECT_API_KEY"] = self.key
        if self.shared:
            folder = self.home / "client"
            chosen |= {
                "PREFECT_HOME": str(folder),
                "PREFECT_PROFILES_PATH": str(folder / "profiles.toml"),
                "PREFECT_PROFILE": "ephemeral",
                "PREFECT_API_KEY": "",
                "PREFECT_CLIENT_CSRF_SUPPORT_ENABLED": "true",
            }
        return chosen

    @property
    def pages(self) -> str:
        """Where people look at it."""
        return self.address.url.removesuffix("/api")

    @property
    def shared(self) -> bool:
        """Whether it is modetune's own and not one that the user configured."""
        return self.use is not None

    def close(self) -> None:
        """End the use; the server lives on for others, and for a while."""
        if self.use is not None:
            self.use.remove()
            self.use.release()


def configured_server() -> SharedServer | None:
    """Return the server that PREFECT_API_URL names, in the environment or the active profile."""
    url = prefect_setting("PREFECT_API_URL")
    if not url:
        return None
    parts = urlsplit(url)
    user, _, host = parts.netloc.rpartition("@")
    address = Address(parts._replace(netloc=host).geturl().rstrip("/"), 0)
    login = prefect_setting("PREFECT_API_AUTH_STRING") or unquote(user)
    return SharedServer(server_home(), address, None, login, prefect_setting("PREFECT_API_KEY"))


def running_address(home: Path) -> Address | None:
    """Return the address of the shared server whose keeper lives, or nothing."""
    address = read_address(home)
    return address if address is not None and is_keeper(address.pid) else None


@overload
def use_server(start: Literal[True] = True) -> SharedServer: ...
@overload
def use_server(start: bool) -> SharedServer | None: ...
def use_server(start: bool = True) -> SharedServer | None:
    """Find the server, or start the shared one; does not wait for it to answer.

    start: whether to start it; without, a server that is configured or runs, else None. Raises
    StorageUnavailable where the folder of the shared server cannot be written.
    """
    configured = configured_server()
    if configured is not None:
        return configured
    home = server_home()
    if not start and running_address(home) is None:
        return None
    remedy = f"name another place with {HOME_VARIABLE}, or use --no-prefect"
    with storage_errors(home / "server.json", remedy):
        make_private(home)
        with _gate(home):
            login = read_login(home)
            address = running_address(home) or _start(home)
            use = _new_use(home)
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
    try:
        with os.fdopen(handle, "w") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        Path(part).replace(path)
    except OSError:
        Path(part).unlink(missing_ok=True)
        raise


def read_address(home: Path) -> Address | None:
    """The address a running server left, or nothing."""
    try:
        saved = json.loads((home / "server.json").read_text())
        return Address(str(saved["url"]), int(saved["pid"]))
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
    address = running_address(home)
    if address is None:
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
    """Keep others from starting, ending or beginning to use the server while this is held."""
    deadline = time.monotonic() + GATE_S

    def wait() -> None:
        if time.monotonic() > deadline:
            raise StorageUnavailable(
                f"another process has held {home / 'server.lock'} for {GATE_S:.0f} s; end it, or "
                "use --no-prefect"
            )
        time.sleep(0.05)

    return FileLock(home / "server.lock").held(wait)


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
    module = "modetune.flows.jobs.prefect_server"
    with (home / "server.log").open("wb") as log, Path(os.devnull).open("rb") as nothing:
        keeper = os.posix_spawn(  # not Popen, which warns of a child that outlives it
            sys.executable,
            [sys.executable, "-P", "-m", module, str(home), str(port)],
            os.environ,
            file_actions=[
                (os.POSIX_SPAWN_DUP2, nothing.fileno(), 0),
                (os.POSIX_SPAWN_DUP2, log.fileno(), 1),
                (os.POSIX_SPAWN_DUP2, log.fileno(), 2),
            ],
            setsid=True,
        )
    address = Address(f"http://127.0.0.1:{port}/api", keeper)
    try:
        _write_private(home / "server.json", json.dumps({"url": address.url, "pid": address.pid}))
    except OSError:
        os.kill(keeper, signal.SIGKILL)  # nobody would find it
        os.waitpid(keeper, 0)
        raise
    return address


def keep(home: Path, port: int) -> None:
    """Run a server until nobody has used it for a while, or until SIGTERM."""
    os.umask(0o077)
    os.chdir(home)
    environment = {
        **os.environ,
        **SETTINGS,
        "PREFECT_HOME": str(home / "prefect"),
        # Prefect copies its pages there; by default into its own package, for one user alone.
        "PREFECT_UI_STATIC_DIRECTORY": str(home / "pages"),
        "PREFECT_SERVER_API_PORT": str(port),
        "PREFECT_SERVER_API_AUTH_STRING": read_login(home),
        "PREFECT_SERVER_API_CSRF_PROTECTION_ENABLED": "true",
        # Pages of other places that the user has open in a browser have no business here.
        "PREFECT_SERVER_API_CORS_ALLOWED_ORIGINS": f"http://127.0.0.1:{port}",
    }
    for name in FOREIGN:
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
    """End the server and remove its address, unless another server has written its own."""
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
    client = ServerClient(url, read_login(home))
    while server.poll() is None:
        time.sleep(min(1.0, limit))
        if time.monotonic() - looked > LOOK_S:
            looked = time.monotonic()
            try:
                watch.look(client)
            except ServerRefused:
                watch = SilentRuns()  # a server that did not answer received no heartbeat either
        with _gate(home):
            if _in_use(home):
                used = time.monotonic()
            elif time.monotonic() - used > limit:
                _end(home, server)
                return
    sys.stderr.write(f"Prefect's server ended unexpectedly with code {server.returncode}\n")


if __name__ == "__main__":
    keep(Path(sys.argv[1]), int(sys.argv[2]))
