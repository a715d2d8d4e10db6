"""The stored result nearest to a job, found by the store's index and told by the entry itself."""

from __future__ import annotations

from collections.abc import Sequence

from modetune.core.storage.store import Store
from modetune.flows.jobs.explain import AskedJob, Nearest, Texts, asked_of, differences_with_places
from modetune.flows.jobs.store_index import ask_index


def nearest(store: Store, jobs: Sequence[AskedJob], texts: Texts) -> list[Nearest | None]:
    """For each job the stored result nearest to it other than its own; None in an empty store.

    texts: the deck's lines by the digest of a model, where they are known.
    """
    if not jobs:
        return []
    keys = ask_index(store, lambda index: [index.nearest(job) for job in jobs])
    return [_told(store, job, near, texts) for job, near in zip(jobs, keys, strict=True)]


def _told(store: Store, job: AskedJob, keys: Sequence[str], texts: Texts) -> Nearest | None:
    for key in keys:
        holding = store.holding(key)
        if holding is not None:
            return Nearest(key, differences_with_places(job, asked_of(holding), texts))
    return None
