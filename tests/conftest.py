"""What tests of several folders share."""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import shutil
import signal
import sys
from collections import Counter
from collections.abc import Generator, Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

#: What tests compute in their own process is small: more threads only wait for each other.
for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

#: Processes that tests start find the byte code of their modules, as those of an installed package
#: do: to compile them takes each two seconds.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

#: On a busy machine an example takes any time. Examples of a test share its folder.
for _profile, _examples in (("untimed", 40), ("nightly", 400)):
    settings.register_profile(
        _profile,
        max_examples=_examples,
        deadline=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
    )
settings.load_profile("untimed")

#: Files that take the better part of a minute or more begin first: one at the end would have all
#: cores but its own wait. Those that wait for a server or a clock stand between those that compute.
LONG = (
    "tests/test_gallery.py",
    "tests/flows/server/test_worker.py",
    "tests/flows/server/test_foreign_programs.py",
    "tests/cases/test_garteur.py",
    "tests/flows/server/test_faults.py",
    "tests/cases/test_fixture.py",
    "tests/flows/jobs/test_prefect.py",
    "tests/benchmarks/test_ways.py",
    "tests/flows/jobs/test_dask.py",
    "tests/flows/studies/test_kinds.py",
    "tests/flows/cli/test_cli.py",
    "tests/flows/report/test_browser.py",
    "tests/flows/server/test_flows.py",
    "tests/test_docs.py",
    "tests/test_structure.py",
)

CCX_ONCE = Path(__file__).with_name("adapters") / "ccx_once.py"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long files begin first; the others keep their order."""
    places = {name: place for place, name in enumerate(LONG)}
    items.sort(key=lambda item: places.get(item.nodeid.partition("::")[0], len(places)))


def pytest_collection_finish() -> None:
    """What is there before the first test is there to the end: no need to look for it again."""
    gc.collect()
    gc.freeze()


def _processor_s() -> float:
    """Return the processor time of this process and of its ended children."""
    return sum(os.times()[:4])


_spent = [_processor_s()]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Attach to each report the processor time since the one before it."""
    report = yield
    now = _processor_s()
    report.user_properties.append(("processor_s", now - _spent[0]))
    _spent[0] = now
    return report


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the processor time of all tests and of the files that take most of it."""
    files: Counter[str] = Counter()
    for report in (report for found in terminalreporter.stats.values() for report in found):
        seconds = dict(getattr(report, "user_properties", ())).get("processor_s", 0.0)
        if seconds:
            files[report.nodeid.partition("::")[0]] += seconds
    terminalreporter.section(f"{sum(files.values()):.0f} processor seconds")
    for name, seconds in files.most_common(20):
        terminalreporter.write_line(f"{seconds:8.1f} s  {name}")


@pytest.fixture(scope="session", autouse=True)
def real_ccx(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """CalculiX itself; `ccx` is, in all tests of a session, one that solves each deck once."""
    real = shutil.which("ccx")
    if real is None:
        yield "ccx"
        return
    shared = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:  # one for all workers
        shared = shared.parent
    program = shared / "ccx" / "bin" / "ccx"
    if not program.exists():
        part = tmp_path_factory.mktemp("ccx-part")
        (part / "bin").mkdir()
        (part / "real").mkdir()
        (part / "real" / "ccx").symlink_to(real)
        (part / "solved").mkdir()
        (part / "bin" / "ccx").write_text(f"#!{sys.executable} -IS\n{CCX_ONCE.read_text()}")
        (part / "bin" / "ccx").chmod(0o755)
        with contextlib.suppress(OSError):  # another worker was faster
            part.rename(shared / "ccx")
    path = os.environ["PATH"]
    os.environ["PATH"] = f"{program.parent}:{path}"
    yield real
    os.environ["PATH"] = path


@pytest.fixture(scope="session", autouse=True)
def _own_home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Limits and servers of the machine's user are not those of its tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MODETUNE_HOME", str(tmp_path_factory.mktemp("home")))
        patch.setenv("MODETUNE_NO_PREFECT", "1")  # tests of the pages take it back
        yield


@pytest.fixture(scope="session", autouse=True)
def _in_this_process() -> Iterator[None]:
    """Jobs of Python programs start no interpreter, and files need not outlast the machine."""
    from tests.embedded import run_embedded

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("modetune.flows.jobs.engine.run_process", run_embedded)
        patch.setattr("os.fsync", lambda number: None)
        yield


@pytest.fixture(autouse=True)
def _no_test_leaves_its_log_or_signals() -> Iterator[None]:
    """Later tests log as this one did, and SIGPIPE stays ignored: its default ends the process."""
    ours = logging.getLogger("modetune")
    before = (ours.handlers[:], ours.propagate)
    yield
    assert (ours.handlers, ours.propagate) == before, "modetune's logger was changed"
    lines = Path("/proc/self/status").read_text().splitlines()
    ignored = int(next(line for line in lines if line.startswith("SigIgn:")).split()[1], 16)
    assert ignored >> (signal.SIGPIPE - 1) & 1, "SIGPIPE is no longer ignored"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real files nobody here wrote; tests that need it skip where it is not there."""
    beside = Path(__file__).resolve().parent.parent.parent / "shared"
    folder = Path(os.environ.get("MODETUNE_SHARED", beside)) / "data"
    if not folder.is_dir():
        pytest.skip(f"no shared data at {folder}; MODETUNE_SHARED names another place")
    return folder
