"""`modetune store`: list, check and prune the stored results.

Heavy packages are imported where they are needed.
"""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modetune.core.errors import CampaignError, StoreDamaged
from modetune.core.storage.keys import Json
from modetune.flows.cli.options import AsJson, StorePlace, stoppable, store_and_campaign
from modetune.flows.cli.output import print_result
from modetune.flows.report.tables import Column, table_of

if TYPE_CHECKING:
    from modetune.flows.jobs.store_files import StoreFile
    from modetune.flows.jobs.store_index import IndexedEntry, Order

AGES_S = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0, "w": 604800.0}
SIZES = {"B": 1.0, "kB": 1e3, "MB": 1e6, "GB": 1e9, "TB": 1e12}
#: Number of digits of a key to print.
SHORT = 12

Older = Annotated[str | None, typer.Option(help="Older than this: 90min, 12h, 30d, 8w.")]
Larger = Annotated[str | None, typer.Option(help="At least this large: 500kB, 10MB, 1GB.")]


class By(StrEnum):
    """Sort order of a list."""

    newest = "newest"
    oldest = "oldest"
    largest = "largest"


@dataclass(frozen=True, slots=True)
class EntryRow:
    """A row of the list. solver, kind and model are empty if the result is unreadable."""

    key: Annotated[str, Column("key")]
    age: Annotated[str, Column("written ago")]
    size: Annotated[str, Column("size")]
    wall_s: Annotated[float, Column("took", "s", ".3g")]
    solver: Annotated[str, Column("solver")]
    kind: Annotated[str, Column("analysis")]
    model: Annotated[str, Column("model")]


@dataclass(frozen=True, slots=True)
class SumRow:
    """The results of one solver, model and analysis."""

    what: Annotated[str, Column("what")]
    solver: Annotated[str, Column("solver")]
    model: Annotated[str, Column("model")]
    files: Annotated[int, Column("files")]
    size: Annotated[str, Column("size")]
    wall_s: Annotated[float, Column("took", "s", ".4g")]


def store_list(
    store: StorePlace = None,
    by: Annotated[By, typer.Option(help="Which results come first.")] = By.newest,
    older: Older = None,
    larger: Larger = None,
    limit: Annotated[
        int, typer.Option(help="Maximum number of results to list; 0: all.", min=0)
    ] = 50,
    as_json: AsJson = False,
) -> None:
    """List results with their date, size, content and cost."""
    from modetune.flows.jobs.store_index import EntryFilter, query_index

    place, _ = store_and_campaign(store)
    before_ns = int((time.time() - age_s(older)) * 1e9) if older else EntryFilter().before_ns
    chosen = EntryFilter(before_ns, size_bytes(larger) if larger else 0)
    found = query_index(place, lambda index: index.entries(chosen, limit or -1, _order(by)))
    told: Json = {"store": str(place.folder), "results": list(map(_told, found))}
    none = [] if found else [f"{place.folder} contains no such result"]
    rows = [_row(entry, time.time()) for entry in found]
    print_result(told, [table_of("", rows, EntryRow), *none], as_json)


def store_size(store: StorePlace = None, as_json: AsJson = False) -> None:
    """Show the size of the store by solver, model and analysis."""
    from modetune.flows.jobs.store_files import other_files
    from modetune.flows.jobs.store_index import query_index

    place, _ = store_and_campaign(store)
    sums: dict[tuple[str, str, str], tuple[int, int, float]] = {}

    def add(name: tuple[str, str, str], *more: float) -> None:
        files, size, wall_s = sums.get(name, (0, 0, 0.0))
        sums[name] = files + int(more[0]), size + int(more[1]), wall_s + more[2]

    for job, count, size, wall_s in query_index(place, lambda index: index.sums()):
        if job is None:
            add(("cannot be read", "", ""), count, size, 0.0)
        else:
            add((job.kind, job.solver, job.note.model if job.note else ""), count, size, wall_s)
    for item in other_files(place, time.time()):
        add((item.what, "", ""), 1, item.size, 0.0)
    sorted_sums = sorted(sums.items(), key=lambda item: -item[1][1])
    total = sum(size for _, size, _ in sums.values())
    holds: list[Json] = [
        {"what": what, "solver": solver, "model": model, "files": files, "size_bytes": size,
         "wall_s": wall_s}
        for (what, solver, model), (files, size, wall_s) in sorted_sums
    ]  # fmt: skip
    told: Json = {"store": str(place.folder), "size_bytes": total, "holds": holds}
    rows = [
        SumRow(*name, files, shown_size(size), wall_s)
        for name, (files, size, wall_s) in sorted_sums
    ]
    text = f"{place.folder} holds {shown_size(total)}"
    print_result(told, [table_of("", rows, SumRow), text], as_json)


def store_check(store: StorePlace = None, as_json: AsJson = False) -> None:
    """Read every result, and set damaged ones aside.

    modetune computes them again when needed. Exit code 5 if any result was damaged.
    """
    from modetune.flows.jobs.store_files import check

    place, _ = store_and_campaign(store)
    with stoppable("stopped; the damaged results found so far were set aside"):
        whole, damaged = check(place)
    aside = [f"set aside: {place.folder / 'damaged' / path.name}" for path in damaged]
    keys: list[Json] = [path.name.partition(".")[0] for path in damaged]
    told: Json = {"store": str(place.folder), "whole": whole, "damaged": keys}
    print_result(told, [f"{whole} whole, {len(damaged)} damaged", *aside], as_json)
    if damaged:
        raise typer.Exit(StoreDamaged.exit_code)


def store_prune(
    store: StorePlace = None,
    older: Older = None,
    larger: Larger = None,
    other_formats: Annotated[
        bool, typer.Option("--other-formats", help="Also results in formats of other versions.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="List what would be removed, and remove nothing.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Remove leftovers of killed runs, and results by age and size.

    --older and --larger apply to results, folders of failed and kept jobs, damaged results and
    texts of decks; if both are given, both must hold. Without them only leftovers are removed and,
    with --other-formats, results of other formats. Results stay while a campaign uses the store;
    modetune computes a removed result again when needed.
    """
    from modetune.flows.jobs.store_files import campaigns_running, prunable, remove

    place, _ = store_and_campaign(store)
    longest = age_s(older) if older else None
    least = size_bytes(larger) if larger else None
    found = prunable(place, time.time(), longest, least, other_formats)
    with stoppable("stopped; the same command continues from there"):
        gone = found if dry_run else remove(place, found)
    _tell_removed(place.folder, gone, dry_run, as_json)
    if (older or larger) and (running := campaigns_running(place)):
        typer.echo(f"kept results, because {running} running campaign(s) may need them", err=True)


def store_forget(
    key: Annotated[str, typer.Argument(help="First characters of a job's key, or a job's folder.")],
    store: StorePlace = None,
    as_json: AsJson = False,
) -> None:
    """Remove the result and folders of one job; modetune computes it again when needed."""
    from modetune.flows.jobs.lookup import key_start, one_key
    from modetune.flows.jobs.store_files import files_of, remove

    place, _ = store_and_campaign(store)
    start = key_start(key)
    whole = one_key(place, start)
    if whole is None:
        raise CampaignError(f"there is no job {start}... in {place.folder}")
    found = files_of(place, whole)
    gone = remove(place, found)
    if len(gone) < len(found):
        raise CampaignError(f"the job {whole[:SHORT]} is running; forget it after it ends")
    _tell_removed(place.folder, gone, False, as_json)


def age_s(text: str) -> float:
    """Return the seconds of an age such as 30d. Raises CampaignError."""
    return _measure(text, AGES_S, "an age", "30d")


def size_bytes(text: str) -> int:
    """Return the bytes of a size such as 10MB. Raises CampaignError."""
    return round(_measure(text, SIZES, "a size", "10MB"))


def shown_size(size: int) -> str:
    """Return a size with a suitable unit."""
    return _shown(size, SIZES)


def shown_age(seconds: float) -> str:
    """Return an age with a suitable unit, as --older accepts it."""
    return _shown(round(max(seconds, 0.0)), AGES_S, ".3g")


def _shown(value: float, units: Mapping[str, float], form: str = ".4g") -> str:
    least = min(units, key=units.__getitem__)
    unit = max(
        (unit for unit in units if value >= units[unit]), key=units.__getitem__, default=least
    )
    return f"{value / units[unit]:{form}} {unit}"


def _measure(text: str, units: Mapping[str, float], what: str, example: str) -> float:
    match = re.fullmatch(r"(\d+(?:\.\d+)?) ?([A-Za-z]+)", text.strip(), re.ASCII)
    by_name = {unit.lower(): value for unit, value in units.items()}
    if match is None or match[2].lower() not in by_name:
        raise CampaignError(
            f"{text!r} is not {what}: expected a number and one of {', '.join(units)}, as {example}"
        )
    return float(match[1]) * by_name[match[2].lower()]


def _order(by: By) -> Order:
    if by is By.newest:
        return "written_ns DESC"
    return "written_ns" if by is By.oldest else "size DESC"


def _tell_removed(folder: Path, gone: Sequence[StoreFile], dry_run: bool, as_json: bool) -> None:
    total = sum(item.size for item in gone)
    removed: list[Json] = [
        {"what": item.what, "path": str(item.path), "key": item.key,
         "size_bytes": item.size, "written": _time(item.written_s)}
        for item in gone
    ]  # fmt: skip
    done: Json = {"store": str(folder), "dry_run": dry_run, "size_bytes": total, "removed": removed}
    lines = []
    for what, count in Counter(item.what for item in gone).most_common():
        size = sum(item.size for item in gone if item.what == what)
        lines.append(f"{count:7} {what}: {shown_size(size)}")
    text = "would be freed" if dry_run else "freed"
    lines.append(f"{shown_size(total)} {text} in {folder}" if gone else "nothing to remove")
    print_result(done, lines, as_json)


def _row(entry: IndexedEntry, now_s: float) -> EntryRow:
    job = entry.job
    return EntryRow(
        entry.key[:SHORT],
        shown_age(now_s - entry.written_s),
        shown_size(entry.size),
        entry.wall_s if job else float("nan"),
        f"{job.solver} {job.solver_version}".strip() if job else "",
        job.kind if job else "cannot be read",
        job.note.model if job and job.note else "",
    )


def _told(entry: IndexedEntry) -> dict[str, Json]:
    job = entry.job
    return {
        "key": entry.key,
        "written": _time(entry.written_s),
        "size_bytes": entry.size,
        "wall_s": entry.wall_s if job else None,
        "solver": job.solver if job else None,
        "solver_version": job.solver_version if job else None,
        "analysis": job.kind if job else None,
        "model": job.note.model if job and job.note else None,
        "values": dict(job.note.values) if job and job.note else None,
    }


def _time(written_s: float) -> str:
    return datetime.fromtimestamp(written_s, UTC).isoformat()
