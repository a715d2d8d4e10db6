"""Arguments and options that several commands have, and how Ctrl-C ends those that keep jobs."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modetune.core.errors import CampaignError, CampaignStopped

if TYPE_CHECKING:
    from modetune.core.storage.store import Store
    from modetune.flows.campaign.campaign import Campaign
    from modetune.flows.updating.prefect import Pages

CampaignPath = Annotated[Path, typer.Argument(help="Campaign file (YAML).")]
ModelPath = Annotated[Path, typer.Argument(help="Campaign file (YAML), or a deck.")]
TestPath = Annotated[
    Path | None,
    typer.Argument(
        help="Test in place of the campaign's own; several files of one test with commas."
    ),
]
SolverChoice = Annotated[
    str | None,
    typer.Option(
        "--solver",
        help="Of a deck: calculix, nastran, mystran, matrices; else the first that is here and "
        "takes it.",
    ),
]
UnitsChoice = Annotated[
    str | None,
    typer.Option(
        "--units",
        help="Of a deck: m-kg-s, mm-t-s, in-slinch-s, ft-slug-s; else guessed from its materials "
        "and told.",
    ),
]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", help="KEY.KEY=VALUE over the campaign file; may be repeated."),
]
At = Annotated[
    list[str] | None,
    typer.Option(help="NAME=VALUE of a parameter, relative to the deck; may be repeated."),
]
Runs = Annotated[Path, typer.Option(help="Where run folders go.")]
Figures = Annotated[Path | None, typer.Option(help="Folder for figures (PNG).")]
Page = Annotated[
    Path | None, typer.Option(help="HTML page with its tables and charts, one file (.html).")
]
NoPrefect = Annotated[
    bool,
    typer.Option("--no-prefect", envvar="MODETUNE_NO_PREFECT", help="Without Prefect's pages."),
]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]


StorePlace = Annotated[
    Path | None,
    typer.Option(
        "--store",
        help="Folder of the store, or a campaign file that names it; else MODETUNE_STORE, or "
        ".modetune/store.",
    ),
]


def store_and_campaign(given: Path | None) -> tuple[Store, Campaign | None]:
    """The store that was named, by its folder or by a campaign. Raises CampaignError."""
    from modetune.core.storage.store import Store

    place = given or Path(os.environ.get("MODETUNE_STORE") or ".modetune/store")
    if not place.exists():
        raise CampaignError(f"{place} is not there; name a store or a campaign file with --store")
    if not place.is_file():
        return Store(place), None
    from modetune.flows.campaign.campaign import load_campaign

    campaign = load_campaign(place)
    return campaign.store, campaign


#: The pages of the run that a server started, in its process.
_given: ContextVar[Pages | None] = ContextVar("given", default=None)


@contextmanager
def on_pages(pages: Pages) -> Iterator[None]:
    """Commands in here are on the pages of a run that a server started."""
    token = _given.set(pages)
    try:
        yield
    finally:
        _given.reset(token)


@contextmanager
def paged(flow: str, name: str, without: bool) -> Iterator[Pages | None]:
    """The pages of a run on Prefect's server, unless it goes without; those of the run that a
    server started where this is its process. Their address goes to standard error."""
    given = _given.get()
    if given is not None or without:
        yield given
        return
    from modetune.flows.updating.prefect import shown

    def tell(address: str) -> None:
        typer.echo(f"this run's page: {address}", err=True)

    with shown(name, flow=flow, address=tell) as pages:
        yield pages


def with_model(settings: list[str] | None, solver: str | None, units: str | None) -> list[str]:
    """Settings with those of `--solver` and `--units`."""
    named = {"model.solver": solver, "model.units": units}
    return [*(settings or []), *(f"{key}={value}" for key, value in named.items() if value)]


@contextmanager
def begun(text: str) -> Iterator[Callable[[str], None]]:
    """Say at once what begins, then the jobs of what is in here; gives what tells what is done."""
    from modetune.flows.campaign.terminal import terminal
    from modetune.flows.jobs.progress import JobProgress

    with JobProgress(terminal(stderr=True)).shown() as progress:
        progress.working(text)
        yield progress.working


@contextmanager
def stoppable(
    said: str = "stopped; finished jobs are in the store, the same command goes on from there",
) -> Iterator[None]:
    """Turn Ctrl-C into the error that says how to go on."""
    try:
        yield
    except KeyboardInterrupt:
        raise CampaignStopped(said) from None
