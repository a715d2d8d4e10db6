"""Ctrl-C in commands whose finished jobs are kept."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from modetune.core.errors import CampaignStopped


@contextmanager
def stoppable(
    said: str = "stopped; finished jobs are in the store, the same command goes on from there",
) -> Iterator[None]:
    """Turn Ctrl-C into the error that says how to go on."""
    try:
        yield
    except KeyboardInterrupt:
        raise CampaignStopped(said) from None
