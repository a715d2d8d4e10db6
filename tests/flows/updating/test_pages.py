"""What is shown never decides: whatever stands in a server's place, a campaign's result, its exit
code and its time stay the same, and nothing of it is left behind in the process."""

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

import pytest

from modetune.core.errors import CampaignStopped, ModesError
from modetune.flows.jobs import prefect_server as process
from modetune.flows.updating import poster, prefect
from modetune.flows.updating.prefect import Pages, shown
from modetune.flows.updating.running import update_campaign
from tests.eventually import eventually
from tests.flows.conftest import Bench, Watcher

TRUTH = {"k1": 1.2, "k4": 0.9}
SIX_MASS = Path(__file__).resolve().parents[3] / "configs" / "six_mass"
#: Seconds by which a campaign may be later for what stands in a server's place, on a busy machine.
LATER_S = prefect.FIRST_WORD_S + prefect.END_S + 2.0


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


def updated(bench: Bench, name: str) -> tuple[Any, float]:
    """A campaign with pages, its record and its wall time."""
    began = time.monotonic()
    with shown("chain") as pages:
        run = update_campaign(bench.campaign(TRUTH), bench.folder / name, Watcher(), pages)
        pages.ended(run.record, run.folder)
    return run.record, time.monotonic() - began


@pytest.mark.parametrize("state", STATES, ids=lambda state: state.__qualname__.partition(".")[0])
def test_what_stands_in_a_servers_place_changes_nothing(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, state: Callable[[socket.socket, bytes], None]
) -> None:
    plain = update_campaign(bench.campaign(TRUTH), bench.folder / "plain", Watcher()).record
    with listening(state) as url:
        monkeypatch.setenv("PREFECT_API_URL", url)
        monkeypatch.setenv("HTTP_PROXY", "http://192.0.2.1:3128")  # nobody has this address
        before = threading.active_count()
        record, wall_s = updated(bench, "shown")
        assert threading.active_count() <= before + 1  # the connection under way, of this test
        end_poster(url)
    assert (record.status, record.reason) == (plain.status, plain.reason)
    assert record.updated.tobytes() == plain.updated.tobytes()
    assert wall_s < LATER_S + plain.wall_s * 3


def end_poster(value: str, variable: str = "PREFECT_API_URL") -> None:
    """Do not wait the minute for which it would go on trying."""
    wanted = f"{variable}={value}".encode()
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if b"updating.poster" in (entry / "cmdline").read_bytes():
                if wanted in (entry / "environ").read_bytes().split(b"\0"):
                    os.kill(int(entry.name), 9)
        except OSError:
            continue


def test_a_login_that_is_asked_for_is_told_in_one_sentence(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with listening(asks_for_a_login) as url:
        monkeypatch.setenv("PREFECT_API_URL", url)
        pages = Pages("chain")
        time.sleep(3.0)  # as long as a short campaign
        pages.end("COMPLETED", "Converged", "")
    said = [entry.getMessage() for entry in caplog.records if entry.name == prefect.__name__]
    assert len(said) == 1
    assert "asks for a login; set PREFECT_API_AUTH_STRING=name:password" in said[0]


def test_a_home_that_cannot_be_used_changes_nothing(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.delenv("PREFECT_API_URL", raising=False)
    (bench.folder / "file").write_text("not a folder")
    campaign = bench.campaign(TRUTH)
    monkeypatch.setenv(process.HOME_VARIABLE, str(bench.folder / "file"))
    pages = Pages("chain")
    time.sleep(3.0)
    pages.failed(ModesError("the modes were lost"))
    assert campaign.name == "chain"
    said = [entry.getMessage() for entry in caplog.records if entry.name == prefect.__name__]
    assert len(said) == 1
    assert "goes on without" in said[0]


def test_a_process_that_does_not_read_holds_nobody_up(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(prefect, "FIRST_WORD_S", 0.2)
    monkeypatch.setattr(prefect, "COMMAND", (sys.executable, "-c", "import time; time.sleep(4)"))
    began = time.monotonic()
    pages = Pages("chain")
    for number in range(2000):
        pages.log(f"{number} {'x' * 1000}")  # far more than a pipe holds
    assert time.monotonic() - began < 2.0
    pages.end("COMPLETED", "Converged", "")


@pytest.mark.parametrize(
    ("error", "state"),
    [
        (KeyboardInterrupt(), "CANCELLED"),
        (CampaignStopped("stopped"), "CANCELLED"),
        (ModesError("lost"), "FAILED"),
        (ZeroDivisionError("a fault"), "CRASHED"),
    ],
)
def test_how_a_campaign_was_broken_off_is_its_runs_state(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, error: BaseException, state: str
) -> None:
    heard = tmp_path / "heard"
    program = f"import sys; open({str(heard)!r}, 'w').write(sys.stdin.read())"
    monkeypatch.setattr(prefect, "COMMAND", (sys.executable, "-c", program))
    with pytest.raises(type(error)), shown("chain"):
        raise error
    lines = [json.loads(line) for line in heard.read_text().splitlines()]
    assert [line["end"]["type"] for line in lines if "end" in line] == [state]


def test_a_campaign_that_is_killed_has_crashed() -> None:
    assert poster.KILLED["end"]["type"] == "CRASHED"
    read, write = os.pipe()
    heard = poster.Poster("chain", None, "update", os.getpid())
    os.write(write, b'{"log": {"message": "one"}}\n{"log": {"mess')
    os.close(write)
    with os.fdopen(read) as pipe:
        heard.hear(pipe)
    assert [heard.waiting.get(), heard.waiting.get()] == [
        {"log": {"message": "one"}},
        poster.KILLED,
    ]


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """What a campaign without Prefect prints."""
    return told(commanded(tmp_path_factory.mktemp("plain"), {}, "--no-prefect"))


def commanded(
    folder: Path, variables: dict[str, str], *options: str, command: str = "update"
) -> subprocess.CompletedProcess[str]:
    """The command in a process of its own: with the interpreter's exit, which threads of others
    can abort. A proxy is named that nobody answers for."""
    shutil.copytree(SIX_MASS, folder / "x", ignore=shutil.ignore_patterns("__pycache__", "*.py"))
    proxies = {name: "http://192.0.2.1:3128" for name in ("HTTP_PROXY", "http_proxy", "ALL_PROXY")}
    environment = {**os.environ, **proxies, process.HOME_VARIABLE: str(folder / "home")}
    hidden = ("PREFECT_API_URL", "PREFECT_API_AUTH_STRING", "NO_PROXY", "no_proxy")
    for name in (*hidden, "MODETUNE_NO_PREFECT"):
        environment.pop(name, None)
    return subprocess.run(
        [sys.executable, "-m", "modetune", command, "campaign.yaml", "--json", *options],
        cwd=folder / "x",
        env=environment | variables,
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )


def told(done: subprocess.CompletedProcess[str]) -> Any:
    """The numbers that a command printed that ended well, without a word on threads or faults."""
    assert done.returncode == 0, done.stderr
    assert not {"fault", "Traceback", "thread"} & set(done.stderr.split())
    found = json.loads(done.stdout)
    return {name: found[name] for name in ("status", "reason", "parameters", "modes")}


@pytest.mark.parametrize("state", [says_nothing, asks_for_a_login])
def test_the_command_ends_as_ever_whatever_stands_in_a_servers_place(
    plain: Any, tmp_path: Path, state: Callable[[socket.socket, bytes], None]
) -> None:
    with listening(state) as url:
        done = commanded(tmp_path, {"PREFECT_API_URL": url})
        end_poster(url)
    assert told(done) == plain


@pytest.mark.parametrize("command", ["screen", "check", "correlate"])
def test_a_study_ends_as_ever_beside_a_server_that_answers_late(
    tmp_path: Path, command: str
) -> None:
    """And whoever reads its JSON sees nothing of it."""
    with listening(answers_late) as url:
        done = commanded(tmp_path, {"PREFECT_API_URL": url}, command=command)
        end_poster(url)
    assert done.returncode == 0, done.stderr
    assert not {"fault", "Traceback", "thread"} & set(done.stderr.split())
    assert isinstance(json.loads(done.stdout), dict)


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
def test_the_command_ends_as_ever_where_the_shared_servers_database_is(
    plain: Any, tmp_path: Path, spoilt: Callable[[Path], AbstractContextManager[None]]
) -> None:
    home = process.machine_home(tmp_path / "home")
    database = home / "prefect" / "prefect.db"
    database.parent.mkdir(parents=True, mode=0o700)
    for folder in (tmp_path / "home", home):
        folder.chmod(0o700)
    with spoilt(database):
        done = commanded(tmp_path, {})
        assert eventually((home / "prefect.log").is_file)  # it was tried
        if address := process.read_address(home):  # it may have ended by itself
            with suppress(ProcessLookupError):
                os.kill(address.pid, signal.SIGKILL)
        end_poster(str(tmp_path / "home"), process.HOME_VARIABLE)
    assert told(done) == plain
