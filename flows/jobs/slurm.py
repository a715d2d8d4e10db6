"""`engine: slurm`: every solver command goes through `srun`, and Slurm counts cores and licences.

The campaign itself stays where it was started, with a thread a job; the job's folder is on a disk
that the nodes share. Slurm ends a job that runs out of time; the time it waits in the queue does
not count. What srun and its daemons say in the log tells a job that Slurm ended from one that the
solver ended.
"""

from __future__ import annotations

import math
import os
import shutil
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from modetune.adapters.process import log_tail, read_log
from modetune.adapters.solver import Command
from modetune.core.errors import (
    SolverCrashed,
    SolverError,
    SolverExhausted,
    SolverMissing,
    SolverTimeout,
)
from modetune.flows.campaign.site import SlurmSection
from modetune.flows.jobs.engine import JobEngine
from modetune.flows.jobs.limits import CORES, Limit, MachineLimits

LAUNCHER = Path(__file__).with_name("srun.py")
MISSING = (
    "`engine: slurm` needs Slurm's program `srun`, which is not on PATH here; start the campaign "
    "on a machine of the cluster, or use `engine: local`"
)
#: What Slurm says of a job, the error it means, and what it means for people.
SAID: tuple[tuple[str, type[SolverError], str], ...] = (
    ("DUE TO TIME LIMIT", SolverTimeout,
     "Slurm ended the job because its time was over; raise `run: timeout_s` or `run.slurm.time`"),
    ("oom_kill", SolverExhausted, "Slurm ended the job because it wanted more memory than it has"),
    ("oom-kill", SolverExhausted, "Slurm ended the job because it wanted more memory than it has"),
    ("Unable to allocate resources", SolverMissing,
     "Slurm refused the job; look at `run.slurm` and `run.licences` in campaign and site file"),
    ("error: execve():", SolverMissing, "the solver's program is not on the node of the job"),
    ("couldn't chdir to", SolverMissing,
     "the job's folder is not on its node; the store must be on a disk that all nodes share"),
    ("CANCELLED AT", SolverCrashed, "the job was cancelled in Slurm"),
    ("Node failure", SolverCrashed, "the node of the job failed"),
)  # fmt: skip
#: Who speaks in a line of the log that is Slurm's.
SPEAKERS = ("srun:", "slurmstepd")


@dataclass(frozen=True, slots=True)
class SlurmLauncher:
    """Starts programs by `srun`. options: what it is told before a solver's command."""

    options: tuple[str, ...]

    def wrapped(self, command: Command) -> Command:
        start = (sys.executable, "-I", "-S", str(LAUNCHER))
        return replace(command, arguments=(*start, *self.options, *command.arguments))

    def check(self, folder: Path, return_code: int) -> None:
        """Raise the error that Slurm's lines in the log mean; nothing where it has said none."""
        lines = [line for line in read_log(folder).splitlines() if line.startswith(SPEAKERS)]
        for words, error, meaning in SAID:
            line = next((line for line in lines if words in line), None)
            if line is not None:
                raise error(f"{meaning} (job in {folder}):\n  | {line}")
        if return_code in (128 + 9, 128 + 15):
            raise SolverCrashed(f"the job was killed under Slurm in {folder}\n{log_tail(folder)}")


def on_slurm(engine: JobEngine, slurm: SlurmSection, name: str) -> JobEngine:
    """An engine whose jobs Slurm runs. name: the campaign's, for the job. Raises SolverMissing."""
    if shutil.which("srun") is None:
        raise SolverMissing(MISSING)
    options = srun_options(engine, slurm, name, os.environ)
    policy = engine.policy
    return replace(
        engine,
        launcher=SlurmLauncher(options),
        counter=MachineLimits(None),
        # Slurm's own limit ends a job that runs; this one ends one that never gets to.
        policy=replace(policy, timeout_s=policy.timeout_s + policy.licence_wait_s),
    )


def srun_options(
    engine: JobEngine, slurm: SlurmSection, name: str, environment: Mapping[str, str]
) -> tuple[str, ...]:
    """What `srun` is told before the solver's command.

    Inside an allocation (`sbatch`, `salloc`) jobs are steps of it: partition, account and licences
    are the allocation's, and steps share its cores.
    """
    options = ["--nodes=1", "--ntasks=1", "--kill-on-bad-exit=1", "--quiet", "--input=none"]
    options += [f"--cpus-per-task={engine.threads}", f"--job-name=modetune-{name}"]
    options.append(f"--time={slurm.time or math.ceil(engine.policy.timeout_s / 60)}")
    if "SLURM_JOB_ID" in environment:
        return (*options, "--exact", *slurm.options)
    named = {
        "partition": slurm.partition,
        "account": slurm.account,
        "licenses": _licences(engine.limits),
    }
    options += [f"--{key}={value}" for key, value in named.items() if value]
    return (*options, *slurm.options)


def _licences(limits: tuple[Limit, ...]) -> str:
    return ",".join(f"{item.name}:{item.taken}" for item in limits if item.name != CORES)
