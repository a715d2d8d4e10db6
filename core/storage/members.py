"""Members of an HDF5 group, attributes and datasets: written with few calls, and read strictly.

Large arrays are compressed without loss. Texts are UTF-8; what that cannot hold is escaped.
"""

from __future__ import annotations

from functools import cache, lru_cache
from typing import Any

import h5py
import numpy as np

#: Arrays of at least so many bytes are compressed: less than a page of the disk saves nothing.
COMPRESSED_BYTES = 4096
#: zlib's level: higher ones take several times as long for a hundredth of the size.
LEVEL = 1
#: Larger arrays of reals are stored as they are: zlib saves a quarter of their noisy digits, at 100
#: MB/s, and a disk is faster.
COMPRESSED_REALS = 1 << 24


def write_attribute(group: h5py.Group, name: str, value: Any) -> None:
    """value: an array without axes."""
    told, held = _types(value.dtype)
    h5py.h5a.create(group.id, name.encode(), told, _space(())).write(value, held)


def read_attribute(group: h5py.Group, name: str) -> Any:
    """What an attribute holds, texts decoded."""
    return _held(h5py.h5a.open(group.id, name.encode()))


def write_dataset(group: h5py.Group, name: str, array: Any) -> None:
    """A dataset, compressed where that pays."""
    whole = array.dtype.kind in "iub"
    most = np.inf if whole else COMPRESSED_REALS
    if not COMPRESSED_BYTES <= array.nbytes <= most or array.dtype.kind == "O":
        # As `create_dataset` does in a third of its time; a job's result has nine of them.
        told, held = _types(array.dtype)
        made = h5py.h5d.create(group.id, name.encode(), told, _space(array.shape), _untimed())
        inside = h5py.h5s.ALL
        made.write(inside, inside, np.ascontiguousarray(array).reshape(array.shape), held)
    else:
        # Bytes of whole numbers are sorted by place, where they repeat. Reals come from text, with
        # few digits, and repeat as they are: unsorted shapes take a quarter less, matrices a third.
        group.create_dataset(
            name, data=array, compression="gzip", compression_opts=LEVEL, shuffle=whole
        )


@cache
def _types(dtype: np.dtype[Any]) -> tuple[Any, Any]:
    """What HDF5 calls a type of values in a file, and in memory."""
    return h5py.h5t.py_create(dtype, logical=True), h5py.h5t.py_create(dtype)


@lru_cache
def _space(shape: tuple[int, ...]) -> Any:
    """What HDF5 calls a shape."""
    return h5py.h5s.create_simple(shape)


@cache
def _untimed() -> Any:
    """What datasets have besides: no time of writing, or no two files would be alike."""
    made = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    made.set_obj_track_times(False)
    return made


def read_dataset(group: h5py.Group, name: str) -> Any:
    """What a dataset holds, texts decoded."""
    return _held(h5py.h5d.open(group.id, name.encode()), h5py.h5s.ALL, h5py.h5s.ALL)


def read_array(group: h5py.Group, name: str) -> Any:
    """A dataset of numbers. Raises ValueError where it is something else."""
    found = read_dataset(group, name)
    if not found.ndim or found.dtype.kind not in "iufcb":
        raise ValueError(f"{name} is not an array of numbers")
    return found


def _held(found: Any, *part: Any) -> Any:
    values = np.empty(found.shape, found.dtype)
    found.read(*part, values)
    if values.dtype.kind == "O":
        texts = [text.decode("utf-8", "surrogateescape") for text in values.flat]
        values = np.array(texts, dtype=object).reshape(values.shape)
    return values


def refuse_others(group: h5py.Group, known: set[str] | frozenset[str]) -> None:
    """Raises ValueError where a group has other members and attributes than these."""
    strange = sorted({*group.keys(), *group.attrs.keys()} - known)
    if strange:
        raise ValueError(f"{group.name} has the unknown member {strange[0]!r}")


def dtype_of(kind: type) -> np.dtype[Any]:
    """Of single values in HDF5."""
    return h5py.string_dtype() if kind is str else np.dtype(kind)


def plain_text(value: Any) -> str:
    """A text that HDF5 can hold: without NUL and lone surrogates, as file names may have."""
    text = str(value).encode("utf-8", "backslashreplace").decode()
    return text.replace("\0", r"\x00")
