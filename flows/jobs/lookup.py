"""Look up jobs in a store: by the start of a key, in any state, and the nearest to a job."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from modetune.adapters.process import LOG, log_tail
from modetune.core.errors import CampaignError
from modetune.core.storage.store import Store
from modetune.flows.jobs.deck_texts import kept_text
from modetune.flows.jobs.explain import (
    AskedJob,
    Nearest,
    Texts,
    asked_by_note,
    asked_of,
    differences_with_places,
)
from modetune.flows.jobs.job import NOTE_FILE, read_note
from modetune.flows.jobs.store_index import ask_index

#: What became of a job; `damaged`: its result was set aside because its checksum did not hold.
State = Literal["stored", "failed", "under way or broken off", "damaged", "kept", "not run"]
KEY_START = re.compile(r"[0-9a-f]{4,64}")
#: Keys shown where the start of one fits several.
SHOWN = 5


@dataclass(frozen=True, slots=True)
class Explanation:
    """What is known of a job.

    where: its file or folder; written_s: when that was written, since 1970; wall_s: what its
    result took; log: the end of what a failed solver run said; nearest: None where nothing is
    stored besides.
    """

    key: str
    state: State
    job: AskedJob | None
    where: Path | None
    written_s: float | None
    wall_s: float | None
    log: str
    nearest: Nearest | None


def key_start(text: str) -> str:
    """The start of a key from what a user gives: a key, its start, or a job's file or folder.

    Raises CampaignError.
    """
    start = Path(text).name.partition(".")[0].lower()
    if not KEY_START.fullmatch(start):
        raise CampaignError(
            f"{text!r} is not a key: expected at least 4 of its 64 hexadecimal digits, or the "
            "folder of a job"
        )
    return start


def one_key(store: Store, start: str) -> str | None:
    """The key that starts so of which a store knows; nothing where it knows of none.

    Raises CampaignError where the start fits several jobs.
    """
    keys = sorted({path.name.partition(".")[0] for _, path in _places(store, start)})
    if len(keys) > 1:
        shown = ", ".join(key[: len(start) + 8] for key in keys[:SHOWN])
        more = f" and {len(keys) - SHOWN} more" if len(keys) > SHOWN else ""
        raise CampaignError(f"{start} is the start of {len(keys)} keys: {shown}{more}; give more")
    return keys[0] if keys else None


def explain_job(store: Store, start: str) -> Explanation | None:
    """What the store knows of the job whose key starts so; nothing where it knows of none.

    Raises CampaignError where the start fits several jobs.
    """
    key = one_key(store, start)
    if key is None:
        return None
    state, path = _places(store, key)[0]
    holding = store.holding(key) if state == "stored" else None
    if state == "stored" and holding is None:
        state = "damaged"
    job = asked_of(holding) if holding else _job_of_folder(key, path)
    near = nearest(store, [job] if job else [], partial(kept_text, store))
    return Explanation(
        key=key,
        state=state,
        job=job,
        where=path,
        written_s=path.stat().st_mtime,
        wall_s=holding.wall_s if holding else None,
        log=log_tail(path) if state == "failed" and (path / LOG).is_file() else "",
        nearest=near[0] if near else None,
    )


def _places(store: Store, start: str) -> list[tuple[State, Path]]:
    """Where jobs whose keys start so have left something; what tells most comes first."""
    jobs = store.folder / "jobs"
    found: list[tuple[State, Path]] = [("stored", path) for path in sorted(store.entries(start))]
    patterns: tuple[tuple[State, Path, str], ...] = (
        ("failed", jobs, f"{start}*.failed"),
        ("under way or broken off", jobs, f"{start}*.part"),
        ("kept", jobs, f"{start}*"),
        ("damaged", store.folder / "damaged", f"{start}*.h5"),
    )
    for state, folder, pattern in patterns:
        known = {path for _, path in found}
        found += [(state, path) for path in sorted(folder.glob(pattern)) if path not in known]
    return found


def _job_of_folder(key: str, folder: Path) -> AskedJob | None:
    try:
        note = read_note((folder / NOTE_FILE).read_text(encoding="utf-8"))
    except OSError:
        return None
    return asked_by_note(key, note) if note else None


def nearest(store: Store, jobs: Sequence[AskedJob], texts: Texts) -> list[Nearest | None]:
    """Return for each job the nearest stored result of another job; None in an empty store.

    texts: the deck's lines by the digest of a model, where there are any.
    """
    if not jobs:
        return []
    keys = ask_index(store, lambda index: [index.nearest(job) for job in jobs])
    return [_first_whole(store, job, near, texts) for job, near in zip(jobs, keys, strict=True)]


def _first_whole(store: Store, job: AskedJob, keys: Sequence[str], texts: Texts) -> Nearest | None:
    for key in keys:
        holding = store.holding(key)
        if holding is not None:
            return Nearest(key, differences_with_places(job, asked_of(holding), texts))
    return None
