"""Frozen dataclasses as HDF5 and back, by their type hints: the form of our own files.

A dataclass is a group, and each of its fields a member of the field's name:

    text, number, truth value, Literal, Enum   an attribute of the group
    array; tuple of texts or numbers           a dataset
    dataclass                                  a group; where several classes are possible, its
                                               attribute `class` names the actual one
    tuple of anything else                     a group with the members 0000, 0001, ...
    mapping                                    a group with the members keys and values
    sparse matrix (CSR)                        a group with shape, data, indices, indptr
    None                                       nothing

Large arrays are compressed without loss. Texts are UTF-8; what that cannot represent is escaped.

Reading is strict: a member that is missing, or that the dataclass does not know, or of another
type, and values that the dataclass itself refuses, raise StoreDamaged. HDF5 hangs or crashes on
some files with a wrong byte, so modetune reads only what a seal (`core/storage/sealed_file`)
confirms.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from functools import cache, lru_cache
from types import NoneType, UnionType
from typing import Any, Literal, Protocol, TypeVar, Union, get_args, get_origin, get_type_hints

import h5py
import numpy as np
from scipy import sparse

from modetune.core.errors import ModetuneError, StoreDamaged

#: Bytes from which arrays are compressed: less than a page of the disk saves nothing.
COMPRESSED_BYTES = 4096
#: zlib's level: higher ones take several times as long for a hundredth of the size.
LEVEL = 1
#: Larger arrays of reals are stored as they are: zlib saves a quarter of their noisy digits, at 100
#: MB/s, and a disk is faster.
COMPRESSED_REALS = 1 << 24
D = TypeVar("D")

#: What h5py and constructors raise where a file is not what was expected.
UNFIT = (
    OSError,
    KeyError,
    IndexError,
    TypeError,
    ValueError,
    RuntimeError,
    AttributeError,
    MemoryError,
    ModetuneError,
)


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


def write_value(group: h5py.Group, value: object) -> None:
    """Put the fields of a dataclass into an empty group."""
    kind: Any = type(value)
    _dataclass_form(kind).fill(group, value)


def read_value(group: h5py.Group, kind: type[D]) -> D:
    """The dataclass that was put into a group. Raises StoreDamaged."""
    form: Any = kind
    try:
        value: D = _dataclass_form(form).take(group)
    except StoreDamaged:
        raise
    except UNFIT as error:
        raise StoreDamaged(f"it is not a readable {kind.__name__}: {error}") from error
    return value


def are_alike(one: Any, other: Any) -> bool:
    """Return whether two values have the same content, NaN equal to NaN, without writing them."""
    if is_dataclass(one):
        names = [item.name for item in fields(one)]
        return type(one) is type(other) and all(
            are_alike(getattr(one, name), getattr(other, name)) for name in names
        )
    if isinstance(one, Mapping):
        return other is not None and are_alike(tuple(one.items()), tuple(other.items()))
    if isinstance(one, tuple):
        return (
            isinstance(other, tuple) and len(one) == len(other) and all(map(are_alike, one, other))
        )
    if isinstance(one, sparse.csr_array):
        ours, theirs = ((item.shape, item.indptr, item.indices, item.data) for item in (one, other))
        return are_alike(ours, theirs)
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other, equal_nan=one.dtype.kind in "fc")
    return bool(one == other or (one != one and other != other))


class _Form(Protocol):
    """How a group holds values of one type."""

    def write(self, group: h5py.Group, name: str, value: Any) -> None: ...

    def read(self, group: h5py.Group, name: str) -> Any: ...


@cache
def _form(hint: Any) -> _Form:
    """The form of a type hint. Raises TypeError for one that has none."""
    origin, arguments = get_origin(hint), get_args(hint)
    if hint in _SCALARS:
        return _Scalar(hint)
    if hint is sparse.csr_array:
        return _Sparse()
    if isinstance(hint, type) and is_dataclass(hint):
        return _dataclass_form(hint)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return _Scalar(str, tuple(item.name for item in hint), lambda name: hint[name])
    if origin is Literal:
        return _Scalar(type(arguments[0]), arguments)
    if origin is np.ndarray:
        return _Array((np.dtype(get_args(arguments[1])[0]),))
    if origin in (Union, UnionType):
        return _union(arguments)
    if origin is tuple:
        items = [item for item in arguments if item is not Ellipsis]
        return _tuple(items, len(items) if len(items) == len(arguments) else None)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        keys, values = (_tuple([item], None) for item in arguments)
        return _Mapping(keys, values)
    raise TypeError(f"{hint} has no form in HDF5")


def _tuple(items: list[Any], count: int | None) -> _Form:
    """Return the form of a tuple with `count` items of these types, or any number of one type."""
    forms = [_form(item) for item in items]
    if all(isinstance(form, _Scalar) and form == forms[0] for form in forms):
        return _Column(forms[0], count)
    return _Items(tuple(forms), count)


def _union(arguments: tuple[Any, ...]) -> _Form:
    """The form of a type that may be one of several."""
    known = [item for item in arguments if item is not NoneType]
    if len(known) < len(arguments):
        return _Optional(_form(known[0]) if len(known) == 1 else _union(tuple(known)))
    if all(is_dataclass(item) for item in known):
        return _OneOf({item.__name__: item for item in known})
    forms = [_form(item) for item in known]
    dtypes = [dtype for item in forms if isinstance(item, _Array) for dtype in item.dtypes]
    if len(dtypes) != len(forms):
        raise TypeError(f"a union of {arguments} has no form in HDF5")
    return _Array(tuple(dtypes))


#: Plain types, and the kinds that NumPy has for them.
_SCALARS: dict[type, str] = {str: "UOT", float: "f", int: "i", bool: "b"}


@dataclass(frozen=True, slots=True)
class _Scalar:
    """A single value: an attribute. made: what the value is made of the stored one."""

    kind: type
    allowed: tuple[Any, ...] = ()
    made: Callable[[Any], Any] | None = None

    def stored(self, value: Any) -> Any:
        if isinstance(value, Enum):
            value = value.name
        return plain_text(value) if self.kind is str else self.kind(value)

    def checked(self, value: Any) -> Any:
        """A value as it was before it was stored. Raises ValueError."""
        found = np.asarray(value)
        if found.ndim or found.dtype.kind not in _SCALARS[self.kind]:
            raise ValueError(f"{found.tolist()!r} is not of type {self.kind.__name__}")
        plain = self.kind(found.item())
        if self.allowed and plain not in self.allowed:
            raise ValueError(f"{plain!r} is not one of {', '.join(map(repr, self.allowed))}")
        return plain if self.made is None else self.made(plain)

    def write(self, group: h5py.Group, name: str, value: Any) -> None:
        write_attribute(group, name, np.array(self.stored(value), dtype=dtype_of(self.kind)))

    def read(self, group: h5py.Group, name: str) -> Any:
        return self.checked(read_attribute(group, name))


@dataclass(frozen=True, slots=True)
class _Column:
    """A tuple of single values: a dataset (n,). count: how many, where that is fixed."""

    item: Any
    count: int | None

    def write(self, group: h5py.Group, name: str, value: Sequence[Any]) -> None:
        stored = [self.item.stored(item) for item in value]
        write_dataset(group, name, np.array(stored, dtype=dtype_of(self.item.kind)))

    def read(self, group: h5py.Group, name: str) -> tuple[Any, ...]:
        found = read_dataset(group, name)
        if found.ndim != 1 or (self.count is not None and found.size != self.count):
            raise ValueError(f"{group.name.rstrip('/')}/{name} has the shape {found.shape}")
        return tuple(self.item.checked(value) for value in found)


@dataclass(frozen=True, slots=True)
class _Array:
    """An array of one of some types: a dataset."""

    dtypes: tuple[np.dtype[Any], ...]

    def write(self, group: h5py.Group, name: str, value: Any) -> None:
        array = np.asarray(value)
        kinds = [dtype for dtype in self.dtypes if dtype.kind == array.dtype.kind]
        stored = array.astype((kinds or self.dtypes)[0], casting="same_kind", copy=False)
        write_dataset(group, name, stored)

    def read(self, group: h5py.Group, name: str) -> Any:
        found = read_array(group, name)
        for dtype in self.dtypes:
            if dtype.kind == found.dtype.kind:
                return found.astype(dtype, copy=False)
        raise ValueError(f"{name} holds {found.dtype}, not {self.dtypes[0]}")


@dataclass(frozen=True, slots=True)
class _Sparse:
    """A CSR matrix, its indices as they are: a group."""

    def write(self, group: h5py.Group, name: str, value: sparse.csr_array) -> None:
        made = group.create_group(name)
        made["shape"] = np.array(value.shape, dtype=np.int64)
        for part in ("data", "indices", "indptr"):
            write_dataset(made, part, getattr(value, part))

    def read(self, group: h5py.Group, name: str) -> sparse.csr_array:
        found = group[name]
        refuse_others(found, {"shape", "data", "indices", "indptr"})
        shape, *parts = (read_array(found, part) for part in ("shape", "data", "indices", "indptr"))
        matrix = sparse.csr_array(tuple(parts), shape=tuple(shape.tolist()))
        matrix.check_format()
        return matrix


@dataclass(frozen=True, slots=True)
class _Optional:
    """A value that may be None: nothing then."""

    form: _Form

    def write(self, group: h5py.Group, name: str, value: Any) -> None:
        if value is not None:
            self.form.write(group, name, value)

    def read(self, group: h5py.Group, name: str) -> Any:
        return self.form.read(group, name) if name in group or name in group.attrs else None


@dataclass(frozen=True, slots=True)
class _Items:
    """A tuple of dataclasses, arrays or tuples: a group with a member each."""

    forms: tuple[_Form, ...]
    count: int | None

    def each(self, count: int) -> list[tuple[_Form, str]]:
        if self.count is not None and self.count != count:
            raise ValueError(f"{count} in place of {self.count} items")
        forms = self.forms * count if self.count is None else self.forms
        return [(form, f"{place:04d}") for place, form in enumerate(forms)]

    def write(self, group: h5py.Group, name: str, value: Sequence[Any]) -> None:
        made = group.create_group(name)
        for (form, place), item in zip(self.each(len(value)), value, strict=True):
            form.write(made, place, item)

    def read(self, group: h5py.Group, name: str) -> tuple[Any, ...]:
        found = group[name]
        each = self.each(len(found) + len(found.attrs))
        return tuple(form.read(found, place) for form, place in each)


@dataclass(frozen=True, slots=True)
class _Mapping:
    """A mapping: a group with its keys and values, each as a tuple is."""

    keys: _Form
    values: _Form

    def write(self, group: h5py.Group, name: str, value: Mapping[Any, Any]) -> None:
        made = group.create_group(name)
        self.keys.write(made, "keys", tuple(value))
        self.values.write(made, "values", tuple(value.values()))

    def read(self, group: h5py.Group, name: str) -> dict[Any, Any]:
        found = group[name]
        refuse_others(found, {"keys", "values"})
        keys, values = self.keys.read(found, "keys"), self.values.read(found, "values")
        return dict(zip(keys, values, strict=True))


@dataclass(frozen=True, slots=True)
class _Dataclass:
    """A dataclass: a group with its fields. label: an additional attribute, or none."""

    kind: Any
    forms: tuple[tuple[str, _Form], ...]

    def fill(self, group: h5py.Group, value: Any) -> None:
        for name, form in self.forms:
            form.write(group, name, getattr(value, name))

    def take(self, group: h5py.Group, beside: frozenset[str] = frozenset()) -> Any:
        refuse_others(group, beside.union(name for name, _ in self.forms))
        values = {}
        for name, form in self.forms:
            try:
                values[name] = form.read(group, name)
            except StoreDamaged:
                raise
            except UNFIT as error:
                place = f"{group.name.rstrip('/')}/{name}"
                raise StoreDamaged(f"{place} is missing or unreadable: {error}") from error
        return self.kind(**values)

    def write(self, group: h5py.Group, name: str, value: Any) -> None:
        self.fill(group.create_group(name), value)

    def read(self, group: h5py.Group, name: str) -> Any:
        return self.take(group[name])


@cache
def _dataclass_form(kind: Any) -> _Dataclass:
    hints = get_type_hints(kind)
    return _Dataclass(kind, tuple((item.name, _form(hints[item.name])) for item in fields(kind)))


@dataclass(frozen=True, slots=True)
class _OneOf:
    """One of several dataclasses: a group whose attribute `class` is its name."""

    kinds: dict[str, Any]

    def write(self, group: h5py.Group, name: str, value: Any) -> None:
        made = group.create_group(name)
        made.attrs["class"] = type(value).__name__
        _dataclass_form(self.kinds[type(value).__name__]).fill(made, value)

    def read(self, group: h5py.Group, name: str) -> Any:
        found = group[name]
        kind = self.kinds[str(found.attrs["class"])]
        return _dataclass_form(kind).take(found, frozenset({"class"}))
