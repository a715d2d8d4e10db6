"""How a campaign's jobs run: `run` in the campaign file."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator

from modetune.flows.execution.site import DaskSection, Engine, SlurmSection, with_site
from modetune.flows.section import Name, Positive, Section

Retries = Annotated[int, Field(ge=0, le=10)]


class RetriesSection(Section):
    """How often a job is tried again, by what became of it; a plain number goes for all."""

    stopped: Retries = 2
    """A job that was killed or broke off."""
    timeout: Retries = 1
    """A job that ran longer than `timeout_s`."""
    no_result: Retries = 1
    """A job that ended well and left what is no result."""


class RunSection(Section):
    """How jobs run."""

    parallel: Annotated[int, Field(ge=0, le=1024)] = 0
    """Jobs at the same time; 0: as many as there are cores."""
    threads: Annotated[int, Field(ge=0, le=1024)] = 0
    """Threads of each job; 0: the cores, shared out among parallel jobs."""
    licences: dict[Name, Annotated[int, Field(ge=1, le=10_000)]] = Field(default={})
    """Jobs of a solver that may run at the same time on the machine, by its name."""
    retries: RetriesSection = RetriesSection()
    """How often a job is tried again, by what became of it; one number goes for all."""
    failed_column: Literal["leave_out", "stop"] = "leave_out"
    """A sensitivity column that cannot be had: go on without it this time, or stop."""
    timeout_s: Positive = 3600.0
    """Longest run of one job [s]"""
    licence_pause_s: Positive = 30.0
    """First pause of a job that got no licence; it grows by half each time [s]"""
    licence_wait_s: Positive = 86400.0
    """After this wait for a licence the job is given up [s]"""
    keep_jobs: bool = False
    """Keep the folders of good jobs; those of failed ones are always kept."""
    engine: Engine = "local"
    """Where jobs run: here, under Slurm, or on a Dask cluster."""
    slurm: SlurmSection = SlurmSection()
    """What Slurm is told."""
    dask: DaskSection = DaskSection()
    """The Dask cluster."""

    @property
    def here(self) -> bool:
        """Whether jobs run on this machine and share its cores with others."""
        return self.engine == "local" or (self.engine == "dask" and self.dask.here)

    def on_site(self) -> RunSection:
        """With what the site file says beneath. Raises CampaignError, ValidationError."""
        return RunSection.model_validate(with_site(self.model_dump(exclude_unset=True)))

    @field_validator("retries", mode="before")
    @classmethod
    def _one_number_for_all(cls, given: object) -> object:
        if isinstance(given, int) and not isinstance(given, bool):
            return dict.fromkeys(("stopped", "timeout", "no_result"), given)
        return given
