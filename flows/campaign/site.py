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
    """What `srun` is told besides threads and licences; time: of one job, in Slurm's notation."""

    partition: Label | None = None
    """Partition that jobs go to."""
    account: Label | None = None
    """Account that they are charged to."""
    time: Label | None = None
    """Time limit of one job in Slurm's notation; without it `run.timeout_s`."""
    options: tuple[Word, ...] = ()
    """More options of `srun`, one a word."""


class DaskSection(Section):
    """The Dask cluster: a scheduler that runs, processes of this machine, or jobs of a queue.

    memory, walltime, queue, account, interface, directives and prologue are of the jobs that a
    queue (slurm, pbs, lsf) is asked for.
    """

    scheduler: Annotated[str, Field(pattern=r"^(tcp|tls)://\S+:\d+$")] | None = None
    """Address of a scheduler that runs, `tcp://host:8786` or `tls://...`."""
    cluster: Literal["local", "slurm", "pbs", "lsf"] = "local"
    """What workers are started on: this machine, or a queue."""
    workers: Annotated[int, Field(ge=1, le=1024)] = 2
    """How many workers."""
    memory: Label | None = None
    """What a job of the queue may use, `4GB`."""
    walltime: Label | None = None
    """How long it may run, `02:00:00`."""
    queue: Label | None = None
    """Queue or partition that it goes to."""
    account: Label | None = None
    """Account that it is charged to."""
    interface: Label | None = None
    """Network interface that workers speak over."""
    directives: tuple[Word, ...] = ()
    """More lines of the batch script's head, one a line."""
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
    """How often a job is tried again, by what became of it; a plain number goes for all."""

    stopped: Retries = 2
    """A job that was killed or broke off."""
    timeout: Retries = 1
    """A job that ran longer than `timeout_s`."""
    no_result: Retries = 1
    """A job that ended well and left what is not a result."""


class SiteRun(Section):
    """What a site, too, may say of how jobs run."""

    parallel: Annotated[int, Field(ge=0, le=1024)] = 0
    """Jobs at the same time; 0: as many as there are cores."""
    threads: Annotated[int, Field(ge=0, le=1024)] = 0
    """Threads of each job; 0: the cores, shared out among parallel jobs."""
    licences: dict[Name, Annotated[int, Field(ge=1, le=10_000)]] = Field(default={})
    """Jobs of a solver that may run at the same time on the machine, by its name."""
    licence_messages: tuple[Word, ...] = ()
    """What a solver prints where no licence is free, besides what is known: parts of lines."""
    disk_gb: Positive = 100.0
    """Disk that the files and the output of one job may take [GB]"""
    memory_gb: Positive | None = None
    """Memory of this machine that the campaign may take: jobs side by side, and factors, which go
    to disk where they do not fit; without it what machine or container have [GB]"""
    engine: Engine = "local"
    """Where jobs run: here, under Slurm, or on a Dask cluster."""
    slurm: SlurmSection = SlurmSection()
    """What Slurm is told."""
    dask: DaskSection = DaskSection()
    """The Dask cluster."""
    prefect: bool = True
    """Prefect coordinates the run; off: a plain thread pool."""


class RunSection(SiteRun):
    """How jobs run."""

    retries: RetriesSection = RetriesSection()
    """How often a job is tried again, by what became of it; one number goes for all."""
    failed_column: Literal["leave_out", "stop"] = "leave_out"
    """A sensitivity column that is unavailable: go on without it this time, or stop."""
    timeout_s: Positive = 3600.0
    """Longest run of one job [s]"""
    licence_pause_s: Positive = 30.0
    """First pause of a job that got no licence; it grows by half each time [s]"""
    licence_wait_s: Positive = 86400.0
    """After this wait for a licence the job is given up [s]"""
    keep_jobs: bool = False
    """Keep the folders of good jobs; those of failed ones are always kept."""

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
    """What holds for the jobs of all campaigns of the site."""


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
