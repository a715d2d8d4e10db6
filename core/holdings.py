"""What a store holds, entry by entry, without reading the results: for people and for forecasts.

Only attributes are read and no checksum is taken, which costs about two milliseconds an entry; so
nothing that is computed may rest on it. Entries that cannot be read are passed over: whoever
wants one of them finds the damage.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import h5py

from modetune.core.store import Store


@dataclass(frozen=True, slots=True)
class Holding:
    """An entry's attributes.

    kind: of the result (modal, matrices, derivatives); asked: the canonical JSON behind the key;
    note: what was noted beside it, empty where nothing was; written_s: when, seconds since 1970.
    """

    key: str
    kind: str
    asked: str
    note: str
    solver: str
    solver_version: str
    wall_s: float
    written_s: float


def holdings(store: Store, newest: int | None = None) -> Iterator[Holding]:
    """The store's entries, the newest first, or only so many of them."""
    dated = []
    for path in store.folder.glob("[0-9a-f][0-9a-f]/*.h5"):
        try:
            dated.append((path.stat().st_mtime, path))
        except OSError:  # gone, or not ours to see
            continue
    for written_s, path in sorted(dated, reverse=True)[:newest]:
        holding = _holding(path, written_s)
        if holding is not None:
            yield holding


def holding_of(store: Store, key: str) -> Holding | None:
    """The entry of this key, or nothing."""
    path = store.path(key)
    return _holding(path, path.stat().st_mtime) if path.is_file() else None


def _holding(path: Path, written_s: float) -> Holding | None:
    try:
        with h5py.File(path, "r") as file:
            return Holding(
                key=str(file.attrs["key"]),
                kind=str(file.attrs["kind"]),
                asked=str(file.attrs["asked"]),
                note=str(file.attrs.get("note", "")),
                solver=str(file.attrs["solver"]),
                solver_version=str(file.attrs["solver_version"]),
                wall_s=float(file.attrs["wall_s"]),
                written_s=written_s,
            )
    except (OSError, KeyError, RuntimeError, ValueError, TypeError):
        return None
