"""The shared server is its owner's alone: seen by its owner, by another user, and by a stranger's
process on its port."""

from __future__ import annotations

import base64
import contextlib
import errno
import http.server
import json
import os
import re
import shutil
import socket
import sqlite3
import stat
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from modetune.core.errors import StorageUnavailable
from modetune.core.storage.locks import FileLock
from modetune.flows.jobs import prefect_server as process
from modetune.flows.jobs.server_client import ServerClient, is_loopback, prefect_setting
from tests.eventually import allowed, eventually
from tests.flows.conftest import SERVER_USER

#: Any account but ours; 65534 is `nobody` on Linux.
STRANGER = 65534
NOT_ROOT = pytest.mark.skipif(os.getuid() != 0, reason="only root can act as another user")

#: Runs as another user, on the standard library alone: what each request is answered.
REQUESTS = """
import json, sys, urllib.error, urllib.request
asked = json.load(sys.stdin)
opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
told = []
for method, path, headers in asked["requests"]:
    request = urllib.request.Request(
        asked["url"] + path, method=method, headers={"Content-Type": "application/json", **headers},
        data=None if method in ("GET", "HEAD") else json.dumps(asked["content"]).encode())
    try:
        with opener.open(request, timeout=30) as reply:
            told.append(reply.status)
    except urllib.error.HTTPError as error:
        told.append(error.code)
print(json.dumps(told))
"""

#: What another user may learn from files and from the list of processes.
SPYING = """
import os, sys
from pathlib import Path
home, seen = Path(sys.argv[1]), []
for path in (home, home / "login", home / "server.json", home / "prefect.log"):
    try:
        os.listdir(path) if path == home else path.read_bytes()
        seen.append(str(path))
    except PermissionError:
        pass
lines = [entry.read_bytes() for entry in Path("/proc").glob("[0-9]*/cmdline")]
print(seen)
sys.stdout.flush()
sys.stdout.buffer.write(b"\\n".join(lines))
"""


class Served:
    """A shared server in a folder that others may enter, so that its own modes must protect it."""

    def __init__(self, base: Path) -> None:
        self.home = process.machine_home(base)
        self.environment = {**os.environ, process.HOME_VARIABLE: str(base)}
        for name in process.FOREIGN:
            self.environment.pop(name, None)
        self.used = self.use()
        found = process.read_address(self.home)
        assert found is not None
        self.url = found.url
        self.login = process.read_login(self.home)

    def use(self, **environment: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-c", SERVER_USER],
            env={**self.environment, **environment},
            capture_output=True,
            text=True,
            timeout=200,
            check=False,
        )

    def owner(self) -> ServerClient:
        return ServerClient(self.url, self.login)


@pytest.fixture(scope="module")
def served(server_base: Path) -> Served:
    return Served(server_base)


def as_stranger(program: str, *arguments: str, told: str = "") -> bytes:
    python = shutil.which("python3", path="/usr/bin:/usr/local/bin")
    if python is None:
        pytest.skip("there is no Python that another user may run")
    return subprocess.run(
        [python, "-c", program, *arguments],
        input=told.encode(),
        capture_output=True,
        check=True,
        user=STRANGER,
        group=STRANGER,
        extra_groups=[],
        cwd="/",
        timeout=300,
        env={},
    ).stdout


def every_request(served: Served) -> list[tuple[str, str]]:
    """Each route of the server with each of its methods."""
    paths: dict[str, dict[str, Any]] = served.owner().get("/openapi.json")["paths"]
    some = "00000000-0000-4000-8000-000000000000"
    return [
        (method.upper(), re.sub(r"{[^}]*}", some, path))
        for path, methods in paths.items()
        for method in methods
    ]


def listening(pids: set[int]) -> set[str]:
    """Addresses that these processes listen on, IPv4 and IPv6, as the kernel writes them."""
    inodes = set()
    for pid in pids:
        for link in Path(f"/proc/{pid}/fd").iterdir():
            try:
                target = str(link.readlink())
            except OSError:
                continue
            if target.startswith("socket:"):
                inodes.add(target[8:-1])
    found = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A" and fields[9] in inodes:
                found.add(fields[1].partition(":")[0])
    return found


def session_of(keeper: int) -> set[int]:
    """A process and all its descendants."""
    parents: dict[int, int] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                stat = (entry / "stat").read_text()
            except OSError:
                continue
            parents[int(entry.name)] = int(stat.rpartition(")")[2].split()[1])
    family = {keeper}
    while grown := {pid for pid, parent in parents.items() if parent in family} - family:
        family |= grown
    return family


def test_it_listens_on_loopback_only(served: Served) -> None:
    address = process.read_address(served.home)
    assert address is not None
    loopback = int.from_bytes(socket.inet_aton("127.0.0.1"), sys.byteorder)
    assert listening(session_of(address.pid)) == {f"{loopback:08X}"}


def test_its_owner_is_served_and_finds_it_again(served: Served) -> None:
    assert served.used.stdout == "ready\n", served.used.stderr
    assert served.use().stdout == "ready\n"
    found = process.read_address(served.home)
    assert found is not None
    assert found.url == served.url
    # Whoever is told the address is told where the login is that its pages ask for.
    server = process.SharedServer(served.home, found, FileLock(served.home / "use"), served.login)
    named = re.fullmatch(r" \(the login is in (.*)\)", server.entrance)
    assert named is not None
    assert Path(named[1]).read_text().strip() == served.login


@NOT_ROOT
def test_another_user_is_refused_on_every_route(served: Served) -> None:
    routes = every_request(served)
    assert len(routes) > 150
    wrong = {"Authorization": "Basic bW9kZXR1bmU6bW9kZXR1bmU="}
    token = served.owner().get("/csrf-token?client=owner")["token"]
    # A token of the owner's takes the second lock away: the login alone must hold.
    token_of_owner = {"Prefect-Csrf-Token": token, "Prefect-Csrf-Client": "owner"}
    for headers, refusals in (
        ({}, {401, 403}),
        (wrong, {401, 403}),
        (token_of_owner, {401}),
        ({**wrong, **token_of_owner}, {401}),
    ):
        told = json.dumps(
            {"url": served.url, "content": {}, "requests": [(*route, headers) for route in routes]}
        )
        answers = json.loads(as_stranger(REQUESTS, told=told))
        open_to_all = {
            route for route, status in zip(routes, answers, strict=True) if status not in refusals
        }
        assert open_to_all <= {("GET", "/health"), ("GET", "/ready")}  # "true", and nothing more


@NOT_ROOT
def test_another_user_cannot_have_a_program_run(served: Served) -> None:
    """The attack that worked on a server without a login: a pool, a deployment, a run of it."""
    requests: list[tuple[str, str, dict[str, str]]] = [
        ("POST", "/work_pools/", {}),
        ("POST", "/flows/", {}),
        ("POST", "/deployments/", {}),
        ("POST", "/deployments/00000000-0000-4000-8000-000000000000/create_flow_run", {}),
        ("GET", "/csrf-token?client=x", {}),
        ("POST", "/work_pools/", {"Host": "localhost/health"}),
        ("POST", "/health", {}),
    ]
    content = {"name": "x", "type": "process", "job_variables": {"command": "touch /tmp/owned"}}
    told = json.dumps({"url": served.url, "content": content, "requests": requests})
    assert set(json.loads(as_stranger(REQUESTS, told=told))) == {401, 403}
    assert "x" not in {pool["name"] for pool in served.owner().post("/work_pools/filter", {})}


@NOT_ROOT
def test_another_user_sees_no_secret_in_files_or_command_lines(served: Served) -> None:
    seen, _, lines = as_stranger(SPYING, str(served.home)).partition(b"\n")
    assert seen == b"[]"
    assert b"prefect_server" in lines  # the list of processes is open to all
    assert served.login.partition(":")[2].encode() not in lines


def test_files_are_readable_by_their_owner_alone(served: Served) -> None:
    modes = {path.name: stat.S_IMODE(path.lstat().st_mode) for path in served.home.iterdir()}
    assert stat.S_IMODE(served.home.stat().st_mode) == 0o700
    assert modes["login"] == modes["server.json"] == modes["prefect.log"] == 0o600
    secret = served.login.partition(":")[2].encode()
    holding = {
        path.name
        for path in served.home.rglob("*")
        if path.is_file() and secret in path.read_bytes()
    }
    assert holding == {"login"}


def test_a_request_that_a_page_forged_is_refused(served: Served) -> None:
    """A browser sends the login that it was told, but a page elsewhere has no token to go with."""
    request = urllib.request.Request(
        f"{served.url}/flows/", data=b'{"name": "forged"}', headers={
            "Authorization": f"Basic {base64.b64encode(served.login.encode()).decode()}",
            "Content-Type": "application/json", "Prefect-Csrf-Token": "x",
            "Prefect-Csrf-Client": "y", "Origin": "http://elsewhere.example",
        },
    )  # fmt: skip
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(request, timeout=30.0)
    with refused.value as answer:
        assert answer.code == 403


def test_a_client_without_the_login_is_told_so(served: Served) -> None:
    other = served.use(PREFECT_API_URL=served.url)
    assert other.stdout == "asks for a login\n", other.stderr
    assert ServerClient(served.url).answer() == "asks for a login"


@NOT_ROOT
def test_the_login_is_not_sent_to_another_users_process(tmp_path: Path) -> None:
    """The port of a server that is gone may be taken by anybody."""
    listening = subprocess.Popen(
        [
            shutil.which("python3", path="/usr/bin:/usr/local/bin") or "python3",
            "-c",
            "import http.server as h; s = h.HTTPServer(('127.0.0.1', 0), h.BaseHTTPRequestHandler);"
            "print(s.server_port, flush=True); s.serve_forever()",
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        cwd="/",
        user=STRANGER,
        group=STRANGER,
        extra_groups=[],
    )
    with listening:
        assert listening.stdout is not None
        url = f"http://127.0.0.1:{int(listening.stdout.readline())}/api"
        assert not process.is_ours(url)
        with FileLock(tmp_path / "use.lock") as use:
            server = process.SharedServer(tmp_path, process.Address(url, os.getpid()), use)
            assert server.answer() == "does not answer"
        listening.kill()


def test_a_folder_of_another_user_is_not_used(tmp_path: Path) -> None:
    base = tmp_path / "base"
    process.machine_home(base).parent.mkdir()
    process.machine_home(base).symlink_to("/tmp")
    with pytest.raises(StorageUnavailable, match="is not a folder owned by user"):
        process.make_private(process.machine_home(base))


def test_hosts_that_share_a_home_have_folders_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = process.machine_home(tmp_path)
    monkeypatch.setattr(socket, "gethostname", lambda: "node/2")
    there = process.machine_home(tmp_path)
    assert there != here
    assert there.name == f"node-2-{os.getuid()}"


def test_a_login_is_made_once_and_a_broken_one_again(tmp_path: Path) -> None:
    first = process.read_login(tmp_path)
    assert process.read_login(tmp_path) == first
    assert re.fullmatch(r"modetune:[\w-]{43}", first)  # 32 random bytes
    (tmp_path / "login").write_text("modetune:")
    second = process.read_login(tmp_path)
    assert second not in (first, "modetune:")
    assert stat.S_IMODE((tmp_path / "login").stat().st_mode) == 0o600


def test_a_proxy_is_not_asked_for_loopback(monkeypatch: pytest.MonkeyPatch) -> None:
    assert [is_loopback(host) for host in ("127.0.0.1", "::1", "localhost", "127.9.9.9")] == (
        [True] * 4
    )
    assert not is_loopback("prefect.example")
    asked = []

    class Page(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.path)
            self.send_response(200)
            self.end_headers()
            self.wfile.write(b'"3.8.8"')

        def log_message(self, format: str, *arguments: object) -> None:
            pass

    with http.server.HTTPServer(("127.0.0.1", 0), Page) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        for name in ("HTTP_PROXY", "http_proxy", "ALL_PROXY"):
            monkeypatch.setenv(name, "http://192.0.2.1:3128")  # nobody has this address
        monkeypatch.delenv("NO_PROXY", raising=False)
        monkeypatch.delenv("no_proxy", raising=False)
        assert ServerClient(f"http://127.0.0.1:{server.server_port}/api").answer() == "ready"
        server.shutdown()
    assert asked == ["/api/admin/version"]


# What may be at an address


class Peer:
    """A peer that accepts connections and does something of its own with each."""

    def __init__(self, serve: Callable[[socket.socket], None]) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._serve = serve
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}/api"
        self._thread = threading.Thread(target=self._accept)
        self._thread.start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self._listener.accept()
                with connection, contextlib.suppress(OSError):
                    self._serve(connection)

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join()


def drip(connection: socket.socket) -> None:
    """Send an endless head, one byte each half second."""
    for byte in b"HTTP/1.1 200 OK\r\nServer: " + 100 * b"x":
        connection.sendall(bytes([byte]))
        threading.Event().wait(0.5)


def drip_body(connection: socket.socket) -> None:
    """Send a head, then an endless body, one byte each half second."""
    connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 1000\r\n\r\n")
    drip(connection)


def hang(connection: socket.socket) -> None:
    """Read and send nothing."""
    while connection.recv(1000):
        pass


def refuse(connection: socket.socket) -> None:
    """Send that others write to the database."""
    connection.recv(1000)
    connection.sendall(b"HTTP/1.1 503 Busy\r\nContent-Length: 0\r\n\r\n")


def page(connection: socket.socket) -> None:
    """Send a page of something else."""
    connection.recv(1000)
    connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 6\r\n\r\n<html>")


@pytest.mark.parametrize(
    ("serve", "answer"),
    [
        (drip, "does not answer"),
        (drip_body, "does not answer"),
        (hang, "does not answer"),
        (refuse, "does not answer"),
        (page, "is not a Prefect server"),
    ],
)
def test_a_probe_takes_three_seconds_at_most(
    serve: Callable[[socket.socket], None], answer: str
) -> None:
    peer = Peer(serve)
    threads, began = threading.active_count(), time.monotonic()
    try:
        assert ServerClient(peer.url).answer() == answer
        assert time.monotonic() - began < allowed(3.0)
        assert threading.active_count() == threads
    finally:
        peer.close()


def test_a_host_whose_name_is_looked_up_for_ever_is_given_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = threading.Event()

    def look_up(*arguments: object, **more: object) -> list[object]:
        found.wait(60.0)
        return []

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    began = time.monotonic()
    assert ServerClient("http://prefect.example/api").answer() == "does not answer"
    assert time.monotonic() - began < allowed(3.0)
    found.set()


# Which server


def test_the_active_profile_names_a_server_and_its_login(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in process.FOREIGN:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PREFECT_HOME", str(tmp_path))
    assert process.configured_server() is None
    (tmp_path / "profiles.toml").write_text(
        'active = "site"\n[profiles.site]\nPREFECT_API_URL = "https://me:word@prefect.example/api"\n'
        '[profiles.other]\nPREFECT_API_URL = "http://127.0.0.1:9/api"\n'
        'PREFECT_API_AUTH_STRING = "you:word"\n'
    )
    server = process.use_server(start=False)
    assert server is not None
    assert (server.address.url, server.login) == ("https://prefect.example/api", "me:word")
    assert not server.shared
    assert server.entrance == ""
    monkeypatch.setenv("PREFECT_PROFILE", "other")
    other = process.use_server()
    assert (other.address.url, other.login) == ("http://127.0.0.1:9/api", "you:word")
    assert other.settings()["PREFECT_API_AUTH_STRING"] == "you:word"
    monkeypatch.setenv("PREFECT_API_AUTH_STRING", "they:word")  # the environment wins
    assert prefect_setting("PREFECT_API_AUTH_STRING") == "they:word"
    (tmp_path / "profiles.toml").write_text("active = ")
    assert process.configured_server() is None


def test_a_server_is_started_only_when_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, served: Served
) -> None:
    for name in process.FOREIGN:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(process.HOME_VARIABLE, str(tmp_path / "none"))
    assert process.use_server(start=False) is None
    assert not (tmp_path / "none").exists()
    monkeypatch.setenv(process.HOME_VARIABLE, str(served.home.parent))
    server = process.use_server(start=False)
    assert server is not None
    assert server.wait(20.0) == "ready"
    server.close()


#: Reads its flow runs through Prefect's own client, as a client process does.
CLIENT = """
from prefect.client.orchestration import get_client
from prefect.settings import PREFECT_HOME
with get_client(sync_client=True) as client:
    print(client.read_flow_runs(limit=1) is not None, PREFECT_HOME.value())
    client.create_flow_from_name("settings")
"""


def test_its_settings_make_prefect_a_client_that_leaves_the_users_folder_alone(
    served: Served, tmp_path: Path
) -> None:
    server = process.SharedServer(
        served.home, process.Address(served.url, 0), FileLock(tmp_path / "x"), served.login
    )
    home = tmp_path / "user"
    home.mkdir()
    used = subprocess.run(
        [sys.executable, "-c", CLIENT],
        env={
            **os.environ,
            "HOME": str(home),
            "PREFECT_HOME": str(home / ".prefect"),
            "PREFECT_PROFILE": "gone",
            "PREFECT_API_KEY": "another server's",
            **server.settings(),
        },
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert used.stdout.split() == ["True", str(served.home / "client")], used.stderr
    assert used.stderr == ""
    assert list(home.iterdir()) == []


def test_a_server_that_is_configured_and_gone_is_not_waited_for_long() -> None:
    server = process.SharedServer(Path(), process.Address("http://127.0.0.1:9/api", 0), None)
    seconds: list[float] = []
    began = time.monotonic()
    assert server.wait(2.5, seconds.append) == "does not answer"
    assert time.monotonic() - began < allowed(6.0)
    assert [int(item) for item in seconds] == [1, 2]


# A shared server that cannot start


def shared_faults(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a shared server that nobody has started yet."""
    for name in process.FOREIGN:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(process.HOME_VARIABLE, str(tmp_path))
    home = process.machine_home(tmp_path)
    process.make_private(home)
    return home


def test_a_full_disk_is_one_sentence_and_leaves_no_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = shared_faults(tmp_path, monkeypatch)
    write, started = process._write_private, []

    def full(path: Path, text: str) -> None:
        if path.name == "server.json":
            started.append(text)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(path, text)

    monkeypatch.setattr(process, "_write_private", full)
    with pytest.raises(StorageUnavailable, match="is full"):
        process.use_server()
    assert not process.is_keeper(json.loads(started[0])["pid"])
    assert not (home / "server.json").exists()


def test_a_home_that_cannot_be_written_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(process.HOME_VARIABLE, "/proc/modetune")  # refuses root too
    monkeypatch.delenv("PREFECT_API_URL", raising=False)
    with pytest.raises(StorageUnavailable, match="/proc/modetune"):
        process.use_server()


def test_a_gate_that_another_process_never_opens_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = shared_faults(tmp_path, monkeypatch)
    monkeypatch.setattr(process, "GATE_S", 0.1)
    with FileLock(home / "server.lock") as gate:
        assert gate.take()
        with pytest.raises(StorageUnavailable, match=r"server\.lock"):
            process.use_server()


def test_a_corrupt_database_ends_the_wait(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home = shared_faults(tmp_path, monkeypatch)
    (home / "prefect").mkdir()
    (home / "prefect" / "prefect.db").write_bytes(b"no database" * 1000)
    server = process.use_server()
    assert server.wait(60.0) == "does not answer"
    server.close()
    keeper = server.address.pid
    assert eventually(lambda: not process.is_keeper(keeper))
    assert process.running_address(home) is None


def test_a_locked_database_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home = shared_faults(tmp_path, monkeypatch)
    (home / "prefect").mkdir()
    with contextlib.closing(sqlite3.connect(home / "prefect" / "prefect.db")) as other:
        other.execute("create table held (x)")
        other.execute("begin exclusive")
        server = process.use_server()
        began = time.monotonic()
        assert server.wait(12.0) == "does not answer"
        assert time.monotonic() - began < allowed(16.0)
    server.close()
    process.stop_server(home)
    assert not process.is_keeper(server.address.pid)
