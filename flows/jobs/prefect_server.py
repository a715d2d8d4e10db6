"""Prefect's server: the one the user configured, or one shared by all commands of a user.

PREFECT_API_URL, in the environment or in Prefect's active profile, names the configured server,
which is used with the user's login. Otherwise the first command starts a server on loopback in the
background, and later ones find its address in `server.json`. Each command holds the lock of a file
in `users/`, which the system releases when the command dies; the server's keeper ends it after
some time without users, and marks dead runs as crashed. Nothing here imports Prefect.

Every account of a machine can connect to loopback, so the shared server requires a login: a random
secret in a file and folder that only the owner can read. Processes of the same user receive it by
file or environment, never on a command line. Folder names contain host and user, because several
machines may share a home folder.
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
from modetune.core.errors import ModetuneError, StorageUnavailable
from modetune.core.machine import ELSEWHERE, is_linux
from modetune.core.storage.files import storage_errors
from modetune.core.storage.locks import FileLock
from modetune.flows.campaign.site import HOME_VARIABLE as HOME_VARIABLE
from modetune.flows.campaign.site import machine_home as machine_home
from modetune.flows.campaign.site import server_home as server_home
from modetune.flows.jobs.heartbeats import LOOK_S, HeartbeatWatch
from modetune.flows.jobs.server_client import (
    PROBE_S,
    Answer,
    ServerClient,
    ServerRefused,
    prefect_setting,
)
from modetune.flows.jobs.server_database import compact, database_of, keep_s, retention_settings

#: The outcome of a request to end the shared server.
Stopped = Literal["stopped", "none", "in use"]
#: Seconds without a user after which the shared server ends.
IDLE_VARIABLE = "MODETUNE_SERVER_IDLE_S"
IDLE_S = 900.0
#: Seconds until the shared server answers on a machine with tenfold overload.
START_PATIENCE_S = 300.0
#: Seconds until a configured server, which should be running already, answers.
CONFIGURED_PATIENCE_S = 10.0
#: Seconds that another process may take to start, end or begin to use the server.
GATE_S = 10.0

#: Settings of server and clients: no telemetry, almost no log.
QUIET: Mapping[str, str] = {
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "DO_NOT_TRACK": "1",
    "PREFECT_LOGGING_LEVEL": "CRITICAL",
    "PREFECT_LOGGING_INTERNAL_LEVEL": "CRITICAL",
}
#: Settings of the server, for many small task runs on SQLite.
SETTINGS: Mapping[str, str] = {
    **QUIET,
    "PREFECT_SERVER_UI_SHOW_PROMOTIONAL_CONTENT": "false",
    "PREFECT_SERVER_CONCURRENCY_LEASE_STORAGE":
        "prefect.server.concurrency.lease_storage.filesystem",
    "PREFECT_SERVER_SERVICES_TASK_RUN_RECORDER_BATCH_SIZE": "100",
    "PREFECT_SERVER_SERVICES_TASK_RUN_RECORDER_READ_BATCH_SIZE": "100",
    # Whole seconds: Prefect 3.8.8 truncates 0.5 to 0, and an idle server then never sleeps.
    "PREFECT_SERVER_SERVICES_TASK_RUN_RECORDER_FLUSH_INTERVAL": "1",
    # Free the slots of a killed campaign soon after their lease has expired.
    "PREFECT_SERVER_SERVICES_REPOSSESSOR_LOOP_SECONDS": "5",
}  # fmt: skip


#: User variables that would direct a process to a server other than the shared one.
FOREIGN = (
    "PREFECT_API_URL", "PREFECT_API_AUTH_STRING", "PREFECT_API_KEY", "PREFECT_PROFILE",
    "PREFECT_PROFILES_PATH", "PREFECT_API_DATABASE_CONNECTION_URL",
    "PREFECT_SERVER_DATABASE_CONNECTION_URL",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Address:
    """The address of a server, without login, and the process id of its keeper."""

    url: str
    pid: int


@dataclass(slots=True)
class SharedServer:
    """A server used by this process until `close`.

    use is the lock that shows this use to others, None for a configured server; login is
    `name:password`; key is the API key of a configured server.
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
        """Wait until the address answers, at most `seconds`; return the last answer.

        waiting is called about once a second with the seconds waited.
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
        """Return a sentence on an address that gave this answer, with a remedy."""
        if self.shared:
            return f"Prefect's server {answer} (its log is in {self.home})"
        remedy = {
            "asks for a login": "; set PREFECT_API_AUTH_STRING=name:password to that of its users",
            "is not a Prefect server": "; set PREFECT_API_URL to a server's .../api, or unset it",
        }.get(answer, "")
        return f"{self.address.url}, named by PREFECT_API_URL, {answer}{remedy}"

    def answer(self, seconds: float = PROBE_S) -> Answer:
        """Probe the address for at most PROBE_S; send no secret to another user's process."""
        if self.shared and not is_ours(self.address.url):
            return "does not answer"
        return self.client.answer(min(seconds, PROBE_S))

    def settings(self) -> dict[str, str]:
        """Return the environment variables that make Prefect a client of this server.

        A client of the shared server does not touch the user's Prefect folder. The user's logging
        settings apply.
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
        """The address of its web pages."""
        return self.address.url.removesuffix("/api")

    @property
    def entrance(self) -> str:
        """Where the login is that the pages ask for, in brackets; empty for a configured server."""
        return f" (the login is in {self.home / 'login'})" if self.shared else ""

    @property
    def shared(self) -> bool:
        """Whether it is modetune's shared server, not one that the user configured."""
        return self.use is not None

    def close(self) -> None:
        """End the use; the server continues for other processes."""
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
    """Find the server, or start the shared one, without waiting until it answers.

    Without start, return None if no server is configured or running. Raises StorageUnavailable if
    the folder of the shared server cannot be written.
    """
    return configured_server() or (
        shared_server() if start or running_address(server_home()) is not None else None
    )


def shared_server() -> SharedServer:
    """Use the shared server; start it if necessary. Raises StorageUnavailable, ModetuneError."""
    if not is_linux():
        raise ModetuneError(f"Prefect's shared server: {ELSEWHERE}")
    home = server_home()
    remedy = f"name another place with {HOME_VARIABLE}, or use --no-prefect"
    with storage_errors(home / "server.json", remedy):
        make_private(home)
        with _gate(home):
            login = read_login(home)
            address = running_address(home) or _start(home)
            use = _new_use(home)
    return SharedServer(home, address, use, login)


def make_private(folder: Path) -> None:
    """Create a folder that only its owner can enter. Raises OSError, StorageUnavailable."""
    folder.parent.parent.mkdir(parents=True, exist_ok=True)
    folder.parent.mkdir(mode=0o700, exist_ok=True)
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid():
        raise StorageUnavailable(
            f"{folder} is not a folder owned by user {os.getuid()}; remove it or choose another "
            f"place with {HOME_VARIABLE}"
        )
    if stat.S_IMODE(found.st_mode) != 0o700:
        folder.chmod(0o700)


def read_login(home: Path) -> str:
    """Return the shared server's login, `name:password`; create it if there is none."""
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
    """Atomically write a file that only its owner can read."""
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
    """Return the address that a running server recorded, None without one."""
    try:
        saved = json.loads((home / "server.json").read_text())
        return Address(str(saved["url"]), int(saved["pid"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None


def is_ours(url: str) -> bool:
    """Return whether a process of this user listens at a local address."""
    port = f":{urlsplit(url).port or 0:04X}"
    lines = (line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:])
    listeners = {line[7] for line in lines if line[3] == "0A" and line[1].endswith(port)}
    return listeners == {str(os.getuid())}


def stop_server(home: Path) -> Stopped:
    """Stop the shared server unless a campaign uses it."""
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
                f"another process has held {home / 'server.lock'} for {GATE_S:.0f} s; stop it or "
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
    """Whether a living process uses the server; removes the locks of dead ones."""
    for path in (home / "users").glob("*.lock"):
        with FileLock(path) as use:
            if not use.take():
                return True
            use.remove()
    return False


def compact_unused(home: Path) -> bool:
    """Return free space of the database to the disk, unless a campaign uses the server."""
    with _gate(home):
        return not _in_use(home) and compact(database_of(home))


def is_keeper(pid: int) -> bool:
    """Return whether a process is a living keeper.

    Process ids are reused, and a zombie has no command line.
    """
    for _ in range(5):
        try:
            line = Path(f"/proc/{pid}/cmdline").read_bytes()
        except OSError:
            return False
        if line:
            return b"modetune.flows.jobs.prefect_server" in line
        time.sleep(0.05)  # a process that is just starting has none yet either
    return False


def _free_port(home: Path) -> int:
    """Return the previous server's port, so that its clients find the new one, or any free port."""
    before = read_address(home)
    ports = [urlsplit(before.url).port or 0, 0] if before is not None else [0]
    for port in ports:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the server does
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                if port:
                    continue  # another process has it
                raise
            return int(probe.getsockname()[1])
    raise AssertionError("the system has no free port")


def _start(home: Path) -> Address:
    keep_s()  # a setting that is not valid is refused here, where it can be read
    port = _free_port(home)
    module = "modetune.flows.jobs.prefect_server"
    with (home / "server.log").open("wb") as log, Path(os.devnull).open("rb") as nothing:
        keeper = os.posix_spawn(  # Popen warns if the child outlives it
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
        os.kill(keeper, signal.SIGKILL)  # without the file no command would find it
        os.waitpid(keeper, 0)
        raise
    return address


def keep(home: Path, port: int) -> None:
    """Run a server until it has had no user for some time, or until SIGTERM."""
    os.umask(0o077)
    os.chdir(home)
    environment = {
        **os.environ,
        **SETTINGS,
        **retention_settings(keep_s()),
        "PREFECT_HOME": str(home / "prefect"),
        # Prefect copies its pages there; the default, its own package, works for one user only.
        "PREFECT_UI_STATIC_DIRECTORY": str(home / "pages"),
        # SQLite's own choice is /var/tmp.
        "SQLITE_TMPDIR": os.environ.get("SQLITE_TMPDIR", tempfile.gettempdir()),
        "PREFECT_SERVER_API_PORT": str(port),
        "PREFECT_SERVER_API_AUTH_STRING": read_login(home),
        "PREFECT_SERVER_API_CSRF_PROTECTION_ENABLED": "true",
        # Web pages of other origins in the user's browser get no access.
        "PREFECT_SERVER_API_CORS_ALLOWED_ORIGINS": f"http://127.0.0.1:{port}",
    }
    for name in FOREIGN:
        environment.pop(name, None)
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(0))
    # The supervisor has a pipe to this process and stops the server when this process ends.
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
        _end(server)


def _end(server: subprocess.Popen[bytes]) -> None:
    """Stop the server; its address remains for the next one."""
    assert server.stdin is not None
    server.stdin.close()
    server.wait()


def _wait_for_idleness(home: Path, url: str, server: subprocess.Popen[bytes]) -> None:
    limit = float(os.environ.get(IDLE_VARIABLE, IDLE_S))
    used = looked = time.monotonic()
    watch = HeartbeatWatch()
    client = ServerClient(url, read_login(home))
    while server.poll() is None:
        time.sleep(min(1.0, limit))
        if time.monotonic() - looked > LOOK_S:
            looked = time.monotonic()
            try:
                watch.look(client)
            except ServerRefused:
                watch = (
                    HeartbeatWatch()
                )  # a server that did not answer received no heartbeat either
        with _gate(home):
            if _in_use(home):
                used = time.monotonic()
            elif time.monotonic() - used > limit:
                _end(server)
                compact(database_of(home))
                return
    sys.stderr.write(f"Prefect's server ended unexpectedly with code {server.returncode}\n")


if __name__ == "__main__":
    keep(Path(sys.argv[1]), int(sys.argv[2]))
