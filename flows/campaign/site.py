"""How and where jobs run: `run` in the campaign file, and defaults in the site file.

A site file has the settings of all campaigns of a site, under the campaign's own keys, so that
campaign files stay portable:

    run:
      engine: slurm
      slurm: {partition: batch, account: dynamics}

It is `~/.config/modetune/site.yaml`, or the file that MODETUNE_SITE names. A campaign's own keys
override those of the site.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, field_validator, model_validator

from modetune.adapters.yaml_file import read_yaml
from modetune.core.errors import CampaignError
from modetune.core.storage.files import machine_user
from modetune.core.updating.verdict import FailOn
from modetune.flows.responses.section import Name, Positive, Section, section_problems

#: Environment variable with the path of a site file.
SITE_VARIABLE = "MODETUNE_SITE"
#: Environment variable with the user's folder: shared server, limits, passed self-tests.
HOME_VARIABLE = "MODETUNE_HOME"
#: Default number of jobs that Slurm gets at the same time.
SLURM_QUEUE = 32

Engine = Literal["local", "slurm", "dask"]
#: One argument for Slurm or a line of a batch script: no line ends, and no empty word.
Word = Annotated[str, Field(pattern=r"^[^\x00-\x1f]+$", max_length=1000)]
#: A name that becomes part of an argument.
Label = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.,:@+-]*$", max_length=200)]

#: How often one kind of failure is tried again.
Retries = Annotated[int, Field(ge=0, le=10)]


class SlurmSection(Section):
    """Options of `srun` in addition to threads and licences."""

    partition: Label | None = None
    """Partition to which jobs are submitted."""
    account: Label | None = None
    """Account to which jobs are charged."""
    time: Label | None = None
    """Time limit of one job in Slurm's notation; without it `run.timeout_s`."""
    options: tuple[Word, ...] = ()
    """Further options of `srun`, as a list."""


class DaskSection(Section):
    """The Dask cluster: a running scheduler, processes on this machine, or jobs in a queue.

    memory, walltime, queue, account, interface, directives and prologue apply to jobs that modetune
    submits to a queue (slurm, pbs, lsf).
    """

    scheduler: Annotated[str, Field(pattern=r"^(tcp|tls)://\S+:\d+$")] | None = None
    """Address of a running scheduler, `tcp://host:8786` or `tls://...`."""
    cluster: Literal["local", "slurm", "pbs", "lsf"] = "local"
    """Where workers start: on this machine, or in a queue."""
    workers: Annotated[int, Field(ge=1, le=1024)] = 2
    """Number of workers."""
    memory: Label | None = None
    """Memory that a job in the queue may use, such as `4GB`."""
    walltime: Label | None = None
    """Time limit of a job in the queue, such as `02:00:00`."""
    queue: Label | None = None
    """Queue or partition to which jobs are submitted."""
    account: Label | None = None
    """Account to which jobs are charged."""
    interface: Label | None = None
    """Network interface through which workers communicate."""
    directives: tuple[Word, ...] = ()
    """Further lines for the head of the batch script."""
    prologue: tuple[Word, ...] = ()
    """Shell lines that the batch script runs before the worker."""

    @model_validator(mode="after")
    def _sound(self) -> DaskSection:
        if self.scheduler is not None and self.cluster != "local":
            raise ValueError("give either `scheduler` or `cluster`")
        if self.cluster != "local" and self.memory is None:
            raise ValueError(f"cluster {self.cluster} needs `memory`, what a job may use (4GB)")
        return self

    @property
    def here(self) -> bool:
        """Whether the workers are processes of this machine that share its cores with others."""
        return self.scheduler is None and self.cluster == "local"


class RetriesSection(Section):
    """How often to retry a job, by its outcome; a single number applies to all."""

    stopped: Retries = 2
    """Retries of a job that was killed or that crashed."""
    timeout: Retries = 1
    """Retries of a job that ran longer than `timeout_s`."""
    no_result: Retries = 1
    """Retries of a job that ended normally without a valid result."""


class SiteRun(Section):
    """How jobs run: the keys that a site file may set too."""

    parallel: Annotated[int, Field(ge=0, le=1024)] = 0
    """Number of jobs in parallel; 0: one per core."""
    threads: Annotated[int, Field(ge=0, le=1024)] = 0
    """Threads per job; 0: the cores divided among the parallel jobs."""
    licences: dict[Name, Annotated[int, Field(ge=1, le=10_000)]] = Field(default={})
    """Maximum number of parallel jobs of a solver on this machine, by the solver's name."""
    licence_messages: tuple[Word, ...] = ()
    """Further messages (parts of lines) by which a solver reports that no licence is free."""
    disk_gb: Positive = 100.0
    """Maximum disk space for the files and output of one job [GB]"""
    memory_gb: Positive | None = None
    """Memory of this machine for parallel jobs and for factors, which go to disk if they do not
    fit; without it the memory of the machine or container [GB]"""
    engine: Engine = "local"
    """Where jobs run: on this machine, under Slurm, or on a Dask cluster."""
    slurm: SlurmSection = SlurmSection()
    """Options of Slurm."""
    dask: DaskSection = DaskSection()
    """The Dask cluster."""
    prefect: bool = True
    """Whether Prefect coordinates the run; if not, a plain thread pool does."""
    fail_on: FailOn = "never"
    """Verdicts that make an update whose e1 is met fail, with exit code 6 and a flow run of type
    Failed: `not-trusted`; `doubt`, any verdict but trusted; or `never`. With `change` an update
    fails, with exit code 7, where the structure has changed over its runs, whatever the verdict."""
    keep: Annotated[int, Field(ge=0, le=100_000)] = 10
    """Number of runs whose record, report and deck stay in `history` below the run folder. The
    past runs of the history stay for ever."""


class RunSection(SiteRun):
    """How jobs run."""

    retries: RetriesSection = RetriesSection()
    """How often to retry a job, by its outcome; a single number applies to all."""
    failed_column: Literal["leave_out", "stop"] = "leave_out"
    """What to do if a sensitivity column is unavailable: leave it out this time, or stop."""
    timeout_s: Positive = 3600.0
    """Time limit of one job [s]"""
    licence_pause_s: Positive = 30.0
    """First pause of a job that got no licence; each further pause is half as long again [s]"""
    licence_wait_s: Positive = 86400.0
    """Longest wait for a licence, after which the job has failed [s]"""
    keep_jobs: bool = False
    """Keep the folders of successful jobs; those of failed jobs are always kept."""

    @property
    def here(self) -> bool:
        """Whether jobs run on this machine and share its cores with others."""
        return self.engine == "local" or (self.engine == "dask" and self.dask.here)

    def on_site(self) -> RunSection:
        """Return these keys over those of the site file. Raises CampaignError, ValidationError."""
        return RunSection.model_validate(with_site(self.model_dump(exclude_unset=True)))

    @field_validator("retries", mode="before")
    @classmethod
    def _one_number_for_all(cls, given: object) -> object:
        if isinstance(given, int) and not isinstance(given, bool):
            return dict.fromkeys(("stopped", "timeout", "no_result"), given)
        return given


class SiteFile(Section):
    """A whole site file."""

    run: SiteRun = SiteRun()
    """Settings for the jobs of all campaigns of the site."""


def user_home() -> Path:
    """Return the user's folder, which several machines may share."""
    named = os.environ.get(HOME_VARIABLE)
    if named:
        return Path(named)
    base = os.environ.get("XDG_DATA_HOME") or str(Path.home() / ".local" / "share")
    return Path(base) / "modetune"


def machine_home(base: Path) -> Path:
    """Return the folder of this machine and user below a shared one."""
    return base / machine_user()


def server_home() -> Path:
    """Return the folder of this machine and user."""
    return machine_home(user_home())


def site_path() -> Path:
    """Return the path of the site file, which may be missing."""
    named = os.environ.get(SITE_VARIABLE)
    return Path(named) if named else Path("~/.config/modetune/site.yaml").expanduser()


def site_run() -> dict[str, Any]:
    """Return the `run` keys of the site file; none where there is no file.

    Raises CampaignError where it cannot be read, or is named and missing.
    """
    path = site_path()
    if not path.is_file() and SITE_VARIABLE not in os.environ:
        return {}
    source = read_yaml(path, "a site file")
    try:
        site = SiteFile.model_validate(source.data)
    except ValidationError as error:
        problems = section_problems(error, source, SiteFile, "site")
        raise CampaignError(problems) from None
    return site.run.model_dump(exclude_unset=True)


def merge_keys(site: dict[str, Any], campaign: dict[str, Any]) -> dict[str, Any]:
    """Return the site's keys overridden by the campaign's: mappings key by key, values whole."""
    both = dict(site)
    for key, value in campaign.items():
        below = both.get(key)
        both[key] = (
            merge_keys(below, value)
            if isinstance(below, dict) and isinstance(value, dict)
            else value
        )
    return both


def with_site(run: dict[str, Any]) -> dict[str, Any]:
    """Return the campaign's `run` keys over the site's, with a cluster's number of jobs.

    Raises CampaignError for the site file, ValidationError for keys that exclude each other.
    """
    both = merge_keys(site_run(), run)
    if both.get("engine") == "slurm":
        return _filled(both, SLURM_QUEUE, 1)
    if both.get("engine") == "dask":
        section = DaskSection.model_validate(both.get("dask", {}))
        return _filled(both, section.workers, 0 if section.here else 1)
    return both


def _filled(run: dict[str, Any], parallel: int, threads: int) -> dict[str, Any]:
    return {
        **run,
        "parallel": run.get("parallel") or parallel,
        "threads": run.get("threads") or threads,
    }
