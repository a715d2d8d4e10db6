"""`engine: slurm` on a stand-in for srun that notes its arguments, and on a real Slurm node."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from modetune.adapters.solver import ModalAnalysis
from modetune.core.errors import (
    CampaignError,
    SolverCancelled,
    SolverCrashed,
    SolverError,
    SolverExhausted,
    SolverMissing,
    SolverRejected,
    SolverTimeout,
)
from modetune.flows.campaign.schema import SensitivitySection
from modetune.flows.campaign.site import DaskSection, RunSection, SlurmSection, merge_keys
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.jobs.engine import JobEngine
from modetune.flows.jobs.job import Job
from modetune.flows.jobs.slurm import srun_options
from modetune.flows.updating.update import update_campaign
from tests.adapters.solved import needs_ccx
from tests.eventually import eventually
from tests.flows.updating.test_stored_matrices import BAR, update, written

NODE = Path(__file__).resolve().parents[3] / "tools" / "slurm_node.sh"
TRUTH = {"k1": 1.2, "k2": 0.8}
#: srun as far as a job needs it: notes its arguments, then runs the command, or says a line.
FAKE = """#!{python} -IS
import json, os, sys
place = next(i for i, word in enumerate(sys.argv[1:], 1) if not word.startswith("-"))
with open({notes!r}, "a") as notes:
    notes.write(json.dumps(sys.argv[1:place]) + "\\n")
try:
    said = open({said!r}).read()
except FileNotFoundError:
    os.execvp(sys.argv[place], sys.argv[place:])
print(said)
sys.exit(1)
"""


@pytest.fixture(autouse=True)
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The site file, which says nothing yet."""
    path = tmp_path / "site.yaml"
    path.write_text("run: {}\n")
    monkeypatch.setenv("MODETUNE_SITE", str(path))
    monkeypatch.delenv("SLURM_JOB_ID", raising=False)
    return path


@pytest.fixture
def asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], list[list[str]]]:
    """A stand-in for srun on PATH; gives the arguments that it got so far."""
    programs, notes = tmp_path / "bin", tmp_path / "notes"
    programs.mkdir()
    srun = programs / "srun"
    srun.write_text(
        FAKE.format(python=sys.executable, notes=str(notes), said=str(tmp_path / "said"))
    )
    srun.chmod(0o755)
    monkeypatch.setenv("PATH", f"{programs}:{os.environ['PATH']}")
    return lambda: [json.loads(line) for line in notes.read_text().splitlines()]


def on_slurm(bench: Any, **run: Any) -> Any:
    campaign = bench.campaign(TRUTH)
    given = campaign.run.model_dump(exclude_unset=True)
    section = RunSection.model_validate({**given, "engine": "slurm", **run})
    return replace(campaign, run=section.on_site())


def modal(k1: float = 1.0) -> Job:
    return Job({"k1": k1}, ModalAnalysis(6, (1, 2, 3)))


def test_every_job_of_a_campaign_goes_through_srun(bench: Any, watcher: Any, asked: Any) -> None:
    slurm = {"partition": "batch", "account": "dynamics", "options": ["--mem=2G", "--qos=night"]}
    campaign = on_slurm(bench, slurm=slurm, threads=3, licences={"scripted": 2, "other": 1})
    record = update_campaign(campaign, bench.folder / "run", watcher).record
    assert record.status == "converged"
    np.testing.assert_allclose(record.updated, list(TRUTH.values()), rtol=1e-5)
    assert len(asked()) == bench.runs() == record.runs.modal
    assert record.runs.core_s > 0.0
    assert record.runs.licence_s > 0.0
    assert asked()[0] == [
        "--nodes=1", "--ntasks=1", "--kill-on-bad-exit=1", "--quiet", "--input=none",
        "--cpus-per-task=3", "--job-name=modetune-chain", "--time=60",
        "--partition=batch", "--account=dynamics", "--licenses=scripted:1",
        "--mem=2G", "--qos=night",
    ]  # fmt: skip


def test_matrix_jobs_of_parameters_that_share_no_node_are_one_on_slurm_too(
    bench: Any, watcher: Any, asked: Any
) -> None:
    sensitivity = SensitivitySection(method="semi_analytic")
    campaign = replace(on_slurm(bench), sensitivity=sensitivity)
    record = update_campaign(campaign, bench.folder / "run", watcher).record
    assert record.status == "converged"
    # The model, and two jobs of springs that share no mass.
    assert bench.runs("matrices") == record.runs.sensitivity == 3
    assert len(asked()) == bench.runs()


def test_a_result_from_slurm_is_a_result_from_here(bench: Any, asked: Any) -> None:
    outcome = job_engine(on_slurm(bench)).solve(modal())
    assert job_engine(bench.campaign(TRUTH)).solve(modal()).reused
    assert outcome.key == job_engine(bench.campaign(TRUTH)).key(modal())
    assert bench.runs() == 1


def test_inside_an_allocation_jobs_are_its_steps(bench: Any, asked: Any) -> None:
    campaign = on_slurm(bench, slurm={"partition": "batch"}, licences={"scripted": 1})
    limits = job_engine(campaign).limits
    options = srun_options(campaign.run.slurm, "x", 1, 60.0, limits, {"SLURM_JOB_ID": "7"})
    assert "--exact" in options
    assert not any(word.startswith(("--partition", "--licenses")) for word in options)


def test_slurm_and_not_the_machine_counts_cores(bench: Any, asked: Any) -> None:
    campaign = on_slurm(bench, threads=1000, parallel=0)
    assert campaign.parallel == 32
    assert job_engine(campaign).solve(modal()).reused is False
    assert "--cpus-per-task=1000" in asked()[0]
    assert not (bench.folder / "home" / "limits").exists()


@pytest.mark.parametrize(
    ("said", "error", "words"),
    [
        ("slurmstepd-n1: error: *** STEP 1.0 ON n1 CANCELLED AT 2026-01-01 DUE TO TIME LIMIT ***",
         SolverTimeout, "exceeded its time limit"),
        ("slurmstepd: error: *** STEP 9.0 ON n1 CANCELLED AT 2026-01-01 ***",
         SolverCrashed, "cancelled in Slurm"),
        ("slurmstepd: error: Detected 1 oom_kill event in StepId=1.0", SolverExhausted, "memory"),
        ("srun: error: Unable to allocate resources: Invalid license specification",
         SolverMissing, "Invalid license specification"),
        ("slurmstepd-n1: error: execve(): ccx: No such file or directory",
         SolverMissing, "node does not have the solver's program"),
        ("slurmstepd-n1: error: couldn't chdir to `/local': No such file or directory",
         SolverMissing, "disk that all nodes share"),
        ("srun: error: Node failure on n1", SolverCrashed, "node of the job failed"),
        ("REJECTED", SolverRejected, "refused its input"),
        ("a solver that talks of an oom_kill", SolverCrashed, "broke off"),
    ],
)  # fmt: skip
def test_what_slurm_says_is_told_from_what_the_solver_says(
    bench: Any, asked: Any, said: str, error: type[SolverError], words: str
) -> None:
    (bench.folder / "said").write_text(said)
    with pytest.raises(error, match=words) as caught:
        job_engine(on_slurm(bench)).solve(modal())
    assert type(caught.value) is error
    assert len(asked()) == 1


def test_without_srun_one_sentence_says_so(bench: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(bench.folder))
    with pytest.raises(SolverMissing, match="`srun`, which is not on PATH"):
        job_engine(on_slurm(bench))


def test_the_site_file_stands_below_the_campaign(site: Path) -> None:
    site.write_text(
        "run:\n  engine: slurm\n  threads: 4\n  slurm: {partition: batch, account: dynamics}\n"
    )
    run = RunSection.model_validate({"slurm": {"account": "other"}, "parallel": 7}).on_site()
    assert (run.engine, run.parallel, run.threads) == ("slurm", 7, 4)
    assert run.slurm == SlurmSection(partition="batch", account="other")
    assert RunSection.model_validate({"engine": "local"}).on_site().engine == "local"


def test_a_site_file_that_is_named_must_be_there(site: Path) -> None:
    site.unlink()
    with pytest.raises(CampaignError, match="cannot be read"):
        RunSection().on_site()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("run: {engine: moon}", "run.engine"),
        ("run: {slurm: {queue: x}}", "unknown key `queue`"),
        ("run:\n  dask: {workers: 0}", "line 2: run.dask.workers"),
        ("run: {slurm: {partition: '-x y'}}", "partition"),
        ("ran: {}", "unknown key `ran`"),
    ],
)
def test_mistakes_in_the_site_file_are_told_with_their_line(
    site: Path, text: str, words: str
) -> None:
    site.write_text(text)
    with pytest.raises(CampaignError, match=words) as caught:
        RunSection().on_site()
    assert str(site) in str(caught.value)


def test_a_scheduler_and_a_queue_exclude_each_other() -> None:
    with pytest.raises(ValidationError, match="either `scheduler` or `cluster`"):
        DaskSection(scheduler="tcp://host:8786", cluster="slurm", memory="2GB")
    with pytest.raises(ValidationError, match="needs `memory`"):
        DaskSection(cluster="pbs")
    with pytest.raises(ValidationError, match="scheduler"):
        DaskSection(scheduler="host:8786")


def test_mappings_merge_and_all_else_is_replaced() -> None:
    site = {"a": {"x": 1, "y": 2}, "b": [1, 2]}
    assert merge_keys(site, {"a": {"y": 3}, "b": [3]}) == {"a": {"x": 1, "y": 3}, "b": [3]}


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A Slurm cluster of this machine with two licences `scripted`."""
    search = f"{os.environ['PATH']}:/usr/sbin"
    missing = [
        name
        for name in ("srun", "slurmctld", "slurmd", "munged")
        if shutil.which(name, path=search) is None
    ]
    if missing:
        pytest.skip(f"Slurm is not installed: no {', '.join(missing)} (slurm-wlm, munge)")
    folder = tmp_path_factory.mktemp("slurm")
    started = subprocess.run(
        [str(NODE), "start", str(folder), "scripted:1"],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
        timeout=100,
    )
    try:
        if started.returncode != 0:
            pytest.skip(f"a Slurm node does not come up here: {started.stderr.strip()}")
        yield folder
    finally:
        subprocess.run([str(NODE), "stop", str(folder)], check=False, stdin=subprocess.DEVNULL)


@pytest.fixture
def queue(node: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], list[str]]:
    """Slurm's jobs on that node, a line each: state and name."""
    monkeypatch.setenv("SLURM_CONF", str(node / "slurm.conf"))
    command = ["squeue", "--noheader", "--format=%T %j"]
    return lambda: subprocess.run(
        command, capture_output=True, text=True, check=True
    ).stdout.splitlines()


def test_a_campaign_runs_on_a_real_slurm_node(bench: Any, watcher: Any, queue: Any) -> None:
    campaign = on_slurm(bench, licences={"scripted": 1})
    record = update_campaign(campaign, bench.folder / "run", watcher).record
    assert record.status == "converged"
    assert bench.runs() == record.runs.modal
    assert queue() == [] or eventually(lambda: queue() == [])


def test_what_a_real_slurm_refuses_is_told(bench: Any, queue: Any) -> None:
    campaign = on_slurm(bench, slurm={"partition": "moon"})
    with pytest.raises(SolverMissing, match="Slurm refused the job"):
        job_engine(campaign).solve(modal())
    assert bench.runs() == 0


def hold_one_run_and_one_in_the_queue(bench: Any, queue: Any) -> tuple[JobEngine, list[Any]]:
    """Two jobs on one licence: the first hangs, the second waits in Slurm's queue."""
    bench.script({1: "hang"})
    engine = job_engine(on_slurm(bench, licences={"scripted": 1}))
    ended: list[Any] = []

    def solve(k1: float) -> None:
        try:
            engine.solve(modal(k1))
        except SolverError as error:
            ended.append(error)

    threads = [threading.Thread(target=solve, args=(k1,)) for k1 in (1.0, 2.0)]
    threads[0].start()
    assert eventually(lambda: bench.runs() == 1)
    threads[1].start()
    assert eventually(lambda: sorted(line.split()[0] for line in queue()) == ["PENDING", "RUNNING"])
    return engine, [ended, *threads]


def test_stopping_ends_running_and_waiting_jobs_in_slurm(bench: Any, queue: Any) -> None:
    engine, (ended, *threads) = hold_one_run_and_one_in_the_queue(bench, queue)
    engine.cancelled.set()
    for thread in threads:
        thread.join()
    assert [type(error) for error in ended] == [SolverCancelled] * 2
    assert eventually(lambda: queue() == [])
    assert bench.runs() == 1  # the one that waited never came


def test_a_job_cancelled_in_slurm_is_tried_again(bench: Any, queue: Any) -> None:
    bench.script({1: "hang"})
    retries = {"stopped": 1, "timeout": 0, "no_result": 0}
    engine = job_engine(on_slurm(bench, retries=retries))
    done: list[Any] = []
    thread = threading.Thread(target=lambda: done.append(engine.solve(modal())))
    thread.start()
    assert eventually(lambda: bench.runs() == 1)
    subprocess.run(["scancel", "--name=modetune-chain"], check=True)
    thread.join()
    assert len(done) == 1
    assert bench.runs() == 2


@needs_ccx
def test_matrices_of_a_model_come_from_slurm_and_modes_are_found_here(
    tmp_path: Path, watcher: Any, asked: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By `auto`: two matrix jobs and the last modal one go through srun, and end where jobs of
    this machine do."""
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))
    monkeypatch.setattr("modetune.flows.updating.mode_source.RUN_S", 10.0)
    file = written(BAR, tmp_path / "bar")
    here = update(file, tmp_path / "here", watcher)
    there = update(file, tmp_path / "there", watcher, "run.engine=slurm")
    assert len(asked()) == there.runs.modal + there.runs.sensitivity == 3
    assert there.iterations[0].solved_by == "stored matrices"
    np.testing.assert_array_equal(there.updated, here.updated)
