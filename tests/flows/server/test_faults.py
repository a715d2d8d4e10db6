"""A server is never a reason to fail: whatever answers in its place, or ends it, a study has the
same numbers and exit code, takes at most 20 s more, and leaves no thread."""

from __future__ import annotations

import json
import os
import select
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest

from modetune.flows.jobs import prefect_server as process
from modetune.flows.jobs.server_client import ServerClient
from modetune.flows.server.run import LOST, carried_out
from modetune.flows.server.run_page import RunPage
from modetune.flows.studies.catalogue import find_study
from tests.eventually import allowed, eventually
from tests.flows.conftest import Bench, Watcher
from tests.flows.server.site import SERVER, SIX_MASS, Site

TRUTH = {"k1": 1.2, "k4": 0.9}
#: Seconds that a study may take longer because of a server.
LATER_S = 20.0
#: Factor on the time of a run, because other tests share the cores with it.
BUSY = 2.0
HIDDEN = ("PREFECT_API_URL", "PREFECT_API_AUTH_STRING", "NO_PROXY", "no_proxy")


def page(status: str, body: str, kind: str = "application/json") -> bytes:
    return (
        f"HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {len(body)}\r\n"
        f"Connection: close\r\n\r\n{body}"
    ).encode()


@contextmanager
def listening(answer: Callable[[socket.socket, bytes], None]) -> Iterator[str]:
    """A server's place, with something else in it; each connection in a thread of its own."""
    over, threads = threading.Event(), []

    def serve(one: socket.socket) -> None:
        with closing(one):
            one.settimeout(30.0)
            try:
                answer(one, one.recv(65536))
            except OSError:
                pass

    def accept(door: socket.socket) -> None:
        while not over.is_set():
            if select.select([door], [], [], 0.05)[0]:
                threads.append(threading.Thread(target=serve, args=(door.accept()[0],)))
                threads[-1].start()

    with socket.create_server(("127.0.0.1", 0)) as door:
        threads.append(threading.Thread(target=accept, args=(door,)))
        threads[0].start()
        try:
            yield f"http://127.0.0.1:{door.getsockname()[1]}/api"
        finally:
            over.set()
            for thread in threads:
                thread.join()


def asks_for_a_login(one: socket.socket, request: bytes) -> None:
    one.sendall(page("401 Unauthorized", '{"exception_message": "Unauthorized"}'))


def is_another_page(one: socket.socket, request: bytes) -> None:
    one.sendall(page("200 OK", "<html>Welcome</html>", "text/html"))


def leads_elsewhere(one: socket.socket, request: bytes) -> None:
    one.sendall(b"HTTP/1.1 302 Found\r\nLocation: http://192.0.2.1/\r\nContent-Length: 0\r\n\r\n")


def is_no_web_server(one: socket.socket, request: bytes) -> None:
    one.sendall(b"\0\xff220 mail.example ready\r\n")


def hangs_up(one: socket.socket, request: bytes) -> None:
    pass


def says_nothing(one: socket.socket, request: bytes) -> None:
    one.recv(65536)  # until the other side has enough


def drips(one: socket.socket, request: bytes) -> None:
    for letter in page("200 OK", '"3.8.8"'):
        one.sendall(bytes([letter]))
        time.sleep(0.5)


def breaks(status: str) -> Callable[[socket.socket, bytes], None]:
    """A server that is up, with a database that is locked, corrupt, or on a full disk."""

    def answer(one: socket.socket, request: bytes) -> None:
        good = request.startswith(b"GET /api/admin/version")
        one.sendall(page("200 OK", '"3.8.8"') if good else page(status, '{"detail": "locked"}'))

    return answer


def is_slow(one: socket.socket, request: bytes) -> None:
    time.sleep(1.5)
    breaks("503 Service Unavailable")(one, request)


def answers_late(one: socket.socket, request: bytes) -> None:
    """After 20 s, unless the other side has hung up by then."""
    if not select.select([one], [], [], 20.0)[0]:
        breaks("503 Service Unavailable")(one, request)


def lies(one: socket.socket, request: bytes) -> None:
    """Says that every run was cancelled, and that nothing has the form that it should have."""
    good = request.startswith(b"GET /api/admin/version")
    told = {"id": "x", "state_type": "CANCELLED", "status": "ABORT", "token": "t"}
    one.sendall(page("200 OK", '"3.8.8"' if good else json.dumps(told)))


STATES = [
    asks_for_a_login,
    is_another_page,
    leads_elsewhere,
    is_no_web_server,
    hangs_up,
    says_nothing,
    drips,
    is_slow,
    answers_late,
    lies,
    breaks("500 Internal Server Error"),
    breaks("503 Service Unavailable"),
    breaks("404 Not Found"),
    breaks("409 Conflict"),
]


def updated(bench: Bench, prefect: Any = "start") -> tuple[Any, float]:
    """The end of an update without results in the store, and its seconds."""
    shutil.rmtree(bench.folder / "store", ignore_errors=True)
    campaign = bench.campaign(TRUTH)
    parameters = {"campaign_file": campaign.file, "runs": bench.folder / "runs"}
    began = time.monotonic()
    end = carried_out(
        find_study("update"), parameters, Watcher(), prefect=prefect, campaign=campaign
    )
    return end, time.monotonic() - began


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, float]:
    """The end of an update without Prefect, and its seconds."""
    bench = Bench(tmp_path_factory.mktemp("alone"))
    bench.script({})
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(process.HOME_VARIABLE, str(bench.folder / "home"))
        end, wall_s = updated(bench, "off")
    assert not end.remark
    return end, wall_s


def ours(threads: set[threading.Thread]) -> set[str]:
    """Threads of modetune; others are connections of this test."""
    return {thread.name for thread in threads if thread.name.startswith(("modetune", "prefect"))}


def check_same(end: Any, plain: Any) -> None:
    assert (end.exit_code, end.status, end.sentence) == (0, plain.status, plain.sentence)
    assert end.found.record.updated.tobytes() == plain.found.record.updated.tobytes()


@pytest.mark.parametrize("state", STATES, ids=lambda state: state.__qualname__.partition(".")[0])
def test_what_answers_in_a_servers_place_changes_no_result(
    bench: Bench,
    alone: tuple[Any, float],
    monkeypatch: pytest.MonkeyPatch,
    state: Callable[[socket.socket, bytes], None],
) -> None:
    for name in HIDDEN:
        monkeypatch.delenv(name, raising=False)
    with listening(state) as url:
        monkeypatch.setenv("PREFECT_API_URL", url)
        monkeypatch.setenv("HTTP_PROXY", "http://192.0.2.1:3128")  # nobody has this address
        before = set(threading.enumerate())
        end, wall_s = updated(bench)
        assert eventually(lambda: not ours(set(threading.enumerate()) - before), 5.0)
    check_same(end, alone[0])
    assert end.remark.startswith(("run without Prefect: ", LOST))
    assert wall_s < BUSY * alone[1] + allowed(LATER_S)


def test_a_server_that_answers_but_writes_nothing_does_not_get_the_end_of_a_run() -> None:
    """Its database is locked or full; Prefect would try for long to write the final state."""
    with listening(breaks("503 Service Unavailable")) as url:
        page = RunPage(ServerClient(url), uuid4(), lambda: None, own_process=False)
        assert not page.finish()


def test_a_login_that_is_asked_for_is_named_with_its_remedy(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    with listening(asks_for_a_login) as url:
        monkeypatch.setenv("PREFECT_API_URL", url)
        end, _ = updated(bench)
    assert "asks for a login; set PREFECT_API_AUTH_STRING=name:password" in end.remark


def test_a_home_that_cannot_be_used_changes_no_result(
    bench: Bench, alone: tuple[Any, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PREFECT_API_URL", raising=False)
    (bench.folder / "file").write_text("not a folder")
    unusable = bench.folder / "file" / "home"
    monkeypatch.setattr(process, "server_home", lambda: unusable)
    end, _ = updated(bench)
    check_same(end, alone[0])
    assert end.remark.startswith("run without Prefect: ")


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, float]:
    """What a campaign without Prefect prints, and its seconds."""
    began = time.monotonic()
    found = printed(commanded(tmp_path_factory.mktemp("plain"), {}, "--no-prefect"))
    return found, time.monotonic() - began


def commanded(
    folder: Path, variables: dict[str, str], *options: str, command: str = "update"
) -> subprocess.CompletedProcess[str]:
    """The command in a process of its own, whose exit threads of others can abort; a proxy is
    named at whose address nobody answers."""
    shutil.copytree(SIX_MASS, folder / "x", ignore=shutil.ignore_patterns("__pycache__", "*.py"))
    proxies = {name: "http://192.0.2.1:3128" for name in ("HTTP_PROXY", "http_proxy", "ALL_PROXY")}
    environment = {**os.environ, **proxies, process.HOME_VARIABLE: str(folder / "home")}
    for name in (*HIDDEN, "MODETUNE_NO_PREFECT"):
        environment.pop(name, None)
    return subprocess.run(
        [sys.executable, "-m", "modetune", command, "campaign.yaml", "--json", *options],
        cwd=folder / "x",
        env=environment | variables,
        capture_output=True,
        text=True,
        timeout=allowed(100.0),
        check=False,
    )


def printed(done: subprocess.CompletedProcess[str]) -> Any:
    """The numbers of a command that ended well, without a word on threads or faults."""
    assert done.returncode == 0, done.stderr
    assert not {"fault", "Traceback", "thread"} & set(done.stderr.split())
    found = json.loads(done.stdout)
    return {name: found[name] for name in ("status", "reason", "parameters", "modes")}


@pytest.mark.parametrize(
    ("command", "state"),
    [("update", says_nothing), ("update", lies), ("screen", lies), ("check", says_nothing)],
)
def test_a_command_ends_as_ever_whatever_answers(
    tmp_path: Path, command: str, state: Callable[[socket.socket, bytes], None]
) -> None:
    with listening(state) as url:
        done = commanded(tmp_path, {"PREFECT_API_URL": url}, command=command)
    assert done.returncode == 0, done.stderr
    assert not {"fault", "Traceback", "thread"} & set(done.stderr.split())
    assert isinstance(json.loads(done.stdout), dict)
    assert done.stderr.splitlines()[-1].startswith("modetune: run without Prefect: ")


@contextmanager
def corrupt(database: Path) -> Iterator[None]:
    database.write_bytes(b"SQLite format 3\0" + bytes(range(256)) * 64)
    yield


@contextmanager
def locked(database: Path) -> Iterator[None]:
    with closing(sqlite3.connect(database, isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        yield


@contextmanager
def full(database: Path) -> Iterator[None]:
    """What stands for a full disk: writing to it fails as there."""
    for name in ("prefect.db", "prefect.db-wal", "prefect.db-journal"):
        database.with_name(name).symlink_to("/dev/full")
    yield


@pytest.mark.parametrize("spoilt", [corrupt, locked, full], ids=lambda spoilt: spoilt.__name__)
def test_a_command_ends_as_ever_where_the_shared_servers_database_is(
    plain: tuple[Any, float],
    tmp_path: Path,
    spoilt: Callable[[Path], AbstractContextManager[None]],
) -> None:
    home = process.machine_home(tmp_path / "home")
    database = home / "prefect" / "prefect.db"
    database.parent.mkdir(parents=True, mode=0o700)
    for folder in (tmp_path / "home", home):
        folder.chmod(0o700)
    with spoilt(database):
        began = time.monotonic()
        done = commanded(tmp_path, {})
        wall_s = time.monotonic() - began
        assert (home / "prefect.log").is_file()  # it was tried
        if address := process.read_address(home):  # it may have ended by itself
            with suppress(ProcessLookupError):
                os.kill(address.pid, signal.SIGKILL)
    assert printed(done) == plain[0]
    assert wall_s < BUSY * plain[1] + allowed(LATER_S)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    site = Site(tmp_path_factory.mktemp("site"))
    yield site
    site.resume()
    site.end_started()
    site.kill(*SERVER)


@pytest.mark.parametrize("blow", [signal.SIGKILL, signal.SIGSTOP])
@pytest.mark.parametrize("moment", ["start", "middle"])
def test_a_server_that_dies_or_hangs_under_a_run_changes_no_result(
    site: Site, plain: tuple[Any, float], blow: signal.Signals, moment: str
) -> None:
    site.run("server", "start")
    site.hang()
    run = subprocess.Popen(
        [sys.executable, "-m", "modetune", "update", "campaign.yaml", "--json"],
        cwd=site.folder,
        env=site.environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    time.sleep(0.5 if moment == "start" else 8.0)
    try:
        site.kill(*SERVER, blow=blow)
        site.resume()
        began = time.monotonic()
        printed_json, said = run.communicate(timeout=100)
        wall_s = time.monotonic() - began
    finally:
        site.resume()
        site.kill(*SERVER)
    assert run.returncode == 0, said
    assert not {"fault", "Traceback", "thread"} & set(said.split())
    assert wall_s < BUSY * plain[1] + allowed(LATER_S)
    assert json.loads(printed_json)["parameters"] == plain[0]["parameters"]
