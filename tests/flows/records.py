"""Two records of one campaign, or two results that a study printed, compared bit by bit."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

#: What depends on the run: seconds, solver runs that the store saved, and where the store is.
OF_THE_RUN = {"wall_s", "core_s", "licence_s", "modal", "sensitivity", "reused", "store"}


def differences(one: Path, other: Path) -> list[str]:
    """Names of datasets and attributes that two records do not share, or whose bits differ."""
    first, second = contents(one), contents(other)
    return sorted(
        name for name in first.keys() | second.keys() if first.get(name) != second.get(name)
    )


def contents(record: Path) -> dict[str, tuple[object, ...]]:
    """Return the bits of each dataset and attribute of a record, without times and counts.

    Of a JSON object: each value by its path.
    """
    if record.suffix == ".json":
        return dict(_values(json.loads(record.read_text("utf-8")), ""))
    found: dict[str, tuple[object, ...]] = {}

    def take(name: str, item: h5py.Group | h5py.Dataset) -> None:
        for key, value in item.attrs.items():
            if key not in OF_THE_RUN and (name, key) != ("", "ended_at"):
                found[f"{name}@{key}"] = _bits(value)
        if isinstance(item, h5py.Dataset):
            found[name] = _bits(item[()])

    with h5py.File(record, "r") as file:
        take("", file)
        file.visititems(take)
    assert found
    return found


def _bits(value: object) -> tuple[object, ...]:
    array = np.asarray(value)
    bits = tuple(array.ravel().tolist()) if array.dtype.kind == "O" else array.tobytes()
    return array.dtype.str, array.shape, bits


def _values(item: object, path: str) -> Iterator[tuple[str, tuple[object, ...]]]:
    if isinstance(item, dict):
        for key, value in item.items():
            if key not in OF_THE_RUN:
                yield from _values(value, f"{path}/{key}")
    elif isinstance(item, list):
        for place, value in enumerate(item):
            yield from _values(value, f"{path}/{place}")
    else:
        yield path, (item,)
