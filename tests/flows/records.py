"""Two records of one campaign, compared bit by bit."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

#: What a clock or a stop has a part in: seconds, and runs that the store spared.
OF_THE_RUN = {"wall_s", "core_s", "licence_s", "modal", "sensitivity", "reused"}


def differences(one: Path, other: Path) -> list[str]:
    """Names of datasets and attributes that two records do not share, or whose bits differ."""
    first, second = contents(one), contents(other)
    return sorted(
        name for name in first.keys() | second.keys() if first.get(name) != second.get(name)
    )


def contents(record: Path) -> dict[str, tuple[object, ...]]:
    """Type, shape and bits of each dataset and attribute of a record, but for times and counts."""
    found: dict[str, tuple[object, ...]] = {}

    def take(name: str, item: h5py.Group | h5py.Dataset) -> None:
        for key, value in item.attrs.items():
            if key not in OF_THE_RUN:
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
