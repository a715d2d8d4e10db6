"""Look up jobs in a store by the start of a key, and what jobs cost."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Literal

from modetune.adapters.process import LOG, log_tail
from modetune.core.errors import CampaignError
from modetune.core.storage.store import Store
from modetune.flows.jobs.engine import JobEngine
from modetune.flows.jobs.job import NOTE_FILE, JobNote, read_note
from modetune.flows.jobs.job_description import JobDescription, job_of_holding, job_of_note
from modetune.flows.jobs.store_index import query_index

#: `damaged`: the result was set aside because its checksum was wrong.
State = Literal["stored", "failed", "running or interrupted", "damaged", "kept", "not run"]
KEY_START = re.compile(r"[0-9a-f]{4,64}")
#: At most this many keys are listed if a start is ambiguous.
SHOWN = 5


@dataclass(frozen=True, slots=True)
class Explanation:
    """What a store has about a job.

    where is its file or folder and written_s its time since 1970; wall_s is the solver time; log is
    the end of a failed run's log.
    """

    key: str
    state: State
    job: JobDescription | None
    where: Path | None
    written_s: float | None
    wall_s: float | None
    log: str


def key_start(text: str) -> str:
    """Return the start of a key from a key, its start, or a job's file or folder.

    Raises CampaignError.
    """
    start = Path(text).name.partition(".")[0].lower()
    if not KEY_START.fullmatch(start):
        raise CampaignError(
            f"{text!r} is not a key; expected at least 4 of its 64 hexadecimal digits, or a job's "
            "folder"
        )
    return start


def one_key(store: Store, start: str) -> str | None:
    """Return the store's key with this start, None if there is none.

    Raises CampaignError if several keys have it.
    """
    keys = sorted({path.name.partition(".")[0] for _, path in _places(store, start)})
    if len(keys) > 1:
        shown = ", ".join(key[: len(start) + 8] for key in keys[:SHOWN])
        more = f" and {len(keys) - SHOWN} more" if len(keys) > SHOWN else ""
        raise CampaignError(
            f"{len(keys)} keys start with {start} ({shown}{more}); give more of its digits"
        )
    return keys[0] if keys else None


def explain_job(store: Store, start: str) -> Explanation | None:
    """Explain the job whose key has this start; None if the store has no such key.

    Raises CampaignError if several keys have it.
    """
    key = one_key(store, start)
    if key is None:
        return None
    state, path = _places(store, key)[0]
    holding = store.holding(key) if state == "stored" else None
    if state == "stored" and holding is None:
        state = "damaged"
    job = job_of_holding(holding) if holding else _job_of_folder(key, path)
    return Explanation(
        key=key,
        state=state,
        job=job,
        where=path,
        written_s=path.stat().st_mtime,
        wall_s=holding.wall_s if holding else None,
        log=log_tail(path) if state == "failed" and (path / LOG).is_file() else "",
    )


def _places(store: Store, start: str) -> list[tuple[State, Path]]:
    """Files and folders of jobs whose keys have this start, the most informative first."""
    jobs = store.folder / "jobs"
    found: list[tuple[State, Path]] = [("stored", path) for path in sorted(store.entries(start))]
    patterns: tuple[tuple[State, Path, str], ...] = (
        ("failed", jobs, f"{start}*.failed"),
        ("running or interrupted", jobs, f"{start}*.part"),
        ("kept", jobs, f"{start}*"),
        ("damaged", store.folder / "damaged", f"{start}*.h5"),
    )
    for state, folder, pattern in patterns:
        known = {path for _, path in found}
        found += [(state, path) for path in sorted(folder.glob(pattern)) if path not in known]
    return found


def _job_of_folder(key: str, folder: Path) -> JobDescription | None:
    try:
        note = read_note((folder / NOTE_FILE).read_text(encoding="utf-8"))
    except OSError:
        return None
    return job_of_note(key, note) if note else None


#: Costs are estimated from this number of the newest results.
NEWEST = 100


@dataclass(frozen=True, slots=True)
class MedianCost:
    """The cost of one job: seconds from start to result, and cores times seconds."""

    wall_s: float
    core_s: float


def job_costs(engine: JobEngine, digest: str, newest: int = NEWEST) -> dict[str, MedianCost]:
    """Return the median cost of each kind of analysis among the newest results in the store.

    digest is that of the model; results of other models with the same name are the fallback.
    """
    solver, name = engine.solver.program.name, engine.solver.deck.summary.name
    found = query_index(engine.store, lambda index: index.newest(newest))
    noted = [(item.job.note, item.wall_s) for item in found if item.job]
    ours = [(note, wall_s) for note, wall_s in noted if note and note.solver == solver]
    by_name = _medians([item for item in ours if item[0].model == name])
    return by_name | _medians([item for item in ours if item[0].model_digest == digest])


def _medians(noted: Sequence[tuple[JobNote, float]]) -> dict[str, MedianCost]:
    prices = {}
    for kind in {note.analysis for note, _ in noted}:
        of_kind = [
            (wall_s, note.threads * wall_s) for note, wall_s in noted if note.analysis == kind
        ]
        prices[kind] = MedianCost(
            median(wall_s for wall_s, _ in of_kind), median(core_s for _, core_s in of_kind)
        )
    return prices


def parallel_time(walls_s: Sequence[float], parallel: int) -> float:
    """Return the time that jobs take, `parallel` at a time, the longest first."""
    ends = [0.0] * max(parallel, 1)
    for wall_s in sorted(walls_s, reverse=True):
        ends[ends.index(min(ends))] += wall_s
    return max(ends)
