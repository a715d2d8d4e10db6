"""Options of several commands apart from those of studies, and the handling of Ctrl-C."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modetune.core.errors import CampaignError, CampaignStopped

if TYPE_CHECKING:
    from modetune.core.storage.store import Store
    from modetune.flows.campaign.campaign import Campaign

NoPrefect = Annotated[
    bool,
    typer.Option(
        "--no-prefect",
        envvar="MODETUNE_NO_PREFECT",
        help="Run the jobs in a thread pool, without Prefect.",
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")]


StorePlace = Annotated[
    Path | None,
    typer.Option(
        "--store",
        help="Folder of the store, or a campaign file that names it; default: "
        "MODETUNE_STORE, or .modetune/store.",
    ),
]


def store_and_campaign(given: Path | None) -> tuple[Store, Campaign | None]:
    """Return the store given by its folder or by a campaign. Raises CampaignError."""
    from modetune.core.storage.store import Store

    place = given or Path(os.environ.get("MODETUNE_STORE") or ".modetune/store")
    try:
        there = place.exists()
    except OSError as error:  # in a folder of another account
        raise CampaignError(f"{place} cannot be read: {error.strerror}") from None
    if not there:
        raise CampaignError(f"{place} does not exist; name a store or a campaign file with --store")
    if not place.is_file():
        return Store(place), None
    from modetune.flows.campaign.campaign import load_campaign

    campaign = load_campaign(place)
    return campaign.store, campaign


@contextmanager
def show_progress(text: str) -> Iterator[Callable[[str], None]]:
    """Show progress, starting with this text; yields a function that shows the next text."""
    from modetune.flows.jobs.progress import JobProgress
    from modetune.flows.report.terminal import terminal

    with JobProgress(terminal(stderr=True)).shown() as progress:
        progress.working(text)
        yield progress.working


@contextmanager
def stoppable(
    said: str = "stopped; finished jobs are stored, and the same command continues from there",
) -> Iterator[None]:
    """Turn Ctrl-C into an error that explains how to continue."""
    try:
        yield
    except KeyboardInterrupt:
        raise CampaignStopped(said) from None
