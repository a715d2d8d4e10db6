"""`engine: slurm`: every solver command runs through `srun`; Slurm counts cores and licences.

The campaign runs where it was started, with one thread per job; job folders are on a disk that the
nodes share. Slurm ends a job that exceeds its time, without the waiting time in the queue. The
messages of srun and its daemons in the log distinguish jobs that Slurm ended from solver failures.
"""

from __future__ import annotations

import math
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
from modetune.flows.jobs.limits import CORES, Limit

LAUNCHER = Path(__file__).with_name("srun.py")
MISSING = (
    "`engine: slurm` needs Slurm's program `srun`, which is not on PATH; start the campaign on a "
    "machine of the cluster, or use `engine: local`"
)
#: Slurm's messages, the error that each means, and a sentence for the user.
MESSAGES: tuple[tuple[str, type[SolverError], str], ...] = (
    ("DUE TO TIME LIMIT", SolverTimeout,
     "the job exceeded its time limit in Slurm; raise `run: timeout_s` or `run.slurm.time`"),
    ("oom_kill", SolverExhausted, "the job exceeded its memory limit in Slurm"),
    ("oom-kill", SolverExhausted, "the job exceeded its memory limit in Slurm"),
    ("Unable to allocate resources", SolverMissing,
     "Slurm refused the job; check `run.slurm` and `run.licences` in campaign and site file"),
    ("error: execve():", SolverMissing, "the job's node does not have the solver's program"),
    ("couldn't chdir to", SolverMissing,
     "the job's node does not have its folder; put the store on a disk that all nodes share"),
    ("CANCELLED AT", SolverCrashed, "the job was cancelled in Slurm"),
    ("Node failure", SolverCrashed, "the node of the job failed"),
)  # fmt: skip
#: How Slurm's lines in the log begin.
PREFIXES = ("srun:", "slurmstepd")


@dataclass(frozen=True, slots=True)
class SlurmLauncher:
    """Starts programs by `srun` with these options."""

    options: tuple[str, ...]

    def wrapped(self, command: Command) -> Command:
        start = (sys.executable, "-I", "-S", str(LAUNCHER))
        return replace(command, arguments=(*start, *self.options, *command.arguments))

    def check(self, folder: Path, return_code: int) -> None:
        """Raise the error that Slurm's messages in the log mean, if there are any."""
        lines = [line for line in read_log(folder).splitlines() if line.startswith(PREFIXES)]
        for words, error, meaning in MESSAGES:
            line = next((line for line in lines if words in line), None)
            if line is not None:
                raise error(f"{meaning} (job in {folder}):\n  | {line}")
        if return_code in (128 + 9, 128 + 15):
            raise SolverCrashed(f"the job was killed under Slurm in {folder}\n{log_tail(folder)}")


def srun_options(
    slurm: SlurmSection,
    job_name: str,
    threads: int,
    timeout_s: float,
    limits: tuple[Limit, ...],
    environment: Mapping[str, str],
) -> tuple[str, ...]:
    """Return the options of `srun` for a solver command. Raises SolverMissing without srun.

    Inside an allocation (`sbatch`, `salloc`) jobs are its steps: partition, account and licences
    are the allocation's, and the steps share its cores.
    """
    if shutil.which("srun") is None:
        raise SolverMissing(MISSING)
    options = ["--nodes=1", "--ntasks=1", "--kill-on-bad-exit=1", "--quiet", "--input=none"]
    options += [f"--cpus-per-task={threads}", f"--job-name=modetune-{job_name}"]
    options.append(f"--time={slurm.time or math.ceil(timeout_s / 60)}")
    if "SLURM_JOB_ID" in environment:
        return (*options, "--exact", *slurm.options)
    named = {
        "partition": slurm.partition,
        "account": slurm.account,
        "licenses": _licences(limits),
    }
    options += [f"--{key}={value}" for key, value in named.items() if value]
    return (*options, *slurm.options)


def _licences(limits: tuple[Limit, ...]) -> str:
    return ",".join(f"{item.name}:{item.taken}" for item in limits if item.name != CORES)
