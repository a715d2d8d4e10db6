"""The shared server is its owner's alone: seen by its owner, by another user, and by a stranger's
process on its port."""

from __future__ import annotations

import base64
import http.server
import json
import os
import re
import shutil
import socket
import stat
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from modetune.core.errors import StorageUnavailable
from modetune.core.storage.locks import FileLock
from modetune.flows.jobs import prefect_server as process
from modetune.flows.jobs.prefect_api import PrefectApi, is_loopback
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
        for name in ("PREFECT_API_URL", "PREFECT_API_AUTH_STRING"):
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

    def owner(self) -> PrefectApi:
        return PrefectApi(self.url.replace("://", f"://{self.login}@"))


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
    with served.owner() as api:
        paths: dict[str, dict[str, Any]] = api.get("/openapi.json")["paths"]
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


@NOT_ROOT
def test_another_user_is_refused_on_every_route(served: Served) -> None:
    routes = every_request(served)
    assert len(routes) > 150
    wrong = {"Authorization": "Basic bW9kZXR1bmU6bW9kZXR1bmU="}
    with served.owner() as api:
        token = api.get("/csrf-token?client=owner")["token"]
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
    with served.owner() as api:
        assert "x" not in {pool["name"] for pool in api.post("/work_pools/filter", {})}


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
    with PrefectApi(served.url, login="") as api:
        assert api.answer() == "asks for a login"


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
    with pytest.raises(StorageUnavailable, match="is not a folder of the user"):
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
        with PrefectApi(f"http://127.0.0.1:{server.server_port}/api", patience_s=2.0) as api:
            assert api.answer() == "ready"
        server.shutdown()
    assert asked == ["/api/admin/version"]
