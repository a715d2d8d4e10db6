"""The codec: every kind of field comes back as it was, and nothing else is read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray
from scipy import sparse

from modetune.core.errors import ModesError, StoreDamaged
from modetune.core.modes import Floats, Integers
from modetune.core.storage.codec import COMPRESSED_BYTES, are_alike, read_value, write_value


class Colour(Enum):
    RED = 1
    BLUE = 2


@dataclass(frozen=True, slots=True)
class Leaf:
    name: str
    size: Floats

    def __post_init__(self) -> None:
        if (self.size < 0.0).any():
            raise ModesError("a size below zero")


@dataclass(frozen=True, slots=True)
class Twig:
    angle: float


@dataclass(frozen=True, slots=True)
class Tree:
    """A field of every kind."""

    text: str
    number: float
    count: int
    true: bool
    kind: Literal["oak", "ash"]
    colour: Colour
    real: Floats
    either: NDArray[np.float64] | NDArray[np.complex128]
    whole: Integers
    flags: NDArray[np.bool_]
    texts: tuple[str, ...]
    numbers: tuple[float, ...]
    pair: tuple[int, int]
    groups: tuple[tuple[int, ...], ...]
    rings: tuple[Floats, ...]
    leaf: Leaf
    leaves: tuple[Leaf, ...]
    parts: tuple[Leaf | Twig, ...]
    last: Leaf | Twig
    mixed: tuple[str, Leaf]
    named: Mapping[str, float]
    shelves: Mapping[int, Leaf]
    matrix: sparse.csr_array
    maybe: Leaf | None = None
    perhaps: float | None = None


LEAF = Leaf("a", np.array([1.0, 2.0]))


def tree() -> Tree:
    matrix = sparse.csr_array(np.array([[2.0, 0.0, 1.0], [0.0, 0.0, 3.0]]))
    return Tree(
        text="µ / \n",
        number=float("inf"),
        count=-3,
        true=True,
        kind="ash",
        colour=Colour.BLUE,
        real=np.arange(6.0).reshape(2, 3),
        either=np.array([1 + 2j]),
        whole=np.array([[1], [2]]),
        flags=np.array([True, False]),
        texts=("a", "", "ü"),
        numbers=(1.0, float("-inf")),
        pair=(4, 5),
        groups=((1, 2), (), (3,)),
        rings=(np.zeros((0, 2)), np.ones(3)),
        leaf=LEAF,
        leaves=(LEAF, replace(LEAF, name="b")),
        parts=(LEAF, Twig(0.5)),
        last=Twig(1.5),
        mixed=("m", LEAF),
        named={"x/y": 1.0, ".": 2.0},
        shelves={7: LEAF},
        matrix=matrix,
    )


def assert_same(one: Any, other: Any) -> None:
    """Equal bit for bit, all the way down."""
    assert type(one) is type(other)
    if is_dataclass(one):
        for item in fields(one):
            assert_same(getattr(one, item.name), getattr(other, item.name))
    elif isinstance(one, tuple):
        assert len(one) == len(other)
        for part, counterpart in zip(one, other, strict=True):
            assert_same(part, counterpart)
    elif isinstance(one, dict):
        assert_same(tuple(one.items()), tuple(other.items()))
    elif isinstance(one, sparse.csr_array):
        assert one.shape == other.shape
        for name in ("data", "indices", "indptr"):
            assert_same(getattr(one, name), getattr(other, name))
    elif isinstance(one, np.ndarray):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
    else:
        assert one == other or (one != one and other != other)


def through(value: Any, path: Path) -> Any:
    with h5py.File(path, "w") as file:
        write_value(file, value)
    with h5py.File(path, "r") as file:
        return read_value(file, type(value))


@pytest.mark.parametrize(
    "value",
    [
        tree(),
        replace(
            tree(),
            maybe=LEAF,
            perhaps=0.0,
            either=np.zeros((0, 3)),
            leaves=(),
            texts=(),
            numbers=(),
            groups=(),
            named={},
            real=np.zeros(0),
        ),
    ],
)
def test_what_was_written_is_read(tmp_path: Path, value: Tree) -> None:
    assert_same(through(value, tmp_path / "a.h5"), value)


def test_the_file_reads_with_h5py_alone(tmp_path: Path) -> None:
    through(tree(), tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as file:
        assert file.attrs["kind"] == "ash"
        assert file["leaves/0001"].attrs["name"] == "b"
        assert file["leaf/size"][()].tolist() == [1.0, 2.0]
        assert file["texts"].asstr()[()].tolist() == ["a", "", "ü"]
        assert file["parts/0001"].attrs["class"] == "Twig"
        assert file["matrix/indptr"][()].tolist() == [0, 2, 3]


def test_large_arrays_are_packed_without_loss(tmp_path: Path) -> None:
    large = np.repeat(np.random.default_rng(1).uniform(size=100), 100)
    assert_same(through(replace(tree(), real=large), tmp_path / "a.h5").real, large)
    assert (tmp_path / "a.h5").stat().st_size < large.nbytes / 2
    assert large.nbytes > COMPRESSED_BYTES


def test_what_hdf5_cannot_hold_is_escaped(tmp_path: Path) -> None:
    assert through(replace(tree(), text="a\0b\udce9"), tmp_path / "a.h5").text == r"a\x00b\udce9"


@settings(max_examples=50)
@given(
    text=st.text(st.characters(codec="utf-8", exclude_characters="\0")),
    number=st.floats(),
    count=st.integers(-(2**63), 2**63 - 1),
    real=arrays.arrays(np.float64, arrays.array_shapes(min_dims=1, max_dims=3, min_side=0)),
    either=arrays.arrays(np.complex128, arrays.array_shapes(max_dims=2)),
    texts=st.lists(st.text(st.characters(codec="utf-8", exclude_characters="\0"))).map(tuple),
)
def test_any_value_comes_back(tmp_path: Path, **values: Any) -> None:
    value = replace(tree(), **values)
    assert_same(through(value, tmp_path / "a.h5"), value)


@pytest.mark.parametrize(
    "change",
    [
        {"text": "other"},
        {"number": float("nan")},
        {"colour": Colour.RED},
        {"real": np.arange(6.0)},
        {"either": np.array([1 - 2j])},
        {"texts": ("a", "")},
        {"leaves": ()},
        {"last": LEAF},
        {"last": Twig(1.0)},
        {"named": {"x/y": 1.0, "z": 2.0}},
        {"matrix": sparse.csr_array(np.eye(2, 3))},
        {"maybe": LEAF},
        {"perhaps": 0.0},
    ],
)
def test_values_are_alike_if_no_field_differs(tmp_path: Path, change: dict[str, Any]) -> None:
    changed = replace(tree(), **change)
    assert are_alike(through(changed, tmp_path / "a.h5"), changed)
    assert not are_alike(changed, tree())
    assert not are_alike(tree(), changed)


def without(name: str) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        del file[name]

    return change


def put(name: str, value: Any) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        if name in file:
            del file[name]
        file[name] = value

    return change


def told(name: str, value: Any, place: str = "/") -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        file[place].attrs[name] = value

    return change


def deaf(file: h5py.File) -> None:
    del file.attrs["text"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (without("real"), "/real is missing"),
        (without("leaf"), "/leaf is missing"),
        (without("leaves/0000"), "leaves"),
        (without("matrix/indptr"), "/matrix is missing"),
        (without("named/keys"), "/named is missing"),
        (deaf, "/text is missing"),
        (put("more", 1.0), "unknown member 'more'"),
        (told("more", 1.0), "unknown member 'more'"),
        (told("more", 1.0, "leaf"), "/leaf has the unknown member 'more'"),
        (put("leaves/0005", 1.0), "leaves"),
        (put("matrix/more", 1.0), "/matrix has the unknown member 'more'"),
        (put("real", "text"), "/real"),
        (put("real", 1.0), "/real"),
        (put("real", np.array([1j])), "real holds complex128"),
        (put("real", np.array([1])), "real holds int64"),
        (put("either", np.array([1])), "either holds int64"),
        (put("texts", np.zeros(2)), "/texts"),
        (put("texts", np.zeros((2, 2))), "/texts has the shape"),
        (put("pair", np.arange(3)), "/pair has the shape"),
        (put("leaf", np.zeros(2)), "/leaf"),
        (put("leaf/size", np.array([-1.0])), "a size below zero"),
        (put("matrix/indices", np.array([0, 9, 2], np.int32)), "/matrix"),
        (told("number", "text"), "'text' is not of type float"),
        (told("number", np.zeros(2)), "is not of type float"),
        (told("count", 1.5), "1.5 is not of type int"),
        (told("true", 1), "is not of type bool"),
        (told("kind", "elm"), "'elm' is not one of 'oak', 'ash'"),
        (told("colour", "GREEN"), "'GREEN' is not one of"),
        (told("class", "Root", "last"), "Root"),
    ],
)
def test_what_is_not_such_a_value_is_refused_with_its_place(
    tmp_path: Path, change: Callable[[h5py.File], None], said: str
) -> None:
    through(tree(), tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        change(file)
        with pytest.raises(StoreDamaged, match=said):
            read_value(file, Tree)


@dataclass(frozen=True, slots=True)
class Odd:
    anything: object


@dataclass(frozen=True, slots=True)
class Torn:
    either: int | Floats


@pytest.mark.parametrize("value", [Odd(1), Torn(1)])
def test_a_type_without_a_form_is_a_fault_told_at_once(tmp_path: Path, value: Any) -> None:
    with pytest.raises(TypeError, match="has no form in HDF5"):
        through(value, tmp_path / "a.h5")
