"""`engine: dask` on a real local cluster of two worker processes and a solver that counts runs."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modetune.adapters.solver import ModalAnalysis
from modetune.core.errors import (
    CampaignError,
    SolverCancelled,
    SolverCrashed,
    SolverRejected,
    StorageUnavailable,
)
from modetune.flows.campaign import solvers
from modetune.flows.campaign.campaign import Campaign, load_campaign
from modetune.flows.campaign.site import DaskSection
from modetune.flows.jobs import dask_cluster, execution
from modetune.flows.jobs.campaign_engine import job_engine, solving_engine
from modetune.flows.jobs.dask_cluster import DaskRunner, dask_result, workers_apart
from modetune.flows.jobs.execution import Execution, Work, solve_jobs
from modetune.flows.jobs.job import Job
from modetune.flows.jobs.runner import Task, retry
from modetune.flows.updating.update import update_campaign
from tests.eventually import eventually

dask_library = pytest.importorskip("dask", reason="Dask is not installed (the extra `cluster`)")
distributed = pytest.importorskip("distributed", reason="Dask is not installed (extra `cluster`)")

ROOT = Path(__file__).resolve().parents[3]
TRUTH = {"k1": 1.2, "k2": 0.8, "k3": 1.1}
CAMPAIGN = """
name: chain
model: {deck: chain.yaml, solver: matrices, units: m-kg-s}
test: {modes: measured.csv}
parameters:
  - {name: k1, quantity: spring_stiffness, elset: k1, bounds: [0.3, 3.0]}
  - {name: k2, quantity: spring_stiffness, elset: k2, bounds: [0.3, 3.0]}
  - {name: k3, quantity: spring_stiffness, elset: k3, bounds: [0.3, 3.0]}
update: {step: weighted_least_squares, e1: {frequency: 1.0e-8, mac: 0.0}, e2: 0, step_limit: 0.5}
sensitivity: {method: finite_difference, difference: central, step: 0.01}
run: {engine: dask, parallel: 2, retries: 0, dask: {workers: 2}}
store: store
"""
#: What Dask runs in each worker before its first task: the solver of the tests stands in.
PRELOAD = """
import sys
from pathlib import Path
sys.path.insert(0, {root!r})
from modetune.flows.campaign import solvers
from modetune.adapters.solver import Solver
from tests.flows.conftest import ChainDeck, ScriptedProgram
solvers.SOLVERS["matrices"] = lambda model, deck, parameters: Solver(
    ChainDeck(), ScriptedProgram(deck.parent))
"""


STARTER = """
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.updating.update import update_campaign
class Silent:
    def working(self, text): pass
    def iteration(self, record): pass
if __name__ == "__main__":
    import dask
    dask.config.set({"distributed.worker.preload": [str(Path("preload.py").resolve())]})
    campaign = load_campaign(Path("chain-campaign.yaml"), ["sensitivity.difference=forward"])
    update_campaign(campaign, Path("run"), Silent())
"""


@pytest.fixture
def scripted(
    bench: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Iterator[Callable[..., Campaign]]:
    """Loads the campaign above, its solver the scripted one here and in the workers."""
    monkeypatch.setenv("MODETUNE_SITE", str(tmp_path / "site.yaml"))
    (tmp_path / "site.yaml").write_text("run: {}\n")
    monkeypatch.setitem(solvers.SOLVERS, "matrices", lambda model, deck, parameters: bench.solver())
    (tmp_path / "chain.yaml").write_text("")
    (tmp_path / "chain-campaign.yaml").write_text(CAMPAIGN)
    frequencies = bench.measured(TRUTH, (1, 2, 3, 4, 5), shapes=False).frequencies_hz
    table = f"mode,{','.join('12345')}\nfrequency_hz,{','.join(map(repr, frequencies.tolist()))}\n"
    (tmp_path / "measured.csv").write_text(table)
    preload = tmp_path / "preload.py"
    preload.write_text(PRELOAD.format(root=str(ROOT)))
    with dask_library.config.set({"distributed.worker.preload": [str(preload)]}):
        yield lambda *given: load_campaign(tmp_path / "chain-campaign.yaml", list(given))


def modal(k1: float = 1.0, n_modes: int = 6) -> Job:
    return Job({"k1": k1}, ModalAnalysis(n_modes, (1, 2, 3)))


def parent_of(process: int) -> int:
    return int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[1])


def programs_below(folder: Path) -> list[int]:
    """Processes that work in a folder."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            if entry.name.isdigit() and (entry / "cwd").readlink().is_relative_to(folder):
                found.append(int(entry.name))
        except OSError:
            continue
    return found


def alive(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def everything_below(process: int) -> list[int]:
    """A process and all its descendants."""
    children: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with suppress(OSError):
                children.setdefault(parent_of(int(entry.name)), []).append(int(entry.name))
    found, todo = [], [process]
    while todo:
        found.append(todo.pop())
        todo += children.get(found[-1], [])
    return found


def test_a_campaign_ends_like_on_threads_and_arrays_do_not_travel(
    scripted: Any, bench: Any, watcher: Any
) -> None:
    on_workers = update_campaign(scripted(), bench.folder / "run", watcher).record
    assert on_workers.status == "converged"
    np.testing.assert_allclose(on_workers.updated, list(TRUTH.values()), rtol=1e-5)
    runs = bench.runs()
    assert runs == on_workers.runs.modal + on_workers.runs.sensitivity
    assert on_workers.runs.core_s > 0.0  # what it cost comes back with the answers
    local = scripted("run.engine=local", "store=other")
    on_threads = update_campaign(local, bench.folder / "other-run", watcher).record
    assert on_threads.updated.tobytes() == on_workers.updated.tobytes()
    assert bench.runs() == 2 * runs


def test_matrix_jobs_of_parameters_that_share_no_node_are_one_on_dask_too(
    scripted: Any, bench: Any, watcher: Any
) -> None:
    campaign = scripted("sensitivity.method=semi_analytic")
    record = update_campaign(campaign, bench.folder / "run", watcher).record
    assert record.status == "converged"
    # The model, and two jobs of springs that share no mass.
    assert bench.runs("matrices") == record.runs.sensitivity == 3


def test_a_cluster_leaves_the_threads_of_algebra_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Other threads here or in a worker would change the last bits of results."""
    names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    for name in names:
        monkeypatch.setenv(name, "undone after the test")
        monkeypatch.delenv(name)
    with dask_cluster.dask_runner(DaskSection(workers=1), 1, 1) as runner:
        (found,) = runner.client.run(lambda: dict(os.environ)).values()
    assert not set(names) & {*os.environ, *found}


def test_what_the_store_has_needs_no_worker(
    scripted: Any, bench: Any, watcher: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    update_campaign(scripted("run.engine=local"), bench.folder / "run", watcher)
    runs = bench.runs()

    def never(*_: object) -> None:
        raise AssertionError("a worker gets a job")

    monkeypatch.setattr(DaskRunner, "submit", never)
    record = update_campaign(scripted(), bench.folder / "again", watcher).record
    assert record.status == "converged"
    assert bench.runs() == runs


def test_a_worker_killed_in_mid_campaign_costs_one_run_and_no_result(
    scripted: Any, bench: Any, watcher: Any
) -> None:
    bench.script({3: "hang"})
    killed: list[int] = []

    def kill_the_worker_that_hangs() -> None:
        jobs = bench.folder / "store" / "jobs"
        # The initial model and a perturbation a parameter: four jobs, one does not end.
        assert eventually(lambda: bench.runs() == 4 and len(list(jobs.glob("*.part"))) == 1)
        (supervisor,) = [
            pid
            for pid in programs_below(jobs)
            if b"supervisor.py" in Path(f"/proc/{pid}/cmdline").read_bytes()
        ]
        worker = parent_of(parent_of(supervisor))  # between them stands what forks supervisors
        os.kill(worker, signal.SIGKILL)
        killed.append(worker)

    killer = threading.Thread(target=kill_the_worker_that_hangs)
    killer.start()
    campaign = scripted("sensitivity.difference=forward")
    record = update_campaign(campaign, bench.folder / "run", watcher).record
    killer.join()
    assert len(killed) == 1
    assert record.status == "converged"
    np.testing.assert_allclose(record.updated, list(TRUTH.values()), rtol=1e-5)
    stored = [path.name.partition(".")[0] for path in (bench.folder / "store").glob("??/*.h5")]
    assert bench.runs() == len(set(stored)) + 1  # the run that died with its worker


def test_workers_that_die_with_a_job_end_it_with_a_sentence() -> None:
    class KilledWorker(Exception):
        pass

    def result() -> Any:
        raise KilledWorker("gone")

    with pytest.raises(SolverCrashed, match="worker running this job died"):
        dask_result(result, type("Future", (), {"status": "error"}))


def test_stopping_a_campaign_ends_the_solvers_of_its_workers(scripted: Any, bench: Any) -> None:
    bench.script({1: "hang", 2: "hang"})
    jobs = bench.folder / "store" / "jobs"
    ended: list[Exception] = []

    def solve(k1: float) -> None:
        try:
            solve_jobs(engine, [modal(k1)])
        except SolverCancelled as error:
            ended.append(error)

    with solving_engine(scripted()) as engine:
        threads = [threading.Thread(target=solve, args=(k1,)) for k1 in (1.0, 2.0)]
        for thread in threads:
            thread.start()
        assert eventually(lambda: bench.runs() == 2)
        engine.cancelled.set()
        for thread in threads:
            thread.join()
    assert len(ended) == 2
    assert eventually(lambda: not programs_below(jobs))
    assert not list((bench.folder / "store").glob("??/*.h5"))


def test_a_killed_campaign_leaves_no_worker_and_no_solver(scripted: Any, bench: Any) -> None:
    bench.script({2: "hang"})  # the first one is alone
    script = bench.folder / "start.py"
    script.write_text(PRELOAD.format(root=str(ROOT)) + STARTER)
    campaign = subprocess.Popen(
        [sys.executable, str(script)],
        cwd=bench.folder,
        env={**os.environ, "MODETUNE_HOME": str(bench.folder / "home")},
    )
    try:
        assert eventually(lambda: bench.runs() == 4)  # the initial model's jobs, one hangs
        # The campaign itself, two workers, what forks their supervisors, a supervisor, its program.
        assert eventually(lambda: len(everything_below(campaign.pid)) >= 6)
        family = [pid for pid in everything_below(campaign.pid) if pid != campaign.pid]
    finally:
        campaign.kill()
        campaign.wait()
    assert eventually(lambda: not any(alive(pid) for pid in family))


def test_an_error_of_a_solver_comes_back_as_itself(scripted: Any, bench: Any) -> None:
    bench.script({1: "rejected"})
    with (
        solving_engine(scripted()) as engine,
        pytest.raises(SolverRejected, match="refused its input"),
    ):
        solve_jobs(engine, [modal()])


def travelled(campaign: Campaign, job: Job, key: str = "") -> Task:
    """A job's piece of work as it arrives in another process."""
    engine = job_engine(campaign)
    piece = Task((job,), (key or engine.key(job),), engine.attempt, 2, engine.order)
    sent = pickle.dumps(piece)
    assert len(sent) < 64_000
    there = pickle.loads(sent)
    assert isinstance(there, Task)
    return there


def test_a_big_job_travels_in_a_few_kilobytes(scripted: Any) -> None:
    nodes = tuple(range(1_000_000, 1_000_500))
    groups = tuple((f"E_{i}", (f"ELEMENT_SET_{i}",)) for i in range(100))
    values = {f"E_{i}": 1.0 + i / 7 for i in range(100)}
    travelled(scripted(), Job(values, ModalAnalysis(40, nodes, groups)), "0" * 64)


def test_answer_and_warnings_of_a_worker_come_back(
    scripted: Any, bench: Any, caplog: pytest.LogCaptureFixture
) -> None:
    bench.script({1: "killed"})
    answer = retry(travelled(scripted("run.retries=1"), modal()).attempt)
    assert not answer.jobs[0].reused
    assert any("retry 1 of 1" in line for line in answer.warnings)
    assert answer.core_s > 0.0
    assert len(pickle.dumps(answer)) < 4_000
    bench.script({4: "killed"})  # the third run is the first of a cluster
    with solving_engine(scripted("run.retries=1", "store=other")) as engine:
        (first,) = solve_jobs(engine, [modal(1.1)])
        (second,) = solve_jobs(engine, [modal(1.2)])
    assert (first.reused, second.reused) == (False, False)
    assert bench.runs() == 5
    assert any("retry 1 of 1" in line for line in caplog.messages)
    assert engine.costs.core_s > 0.0


def test_an_error_says_after_its_travel_whether_another_try_may_follow() -> None:
    error = SolverCrashed("gone")
    error.again = True
    again = pickle.loads(pickle.dumps(error))
    assert (type(again), again.again, str(again)) == (SolverCrashed, True, "gone")


def test_a_worker_that_would_make_another_job_says_so(scripted: Any) -> None:
    with pytest.raises(CampaignError, match="campaign on all machines"):
        travelled(scripted(), modal(), "0" * 64).attempt()


def test_a_store_that_is_not_shared_is_told(
    scripted: Any, bench: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(execution, "PATIENCE_S", 0.0)
    engine = job_engine(scripted("run.engine=local"))
    with pytest.raises(StorageUnavailable, match="on a disk that all machines share"):
        execution._wait_until_seen(engine, "0" * 64)


def test_a_scheduler_that_does_not_answer_is_told(
    scripted: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dask_cluster, "CONNECT_S", 0.5)
    campaign = scripted("run.dask={scheduler: 'tcp://127.0.0.1:9'}")
    with (
        pytest.raises(CampaignError, match=r"no Dask scheduler answered at tcp://127\.0\.0\.1:9"),
        solving_engine(campaign),
    ):
        pass


@pytest.mark.parametrize(
    ("package", "section"),
    [
        ("distributed", "{workers: 1}"),
        ("cryptography", "{workers: 1}"),
        ("dask_jobqueue", "{cluster: pbs, memory: 2GB}"),
    ],
)
def test_a_missing_package_is_told_before_anything_starts(
    scripted: Any, monkeypatch: pytest.MonkeyPatch, package: str, section: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    told = rf"needs the package {package};.*pip install 'modetune\[cluster\]'"
    with (
        pytest.raises(CampaignError, match=told),
        solving_engine(scripted(f"run.dask={section}")),
    ):
        pass


#: A deck that the real `matrices` solver reads.
DECK = """
masses: {m1: 1.8, m2: 2.4, m3: 1.6, m4: 1.2, m5: 1.1, m6: 0.9}
springs:
  k1: {between: [ground, m1], stiffness: 1500.0}
  k2: {between: [m1, m2], stiffness: 1600.0}
  k3: {between: [m2, m3], stiffness: 1400.0}
  k4: {between: [m3, m4], stiffness: 6500.0}
  k5: {between: [m4, m5], stiffness: 1300.0}
  k6: {between: [m5, m6], stiffness: 1500.0}
  k7: {between: [m6, ground], stiffness: 1300.0}
"""


def test_a_queue_that_refuses_workers_is_told_in_one_sentence(scripted: Any, bench: Any) -> None:
    pytest.importorskip("dask_jobqueue", reason="dask-jobqueue is not installed")
    (bench.folder / "chain.yaml").write_text(DECK)
    programs = bench.folder / "bin"
    programs.mkdir()
    sbatch = programs / "sbatch"
    sbatch.write_text("#!/bin/sh\necho 'sbatch: error: no such account' >&2\nexit 1\n")
    sbatch.chmod(0o755)
    ended = subprocess.run(
        [
            sys.executable,
            "-m",
            "modetune",
            "update",
            "chain-campaign.yaml",
            "--no-prefect",
            "--set",
            "run.dask={cluster: slurm, memory: 1GB, interface: lo}",
        ],
        cwd=bench.folder,
        env={**os.environ, "PATH": f"{programs}:{os.environ['PATH']}"},
        capture_output=True,
        text=True,
        check=False,
        timeout=100,
    )
    assert ended.returncode == 2
    (line,) = [line for line in ended.stderr.splitlines() if line.startswith("modetune: ")]
    assert "the Dask cluster (slurm) did not start" in line
    assert "no such account" in line
    assert "Traceback" not in ended.stderr


def test_a_scheduler_that_runs_is_used_and_left_running(
    scripted: Any, bench: Any, watcher: Any
) -> None:
    with distributed.LocalCluster(
        n_workers=1,
        threads_per_worker=1,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        silence_logs=50,
    ) as cluster:
        campaign = scripted(f"run.dask={{scheduler: '{cluster.scheduler_address}'}}")
        record = update_campaign(campaign, bench.folder / "run", watcher).record
        assert record.status == "converged"
        with distributed.Client(cluster) as client:
            assert client.submit(abs, -1).result() == 1
            assert len(workers_apart(client, "http://127.0.0.1:9/api")) == 1


def test_a_scheduler_that_ends_is_told_and_no_work_waits_for_it(
    scripted: Any, bench: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dask_cluster, "CONNECT_S", 3.0)  # how long the client seeks it
    bench.script({1: "hang", 2: "hang"})
    cluster = distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        silence_logs=50,
    )
    campaign = scripted(f"run.dask={{scheduler: '{cluster.scheduler_address}'}}")

    def end() -> None:
        eventually(lambda: bench.runs() == 2)
        cluster.close()

    ending = threading.Thread(target=end)
    ending.start()
    works = [Work(f"modal {n}", (modal(1.0 + 0.1 * n),)) for n in range(6)]
    with (
        solving_engine(campaign) as engine,
        pytest.raises(CampaignError, match="scheduler was lost"),
    ):
        Execution(engine).run("points", works)
    ending.join()
